//! Proximal policy optimisation of a Gaussian policy.
//!
//! Host slices come in and go out; all weights lie in one of them (see `parameters`). Nothing here knows an environment or a file.
//! In comments: T steps of N environments (the rollout), B = T × N samples, M samples in a minibatch, O and A numbers in an
//! observation and an action.

mod acting;
mod adam;
mod backend;
mod candle;
mod checkpoint;
mod format;
mod gae;
mod growth;
mod kernels;
mod measure;
mod normalizer;
mod parameters;
mod perception;
mod policy;
mod rollout;

use std::f64::consts::{E, TAU};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail, ensure};
use rand::seq::SliceRandom;
use rayon::prelude::*;

pub use acting::Acting;
pub use checkpoint::{Checkpoint, Fork, Progress};
pub use format::{Array, Damaged, sealed};
pub use gae::gae;
pub use kernels::Workspace;
pub use measure::{flops_per_sample, matmul_gflops, time_gradient_steps};
pub use normalizer::Normalizer;
pub use parameters::{Layer, Layout, View};
pub use perception::Perception;
pub use policy::{FrozenPolicy, Policy};
pub use rollout::{Rollout, RolloutBlock};

use crate::config::{self, PpoConfig};
use crate::ranks::Division;
use crate::rng::{self, Rng};
use crate::spaces::Spaces;
use adam::{Adam, norm};
use backend::{Backend, Minibatch, ShardSums};
use candle::Reference;
use kernels::{Arithmetic, Kernels};

/// The policy and what improves it.
pub struct Ppo {
    config: PpoConfig,
    seed: u64,
    policy: Policy,
    backend: Box<dyn Backend>,
    arithmetic: Arithmetic,
    /// Of all parameters, of the last minibatch.
    gradient: Vec<f32>,
    adam: Adam,
    learning_rate: f64,
    division: Division,
}

/// Means over the minibatches of an update, where nothing else is said.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// The clipped surrogate, negated.
    pub policy_loss: f64,
    /// The clipped squared error of the values.
    pub value_loss: f64,
    /// Squared distance of the mean actions from [-1, 1], beyond which they are clipped.
    pub excess: f64,
    /// Entropy of the policy's own action distribution, nats.
    pub entropy: f64,
    /// KL divergence from the policy that collected, nats.
    pub kl: f64,
    /// The same of the first minibatch alone, before any step: zero but for rounding.
    pub first_kl: f64,
    /// The largest |ratio - 1| of the first minibatch: zero but for rounding.
    pub first_ratio_error: f64,
    /// Fraction of the samples whose ratio was clipped.
    pub clip_fraction: f64,
    /// Norm of all gradients together, before clipping.
    pub grad_norm: f64,
    /// Mean of the policy's own standard deviations, after the update.
    pub std: f64,
    /// 1 - Var(returns - values) / Var(returns) of the values that the rollout was collected with.
    pub explained_variance: f64,
    /// The learning rate after the update.
    pub learning_rate: f64,
}

impl Ppo {
    /// A new learner for environments with these spaces, of which it computes some shards; all its randomness follows from `seed`.
    ///
    /// # Errors
    /// A precision that this machine does not have, or a symmetry that the observations do not have.
    pub fn new(config: &PpoConfig, spaces: Spaces, seed: u64, division: Division) -> Result<Self> {
        let [_, std] = config.std_bounds(0);
        let policy = Policy::random(&config.net(), spaces, std, seed)?;
        let arithmetic = Arithmetic::new(config.precision)?;
        let backend: Box<dyn Backend> = match config.backend {
            config::Backend::Fused => Box::new(Kernels::new(config, arithmetic)),
            config::Backend::Candle => Box::new(Reference::new(config)),
        };
        let (gradient, adam) = (vec![0.0; policy.layout.count()], Adam::new(policy.layout.count()));
        let (config, learning_rate) = (config.clone(), config.learning_rate);
        Ok(Self { config, seed, policy, backend, arithmetic, gradient, adam, learning_rate, division })
    }

