//! What training may change of the task and add to its reward, at one moment of a run.

use std::f64::consts::PI;
use std::ops::AddAssign;

use crate::config::{EnvConfig, TrainingConfig, share};

/// The task as it is trained at some moment: what counts as reaching a goal, which goals are drawn, what is paid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lesson {
    /// Rotation error that counts as being at the goal, rad.
    pub tolerance: f64,
    /// Steps within the tolerance until a goal is reached.
    pub hold: u32,
    /// A new goal is at most so far from the cube's orientation, rad.
    pub goal_angle: f64,
    /// Control steps after which an episode is truncated.
    pub max_episode_steps: u32,
    /// Chance that the goal is replaced after a step on which it was not reached.
    pub redirect_chance: f64,
    /// Whether the value of going on with a goal that was reached is bootstrapped, as if it stayed.
    pub bootstrap_reached: bool,
    /// Weight of the task's own reward.
    pub task_reward: f64,
    /// Paid for each rad by which the rotation error shrinks, taken back where it grows.
    progress_reward: f64,
    /// Paid on every step within the tolerance.
    hold_reward: f64,
    /// Paid on the step on which a goal is reached.
    goal_reward: f64,
    /// Paid on the step on which the cube is dropped.
    pub drop_reward: f64,
}

/// What training pays besides the task's own reward.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shaping {
    /// For turning towards the goal.
    pub progress: f64,
    /// For being within the tolerance.
    pub within: f64,
    /// For reaching a goal.
    pub goal: f64,
    /// For dropping the cube.
    pub drop: f64,
}

impl Lesson {
    /// The task itself: what is played, and what is scored.
    pub fn task(env: &EnvConfig) -> Self {
        Self {
            tolerance: env.success_tolerance,
            hold: env.max_consecutive_successes,
            goal_angle: PI,
            max_episode_steps: env.max_episode_steps(),
            redirect_chance: 0.0,
            bootstrap_reached: false,
            task_reward: 1.0,
            progress_reward: 0.0,
            hold_reward: 0.0,
            goal_reward: 0.0,
            drop_reward: 0.0,
        }
    }

    /// The lesson that training gives after `env_steps` control steps of the whole run.
    pub fn at(env_steps: u64, training: &TrainingConfig, env: &EnvConfig) -> Self {
        let task = Self::task(env);
        let share = |steps| share(env_steps, steps);
        let between = |start: f64, end: f64, share: f64| start * (1.0 - share) + end * share;
        let last_hold = (training.hold_scale * f64::from(task.hold)).round().max(1.0);
        let first_hold = f64::from(training.hold_start).min(last_hold);
        let hold = between(first_hold, last_hold, share(training.hold_steps));
        Self {
            // By equal factors in equal times: halving the error is as hard a step anywhere.
            tolerance: training.tolerance_start.powf(1.0 - share(training.tolerance_steps))
                * (training.tolerance_scale * task.tolerance).powf(share(training.tolerance_steps)),
            hold: hold.round() as u32,
            goal_angle: between(training.goal_angle_start, task.goal_angle, share(training.goal_angle_steps)),
            max_episode_steps: match training.episode_seconds {
                0.0 => task.max_episode_steps,
                // Whoever plays a policy in shorter episodes need not say what only training sees.
                seconds => env.control_steps(seconds).min(task.max_episode_steps),
            },
            redirect_chance: if training.goal_lifetime == 0 { 0.0 } else { 1.0 / training.goal_lifetime as f64 },
            bootstrap_reached: training.bootstrap_reached,
            task_reward: between(training.task_reward_start, training.task_reward, share(training.task_reward_steps)),
            progress_reward: training.progress_reward,
            hold_reward: training.hold_reward,
            goal_reward: training.goal_reward,
            drop_reward: between(training.drop_reward_start, training.drop_reward, share(training.drop_reward_steps)),
        }
    }

    /// What a step pays that has turned the cube `progress` rad towards the goal.
    pub(super) fn shaping(&self, progress: f64, within: bool, reached: bool, dropped: bool) -> Shaping {
        Shaping {
            progress: self.progress_reward * progress,
            within: if within { self.hold_reward } else { 0.0 },
            goal: if reached { self.goal_reward } else { 0.0 },
            drop: if dropped { self.drop_reward } else { 0.0 },
        }
    }

