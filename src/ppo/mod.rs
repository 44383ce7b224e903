//! The fence around candle: a Gaussian policy, and proximal policy optimisation of it.
//!
//! Host slices come in and go out. Nothing outside this folder names candle, nothing inside knows an environment or a file.
//! In comments: T steps of N environments (the rollout), B = T × N samples, M samples in a minibatch, O and A numbers in an
//! observation and an action.

mod adam;
mod checkpoint;
mod elementwise;
mod gae;
mod layer;
mod loss;
mod measure;
mod normalizer;
mod policy;
mod rollout;

use anyhow::{Context, Result, bail, ensure};
use candle_core::{Device, Tensor};
use rand::seq::SliceRandom;
use rand_distr::{Distribution, StandardNormal};

pub use checkpoint::{Checkpoint, Progress};
pub use gae::gae;
pub use measure::{flops_per_sample, matmul_gflops, time_gradient_steps};
pub use normalizer::Normalizer;
pub use policy::{Mlp, Policy};
pub use rollout::{Rollout, RolloutStep};

use crate::config::PpoConfig;
use crate::rng::{self, Rng};
use adam::Adam;
use loss::{Losses, Minibatch};

/// The policy and what improves it.
pub struct Ppo {
    config: PpoConfig,
    seed: u64,
    policy: Policy,
    adam: Adam,
    learning_rate: f64,
}

