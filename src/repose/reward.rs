//! The rewards of a control step, as two tables: the terms of the task, which is scored, and the terms that only training adds.
//!
//! A term is one row. Its column in `metrics.csv`, its tag, its sums and its description follow from that row.

use crate::config::{EnvConfig, TrainingConfig};
use crate::quat::Quat;

/// A control step after its physics: what its rewards may depend on, and what they are. SI units and rad, in the world frame.
#[derive(Clone, Default)]
pub struct Step {
    /// The goal during the step.
    pub goal: Quat,
    /// Rotation error before the step, from 0 to π.
    pub rot_dist_before: f64,
    /// Rotation error after the step.
    pub rot_dist: f64,
    /// Distance of the object from the goal position.
    pub goal_dist: f64,
    /// Whether the rotation error is within the tolerance of the lesson, which may differ from the task's in training.
    pub within: bool,
    /// Whether the object was dropped.
    pub dropped: bool,
    /// The action, clipped to [-1, 1].
    pub action: Vec<f32>,
    /// The random force on the object, if there are such forces in the episode.
    pub push: Option<[f64; 3]>,
    /// Whether the physics diverged. Then nothing above but the goal and the actions has a meaning, and there is no reward.
    pub diverged: bool,
    /// The reward by term.
    pub reward: TaskReward,
    /// What training adds to it, by term.
    pub training: TrainingReward,
}

/// The description of a quantity for a reader: its name in columns, tags and JSON, and what it is, in a sentence.
#[derive(Clone, Copy)]
pub struct Description(pub &'static str, pub &'static str);

/// A term of the task's reward, and its value in a step.
struct TaskTerm(Description, fn(&EnvConfig, &Step) -> f64);

/// A term of the reward that training adds: its weight times its value in a step. The weight after a number of control steps of the
/// whole run follows from `[training]`. It is logged under its own description if it changes.
struct TrainingTerm(
    Description,
    Option<Description>,
    fn(&TrainingConfig, u64) -> f64,
    fn(&Step) -> f64,
);

/// Rotation error, rad, below which coming nearer is rewarded hardly more than in proportion.
const NEAR: f64 = 0.1;

#[rustfmt::skip]
const TASK: [TaskTerm; 5] = [
    TaskTerm(Description("rotation", "The task's reward for a small rotation error."),
        |env, step| env.rot_reward_scale / (step.rot_dist + env.rot_eps)),
    TaskTerm(Description("distance", "The task's penalty for the cube's distance from its place."),
        |env, step| env.dist_reward_scale * step.goal_dist),
    TaskTerm(Description("action", "The task's penalty for large actions."),
        |env, step| env.action_penalty_scale * step.action.iter().map(|&a| f64::from(a) * f64::from(a)).sum::<f64>()),
    TaskTerm(Description("bonus", "The task's bonus within the tolerance."),
        |env, step| if step.rot_dist <= env.success_tolerance { env.reach_goal_bonus } else { 0.0 }),
    TaskTerm(Description("fall", "The task's penalty for a drop."),
        |env, step| if step.goal_dist >= env.fall_dist { env.fall_penalty } else { 0.0 }),
];

// The rewards for turning and approaching are differences of potentials, so going back and forth earns nothing (Ng, Harada and
// Russell, "Policy invariance under reward transformations", 1999).
#[rustfmt::skip]
const TRAINING: [TrainingTerm; 4] = [
    TrainingTerm(Description("progress", "The training reward for turning towards the goal."),
        None, |training, _| training.progress_reward,
        |step| step.rot_dist_before - step.rot_dist),
    TrainingTerm(Description("approach", "The training reward for coming nearer to the goal by a factor."),
        None, |training, _| training.approach_reward,
        |step| ((step.rot_dist_before + NEAR) / (step.rot_dist + NEAR)).ln()),
    TrainingTerm(Description("within", "The training reward for being within the tolerance."),
        None, |training, _| training.hold_reward,
        |step| f64::from(step.within)),
    TrainingTerm(Description("drop", "The training reward for a drop, which is negative."),
        Some(Description("drop_reward", "The training reward for the step of a drop.")),
        |training, steps| training.drop_reward.at(steps),
        |step| f64::from(step.dropped)),
];

