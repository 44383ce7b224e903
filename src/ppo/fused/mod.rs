//! Our own kernels: a minibatch in one pass over its samples, without a graph.
//!
//! The samples are split into groups, and each (group, net) is one task for one thread: it gathers and normalises a block of
//! rows at a time, takes it forward, computes the loss and goes backward while all of it lies in the cache of that core, and
//! adds up the gradient of its group. Then the groups are added in a fixed order. How samples are grouped depends on
//! their number alone, so the result is the same for any number of threads. After the first minibatch no array of samples or
//! weights is allocated, but for what gemm packs matrices into.

mod activation;
mod adam;
mod amx;
mod bf16;
mod loss;
mod multiplier;
mod net;
mod product;

use std::sync::Mutex;

use anyhow::Result;
use candle_core::{Device, Tensor};
use pulp::Arch;
use rayon::prelude::*;

pub use multiplier::{Arithmetic, Multiplier};
pub use net::{Net, Workspace};
pub use product::Matrix;

use super::backend::{Backend, Losses, Moments};
use super::normalizer::Scaling;
use super::rollout::Rollout;
use super::{Policy, entropy};
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

/// Gradients and steps by our own kernels.
pub struct Fused {
    config: PpoConfig,
    arithmetic: Arithmetic,
    /// For each thread of the pool.
    workspaces: Vec<Mutex<Workspace>>,
    /// For each group and net.
    parts: Vec<Part>,
    /// Of all parameters, one after the other.
    gradient: Vec<f32>,
    /// The running means of the gradient and of its square, likewise.
    moments: [Vec<f32>; 2],
    steps: u64,
    scaling: Scaling,
    old_log_std: Vec<f32>,
    squares: Vec<f64>,
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

impl Fused {
    /// For the parameters of `policy`.
    pub fn new(config: &PpoConfig, policy: &Policy, arithmetic: Arithmetic) -> Self {
        let zeros = || vec![0.0; policy.parameter_count()];
        Self {
            config: config.clone(),
            arithmetic,
            workspaces: Vec::new(),
            parts: Vec::new(),
            gradient: zeros(),
            moments: [zeros(), zeros()],
            steps: 0,
            scaling: policy.normalizer.scaling(),
            old_log_std: Vec::new(),
            squares: Vec::new(),
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

    /// Adds the gradients of the groups; returns the norm of the result.
    fn add_up(&mut self, groups: usize, sizes: [usize; 2], action_size: usize, entropy_coef: f32) -> f64 {
        let parts = &self.parts[..2 * groups];
        let (actor, rest) = self.gradient.split_at_mut(sizes[0]);
        let (critic, log_std) = rest.split_at_mut(sizes[1]);
        let mut sum = 0.0;
        for (role, gradient) in [actor, critic].into_iter().enumerate() {
            let chunks = gradient.par_chunks_mut(CHUNK).enumerate();
            let add = |(i, out): (usize, &mut [f32])| {
                let own = i * CHUNK..i * CHUNK + out.len();
                let of_group = |group: usize| &parts[2 * group + role].gradient[own.clone()];
                let mut groups = (0..groups).map(of_group);
                out.copy_from_slice(groups.next().expect("a minibatch has a group"));
                groups.for_each(|part| add_to(out, part));
                sum_of_squares(out)
            };
            chunks.map(add).collect_into_vec(&mut self.squares);
            sum += self.squares.iter().sum::<f64>();
        }
        assert_eq!(log_std.len(), action_size);
        log_std.fill(-entropy_coef);
        parts.iter().step_by(2).for_each(|part| add_to(log_std, &part.sums.log_std_grad));
        (sum + sum_of_squares(log_std)).sqrt()
    }
}

impl Backend for Fused {
    fn begin(&mut self, policy: &Policy, _: &Rollout) -> Result<()> {
        self.scaling = policy.normalizer.scaling();
        self.old_log_std = policy.log_std().to_vec1()?;
        Ok(())
    }

    fn gradient(&mut self, policy: &Policy, rollout: &Rollout, samples: &[u32]) -> Result<Losses> {
        let Grouping { size, groups, rows } = self.reserve(policy, samples.len());
        let nets = policy.fused_nets();
        let log_std: Vec<f32> = policy.log_std().to_vec1()?;
        let loss = Loss::new(rollout, samples.len(), &self.config, &log_std);
        let tasks = samples.chunks(size).flat_map(|group| ROLES.map(|role| (group, role)));
        let tasks: Vec<_> = tasks.zip(&mut self.parts).collect();
        tasks.into_par_iter().with_max_len(1).for_each(|((group, role), part)| {
            let net = &nets[role as usize];
            part.gradient.resize(net.parameter_count(), 0.0);
            part.sums.clear(log_std.len());
            let thread = rayon::current_thread_index().expect("rayon runs this");
            let work = &mut *self.workspaces[thread].lock().expect("no task has panicked");
            for (i, block) in group.chunks(rows).enumerate() {
                gather(rollout, block, &self.scaling, &mut work.inputs);
                net.forward(block.len(), work);
                let (outputs, grad) = work.outputs_and_grad(block.len(), net.outputs());
                match role {
                    Role::Actor => loss.actor(block, outputs, grad, &mut part.sums),
                    Role::Critic => loss.critic(block, outputs, grad, &mut part.sums),
                }
                net.backward(block.len(), work, &mut part.gradient, i > 0);
            }
        });

        let sizes = [0, 1].map(|net: usize| nets[net].parameter_count());
        let grad_norm = self.add_up(groups, sizes, log_std.len(), self.config.entropy_coef as f32);
        let parts = &self.parts[..2 * groups];
        let mean = |of: fn(&Sums) -> f64| parts.iter().map(|part| of(&part.sums)).sum::<f64>() / samples.len() as f64;
        let (policy_loss, value) = (-mean(|sums| sums.surrogate), mean(|sums| sums.value_error));
        let excess = mean(|sums| sums.excess);
        let entropy = entropy(&log_std);
        let moved: Vec<f64> = (0..log_std.len())
            .map(|i| parts.iter().step_by(2).map(|part| f64::from(part.sums.moved[i])).sum())
            .collect();
        Ok(Losses {
            total: policy_loss + self.config.value_coef * value - self.config.entropy_coef * entropy
                + self.config.bounds_coef * excess,
            policy: policy_loss,
            value,
            excess,
            entropy,
            kl: loss::kl(&moved, samples.len(), &self.old_log_std, &log_std),
            clip_fraction: mean(|sums| sums.clipped as f64),
            ratio_error: parts.iter().map(|part| f64::from(part.sums.ratio_error)).fold(0.0, f64::max),
            grad_norm,
        })
    }

    fn step(&mut self, policy: &Policy, learning_rates: [f64; 2], scale: f64) -> Result<()> {
        self.steps += 1;
        let rates = learning_rates.map(|rate| adam::Rates::new(self.steps, rate, scale));
        let [mean, square] = &mut self.moments;
        let mut at = 0;
        for (name, var) in policy.parameters() {
            let own = at..at + var.elem_count();
            at = own.end;
            let rates = rates[usize::from(Policy::is_of_critic(name))];
            adam::step(var, rates, &self.gradient[own.clone()], &mut mean[own.clone()], &mut square[own])?;
        }
        Ok(())
    }

    fn moments(&self, policy: &Policy) -> Result<Moments> {
        let mut at = 0;
        let mut tensors = Vec::new();
        for (_, var) in policy.parameters() {
            let own = at..at + var.elem_count();
            at = own.end;
            let tensor = |moment: &[f32]| Tensor::from_slice(&moment[own.clone()], var.shape(), &Device::Cpu);
            tensors.push([tensor(&self.moments[0])?, tensor(&self.moments[1])?]);
        }
        Ok(Moments { tensors, steps: self.steps })
    }

    fn restore(&mut self, moments: Moments) -> Result<()> {
        self.steps = moments.steps;
        for (which, own) in self.moments.iter_mut().enumerate() {
            own.clear();
            for pair in &moments.tensors {
                own.extend(pair[which].flatten_all()?.to_vec1::<f32>()?);
            }
        }
        Ok(())
    }
}

/// Writes the normalised observations of these samples, row after row.
fn gather(rollout: &Rollout, samples: &[u32], scaling: &Scaling, out: &mut [f32]) {
    let size = scaling.size();
    for (&sample, row) in samples.iter().zip(out.chunks_exact_mut(size)) {
        let (block, i) = rollout.locate(sample);
        scaling.apply(&block.observations[i * size..(i + 1) * size], row);
    }
}

fn add_to(sums: &mut [f32], x: &[f32]) {
    Arch::new().dispatch(
        #[inline(always)]
        || sums.iter_mut().zip(x).for_each(|(sum, x)| *sum += x),
    );
}

/// The sum of the squares, added up in lanes: first floats within a lane, then doubles.
fn sum_of_squares(x: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 32];
    Arch::new().dispatch(
        #[inline(always)]
        || {
            let (whole, rest) = x.as_chunks::<32>();
            for chunk in whole.iter().map(|chunk| &chunk[..]).chain([rest]) {
                lanes.iter_mut().zip(chunk).for_each(|(lane, x)| *lane += x * x);
            }
        },
    );
    lanes.iter().map(|&lane| f64::from(lane)).sum()
}
