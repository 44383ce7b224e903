//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs, and the randomness of an
//! episode depends on its number alone; so the results do not depend on which thread steps which block when.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;

use super::{End, Env, EnvState, Resumable, Transition};
use crate::ranks::Division;
use crate::rng;
use crate::schedule::{block_sizes, panic_message};
use crate::spaces::Spaces;

/// N environments that start their next episode by themselves.
pub struct EnvPool<E: Env> {
    blocks: Vec<EnvBlock<E>>,
}

/// Some environments of a pool, that one thread steps at a time.
pub struct EnvBlock<E: Env> {
    slots: Vec<Slot<E>>,
    seed: u64,
    /// Its number among the blocks of all ranks.
    number: usize,
    /// The number of its first environment.
    first: usize,
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
    /// `[n, O]`, the observation to act on next: of the new episode where one ended, under the new goal where it was replaced.
    pub observations: &'a mut [f32],
    /// `[n, O]`, the last observation of the episode where one was truncated, or under the goal that was replaced; other rows
    /// are left alone.
    pub final_observations: &'a mut [f32],
}

impl<E: Env> EnvPool<E> {
    /// A pool of these environments (at least one, all of one kind), whose episodes are drawn from `seed`.
    pub fn new(seed: u64, envs: Vec<E>) -> Self {
        Self::of_shards(seed, envs, &Division::alone(1))
    }

    /// The same of the environments of this rank's shards, which have as many each; no block is of two shards.
    pub fn of_shards(seed: u64, envs: Vec<E>, division: &Division) -> Self {
        let (shards, own) = (division.shards(), division.own());
        let in_shard = envs.len() / own.len();
        assert_eq!(in_shard * own.len(), envs.len(), "environments of {} shards", own.len());
        let sizes = block_sizes(in_shard, in_shard * shards);
        let mut first = own.start * in_shard;
        let mut slots = envs.into_iter().map(|env| Slot { env, next_episode: 0 });
        let block = |(i, &size): (usize, &usize)| {
            let slots = slots.by_ref().take(size).collect();
            first += size;
            let (number, stride) = (own.start * sizes.len() + i, (in_shard * shards) as u64);
            EnvBlock { slots, seed, number, first: first - size, stride, finished: Vec::new() }
        };
        let of_all_shards = own.clone().flat_map(|_| &sizes);
        Self { blocks: of_all_shards.enumerate().map(block).collect() }
    }

    /// The number of environments.
    pub fn count(&self) -> usize {
        self.blocks.iter().map(EnvBlock::count).sum()
    }

    /// The number of environments in each block.
    pub fn block_sizes(&self) -> Vec<usize> {
        self.blocks.iter().map(EnvBlock::count).collect()
    }

    /// The blocks in order.
    pub fn blocks_mut(&mut self) -> &mut [EnvBlock<E>] {
        &mut self.blocks
    }

    /// Starts the first episode of every environment, at random ages so that they do not all end together. Writes the
    /// `observations` `[n, O]` of each block.
    pub fn reset(&mut self, observations: Vec<&mut [f32]>) {
        let size = E::SPACES.observation_size;
        for block in &mut self.blocks {
            (block.first as u64..).zip(&mut block.slots).for_each(|(episode, slot)| slot.next_episode = episode);
        }
        self.blocks.par_iter_mut().zip_eq(observations).for_each(|(block, rows)| {
            for (slot, row) in block.slots.iter_mut().zip(rows.chunks_exact_mut(size)) {
                let age = rng::uniform(&mut rng::stream(block.seed, "age", slot.next_episode), 0.0, 1.0);
                slot.start(block.seed, block.stride, row);
                slot.env.skip_ahead(age);
            }
        });
    }

    /// Trains this lesson from now on.
    pub fn set_lesson(&mut self, lesson: E::Lesson) {
        self.envs_mut().for_each(|env| env.set_lesson(lesson));
    }