/// Means over the minibatches of an update, where nothing else is said.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// The clipped surrogate, negated.
    pub policy_loss: f64,
    /// The clipped squared error of the values.
    pub value_loss: f64,
    /// Entropy of the action distribution, nats.
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
    /// Mean standard deviation of the actions, after the update.
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
    /// Only if candle cannot allocate.
    pub fn new(config: &PpoConfig, observation_size: usize, action_size: usize, seed: u64) -> Result<Self> {
        let policy = Policy::new(config, observation_size, action_size, seed)?;
        let adam = Adam::new(policy.parameters())?;
        Ok(Self { config: config.clone(), seed, policy, adam, learning_rate: config.learning_rate })
    }

    /// The policy as it is now.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// A rollout of the configured horizon for `envs` environments.
    pub fn rollout(&self, envs: usize) -> Rollout {
        Rollout::new(self.config.horizon, envs, self.policy.observation_size(), self.policy.action_size())
    }

    /// The generator of the action noise of an iteration.
    pub fn noise(&self, iteration: u64) -> Rng {
        rng::stream(self.seed, "action noise", iteration)
    }

    /// Draws actions for the observations of a step; writes actions, means, log-probabilities and values.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn act(&self, step: &mut RolloutStep, noise: &mut Rng) -> Result<()> {
        let observations = self.policy.normalized(step.observations)?;
        let [actor, critic] = self.policy.frozen_nets();
        policy::copy_out(&actor.forward(&observations)?, step.means)?;
        policy::copy_out(&critic.forward(&observations)?, step.values)?;
        let std = self.policy.std()?;
        let constant: f32 = std.iter().map(|s| s.ln() + 0.5 * std::f32::consts::TAU.ln()).sum();
        let rows = step.actions.chunks_exact_mut(std.len()).zip(step.means.chunks_exact(std.len()));
        for ((actions, means), log_prob) in rows.zip(step.log_probs.iter_mut()) {
            let mut squares = 0.0;
            for ((action, mean), std) in actions.iter_mut().zip(means).zip(&std) {
                let drawn: f32 = StandardNormal.sample(noise);
                *action = mean + std * drawn;
                squares += ((*action - mean) / std).powi(2);
            }
            *log_prob = -0.5 * squares - constant;
        }
        Ok(())
    }

    /// Scales the rewards of a step and, for each truncated environment, adds the discounted value of its final observation,
    /// so that the advantages need one array of ends only. `truncated` `[N]`, `final_observations` `[N, O]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn settle(
        &self,
        rewards: &mut [f32],
        truncated: impl Iterator<Item = bool>,
        final_observations: &[f32],
    ) -> Result<()> {
        rewards.iter_mut().for_each(|reward| *reward *= self.config.reward_scale as f32);
        let rows: Vec<usize> = truncated.enumerate().filter_map(|(row, cut)| cut.then_some(row)).collect();
        if rows.is_empty() {
            return Ok(());
        }
        let size = self.policy.observation_size();
        let observations: Vec<f32> =
            rows.iter().flat_map(|row| &final_observations[row * size..(row + 1) * size]).copied().collect();
        let mut values = vec![0.0; rows.len()];
        self.policy.values(&observations, &mut values)?;
        for (row, value) in rows.into_iter().zip(values) {
            rewards[row] += self.config.gamma as f32 * value;
        }
        Ok(())
    }

    /// Learns from a rollout that this policy has collected, then takes its observations into the normaliser, which stays
    /// the same during collection and update: so the first minibatch still sees the very policy that acted.
    ///
    /// # Errors
    /// A loss, gradient or weight that is not finite; the policy must not be used or saved then.
    pub fn update(&mut self, rollout: &mut Rollout, iteration: u64) -> Result<UpdateStats> {
        let (last_observations, last_values) = rollout.after_last();
        self.policy.values(last_observations, last_values)?;
        let (batch, explained_variance) = self.batch(rollout)?;
        let old_std = self.policy.log_std().as_detached_tensor().exp()?;
        let size = rollout.samples() / self.config.minibatches;
        let mut shuffle = rng::stream(self.seed, "shuffle", iteration);
        let mut order: Vec<u32> = (0..rollout.samples() as u32).collect();
        let mut stats = UpdateStats::default();
        for epoch in 0..self.config.epochs {
            order.shuffle(&mut shuffle);
            for (part, indices) in order.chunks_exact(size).enumerate() {
                let minibatch = batch.select(indices)?;
                let first = (epoch, part) == (0, 0);
                self.minibatch_step(&minibatch, &old_std, first, &mut stats)
                    .with_context(|| format!("iteration {iteration}, epoch {epoch}, minibatch {part}"))?;
            }
        }
        self.check_weights().with_context(|| format!("iteration {iteration}"))?;
        stats.average((self.config.epochs * self.config.minibatches) as f64);
        let std = self.policy.std()?;
        stats.std = std.iter().copied().map(f64::from).sum::<f64>() / std.len() as f64;
        (stats.explained_variance, stats.learning_rate) = (explained_variance, self.learning_rate);
        let collected = rollout.samples() * self.policy.observation_size();
        self.policy.normalizer.update(&rollout.observations[..collected]);
        Ok(stats)
    }

    /// The whole rollout as tensors, with normalised observations and advantages, and the explained variance.
    fn batch(&self, rollout: &Rollout) -> Result<(Minibatch, f64)> {
        let samples = rollout.samples();
        let (mut advantages, mut returns) = (vec![0.0; samples], vec![0.0; samples]);
        let factors = [self.config.gamma as f32, self.config.lambda as f32];
        gae(factors, &rollout.rewards, &rollout.values, &rollout.dones, &mut advantages, &mut returns);
        let (_, residual) = mean_and_variance(&advantages);
        let (_, spread) = mean_and_variance(&returns);
        standardize(&mut advantages);

        let rows = |values: &[f32], width: usize| Tensor::from_slice(values, (samples, width), &Device::Cpu);
        let column = |values: &[f32]| Tensor::from_slice(values, samples, &Device::Cpu);
        let actions = self.policy.action_size();
        let batch = Minibatch {
            observations: self.policy.normalized(&rollout.observations[..samples * self.policy.observation_size()])?,
            actions: rows(&rollout.actions, actions)?,
            old_means: rows(&rollout.means, actions)?,
            old_log_probs: column(&rollout.log_probs)?,
            old_values: column(&rollout.values[..samples])?,
            advantages: column(&advantages)?,
            returns: column(&returns)?,
        };
        Ok((batch, if spread > 0.0 { 1.0 - residual / spread } else { f64::NAN }))
    }

    /// One gradient step; adds its figures to `stats`.
    fn minibatch_step(
        &mut self,
        batch: &Minibatch,
        old_std: &Tensor,
        first: bool,
        stats: &mut UpdateStats,
    ) -> Result<()> {
        let [actor, critic] = self.policy.nets();
        let means = actor.forward(&batch.observations)?;
        let values = critic.forward(&batch.observations)?.squeeze(1)?;
        let log_std = self.policy.log_std().as_tensor();
        let losses = loss::losses(&self.config, batch, [&means, &values], [log_std, old_std])?;
        let [total, kl] = [scalar(&losses.total)?, scalar(&losses.kl)?];
        if !total.is_finite() {
            bail!("the loss is {total}: the training has failed and stops here");
        }
        let grads = losses.total.backward()?;
        let norm = adam::global_norm(self.policy.parameters(), &grads)?;
        if !norm.is_finite() {
            bail!("the norm of the gradient is {norm}: the training has failed and stops here");
        }
        self.adapt_learning_rate(kl);
        // As in PyTorch's clip_grad_norm_, with its constant against a division by zero.
        let scale = (self.config.max_grad_norm / (norm + 1e-6)).min(1.0);
        self.adam.step(self.policy.parameters(), &grads, self.learning_rate, scale)?;
        stats.add(&self.config, &losses, kl, norm, first)
    }

    fn check_weights(&self) -> Result<()> {
        for (name, var) in self.policy.parameters() {
            let sound = var.flatten_all()?.to_vec1::<f32>()?.iter().all(|x| x.is_finite());
            ensure!(sound, "the step has made `{name}` infinite or NaN: the training has failed and stops here");
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
        } else if kl > 0.0 && kl < 0.5 * desired {
            self.learning_rate = (self.learning_rate * 1.5).min(highest);
        }
    }
}

