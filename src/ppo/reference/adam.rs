//! Adam with moments that can be saved, and the global norm of the gradients.

use anyhow::Result;
use candle_core::backprop::GradStore;
use candle_core::{Tensor, Var};

use super::super::backend::{BETA1, BETA2, EPSILON};

/// D. P. Kingma, J. Ba, "Adam: a method for stochastic optimization" (2015), algorithm 1.
pub struct Adam {
    /// For each parameter the running means of the gradient and of its square.
    moments: Vec<[Tensor; 2]>,
    steps: u64,
}

impl Adam {
    /// An optimizer that has not taken a step.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn new(parameters: &[(String, Var)]) -> Result<Self> {
        let moments: candle_core::Result<_> =
            parameters.iter().map(|(_, var)| Ok([var.zeros_like()?, var.zeros_like()?])).collect();
        Ok(Self { moments: moments?, steps: 0 })
    }

    /// For each parameter, in order, the running means of the gradient and of its square.
    pub fn moments(&self) -> &[[Tensor; 2]] {
        &self.moments
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Goes on from saved moments.
    pub fn restore(&mut self, moments: Vec<[Tensor; 2]>, steps: u64) {
        (self.moments, self.steps) = (moments, steps);
    }

    /// Moves the parameters one step against the gradients, each of which is first multiplied by `scale`, at the `rate` of a
    /// parameter of this name.
    ///
    /// # Errors
    /// Shapes that do not match the parameters this was made for.
    pub fn step(
        &mut self,
        parameters: &[(String, Var)],
        grads: &GradStore,
        rate: impl Fn(&str) -> f64,
        scale: f64,
    ) -> Result<()> {
        self.steps += 1;
        let correction1 = 1.0 - BETA1.powi(self.steps as i32);
        let correction2 = 1.0 - BETA2.powi(self.steps as i32);
        for ((name, var), moments) in parameters.iter().zip(&mut self.moments) {
            let Some(grad) = grads.get(var) else { continue };
            // A gradient keeps the graph it came from; detached, the moments do not grow a chain of them.
            let grad = (grad.detach() * scale)?;
            let mean = ((&moments[0] * BETA1)? + (&grad * (1.0 - BETA1))?)?;
            let square = ((&moments[1] * BETA2)? + (grad.sqr()? * (1.0 - BETA2))?)?;
            let root = ((&square / correction2)?.sqrt()? + EPSILON)?;
            let update = ((&mean * (rate(name) / correction1))? / root)?;
            var.set(&(var.as_detached_tensor() - update)?)?;
            *moments = [mean, square];
        }
        Ok(())
    }
}

/// The Euclidean norm of all gradients together.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn global_norm(parameters: &[(String, Var)], grads: &GradStore) -> Result<f64> {
    let mut sum = 0.0;
    for (_, var) in parameters {
        if let Some(grad) = grads.get(var) {
            sum += f64::from(grad.sqr()?.sum_all()?.to_scalar::<f32>()?);
        }
    }
    Ok(sum.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// The numbers are those of this program (PyTorch):
    /// ```python
    /// import torch
    /// x = torch.tensor([1.0, -2.0, 3.0], requires_grad=True)
    /// adam = torch.optim.Adam([x], lr=0.1)
    /// for _ in range(3):
    ///     adam.zero_grad()
    ///     (x ** 2 * torch.tensor([1.0, 0.5, 0.1])).sum().backward()
    ///     norm = torch.nn.utils.clip_grad_norm_([x], 1.0)
    ///     adam.step()
    ///     print(norm.item(), x.tolist())
    /// ```
    #[test]
    fn steps_with_clipped_gradients_match_pytorch() {
        let x = Var::new(&[1.0f32, -2.0, 3.0], &Device::Cpu).unwrap();
        let weights = Tensor::new(&[1.0f32, 0.5, 0.1], &Device::Cpu).unwrap();
        let parameters = [("x".to_owned(), x.clone())];
        let mut adam = Adam::new(&parameters).unwrap();
        for (expected_norm, expected) in GOLDEN {
            let loss = (x.as_tensor().sqr().unwrap() * &weights).unwrap().sum_all().unwrap();
            let grads = loss.backward().unwrap();
            let norm = global_norm(&parameters, &grads).unwrap();
            adam.step(&parameters, &grads, |_| 0.1, (1.0 / (norm + 1e-6)).min(1.0)).unwrap();
            assert!((norm - expected_norm).abs() < 1e-5, "norm {norm}");
            for (found, expected) in x.to_vec1::<f32>().unwrap().iter().zip(expected) {
                assert!((found - expected).abs() < 1e-6, "{found} instead of {expected}");
            }
        }
    }

    const GOLDEN: [(f64, [f32; 3]); 3] = [
        (2.891_366_5, [0.900_000_04, -1.9, 2.9]),
        (2.680_746_3, [0.800_088_5, -1.799_943_9, 2.799_913_2]),
        (2.472_639_3, [0.700_356_66, -1.699_788_2, 2.699_673_2]),
    ];
}
