//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs. The randomness of an
//! episode depends on its number alone. The results therefore do not depend on which thread steps which block, or when.

use std::panic::{AssertUnwindSafe, catch_unwind};

use anyhow::{Context, Result, anyhow, ensure};
use rayon::prelude::*;

use super::{End, Env, EnvState, Resumable, Transition};
use crate::ranks::Exchange;
use crate::rng;
use crate::schedule::{block_sizes, panic_message};
use crate::sim::stepping;
use crate::spaces::Spaces;

/// The most environments that a thread steps before it can share the rest with other threads.
const MOST_AT_ONCE: usize = 8;

/// N environments that start their next episode automatically. O is the observation size.
pub struct EnvPool<E: Env> {
    /// Its blocks, in the order of the environments. None spans two shards.
    pub blocks: Vec<EnvBlock<E>>,
}

/// When an environment whose episode ended starts the next one, in the words of Gymnasium.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Autoreset {
    /// In the step that ended the episode, whose observation is then the first one of the next.
    SameStep,
    /// In place of the step after it. The action of that step is ignored, and its reward is 0.
    NextStep,
    /// Never by itself: [`EnvPool::restart`] does it.
    Disabled,
}

/// The n environments of a pool that are stepped by one thread at a time.
pub struct EnvBlock<E: Env> {
    /// The number of this block, counted over all ranks.
    pub number: usize,
    /// The number of its first environment, counted over all ranks.
    pub first: usize,
    /// The ends `[n]` of the last step.
    pub ends: Vec<Option<End>>,
    /// Final observations `[n, O]` of the episodes that ended in the last step, and under goals that were replaced. Other rows are
    /// older.
    pub final_observations: Vec<f32>,
    /// The description of observations and actions.
    pub spaces: Spaces,
    slots: Vec<Slot<E>>,
    draw: Draw,
    finished: Vec<E::Episode>,
}

struct Slot<E: Env> {
    env: E,
    next_episode: u64,
}

/// Where episodes are drawn from.
#[derive(Clone, Copy)]
struct Draw {
    seed: u64,
    /// The number of all environments, by which the episode numbers of one environment increase.
    stride: u64,
}

/// An environment with its part of its block.
struct Member<'a, E: Env> {
    /// Its number, counted over all ranks.
    number: usize,
    slot: &'a mut Slot<E>,
    draw: Draw,
    end: &'a mut Option<End>,
    final_observation: &'a mut [f32],
}

impl<E: Env> EnvPool<E> {
    /// Creates a pool of these environments of one kind, which `exchange` assigns to this rank. Their episodes are drawn from
    /// `seed`.
    ///
    /// # Panics
    /// Panics if there are none, or if they do not divide evenly into the shards of this rank.
    pub fn new(seed: u64, envs: Vec<E>, exchange: &Exchange) -> Self {
        let shards = exchange.own_shards();
        let spaces = envs[0].spaces();
        let in_shard = envs.len() / shards.len();
        assert_eq!(
            in_shard * shards.len(),
            envs.len(),
            "environments do not divide evenly into {} shards",
            shards.len()
        );
        let all = in_shard * exchange.shards();
        let sizes = block_sizes(in_shard, all);
        let first_block = shards.start * sizes.len();
        let mut first = shards.start * in_shard;
        let mut slots = (first as u64..).zip(envs).map(|(next_episode, env)| Slot { env, next_episode });
        let block = |(number, size)| {
            first += size;
            EnvBlock {
                number,
                first: first - size,
                ends: vec![None; size],
                final_observations: vec![0.0; size * spaces.observation_size],
                slots: slots.by_ref().take(size).collect(),
                spaces,
                draw: Draw { seed, stride: all as u64 },
                finished: Vec::new(),
            }
        };
        Self { blocks: (first_block..).zip(sizes.repeat(shards.len())).map(block).collect() }
    }

    /// The description of observations and actions.
    pub fn spaces(&self) -> Spaces {
        self.blocks[0].spaces
    }

    /// The number of environments.
    pub fn count(&self) -> usize {
        self.block_sizes().iter().sum()
    }

    /// The number of environments in each block.
    pub fn block_sizes(&self) -> Vec<usize> {
        self.blocks.iter().map(EnvBlock::count).collect()
    }

