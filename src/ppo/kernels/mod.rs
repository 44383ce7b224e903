//! Our own kernels: a minibatch in one pass over its samples, without a graph.
//!
//! What the nets see of all samples is computed once. A minibatch is split into groups, and each (group, net) is one task for one
//! thread: it gathers a block of rows at a time, takes it forward, computes the loss and goes backward while all of it lies in the cache of that core, and
//! adds up the gradient of its group. Then the groups are added in a fixed order. How samples are grouped depends on
//! their number alone, so the result is the same for any number of threads. After the first minibatch no array of samples or
//! weights is allocated, but for what gemm packs matrices into.

mod activation;
mod amx;
mod bf16;
mod loss;
mod multiplier;
mod net;
mod product;

use std::sync::Mutex;

use anyhow::Result;
use pulp::Arch;
use rayon::prelude::*;

pub use multiplier::{Arithmetic, Multiplier};
pub use net::{Net, Workspace};
pub use product::Matrix;

use super::Policy;
use super::backend::{Backend, Losses};
use super::rollout::{Rollout, RolloutBlock};
use crate::config::PpoConfig;
use loss::{Loss, Sums};

/// Groups of a minibatch. More can occupy more threads (there are two tasks for each) and take more memory and time to add.
const GROUPS: usize = 16;

/// Samples of a small minibatch that are worth a group of their own.
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

/// How a minibatch is split up, which follows from its size alone.
struct Grouping {
    /// Samples of a group; the last one may have fewer.
    size: usize,
    groups: usize,
    /// Rows that go through a net together: blocks of one size, as far as that goes.
    rows: usize,
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

    /// Makes room for a minibatch.
    fn reserve(&mut self, policy: &Policy, samples: usize) -> Grouping {
        let size = samples.div_ceil(GROUPS).max(SMALLEST_GROUP);
        let grouping = Grouping { size, groups: samples.div_ceil(size), rows: size.div_ceil(size.div_ceil(ROWS)) };
        self.workspaces.retain_mut(|work| work.get_mut().expect("no task has panicked").rows() >= grouping.rows);
        while self.workspaces.len() < rayon::current_num_threads() {
            self.workspaces.push(Mutex::new(policy.workspace(grouping.rows, true, self.arithmetic)));
        }
        if self.parts.len() < 2 * grouping.groups {
            self.parts.resize(2 * grouping.groups, Part::default());
        }
        grouping
    }

    /// Writes the sum of the gradients of the groups of the net of this role.
    fn add_up(&self, role: Role, groups: usize, out: &mut [f32]) {
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(i, out)| {
            let own = i * CHUNK..i * CHUNK + out.len();
            let mut of_groups = (0..groups).map(|group| &self.parts[2 * group + role as usize].gradient[own.clone()]);
            out.copy_from_slice(of_groups.next().expect("a minibatch has a group"));
            of_groups.for_each(|part| add_to(out, part));
        });
    }
}

impl Backend for Kernels {
    fn begin(&mut self, policy: &Policy, rollout: &Rollout) {
        let (reader, size) = (policy.reader(), policy.spaces.observation_size);
        self.seen.resize(rollout.samples() * size, 0.0);
        let of_blocks = self.seen.par_chunks_mut(rollout.blocks[0].samples() * size);
        of_blocks.zip(&rollout.blocks).for_each(|(seen, block)| reader.read(block.acted_on(), seen));
        self.old_log_std = policy.log_std().to_vec();
    }

    fn gradient(&mut self, policy: &Policy, rollout: &Rollout, samples: &[u32], out: &mut [f32]) -> Result<Losses> {
        let Grouping { size, groups, rows } = self.reserve(policy, samples.len());
        let nets = [&policy.layout.actor, &policy.layout.critic].map(|layers| policy.net(layers));
        let log_std = policy.log_std();
        let loss = Loss::new(rollout, samples.len(), &self.config, log_std);
        let tasks = samples.chunks(size).flat_map(|group| ROLES.map(|role| (group, role)));
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
        self.add_up(Role::Actor, groups, &mut out[actor]);
        self.add_up(Role::Critic, groups, &mut out[critic]);
        let parts = &self.parts[..2 * groups];
        let of_log_std = &mut out[of_log_std];
        of_log_std.fill(0.0);
        parts.iter().step_by(2).for_each(|part| add_to(of_log_std, &part.sums.log_std_grad));
        let mean = |of: fn(&Sums) -> f64| parts.iter().map(|part| of(&part.sums)).sum::<f64>() / samples.len() as f64;
        let (policy_loss, value) = (-mean(|sums| sums.surrogate), mean(|sums| sums.value_error));
        let excess = mean(|sums| sums.excess);
        let moved: Vec<f64> = (0..log_std.len())
            .map(|i| parts.iter().step_by(2).map(|part| f64::from(part.sums.moved[i])).sum())
            .collect();
        Ok(Losses {
            total: policy_loss + self.config.value_coef * value + self.config.bounds_coef * excess,
            policy: policy_loss,
            value,
            excess,
            kl: loss::kl(&moved, samples.len(), &self.old_log_std, log_std),
            clip_fraction: mean(|sums| sums.clipped as f64),
            ratio_error: parts.iter().map(|part| f64::from(part.sums.ratio_error)).fold(0.0, f64::max),
        })
    }
}

fn add_to(sums: &mut [f32], x: &[f32]) {
    Arch::new().dispatch(
        #[inline(always)]
        || sums.iter_mut().zip(x).for_each(|(sum, x)| *sum += x),
    );
}
