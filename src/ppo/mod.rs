//! Proximal policy optimisation (PPO) of a Gaussian policy.
//!
//! Inputs and outputs are host slices; all weights are in one array (see `parameters`). Nothing here depends on an
//! environment or a file.
//! Notation in comments: a rollout has T steps of N environments, B = T × N samples; a minibatch has M samples; an
//! observation has O values and an action A.

mod acting;
mod adam;
mod backend;
mod candle;
mod checkpoint;
mod format;
mod gae;
mod growth;
mod kernels;
mod learning_rate;
mod measure;
mod normalizer;
mod parameters;
mod perception;
mod policy;
mod progress;
mod rollout;

use std::f64::consts::{E, TAU};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail, ensure};
use rand::seq::SliceRandom;
use rayon::prelude::*;

pub use acting::Acting;
pub use checkpoint::Checkpoint;
pub use format::{Array, Damaged, sealed};
pub use gae::{Discount, gae};
pub use kernels::Workspace;
pub use measure::{flops_per_sample, matmul_gflops, time_gradient_steps};
pub use normalizer::Normalizer;
pub use parameters::{Layer, Layout, View};
pub use perception::Perception;
pub use policy::{ActorParts, FrozenPolicy, LayerParts, Policy};
pub use progress::{Evaluation, Fork, Progress};
pub use rollout::{Rollout, RolloutBlock};

use crate::config::{Backend, PpoConfig};
use crate::ranks::{Division, Slices, totals};
use crate::rng::{self, Rng};
use crate::spaces::Spaces;
use adam::{Adam, norm, norm_chunks, squares};
use backend::{GradientBackend, Minibatch, ShardSums};
use candle::Reference;
use kernels::{Arithmetic, Kernels};
use learning_rate::LearningRate;

/// A learner: the policy and everything that trains it.
pub struct Ppo {
    config: PpoConfig,
    seed: u64,
    policy: Policy,
    backend: Box<dyn GradientBackend>,
    arithmetic: Arithmetic,
    /// The gradient of all parameters for the last minibatch.
    gradient: Vec<f32>,
    adam: Adam,
    learning_rate: LearningRate,
    division: Division,
    /// The chunks of each group of parameters, by which the norm of the gradient is computed.
    chunks: Vec<Vec<Range<usize>>>,
    /// The parameters that each rank moves.
    slices: Slices,
}

/// Statistics of an update: means over its minibatches unless stated otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// The clipped surrogate, negated.
    pub policy_loss: f64,
    /// The clipped squared error of the values.
    pub value_loss: f64,
    /// Squared distance of the mean actions from [-1, 1], beyond which they are clipped.
    pub excess: f64,
    /// Entropy of the action distribution at noise scale 1, nats.
    pub entropy: f64,
    /// KL divergence from the policy that collected the rollout, nats.
    pub kl: f64,
    /// The same for the first minibatch alone, before any gradient step: zero up to rounding.
    pub first_kl: f64,
    /// The largest |ratio - 1| of the first minibatch: zero up to rounding.
    pub first_ratio_error: f64,
    /// Fraction of the samples whose ratio was clipped.
    pub clip_fraction: f64,
    /// Norm of the whole gradient, before clipping.
    pub grad_norm: f64,
    /// Mean of the standard deviations at noise scale 1, after the update.
    pub std: f64,
    /// 1 - Var(returns - values) / Var(returns), with the values predicted during collection.
    pub explained_variance: f64,
    /// The learning rate after the update.
    pub learning_rate: f64,
}

