//! What acts: two MLPs, actor and critic, a standard deviation that does not depend on the state, and the normaliser.

use anyhow::Result;
use candle_core::{DType, Device, Module, Tensor, Var};
use candle_nn::Linear;
use rand::RngExt;

use super::Normalizer;
use super::layer::FusedLinear;
use crate::config::{Activation, Layers, PpoConfig};
use crate::rng::{self, Rng};

/// The last layer of the actor starts this much smaller, so that the first actions are near the middle of their range.
const LAST_ACTOR_LAYER: f32 = 0.1;

/// A Gaussian policy with diagonal covariance, and the value of states under it.
pub struct Policy {
    parameters: Vec<(String, Var)>,
    /// Reads raw observations.
    pub normalizer: Normalizer,
    depth: usize,
    activation: Activation,
    kind: Layers,
    sizes: [usize; 2],
}

/// One network on the present parameters.
pub struct Mlp {
    /// Weight and bias of each layer.
    layers: Vec<[Tensor; 2]>,
    activation: Activation,
    kind: Layers,
}

impl Mlp {
    /// `[B, I]` → `[B, outputs]`, with the activation after every layer but the last.
    ///
    /// # Errors
    /// Inputs of another width than the first layer's.
    pub fn forward(&self, inputs: &Tensor) -> candle_core::Result<Tensor> {
        let mut x = inputs.clone();
        for (i, [weight, bias]) in self.layers.iter().enumerate() {
            let activation = (i + 1 < self.layers.len()).then_some(self.activation);
            x = match self.kind {
                Layers::Fused => FusedLinear { activation }.forward(&x, weight, bias)?,
                Layers::Candle => candle_layer(&x, weight, bias, activation)?,
            };
        }
        Ok(x)
    }
}

/// The same as [`FusedLinear`], of candle's own parts.
fn candle_layer(
    x: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    activation: Option<Activation>,
) -> candle_core::Result<Tensor> {
    let z = Linear::new(weight.clone(), Some(bias.clone())).forward(x)?;
    match activation {
        None => Ok(z),
        Some(Activation::Elu) => z.elu(1.0),
        Some(Activation::Relu) => z.relu(),
        Some(Activation::Silu) => z.silu(),
        Some(Activation::Tanh) => z.tanh(),
    }
}

impl Policy {
    /// A new policy for observations and actions of these sizes, its weights drawn from `seed`.
    ///
    /// Weights and biases are uniform in ± 1/√inputs, as in PyTorch's `Linear`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn new(config: &PpoConfig, observation_size: usize, action_size: usize, seed: u64) -> Result<Self> {
        let mut rng = rng::stream(seed, "weights", 0);
        let mut parameters = Vec::new();
        for (net, outputs, last_scale) in [("actor", action_size, LAST_ACTOR_LAYER), ("critic", 1, 1.0)] {
            let mut inputs = observation_size;
            for (layer, &size) in config.hidden.iter().chain([&outputs]).enumerate() {
                let bound = 1.0 / (inputs as f32).sqrt();
                let scale = if layer == config.hidden.len() { last_scale } else { 1.0 };
                let weight = uniform(&mut rng, bound * scale, &[size, inputs])?;
                parameters.push((format!("{net}.{layer}.weight"), weight));
                parameters.push((format!("{net}.{layer}.bias"), uniform(&mut rng, bound, &[size])?));
                inputs = size;
            }
        }
        let log_std = Tensor::full(config.init_std.ln() as f32, action_size, &Device::Cpu)?;
        parameters.push(("log_std".into(), Var::from_tensor(&log_std)?));
        Ok(Self {
            parameters,
            normalizer: Normalizer::new(observation_size),
            depth: config.hidden.len() + 1,
            activation: config.activation,
            kind: config.layers,
            sizes: [observation_size, action_size],
        })
    }

    /// The parameters by name, always in the same order.
    pub fn parameters(&self) -> &[(String, Var)] {
        &self.parameters
    }

    /// The number of weights, biases and standard deviations.
    pub fn parameter_count(&self) -> usize {
        self.parameters.iter().map(|(_, var)| var.elem_count()).sum()
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.sizes[0]
    }

    /// Numbers in an action.
    pub fn action_size(&self) -> usize {
        self.sizes[1]
    }

    /// Actor and critic with gradients.
    pub fn nets(&self) -> [Mlp; 2] {
        self.build(|var| var.as_tensor().clone())
    }

    /// Actor and critic without gradients: a forward pass builds no graph. They follow later updates of the parameters.
    pub fn frozen_nets(&self) -> [Mlp; 2] {
        self.build(|var| var.as_tensor().detach())
    }

    fn build(&self, tensor: impl Fn(&Var) -> Tensor) -> [Mlp; 2] {
        let pairs: Vec<&[(String, Var)]> = self.parameters.chunks_exact(2).collect();
        [&pairs[..self.depth], &pairs[self.depth..]].map(|net| Mlp {
            layers: net.iter().map(|pair| [tensor(&pair[0].1), tensor(&pair[1].1)]).collect(),
            activation: self.activation,
            kind: self.kind,
        })
    }

    /// The logarithm of the standard deviations, `[A]`.
    pub fn log_std(&self) -> &Var {
        &self.parameters.last().expect("log_std is the last parameter").1
    }

    /// The standard deviations, `[A]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn std(&self) -> Result<Vec<f32>> {
        Ok(self.log_std().as_detached_tensor().exp()?.to_vec1()?)
    }

    /// Raw observations `[B, O]`, normalised, as a tensor.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn normalized(&self, raw: &[f32]) -> Result<Tensor> {
        let mut normalized = vec![0.0; raw.len()];
        self.normalizer.apply(raw, &mut normalized);
        let [size, _] = self.sizes;
        Ok(Tensor::from_vec(normalized, (raw.len() / size, size), &Device::Cpu)?)
    }

    /// Writes the mean actions `[B, A]` for raw observations `[B, O]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn means(&self, observations: &[f32], out: &mut [f32]) -> Result<()> {
        let [actor, _] = self.frozen_nets();
        copy_out(&actor.forward(&self.normalized(observations)?)?, out)
    }

    /// Writes the values `[B]` of raw observations `[B, O]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn values(&self, observations: &[f32], out: &mut [f32]) -> Result<()> {
        let [_, critic] = self.frozen_nets();
        copy_out(&critic.forward(&self.normalized(observations)?)?, out)
    }
}

