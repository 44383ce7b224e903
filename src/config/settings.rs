//! The settings as types. `configs/repose.toml` documents the meaning and the unit of each key.

#![expect(missing_docs, reason = "each key is explained in configs/repose.toml")]

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ramp::{Geometric, Ramp};
use crate::sim::{Cone, Parts};

/// The value of `env.model` for the built-in scene.
pub const BUILTIN_MODEL: &str = "builtin";

/// The whole configuration of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Config {
    /// The task and its physics.
    pub env: EnvConfig,
    /// The parts of the hand that the user names. The others are found by the structure of the scene.
    pub hand: Parts,
    /// Changes to the task and additions to its reward that only training uses.
    pub training: TrainingConfig,
    /// Random physics, noise and delays of a share of the episodes of a training run.
    pub randomization: RandomizationConfig,
    /// The learner.
    pub ppo: PpoConfig,
    /// The run: length, checkpoints, evaluations, seed, threads.
    pub run: RunConfig,
}

/// The task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnvConfig {
    pub num_envs: usize,
    pub model: String,
    pub num_hand_dofs: OfScene<usize>,
    pub num_actuators: OfScene<usize>,
    pub sim_dt: f64,
    pub ctrl_dt: f64,
    pub friction_scale: f64,
    pub cube_mass_scale: f64,
    pub hand_mass_scale: f64,
    pub cube_size_scale: f64,
    pub gains_scale: f64,
    pub damping_scale: f64,
    pub frictionloss_scale: f64,
    pub cube_com: [f64; 3],
    pub gravity: [f64; 3],
    pub cone: Cone,
    pub action_delay: u32,
    pub prediction: u32,
    pub known: ByName,
    pub noise: ByName,
    pub bias: ByName,
    pub max_episode_seconds: f64,
    pub goal_position: OfScene<[f64; 3]>,
    pub target_height: f64,
    pub act_moving_average: Ramp,
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

/// A setting that comes from the scene unless the user sets it.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(transparent)]
pub struct OfScene<T> {
    /// The value that is set or, until the scene is known, the default.
    pub value: T,
    /// Whether the value applies regardless of the scene.
    #[serde(skip)]
    pub named: bool,
}

impl<T> OfScene<T> {
    /// Takes the value of the scene, unless one is set.
    pub fn settle(&mut self, of_scene: T) {
        if !self.named {
            *self = Self {
                value: of_scene,
                named: true,
            };
        }
    }
}

impl<T: PartialEq> PartialEq for OfScene<T> {
    fn eq(&self, other: &Self) -> bool {
        self.value == other.value
    }
}

/// Values by the name of a group of the observation, or of a quantity.
pub type ByName = BTreeMap<String, f64>;

/// The effect of a step outside the tolerance on the counter of steps within it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SuccessHold {
    /// The counter stays unchanged.
    Cumulative,
    /// The counter is reset to zero.
    Consecutive,
}

/// Settings that only training uses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingConfig {
    pub task_reward: Ramp,
    pub progress_reward: f64,
    pub approach_reward: f64,
    pub hold_reward: f64,
    pub drop_reward: Ramp,
    pub assist: Ramp,
    pub tolerance: Geometric,
    pub hold: Ramp,
    pub goal_lifetime: u64,
}

/// Random physics, noise and delays of a share of the episodes of a training run. Intervals are [low, high].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RandomizationConfig {
    pub share: Ramp,
    pub each: f64,
    pub friction: [f64; 2],
    pub cube_mass: [f64; 2],
    pub hand_mass: [f64; 2],
    pub cube_size: [f64; 2],
    pub cube_com: f64,
    pub gains: [f64; 2],
    pub damping: [f64; 2],
    pub frictionloss: [f64; 2],
    pub gravity: f64,
    pub delay: [u32; 2],
    pub noise: ByName,
    pub bias: ByName,
    pub push: f64,
    pub push_steps: u32,
}

/// The learner.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PpoConfig {
    pub critic_first: u64,
    pub horizon: Ramp,
    pub epochs: usize,
    pub minibatches: usize,
    pub hidden: Vec<usize>,
    pub activation: Activation,
    pub symmetry: Symmetry,
    pub backend: Backend,
    pub precision: Precision,
    pub learning_rate: f64,
    pub learning_rate_range: [f64; 2],
    pub desired_kl: Geometric,
    pub gamma: f64,
    pub lambda: f64,
    pub clip: f64,
    pub value_clip: f64,
    pub value_coef: f64,
    pub bounds_coef: f64,
    pub max_grad_norm: f64,
    pub reward_scale: f64,
    pub std: Geometric,
    pub away_std: Ramp,
    pub away_range: [f64; 2],
}

