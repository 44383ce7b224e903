//! The gradient of a minibatch in one pass over its samples, without an autograd graph.
//!
//! The network inputs of all samples are computed once per rollout. The samples of a minibatch come in groups, and each
//! (group, net) is one job for one thread. The job gathers a block of rows at a time, which stays in the cache of that core.
//! It runs the forward pass, the loss and the backward pass on it, and accumulates the gradient of its group. Then the
//! gradients of the groups are added as a binary tree, chunk by chunk, each with its squares for the norm. All threads wait
//! for each other after each of these parts. The grouping depends only on the settings, so the result
//! is the same for any number of threads. After the first minibatch, the only float arrays that are allocated are the
//! packing buffers of gemm and small temporaries of the sums. bf16 also packs the weights anew for each minibatch.

use std::sync::Mutex;

use anyhow::Result;
use rayon::prelude::*;

use super::backend::{GradientBackend, Losses};
use super::kernels::{Arithmetic, Net, ROWS, Workspace};
use super::loss::{Loss, Sums};
use super::policy::Policy;
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;

/// The gradient backend with our own kernels.
pub struct Fused {
    arithmetic: Arithmetic,
    /// Workspaces, one per thread of the pool.
    workspaces: Vec<Mutex<Workspace>>,
    /// `[B, O]`: network inputs for the samples of the rollout
    seen: Vec<f32>,
}

/// A job: the samples of a group, a net, what computes the gradient of its outputs, and the place for the gradient of its parameters.
type Job<'a> = (
    &'a [u32],
    &'a Net<'a>,
    fn(&Loss<'a>, &[u32], &[f32], &mut [f32], &mut Sums),
    &'a mut [f32],
);

impl Fused {
    /// Creates the backend.
    pub fn new(arithmetic: Arithmetic) -> Self {
        Self {
            arithmetic,
            workspaces: Vec::new(),
            seen: Vec::new(),
        }
    }

    /// Passes the samples of a job forward and backward through its net, `rows` of them at a time.
    fn pass<'a>(
        &self,
        loss: &Loss<'a>,
        rows: usize,
        (group, net, of_outputs, gradient): Job<'a>,
    ) -> Losses {
        let mut sums = loss.of_none();
        let thread = rayon::current_thread_index().expect("runs on a rayon thread");
        let work = &mut *self.workspaces[thread].lock().expect("no job has panicked");
        let size = work.inputs.len() / ROWS;
        for (i, block) in group.chunks(rows).enumerate() {
            for (&sample, row) in block.iter().zip(work.inputs.chunks_exact_mut(size)) {
                row.copy_from_slice(&self.seen[RolloutBlock::row(size, sample as usize)]);
            }
            net.forward(block.len(), work);
            let (outputs, grad) = work.outputs_and_grad(block.len(), net.outputs());
            of_outputs(loss, block, outputs, grad, &mut sums);
            net.backward(block.len(), work, gradient, i > 0);
        }
        loss.of_group(&sums)
    }
}

impl GradientBackend for Fused {
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) {
        let perception = policy.perception();
        let size = policy.spaces.observation_size;
        self.seen.resize(rollout.samples() * size, 0.0);
        let mut rest = &mut self.seen[..];
        let mut parts = Vec::new();
        for raw in rollout.blocks.iter().map(RolloutBlock::acted_on) {
            parts.push((raw, rest.split_off_mut(..raw.len()).expect("room for all")));
        }
        parts
            .into_par_iter()
            .for_each(|(raw, seen)| perception.apply(raw, seen));
    }

    fn gradients(
        &mut self,
        policy: &Policy,
        config: &PpoConfig,
        rollout: &Rollout,
        groups: &[&[u32]],
        count: usize,
        gradients: &mut Vec<Vec<f32>>,
    ) -> Result<Vec<Losses>> {
        self.workspaces
            .resize_with(rayon::current_num_threads(), || {
                Mutex::new(Workspace::new(&policy.layout.actor, ROWS, self.arithmetic))
            });
        // The rows that pass through a net together: blocks of equal size as far as possible.
        let samples = groups.iter().map(|group| group.len()).max().unwrap_or(0);
        let rows = samples.div_ceil(samples.div_ceil(ROWS));
        let mut nets = policy.nets();
        Net::prepare(&mut nets, self.arithmetic, true);
        let [actor, critic] = &nets;
        let loss = Loss::new(policy, rollout, count, config);
        let [of_actor, _] = policy.layout.nets();
        gradients.resize_with(groups.len(), || vec![0.0; policy.layout.count()]);
        let mut jobs: Vec<Job> = Vec::new();
        for (&group, gradient) in groups.iter().zip(gradients) {
            let (for_actor, for_critic) = gradient.split_at_mut(of_actor.end);
            jobs.push((group, actor, Loss::actor, for_actor));
            jobs.push((group, critic, Loss::critic, for_critic));
        }
        let losses: Vec<Losses> = jobs
            .into_par_iter()
            .with_max_len(1)
            .map(|job| self.pass(&loss, rows, job))
            .collect();
        Ok(losses.chunks(2).map(|nets| nets[0] + nets[1]).collect())
    }
}
