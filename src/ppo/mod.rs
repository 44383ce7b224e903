//! The fence around candle: a Gaussian policy, and proximal policy optimisation of it.
//!
//! Host slices come in and go out. Nothing outside this folder names candle, nothing inside knows an environment or a file.
//! In comments: T steps of N environments (the rollout), B = T × N samples, M samples in a minibatch, O and A numbers in an
//! observation and an action.

mod acting;
mod backend;
mod checkpoint;
mod format;
mod fused;
mod gae;
mod measure;
mod normalizer;
mod policy;
mod reference;
mod rollout;

use std::f64::consts::{E, TAU};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail, ensure};
use rand::seq::SliceRandom;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

pub use acting::Acting;
pub use checkpoint::{Checkpoint, Progress};
pub use format::{Array, sealed};
pub use fused::Workspace;
pub use gae::gae;
pub use measure::{flops_per_sample, matmul_gflops, time_gradient_steps};
pub use normalizer::Normalizer;
pub use policy::{FrozenPolicy, Policy};
pub use rollout::{Rollout, RolloutBlock, RolloutStep};

use crate::config::PpoConfig;
use crate::rng::{self, Rng};
use backend::{Backend, Losses};
use fused::Arithmetic;

/// The policy and what improves it.
pub struct Ppo {
    config: PpoConfig,
    seed: u64,
    policy: Policy,
    backend: Box<dyn Backend>,
    arithmetic: Arithmetic,
    learning_rate: f64,
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
    /// A new learner for observations and actions of these sizes; all its randomness follows from `seed`.
    ///
    /// # Errors
    /// A precision that this machine does not have.
    pub fn new(config: &PpoConfig, observation_size: usize, action_size: usize, seed: u64) -> Result<Self> {
        let policy = Policy::new(config, observation_size, action_size, seed)?;
        let arithmetic = Arithmetic::new(config.precision)?;
        let backend = backend::new(config, &policy, arithmetic)?;
        Ok(Self { config: config.clone(), seed, policy, backend, arithmetic, learning_rate: config.learning_rate })
    }

    /// The policy as it is now.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// A rollout of the configured horizon for blocks of so many environments.
    pub fn rollout(&self, block_sizes: &[usize]) -> Rollout {
        Rollout::new(self.config.horizon, block_sizes, self.policy.observation_size(), self.policy.action_size())
    }

