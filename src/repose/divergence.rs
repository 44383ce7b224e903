//! How the physics of an episode diverged: its last steps, as JSON that any MuJoCo can replay.

use serde_json::json;

use super::EpisodePhysics;
use super::physics::add_settings;
use crate::config::EnvConfig;
use crate::sim::Simulation;

/// The end of an episode whose physics diverged.
pub struct Diverged {
    /// The length of the episode in control steps, including the last one.
    pub length: u32,
    /// What the episode has drawn, if it was randomised.
    pub draw: Option<EpisodePhysics>,
    /// The last steps of the episode.
    pub tail: Tail,
}

impl Diverged {
    /// One object. `state` is MuJoCo's `mj_getState` for `mjSTATE_INTEGRATION` before the first step. `ctrl` holds the
    /// controls of each step in the model's order, and `actions` the policy's actions. In a training run with randomised episodes,
    /// `randomization` is what this one has drawn on top of the settings (null if nothing). `pushes` is then the force on the object
    /// in each step. `torques` is the torque on the object in each step with assistance. It is shorter than `ctrl` if the assistance
    /// began or ended within these steps.
    pub fn as_json(&self, config: &EnvConfig, iteration: u64, env: usize) -> String {
        let tail = &self.tail;
        let actions: Vec<_> = tail.actions.chunks_exact(tail.width).collect();
        let ctrl: Vec<_> = tail.controls.chunks_exact(tail.width).collect();
        let mut dump = json!({
            "model": config.model,
            "goal_position": config.goal_position.value,
            "sim_dt": config.sim_dt,
            "ctrl_dt": config.ctrl_dt,
            "iteration": iteration,
            "environment": env,
            "episode_length": self.length,
            "state": tail.start,
            "ctrl": ctrl,
            "actions": actions,
        });
        add_settings(config, &mut dump);
        dump["randomization"] = self.draw.as_ref().map(|draw| draw.physics.as_json()).into();
        dump["pushes"] = json!(tail.pushes);
        dump["torques"] = json!(tail.torques);
        format!("{dump}\n")
    }
}

/// A warning if the physics diverged in more than 1 % of the steps, and what is learnt or scored then is not the task. Otherwise a warning
/// if more than 1 % of the predictions diverged.
pub fn divergence(diverged: u64, unpredicted: u64, steps: u64) -> Option<String> {
    let warning =
        |count, what| (count * 100 > steps).then(|| format!("in {count} of {steps} steps {what}"));
    let physics = "the physics diverged and the episode ended: this combination of scene, env.sim_dt, masses, friction, gains and \
                   damping cannot be simulated";
    let prediction = "the prediction diverged, and the policy saw what was measured: a model cannot go on from such a measurement \
                      (env.prediction, env.noise, env.bias)";
    warning(diverged, physics).or_else(|| warning(unpredicted, prediction))
}

/// The number of steps between two kept states.
const STEPS: usize = 16;

/// The data needed to replay the end of an episode in any MuJoCo.
#[derive(Clone, Default)]
pub struct Tail {
    /// The state before the first of these steps.
    pub start: Box<[f64]>,
    /// The controls sent in each step, in the model's order, one step after another.
    pub controls: Vec<f64>,
    /// The policy's action in each step, one step after another.
    pub actions: Vec<f32>,
    /// The number of controls, and of values in an action.
    pub width: usize,
    /// The random force on the object in each step, N. Empty where there is none.
    pub pushes: Vec<[f64; 3]>,
    /// The torque on the object in each step, N m. Empty where there is none.
    pub torques: Vec<[f64; 3]>,
}

/// The steps since the second-to-last kept state: at least the last 16 if the episode has that many.
#[derive(Default)]
pub struct Recorder {
    before: Option<Tail>,
    now: Option<Tail>,
}

impl Recorder {
    /// Records a step that is about to be taken, after its controls have been set.
    pub fn record(
        &mut self,
        sim: &Simulation,
        action: &[f32],
        push: Option<[f64; 3]>,
        torque: Option<[f64; 3]>,
    ) {
        let width = action.len();
        if self
            .now
            .as_ref()
            .is_none_or(|tail| tail.controls.len() == STEPS * width)
        {
            self.before = self.now.replace(Tail {
                start: sim.state(),
                width,
                ..Tail::default()
            });
        }
        let tail = self.now.as_mut().expect("just begun");
        tail.controls.extend(sim.ctrl());
        tail.actions.extend(action);
        tail.pushes.extend(push);
        tail.torques.extend(torque);
    }

    /// The recorded steps, or `None` before the first step.
    pub fn tail(&self) -> Option<Tail> {
        let mut parts = [&self.before, &self.now].into_iter().flatten().cloned();
        let mut tail = parts.next()?;
        for part in parts {
            tail.controls.extend(part.controls);
            tail.actions.extend(part.actions);
            tail.pushes.extend(part.pushes);
            tail.torques.extend(part.torques);
        }
        Some(tail)
    }
}
