//! What learning costs on this machine, and what its bare matrix products cost: the limit it is measured against.

use std::hint::black_box;
use std::time::Instant;

use anyhow::Result;
use candle_core::{Device, Tensor};

use super::{Policy, Ppo, Rollout, UpdateStats};

/// Times gradient steps (forward, backward and Adam, both nets) on minibatches of a collected rollout; seconds for each.
///
/// # Errors
/// A loss or gradient that is not finite.
pub fn time_gradient_steps(ppo: &mut Ppo, rollout: &Rollout, repeats: usize) -> Result<Vec<f64>> {
    let (batch, _) = ppo.batch(rollout)?;
    let old_std = ppo.policy.log_std().as_detached_tensor().exp()?;
    let size = rollout.samples() / ppo.config.minibatches;
    let indices: Vec<u32> = (0..size as u32).collect();
    let minibatch = batch.select(&indices)?;
    let mut seconds = Vec::new();
    for _ in 0..repeats {
        let start = Instant::now();
        ppo.minibatch_step(&minibatch, &old_std, false, &mut UpdateStats::default())?;
        seconds.push(start.elapsed().as_secs_f64());
    }
    Ok(seconds)
}

/// Times the matrix products of one forward and backward pass of `policy` on `samples` samples, as candle does them; for each
/// repeat 10⁹ floating-point operations per second.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn matmul_gflops(policy: &Policy, samples: usize, repeats: usize) -> Result<Vec<f64>> {
    let mut operands = Vec::new();
    let mut flops = 0.0;
    for (_, var) in policy.parameters().iter().filter(|(_, var)| var.rank() == 2) {
        let (outputs, inputs) = var.dims2()?;
        let weight = Tensor::full(0.01f32, (outputs, inputs), &Device::Cpu)?.contiguous()?;
        let x = Tensor::full(0.5f32, (samples, inputs), &Device::Cpu)?.contiguous()?;
        let grad = Tensor::full(0.1f32, (samples, outputs), &Device::Cpu)?.contiguous()?;
        flops += 6.0 * (samples * inputs * outputs) as f64;
        operands.push((weight, x, grad));
    }
    let mut rates = Vec::new();
    for _ in 0..repeats {
        let start = Instant::now();
        for (weight, x, grad) in &operands {
            black_box(x.matmul(&weight.t()?)?);
            black_box(grad.matmul(weight)?);
            black_box(grad.t()?.matmul(x)?);
        }
        rates.push(1e-9 * flops / start.elapsed().as_secs_f64());
    }
    Ok(rates)
}