/// Copies a whole tensor into a slice of the same number of elements.
pub(super) fn copy_out(tensor: &Tensor, out: &mut [f32]) -> Result<()> {
    out.copy_from_slice(&tensor.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>()?);
    Ok(())
}

fn uniform(rng: &mut Rng, bound: f32, shape: &[usize]) -> Result<Var> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| bound * (2.0 * rng.random::<f32>() - 1.0)).collect();
    Ok(Var::from_vec(values, shape, &Device::Cpu)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    /// Largest difference relative to the largest number.
    fn difference(a: &Tensor, b: &Tensor) -> f32 {
        let numbers = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let largest = |t: Tensor| numbers(t).into_iter().fold(0.0f32, |most, x| most.max(x.abs()));
        largest((a - b).unwrap()) / largest(b.clone())
    }

    #[test]
    fn outputs_and_gradients_of_fused_layers_are_those_of_candles_layers() {
        for activation in [Activation::Elu, Activation::Relu, Activation::Silu, Activation::Tanh] {
            let mut config = Config::resolve(None, &[]).unwrap().ppo;
            (config.activation, config.hidden) = (activation, vec![64, 33]);
            let mut policy = Policy::new(&config, 157, 20, 3).unwrap();
            let inputs = uniform(&mut rng::stream(0, "test", 0), 3.0, &[300, 157]).unwrap();
            let [fused, candle] = [Layers::Fused, Layers::Candle].map(|kind| {
                policy.kind = kind;
                let [actor, critic] = policy.nets();
                let outputs = [actor.forward(&inputs).unwrap(), critic.forward(&inputs).unwrap()];
                let loss = outputs.iter().map(|y| (y - 0.3).unwrap().sqr().unwrap().mean_all().unwrap());
                let grads = loss.reduce(|a, b| (a + b).unwrap()).unwrap().backward().unwrap();
                (outputs, grads)
            });
            for (a, b) in fused.0.iter().zip(&candle.0) {
                assert!(difference(a, b) < 1e-5, "{activation:?}: outputs");
            }
            let all = policy.parameters().iter().filter(|(name, _)| name != "log_std");
            for (name, var) in all.map(|(name, var)| (name.as_str(), var)).chain([("inputs", &inputs)]) {
                let error = difference(fused.1.get(var).unwrap(), candle.1.get(var).unwrap());
                assert!(error < 1e-4, "{activation:?}: gradient of {name} off by {error}");
            }
        }
    }
}