    /// The policy as it is now.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// A rollout of the configured horizon for blocks of so many environments.
    pub fn rollout(&self, block_sizes: &[usize]) -> Rollout {
        Rollout::new(self.config.horizon, block_sizes, &self.policy.spaces)
    }

    /// Keeps the standard deviations of the actions within the bounds for a run after so many control steps.
    pub fn limit_std(&mut self, env_steps: u64) {
        let [least, most] = self.config.std_bounds(env_steps).map(|std| std.ln() as f32);
        let log_std = &mut self.policy.parameters[self.policy.layout.log_std.clone()];
        log_std.iter_mut().for_each(|x| *x = x.max(least).min(most));
    }

    /// What acting for blocks of up to `rows` environments needs, to be used again and again.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.policy.workspace(rows, false, self.arithmetic)
    }

    /// The policy of this iteration, to collect a rollout with.
    pub fn acting(&self) -> Acting<'_> {
        let policy = self.policy.freeze();
        let std = policy.std();
        // The geometric mean. In proportion to it all standard deviations grow: to those of the policy the losses take the factor for
        // a constant, though it follows them.
        let typical = (std.iter().map(|s| s.ln()).sum::<f32>() / std.len() as f32).exp();
        let away_scale = (self.config.away_std as f32 / typical).max(1.0);
        Acting { policy, config: &self.config, away_scale }
    }

    /// The generator of the action noise of a block of environments in an iteration.
    pub fn noise(&self, iteration: u64, block: usize) -> Rng {
        rng::stream(self.seed, "action noise", iteration << 32 | block as u64)
    }

    /// Learns from a rollout that this policy has collected, then takes its observations into the normaliser, which stays
    /// the same during collection and update: so the first minibatch still sees the very policy that acted. `None` if `stop`
    /// was set meanwhile; then the learner must be restored before it is used again.
    ///
    /// # Errors
    /// A loss, gradient or weight that is not finite; the policy must not be used or saved then.
    pub fn update(&mut self, rollout: &mut Rollout, iteration: u64, stop: &AtomicBool) -> Result<Option<UpdateStats>> {
        // On a worker thread: from outside, each of the many short parallel parts would put this one to sleep and wake it.
        rayon::scope(|_| self.learn(rollout, iteration, stop))
    }

    fn learn(&mut self, rollout: &mut Rollout, iteration: u64, stop: &AtomicBool) -> Result<Option<UpdateStats>> {
        let explained_variance = self.prepare(rollout);
        self.backend.begin(&self.policy, rollout);
        let own = self.division.own();
        let in_shard = rollout.samples() / own.len();
        // Of each shard, as many in each part.
        let size = in_shard / self.config.minibatches;
        let stream = |shard| rng::stream(self.seed, "shuffle", iteration << 32 | shard as u64);
        let mut shuffles: Vec<Rng> = own.clone().map(stream).collect();
        let mut order: Vec<u32> = (0..rollout.samples() as u32).collect();
        let (mut samples, mut steps) = (Vec::new(), Vec::new());
        for epoch in 0..self.config.epochs {
            order.chunks_mut(in_shard).zip(&mut shuffles).for_each(|(shard, shuffle)| shard.shuffle(shuffle));
            for part in 0..self.config.minibatches {
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

    /// The figures of an update of these steps.
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
            learning_rate: self.learning_rate,
        }
    }

    /// Sets the returns and the advantages, which get mean 0 and standard deviation 1; returns the explained variance.
    fn prepare(&self, rollout: &mut Rollout) -> f64 {
        let factors = [self.config.gamma as f32, self.config.lambda as f32];
        rollout.blocks.par_iter_mut().for_each(|block| {
            gae(factors, &block.rewards, &block.values, &block.dones, &mut block.advantages, &mut block.returns);
        });
        let (_, spread) = self.mean_and_variance(rollout, |block| &block.returns);
        let (mean, residual) = self.mean_and_variance(rollout, |block| &block.advantages);
        let scale = 1.0 / (residual.sqrt() + 1e-8);
        for x in rollout.blocks.iter_mut().flat_map(|block| &mut block.advantages) {
            *x = ((f64::from(*x) - mean) * scale) as f32;
        }
        if spread > 0.0 { 1.0 - residual / spread } else { f64::NAN }
    }

    /// Mean and variance of what all samples of all ranks have there.
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

    /// One gradient step on these samples, shard after shard. The `first` of an update still sees the policy that acted.
    fn minibatch_step(&mut self, rollout: &Rollout, samples: &[u32], first: bool) -> Result<Step> {
        let (own_shards, shards) = (self.division.own().len(), self.division.shards());
        let minibatch = Minibatch { samples, own_shards, shards };
        let sums = self.backend.gradient(&self.policy, rollout, minibatch, &mut self.gradient)?;
        self.division.add_up(&mut self.gradient);
        let losses = self.losses(&sums, minibatch.count() as f64);
        let grad_norm = norm(&self.gradient, &self.policy.layout.groups());
        for (what, value) in [("the loss", losses.total), ("the norm of the gradient", grad_norm)] {
            if !value.is_finite() {
                bail!("{what} is {value}: the training has failed and stops here");
            }
        }
        if !first {
            self.adapt_learning_rate(losses.kl);
        }
        // Of the Gaussian with the policy's own standard deviations.
        let entropy = self.policy.log_std().iter().map(|&s| f64::from(s) + 0.5 * (TAU * E).ln()).sum();
        // As in PyTorch's clip_grad_norm_, with its constant against a division by zero.
        let scale = (self.config.max_grad_norm / (grad_norm + 1e-6)).min(1.0);
        self.adam.step(&mut self.policy.parameters, &self.gradient, self.learning_rate, scale);
        Ok(Step { losses, grad_norm, entropy })
    }

    /// The figures of a minibatch of so many samples, from the sums of the shards of this rank.
    fn losses(&self, sums: &[ShardSums], samples: f64) -> Losses {
        let row = |sums: &ShardSums| vec![sums.surrogate, sums.value_error, sums.excess, sums.kl, sums.clipped];
        let totals = self.division.total(sums.iter().map(row));
        let mean = |i: usize| totals[i] / samples;
        let (policy, value, excess, kl, clip_fraction) = (-mean(0), mean(1), mean(2), mean(3), mean(4));
        let total = policy + self.config.value_coef * value + self.config.bounds_coef * excess;
        let ratio_error = self.division.largest(sums.iter().map(|sums| sums.ratio_error).fold(0.0, f64::max));
        Losses { total, policy, value, excess, kl, clip_fraction, ratio_error }
    }

    /// Goes on with the learning rate of its settings, where they name another one than `before` or keep it fixed; an adapted one
    /// stays within its range.
    pub fn settle_learning_rate(&mut self, before: &PpoConfig) {
        let PpoConfig { learning_rate, learning_rate_range: [lowest, highest], desired_kl, .. } = self.config;
        if desired_kl == 0.0 || learning_rate != before.learning_rate {
            self.learning_rate = learning_rate;
        } else {
            self.learning_rate = self.learning_rate.clamp(lowest, highest);
        }
    }

    fn check_weights(&self) -> Result<()> {
        for View { name, range, .. } in self.policy.layout.views() {
            let finite = self.policy.parameters[range].iter().all(|x| x.is_finite());
            ensure!(finite, "the step has made `{name}` infinite or NaN: the training has failed and stops here");
        }
        Ok(())
    }

    /// Keeps the KL divergence of an update near the desired one, as the reference implementation does.
    fn adapt_learning_rate(&mut self, kl: f64) {
        let desired = self.config.desired_kl;
        let [lowest, highest] = self.config.learning_rate_range;
        if desired == 0.0 {
            return;
        }
        if kl > 2.0 * desired {
            self.learning_rate = (self.learning_rate / 1.5).max(lowest);
        } else if kl < 0.5 * desired {
            self.learning_rate = (self.learning_rate * 1.5).min(highest);
        }
    }
}

