//! What the bare matrix products of a gradient step cost: the limit that the learner is measured against.

use std::hint::black_box;
use std::time::Instant;

use anyhow::Result;
use candle_core::{Device, Tensor};

use super::Policy;

/// Times the products of one forward and backward pass of `policy` on `samples` samples, as candle does them, `repeats`
/// times; the median in 10⁹ floating-point operations per second.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn matmul_gflops(policy: &Policy, samples: usize, repeats: usize) -> Result<f64> {
    let mut operands = Vec::new();
    let mut flops = 0.0;
    for (_, var) in policy.parameters().iter().filter(|(_, var)| var.rank() == 2) {
        let (outputs, inputs) = var.dims2()?;
        let weight = Tensor::full(0.01f32, (outputs, inputs), &Device::Cpu)?;
        let x = Tensor::full(0.5f32, (samples, inputs), &Device::Cpu)?;
        let grad = Tensor::full(0.1f32, (samples, outputs), &Device::Cpu)?;
        flops += 6.0 * (samples * inputs * outputs) as f64;
        operands.push((weight, x, grad));
    }
    let mut seconds = Vec::new();
    for _ in 0..repeats {
        let start = Instant::now();
        for (weight, x, grad) in &operands {
            black_box(x.matmul(&weight.t()?)?);
            black_box(grad.matmul(weight)?);
            black_box(grad.t()?.matmul(x)?);
        }
        seconds.push(start.elapsed().as_secs_f64());
    }
    seconds.sort_by(f64::total_cmp);
    Ok(1e-9 * flops / seconds[repeats / 2])
}
