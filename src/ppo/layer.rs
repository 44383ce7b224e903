//! A linear layer with its activation as one operation of candle's graph, forward and backward.

use anyhow::Context;
use candle_core::{CpuStorage, CustomOp3, Error, Layout, Result, Shape, Storage, Tensor};
use gemm::{Parallelism, gemm};

use super::elementwise::{add_bias_activate, backward_activate, slope_from_output};
use crate::config::Activation;

/// `activation(x · weightᵀ + bias)` for `x` `[B, I]`, `weight` `[O, I]`, `bias` `[O]`.
#[derive(Clone, Copy)]
pub struct FusedLinear {
    /// None for a last layer.
    pub activation: Option<Activation>,
}

impl FusedLinear {
    /// The layer's output `[B, O]`.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn forward(self, x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
        x.apply_op3(weight, bias, self)
    }
}

impl CustomOp3 for FusedLinear {
    fn name(&self) -> &'static str {
        "fused-linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (samples, inputs) = x_layout.shape().dims2()?;
        let (outputs, weight_inputs) = weight_layout.shape().dims2()?;
        if inputs != weight_inputs || bias_layout.shape().dims1()? != outputs {
            candle_core::bail!(
                "fused-linear: got {x_layout:?} for weights {weight_layout:?} and biases {bias_layout:?}"
            );
        }
        let x = Matrix::new(floats(x, x_layout)?, samples, inputs);
        let weight = Matrix::new(floats(weight, weight_layout)?, outputs, inputs);
        let mut y = product(x, weight.transposed());
        add_bias_activate(&mut y, floats(bias, bias_layout)?, self.activation);
        Ok((CpuStorage::F32(y), (samples, outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (samples, inputs) = x.dims2()?;
        let outputs = bias.dims1()?;
        let device = x.device();
        let known = match self.activation {
            Some(activation) if !slope_from_output(activation) => {
                &FusedLinear { activation: None }.forward(&x.detach(), &weight.detach(), &bias.detach())?
            }
            _ => y,
        };
        let mut dz = grad.flatten_all()?.to_vec1::<f32>()?;
        let (known, known_layout) = known.storage_and_layout();
        let db = backward_activate(&mut dz, cpu_floats(&known, known_layout)?, outputs, self.activation);
        let dz = Matrix::new(&dz, samples, outputs);

        let dw = {
            let (x, x_layout) = x.storage_and_layout();
            product(dz.transposed(), Matrix::new(cpu_floats(&x, x_layout)?, samples, inputs))
        };
        let dx = if x.track_op() {
            let (weight, weight_layout) = weight.storage_and_layout();
            let dx = product(dz, Matrix::new(cpu_floats(&weight, weight_layout)?, outputs, inputs));
            Some(Tensor::from_vec(dx, (samples, inputs), device)?)
        } else {
            None
        };
        let dw = Tensor::from_vec(dw, (outputs, inputs), device)?;
        Ok((dx, Some(dw), Some(Tensor::from_vec(db, outputs, device)?)))
    }
}

/// A matrix in a slice.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    data: &'a [f32],
    /// Rows and columns.
    size: [usize; 2],
    /// Distance in `data` between neighbours in a column and in a row.
    strides: [isize; 2],
}

impl<'a> Matrix<'a> {
    /// Row after row.
    fn new(data: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(data.len(), rows * columns, "elements of a matrix");
        Self { data, size: [rows, columns], strides: [columns as isize, 1] }
    }

    fn transposed(self) -> Self {
        let ([rows, columns], [down, right]) = (self.size, self.strides);
        Self { data: self.data, size: [columns, rows], strides: [right, down] }
    }
}

/// The matrix product, row after row.
fn product(lhs: Matrix, rhs: Matrix) -> Vec<f32> {
    let ([m, k], [rhs_rows, n]) = (lhs.size, rhs.size);
    assert_eq!(k, rhs_rows, "columns of the first and rows of the second matrix");
    let mut out: Vec<f32> = Vec::with_capacity(m * n);
    // SAFETY: the strides of `Matrix` stay within its slice, `out` has room for m × n elements with rows of n, and gemm
    // writes each of them without reading it (`read_dst` is false).
    unsafe {
        gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            false,
            lhs.data.as_ptr(),
            lhs.strides[1],
            lhs.strides[0],
            rhs.data.as_ptr(),
            rhs.strides[1],
            rhs.strides[0],
            0.0,
            1.0,
            false,
            false,
            false,
            Parallelism::Rayon(rayon::current_num_threads()),
        );
        out.set_len(m * n);
    }
    out
}

fn floats<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let (start, end) =
        layout.contiguous_offsets().context("fused-linear needs contiguous tensors").map_err(Error::wrap)?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}

fn cpu_floats<'a>(storage: &'a Storage, layout: &Layout) -> Result<&'a [f32]> {
    match storage {
        Storage::Cpu(storage) => floats(storage, layout),
        _ => candle_core::bail!("fused-linear runs on the CPU"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;
    use candle_core::{Device, Var};

    fn random(shape: &[usize], index: u64) -> Var {
        let mut rng = rng::stream(0, "test", index);
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect();
        Var::from_vec(values, shape, &Device::Cpu).unwrap()
    }

    #[test]
    fn results_are_the_same_bits_for_any_number_of_threads() {
        let [x, w, b] = [&[1000, 157][..], &[64, 157], &[64]].map(|shape| random(shape, 1));
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let y = FusedLinear { activation: Some(Activation::Elu) }.forward(&x, &w, &b).unwrap();
                let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
                [&w, &b, &x].map(|var| grads.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap())
            })
        };
        let one = run(1);
        assert_eq!(one, run(2));
        assert_eq!(one, run(8));
    }
}