/// The activation function after each hidden layer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    Elu,
    Relu,
    Tanh,
}

/// The states that a policy treats as the same.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Symmetry {
    /// None.
    None,
    /// A cube and the same cube turned onto itself, whatever the object is.
    Cube,
    /// The object and the same object turned onto itself, by any of a cube's rotations that does so.
    Object,
}

/// The implementation that computes the gradients.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Our own kernels.
    Fused,
    /// candle's tensors and automatic differentiation: slower, the reference for the kernels.
    Candle,
}

/// The number format of the matrix products in the nets while learning and collecting. Everything else is `f32`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// `f32`.
    F32,
    /// bf16 with sums in `f32`, on the tiles or dot products of processors that have them.
    Bf16,
    /// The rounding of bf16 without its speed, on any processor.
    Bf16Rounded,
}

/// The run: length, checkpoints, evaluations, seed, threads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunConfig {
    pub total_steps: u64,
    pub checkpoint_every: u64,
    pub eval_every: u64,
    pub eval_episodes: usize,
    pub patience: u32,
    pub seed: u64,
    pub shards: usize,
    pub threads: usize,
}

impl Config {
    /// The number of control steps in the first iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        self.env.num_envs.saturating_mul(self.ppo.first_horizon()) as u64
    }

    /// The number of samples in a minibatch.
    pub fn samples_per_minibatch(&self) -> usize {
        self.ppo.minibatch_of(
            self.steps_per_iteration() as usize,
            self.ppo.first_horizon(),
        )
    }

    /// The number of shards: the configured one or, if that is 0, the largest that fits, up to 16.
    pub fn shards(&self) -> usize {
        if self.run.shards > 0 {
            return self.run.shards;
        }
        let fitting = [16, 8, 4, 2]
            .into_iter()
            .find(|&shards| self.divides(shards));
        fitting.unwrap_or(1)
    }

    /// Whether environments and minibatches can be divided evenly into `shards`.
    pub(super) fn divides(&self, shards: usize) -> bool {
        self.env.num_envs.is_multiple_of(shards)
            && self.samples_per_minibatch().is_multiple_of(shards)
    }
}

impl PpoConfig {
    /// The number of control steps of each environment in the first iteration.
    pub fn first_horizon(&self) -> usize {
        self.horizon.from.max(1.0) as usize
    }

    /// The control steps of each environment in an iteration that begins after `env_steps` control steps of the run. This
    /// is the largest multiple of the first horizon that the ramp has reached.
    pub fn horizon_at(&self, env_steps: u64) -> usize {
        let first = self.first_horizon();
        (self.horizon.at(env_steps) / first as f64 + 1e-9) as usize * first
    }

    /// The number of samples in a minibatch of a rollout with this many samples and this horizon. It is the same for all
    /// horizons of a run.
    pub fn minibatch_of(&self, samples: usize, horizon: usize) -> usize {
        samples / (horizon / self.first_horizon()) / self.minibatches
    }

    /// How far a value may move from its value at collection time, or infinity if `value_clip` is 0.
    pub fn value_clip(&self) -> f64 {
        if self.value_clip == 0.0 {
            f64::INFINITY
        } else {
            self.value_clip
        }
    }
}

impl RandomizationConfig {
    /// Whether a training run has randomised episodes, at its beginning or later.
    pub fn happens(&self) -> bool {
        self.share.from > 0.0 || self.share.to > 0.0
    }
}

impl EnvConfig {
    /// The task after `env_steps` control steps of a run: actions are smoothed as much as training has come to smooth them.
    pub fn at(&self, env_steps: u64) -> Self {
        Self {
            act_moving_average: Ramp::constant(self.act_moving_average.at(env_steps)),
            ..self.clone()
        }
    }

    /// The number of physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.ctrl_dt / self.sim_dt).round() as usize
    }

    /// Whether a control step takes a whole number of physics steps of `sim_dt` seconds, at most 10 000.
    pub fn is_multiple_of(&self, sim_dt: f64) -> bool {
        let ratio = self.ctrl_dt / sim_dt;
        let whole = ratio.round();
        (1.0..=1e4).contains(&whole) && (ratio / whole - 1.0).abs() < 1e-6
    }

    /// The number of control steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> u32 {
        (self.max_episode_seconds / self.ctrl_dt).round() as u32
    }

    /// The path of the user's own scene, or `None` for the built-in one.
    pub fn model_file(&self) -> Option<&Path> {
        (self.model != BUILTIN_MODEL).then(|| Path::new(&self.model))
    }
}
