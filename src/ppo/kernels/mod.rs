//! Our own kernels: a minibatch in one pass over its samples, without a graph.
//!
//! What the nets see of all samples is computed once. The samples of each shard in a minibatch are split into groups, and each
//! (group, net) is one task for one thread: it gathers a block of rows at a time, takes it forward, computes the loss and goes
//! backward while all of it lies in the cache of that core, and adds up the gradient of its group. Then the groups are added as a
//! binary tree. How samples are grouped depends on their number and that of the shards alone, so the result is the same for any
//! number of threads. After the first minibatch no array of samples or weights is allocated, but for what gemm packs matrices into.

mod activation;
mod amx;
mod bf16;
mod loss;
mod multiplier;
mod net;
mod product;

use std::sync::Mutex;

use anyhow::Result;
use rayon::prelude::*;

pub use multiplier::{Arithmetic, Multiplier};
pub use net::{Net, Workspace};
pub use product::Matrix;

use super::Policy;
use super::backend::{Backend, Minibatch, ShardSums};
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;
use crate::ranks::tree_sum;
use loss::{Loss, Sums};

/// Groups of a minibatch, if its shards are fewer. More can occupy more threads (there are two tasks for each) and take more memory
/// and time to add.
const GROUPS: usize = 16;

/// Samples of a shard that are worth a group of their own.
const SMALLEST_GROUP: usize = 32;

/// Rows that go through a net together: enough for fast products, few enough for the cache of a core.
pub const ROWS: usize = 256;

/// Numbers of the gradient that one task adds up.
const CHUNK: usize = 4096;

/// Gradients by our own kernels.
pub struct Kernels {
    config: PpoConfig,
    arithmetic: Arithmetic,
    /// For each thread of the pool.
    workspaces: Vec<Mutex<Workspace>>,
    /// For each group and net.
    parts: Vec<Part>,
    /// `[B, O]`, what the nets see of the samples of the rollout.
    seen: Vec<f32>,
    old_log_std: Vec<f32>,
}

/// What a task leaves behind.
#[derive(Clone, Default)]
struct Part {
    gradient: Vec<f32>,
    sums: Sums,
}

/// Which net a task is about.
#[derive(Clone, Copy, PartialEq)]
enum Role {
    Actor,
    Critic,
}

const ROLES: [Role; 2] = [Role::Actor, Role::Critic];

impl Kernels {
    /// With these settings.
    pub fn new(config: &PpoConfig, arithmetic: Arithmetic) -> Self {
        Self {
            config: config.clone(),
            arithmetic,
            workspaces: Vec::new(),
            parts: Vec::new(),
            seen: Vec::new(),
            old_log_std: Vec::new(),
        }
    }

    /// Makes room for so many groups of so many samples; the rows that go through a net together: blocks of one size, as far as that
    /// goes.
    fn reserve(&mut self, policy: &Policy, groups: usize, samples: usize) -> usize {
        let rows = samples.div_ceil(samples.div_ceil(ROWS));
        self.workspaces.retain_mut(|work| work.get_mut().expect("no task has panicked").rows() >= rows);
        while self.workspaces.len() < rayon::current_num_threads() {
            self.workspaces.push(Mutex::new(policy.workspace(rows, true, self.arithmetic)));
        }
        if self.parts.len() < 2 * groups {
            self.parts.resize(2 * groups, Part::default());
        }
        rows
    }

    /// Writes the sum of the gradients of the groups of the net of this role.
    fn add_up(&self, role: Role, groups: usize, out: &mut [f32]) {
        let gradients: Vec<&[f32]> =
            (0..groups).map(|group| &self.parts[2 * group + role as usize].gradient[..]).collect();
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(i, out)| {
            let own = i * CHUNK..i * CHUNK + out.len();
            let of_groups: Vec<&[f32]> = gradients.iter().map(|gradient| &gradient[own.clone()]).collect();
            tree_sum(out, &of_groups);
        });
    }

    /// The sums of a shard, whose groups left these parts.
    fn shard_sums(&self, parts: &[Part], samples: usize, log_std: &[f32]) -> ShardSums {
        let sum = |of: fn(&Sums) -> f64| parts.iter().map(|part| of(&part.sums)).sum::<f64>();
        let moved: Vec<f64> = (0..log_std.len())
            .map(|i| parts.iter().step_by(2).map(|part| f64::from(part.sums.moved[i])).sum())
            .collect();
        ShardSums {
            surrogate: sum(|sums| sums.surrogate),
            value_error: sum(|sums| sums.value_error),
            excess: sum(|sums| sums.excess),
            kl: loss::kl(&moved, samples, &self.old_log_std, log_std) * samples as f64,
            clipped: sum(|sums| sums.clipped as f64),
            ratio_error: parts.iter().map(|part| f64::from(part.sums.ratio_error)).fold(0.0, f64::max),
        }
    }
}

/// The groups that each shard of so many samples is split into, of so many shards: a power of two, so that all groups can be added
/// as a tree. It depends on nothing else.
fn groups_of_shard(samples: usize, shards: usize) -> usize {
    let mut groups = (GROUPS / shards).max(1);
    while groups > 1 && samples / groups < SMALLEST_GROUP {
        groups /= 2;
    }
    groups
}

impl Backend for Kernels {
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
        self.old_log_std = policy.log_std().to_vec();
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
        let nets = [&policy.layout.actor, &policy.layout.critic].map(|layers| policy.net(layers));
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
            let thread = rayon::current_thread_index().expect("rayon runs this");
            let work = &mut *self.workspaces[thread].lock().expect("no task has panicked");
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
        let parts = &self.parts[..2 * all_groups];
        let of_groups: Vec<&[f32]> = parts.iter().step_by(2).map(|part| &part.sums.log_std_grad[..]).collect();
        tree_sum(&mut out[of_log_std], &of_groups);
        Ok(parts.chunks(2 * groups).map(|parts| self.shard_sums(parts, in_shard, log_std)).collect())
    }
}
