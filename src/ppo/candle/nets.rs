//! Actor and critic built from candle's layers, on variables that hold the parameters of a policy.

use std::ops::Range;

use candle_core::backprop::GradStore;
use candle_core::{Device, Result, Tensor, Var};
use candle_nn::{Linear, Sequential, seq};

use super::super::Policy;
use super::super::parameters::Layer;
use crate::config::Activation;

/// The nets of a policy, in differentiable form.
pub(super) struct Nets {
    /// `[M, O]` → `[M, A]`
    pub actor: Sequential,
    /// `[M, O]` → `[M, 1]`
    pub critic: Sequential,
    /// All variables, and the ranges of their values among the parameters of the policy.
    variables: Vec<(Range<usize>, Var)>,
}

impl Nets {
    /// Creates the nets with the current parameters of `policy`.
    ///
    /// # Errors
    /// Fails if candle reports an error.
    pub(super) fn new(policy: &Policy) -> Result<Self> {
        let activation: fn(&Tensor) -> Result<Tensor> = match policy.activation {
            Activation::Elu => |x| x.elu(1.0),
            Activation::Relu => Tensor::relu,
            Activation::Tanh => Tensor::tanh,
        };
        let layout = &policy.layout;
        let mut variables = Vec::new();
        let mut variable = |range: &Range<usize>, shape: &[usize]| {
            let variable = Var::from_slice(&policy.parameters[range.clone()], shape, &Device::Cpu)?;
            variables.push((range.clone(), variable.clone()));
            Ok::<Var, candle_core::Error>(variable)
        };
        let mut net = |layers: &[Layer]| -> Result<Sequential> {
            let mut net = seq();
            for (i, layer) in layers.iter().enumerate() {
                if i > 0 {
                    net = net.add_fn(activation);
                }
                let weight = variable(&layer.weight, &[layer.outputs, layer.inputs])?;
                let bias = variable(&layer.bias, &[layer.outputs])?;
                net = net.add(Linear::new(weight.as_tensor().clone(), Some(bias.as_tensor().clone())));
            }
            Ok(net)
        };
        let (actor, critic) = (net(&layout.actor)?, net(&layout.critic)?);
        Ok(Self { actor, critic, variables })
    }

    /// Writes the gradient of each variable in `grads` to its range of the gradient of all parameters.
    ///
    /// # Errors
    /// Fails if candle reports an error.
    pub(super) fn write_gradient(&self, grads: &GradStore, out: &mut [f32]) -> Result<()> {
        for (range, variable) in &self.variables {
            let out = &mut out[range.clone()];
            match grads.get(variable) {
                Some(grad) => out.copy_from_slice(&grad.flatten_all()?.to_vec1::<f32>()?),
                None => out.fill(0.0),
            }
        }
        Ok(())
    }
}
