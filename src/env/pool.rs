//! Many environments stepped together on the worker threads of rayon's current pool.
//!
//! Environment i reads and writes row i of each array and owns everything else that it needs, and the randomness of an
//! episode depends on its number alone; so the results are the same for any number of threads.

use rayon::prelude::*;

use super::{End, Env, Transition};
use crate::rng;

/// N environments that start their next episode by themselves.
pub struct EnvPool<E: Env> {
    slots: Vec<Slot<E>>,
    seed: u64,
    observation_size: usize,
    action_size: usize,
    finished: Vec<E::Episode>,
}

struct Slot<E: Env> {
    env: E,
    next_episode: u64,
    finished: Option<E::Episode>,
}

/// Where a step writes, row i for environment i. N environments, O numbers in an observation.
pub struct StepBuffers<'a> {
    /// `[N]`
    pub rewards: &'a mut [f32],
    /// `[N]`
    pub ends: &'a mut [Option<End>],
    /// `[N, O]`, the observation to act on next: of the new episode where one ended.
    pub observations: &'a mut [f32],
    /// `[N, O]`, the last observation of the episode where one was truncated; other rows are left alone.
    pub final_observations: &'a mut [f32],
}

impl<E: Env> EnvPool<E> {
    /// A pool of these environments (at least one, all of one kind), whose episodes are drawn from `seed`.
    pub fn new(seed: u64, envs: Vec<E>) -> Self {
        let (observation_size, action_size) = (envs[0].observation_size(), envs[0].action_size());
        let slots = envs.into_iter().map(|env| Slot { env, next_episode: 0, finished: None }).collect();
        Self { slots, seed, observation_size, action_size, finished: Vec::new() }
    }

    /// The number of environments.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Never true: a pool has at least one environment.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Numbers in an action.
    pub fn action_size(&self) -> usize {
        self.action_size
    }

    /// Starts an episode in every environment, at random ages so that they do not all end together.
    ///
    /// Episodes are numbered from `first_episode` on: those before it are not played again. Writes `observations` `[N, O]`.
    pub fn reset(&mut self, first_episode: u64, observations: &mut [f32]) {
        let (seed, count) = (self.seed, self.len() as u64);
        let rows = observations.par_chunks_exact_mut(self.observation_size);
        self.slots.par_iter_mut().zip_eq(rows).enumerate().for_each(|(i, (slot, row))| {
            slot.next_episode = first_episode + i as u64;
            let age = rng::uniform(&mut rng::stream(seed, "age", slot.next_episode), 0.0, 1.0);
            slot.start(seed, count, row);
            slot.env.skip_ahead(age);
        });
    }

    /// Steps every environment with its row of `actions` `[N, A]`, and starts a new episode where one ended.
    pub fn step(&mut self, actions: &[f32], buffers: StepBuffers) {
        let (seed, count, size) = (self.seed, self.len() as u64, self.observation_size);
        self.slots
            .par_iter_mut()
            .zip_eq(actions.par_chunks_exact(self.action_size))
            .zip_eq(buffers.rewards)
            .zip_eq(buffers.ends)
            .zip_eq(buffers.observations.par_chunks_exact_mut(size))
            .zip_eq(buffers.final_observations.par_chunks_exact_mut(size))
            .for_each(|(((((slot, action), reward), end), row), final_row)| {
                let transition: Transition = slot.env.step(action, row);
                (*reward, *end) = (transition.reward, transition.end);
                if let Some(end) = transition.end {
                    if end == End::Truncated {
                        final_row.copy_from_slice(row);
                    }
                    slot.finished = Some(slot.env.episode());
                    slot.start(seed, count, row);
                }
            });
        self.finished.extend(self.slots.iter_mut().filter_map(|slot| slot.finished.take()));
    }

    /// The episodes that ended since the last call, in the order of steps and then of environments.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        std::mem::take(&mut self.finished)
    }

    /// A number beyond those of all episodes that were begun; a pool that is reset with it repeats none of them.
    pub fn next_episode(&self) -> u64 {
        self.slots.iter().map(|slot| slot.next_episode).max().expect("a pool has at least one environment")
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.slots.iter_mut().map(|slot| &mut slot.env)
    }
}

impl<E: Env> Slot<E> {
    fn start(&mut self, seed: u64, count: u64, row: &mut [f32]) {
        self.env.reset(rng::stream(seed, "episode", self.next_episode), row);
        self.next_episode += count;
    }
}
