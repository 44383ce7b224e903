//! The settings as types; `configs/repose.toml` says what each key means and in which unit.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ramp::Ramp;

/// `env.model` of the scene that is built into the program.
pub const BUILTIN_MODEL: &str = "builtin";

/// The whole configuration of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The task and its physics.
    pub env: EnvConfig,
    /// What training changes of the task and adds to its reward.
    pub training: TrainingConfig,
    /// The learner.
    pub ppo: PpoConfig,
    /// The course of a training.
    pub run: RunConfig,
}

/// The task.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvConfig {
    pub num_envs: usize,
    pub model: String,
    pub num_hand_dofs: usize,
    pub num_actuators: usize,
    pub sim_dt: f64,
    pub ctrl_dt: f64,
    pub friction_scale: f64,
    pub cube_mass_scale: f64,
    pub max_episode_seconds: f64,
    pub goal_position: [f64; 3],
    pub target_height: f64,
    pub act_moving_average: f64,
    pub rot_reward_scale: f64,
    pub rot_eps: f64,
    pub dist_reward_scale: f64,
    pub action_penalty_scale: f64,
    pub reach_goal_bonus: f64,
    pub success_tolerance: f64,
    pub max_consecutive_successes: u32,
    pub success_hold: SuccessHold,
    pub fall_dist: f64,
    pub fall_penalty: f64,
    pub reset_position_noise: f64,
    pub reset_dof_pos_noise: f64,
    pub reset_dof_vel_noise: f64,
    pub vel_obs_scale: f64,
}

/// What a step outside the tolerance does to the counter of steps within it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SuccessHold {
    /// It leaves the counter alone.
    Cumulative,
    /// It sets the counter to zero.
    Consecutive,
}

/// What only training sees.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    pub task_reward: Ramp,
    pub progress_reward: f64,
    pub hold_reward: f64,
    pub drop_reward: Ramp,
    pub tolerance: Ramp,
    pub hold: Ramp,
    pub goal_lifetime: u64,
}

/// The learner.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PpoConfig {
    pub horizon: usize,
    pub epochs: usize,
    pub minibatches: usize,
    pub hidden: Vec<usize>,
    pub activation: Activation,
    pub symmetry: Symmetry,
    pub backend: Backend,
    pub precision: Precision,
    pub learning_rate: f64,
    pub learning_rate_range: [f64; 2],
    pub desired_kl: f64,
    pub gamma: f64,
    pub lambda: f64,
    pub clip: f64,
    pub value_clip: f64,
    pub value_coef: f64,
    pub bounds_coef: f64,
    pub max_grad_norm: f64,
    pub reward_scale: f64,
    pub max_std: Ramp,
    pub min_std: Ramp,
    pub away_std: f64,
    pub away_range: [f64; 2],
}

/// The function after each hidden layer.
#[allow(missing_docs)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    Elu,
    Relu,
    Tanh,
}

/// What a policy takes to be the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Symmetry {
    /// Nothing.
    None,
    /// A cube and the same cube turned onto itself.
    Cube,
}

/// What computes the gradients.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Our own kernels.
    Fused,
    /// candle's tensors and automatic gradients: slower, the reference for the other.
    Candle,
}

/// The numbers that are multiplied in the nets while learning and collecting; all else is in floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Floats.
    F32,
    /// bf16, with sums in floats, on the tiles of processors that have them.
    Bf16,
    /// The rounding of bf16 without its speed, on any processor.
    Bf16Rounded,
}

/// The course of a training.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    pub total_steps: u64,
    pub checkpoint_every: u64,
    pub eval_every: u64,
    pub eval_episodes: usize,
    pub seed: u64,
    pub shards: usize,
    pub threads: usize,
}

/// What of the settings of a learner its policy keeps for life.
#[derive(Clone, Debug, PartialEq)]
pub struct NetConfig {
    /// Sizes of the hidden layers, of the actor and of the critic alike.
    pub hidden: Vec<usize>,
    /// The function after each of them.
    pub activation: Activation,
    /// What it takes to be the same.
    pub symmetry: Symmetry,
}

impl Config {
    /// Control steps in one iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.env.num_envs * self.ppo.horizon) as u64
    }

    /// Samples of a minibatch.
    pub fn samples_per_minibatch(&self) -> usize {
        self.env.num_envs * self.ppo.horizon / self.ppo.minibatches
    }

    /// The shards of the training: those that are asked for, or else the most that fit, up to 16.
    pub fn shards(&self) -> usize {
        let found = [16, 8, 4, 2].into_iter().find(|&shards| self.divides(shards)).unwrap_or(1);
        if self.run.shards == 0 { found } else { self.run.shards }
    }

    /// Whether environments and minibatches can be dealt to so many shards.
    pub(super) fn divides(&self, shards: usize) -> bool {
        self.env.num_envs.is_multiple_of(shards) && self.samples_per_minibatch().is_multiple_of(shards)
    }
}

impl PpoConfig {
    /// The policy that is trained.
    pub fn net(&self) -> NetConfig {
        NetConfig { hidden: self.hidden.clone(), activation: self.activation, symmetry: self.symmetry }
    }

    /// How far a value may move from the one that was there when the rollout was collected.
    pub fn value_clip(&self) -> f64 {
        if self.value_clip == 0.0 { f64::INFINITY } else { self.value_clip }
    }

    /// The least and the largest standard deviation of the actions after `env_steps` control steps of the whole run.
    pub fn std_bounds(&self, env_steps: u64) -> [f64; 2] {
        [self.min_std.by_equal_steps(env_steps), self.max_std.by_equal_factors(env_steps)]
    }
}

impl EnvConfig {
    /// Physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.ctrl_dt / self.sim_dt).round() as usize
    }

    /// Control steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> u32 {
        (self.max_episode_seconds / self.ctrl_dt).round() as u32
    }

    /// The user's own scene, or `None` for the built-in one.
    pub fn model_file(&self) -> Option<&Path> {
        (self.model != BUILTIN_MODEL).then(|| Path::new(&self.model))
    }
}
