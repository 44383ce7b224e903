//! The lesson, a stage of the curriculum: what training changes about the task and adds to its reward at a given step of a run.

use super::reward::{Description, ramped, training_reward, training_weights};
use super::{Step, TaskReward, TrainingReward};
use crate::config::{Config, EnvConfig};

/// The task as trained at a given step: when a goal is reached, how long goals stay, and what is rewarded.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lesson {
    /// The weight of the new target in the smoothed one.
    pub act_moving_average: f64,
    /// The largest angular acceleration of the object towards its goal for each rad of error, 1/s².
    pub assist: f64,
    /// Rotation error that counts as being at the goal, rad.
    pub tolerance: f64,
    /// Steps within the tolerance that reach a goal.
    pub hold: u32,
    /// Probability that the goal is replaced after a step in which it was not reached.
    pub redirect_chance: f64,
    /// If set, a reached goal is cut off and bootstrapped like a time limit ([`crate::env::End::Redirected`]). Otherwise values
    /// would depend on the hold counter, which the policy does not see. In the task itself the next goal follows immediately.
    pub goals_end: bool,
    /// Probability that an episode that begins is randomised, where the environment can do that.
    pub randomized: f64,
    /// Weight of the task's own reward.
    pub task_reward: f64,
    /// The weights of the terms that training adds to the reward.
    weights: TrainingReward,
}

impl Lesson {
    /// The lesson that is the task itself, as played and scored.
    pub fn task(env: &EnvConfig) -> Self {
        Self {
            act_moving_average: env.act_moving_average.at(0),
            tolerance: env.success_tolerance,
            hold: env.max_consecutive_successes,
            task_reward: 1.0,
            ..Self::default()
        }
    }

    /// The lesson after `env_steps` control steps of the whole run.
    pub fn at(env_steps: u64, config: &Config) -> Self {
        let training = &config.training;
        Self {
            act_moving_average: config.env.act_moving_average.at(env_steps),
            assist: training.assist.at(env_steps),
            tolerance: training.tolerance.at(env_steps),
            hold: training.hold.at(env_steps).round() as u32,
            redirect_chance: if training.goal_lifetime == 0 {
                0.0
            } else {
                1.0 / training.goal_lifetime as f64
            },
            goals_end: true,
            randomized: config.randomization.share.at(env_steps),
            task_reward: training.task_reward.at(env_steps),
            weights: training_weights(training, env_steps),
        }
    }

    /// The values that change during training, with their descriptions.
    pub fn described(&self) -> Vec<(Description, f64)> {
        let mut all = vec![
            (
                Description(
                    "tolerance",
                    "The rotation error, rad, up to which a goal counts in training.",
                ),
                self.tolerance,
            ),
            (
                Description(
                    "hold",
                    "The steps within the tolerance that reach a goal in training.",
                ),
                f64::from(self.hold),
            ),
            (
                Description(
                    "task_reward",
                    "The weight of the task's reward in training.",
                ),
                self.task_reward,
            ),
        ];
        all.extend(ramped(&self.weights));
        all.extend([
            (Description("randomized", "Probability that a new episode is randomised."), self.randomized),
            (
                Description("act_moving_average", "The weight of the new target in the smoothed one."),
                self.act_moving_average,
            ),
            (
                Description("assist", "The largest angular acceleration towards the goal for each rad of error, 1/s²."),
                self.assist,
            ),
        ]);
        all
    }

