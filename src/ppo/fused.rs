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
use super::kernels::{Arithmetic, ROWS, Workspace};
use super::loss::Loss;
use super::policy::Policy;
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;

/// The gradient backend with our own kernels.
pub(super) struct Fused {
    config: PpoConfig,
    arithmetic: Arithmetic,
    /// Workspaces, one per thread of the pool.
    workspaces: Vec<Mutex<Workspace>>,
    /// `[B, O]`: network inputs for the samples of the rollout
    seen: Vec<f32>,
}

/// The net that a job works on.
#[derive(Clone, Copy)]
enum Role {
    Actor,
    Critic,
}

impl Fused {
    /// Creates the backend with these settings.
    pub(super) fn new(config: &PpoConfig, arithmetic: Arithmetic) -> Self {
        Self { config: config.clone(), arithmetic, workspaces: Vec::new(), seen: Vec::new() }
    }
}

impl GradientBackend for Fused {
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) {
        let transform = policy.input_transform();
        let size = policy.spaces.observation_size;
        self.seen.resize(rollout.samples() * size, 0.0);
        let mut rest = &mut self.seen[..];
        let mut parts = Vec::new();
        for raw in rollout.blocks.iter().map(RolloutBlock::acted_on) {
            parts.push((raw, rest.split_off_mut(..raw.len()).expect("room for all")));
        }
        parts.into_par_iter().for_each(|(raw, seen)| transform.apply(raw, seen));
    }

    fn gradients(
        &mut self,
        policy: &Policy,
        rollout: &Rollout,
        groups: &[&[u32]],
        count: usize,
        gradients: &mut Vec<Vec<f32>>,
    ) -> Result<Vec<Losses>> {
        let workspace = || Mutex::new(Workspace::new(&policy.layout.actor, ROWS, self.arithmetic));
        self.workspaces.resize_with(rayon::current_num_threads(), workspace);
        // The rows that pass through a net together: blocks of equal size as far as possible.
        let samples = groups.iter().map(|group| group.len()).max().unwrap_or(0);
        let rows = samples.div_ceil(samples.div_ceil(ROWS));
        let nets = policy.nets(self.arithmetic, true);
        let loss = Loss::new(policy, rollout, count, &self.config);
        // Passes the samples of a group forward and backward through a net.
        let job = |(group, role, gradient): (&[u32], Role, &mut [f32])| {
            let net = &nets[role as usize];
            let mut sums = loss.of_none();
            let thread = rayon::current_thread_index().expect("runs on a rayon thread");
            let work = &mut *self.workspaces[thread].lock().expect("no job has panicked");
            for (i, block) in group.chunks(rows).enumerate() {
                for (&sample, row) in block.iter().zip(work.inputs.chunks_exact_mut(policy.spaces.observation_size)) {
                    row.copy_from_slice(&self.seen[RolloutBlock::row(row.len(), sample as usize)]);
                }
                net.forward(block.len(), work);
                let (outputs, grad) = work.outputs_and_grad(block.len(), net.outputs());
                match role {
                    Role::Actor => loss.actor(block, outputs, grad, &mut sums),
                    Role::Critic => loss.critic(block, outputs, grad, &mut sums),
                }
                net.backward(block.len(), work, gradient, i > 0);
            }
            loss.of_group(&sums)
        };
        let [actor, _] = policy.layout.nets();
        gradients.resize_with(groups.len(), || vec![0.0; policy.layout.count()]);
        let mut jobs = Vec::new();
        for (&group, gradient) in groups.iter().zip(gradients) {
            let (actor, critic) = gradient.split_at_mut(actor.end);
            jobs.push((group, Role::Actor, actor));
            jobs.push((group, Role::Critic, critic));
        }
        let losses: Vec<Losses> = jobs.into_par_iter().with_max_len(1).map(job).collect();
        Ok(losses.chunks(2).map(|nets| nets[0] + nets[1]).collect())
    }
}
