//! What learning costs on this machine, and what its bare matrix products cost: the limit it is measured against.

use std::time::Instant;

use anyhow::Result;
use rayon::prelude::*;

use super::kernels::{Matrix, Multiplier, ROWS};
use super::{Policy, Ppo, Rollout};

/// Seconds after which, from the third on, no further gradient step is timed.
const LIMIT: f64 = 5.0;

/// Times gradient steps (gathering, forward, backward and Adam, both nets) on a minibatch of a collected rollout, up to
/// `repeats` of them; seconds for each.
///
/// # Errors
/// A loss or gradient that is not finite.
pub fn time_gradient_steps(ppo: &mut Ppo, rollout: &mut Rollout, repeats: usize) -> Result<Vec<f64>> {
    ppo.prepare(rollout);
    ppo.backend.begin(&ppo.policy, rollout);
    // Samples from all over the rollout, as a shuffled minibatch has them.
    let (samples, step) = (rollout.samples(), ppo.config.minibatches);
    let minibatch: Vec<u32> = (0..samples as u32).step_by(step).take(samples / step).collect();
    let mut seconds = Vec::new();
    while seconds.len() < repeats && (seconds.len() < 3 || seconds.iter().sum::<f64>() < LIMIT) {
        let taken = rayon::scope(|_| {
            let start = Instant::now();
            ppo.minibatch_step(rollout, &minibatch, false).map(|_| start.elapsed())
        });
        seconds.push(taken?.as_secs_f64());
    }
    Ok(seconds)
}

/// The matrix products of one forward and backward pass: sizes of weights `[outputs, inputs]`, and whether the gradient of the
/// inputs is needed, which it is not for observations.
fn products(policy: &Policy) -> impl Iterator<Item = (usize, usize, bool)> {
    let nets = [&policy.layout.actor, &policy.layout.critic];
    nets.into_iter().flat_map(|layers| layers.iter().enumerate().map(|(i, layer)| (layer.outputs, layer.inputs, i > 0)))
}

/// Floating-point operations of those products for one sample, both nets.
pub fn flops_per_sample(policy: &Policy) -> f64 {
    products(policy).map(|(o, i, inner)| (if inner { 6 } else { 4 } * o * i) as f64).sum()
}

/// Times the matrix products of one forward and backward pass of the policy on `samples` samples, on all threads, on numbers that
/// lie in the caches as far as they fit; for each repeat 10⁹ floating-point operations per second.
pub fn matmul_gflops(ppo: &Ppo, samples: usize, repeats: usize) -> Vec<f64> {
    let (policy, arithmetic, blocks) = (&ppo.policy, ppo.arithmetic, samples.div_ceil(ROWS));
    let widest = products(policy).map(|(o, i, _)| o.max(i)).max().expect("a policy has layers");
    let pass = |_: usize| {
        let (x, dz) = (vec![0.5f32; ROWS * widest], vec![0.1f32; ROWS * widest]);
        let (mut out, weights) = (vec![0.0; (ROWS * widest).max(widest * widest)], vec![0.01f32; widest * widest]);
        let mut multiplier = Multiplier::new(arithmetic);
        let start = Instant::now();
        for (o, i, inner) in products(policy) {
            let weight = Matrix::new(&weights[..o * i], o, i);
            let (x, dz) = (Matrix::new(&x[..ROWS * i], ROWS, i), Matrix::new(&dz[..ROWS * o], ROWS, o));
            multiplier.product(&mut out[..ROWS * o], x, weight.transposed(), false);
            multiplier.product(&mut out[..o * i], dz.transposed(), x, true);
            if inner {
                multiplier.product(&mut out[..ROWS * i], dz, weight, false);
            }
        }
        start.elapsed().as_secs_f64()
    };
    let threads = rayon::current_num_threads().min(blocks) as f64;
    (0..repeats)
        .map(|_| {
            let seconds: f64 = (0..blocks).into_par_iter().with_max_len(1).map(pass).sum();
            1e-9 * flops_per_sample(policy) * (blocks * ROWS) as f64 * threads / seconds
        })
        .collect()
}