impl UpdateStats {
    /// Returns the logged statistics, each with its group and name.
    pub fn named(&self) -> [(&'static str, f64); 11] {
        [
            ("loss/policy", self.policy_loss),
            ("loss/value", self.value_loss),
            ("policy/entropy", self.entropy),
            ("policy/kl", self.kl),
            ("policy/first_kl", self.first_kl),
            ("policy/clip_fraction", self.clip_fraction),
            ("policy/std", self.std),
            ("policy/excess", self.excess),
            ("value/explained_variance", self.explained_variance),
            ("optim/learning_rate", self.learning_rate),
            ("optim/grad_norm", self.grad_norm),
        ]
    }
}

impl Ppo {
    /// Creates a learner for environments with these spaces. It computes the shards that `division` assigns to this
    /// rank; all its randomness is derived from `seed`.
    ///
    /// # Errors
    /// Fails if this machine does not support the configured precision, or if the observations lack the configured
    /// symmetry.
    pub fn new(config: &PpoConfig, spaces: Spaces, seed: u64, division: Division) -> Result<Self> {
        let policy = Policy::random(&config.net(), spaces, config.std.by_equal_factors(0), seed)?;
        let arithmetic = Arithmetic::new(config.precision)?;
        let backend: Box<dyn GradientBackend> = match config.backend {
            Backend::Fused => Box::new(Kernels::new(config, arithmetic)),
            Backend::Candle => Box::new(Reference::new(config)),
        };
        let (gradient, adam) = (vec![0.0; policy.layout.count()], Adam::new(policy.layout.count()));
        let (config, learning_rate) = (config.clone(), LearningRate::new(config));
        let chunks = norm_chunks(&policy.layout.groups());
        let slices = division.slices(&chunks.concat());
        Ok(Self { config, seed, policy, backend, arithmetic, gradient, adam, learning_rate, division, chunks, slices })
    }

    /// Returns the current policy.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// Returns a checksum (CRC-32) of all parameters.
    pub fn checksum(&self) -> u32 {
        let mut hasher = crc32fast::Hasher::new();
        self.policy.parameters.iter().for_each(|x| hasher.update(&x.to_le_bytes()));
        hasher.finalize()
    }

    /// Creates a rollout of the first horizon for blocks with these numbers of environments.
    pub fn rollout(&self, block_sizes: &[usize]) -> Rollout {
        Rollout::new(self.config.first_horizon(), block_sizes, &self.policy.spaces)
    }

    /// Sets the standard deviation of the actions, the desired KL divergence and the horizon of the rollout to where their
    /// ramps are after `env_steps` control steps of the run.
    pub fn follow_ramps(&mut self, env_steps: u64, rollout: &mut Rollout) {
        let horizon = self.config.horizon_at(env_steps);
        if horizon != rollout.horizon() {
            rollout.resize(horizon, &self.policy.spaces);
        }
        self.learning_rate.follow_ramp(env_steps);
        let std = self.config.std.by_equal_factors(env_steps);
        self.policy.parameters[self.policy.layout.log_std.clone()].fill(std.ln() as f32);
    }

    /// Returns a reusable workspace for acting in blocks of up to `rows` environments.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.policy.workspace(rows, false, self.arithmetic)
    }

