//! The lesson: what training changes about the task and adds to its reward at a given step of a run.

use std::ops::AddAssign;

use crate::config::{Config, EnvConfig};

/// Rotation error, rad, below which coming nearer is hardly paid more than in proportion.
const NEAR: f64 = 0.1;

/// The task as trained at a given step: when a goal is reached, how long goals stay, and what is rewarded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lesson {
    /// Rotation error that counts as being at the goal, rad.
    pub tolerance: f64,
    /// Steps within the tolerance that reach a goal.
    pub hold: u32,
    /// Probability that the goal is replaced after a step in which it was not reached.
    pub redirect_chance: f64,
    /// Whether reaching a goal ends it with [`crate::env::End::Redirected`], so that its value is the same as if it stayed. No value
    /// then depends on the hold so far, which is not observed. In the task itself the next goal follows immediately.
    pub goals_end: bool,
    /// Probability that an episode that begins is randomised, where the environment can do that.
    pub randomized: f64,
    /// Weight of the task's own reward.
    pub task_reward: f64,
    /// Reward per rad by which the rotation error shrinks; negative where the error grows.
    progress_reward: f64,
    /// Reward for each factor e by which the rotation error plus [`NEAR`] shrinks; negative where it grows.
    approach_reward: f64,
    /// Reward for every step within the tolerance.
    hold_reward: f64,
    /// Reward for the step in which the cube is dropped.
    pub drop_reward: f64,
}

/// The rewards that training adds to the task's own.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shaping {
    /// The reward for turning towards the goal.
    pub progress: f64,
    /// The reward for coming nearer to it by a factor.
    pub approach: f64,
    /// The reward for being within the tolerance.
    pub within: f64,
    /// The reward for dropping the cube.
    pub drop: f64,
}

impl Lesson {
    /// Returns the lesson that is the task itself, as played and scored.
    pub fn task(env: &EnvConfig) -> Self {
        Self {
            tolerance: env.success_tolerance,
            hold: env.max_consecutive_successes,
            redirect_chance: 0.0,
            goals_end: false,
            randomized: 0.0,
            task_reward: 1.0,
            progress_reward: 0.0,
            approach_reward: 0.0,
            hold_reward: 0.0,
            drop_reward: 0.0,
        }
    }

    /// Returns the lesson after `env_steps` control steps of the whole run.
    pub fn at(env_steps: u64, config: &Config) -> Self {
        let training = &config.training;
        Self {
            // By equal factors: halving the error is equally hard at any size.
            tolerance: training.tolerance.by_equal_factors(env_steps),
            hold: training.hold.by_equal_steps(env_steps).round() as u32,
            redirect_chance: if training.goal_lifetime == 0 { 0.0 } else { 1.0 / training.goal_lifetime as f64 },
            goals_end: true,
            randomized: config.randomization.share.by_equal_steps(env_steps),
            task_reward: training.task_reward.by_equal_steps(env_steps),
            progress_reward: training.progress_reward,
            approach_reward: training.approach_reward,
            hold_reward: training.hold_reward,
            drop_reward: training.drop_reward.by_equal_steps(env_steps),
        }
    }

    /// Returns the values that change during training, by name.
    pub fn named(&self) -> [(&'static str, f64); 5] {
        let Self { tolerance, hold, task_reward, drop_reward, randomized, .. } = *self;
        let rewards = [("task_reward", task_reward), ("drop_reward", drop_reward)];
        [("tolerance", tolerance), ("hold", f64::from(hold)), rewards[0], rewards[1], ("randomized", randomized)]
    }

    /// Returns the shaping of a step that changed the rotation error from `before` to `after`, rad. What is paid for turning and
    /// approaching is a difference of potentials, so no way of going back and forth earns anything (Ng, Harada and Russell,
    /// "Policy invariance under reward transformations", 1999).
    pub(super) fn shaping(&self, before: f64, after: f64, within: bool, dropped: bool) -> Shaping {
        Shaping {
            progress: self.progress_reward * (before - after),
            approach: self.approach_reward * ((before + NEAR) / (after + NEAR)).ln(),
            within: if within { self.hold_reward } else { 0.0 },
            drop: if dropped { self.drop_reward } else { 0.0 },
        }
    }

    /// Returns the training reward of a step with the task reward `task`.
    pub(super) fn total(&self, task: f64, shaping: Shaping) -> f64 {
        self.task_reward * task + shaping.named().iter().map(|(_, paid)| paid).sum::<f64>()
    }
}

impl Shaping {
    /// Returns the terms by name.
    pub fn named(&self) -> [(&'static str, f64); 4] {
        let Self { progress, approach, within, drop } = *self;
        [("progress", progress), ("approach", approach), ("within", within), ("drop", drop)]
    }
}

impl AddAssign for Shaping {
    fn add_assign(&mut self, other: Self) {
        self.progress += other.progress;
        self.approach += other.approach;
        self.within += other.within;
        self.drop += other.drop;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Override};

