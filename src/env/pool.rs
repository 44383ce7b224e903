//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs, and the randomness of an
//! episode depends on its number alone; so the results do not depend on which thread steps which block when.

use rayon::prelude::*;

use super::{End, Env, Transition};
use crate::rng;
use crate::schedule::block_sizes;

/// N environments that start their next episode by themselves.
pub struct EnvPool<E: Env> {
    blocks: Vec<EnvBlock<E>>,
}

/// Some environments of a pool, that one thread steps at a time.
pub struct EnvBlock<E: Env> {
    slots: Vec<Slot<E>>,
    seed: u64,
    /// The number of environments in the whole pool: so far apart are the numbers of an environment's episodes.
    stride: u64,
    finished: Vec<E::Episode>,
}

struct Slot<E: Env> {
    env: E,
    next_episode: u64,
}

/// Where a step of a block writes, one row for each of its n environments. O numbers in an observation.
pub struct StepBuffers<'a> {
    /// `[n]`
    pub rewards: &'a mut [f32],
    /// `[n]`
    pub ends: &'a mut [Option<End>],
    /// `[n, O]`, the observation to act on next: of the new episode where one ended.
    pub observations: &'a mut [f32],
    /// `[n, O]`, the last observation of the episode where one was truncated; other rows are left alone.
    pub final_observations: &'a mut [f32],
}

impl<E: Env> EnvPool<E> {
    /// A pool of these environments (at least one, all of one kind), whose episodes are drawn from `seed`.
    pub fn new(seed: u64, envs: Vec<E>) -> Self {
        let (sizes, stride) = (block_sizes(envs.len()), envs.len() as u64);
        let mut slots = envs.into_iter().map(|env| Slot { env, next_episode: 0 });
        let block = |size| EnvBlock { slots: slots.by_ref().take(size).collect(), seed, stride, finished: Vec::new() };
        Self { blocks: sizes.into_iter().map(block).collect() }
    }

    /// The number of environments.
    pub fn len(&self) -> usize {
        self.blocks.iter().map(EnvBlock::len).sum()
    }

    /// Never true: a pool has at least one environment.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.blocks[0].slots[0].env.observation_size()
    }

    /// Numbers in an action.
    pub fn action_size(&self) -> usize {
        self.blocks[0].slots[0].env.action_size()
    }

    /// The number of environments in each block.
    pub fn block_sizes(&self) -> Vec<usize> {
        self.blocks.iter().map(EnvBlock::len).collect()
    }

    /// The blocks in order.
    pub fn blocks_mut(&mut self) -> &mut [EnvBlock<E>] {
        &mut self.blocks
    }

    /// Starts an episode in every environment, at random ages so that they do not all end together.
    ///
    /// Episodes are numbered from `first_episode` on: those before it are not played again. Writes the `observations`
    /// `[n, O]` of each block.
    pub fn reset(&mut self, first_episode: u64, observations: Vec<&mut [f32]>) {
        let size = self.observation_size();
        let slots = self.blocks.iter_mut().flat_map(|block| &mut block.slots);
        (first_episode..).zip(slots).for_each(|(episode, slot)| slot.next_episode = episode);
        self.blocks.par_iter_mut().zip_eq(observations).for_each(|(block, rows)| {
            for (slot, row) in block.slots.iter_mut().zip(rows.chunks_exact_mut(size)) {
                let age = rng::uniform(&mut rng::stream(block.seed, "age", slot.next_episode), 0.0, 1.0);
                slot.start(block.seed, block.stride, row);
                slot.env.skip_ahead(age);
            }
        });
    }

    /// The episodes that ended since the last call, in the order of blocks, then of steps, then of environments.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        self.blocks.iter_mut().flat_map(|block| block.finished.drain(..)).collect()
    }

    /// A number beyond those of all episodes that were begun; a pool that is reset with it repeats none of them.
    pub fn next_episode(&self) -> u64 {
        let slots = self.blocks.iter().flat_map(|block| &block.slots);
        slots.map(|slot| slot.next_episode).max().expect("a pool has at least one environment")
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.blocks.iter_mut().flat_map(|block| &mut block.slots).map(|slot| &mut slot.env)
    }
}

impl<E: Env> EnvBlock<E> {
    /// The number n of its environments.
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Never true: a block has at least one environment.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    /// Steps every environment with its row of `actions` `[n, A]`, and starts a new episode where one ended.
    pub fn step(&mut self, actions: &[f32], buffers: StepBuffers) {
        let env = &self.slots[0].env;
        let (size, action_size) = (env.observation_size(), env.action_size());
        assert_eq!(actions.len(), self.len() * action_size, "actions of a block");
        assert!(buffers.rewards.len() == self.len() && buffers.ends.len() == self.len(), "rows of a block");
        let both = [buffers.observations.len(), buffers.final_observations.len()];
        assert_eq!(both, [self.len() * size; 2], "observations of a block");
        let rows = buffers.observations.chunks_exact_mut(size).zip(buffers.final_observations.chunks_exact_mut(size));
        let results = buffers.rewards.iter_mut().zip(buffers.ends).zip(rows);
        let slots = self.slots.iter_mut().zip(actions.chunks_exact(action_size));
        for ((slot, action), ((reward, end), (row, final_row))) in slots.zip(results) {
            let transition: Transition = slot.env.step(action, row);
            (*reward, *end) = (transition.reward, transition.end);
            if let Some(end) = transition.end {
                if end == End::Truncated {
                    final_row.copy_from_slice(row);
                }
                self.finished.push(slot.env.episode());
                slot.start(self.seed, self.stride, row);
            }
        }
    }
}

impl<E: Env> Slot<E> {
    fn start(&mut self, seed: u64, stride: u64, row: &mut [f32]) {
        self.env.reset(rng::stream(seed, "episode", self.next_episode), row);
        self.next_episode += stride;
    }
}
