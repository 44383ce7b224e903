//! The rewards of a control step, as two tables: the terms of the task, which is scored, and those that only training adds.
//!
//! A term is one row. Its column in `metrics.csv`, its tag, its sums and its description follow from that row.

use super::hand::{ACTION_SIZE, JOINTS};
use super::terms::{Description, TermList, Terms};
use crate::config::{EnvConfig, Ramp, TrainingConfig};
use crate::sim::{Pose, Velocity};

/// What a reward may depend on: a step that did not diverge, after its physics. SI units and rad, in the world frame.
#[derive(Clone, Debug, Default)]
pub struct Step {
    /// Rotation error before the step, from 0 to π.
    pub rot_dist_before: f64,
    /// Rotation error after the step.
    pub rot_dist: f64,
    /// Distance of the cube from the goal position.
    pub goal_dist: f64,
    /// Whether the rotation error is within the tolerance of the lesson, which training may set apart from the task's.
    pub within: bool,
    /// Whether the cube was dropped.
    pub dropped: bool,
    /// The action, clipped to [-1, 1].
    pub action: [f32; ACTION_SIZE],
    /// The action of the step before, clipped; zeros after a reset.
    pub previous_action: [f32; ACTION_SIZE],
    /// The pose of the cube.
    pub cube: Pose,
    /// The velocity of the cube's centre.
    pub cube_velocity: Velocity,
    /// The angles of the joints, in observation order.
    pub joint_pos: [f64; JOINTS.len()],
    /// The velocities of the joints, in observation order.
    pub joint_vel: [f64; JOINTS.len()],
}

/// A term of the task's reward.
struct TaskTerm {
    about: Description,
    /// Its value in a step.
    value: fn(&EnvConfig, &Step) -> f64,
}

/// A term of the reward that training adds: its weight times its value.
struct TrainingTerm {
    about: Description,
    weight: Weight,
    /// What the weight multiplies, in a step.
    value: fn(&Step) -> f64,
}

/// The setting in `[training]` that holds the weight of a term.
enum Weight {
    Constant(fn(&TrainingConfig) -> f64),
    /// Its name and its value.
    Ramp(Description, fn(&TrainingConfig) -> Ramp),
}

/// Rotation error, rad, below which coming nearer is hardly paid more than in proportion.
const NEAR: f64 = 0.1;

const TASK: [TaskTerm; 5] = [
    TaskTerm {
        about: Description { name: "rotation", text: "The task's reward for a small rotation error." },
        value: |env, step| env.rot_reward_scale / (step.rot_dist + env.rot_eps),
    },
    TaskTerm {
        about: Description { name: "distance", text: "The task's penalty for the cube's distance from its place." },
        value: |env, step| env.dist_reward_scale * step.goal_dist,
    },
    TaskTerm {
        about: Description { name: "action", text: "The task's penalty for large actions." },
        value: |env, step| {
            env.action_penalty_scale * step.action.iter().map(|&a| f64::from(a) * f64::from(a)).sum::<f64>()
        },
    },
    TaskTerm {
        about: Description { name: "bonus", text: "The task's bonus within the tolerance." },
        value: |env, step| if step.rot_dist <= env.success_tolerance { env.reach_goal_bonus } else { 0.0 },
    },
    TaskTerm {
        about: Description { name: "fall", text: "The task's penalty for a drop." },
        value: |env, step| if step.goal_dist >= env.fall_dist { env.fall_penalty } else { 0.0 },
    },
];

// What is paid for turning and approaching is a difference of potentials, so no way of going back and forth earns anything (Ng,
// Harada and Russell, "Policy invariance under reward transformations", 1999).
const TRAINING: [TrainingTerm; 4] = [
    TrainingTerm {
        about: Description { name: "progress", text: "The training reward for turning towards the goal." },
        weight: Weight::Constant(|training| training.progress_reward),
        value: |step| step.rot_dist_before - step.rot_dist,
    },
    TrainingTerm {
        about: Description { name: "approach", text: "The training reward for coming nearer to the goal by a factor." },
        weight: Weight::Constant(|training| training.approach_reward),
        value: |step| ((step.rot_dist_before + NEAR) / (step.rot_dist + NEAR)).ln(),
    },
    TrainingTerm {
        about: Description { name: "within", text: "The training reward for being within the tolerance." },
        weight: Weight::Constant(|training| training.hold_reward),
        value: |step| f64::from(u8::from(step.within)),
    },
    TrainingTerm {
        about: Description { name: "drop", text: "The training reward for a drop, which is negative." },
        weight: Weight::Ramp(
            Description { name: "drop_reward", text: "The training reward for the step of a drop." },
            |training| training.drop_reward,
        ),
        value: |step| f64::from(u8::from(step.dropped)),
    },
];