/// Figures of one minibatch.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Losses {
    /// What is minimised.
    total: f64,
    /// The clipped surrogate, negated.
    policy: f64,
    /// The clipped squared error of the values.
    value: f64,
    /// Mean squared distance of the means from [-1, 1], beyond which actions are clipped.
    excess: f64,
    /// Mean KL divergence of the present distribution from the one that acted, nats.
    kl: f64,
    /// Fraction of the samples whose ratio was clipped.
    clip_fraction: f64,
    /// The largest |ratio - 1|.
    ratio_error: f64,
}

/// What is known of one gradient step.
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

    fn learner(desired_kl: f64) -> Ppo {
        let mut config = Config::resolve(None, &["ppo.symmetry=none".parse().unwrap()]).unwrap().ppo;
        (config.desired_kl, config.learning_rate, config.learning_rate_range) = (desired_kl, 1e-3, [5e-4, 2e-3]);
        Ppo::new(&config, SPACES, 0, Division::alone(1)).unwrap()
    }

    #[test]
    fn the_learning_rate_follows_the_divergence_within_its_range() {
        let mut ppo = learner(0.01);
        // The divergence, and the factor that the rate is then changed by.
        for (kl, factor) in [(0.021, 1.0 / 1.5), (0.019, 1.0), (0.006, 1.0), (0.004, 1.5), (0.0, 1.5)] {
            ppo.learning_rate = 1e-3;
            ppo.adapt_learning_rate(kl);
            assert!((ppo.learning_rate / 1e-3 - factor).abs() < 1e-12, "KL {kl}: {}", ppo.learning_rate);
        }
        (0..9).for_each(|_| ppo.adapt_learning_rate(1.0));
        assert_eq!(ppo.learning_rate, 5e-4);
        (0..9).for_each(|_| ppo.adapt_learning_rate(1e-4));
        assert_eq!(ppo.learning_rate, 2e-3);
    }

    #[test]
    fn a_fork_takes_the_learning_rate_of_its_settings_where_they_name_another_or_keep_it_fixed() {
        let mut ppo = learner(0.01);
        let before = ppo.config.clone();
        // As adapted, what the settings name now, the divergence that is desired, and the rate that it goes on with.
        for (adapted, named, desired, expected) in
            [(7e-4, 1e-3, 0.01, 7e-4), (7e-4, 6e-4, 0.01, 6e-4), (7e-4, 1e-3, 0.0, 1e-3), (1e-4, 1e-3, 0.01, 5e-4)]
        {
            (ppo.learning_rate, ppo.config.learning_rate, ppo.config.desired_kl) = (adapted, named, desired);
            ppo.settle_learning_rate(&before);
            assert_eq!(ppo.learning_rate, expected);
        }
    }

    #[test]
    fn the_entropy_is_that_of_a_gaussian_with_these_standard_deviations() {
        let mut ppo = learner(0.0);
        let rollout = Rollout::new(1, &[4], &SPACES);
        ppo.backend.begin(&ppo.policy, &rollout);
        // Of a standard deviation of 0.6: ln 0.6 + ln(2πe) / 2 = 0.908 113 for each of two actions.
        let step = ppo.minibatch_step(&rollout, &[0, 1, 2, 3], true).unwrap();
        assert!((step.entropy - 2.0 * 0.908_113).abs() < 1e-5, "{}", step.entropy);
    }

    #[test]
    fn without_a_desired_divergence_the_learning_rate_is_fixed() {
        let mut ppo = learner(0.0);
        [1e-6, 1.0].into_iter().for_each(|kl| ppo.adapt_learning_rate(kl));
        assert_eq!(ppo.learning_rate, 1e-3);
    }
}