    /// Returns the policy of this iteration, for collecting a rollout.
    pub fn acting(&self) -> Acting<'_> {
        let policy = self.policy.freeze_for(self.arithmetic);
        // All actions have the same standard deviation.
        let away_scale = (self.config.away_std as f32 / policy.std()[0]).max(1.0);
        Acting { policy, config: &self.config, away_scale }
    }

    /// Returns the generator of the action noise for a block of environments in an iteration.
    pub fn noise(&self, iteration: u64, block: usize) -> Rng {
        rng::stream(self.seed, "action noise", iteration << 32 | block as u64)
    }

    /// Learns from a rollout that this policy collected, then adds its observations to the normaliser. The normaliser
    /// does not change during collection and learning, so the first minibatch sees exactly the policy that acted.
    /// Returns `None` if `stop` was set in the meantime; the learner must then be restored before it is used again.
    ///
    /// # Errors
    /// Fails if a loss, gradient or weight is not finite; the policy must not be used or saved then.
    pub fn update(&mut self, rollout: &mut Rollout, iteration: u64, stop: &AtomicBool) -> Result<Option<UpdateStats>> {
        // Runs on a worker thread: each of the many short parallel sections would put an outside thread to sleep and
        // wake it.
        rayon::scope(|_| self.learn(rollout, iteration, stop))
    }

    fn learn(&mut self, rollout: &mut Rollout, iteration: u64, stop: &AtomicBool) -> Result<Option<UpdateStats>> {
        let explained_variance = self.prepare(rollout);
        self.backend.begin(&self.policy, rollout);
        let own = self.division.own();
        let in_shard = rollout.samples() / own.len();
        // Each part takes this number of samples from each shard.
        let shards = self.division.shards();
        let size = self.config.minibatch_of(in_shard * shards, rollout.horizon()) / shards;
        let stream = |shard| rng::stream(self.seed, "shuffle", iteration << 32 | shard as u64);
        let mut shuffles: Vec<Rng> = own.clone().map(stream).collect();
        let mut order: Vec<u32> = (0..rollout.samples() as u32).collect();
        let (mut samples, mut steps) = (Vec::new(), Vec::new());
        for epoch in 0..self.config.epochs {
            order.chunks_mut(in_shard).zip(&mut shuffles).for_each(|(shard, shuffle)| shard.shuffle(shuffle));
            for part in 0..in_shard / size {
                if stop.load(Ordering::Relaxed) {
                    return Ok(None);
                }
                samples.clear();
                order.chunks(in_shard).for_each(|shard| samples.extend_from_slice(&shard[part * size..][..size]));
                let step = self.minibatch_step(rollout, &samples, steps.is_empty());
                steps.push(step.with_context(|| format!("epoch {epoch}, minibatch {part}"))?);
            }
        }
        self.check_weights()?;
        let seen: Vec<&[f32]> = rollout.blocks.iter().map(RolloutBlock::acted_on).collect();
        let seen: Vec<Vec<&[f32]>> = seen.chunks(seen.len() / own.len()).map(<[_]>::to_vec).collect();
        self.policy.see(&seen, &self.division);
        Ok(Some(self.stats(&steps, explained_variance)))
    }

    /// Returns the statistics of an update with these steps.
    fn stats(&self, steps: &[Step], explained_variance: f64) -> UpdateStats {
        let mean = |of: fn(&Step) -> f64| steps.iter().map(of).sum::<f64>() / steps.len() as f64;
        let std = self.policy.std();
        UpdateStats {
            policy_loss: mean(|step| step.losses.policy),
            value_loss: mean(|step| step.losses.value),
            excess: mean(|step| step.losses.excess),
            entropy: mean(|step| step.entropy),
            kl: mean(|step| step.losses.kl),
            first_kl: steps[0].losses.kl,
            first_ratio_error: steps[0].losses.ratio_error,
            clip_fraction: mean(|step| step.losses.clip_fraction),
            grad_norm: mean(|step| step.grad_norm),
            std: std.iter().copied().map(f64::from).sum::<f64>() / std.len() as f64,
            explained_variance,
            learning_rate: self.learning_rate.rate,
        }
    }

    /// Computes the returns and advantages, normalises the advantages to mean 0 and standard deviation 1, and returns
    /// the explained variance.
    fn prepare(&self, rollout: &mut Rollout) -> f64 {
        let discount = Discount { gamma: self.config.gamma as f32, lambda: self.config.lambda as f32 };
        rollout.blocks.par_iter_mut().for_each(|block| {
            gae(discount, &block.rewards, &block.values, &block.dones, &mut block.advantages, &mut block.returns);
        });
        let (_, spread) = self.mean_and_variance(rollout, |block| &block.returns);
        let (mean, residual) = self.mean_and_variance(rollout, |block| &block.advantages);
        let scale = 1.0 / (residual.sqrt() + 1e-8);
        for x in rollout.blocks.iter_mut().flat_map(|block| &mut block.advantages) {
            *x = ((f64::from(*x) - mean) * scale) as f32;
        }
        if spread > 0.0 { 1.0 - residual / spread } else { f64::NAN }
    }

    /// Returns the mean and variance of one array over all samples of all ranks.
    fn mean_and_variance(&self, rollout: &Rollout, of: fn(&RolloutBlock) -> &[f32]) -> (f64, f64) {
        let shards = self.division.own().len();
        let sum = |term: &dyn Fn(f64) -> f64| {
            let blocks = rollout.blocks.chunks(rollout.blocks.len() / shards);
            let of_shard =
                |blocks: &[RolloutBlock]| blocks.iter().flat_map(of).map(|&x| term(f64::from(x))).sum::<f64>();
            self.division.total(blocks.map(|blocks| vec![of_shard(blocks)]))[0]
        };
        let count = (rollout.samples() / shards * self.division.shards()) as f64;
        let mean = sum(&|x| x) / count;
        (mean, sum(&|x| (x - mean).powi(2)) / count)
    }

    /// Takes one gradient step on these samples, which are ordered by shard. In the `first` step of an update, the
    /// policy is still the one that acted.
    fn minibatch_step(&mut self, rollout: &Rollout, samples: &[u32], first: bool) -> Result<Step> {
        let (own_shards, shards) = (self.division.own().len(), self.division.shards());
        let minibatch = Minibatch { samples, own_shards, shards };
        let sums = self.backend.gradient(&self.policy, rollout, minibatch, &mut self.gradient)?;
        self.division.reduce(&mut self.gradient, &self.slices);
        let losses = self.losses(&sums, minibatch.count() as f64);
        let squares = squares(&self.gradient, self.slices.own_chunks());
        let squares = self.division.gather_chunks(squares, &self.slices);
        let grad_norm = norm(&squares, &self.chunks);
        for (what, value) in [("the loss", losses.total), ("the norm of the gradient", grad_norm)] {
            if !value.is_finite() {
                bail!("{what} is {value}: the training has failed and stops here");
            }
        }
        if !first {
            self.learning_rate.adapt(losses.kl);
        }
        // The entropy of the Gaussian at noise scale 1.
        let entropy = self.policy.log_std().iter().map(|&s| f64::from(s) + 0.5 * (TAU * E).ln()).sum();
        // As in PyTorch's clip_grad_norm_, including the constant that prevents a division by zero.
        let scale = (self.config.max_grad_norm / (grad_norm + 1e-6)).min(1.0);
        let (parameters, own) = (&mut self.policy.parameters, self.slices.own());
        self.adam.step(parameters, &self.gradient, own, self.learning_rate.rate, scale);
        self.division.share(parameters, &self.slices);
        Ok(Step { losses, grad_norm, entropy })
    }

    /// Returns the losses of a minibatch of `samples` samples, given the sums of this rank's shards.
    fn losses(&self, sums: &[ShardSums], samples: f64) -> Losses {
        let row =
            |sums: &ShardSums| [sums.surrogate, sums.value_error, sums.excess, sums.kl, sums.clipped, sums.ratio_error];
        let rows = self.division.gather(sums.iter().flat_map(row).collect());
        let totals = totals(&rows, self.division.shards());
        let mean = |i: usize| totals[i] / samples;
        let (policy, value, excess, kl, clip_fraction) = (-mean(0), mean(1), mean(2), mean(3), mean(4));
        let total = policy + self.config.value_coef * value + self.config.bounds_coef * excess;
        let ratio_error = rows.iter().skip(5).step_by(6).copied().fold(0.0, f64::max);
        Losses { total, policy, value, excess, kl, clip_fraction, ratio_error }
    }

    /// Brings the learning rate of a fork, whose parent had the settings `before`, in line with its own settings.
    pub fn settle_learning_rate(&mut self, before: &PpoConfig) {
        self.learning_rate.settle(before);
    }

    fn check_weights(&self) -> Result<()> {
        for View { name, range, .. } in self.policy.layout.views() {
            let finite = self.policy.parameters[range].iter().all(|x| x.is_finite());
            ensure!(finite, "the update made `{name}` infinite or NaN: the training has failed and stops here");
        }
        Ok(())
    }
}

