//! The hand in a window: the loop that controls time, and the panel's readout of the task.

use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::clock::Clock;
use crate::env::Env;
use crate::evaluate::{Actor, Episodes, Player};
use crate::os;
use crate::repose::{Repose, Step, Task, TaskReward, named, task_reward, task_terms};
use crate::sim::{Gauge, Readout, Trend, Viewer};

/// The minimum time between two frames.
const FRAME: Duration = Duration::from_micros(16_667);
/// Printed when a window opens.
const KEYS: &str = "window: Space pauses, Right steps, Up and Down change the speed, G new goal, R reset, P next kind of actions, \
                    X MuJoCo's panel, Ctrl+Q closes";
/// The number of control steps that the curves show.
const HISTORY: usize = 800;

/// An open window.
pub struct Window<'a> {
    viewer: Viewer,
    actors: Vec<Actor<'a>>,
}

impl<'a> Window<'a> {
    /// Opens a window on `task`, which must have been loaded for display. The user chooses between `actors`, by their names, and
    /// begins with `actors[first]`.
    ///
    /// # Errors
    /// Fails if there is no display or a library is missing. The message names the packages that provide it.
    pub fn open(task: &Task, actors: Vec<(&'static str, Actor<'a>)>, first: usize) -> Result<Self> {
        let (names, actors) = actors.into_iter().unzip();
        let viewer = Viewer::open(&task.scene, names, first)?;
        os::say_line(KEYS);
        Ok(Self { viewer, actors })
    }

    /// Plays the episodes, possibly without end, until they are over or the window is closed. Returns a summary to print.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    pub fn play(mut self, task: &Arc<Task>, episodes: Episodes) -> Result<String> {
        let mut player = Player::new(task, episodes);
        let mut tally = Tally::default();
        let mut curves = [
            Trend {
                name: "rotation error, degrees (line: tolerance)",
                level: Some(task.config.success_tolerance.to_degrees()),
                ..Trend::default()
            },
            Trend {
                name: "reward of a step",
                ..Trend::default()
            },
        ];
        let mut clock = Clock::new(task.config.ctrl_dt);
        // Ends the episode and starts the next one, if there is one.
        let next = |player: &mut Player, tally: &mut Tally, is_complete: bool| {
            tally.add(&player.lane.env, is_complete);
            let is_left = tally.episodes < episodes.count;
            if is_left {
                player.start(episodes, episodes.first + tally.episodes);
            }
            is_left
        };
        while self.viewer.is_open() {
            let frame = Instant::now();
            let episode = episodes.first + tally.episodes;
            let readout = readout(&player.lane.env, episode, &tally, &curves);
            let asked = self.viewer.show(&mut player.lane.env.sim, readout)?;
            if asked.reset && !next(&mut player, &mut tally, false) {
                return Ok(tally.summary());
            }
            if asked.new_goal {
                player.new_goal();
            }
            let due = if asked.paused {
                clock.pause();
                asked.steps
            } else {
                clock.steps_due(asked.speed)
            };
            for _ in 0..due {
                let end = player.step(&self.actors[asked.choice]);
                tally.steps += 1;
                extend(&mut curves, &player.lane.env, tally.steps);
                if end.is_some() && !next(&mut player, &mut tally, true) {
                    return Ok(tally.summary());
                }
            }
            sleep(FRAME.saturating_sub(frame.elapsed()));
        }
        tally.add(&player.lane.env, false);
        Ok(tally.summary())
    }
}

/// The totals played in the window so far.
#[derive(Default)]
struct Tally {
    steps: u64,
    /// All episodes before the current one.
    episodes: usize,
    /// Episodes that the user did not end.
    completed: u32,
    drops: u32,
    goals: u32,
}

impl Tally {
    /// Adds an episode.
    fn add(&mut self, env: &Repose, is_complete: bool) {
        let episode = env.episode();
        self.episodes += 1;
        self.completed += u32::from(is_complete);
        self.drops += u32::from(episode.dropped);
        self.goals += episode.goals;
    }

    fn summary(&self) -> String {
        format!(
            "shown: {} steps, {} episodes completed, {} drops, {} goals reached",
            self.steps, self.completed, self.drops, self.goals
        )
    }
}

/// Adds the last of so many steps to the curves of the error and the reward.
fn extend(curves: &mut [Trend; 2], env: &Repose, steps: u64) {
    let time = steps as f64 * env.task.config.ctrl_dt;
    let values = [env.last.rot_dist.to_degrees(), env.last.reward.iter().sum()];
    for (Trend { points, .. }, value) in curves.iter_mut().zip(values) {
        points.push_back([time, value]);
        if points.len() > HISTORY {
            points.pop_front();
        }
    }
}

fn readout(env: &Repose, episode: usize, tally: &Tally, curves: &[Trend]) -> Readout {
    let config = &env.task.config;
    let stats = env.episode();
    let reward = if stats.length == 0 {
        TaskReward::default()
    } else {
        env.last.reward
    };
    let asked = config.max_consecutive_successes;
    // The largest value of each term in a step, positive or negative.
    let extreme = Step {
        goal_dist: config.fall_dist,
        action: vec![1.0; env.spaces().action_size],
        ..Step::default()
    };
    let largest = task_reward(config, &extreme);
    let terms = named(task_terms(), reward).zip(largest);
    let terms = terms.map(|((name, value), largest)| Gauge {
        name,
        fraction: if largest == 0.0 {
            0.0
        } else {
            (value / largest.abs()) as f32
        },
        signed: true,
        text: format!("{value:+.3}"),
    });
    let hold = Gauge {
        name: "held",
        fraction: env.held as f32 / asked as f32,
        signed: false,
        text: format!("{} of {asked} steps", env.held),
    };
    // The episodes before the current one, including episodes that the user ended.
    let before = match tally.episodes {
        0 => "nothing yet".to_owned(),
        count => format!(
            "{} goals, {} drops in {count} episodes",
            tally.goals, tally.drops
        ),
    };
    let angle = |radians: f64| format!("{:.1}° = {radians:.3} rad", radians.to_degrees());
    Readout {
        rows: vec![
            ("goals reached", stats.goals.to_string()),
            ("rotation error", angle(env.rot_dist())),
            ("tolerance", angle(config.success_tolerance)),
            (
                "episode",
                format!(
                    "{episode}, {:.2} s",
                    f64::from(stats.length) * config.ctrl_dt
                ),
            ),
            ("before", before),
        ],
        bars: vec![
            ("within the tolerance", vec![hold]),
            ("reward of this step", terms.collect()),
        ],
        curves: curves.to_vec(),
    }
}
