//! Custom kernels: the gradient of a minibatch in one pass over its samples, without an autograd graph.
//!
//! The network inputs of all samples are computed once per rollout. The samples of each shard in a minibatch are split
//! into groups, and each (group, net) is one job for one thread. The job gathers a block of rows at a time, runs the
//! forward pass, the loss and the backward pass while all of it is in the cache of that core, and accumulates the
//! gradient of its group. Then the gradients of the groups are added as a binary tree. The grouping depends only on the
//! numbers of samples and shards, so the result is the same for any number of threads. After the first minibatch, the
//! only float arrays that are allocated are the packing buffers of gemm and small temporaries of the sums; bf16 also
//! packs the weights anew for each minibatch.

mod activation;
mod amx;
mod avx512;
mod bf16;
mod loss;
mod multiplier;
mod net;
mod product;
mod units;

use std::sync::Mutex;

use anyhow::Result;
use rayon::prelude::*;

pub(super) use multiplier::{Arithmetic, Multiplier};
pub(super) use net::Net;
pub use net::Workspace;
pub(super) use product::Matrix;

use super::Policy;
use super::backend::{GradientBackend, Minibatch, ShardSums};
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;
use crate::ranks::tree_sum;
use loss::{Loss, Sums};

/// The largest number of groups in a minibatch, unless it has more shards. More groups can occupy more threads (there
/// are two jobs per group), but take more memory and more time to add up.
const GROUPS: usize = 16;

/// The fewest samples of a shard that are worth their own group.
const SMALLEST_GROUP: usize = 32;

/// Rows that pass through a net together: enough for fast products, few enough for the cache of one core.
pub(super) const ROWS: usize = 256;

/// Gradient values that one job adds up.
const CHUNK: usize = 4096;

/// The gradient backend with custom kernels.
pub(super) struct Kernels {
    config: PpoConfig,
    arithmetic: Arithmetic,
    /// Workspaces, one per thread of the pool.
    workspaces: Vec<Mutex<Workspace>>,
    /// Results, one per group and net.
    parts: Vec<Partial>,
    /// `[B, O]`: network inputs for the samples of the rollout
    seen: Vec<f32>,
}

/// The result of a job.
#[derive(Clone, Default)]
struct Partial {
    gradient: Vec<f32>,
    sums: Sums,
}

/// The net that a job works on.
#[derive(Clone, Copy, PartialEq)]
enum Role {
    Actor,
    Critic,
}

const ROLES: [Role; 2] = [Role::Actor, Role::Critic];

impl Kernels {
    /// Creates the backend with these settings.
    pub(super) fn new(config: &PpoConfig, arithmetic: Arithmetic) -> Self {
        Self { config: config.clone(), arithmetic, workspaces: Vec::new(), parts: Vec::new(), seen: Vec::new() }
    }

    /// Makes room for this number of groups of up to `samples` samples. Returns the number of rows that pass through a
    /// net together, chosen for blocks of equal size as far as possible.
    fn reserve(&mut self, policy: &Policy, groups: usize, samples: usize) -> usize {
        let rows = samples.div_ceil(samples.div_ceil(ROWS));
        self.workspaces.retain_mut(|work| work.get_mut().expect("no job has panicked").rows() >= rows);
        while self.workspaces.len() < rayon::current_num_threads() {
            self.workspaces.push(Mutex::new(policy.workspace(rows, true, self.arithmetic)));
        }
        if self.parts.len() < 2 * groups {
            self.parts.resize(2 * groups, Partial::default());
        }
        rows
    }

    /// Writes the sum of the gradients of all groups for one net.
    fn add_up(&self, role: Role, groups: usize, out: &mut [f32]) {
        let gradients: Vec<&[f32]> =
            (0..groups).map(|group| &self.parts[2 * group + role as usize].gradient[..]).collect();
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(i, out)| {
            let own = i * CHUNK..i * CHUNK + out.len();
            let of_groups: Vec<&[f32]> = gradients.iter().map(|gradient| &gradient[own.clone()]).collect();
            tree_sum(out, &of_groups);
        });
    }

    /// Returns the sums of a shard from the results of its groups.
    fn shard_sums(parts: &[Partial], log_std: &[f32]) -> ShardSums {
        let sum = |of: fn(&Sums) -> f64| parts.iter().map(|part| of(&part.sums)).sum::<f64>();
        let moved: Vec<f64> = (0..log_std.len())
            .map(|i| parts.iter().step_by(2).map(|part| f64::from(part.sums.moved[i])).sum())
            .collect();
        ShardSums {
            surrogate: sum(|sums| sums.surrogate),
            value_error: sum(|sums| sums.value_error),
            excess: sum(|sums| sums.excess),
            kl: loss::kl(&moved, log_std),
            clipped: sum(|sums| sums.clipped as f64),
            ratio_error: parts.iter().map(|part| f64::from(part.sums.ratio_error)).fold(0.0, f64::max),
        }
    }
}

