//! A network on a block of rows: forward and backward, layer by layer, in the cache of one core.

use rayon::prelude::*;

use super::super::parameters;
use super::activation::{add_bias, slopes_and_sums};
use super::bf16::{Order, Packed};
use super::multiplier::{Arithmetic, Multiplier};
use super::product::Matrix;
use crate::config::Activation;

/// The most elements of a product that gemm takes as a small one.
const LARGEST_SMALL: usize = 16 * 16;

/// One network with the current parameters.
pub(crate) struct Net<'a> {
    layers: Vec<Dense<'a>>,
}

/// A dense layer.
struct Dense<'a> {
    /// `[outputs, inputs]`
    weight: Matrix<'a>,
    /// `[inputs, outputs]`: the weight as the forward pass reads it, if a copy was made.
    weight_t: Option<Vec<f32>>,
    /// The weight, transposed and as it is, as products in bf16 read it, if it was packed.
    packed: [Option<Packed>; 2],
    /// `[outputs]`
    bias: &'a [f32],
    inputs: usize,
    outputs: usize,
    activation: Option<Activation>,
}

/// Buffers for passing a block of up to `rows` rows through nets with the same hidden layers.
pub struct Workspace {
    /// `[rows, I]`: inputs of the nets.
    pub inputs: Vec<f32>,
    /// `[rows, outputs]` for each layer.
    outputs: Vec<Vec<f32>>,
    /// `[rows, widest layer]`: gradients with respect to the outputs of a layer and of the layer below it.
    grads: [Vec<f32>; 2],
    multiplier: Multiplier,
    /// The largest number of rows that it holds.
    pub rows: usize,
}

impl Workspace {
    /// Creates a workspace for a net with these layers, or with the same hidden layers and fewer outputs.
    pub fn new(layers: &[parameters::Layer], rows: usize, arithmetic: Arithmetic) -> Self {
        Self {
            inputs: vec![0.0; rows * layers[0].inputs],
            outputs: layers
                .iter()
                .map(|layer| vec![0.0; rows * layer.outputs])
                .collect(),
            grads: Default::default(),
            multiplier: Multiplier::new(arithmetic),
            rows,
        }
    }

    /// The outputs of a net with `outputs` outputs for `rows` rows, and the buffer for the gradient with
    /// respect to them, which the first call makes.
    pub fn outputs_and_grad(&mut self, rows: usize, outputs: usize) -> (&[f32], &mut [f32]) {
        let widest = self
            .outputs
            .iter()
            .map(Vec::len)
            .max()
            .expect("a net has layers");
        self.grads
            .iter_mut()
            .for_each(|grad| grad.resize(widest, 0.0));
        let last = self.outputs.last().expect("a net has layers");
        (
            &last[..rows * outputs],
            &mut self.grads[0][..rows * outputs],
        )
    }
}

impl<'a> Net<'a> {
    /// Creates the net of these layers, whose ranges refer to `parameters`.
    pub(crate) fn new(
        layers: &[parameters::Layer],
        parameters: &'a [f32],
        activation: Activation,
    ) -> Self {
        let layer = |(i, layer): (usize, &parameters::Layer)| Dense {
            weight: Matrix::new(
                &parameters[layer.weight.clone()],
                layer.outputs,
                layer.inputs,
            ),
            weight_t: None,
            packed: [None, None],
            bias: &parameters[layer.bias.clone()],
            inputs: layer.inputs,
            outputs: layer.outputs,
            activation: (i + 1 < layers.len()).then_some(activation),
        };
        Self {
            layers: layers.iter().enumerate().map(layer).collect(),
        }
    }

    /// Gives nets rearranged copies of their weights, which each product would otherwise make anew. The results are the same, bit
    /// for bit. To learn means forward and backward passes of many rows. To act means many forward passes of few rows: to rearrange
    /// the weights for each would take longer than its products.
    pub(crate) fn prepare(nets: &mut [Self], arithmetic: Arithmetic, learns: bool) {
        let mut jobs = Vec::new();
        for layer in nets.iter_mut().flat_map(|net| &mut net.layers) {
            if !learns {
                layer.weight_t = Some(layer.transposed());
            }
            if let Arithmetic::Bf16(_) = arithmetic {
                // The lines of the right operands of the forward and of the backward pass.
                let lines = [
                    Some(layer.weight),
                    learns.then_some(layer.weight.transposed()),
                ];
                for (packed, lines) in layer.packed.iter_mut().zip(lines.into_iter().flatten()) {
                    jobs.extend(packed.insert(Packed::default()).jobs(lines, Order::Pairs));
                }
            }
        }
        jobs.into_par_iter().for_each(|pack| pack());
    }

    /// The number of outputs.
    pub(crate) fn outputs(&self) -> usize {
        self.layers.last().expect("a net has layers").outputs
    }