/// The list of the task's terms.
pub struct OfTask;

/// The list of the terms that training adds.
pub struct OfTraining;

impl TermList for OfTask {
    fn descriptions() -> impl Iterator<Item = Description> {
        TASK.iter().map(|term| term.about)
    }
}

impl TermList for OfTraining {
    fn descriptions() -> impl Iterator<Item = Description> {
        TRAINING.iter().map(|term| term.about)
    }
}

/// The task's reward by term.
pub type TaskReward = Terms<OfTask, { TASK.len() }>;

/// The reward that training adds, by term; or the weights of these terms.
pub type TrainingReward = Terms<OfTraining, { TRAINING.len() }>;

/// Returns the task's reward of a step.
pub fn task_reward(env: &EnvConfig, step: &Step) -> TaskReward {
    Terms::new(TASK.each_ref().map(|term| (term.value)(env, step)))
}

/// Returns the reward that training adds to a step, given the weights of its terms.
pub(super) fn training_reward(weights: &TrainingReward, step: &Step) -> TrainingReward {
    let mut values = weights.values();
    values.iter_mut().zip(&TRAINING).for_each(|(value, term)| *value *= (term.value)(step));
    Terms::new(values)
}

/// Returns the weights of the training's terms after `env_steps` control steps of the whole run.
pub(super) fn training_weights(training: &TrainingConfig, env_steps: u64) -> TrainingReward {
    Terms::new(TRAINING.each_ref().map(|term| match &term.weight {
        Weight::Constant(weight) => weight(training),
        Weight::Ramp(_, ramp) => ramp(training).by_equal_steps(env_steps),
    }))
}

/// Returns the weights that change in the course of a training, with their descriptions.
pub(super) fn ramped(weights: &TrainingReward) -> impl Iterator<Item = (Description, f64)> {
    TRAINING.iter().zip(weights.values()).filter_map(|(term, weight)| match term.weight {
        Weight::Constant(_) => None,
        Weight::Ramp(setting, _) => Some((setting, weight)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn terms(rot_dist: f64, goal_dist: f64, action: &[f32]) -> TaskReward {
        let mut config = Config::resolve(None, &[]).unwrap().env;
        config.fall_penalty = -7.0;
        let mut step = Step { rot_dist, goal_dist, ..Step::default() };
        step.action[..action.len()].copy_from_slice(action);
        task_reward(&config, &step)
    }

    #[test]
    fn each_term_is_the_one_of_the_task() {
        // 1 / (0.4 + 0.1), -10 * 0.05, -0.0002 * (1 + 0.25)
        let reward = terms(0.4, 0.05, &[1.0, -0.5]);
        let expected = [("rotation", 2.0), ("distance", -0.5), ("action", -0.00025), ("bonus", 0.0), ("fall", 0.0)];
        for ((name, found), (expected_name, expected)) in reward.named().zip(expected) {
            assert!(name == expected_name && (found - expected).abs() < 1e-12, "{reward:?}");
        }
        assert!((reward.total() - 1.49975).abs() < 1e-12);
    }

    #[test]
    fn the_bonus_is_paid_up_to_the_tolerance_itself() {
        assert_eq!(terms(0.1, 0.0, &[])["bonus"], 2.0);
        assert_eq!(terms(0.1 + 1e-9, 0.0, &[])["bonus"], 0.0);
    }

    #[test]
    fn the_fall_penalty_is_paid_from_the_limit_on() {
        assert_eq!(terms(1.0, 0.24, &[])["fall"], -7.0);
        assert_eq!(terms(1.0, 0.24 - 1e-9, &[])["fall"], 0.0);
    }

    #[test]
    fn sums_of_terms_contain_every_term() {
        let mut sum = TrainingReward::new([1.0; TRAINING.len()]);
        sum += TrainingReward::new([2.0; TRAINING.len()]);
        assert!(sum.values().iter().all(|&value| value == 3.0) && sum.named().count() == TRAINING.len());
    }
}