    /// The episodes that ended since the last call, in the order of blocks, then of steps, then of environments.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        self.blocks.iter_mut().flat_map(|block| block.finished.drain(..)).collect()
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.blocks.iter_mut().flat_map(|block| &mut block.slots).map(|slot| &mut slot.env)
    }
}

impl<E: Resumable> EnvPool<E> {
    /// The state of every environment. Episodes that ended and were not taken yet are not part of it.
    pub fn save(&self) -> EnvState {
        let mut state = EnvState::default();
        for slot in self.blocks.iter().flat_map(|block| &block.slots) {
            state.counters.push(slot.next_episode);
            slot.env.save(&mut state);
        }
        state
    }

    /// Goes on from the state of a pool of as many environments, bit for bit, and writes the `observations` `[n, O]` of each
    /// block to act on next.
    ///
    /// # Errors
    /// A state that no such pool can have saved.
    pub fn restore(&mut self, state: &EnvState, observations: Vec<&mut [f32]>) -> Result<()> {
        let size = E::SPACES.observation_size;
        let mut rows = state.rows(self.count())?;
        let slots = self.blocks.iter_mut().flat_map(|block| &mut block.slots);
        for (i, (slot, row)) in
            slots.zip(observations.into_iter().flat_map(|rows| rows.chunks_exact_mut(size))).enumerate()
        {
            let mut state = rows.next().expect("a row for each environment");
            let restore = || {
                let [next_episode] = state.counters()?;
                ensure!(next_episode < 1 << 60, "an episode with the number {next_episode}");
                slot.next_episode = next_episode;
                slot.env.restore(&mut state, row)?;
                state.finish()
            };
            restore().with_context(|| format!("environment {i}"))?;
        }
        self.blocks.iter_mut().for_each(|block| block.finished.clear());
        Ok(())
    }
}

impl<E: Env> EnvBlock<E> {
    /// Its number among the blocks of all ranks.
    pub fn number(&self) -> usize {
        self.number
    }

    /// The number n of its environments.
    pub fn count(&self) -> usize {
        self.slots.len()
    }

    /// Steps every environment with its row of `actions` `[n, A]`, and starts a new episode where one ended, or goes on under another goal.
    ///
    /// # Errors
    /// A panic in an environment, with its number; the pool cannot be stepped any further.
    pub fn step(&mut self, actions: &[f32], buffers: StepBuffers) -> Result<()> {
        let Spaces { observation_size: size, action_size, .. } = E::SPACES;
        assert_eq!(actions.len(), self.count() * action_size, "actions of a block");
        assert!(buffers.rewards.len() == self.count() && buffers.ends.len() == self.count(), "rows of a block");
        let both = [buffers.observations.len(), buffers.final_observations.len()];
        assert_eq!(both, [self.count() * size; 2], "observations of a block");
        let rows = buffers.observations.chunks_exact_mut(size).zip(buffers.final_observations.chunks_exact_mut(size));
        let results = buffers.rewards.iter_mut().zip(buffers.ends).zip(rows);
        let slots = self.slots.iter_mut().zip(actions.chunks_exact(action_size));
        for (i, ((slot, action), ((reward, end), (row, final_row)))) in slots.zip(results).enumerate() {
            STEPPING.set(Some(self.first + i));
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
            // What a panic leaves half done is not used again.
            if let Err(panic) = catch_unwind(AssertUnwindSafe(step)) {
                bail!("environment {} panicked: {}", self.first + i, panic_message(&*panic));
            }
        }
        STEPPING.set(None);
        Ok(())
    }
}

thread_local! {
    static STEPPING: Cell<Option<usize>> = const { Cell::new(None) };
}

/// The number of the environment that this thread is stepping, if it is: for whoever must tell when there is no way to return.
pub fn stepping() -> Option<usize> {
    STEPPING.get()
}

impl<E: Env> Slot<E> {
    fn start(&mut self, seed: u64, stride: u64, row: &mut [f32]) {
        self.env.reset(rng::stream(seed, "episode", self.next_episode), row);
        self.next_episode += stride;
    }
}