    fn at(env_steps: u64, sets: &[&str]) -> Lesson {
        let sets: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
        Lesson::at(env_steps, &Config::resolve(None, &sets).unwrap())
    }

    #[test]
    fn the_task_itself_pays_its_own_reward_alone() {
        let task = Lesson::task(&Config::resolve(None, &[]).unwrap().env);
        assert_eq!(task.total(1.25, task.shaping(3.0, 0.0, true, true)), 1.25);
        assert_eq!((task.tolerance, task.hold, task.goals_end), (0.1, 50, false));
    }

    #[test]
    fn tolerance_and_hold_follow_their_ramps() {
        let sets = ["training.tolerance={from=0.4,to=0.1,steps=1000}", "training.hold={from=1,to=50,steps=2000}"];
        let found = [0, 500, 1000, 2000, 9000].map(|steps| at(steps, &sets));
        let tolerances = found.map(|lesson| (lesson.tolerance * 1e6).round() / 1e6);
        assert_eq!(tolerances, [0.4, 0.2, 0.1, 0.1, 0.1]);
        assert_eq!(found.map(|lesson| lesson.hold), [1, 13, 26, 50, 50]);
    }

    #[test]
    fn what_training_asks_does_not_follow_the_task() {
        let sets = ["env.success_tolerance=0.3", "env.max_consecutive_successes=7"];
        assert_eq!(at(1 << 40, &sets), at(1 << 40, &[]));
    }

    #[test]
    fn training_pays_for_progress_holding_and_drops_besides_the_weighted_task() {
        let sets = ["training.progress_reward=10", "training.approach_reward=0", "training.hold_reward=2"];
        let sets = [&sets[..], &["training.task_reward=0.5"]].concat();
        let lesson = at(0, &[&sets[..], &["training.drop_reward=-3"]].concat());
        let shaping = lesson.shaping(0.0, 0.25, true, false);
        assert_eq!(shaping, Shaping { progress: -2.5, approach: 0.0, within: 2.0, drop: 0.0 });
        assert_eq!(lesson.total(4.0, shaping), 1.5);
        let dropped = Shaping { progress: 2.5, approach: 0.0, within: 0.0, drop: -3.0 };
        assert_eq!(lesson.shaping(0.25, 0.0, false, true), dropped);
        let sets = ["training.drop_reward={from=1,to=-3,steps=100}"];
        let drops = [0, 50, 100, 500].map(|steps| at(steps, &sets).shaping(0.0, 0.0, false, true).drop);
        assert_eq!(drops, [1.0, -1.0, -3.0, -3.0]);
        let sets = ["training.task_reward={from=1,to=0,steps=100}"];
        let weights = [0, 50, 100, 500].map(|steps| at(steps, &sets).total(1.0, Shaping::default()));
        assert_eq!(weights, [1.0, 0.5, 0.0, 0.0]);
    }

    #[test]
    fn the_same_turn_is_paid_more_near_the_goal_and_back_and_forth_earns_nothing() {
        let lesson = at(0, &["training.approach_reward=20"]);
        let paid = |before, after| lesson.shaping(before, after, false, false).approach;
        let factor_e = std::f64::consts::E * (0.3 + NEAR) - NEAR;
        assert!((paid(factor_e, 0.3) - 20.0).abs() < 1e-9, "{}", paid(factor_e, 0.3));
        assert!(paid(0.4, 0.2) > 5.0 * paid(2.4, 2.2));
        assert!((paid(1.0, 0.3) + paid(0.3, 2.0) + paid(2.0, 1.0)).abs() < 1e-9);
    }
}
