//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs. The randomness of an
//! episode depends on its number alone. The results therefore do not depend on which thread steps which block, or when.

use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;

use super::{End, Env, EnvState, Resumable, Transition};
use crate::ranks::{Blocks, Exchange};
use crate::rng;
use crate::schedule::panic_message;
use crate::sim::stepping;
use crate::spaces::Spaces;

/// N environments that start their next episode automatically.
pub struct EnvPool<E: Env> {
    blocks: Vec<EnvBlock<E>>,
}

/// A part of a pool that is stepped by one thread at a time.
pub struct EnvBlock<E: Env> {
    slots: Vec<Slot<E>>,
    seed: u64,
    /// The number of this block, counted over all that exchange.
    number: usize,
    /// The number of its first environment, counted likewise.
    first: usize,
    /// The number of all environments, by which the episode numbers of one environment increase.
    stride: u64,
    finished: Vec<E::Episode>,
}

struct Slot<E: Env> {
    env: E,
    next_episode: u64,
}

/// The outputs of a step of a block, with one row for each of its n environments; O is the observation size.
pub struct StepBuffers<'a> {
    /// Rewards `[n]`.
    pub rewards: &'a mut [f32],
    /// Ends `[n]`.
    pub ends: &'a mut [Option<End>],
    /// Observations `[n, O]` to act on next: the first of the new episode where one ended, under the new goal where the goal
    /// was replaced.
    pub observations: &'a mut [f32],
    /// Final observations `[n, O]` of episodes that were truncated, or under goals that were replaced; other rows are not
    /// written.
    pub final_observations: &'a mut [f32],
}

impl<E: Env> EnvPool<E> {
    /// Creates a pool of at least one environment, all of one kind, whose episodes are drawn from `seed`.
    pub fn new(seed: u64, envs: Vec<E>) -> Self {
        let blocks = Exchange::alone(1).blocks(envs.len());
        Self::in_blocks(seed, envs, blocks)
    }

    /// Creates a pool of environments in these blocks.
    pub fn in_blocks(seed: u64, envs: Vec<E>, blocks: Blocks) -> Self {
        let (mut first, stride) = (blocks.first_env, blocks.envs as u64);
        let mut slots = envs.into_iter().map(|env| Slot { env, next_episode: 0 });
        let block = |(number, size)| {
            let slots = slots.by_ref().take(size).collect();
            first += size;
            EnvBlock { slots, seed, number, first: first - size, stride, finished: Vec::new() }
        };
        Self { blocks: (blocks.first_block..).zip(blocks.sizes).map(block).collect() }
    }

    /// Returns the number of environments.
    pub fn count(&self) -> usize {
        self.blocks.iter().map(EnvBlock::count).sum()
    }

    /// Returns the number of environments in each block.
    pub fn block_sizes(&self) -> Vec<usize> {
        self.blocks.iter().map(EnvBlock::count).collect()
    }

    /// Returns the blocks in order.
    pub fn blocks_mut(&mut self) -> &mut [EnvBlock<E>] {
        &mut self.blocks
    }

    /// Starts the first episode of every environment, at a random age so that they do not all end together, and writes the
    /// `observations` `[n, O]` of each block.
    pub fn reset(&mut self, observations: Vec<&mut [f32]>) {
        let size = E::SPACES.observation_size;
        for block in &mut self.blocks {
            (block.first as u64..).zip(&mut block.slots).for_each(|(episode, slot)| slot.next_episode = episode);
        }
        self.blocks.par_iter_mut().zip_eq(observations).for_each(|(block, rows)| {
            for (i, (slot, row)) in block.slots.iter_mut().zip(rows.chunks_exact_mut(size)).enumerate() {
                let age = rng::uniform(&mut rng::stream(block.seed, "age", slot.next_episode), 0.0, 1.0);
                stepping("environment", block.first + i, || slot.start(block.seed, block.stride, row));
                slot.env.skip_ahead(age);
            }
        });
    }

    /// Switches all environments to `lesson` from the next step on.
    pub fn set_lesson(&mut self, lesson: E::Lesson) {
        self.envs_mut().for_each(|env| env.set_lesson(lesson));
    }