    /// The values that change during training, by name.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        self.described()
            .into_iter()
            .map(|(about, value)| (about.0, value))
    }

    /// The reward that training adds to a step.
    pub(super) fn reward(&self, step: &Step) -> TrainingReward {
        training_reward(&self.weights, step)
    }

    /// The reward that is learnt from, given the task's reward and what training adds to it.
    pub(super) fn total(&self, task: TaskReward, added: TrainingReward) -> f64 {
        self.task_reward * task.iter().sum::<f64>() + added.iter().sum::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Override, Settings};

    fn at(env_steps: u64, sets: &[&str]) -> Lesson {
        let sets: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
        Lesson::at(env_steps, &Settings::new().sets(&sets).resolve().unwrap())
    }

    fn step(rot_dist_before: f64, rot_dist: f64, within: bool, dropped: bool) -> Step {
        Step {
            rot_dist_before,
            rot_dist,
            within,
            dropped,
            ..Step::default()
        }
    }

    #[test]
    fn the_task_itself_pays_its_own_reward_alone() {
        let task = Lesson::task(&Config::default().env);
        assert_eq!(
            task.total(
                [1.25, 0.0, 0.0, 0.0, 0.0],
                task.reward(&step(3.0, 0.0, true, true))
            ),
            1.25
        );
        assert_eq!(
            (task.tolerance, task.hold, task.goals_end),
            (0.1, 50, false)
        );
    }

    #[test]
    fn tolerance_and_hold_follow_their_ramps() {
        let sets = [
            "training.tolerance={from=0.4,to=0.1,steps=1000}",
            "training.hold={from=1,to=50,steps=2000}",
        ];
        let found = [0, 500, 1000, 2000, 9000].map(|steps| at(steps, &sets));
        let tolerances = found.map(|lesson| (lesson.tolerance * 1e6).round() / 1e6);
        assert_eq!(tolerances, [0.4, 0.2, 0.1, 0.1, 0.1]);
        assert_eq!(found.map(|lesson| lesson.hold), [1, 13, 26, 50, 50]);
    }

    #[test]
    fn what_training_asks_does_not_follow_the_task() {
        let sets = [
            "env.success_tolerance=0.3",
            "env.max_consecutive_successes=7",
        ];
        assert_eq!(at(1 << 40, &sets), at(1 << 40, &[]));
    }

    #[test]
    fn training_pays_for_progress_holding_and_drops_besides_the_weighted_task() {
        let sets = [
            "training.progress_reward=10",
            "training.approach_reward=0",
            "training.hold_reward=2",
        ];
        let sets = [&sets[..], &["training.task_reward=0.5"]].concat();
        let lesson = at(0, &[&sets[..], &["training.drop_reward=-3"]].concat());
        let reward = lesson.reward(&step(0.0, 0.25, true, false));
        assert_eq!(reward, [-2.5, 0.0, 2.0, 0.0]);
        assert_eq!(lesson.total([4.0, 0.0, 0.0, 0.0, 0.0], reward), 1.5);
        assert_eq!(
            lesson.reward(&step(0.25, 0.0, false, true)),
            [2.5, 0.0, 0.0, -3.0]
        );
        let sets = ["training.drop_reward={from=1,to=-3,steps=100}"];
        let drops =
            [0, 50, 100, 500].map(|steps| at(steps, &sets).reward(&step(0.0, 0.0, false, true))[3]);
        assert_eq!(drops, [1.0, -1.0, -3.0, -3.0]);
        let sets = ["training.task_reward={from=1,to=0,steps=100}"];
        let weights = [0, 50, 100, 500].map(|steps| {
            at(steps, &sets).total([1.0, 0.0, 0.0, 0.0, 0.0], TrainingReward::default())
        });
        assert_eq!(weights, [1.0, 0.5, 0.0, 0.0]);
    }

    #[test]
    fn the_same_turn_is_paid_more_near_the_goal_and_back_and_forth_earns_nothing() {
        let lesson = at(0, &["training.approach_reward=20"]);
        let paid = |before, after| lesson.reward(&step(before, after, false, false))[1];
        let factor_e = std::f64::consts::E * (0.3 + 0.1) - 0.1;
        assert!(
            (paid(factor_e, 0.3) - 20.0).abs() < 1e-9,
            "{}",
            paid(factor_e, 0.3)
        );
        assert!(paid(0.4, 0.2) > 5.0 * paid(2.4, 2.2));
        assert!((paid(1.0, 0.3) + paid(0.3, 2.0) + paid(2.0, 1.0)).abs() < 1e-9);
    }
}