impl UpdateStats {
    fn add(&mut self, config: &PpoConfig, losses: &Losses, kl: f64, grad_norm: f64, first: bool) -> Result<()> {
        let ratios = losses.ratios.to_vec1::<f32>()?;
        let error = |ratio: &f32| f64::from((ratio - 1.0).abs());
        if first {
            (self.first_kl, self.first_ratio_error) = (kl, ratios.iter().map(error).fold(0.0, f64::max));
        }
        let clipped = ratios.iter().filter(|ratio| error(ratio) > config.clip).count();
        self.policy_loss += scalar(&losses.policy)?;
        self.value_loss += scalar(&losses.value)?;
        self.entropy += scalar(&losses.entropy)?;
        self.kl += kl;
        self.clip_fraction += clipped as f64 / ratios.len() as f64;
        self.grad_norm += grad_norm;
        Ok(())
    }

    fn average(&mut self, count: f64) {
        for sum in [
            &mut self.policy_loss,
            &mut self.value_loss,
            &mut self.entropy,
            &mut self.kl,
            &mut self.clip_fraction,
            &mut self.grad_norm,
        ] {
            *sum /= count;
        }
    }
}

impl Minibatch {
    /// The samples with these indices.
    fn select(&self, indices: &[u32]) -> Result<Self> {
        let indices = Tensor::from_slice(indices, indices.len(), &Device::Cpu)?;
        let pick = |tensor: &Tensor| tensor.index_select(&indices, 0);
        Ok(Self {
            observations: pick(&self.observations)?,
            actions: pick(&self.actions)?,
            old_means: pick(&self.old_means)?,
            old_log_probs: pick(&self.old_log_probs)?,
            old_values: pick(&self.old_values)?,
            advantages: pick(&self.advantages)?,
            returns: pick(&self.returns)?,
        })
    }
}

fn scalar(tensor: &Tensor) -> Result<f64> {
    Ok(f64::from(tensor.to_scalar::<f32>()?))
}

fn mean_and_variance(values: &[f32]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().copied().map(f64::from).sum::<f64>() / count;
    (mean, values.iter().map(|&x| (f64::from(x) - mean).powi(2)).sum::<f64>() / count)
}

/// Gives the values mean 0 and standard deviation 1.
fn standardize(values: &mut [f32]) {
    let (mean, variance) = mean_and_variance(values);
    let scale = 1.0 / (variance.sqrt() + 1e-8);
    values.iter_mut().for_each(|x| *x = ((f64::from(*x) - mean) * scale) as f32);
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
        for (kl, factor) in [(0.021, 1.0 / 1.5), (0.019, 1.0), (0.006, 1.0), (0.004, 1.5), (0.0, 1.0)] {
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
