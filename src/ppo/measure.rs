//! Measurements of the cost of learning on this machine and, as its limit, of the matrix products alone.

use std::time::Instant;

use anyhow::Result;
use rayon::prelude::*;

use super::Ppo;
use super::kernels::{Matrix, Multiplier, ROWS};
use super::policy::Policy;
use super::rollout::Rollout;
use super::update::Stage;
use crate::os;

/// Seconds after which no further gradient step is timed, once three have been.
const LIMIT: f64 = 5.0;

/// Times up to `repeats` gradient steps (gathering, forward, backward and Adam, both nets) on a minibatch of a
/// collected rollout. The results are the time of each, s, and the share of the time of all threads in which they neither compute nor
/// look for work.
///
/// # Errors
/// Fails if a loss or gradient is not finite.
pub fn time_gradient_steps(
    ppo: &mut Ppo,
    rollout: &mut Rollout,
    repeats: usize,
) -> Result<(Vec<f64>, f64)> {
    ppo.prepare(rollout);
    ppo.backend.begin(&ppo.policy, rollout);
    // Samples from the whole rollout, as in a shuffled minibatch.
    let samples = rollout.samples();
    let step = samples / ppo.config.minibatch_of(samples, rollout.horizon);
    let minibatch: Vec<u32> = (0..samples as u32)
        .step_by(step)
        .take(samples / step)
        .collect();
    let mut seconds = Vec::new();
    let mut all = 0.0;
    let before = os::processor_seconds();
    while seconds.len() < repeats && (seconds.len() < 3 || all < LIMIT) {
        let taken = rayon::scope(|_| {
            let start = Instant::now();
            ppo.minibatch_step(rollout, &minibatch, Stage::Later)
                .map(|_| start.elapsed())
        });
        let taken = taken?.as_secs_f64();
        all += taken;
        seconds.push(taken);
    }
    let worked = os::processor_seconds() - before;
    let of_threads = all * rayon::current_num_threads() as f64;
    Ok((seconds, (1.0 - worked / of_threads).max(0.0)))
}

/// The matrix products of one forward and backward pass: sizes of weights `[outputs, inputs]`, and whether the
/// gradient of the inputs is needed. It is not needed for observations.
fn products(policy: &Policy) -> impl Iterator<Item = (usize, usize, bool)> {
    [&policy.layout.actor, &policy.layout.critic]
        .into_iter()
        .flat_map(|layers| layers.iter().enumerate())
        .map(|(i, layer)| (layer.outputs, layer.inputs, i > 0))
}

/// The number of floating-point operations of these products for one sample, both nets.
pub fn flops_per_sample(policy: &Policy) -> f64 {
    products(policy)
        .map(|(o, i, inner)| (if inner { 6 } else { 4 } * o * i) as f64)
        .sum()
}

/// Times the matrix products of one forward and backward pass of the policy on `samples` samples, on all threads. Their
/// data stays in the caches as far as it fits. Returns 10⁹ floating-point operations per second for each repeat.
pub fn matmul_gflops(ppo: &Ppo, samples: usize, repeats: usize) -> Vec<f64> {
    let policy = &ppo.policy;
    let arithmetic = ppo.arithmetic;
    let blocks = samples.div_ceil(ROWS);
    let widest = products(policy)
        .map(|(o, i, _)| o.max(i))
        .max()
        .expect("a policy has layers");
    let pass = |_: usize| {
        let x = vec![0.5f32; ROWS * widest];
        let dz = vec![0.1f32; ROWS * widest];
        let mut out = vec![0.0; (ROWS * widest).max(widest * widest)];
        let weights = vec![0.01f32; widest * widest];
        let mut multiplier = Multiplier::new(arithmetic);
        let start = Instant::now();
        for (o, i, inner) in products(policy) {
            let weight = Matrix::new(&weights[..o * i], o, i);
            let x = Matrix::new(&x[..ROWS * i], ROWS, i);
            let dz = Matrix::new(&dz[..ROWS * o], ROWS, o);
            multiplier.product(&mut out[..ROWS * o], x, weight.transposed(), None, false);
            multiplier.product(&mut out[..o * i], dz.transposed(), x, None, true);
            if inner {
                multiplier.product(&mut out[..ROWS * i], dz, weight, None, false);
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
