//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs, and the randomness of an
//! episode depends on its number alone; so the results do not depend on which thread steps which block when.

use std::any::Any;
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;

use super::{End, Env, EnvState, Resumable, Transition};
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
    /// The number of its first environment.
    first: usize,
    /// The number of environments in the whole pool: so far apart are the numbers of an environment's episodes.
    stride: u64,
    finished: Vec<E::Episode>,
    perceive: fn(&mut [f32]),
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
        let (sizes, stride) = (block_sizes(envs.len()), envs.len() as u64);
        let mut slots = envs.into_iter().map(|env| Slot { env, next_episode: 0 });
        let mut first = 0;
        let block = |size| {
            let slots = slots.by_ref().take(size).collect();
            first += size;
            EnvBlock { slots, seed, first: first - size, stride, finished: Vec::new(), perceive: |_| {} }
        };
        Self { blocks: sizes.into_iter().map(block).collect() }
    }

    /// From now on turns the rows `[B, O]` of observations that it writes, in place, into those that the policy looks at.
    pub fn perceive_with(&mut self, perceive: fn(&mut [f32])) {
        self.blocks.iter_mut().for_each(|block| block.perceive = perceive);
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

    /// Starts the first episode of every environment, at random ages so that they do not all end together. Writes the
    /// `observations` `[n, O]` of each block.
    pub fn reset(&mut self, observations: Vec<&mut [f32]>) {
        let size = self.observation_size();
        let slots = self.blocks.iter_mut().flat_map(|block| &mut block.slots);
        (0..).zip(slots).for_each(|(episode, slot)| slot.next_episode = episode);
        self.blocks.par_iter_mut().zip_eq(observations).for_each(|(block, rows)| {
            for (slot, row) in block.slots.iter_mut().zip(rows.chunks_exact_mut(size)) {
                let age = rng::uniform(&mut rng::stream(block.seed, "age", slot.next_episode), 0.0, 1.0);
                slot.start(block.seed, block.stride, row);
                slot.env.skip_ahead(age);
                (block.perceive)(row);
            }
        });
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
        let size = self.observation_size();
        let mut rows = state.rows(self.len())?;
        let perceive = self.blocks[0].perceive;
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
                perceive(row);
                state.finish()
            };
            restore().with_context(|| format!("environment {i}"))?;
        }
        self.blocks.iter_mut().for_each(|block| block.finished.clear());
        Ok(())
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

    /// Steps every environment with its row of `actions` `[n, A]`, and starts a new episode where one ended, or goes on under another goal.
    ///
    /// # Errors
    /// A panic in an environment, with its number; the pool cannot be stepped any further.
    pub fn step(&mut self, actions: &[f32], buffers: StepBuffers) -> Result<()> {
        let env = &self.slots[0].env;
        let (size, action_size) = (env.observation_size(), env.action_size());
        assert_eq!(actions.len(), self.len() * action_size, "actions of a block");
        assert!(buffers.rewards.len() == self.len() && buffers.ends.len() == self.len(), "rows of a block");
        let both = [buffers.observations.len(), buffers.final_observations.len()];
        assert_eq!(both, [self.len() * size; 2], "observations of a block");
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
                    (self.perceive)(final_row);
                }
                match transition.end {
                    None => {}
                    Some(End::Redirected) => slot.env.redirect(row),
                    Some(End::Truncated | End::Terminated) => {
                        self.finished.push(slot.env.episode());
                        slot.start(self.seed, self.stride, row);
                    }
                }
                (self.perceive)(row);
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

/// What a panic said.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}

impl<E: Env> Slot<E> {
    fn start(&mut self, seed: u64, stride: u64, row: &mut [f32]) {
        self.env.reset(rng::stream(seed, "episode", self.next_episode), row);
        self.next_episode += stride;
    }
}
