//! Adam on slices, in place, on all threads.

use anyhow::Result;
use candle_core::{CpuStorage, InplaceOp1, Layout, Var};
use pulp::Arch;
use rayon::prelude::*;
use std::sync::Mutex;

use super::super::backend::{BETA1, BETA2, EPSILON};

/// Parameters that one task takes.
const CHUNK: usize = 8192;

/// A step of Adam for one parameter: what candle is asked to do with the numbers in its storage.
struct Step<'a> {
    rates: Rates,
    /// Gradient, running mean of it, running mean of its square.
    with: Mutex<(&'a [f32], &'a mut [f32], &'a mut [f32])>,
}

/// The numbers of a step that are the same for all parameters.
#[derive(Clone, Copy)]
pub struct Rates {
    /// What the gradients are multiplied by first.
    pub scale: f32,
    /// The learning rate over the bias correction of the means.
    pub rate: f32,
    /// The reciprocal of the bias correction of the squares.
    pub square: f32,
}

impl Rates {
    /// Of the step with this number, from 1 on.
    pub fn new(step: u64, learning_rate: f64, scale: f64) -> Self {
        let correction = |beta: f64| 1.0 - beta.powi(step as i32);
        Self {
            scale: scale as f32,
            rate: (learning_rate / correction(BETA1)) as f32,
            square: (1.0 / correction(BETA2)) as f32,
        }
    }
}

/// Moves one parameter against its gradient; all four arrays have the same number of elements.
///
/// D. P. Kingma, J. Ba, "Adam: a method for stochastic optimization" (2015), algorithm 1.
///
/// # Errors
/// A parameter that is not of contiguous floats on the CPU.
pub fn step(var: &Var, rates: Rates, grad: &[f32], mean: &mut [f32], square: &mut [f32]) -> Result<()> {
    Ok(var.inplace_op1(&Step { rates, with: Mutex::new((grad, mean, square)) })?)
}

impl InplaceOp1 for Step<'_> {
    fn name(&self) -> &'static str {
        "adam-step"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> candle_core::Result<()> {
        let CpuStorage::F32(numbers) = storage else { candle_core::bail!("adam-step needs floats") };
        let Some((start, end)) = layout.contiguous_offsets() else {
            candle_core::bail!("adam-step needs a whole tensor")
        };
        let mut with = self.with.lock().expect("no step has panicked");
        let (grad, mean, square) = &mut *with;
        let parameters = numbers[start..end].par_chunks_mut(CHUNK).zip(grad.par_chunks(CHUNK));
        let moments = mean.par_chunks_mut(CHUNK).zip(square.par_chunks_mut(CHUNK));
        parameters.zip(moments).for_each(|((x, grad), (mean, square))| self.rates.apply(x, grad, mean, square));
        Ok(())
    }
}

impl Rates {
    fn apply(self, x: &mut [f32], grad: &[f32], mean: &mut [f32], square: &mut [f32]) {
        Arch::new().dispatch(
            #[inline(always)]
            || {
                for (((x, grad), mean), square) in x.iter_mut().zip(grad).zip(mean).zip(square) {
                    let grad = grad * self.scale;
                    *mean = BETA1 as f32 * *mean + (1.0 - BETA1) as f32 * grad;
                    *square = BETA2 as f32 * *square + (1.0 - BETA2) as f32 * grad * grad;
                    *x -= self.rate * *mean / ((*square * self.square).sqrt() + EPSILON as f32);
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// The numbers are those of the PyTorch program at `steps_with_clipped_gradients_match_pytorch` in
    /// `reference/adam.rs`.
    #[test]
    fn steps_with_clipped_gradients_match_pytorch() {
        let x = Var::new(&[1.0f32, -2.0, 3.0], &Device::Cpu).unwrap();
        let (mut mean, mut square) = ([0.0; 3], [0.0; 3]);
        for (i, expected) in GOLDEN.into_iter().enumerate() {
            let numbers = x.to_vec1::<f32>().unwrap();
            let grad = [2.0 * numbers[0], numbers[1], 0.2 * numbers[2]];
            let norm = f64::from(grad.iter().map(|g| g * g).sum::<f32>().sqrt());
            let rates = Rates::new(i as u64 + 1, 0.1, (1.0 / (norm + 1e-6)).min(1.0));
            step(&x, rates, &grad, &mut mean, &mut square).unwrap();
            for (found, expected) in x.to_vec1::<f32>().unwrap().iter().zip(expected) {
                assert!((found - expected).abs() < 1e-6, "{found} instead of {expected}");
            }
        }
    }

    const GOLDEN: [[f32; 3]; 3] = [
        [0.900_000_04, -1.9, 2.9],
        [0.800_088_5, -1.799_943_9, 2.799_913_2],
        [0.700_356_66, -1.699_788_2, 2.699_673_2],
    ];
}