    /// Runs the first `rows` rows of the inputs through the net and returns its outputs `[rows, outputs]`.
    pub(crate) fn forward<'w>(&self, rows: usize, work: &'w mut Workspace) -> &'w [f32] {
        for (l, layer) in self.layers.iter().enumerate() {
            let (below, outputs) = work.outputs.split_at_mut(l);
            let x = below.last().unwrap_or(&work.inputs);
            let y = &mut outputs[0][..rows * layer.outputs];
            let packed = layer.packed[0].as_ref();
            work.multiplier
                .product(y, layer.x(x, rows), layer.weight_t(rows), packed, false);
            add_bias(y, layer.bias, layer.activation);
        }
        &work.outputs[self.layers.len() - 1][..rows * self.outputs()]
    }

    /// Propagates the gradient with respect to the outputs of the last forward pass, which is in `work`, back through
    /// the net. Writes the gradient of the parameters, in their order, to `gradient`, or adds it if `add` is set.
    pub(crate) fn backward(
        &self,
        rows: usize,
        work: &mut Workspace,
        gradient: &mut [f32],
        add: bool,
    ) {
        let mut rest = gradient;
        let [above, below] = &mut work.grads;
        for (l, layer) in self.layers.iter().enumerate().rev() {
            let at = rest.len() - layer.outputs * (layer.inputs + 1);
            let own = rest.split_off_mut(at..).expect("room for each layer");
            let (weight_grad, bias_grad) = own.split_at_mut(layer.outputs * layer.inputs);

            let grad = &mut above[..rows * layer.outputs];
            if !add {
                bias_grad.fill(0.0);
            }
            slopes_and_sums(
                grad,
                &work.outputs[l][..grad.len()],
                layer.activation,
                bias_grad,
            );
            let grad = Matrix::new(grad, rows, layer.outputs);
            let x = if l == 0 {
                &work.inputs
            } else {
                &work.outputs[l - 1]
            };
            work.multiplier
                .product(weight_grad, grad.transposed(), layer.x(x, rows), None, add);
            if l > 0 {
                let out = &mut below[..rows * layer.inputs];
                let packed = layer.packed[1].as_ref();
                work.multiplier
                    .product(out, grad, layer.weight, packed, false);
                std::mem::swap(above, below);
            }
        }
    }
}

impl Dense<'_> {
    /// A copy of the weight, transposed.
    fn transposed(&self) -> Vec<f32> {
        let data = self.weight.data();
        let mut weight_t = Vec::with_capacity(data.len());
        (0..self.inputs)
            .for_each(|input| weight_t.extend(data[input..].iter().step_by(self.inputs)));
        weight_t
    }

    /// The transposed weight, for a product with `rows` rows.
    fn weight_t(&self, rows: usize) -> Matrix<'_> {
        // gemm adds up single rows and small products in an order that depends on how the weight is stored.
        let ordered = rows > 1 && rows * self.outputs > LARGEST_SMALL;
        match self.weight_t.as_ref().filter(|_| ordered) {
            Some(weight_t) => Matrix::new(weight_t, self.inputs, self.outputs),
            None => self.weight.transposed(),
        }
    }

    fn x<'x>(&self, x: &'x [f32], rows: usize) -> Matrix<'x> {
        Matrix::new(&x[..rows * self.inputs], rows, self.inputs)
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::parameters::ParameterLayout;
    use super::*;
    use crate::config::Precision;
    use crate::spaces::Spaces;

    const SPACES: Spaces = Spaces {
        observation_size: 70,
        action_size: 20,
        object_and_goal: None,
        distance: |_, _| 0.0,
    };

    #[test]
    fn packed_weights_change_no_bit() {
        let Ok(arithmetic) = Arithmetic::new(Precision::Bf16) else {
            return;
        };
        let layout = ParameterLayout::new(&[70, 33], &SPACES);
        let parameters: Vec<f32> = (0..layout.count())
            .map(|i| ((i * 37 % 101) as f32 - 50.0) / 300.0)
            .collect();
        for rows in [1, 32, 50] {
            let [plain, packed] = [false, true].map(|packed| {
                let mut nets = [Net::new(&layout.actor, &parameters, Activation::Elu)];
                if packed {
                    Net::prepare(&mut nets, arithmetic, true);
                }
                let [net] = nets;
                let mut work = Workspace::new(&layout.actor, rows, arithmetic);
                work.inputs
                    .iter_mut()
                    .enumerate()
                    .for_each(|(i, x)| *x = ((i * 61 % 97) as f32 - 48.0) / 20.0);
                let outputs = net.forward(rows, &mut work).to_vec();
                let (_, grad) = work.outputs_and_grad(rows, net.outputs());
                grad.iter_mut()
                    .enumerate()
                    .for_each(|(i, grad)| *grad = (i % 7) as f32 - 3.0);
                let mut gradient = vec![0.0; layout.nets()[0].len()];
                net.backward(rows, &mut work, &mut gradient, false);
                (outputs, gradient)
            });
            assert!(
                plain.1.iter().any(|&x| x != 0.0) && plain == packed,
                "{rows} rows"
            );
        }
    }

    #[test]
    fn copies_of_the_weights_for_few_rows_change_no_bit() {
        let layout = ParameterLayout::new(&[300, 64], &SPACES);
        let parameters: Vec<f32> = (0..layout.count())
            .map(|i| ((i * 37 % 101) as f32 - 50.0) / 300.0)
            .collect();
        let mut work = Workspace::new(&layout.actor, 64, Arithmetic::F32);
        work.inputs
            .iter_mut()
            .enumerate()
            .for_each(|(i, x)| *x = ((i * 61 % 97) as f32 - 48.0) / 20.0);
        for layers in [&layout.actor, &layout.critic] {
            let net = || Net::new(layers, &parameters, Activation::Elu);
            for rows in [1, 2, 5, 13, 32, 64] {
                let expected = net().forward(rows, &mut work).to_vec();
                let mut nets = [net()];
                Net::prepare(&mut nets, Arithmetic::F32, false);
                assert_eq!(nets[0].forward(rows, &mut work), expected, "{rows} rows");
            }
        }
    }
}