    /// Keeps the standard deviations of the actions within the bounds for a run after so many control steps.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn limit_std(&mut self, env_steps: u64) -> Result<()> {
        self.policy.limit_std(self.config.std_bounds(env_steps))
    }

    /// What acting for blocks of up to `rows` environments needs, to be used again and again.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.policy.workspace(rows, false, self.arithmetic)
    }

    /// The policy of this iteration, to collect a rollout with.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn acting(&self) -> Result<Acting<'_>> {
        let policy = self.policy.freeze()?;
        let std = policy.std();
        // The geometric mean. In proportion to it all standard deviations grow: to those of the policy the losses take the factor for
        // a constant, though it follows them.
        let typical = (std.iter().map(|s| s.ln()).sum::<f32>() / std.len() as f32).exp();
        let away_scale = (self.config.away_std as f32 / typical).max(1.0);
        let away_range = self.config.away_range.map(|x| x as f32);
        let (gamma, reward_scale) = (self.config.gamma as f32, self.config.reward_scale as f32);
        Ok(Acting { policy, away_scale, away_range, gamma, reward_scale })
    }

    /// The generator of the action noise of a block of environments in an iteration.
    pub fn noise(&self, iteration: u64, block: usize) -> Rng {
        rng::stream(self.seed, "action noise", iteration << 32 | block as u64)
    }

    /// Draws which environments of a block explore in an iteration, and the one noise that each of them keeps through it: what
    /// changes from step to step is smoothed away by the hand, what stays moves it to another place. To the losses it is noise like
    /// any other, of a larger standard deviation: an approximation, since what stays can be seen in the states that follow.
    ///
    /// On noise correlated in time: J. Hollenstein et al., "Colored noise in PPO: improved exploration and performance through
    /// correlated action sampling" (2024).
    pub fn explore(&self, block: &mut RolloutBlock, iteration: u64, index: usize) {
        let mut rng = rng::stream(self.seed, "exploring", iteration << 32 | index as u64);
        let noises = block.steady_noise.chunks_exact_mut(self.policy.action_size());
        for (scale, noise) in block.exploring_scales.iter_mut().zip(noises) {
            let explores = rng::uniform(&mut rng, 0.0, 1.0) < self.config.exploring_share;
            *scale = if explores { self.config.exploring_scale as f32 } else { 1.0 };
            if explores {
                noise.fill_with(|| StandardNormal.sample(&mut rng));
            }
        }
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
        self.backend.begin(&self.policy, rollout)?;
        let size = rollout.samples() / self.config.minibatches;
        let mut shuffle = rng::stream(self.seed, "shuffle", iteration);
        let mut order: Vec<u32> = (0..rollout.samples() as u32).collect();
        let mut stats = UpdateStats::default();
        for epoch in 0..self.config.epochs {
            order.shuffle(&mut shuffle);
            for (part, samples) in order.chunks_exact(size).enumerate() {
                if stop.load(Ordering::Relaxed) {
                    return Ok(None);
                }
                let first = (epoch, part) == (0, 0);
                let losses = self
                    .minibatch_step(rollout, samples, first)
                    .with_context(|| format!("epoch {epoch}, minibatch {part}"))?;
                if first {
                    (stats.first_kl, stats.first_ratio_error) = (losses.kl, losses.ratio_error);
                }
                stats.add(&losses);
            }
        }
        self.check_weights()?;
        stats.average((self.config.epochs * self.config.minibatches) as f64);
        let std = self.policy.std()?;
        stats.std = std.iter().copied().map(f64::from).sum::<f64>() / std.len() as f64;
        (stats.explained_variance, stats.learning_rate) = (explained_variance, self.learning_rate);
        let seen: Vec<&[f32]> = rollout.blocks.iter().map(RolloutBlock::acted_on).collect();
        self.policy.normalizer.update(&seen);
        Ok(Some(stats))
    }

    /// Sets the returns and the advantages, which get mean 0 and standard deviation 1; returns the explained variance.
    fn prepare(&self, rollout: &mut Rollout) -> f64 {
        let factors = [self.config.gamma as f32, self.config.lambda as f32];
        rollout.blocks.par_iter_mut().for_each(|block| {
            gae(factors, &block.rewards, &block.values, &block.dones, &mut block.advantages, &mut block.returns);
        });
        let all = |of: fn(&RolloutBlock) -> &[f32]| rollout.blocks.iter().flat_map(of);
        let (_, spread) = mean_and_variance(all(|block| &block.returns));
        let (mean, residual) = mean_and_variance(all(|block| &block.advantages));
        let scale = 1.0 / (residual.sqrt() + 1e-8);
        for x in rollout.blocks.iter_mut().flat_map(|block| &mut block.advantages) {
            *x = ((f64::from(*x) - mean) * scale) as f32;
        }
        if spread > 0.0 { 1.0 - residual / spread } else { f64::NAN }
    }

    /// One gradient step on these samples. The `first` of an update still sees the policy that acted.
    fn minibatch_step(&mut self, rollout: &Rollout, samples: &[u32], first: bool) -> Result<Losses> {
        let losses = self.backend.gradient(&self.policy, rollout, samples)?;
        let Losses { total, grad_norm, .. } = losses;
        if !total.is_finite() {
            bail!("the loss is {total}: the training has failed and stops here");
        }
        if !grad_norm.is_finite() {
            bail!("the norm of the gradient is {grad_norm}: the training has failed and stops here");
        }
        if !first {
            self.adapt_learning_rate(losses.kl);
        }
        // As in PyTorch's clip_grad_norm_, with its constant against a division by zero.
        let scale = (self.config.max_grad_norm / (grad_norm + 1e-6)).min(1.0);
        let critic = match self.config.critic_learning_rate {
            0.0 => self.learning_rate,
            own => own,
        };
        self.backend.step(&self.policy, [self.learning_rate, critic], scale)?;
        Ok(losses)
    }

    fn check_weights(&self) -> Result<()> {
        for (name, var) in self.policy.parameters() {
            // A sum with a number that is not finite is not finite.
            ensure!(
                var.sum_all()?.to_scalar::<f32>()?.is_finite(),
                "the step has made `{name}` infinite or NaN: the training has failed and stops here"
            );
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

impl UpdateStats {
    fn add(&mut self, losses: &Losses) {
        self.policy_loss += losses.policy;
        self.value_loss += losses.value;
        self.excess += losses.excess;
        self.entropy += losses.entropy;
        self.kl += losses.kl;
        self.clip_fraction += losses.clip_fraction;
        self.grad_norm += losses.grad_norm;
    }

    fn average(&mut self, count: f64) {
        for sum in [
            &mut self.policy_loss,
            &mut self.value_loss,
            &mut self.excess,
            &mut self.entropy,
            &mut self.kl,
            &mut self.clip_fraction,
            &mut self.grad_norm,
        ] {
            *sum /= count;
        }
    }
}

fn mean_and_variance<'a>(values: impl Iterator<Item = &'a f32> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    let mean = values.clone().map(|&x| f64::from(x)).sum::<f64>() / count;
    (mean, values.map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count)
}

/// The entropy, nats, of a Gaussian with these logarithms of its standard deviations.
fn entropy(log_std: &[f32]) -> f64 {
    log_std.iter().map(|&s| f64::from(s) + 0.5 * (TAU * E).ln()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn learner(desired_kl: f64) -> Ppo {
        let mut config = Config::resolve(None, &[]).unwrap().ppo;
        (config.desired_kl, config.learning_rate, config.learning_rate_range) = (desired_kl, 1e-3, [5e-4, 2e-3]);
        Ppo::new(&config, 3, 2, 0).unwrap()
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
    fn without_a_desired_divergence_the_learning_rate_is_fixed() {
        let mut ppo = learner(0.0);
        [1e-6, 1.0].into_iter().for_each(|kl| ppo.adapt_learning_rate(kl));
        assert_eq!(ppo.learning_rate, 1e-3);
    }
}
