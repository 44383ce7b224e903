//! The first episodes of a score, step by step, as JSON lines: enough to replay and check each step elsewhere.

use serde_json::{Map, Value, json};

use crate::env::{End, Env};
use crate::evaluate::Moment;
use crate::repose::{Group, Task, add_settings, named, physical, task_terms};

/// The number of records at which writing stops. Episodes are written whole and in order.
const ENOUGH: usize = 2000;

/// The records of episodes that may still be needed.
pub struct Trace {
    header: Value,
    /// The lines of each episode.
    episodes: Vec<Vec<String>>,
    /// The last episode that may be needed, as far as is known.
    last: usize,
}

impl Trace {
    /// Creates an empty trace of a task, played by the `actor` of this name, with the policy in `checkpoint`, in episodes drawn from
    /// `seed`.
    pub fn new(task: &Task, actor: &str, checkpoint: Option<&str>, seed: u64) -> Self {
        let config = &task.config;
        let hand = &task.hand;
        // The entries that are not zero: row, column and value.
        let mirror = task.mirror().map(|matrix| -> Value {
            matrix
                .iter()
                .enumerate()
                .filter(|(_, value)| **value != 0.0)
                .map(|(i, value)| json!([i / hand.layout.size, i % hand.layout.size, value]))
                .collect()
        });
        let mut header = json!({
            "sim_dt": config.sim_dt,
            "ctrl_dt": config.ctrl_dt,
            "act_moving_average": config.act_moving_average.at(0),
            "success_tolerance": config.success_tolerance,
            "max_consecutive_successes": config.max_consecutive_successes,
            "max_episode_steps": config.max_episode_steps(),
            "model": config.model,
            "goal_position": config.goal_position.value,
            "actor": actor,
            "checkpoint": checkpoint,
            "seed": seed,
            "settings": config.unlike_default(),
            "observation": Vec::from_iter(hand.layout.groups().map(|Group { name, start, length, unit, .. }| {
                json!({ "name": name, "start": start, "length": length, "unit": unit })
            })),
            "joint_names": hand.parts.joints,
            "actuator_names": hand.parts.actuators,
            "fingertip_names": hand.parts.fingertips,
            "quaternion_order": "wxyz",
            "vel_obs_scale": config.vel_obs_scale,
            "mirror_matrix": mirror,
            "warnings": task.warnings,
            "prediction": config.prediction,
            "predicted_with": task.predicted_with().map(physical),
        });
        add_settings(config, &mut header);
        Self {
            header,
            episodes: Vec::new(),
            last: usize::MAX,
        }
    }

    /// Records `moment` if it may be needed.
    ///
    /// Episodes run in parallel, and their lengths are not known beforehand. But once the episodes up to some number have
    /// enough records together, no later one is needed.
    pub fn record(&mut self, moment: &Moment) {
        if moment.episode > self.last {
            return;
        }
        if self.episodes.len() <= moment.episode {
            self.episodes.resize(moment.episode + 1, Vec::new());
        }
        self.episodes[moment.episode].push(record(moment).to_string());
        let mut records = 0;
        let full = self.episodes.iter().position(|lines| {
            records += lines.len();
            records >= ENOUGH
        });
        if let Some(last) = full {
            self.last = last;
            self.episodes.truncate(last + 1);
        }
    }

    /// The whole text.
    pub fn finish(self) -> String {
        let lines =
            std::iter::once(self.header.to_string()).chain(self.episodes.into_iter().flatten());
        lines.map(|line| line + "\n").collect()
    }
}

fn record(moment: &Moment) -> Value {
    let env = moment.env;
    let simulation = &env.sim;
    let qpos = simulation.qpos();
    let qvel = simulation.qvel();
    let obs = doubles(moment.observation);
    let episode = moment.episode;
    let step = env.episode().length;
    let Some((action, end)) = moment.step else {
        return json!({
            "episode": episode, "step": step, "qpos": qpos, "qvel": qvel, "reset": true, "goal": env.goal, "obs": obs,
        });
    };
    let details = &env.last;
    let mut reward = Map::from_iter(
        named(task_terms(), details.reward).map(|(name, value)| (name.to_owned(), json!(value))),
    );
    reward.insert("total".into(), json!(details.reward.iter().sum::<f64>()));
    json!({
        "episode": episode,
        "step": step,
        "qpos": qpos,
        "qvel": qvel,
        "ctrl": simulation.ctrl(),
        "action": doubles(action),
        "goal": details.goal,
        "reward": reward,
        "rot_dist": details.rot_dist,
        "goal_dist": details.goal_dist,
        "held": env.held,
        "goals": env.episode().goals,
        "terminated": end == Some(End::Terminated),
        "truncated": end == Some(End::Truncated),
        "diverged": details.diverged,
        "obs": obs,
    })
}

/// Floats as doubles, so that a reader gets exactly the same values.
fn doubles(values: &[f32]) -> Value {
    values.iter().map(|&x| json!(f64::from(x))).collect()
}