    /// Starts the first episode of every environment, and writes the `observations` `[n, O]` of each block. Ages are
    /// random, so that the episodes do not all end together.
    pub fn reset(&mut self, observations: Vec<&mut [f32]>) {
        let size = self.spaces().observation_size;
        self.blocks.par_iter_mut().zip_eq(observations).for_each(|(block, rows)| {
            for (member, row) in block.members().zip(rows.chunks_exact_mut(size)) {
                stepping("environment", member.number, || member.slot.start_aged(member.draw, row));
            }
        });
    }

    /// Makes the first episodes of `seed` start next.
    pub fn reseed(&mut self, seed: u64) {
        for block in &mut self.blocks {
            block.draw.seed = seed;
            (block.first as u64..).zip(&mut block.slots).for_each(|(episode, slot)| slot.next_episode = episode);
        }
    }

    /// Starts the next episode of each environment that is `marked`, at a random age if `aged`, and writes its row of the
    /// `observations` `[N, O]`.
    pub fn restart(&mut self, marked: &[bool], aged: bool, observations: &mut [f32]) {
        let rows = observations.chunks_exact_mut(self.spaces().observation_size);
        let members = self.blocks.iter_mut().flat_map(EnvBlock::members).zip(rows).zip(marked);
        let chosen: Vec<_> = members.filter(|(_, marked)| **marked).map(|(member, _)| member).collect();
        chosen.into_par_iter().for_each(|(Member { number, slot, draw, end, .. }, row)| {
            *end = None;
            stepping("environment", number, || if aged { slot.start_aged(draw, row) } else { slot.start(draw, row) });
        });
    }

    /// Steps every environment with its row of `actions` `[N, A]`. Writes `rewards` `[N]` and `observations` `[N, O]`, and to the
    /// blocks the ends and the final observations. Where a goal was replaced, the observation already shows the new one. Returns
    /// the episodes that ended, with the places of their environments. Threads share the work in parts smaller than a block,
    /// because all wait for the last one.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics. The pool must not be stepped again.
    pub fn step(
        &mut self,
        actions: &[f32],
        autoreset: Autoreset,
        rewards: &mut [f32],
        observations: &mut [f32],
    ) -> Result<Vec<(usize, E::Episode)>> {
        let rows = rows(self.spaces(), self.count(), actions, rewards, observations);
        let members: Vec<_> = self.blocks.iter_mut().flat_map(EnvBlock::members).zip(rows).collect();
        let ended = members.into_par_iter().enumerate().with_max_len(MOST_AT_ONCE).map(|(place, (member, row))| {
            let episode = member.step(autoreset, row)?;
            Ok(episode.map(|episode| (place, episode)))
        });
        Ok(ended.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect())
    }

    /// Switches all environments to `lesson` from the next step on.
    pub fn set_lesson(&mut self, lesson: E::Lesson) {
        self.envs_mut().for_each(|env| env.set_lesson(lesson));
    }

    /// The episodes that ended since the last call, ordered by block, then step, then environment.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        self.blocks.iter_mut().flat_map(|block| block.finished.drain(..)).collect()
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.blocks.iter_mut().flat_map(EnvBlock::envs_mut)
    }
}

impl<E: Resumable> EnvPool<E> {
    /// The state of every environment. It does not include finished episodes that have not been taken yet.
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
        let size = self.spaces().observation_size;
        let first = self.blocks[0].first;
        let states = state.rows(self.blocks[0].draw.stride as usize)?.skip(first);
        let slots = self.blocks.iter_mut().flat_map(|block| &mut block.slots);
        let rows = observations.into_iter().flat_map(|rows| rows.chunks_exact_mut(size));
        for (number, ((slot, row), mut state)) in (first..).zip(slots.zip(rows).zip(states)) {
            let restore = || {
                let [next_episode] = state.counters()?;
                ensure!(next_episode < 1 << 60, "episode number {next_episode} is out of range");
                slot.next_episode = next_episode;
                slot.env.restore(&mut state, row)?;
                state.finish()
            };
            stepping("environment", number, restore).with_context(|| format!("environment {number}"))?;
        }
        self.blocks.iter_mut().for_each(|block| block.finished.clear());
        Ok(())
    }
}

