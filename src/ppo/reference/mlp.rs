//! A network of candle's own layers.

use candle_core::{Module, Result, Tensor, Var};
use candle_nn::Linear;

use crate::config::Activation;

/// One network on the present parameters.
pub struct Mlp {
    layers: Vec<Linear>,
    activation: Activation,
}

impl Mlp {
    /// The net of these parameters, weight and bias of each layer. A `frozen` one builds no graph.
    pub fn new(parameters: &[(String, Var)], activation: Activation, frozen: bool) -> Self {
        let tensor = |var: &Var| if frozen { var.as_detached_tensor() } else { var.as_tensor().clone() };
        let layer = |pair: &[(String, Var)]| Linear::new(tensor(&pair[0].1), Some(tensor(&pair[1].1)));
        Self { layers: parameters.chunks_exact(2).map(layer).collect(), activation }
    }

    /// `[B, I]` → `[B, outputs]`, with the activation after every layer but the last.
    ///
    /// # Errors
    /// Inputs of another width than the first layer's.
    pub fn forward(&self, inputs: &Tensor) -> Result<Tensor> {
        let (last, hidden) = self.layers.split_last().expect("a net has layers");
        let mut x = inputs.clone();
        for layer in hidden {
            let z = layer.forward(&x)?;
            x = match self.activation {
                Activation::Elu => z.elu(1.0)?,
                Activation::Relu => z.relu()?,
                Activation::Silu => z.silu()?,
                Activation::Tanh => z.tanh()?,
            };
        }
        last.forward(&x)
    }
}