    /// What training pays for a step with this reward of the task.
    pub(super) fn total(&self, task: f64, shaping: Shaping) -> f64 {
        self.task_reward * task + shaping.values().iter().sum::<f64>()
    }
}

impl Shaping {
    /// The names under which the terms are logged, in the order of [`Shaping::values`].
    pub const NAMES: [&'static str; 4] = ["progress", "within", "goal", "drop"];

    /// The terms in the order of [`Shaping::NAMES`].
    pub fn values(&self) -> [f64; 4] {
        [self.progress, self.within, self.goal, self.drop]
    }
}

impl AddAssign for Shaping {
    fn add_assign(&mut self, other: Self) {
        self.progress += other.progress;
        self.within += other.within;
        self.goal += other.goal;
        self.drop += other.drop;
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::{Config, Override};

    fn at(env_steps: u64, sets: &[&str]) -> Lesson {
        let sets: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
        // Like a run from before there was anything that only training sees.
        let config = Config::from_text(Path::new("config.toml"), "", &sets).unwrap();
        Lesson::at(env_steps, &config.training, &config.env)
    }

    #[test]
    fn without_curricula_and_shaping_the_task_itself_is_trained() {
        let task = Lesson::task(&Config::resolve(None, &[]).unwrap().env);
        assert_eq!([at(0, &[]), at(1 << 40, &[])], [task; 2]);
        assert_eq!(task.total(1.25, task.shaping(3.0, true, true, true)), 1.25);
    }

    #[test]
    fn curricula_go_from_their_start_to_the_task_in_so_many_steps_and_stay_there() {
        let sets = ["training.tolerance_start=0.4", "training.tolerance_steps=1000", "training.hold_start=1"];
        let sets = [&sets[..], &["training.hold_steps=2000", "training.goal_angle_steps=500"]].concat();
        let sets = [&sets[..], &["training.goal_angle_start=1"]].concat();
        let found = [0, 500, 1000, 2000, 9000].map(|steps| at(steps, &sets));
        let tolerances = found.map(|lesson| (lesson.tolerance * 1e6).round() / 1e6);
        assert_eq!(tolerances, [0.4, 0.2, 0.1, 0.1, 0.1]);
        let aims_better = at(1000, &[&sets[..], &["training.tolerance_scale=0.5"]].concat());
        assert!((aims_better.tolerance - 0.05).abs() < 1e-9, "{}", aims_better.tolerance);
        assert_eq!(found.map(|lesson| lesson.hold), [1, 13, 26, 50, 50]);
        let shorter = [&sets[..], &["training.hold_scale=0.3"]].concat();
        assert_eq!([0, 1000, 2000, 9000].map(|steps| at(steps, &shorter).hold), [1, 8, 15, 15]);
        assert_eq!(found.map(|lesson| lesson.goal_angle), [1.0, PI, PI, PI, PI]);
    }

    #[test]
    fn training_pays_for_progress_goals_and_drops_besides_the_weighted_task() {
        let sets = ["training.task_reward=0.5", "training.progress_reward=10", "training.goal_reward=7"];
        let lesson = at(0, &[&sets[..], &["training.drop_reward=-3", "training.hold_reward=2"]].concat());
        let shaping = lesson.shaping(-0.2, true, true, false);
        assert_eq!(shaping.values(), [-2.0, 2.0, 7.0, 0.0]);
        assert_eq!(lesson.total(4.0, shaping), 9.0);
        assert_eq!(lesson.shaping(0.1, false, false, true).values(), [1.0, 0.0, 0.0, -3.0]);
        let sets = ["training.drop_reward=-3", "training.drop_reward_start=1", "training.drop_reward_steps=100"];
        let drops = [0, 50, 100, 500].map(|steps| at(steps, &sets).shaping(0.0, false, false, true).drop);
        assert_eq!(drops, [1.0, -1.0, -3.0, -3.0]);
        let sets = ["training.task_reward=0", "training.task_reward_start=1", "training.task_reward_steps=100"];
        let weights = [0, 50, 100, 500].map(|steps| at(steps, &sets).total(1.0, Shaping::default()));
        assert_eq!(weights, [1.0, 0.5, 0.0, 0.0]);
    }
}