impl<E: Env> EnvBlock<E> {
    /// The number n of environments in this block.
    pub fn count(&self) -> usize {
        self.slots.len()
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.slots.iter_mut().map(|slot| &mut slot.env)
    }

    /// Steps every environment with its row of `actions` `[n, A]`. Where an episode ended, starts a new one. Where a goal was
    /// replaced, continues under another one. Writes the `rewards` `[n]`, and the `observations` `[n, O]` to act on next. These
    /// belong to the new episode or show the new goal.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics. The pool must not be stepped again.
    pub fn step(&mut self, actions: &[f32], rewards: &mut [f32], observations: &mut [f32]) -> Result<()> {
        let rows = rows(self.spaces, self.count(), actions, rewards, observations);
        let mut finished = std::mem::take(&mut self.finished);
        for (member, row) in self.members().zip(rows) {
            finished.extend(member.step(Autoreset::SameStep, row)?);
        }
        self.finished = finished;
        Ok(())
    }

    /// The environments in order, each with its part of the block.
    fn members(&mut self) -> impl Iterator<Item = Member<'_, E>> {
        let draw = self.draw;
        let finals = self.final_observations.chunks_exact_mut(self.spaces.observation_size);
        let own = self.slots.iter_mut().zip(&mut self.ends).zip(finals);
        (self.first..).zip(own).map(move |(number, ((slot, end), final_observation))| Member {
            number,
            slot,
            draw,
            end,
            final_observation,
        })
    }
}

/// The action `[A]`, the reward and the observation `[O]` of an environment: what a step reads, and what it writes.
type Row<'a> = ((&'a [f32], &'a mut f32), &'a mut [f32]);

/// The rows of `n` environments in the arrays `[n, A]`, `[n]` and `[n, O]`.
///
/// # Panics
/// Panics if the arrays have other lengths.
fn rows<'a>(
    Spaces { observation_size, action_size, .. }: Spaces,
    n: usize,
    actions: &'a [f32],
    rewards: &'a mut [f32],
    observations: &'a mut [f32],
) -> impl Iterator<Item = Row<'a>> {
    let found = [actions.len(), rewards.len(), observations.len()];
    assert_eq!(found, [n * action_size, n, n * observation_size], "lengths of the actions, rewards and observations");
    actions.chunks_exact(action_size).zip(rewards).zip(observations.chunks_exact_mut(observation_size))
}

impl<E: Env> Member<'_, E> {
    /// Steps the environment, or starts its next episode where that takes the place of a step. The result is the episode that
    /// ended.
    ///
    /// # Errors
    /// Fails with the environment's number if it panics.
    fn step(self, autoreset: Autoreset, ((action, reward), observation): Row) -> Result<Option<E::Episode>> {
        let Self { number, slot, draw, end, final_observation } = self;
        let step = || {
            if autoreset == Autoreset::NextStep && matches!(end, Some(End::Truncated | End::Terminated)) {
                *reward = 0.0;
                *end = None;
                slot.start(draw, observation);
                return None;
            }
            let transition: Transition = slot.env.step(action, observation);
            *reward = transition.reward;
            *end = transition.end;
            if end.is_some() {
                final_observation.copy_from_slice(observation);
            }
            match transition.end {
                None => None,
                Some(End::Redirected) => {
                    slot.env.redirect(observation);
                    None
                }
                Some(End::Truncated | End::Terminated) => {
                    let episode = slot.env.episode();
                    if autoreset == Autoreset::SameStep {
                        slot.start(draw, observation);
                    }
                    Some(episode)
                }
            }
        };
        // Unwind safe: a state that a panic left inconsistent is not used again.
        stepping("environment", number, || catch_unwind(AssertUnwindSafe(step)))
            .map_err(|panic| anyhow!("environment {number} panicked: {}", panic_message(&*panic)))
    }
}

impl<E: Env> Slot<E> {
    fn start(&mut self, draw: Draw, row: &mut [f32]) {
        self.env.reset(rng::stream(draw.seed, "episode", self.next_episode), row);
        self.next_episode += draw.stride;
    }

    fn start_aged(&mut self, draw: Draw, row: &mut [f32]) {
        let age = rng::uniform(&mut rng::stream(draw.seed, "age", self.next_episode), 0.0, 1.0);
        self.start(draw, row);
        self.env.skip_ahead(age);
    }
}
