//! The same computation with candle's tensors, layers and automatic differentiation: slower, the reference for the
//! kernels, and the place to try a change of the algorithm first. No other folder names candle's crates.

mod loss;
mod nets;

use anyhow::Result;
use candle_core::{Device, Module, Tensor};

use super::Policy;
use super::backend::{Backend, Losses};
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;
use crate::ranks::{Minibatch, tree_sum};
use crate::spaces::Spaces;
use loss::{Batch, Gaussian};
use nets::Nets;

/// The gradient backend in candle.
pub(super) struct Reference {
    config: PpoConfig,
}

impl Reference {
    /// Creates the backend with these settings.
    pub(super) fn new(config: &PpoConfig) -> Self {
        Self { config: config.clone() }
    }

    /// Gathers these samples of a rollout.
    fn minibatch(policy: &Policy, rollout: &Rollout, samples: &[u32]) -> Result<Batch> {
        let Spaces { observation_size, action_size, .. } = policy.spaces;
        let array = |width: usize, of: fn(&RolloutBlock) -> &[f32]| -> Vec<f32> {
            let located = samples.iter().map(|&sample| rollout.locate(sample));
            located.flat_map(|(block, i)| &of(block)[RolloutBlock::row(width, i)]).copied().collect()
        };
        let rows = |width: usize, values| Tensor::from_vec(values, (samples.len(), width), &Device::Cpu);
        let column = |of| Tensor::from_vec(array(1, of), samples.len(), &Device::Cpu);
        let raw = array(observation_size, |block| &block.observations);
        let mut observations = vec![0.0; raw.len()];
        policy.input_transform().apply(&raw, &mut observations);
        Ok(Batch {
            observations: rows(observation_size, observations)?,
            actions: rows(action_size, array(action_size, |block| &block.actions))?,
            old_means: rows(action_size, array(action_size, |block| &block.means))?,
            scales: rows(1, array(1, |block| &block.noise_scales))?,
            old_log_probs: column(|block| &block.log_probs)?,
            old_values: column(|block| &block.values)?,
            advantages: column(|block| &block.advantages)?,
            returns: column(|block| &block.returns)?,
        })
    }
}

impl Backend for Reference {
    fn gradient(&mut self, policy: &Policy, rollout: &Rollout, of: &Minibatch, out: &mut [f32]) -> Result<Vec<Losses>> {
        let (mut sums, mut gradients) = (Vec::new(), Vec::new());
        for group in &of.groups {
            let (batch, nets) = (Self::minibatch(policy, rollout, group)?, Nets::new(policy)?);
            let means = nets.actor.forward(&batch.observations)?;
            let values = nets.critic.forward(&batch.observations)?.squeeze(1)?;
            let log_std = Tensor::full(policy.log_std, policy.spaces.action_size, &Device::Cpu)?;
            let new = Gaussian { means, log_std, scales: batch.scales.clone() };
            let losses = loss::losses(&self.config, &batch, &new, &values)?;
            let mut gradient = vec![0.0; out.len()];
            let weight = group.len() as f64 / of.count as f64;
            nets.write_gradient(&(losses.total * weight)?.backward()?, &mut gradient)?;
            gradients.push(gradient);
            let ratios = losses.ratios.to_vec1::<f32>()?;
            let errors = || ratios.iter().map(|ratio| f64::from((ratio - 1.0).abs()));
            let sum = |mean: &Tensor| -> Result<f64> { Ok(f64::from(mean.to_scalar::<f32>()?) * ratios.len() as f64) };
            sums.push(Losses {
                surrogate: -sum(&losses.policy)?,
                value_error: sum(&losses.value)?,
                excess: sum(&losses.excess)?,
                kl: sum(&losses.kl)?,
                clipped: errors().filter(|&error| error > self.config.clip).count() as f64,
                ratio_error: errors().fold(0.0, f64::max),
            });
        }
        tree_sum(out, &gradients.iter().map(|gradient| &gradient[..]).collect::<Vec<_>>());
        Ok(sums)
    }
}