/// Returns the number of groups that each shard of `samples` samples is split into: a power of two, so that all groups
/// can be added as a tree. It depends on nothing but `samples` and `shards`.
fn groups_of_shard(samples: usize, shards: usize) -> usize {
    let mut groups = (GROUPS / shards).max(1);
    while groups > 1 && samples / groups < SMALLEST_GROUP {
        groups /= 2;
    }
    groups
}

impl GradientBackend for Kernels {
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) {
        let (reader, size) = (policy.reader(), policy.spaces.observation_size);
        self.seen.resize(rollout.samples() * size, 0.0);
        let (mut rest, mut parts) = (&mut self.seen[..], Vec::new());
        for block in &rollout.blocks {
            let (seen, after) = rest.split_at_mut(block.samples() * size);
            parts.push((seen, block));
            rest = after;
        }
        parts.into_par_iter().for_each(|(seen, block)| reader.read(block.acted_on(), seen));
    }

    fn gradient(
        &mut self,
        policy: &Policy,
        rollout: &Rollout,
        minibatch: Minibatch,
        out: &mut [f32],
    ) -> Result<Vec<ShardSums>> {
        let in_shard = minibatch.in_shard();
        let groups = groups_of_shard(in_shard, minibatch.shards);
        let all_groups = groups * minibatch.own_shards;
        let rows = self.reserve(policy, all_groups, in_shard.div_ceil(groups));
        let nets = [&policy.layout.actor, &policy.layout.critic];
        let nets = nets.map(|layers| policy.net(layers).packed(self.arithmetic, true));
        let log_std = policy.log_std();
        let loss = Loss::new(rollout, minibatch.count(), &self.config, log_std);
        let bounds: Vec<usize> = (0..=groups).map(|i| in_shard * i / groups).collect();
        let shards = minibatch.samples.chunks(in_shard);
        let tasks = shards.flat_map(|shard| bounds.windows(2).map(|bounds| &shard[bounds[0]..bounds[1]]));
        let tasks = tasks.flat_map(|group| ROLES.map(|role| (group, role)));
        let tasks: Vec<_> = tasks.zip(&mut self.parts).collect();
        tasks.into_par_iter().with_max_len(1).for_each(|((group, role), part)| {
            let net = &nets[role as usize];
            part.gradient.resize(net.parameter_count(), 0.0);
            part.sums = Sums::new(log_std.len());
            let thread = rayon::current_thread_index().expect("runs on a rayon thread");
            let work = &mut *self.workspaces[thread].lock().expect("no job has panicked");
            for (i, block) in group.chunks(rows).enumerate() {
                for (&sample, row) in block.iter().zip(work.inputs.chunks_exact_mut(net.inputs())) {
                    row.copy_from_slice(&self.seen[RolloutBlock::row(row.len(), sample as usize)]);
                }
                net.forward(block.len(), work);
                let (outputs, grad) = work.outputs_and_grad(block.len(), net.outputs());
                match role {
                    Role::Actor => loss.actor(block, outputs, grad, &mut part.sums),
                    Role::Critic => loss.critic(block, outputs, grad, &mut part.sums),
                }
                net.backward(block.len(), work, &mut part.gradient, i > 0);
            }
        });

        let [actor, critic, of_log_std] = policy.layout.groups();
        self.add_up(Role::Actor, all_groups, &mut out[actor]);
        self.add_up(Role::Critic, all_groups, &mut out[critic]);
        out[of_log_std].fill(0.0);
        let parts = &self.parts[..2 * all_groups];
        Ok(parts.chunks(2 * groups).map(|parts| Self::shard_sums(parts, log_std)).collect())
    }
}
