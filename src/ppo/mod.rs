//! Proximal policy optimisation (PPO) of a Gaussian policy.
//!
//! Inputs and outputs are host slices. All weights are in one array (see `parameters`). Nothing here depends on an
//! environment or a file. Notation in comments: a rollout has T steps of N environments, so B = T × N samples. A
//! minibatch has M samples. An observation has O values, and an action has A.

mod acting;
mod adam;
mod backend;
mod candle;
mod checkpoint;
mod format;
mod fused;
mod gae;
mod kernels;
mod learning_rate;
mod loss;
mod measure;
mod normalizer;
mod parameters;
mod perception;
mod policy;
mod progress;
mod rollout;
mod update;

use anyhow::Result;

pub use acting::Acting;
pub use backend::Losses;
pub use checkpoint::Checkpoint;
pub use format::{Array, Damaged, sealed};
pub use kernels::Workspace;
pub use measure::{flops_per_sample, matmul_gflops, time_gradient_steps};
pub use normalizer::Normalizer;
pub use parameters::{Layer, ParameterLayout, View};
pub use perception::Perception;
pub use policy::{FrozenPolicy, GROUP, Policy};
pub use progress::{Fork, Progress, Rise, beats};
pub use rollout::{Rollout, RolloutBlock};
pub use update::UpdateStats;

use crate::config::{Backend, PpoConfig};
use crate::ranks::{Exchange, Slices};
use crate::rng::{self, Rng};
use crate::spaces::Spaces;
use adam::{Adam, norm_chunks};
use backend::GradientBackend;
use candle::Reference;
use fused::Fused;
use kernels::Arithmetic;

/// A learner: the policy and everything that trains it.
pub struct Ppo {
    config: PpoConfig,
    seed: u64,
    /// The current policy.
    pub policy: Policy,
    backend: Box<dyn GradientBackend>,
    arithmetic: Arithmetic,
    /// The gradient of all parameters for the last minibatch.
    gradient: Vec<f32>,
    /// The same of each group of this rank.
    of_groups: Vec<Vec<f32>>,
    adam: Adam,
    /// The learning rate of the next step.
    learning_rate: f64,
    /// The control steps of the run, which the ramps of the settings follow.
    env_steps: u64,
    /// The iteration in which the actor begins to learn.
    actor_from: u64,
    exchange: Exchange,
    /// The parameters that this rank moves.
    slices: Slices,
}

impl Ppo {
    /// Creates a learner for environments with these spaces. It learns from the samples that `exchange` assigns to this
    /// rank, and adds up results with the other ranks. All its randomness is derived from `seed`.
    ///
    /// # Errors
    /// Fails if this machine does not support the configured precision.
    pub fn new(config: &PpoConfig, spaces: Spaces, seed: u64, exchange: Exchange) -> Result<Self> {
        let policy = Policy::random(config, spaces, seed);
        let arithmetic = Arithmetic::new(config.precision)?;
        let count = policy.layout.count();
        Ok(Self {
            slices: exchange.slices(norm_chunks(&policy.layout.nets())),
            config: config.clone(),
            seed,
            policy,
            backend: match config.backend {
                Backend::Fused => Box::new(Fused::new(arithmetic)),
                Backend::Candle => Box::new(Reference),
            },
            arithmetic,
            gradient: vec![0.0; count],
            of_groups: Vec::new(),
            adam: Adam::new(count),
            learning_rate: config.learning_rate,
            env_steps: 0,
            actor_from: config.critic_first + 1,
            exchange,
        })
    }

    /// A checksum (CRC-32) of all parameters.
    pub fn checksum(&self) -> u32 {
        let mut hasher = crc32fast::Hasher::new();
        self.policy
            .parameters
            .iter()
            .for_each(|x| hasher.update(&x.to_le_bytes()));
        hasher.finalize()
    }

    /// Creates a rollout of the first horizon for blocks with these numbers of environments.
    pub fn rollout(&self, block_sizes: &[usize]) -> Rollout {
        Rollout::new(
            self.config.first_horizon(),
            block_sizes,
            &self.policy.spaces,
        )
    }

    /// Sets the standard deviations of the actions, the desired KL divergence and the horizon of the rollout. All follow
    /// their ramps after `env_steps` control steps of the run.
    pub fn follow_ramps(&mut self, env_steps: u64, rollout: &mut Rollout) {
        let horizon = self.config.horizon_at(env_steps);
        if horizon != rollout.horizon {
            rollout.resize(horizon, &self.policy.spaces);
        }
        self.env_steps = env_steps;
        self.policy
            .log_std
            .fill(self.config.std.at(env_steps).ln() as f32);
    }

    /// Begins a fork of another run after this iteration.
    pub fn begin_after(&mut self, iteration: u64) {
        self.actor_from = iteration
            .saturating_add(self.config.critic_first)
            .saturating_add(1);
    }

    /// Whether only the critic learns in this iteration.
    pub fn is_critic_alone(&self, iteration: u64) -> bool {
        iteration < self.actor_from
    }

    /// A reusable workspace for acting in blocks of up to `rows` environments.
    pub fn workspace(&self, rows: usize) -> Workspace {
        Workspace::new(&self.policy.layout.actor, rows, self.arithmetic)
    }

    /// The policy of this iteration, for collecting a rollout.
    pub fn acting(&self) -> Acting<'_> {
        let away_std = self.config.away_std.at(self.env_steps) as f32;
        let away_scale = (away_std / self.policy.std()).max(1.0);
        Acting {
            frozen: self.policy.freeze_for(self.arithmetic),
            config: &self.config,
            away_scale,
        }
    }

    /// The generator of the action noise for a block of environments in an iteration.
    pub fn noise(&self, iteration: u64, block: usize) -> Rng {
        rng::stream(self.seed, "action noise", iteration << 32 | block as u64)
    }
}

#[cfg(test)]
mod agreement;