/// Losses and statistics of one minibatch.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Losses {
    /// The loss that is minimised.
    total: f64,
    /// The clipped surrogate, negated.
    policy: f64,
    /// The clipped squared error of the values.
    value: f64,
    /// Mean squared distance of the means from [-1, 1], beyond which actions are clipped.
    excess: f64,
    /// Mean KL divergence of the current distribution from the one that acted, nats.
    kl: f64,
    /// Fraction of the samples whose ratio was clipped.
    clip_fraction: f64,
    /// The largest |ratio - 1|.
    ratio_error: f64,
}

/// The results of one gradient step.
struct Step {
    losses: Losses,
    grad_norm: f64,
    entropy: f64,
}

#[cfg(test)]
mod agreement;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    const SPACES: Spaces = Spaces { observation_size: 3, action_size: 2, cube_and_goal: None, distance: |_| 0.0 };

    #[test]
    fn the_entropy_is_that_of_a_gaussian_with_these_standard_deviations() {
        let config = Config::resolve(None, &["ppo.symmetry=none".parse().unwrap()]).unwrap().ppo;
        let mut ppo = Ppo::new(&config, SPACES, 0, Division::alone(1)).unwrap();
        let rollout = Rollout::new(1, &[4], &SPACES);
        ppo.backend.begin(&ppo.policy, &rollout);
        // With a standard deviation of 0.6: ln 0.6 + ln(2πe) / 2 = 0.908 113 for each of the two actions.
        let step = ppo.minibatch_step(&rollout, &[0, 1, 2, 3], true).unwrap();
        assert!((step.entropy - 2.0 * 0.908_113).abs() < 1e-5, "{}", step.entropy);
    }
}
