//! The hand in a window, at real time or slower: the loop that owns time, and what the panel shows of the task.

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Result;

use crate::env::{ACTION_SIZE, Env, Repose, Task};
use crate::evaluate::{Actor, Episodes, Player};
use crate::sim::{Bar, Controls, Curve, Readout, Viewer};

/// Whether this build has windows.
pub const PRESENT: bool = true;

/// The shortest time between two pictures.
const FRAME: Duration = Duration::from_micros(16_667);
/// A machine that cannot keep up falls behind by at most so many seconds.
const LARGEST_LAG: f64 = 0.25;
/// Control steps that the curves show.
const HISTORY: usize = 800;

/// An open window.
pub struct Window {
    viewer: Viewer,
}

impl Window {
    /// Opens a window on `task`, which must be one to see, that lets the user choose between actors of these names; the one at
    /// `first` begins.
    ///
    /// # Errors
    /// No display or a missing library, with the packages that bring them.
    pub fn open(task: &Task, actors: Vec<&'static str>, first: usize) -> Result<Self> {
        Ok(Self { viewer: Viewer::open(task.scene(), "shadow-repose", actors, first)? })
    }

    /// Plays the episodes, of which there may be no end, until they are over or the window is closed; returns what to say
    /// about it.
    ///
    /// # Errors
    /// OpenGL's.
    pub fn play(mut self, task: &Arc<Task>, actors: &[Actor], episodes: Episodes) -> Result<String> {
        let mut player = Player::new(task, episodes);
        let mut episode = episodes.first;
        let (mut tally, mut history) = (Tally::default(), History::default());
        let mut pace = Pace::new(task.config().ctrl_dt);
        while self.viewer.is_open() {
            let frame = Instant::now();
            let readout = readout(player.env(), episode, &tally, &history);
            let asked = self.viewer.show(player.env_mut().simulation_mut(), readout)?;
            if asked.reset {
                tally.goals += player.env().episode().goals;
                episode += 1;
                if episode - episodes.first >= episodes.count {
                    return Ok(tally.to_string());
                }
                player.start(episodes, episode);
            }
            if asked.new_goal {
                player.new_goal();
            }
            for _ in 0..pace.steps_due(&asked) {
                let end = player.step(&actors[asked.choice]);
                tally.steps += 1;
                history.add(player.env(), tally.steps as f64 * task.config().ctrl_dt);
                if end.is_some() {
                    tally.add(player.env());
                    episode += 1;
                    if episode - episodes.first >= episodes.count {
                        return Ok(tally.to_string());
                    }
                    player.start(episodes, episode);
                }
            }
            sleep(FRAME.saturating_sub(frame.elapsed()));
        }
        tally.goals += player.env().episode().goals;
        Ok(tally.to_string())
    }
}

/// Turns the time that has passed into control steps.
struct Pace {
    ctrl_dt: f64,
    last: Instant,
    /// s of the scene that are still to be played.
    owed: f64,
}

impl Pace {
    fn new(ctrl_dt: f64) -> Self {
        Self { ctrl_dt, last: Instant::now(), owed: 0.0 }
    }

    fn steps_due(&mut self, asked: &Controls) -> u32 {
        let passed = self.last.elapsed().as_secs_f64();
        self.last = Instant::now();
        if asked.paused {
            self.owed = 0.0;
            return asked.steps;
        }
        self.owed = (self.owed + passed * asked.speed).min(LARGEST_LAG * asked.speed.max(1.0));
        let steps = (self.owed / self.ctrl_dt).floor();
        self.owed -= steps * self.ctrl_dt;
        steps as u32
    }
}

/// What has been played in the window so far.
#[derive(Default)]
struct Tally {
    steps: u64,
    episodes: u32,
    drops: u32,
    goals: u32,
}

impl Tally {
    fn add(&mut self, env: &Repose) {
        let episode = env.episode();
        self.episodes += 1;
        self.drops += u32::from(episode.dropped);
        self.goals += episode.goals;
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { steps, episodes, drops, goals } = self;
        write!(f, "shown: {steps} steps, {episodes} episodes to their end, {drops} drops, {goals} goals reached")
    }
}

/// The recent past of an episode.
#[derive(Default)]
struct History {
    /// Degrees.
    error: VecDeque<[f64; 2]>,
    reward: VecDeque<[f64; 2]>,
}

impl History {
    fn add(&mut self, env: &Repose, time: f64) {
        let step = env.last_step();
        for (curve, value) in [(&mut self.error, step.rot_dist.to_degrees()), (&mut self.reward, step.reward.total())] {
            curve.push_back([time, value]);
            if curve.len() > HISTORY {
                curve.pop_front();
            }
        }
    }
}

fn readout(env: &Repose, episode: usize, tally: &Tally, history: &History) -> Readout {
    let config = env.config();
    let (stats, reward) = (env.episode(), env.last_step().reward);
    let tolerance = config.success_tolerance.to_degrees();
    let asked = config.max_consecutive_successes;
    // Of each term the largest that a step can pay or cost.
    let largest = [
        config.rot_reward_scale / config.rot_eps,
        config.dist_reward_scale * config.fall_dist,
        config.action_penalty_scale * ACTION_SIZE as f64,
        config.reach_goal_bonus,
        config.fall_penalty,
    ];
    let terms = reward.named().into_iter().zip(largest).map(|((name, value), largest)| {
        let share = if largest == 0.0 { 0.0 } else { (value / largest) as f32 };
        Bar { name, share, text: format!("{value:+.3}") }
    });
    let hold = Bar { name: "held", share: env.held() as f32 / asked as f32, text: format!("{}/{asked}", env.held()) };
    Readout {
        rows: vec![
            ("goals reached", stats.goals.to_string()),
            ("rotation error", format!("{:.1}° (goal {tolerance:.1}°)", env.rot_dist().to_degrees())),
            ("episode", format!("{episode}, {:.2} s", f64::from(stats.length) * config.ctrl_dt)),
            ("before it", format!("{} goals, {} drops in {}", tally.goals, tally.drops, tally.episodes)),
        ],
        bars: vec![("within the tolerance", vec![hold]), ("reward of this step", terms.collect())],
        curves: vec![
            Curve { name: "rotation error, degrees", points: history.error.clone(), level: Some(tolerance) },
            Curve { name: "reward", points: history.reward.clone(), level: None },
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn controls(paused: bool, speed: f64, steps: u32) -> Controls {
        Controls { paused, speed, choice: 0, steps, reset: false, new_goal: false }
    }

    #[test]
    fn a_pause_lets_single_steps_through_and_does_not_catch_up_afterwards() {
        let mut pace = Pace::new(1e-3);
        pace.last -= Duration::from_secs(10);
        assert_eq!(pace.steps_due(&controls(true, 1.0, 3)), 3);
        assert_eq!(pace.steps_due(&controls(true, 1.0, 0)), 0);
        assert!(pace.steps_due(&controls(false, 1.0, 0)) < 200, "the pause is not played");
    }

    #[test]
    fn a_machine_that_is_too_slow_falls_behind_instead_of_stalling() {
        let mut pace = Pace::new(0.01);
        pace.last -= Duration::from_secs(60);
        assert_eq!(pace.steps_due(&controls(false, 1.0, 0)), 25);
    }
}
