//! The same computation with candle's tensors, layers and automatic differentiation. It is slower, but it is the
//! reference for the kernels, and the place to try a change of the algorithm first. No other folder names candle's
//! crates.

mod loss;

use std::ops::Range;

use anyhow::Result;
use candle_core::{Device, Module, Tensor, Var};
use candle_nn::Linear;

use super::Policy;
use super::backend::{GradientBackend, Losses};
use super::parameters::Layer;
use super::rollout::{Rollout, RolloutBlock};
use crate::config::{Activation, PpoConfig};
use crate::spaces::Spaces;
use loss::Batch;

/// The gradient backend in candle.
pub struct Reference;

/// Gathers these samples of a rollout.
fn gathered(policy: &Policy, rollout: &Rollout, samples: &[u32]) -> Result<Batch> {
    let Spaces {
        observation_size,
        action_size,
        ..
    } = policy.spaces;
    let array = |width: usize, of: fn(&RolloutBlock) -> &[f32]| -> Vec<f32> {
        let located = samples.iter().map(|&sample| rollout.locate(sample));
        located
            .flat_map(|(block, i)| &of(block)[RolloutBlock::row(width, i)])
            .copied()
            .collect()
    };
    let tensor =
        |width: usize, values| Tensor::from_vec(values, (samples.len(), width), &Device::Cpu);
    let column = |of| tensor(1, array(1, of));
    let raw = array(observation_size, |block| &block.observations);
    let mut observations = vec![0.0; raw.len()];
    policy.perception().apply(&raw, &mut observations);
    Ok(Batch {
        observations: tensor(observation_size, observations)?,
        actions: tensor(action_size, array(action_size, |block| &block.actions))?,
        old_means: tensor(action_size, array(action_size, |block| &block.means))?,
        log_std: Tensor::new(&policy.log_std[..], &Device::Cpu)?,
        scales: column(|block| &block.noise_scales)?,
        old_log_probs: column(|block| &block.log_probs)?,
        old_values: column(|block| &block.values)?,
        advantages: column(|block| &block.advantages)?,
        returns: column(|block| &block.returns)?,
    })
}

impl GradientBackend for Reference {
    fn gradients(
        &mut self,
        policy: &Policy,
        config: &PpoConfig,
        rollout: &Rollout,
        groups: &[&[u32]],
        count: usize,
        gradients: &mut Vec<Vec<f32>>,
    ) -> Result<Vec<Losses>> {
        let mut sums = Vec::new();
        gradients.clear();
        for group in groups {
            let batch = gathered(policy, rollout, group)?;
            let mut variables = Vec::new();
            let means = forward(
                policy,
                &policy.layout.actor,
                &batch.observations,
                &mut variables,
            )?;
            let values = forward(
                policy,
                &policy.layout.critic,
                &batch.observations,
                &mut variables,
            )?;
            let (total, losses) = loss::losses(config, &batch, &means, &values)?;
            sums.push(losses);
            let grads = (total * (group.len() as f64 / count as f64))?.backward()?;
            let mut gradient = vec![0.0; policy.layout.count()];
            for (range, variable) in variables {
                if let Some(grad) = grads.get(&variable) {
                    gradient[range].copy_from_slice(&grad.flatten_all()?.to_vec1::<f32>()?);
                }
            }
            gradients.push(gradient);
        }
        Ok(sums)
    }
}

/// What the net of these layers computes from `x` `[M, O]`. Adds to `variables` the variables that hold its parameters,
/// each with the range of its values among the parameters of the policy.
fn forward(
    policy: &Policy,
    layers: &[Layer],
    x: &Tensor,
    variables: &mut Vec<(Range<usize>, Var)>,
) -> Result<Tensor> {
    let mut x = x.clone();
    for (i, layer) in layers.iter().enumerate() {
        let mut variable = |range: &Range<usize>, shape: &[usize]| -> Result<Tensor> {
            let variable = Var::from_slice(&policy.parameters[range.clone()], shape, &Device::Cpu)?;
            variables.push((range.clone(), variable.clone()));
            Ok(variable.into_inner())
        };
        if i > 0 {
            x = match policy.activation {
                Activation::Elu => x.elu(1.0),
                Activation::Relu => x.relu(),
                Activation::Tanh => x.tanh(),
            }?;
        }
        let weight = variable(&layer.weight, &[layer.outputs, layer.inputs])?;
        let bias = variable(&layer.bias, &[layer.outputs])?;
        x = Linear::new(weight, Some(bias)).forward(&x)?;
    }
    Ok(x)
}