    /// Returns the episodes that ended since the last call, ordered by block, then step, then environment.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        self.blocks.iter_mut().flat_map(|block| block.finished.drain(..)).collect()
    }

    /// Returns the number of the first environment.
    pub fn first(&self) -> usize {
        self.blocks[0].first
    }

    /// Returns the environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.blocks.iter_mut().flat_map(|block| &mut block.slots).map(|slot| &mut slot.env)
    }
}

impl<E: Resumable> EnvPool<E> {
    /// Returns the state of every environment. It does not include finished episodes that have not been taken yet.
    pub fn save(&self) -> EnvState {
        let mut state = EnvState::default();
        for slot in self.blocks.iter().flat_map(|block| &block.slots) {
            state.counters.push(slot.next_episode);
            slot.env.save(&mut state);
        }
        state
    }

    /// Resumes, bit for bit, from the states of all environments, and writes the `observations` `[n, O]` of each
    /// block to act on next.
    ///
    /// # Errors
    /// Fails if no such pool can have saved this state.
    pub fn restore(&mut self, state: &EnvState, observations: Vec<&mut [f32]>) -> Result<()> {
        let (size, of_all) = (E::SPACES.observation_size, self.blocks[0].stride as usize);
        let mut rows = state.rows(of_all)?.skip(self.first());
        let first = self.first();
        let slots = self.blocks.iter_mut().flat_map(|block| &mut block.slots);
        for (i, (slot, row)) in
            slots.zip(observations.into_iter().flat_map(|rows| rows.chunks_exact_mut(size))).enumerate()
        {
            let mut state = rows.next().expect("one row per environment");
            let restore = || {
                let [next_episode] = state.counters()?;
                ensure!(next_episode < 1 << 60, "episode number {next_episode} is out of range");
                slot.next_episode = next_episode;
                slot.env.restore(&mut state, row)?;
                state.finish()
            };
            stepping("environment", first + i, restore).with_context(|| format!("environment {}", first + i))?;
        }
        self.blocks.iter_mut().for_each(|block| block.finished.clear());
        Ok(())
    }
}

impl<E: Env> EnvBlock<E> {
    /// Returns the number of this block.
    pub fn number(&self) -> usize {
        self.number
    }

    /// Returns the number n of environments in this block.
    pub fn count(&self) -> usize {
        self.slots.len()
    }

    /// Steps every environment with its row of `actions` `[n, A]`. Where an episode ended, starts a new one; where a goal was
    /// replaced, continues under another.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics; the pool must not be stepped again.
    pub fn step(&mut self, actions: &[f32], buffers: StepBuffers) -> Result<()> {
        let Spaces { observation_size: size, action_size, .. } = E::SPACES;
        assert_eq!(actions.len(), self.count() * action_size, "length of the block's actions");
        assert!(buffers.rewards.len() == self.count() && buffers.ends.len() == self.count(), "rows of a block");
        let both = [buffers.observations.len(), buffers.final_observations.len()];
        assert_eq!(both, [self.count() * size; 2], "lengths of the block's observations");
        let rows = buffers.observations.chunks_exact_mut(size).zip(buffers.final_observations.chunks_exact_mut(size));
        let results = buffers.rewards.iter_mut().zip(buffers.ends).zip(rows);
        let slots = self.slots.iter_mut().zip(actions.chunks_exact(action_size));
        for (i, ((slot, action), ((reward, end), (row, final_row)))) in slots.zip(results).enumerate() {
            let step = || {
                let transition: Transition = slot.env.step(action, row);
                (*reward, *end) = (transition.reward, transition.end);
                if let Some(End::Truncated | End::Redirected) = transition.end {
                    final_row.copy_from_slice(row);
                }
                match transition.end {
                    None => {}
                    Some(End::Redirected) => slot.env.redirect(row),
                    Some(End::Truncated | End::Terminated) => {
                        self.finished.push(slot.env.episode());
                        slot.start(self.seed, self.stride, row);
                    }
                }
            };
            // Unwind safe: a state that a panic left inconsistent is not used again.
            let number = self.first + i;
            if let Err(panic) = stepping("environment", number, || catch_unwind(AssertUnwindSafe(step))) {
                bail!("environment {number} panicked: {}", panic_message(&*panic));
            }
        }
        Ok(())
    }
}

impl<E: Env> Slot<E> {
    fn start(&mut self, seed: u64, stride: u64, row: &mut [f32]) {
        self.env.reset(rng::stream(seed, "episode", self.next_episode), row);
        self.next_episode += stride;
    }
}