/// The task's reward by term, in the order of [`task_terms`].
pub type TaskReward = [f64; TASK.len()];

/// The reward that training adds, by term, or the weights of these terms, in the order of [`training_terms`].
pub type TrainingReward = [f64; TRAINING.len()];

/// The terms of the task's reward.
pub fn task_terms() -> [Description; TASK.len()] {
    TASK.each_ref().map(|term| term.0)
}

/// The terms of the reward that training adds.
pub fn training_terms() -> [Description; TRAINING.len()] {
    TRAINING.each_ref().map(|term| term.0)
}

/// The values of these terms by name.
pub fn named<const N: usize>(
    terms: [Description; N],
    values: [f64; N],
) -> impl Iterator<Item = (&'static str, f64)> {
    terms.into_iter().map(|term| term.0).zip(values)
}

/// Adds rewards to a sum of rewards, term by term.
pub fn add<const N: usize>(sum: &mut [f64; N], more: [f64; N]) {
    sum.iter_mut()
        .zip(more)
        .for_each(|(sum, value)| *sum += value);
}

/// The task's reward of a step.
pub fn task_reward(env: &EnvConfig, step: &Step) -> TaskReward {
    TASK.each_ref().map(|TaskTerm(_, value)| value(env, step))
}

/// The reward that training adds to a step, given the weights of its terms.
pub fn training_reward(weights: &TrainingReward, step: &Step) -> TrainingReward {
    std::array::from_fn(|i| weights[i] * (TRAINING[i].3)(step))
}

/// The weights of the terms that training adds, after `env_steps` control steps of the whole run.
pub fn training_weights(training: &TrainingConfig, env_steps: u64) -> TrainingReward {
    TRAINING
        .each_ref()
        .map(|term| (term.2)(training, env_steps))
}

/// The weights that change in the course of a training run, with their descriptions.
pub fn ramped(weights: &TrainingReward) -> impl Iterator<Item = (Description, f64)> {
    TRAINING
        .iter()
        .zip(*weights)
        .filter_map(|(term, value)| Some((term.1?, value)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn terms(rot_dist: f64, goal_dist: f64, action: &[f32]) -> TaskReward {
        let mut config = Config::default().env;
        config.fall_penalty = -7.0;
        task_reward(
            &config,
            &Step {
                rot_dist,
                goal_dist,
                action: action.to_vec(),
                ..Step::default()
            },
        )
    }

    #[test]
    fn each_term_is_the_one_of_the_task() {
        // 1 / (0.4 + 0.1), -10 * 0.05, -0.0002 * (1 + 0.25)
        let reward = terms(0.4, 0.05, &[1.0, -0.5]);
        let expected = [
            ("rotation", 2.0),
            ("distance", -0.5),
            ("action", -0.00025),
            ("bonus", 0.0),
            ("fall", 0.0),
        ];
        for ((name, found), (expected_name, expected)) in named(task_terms(), reward).zip(expected)
        {
            assert!(
                name == expected_name && (found - expected).abs() < 1e-12,
                "{reward:?}"
            );
        }
        assert!((reward.iter().sum::<f64>() - 1.49975).abs() < 1e-12);
    }

    #[test]
    fn the_bonus_is_paid_up_to_the_tolerance_itself() {
        assert_eq!(terms(0.1, 0.0, &[])[3], 2.0);
        assert_eq!(terms(0.1 + 1e-9, 0.0, &[])[3], 0.0);
    }

    #[test]
    fn the_fall_penalty_is_paid_from_the_limit_on() {
        assert_eq!(terms(1.0, 0.24, &[])[4], -7.0);
        assert_eq!(terms(1.0, 0.24 - 1e-9, &[])[4], 0.0);
    }

    #[test]
    fn sums_of_terms_contain_every_term() {
        let mut sum = [1.0; TRAINING.len()];
        add(&mut sum, [2.0; TRAINING.len()]);
        assert_eq!(sum, [3.0; TRAINING.len()]);
    }
}
