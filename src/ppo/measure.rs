//! What learning costs on this machine, and what its bare matrix products cost: the limit it is measured against.

use std::hint::black_box;
use std::time::Instant;

use anyhow::Result;
use candle_core::{Device, Tensor};

use super::{Policy, Ppo, Rollout, UpdateStats};

/// Seconds after which, from the third on, no further gradient step is timed.
const LIMIT: f64 = 5.0;

/// Times gradient steps (forward, backward and Adam, both nets) on a minibatch of a collected rollout, up to `repeats` of them;
/// seconds for each.
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
    while seconds.len() < repeats && (seconds.len() < 3 || seconds.iter().sum::<f64>() < LIMIT) {
        let start = Instant::now();
        ppo.minibatch_step(&minibatch, &old_std, false, &mut UpdateStats::default())?;
        seconds.push(start.elapsed().as_secs_f64());
    }
    Ok(seconds)
}

/// The matrix products of one forward and backward pass: sizes of weights `[outputs, inputs]`, and whether the gradient of the
/// inputs is needed, which it is not for observations.
fn products(policy: &Policy) -> impl Iterator<Item = (usize, usize, bool)> {
    let weights = policy.parameters().iter().filter(|(_, var)| var.rank() == 2);
    weights.map(|(name, var)| (var.dims()[0], var.dims()[1], !name.contains(".0.")))
}

/// Floating-point operations of those products for one sample, both nets.
pub fn flops_per_sample(policy: &Policy) -> f64 {
    products(policy).map(|(o, i, inner)| (if inner { 6 } else { 4 } * o * i) as f64).sum()
}

/// Times the matrix products of one forward and backward pass of `policy` on `samples` samples, as candle does them; for each
/// repeat 10⁹ floating-point operations per second.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn matmul_gflops(policy: &Policy, samples: usize, repeats: usize) -> Result<Vec<f64>> {
    let constant = |value: f32, shape: (usize, usize)| Tensor::full(value, shape, &Device::Cpu)?.contiguous();
    let mut operands = Vec::new();
    for (outputs, inputs, inner) in products(policy) {
        let weight = constant(0.01, (outputs, inputs))?;
        operands.push((weight, constant(0.5, (samples, inputs))?, constant(0.1, (samples, outputs))?, inner));
    }
    let mut rates = Vec::new();
    for _ in 0..repeats {
        let start = Instant::now();
        for (weight, x, grad, inner) in &operands {
            black_box(x.matmul(&weight.t()?)?);
            black_box(grad.t()?.matmul(x)?);
            if *inner {
                black_box(grad.matmul(weight)?);
            }
        }
        rates.push(1e-9 * flops_per_sample(policy) * samples as f64 / start.elapsed().as_secs_f64());
    }
    Ok(rates)
}
