//! The same computation in candle's own tensors and its automatic gradients: slower, the reference that the kernels are
//! compared with, and the one that could run on another device.

mod adam;
mod loss;
mod mlp;

use anyhow::Result;
use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor};

pub use mlp::Mlp;

use super::Policy;
use super::backend::{self, Backend, Moments};
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;
use adam::Adam;
use loss::Minibatch;

/// Gradients and steps by candle.
pub struct Reference {
    config: PpoConfig,
    adam: Adam,
    /// All samples of the rollout.
    batch: Option<Minibatch>,
    /// `[A]`, of the actions in the rollout.
    old_std: Option<Tensor>,
    grads: Option<GradStore>,
}

impl Reference {
    /// For the parameters of `policy`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn new(config: &PpoConfig, policy: &Policy) -> Result<Self> {
        let adam = Adam::new(policy.parameters())?;
        Ok(Self { config: config.clone(), adam, batch: None, old_std: None, grads: None })
    }
}

impl Backend for Reference {
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) -> Result<()> {
        let samples = rollout.samples();
        let array =
            |of: fn(&RolloutBlock) -> &[f32]| -> Vec<f32> { rollout.blocks.iter().flat_map(of).copied().collect() };
        let rows = |values: Vec<f32>| {
            let width = values.len() / samples;
            Tensor::from_vec(values, (samples, width), &Device::Cpu)
        };
        let column = |values: Vec<f32>| Tensor::from_vec(values, samples, &Device::Cpu);
        let raw = array(RolloutBlock::acted_on);
        let mut observations = vec![0.0; raw.len()];
        policy.normalizer.scaling().apply(&raw, &mut observations);
        self.batch = Some(Minibatch {
            observations: rows(observations)?,
            actions: rows(array(|block| &block.actions))?,
            old_means: rows(array(|block| &block.means))?,
            noise_scales: rows(array(|block| &block.noise_scales))?,
            old_log_probs: column(array(|block| &block.log_probs))?,
            old_values: column(array(|block| &block.values[..block.samples()]))?,
            advantages: column(array(|block| &block.advantages))?,
            returns: column(array(|block| &block.returns))?,
        });
        self.old_std = Some(policy.log_std().as_detached_tensor().exp()?);
        Ok(())
    }

    fn gradient(&mut self, policy: &Policy, _: &Rollout, samples: &[u32]) -> Result<backend::Losses> {
        let batch = self.batch.as_ref().expect("begin comes first").select(samples)?;
        let old_std = self.old_std.as_ref().expect("begin comes first");
        let [actor, critic] = policy.candle_nets(false);
        let means = actor.forward(&batch.observations)?;
        let values = critic.forward(&batch.observations)?.squeeze(1)?;
        let losses = loss::losses(&self.config, &batch, [&means, &values], [policy.log_std().as_tensor(), old_std])?;
        let grads = losses.total.backward()?;
        let grad_norm = adam::global_norm(policy.parameters(), &grads)?;
        self.grads = Some(grads);
        let ratios = losses.ratios.to_vec1::<f32>()?;
        let errors = || ratios.iter().map(|ratio| f64::from((ratio - 1.0).abs()));
        Ok(backend::Losses {
            total: scalar(&losses.total)?,
            policy: scalar(&losses.policy)?,
            value: scalar(&losses.value)?,
            excess: scalar(&losses.excess)?,
            entropy: scalar(&losses.entropy)?,
            kl: scalar(&losses.kl)?,
            clip_fraction: errors().filter(|&error| error > self.config.clip).count() as f64 / ratios.len() as f64,
            ratio_error: errors().fold(0.0, f64::max),
            grad_norm,
        })
    }

    fn step(&mut self, policy: &Policy, learning_rates: [f64; 2], scale: f64) -> Result<()> {
        let grads = self.grads.take().expect("gradient comes first");
        let rate = |name: &str| learning_rates[usize::from(Policy::is_of_critic(name))];
        self.adam.step(policy.parameters(), &grads, rate, scale)
    }

    fn moments(&self, _: &Policy) -> Result<Moments> {
        Ok(Moments { tensors: self.adam.moments().to_vec(), steps: self.adam.steps() })
    }

    fn restore(&mut self, moments: Moments) -> Result<()> {
        self.adam.restore(moments.tensors, moments.steps);
        Ok(())
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
            noise_scales: pick(&self.noise_scales)?,
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
