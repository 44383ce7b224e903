//! Many environments, in blocks that step independently of one another.
//!
//! Environment i reads and writes its own row of each array and owns everything else that it needs. The randomness of an
//! episode depends on its number alone. The results therefore do not depend on which thread steps which block, or when.

use anyhow::{Context, Result, anyhow, ensure};
use rayon::prelude::*;

use super::{End, Env, EnvState, Resumable};
use crate::ranks::Exchange;
use crate::rng;
use crate::schedule::{block_sizes, caught};
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
#[derive(Clone, Copy, PartialEq)]
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
    /// Its environments in order.
    pub members: Vec<Member<E>>,
    /// The description of observations and actions.
    pub spaces: Spaces,
    finished: Vec<E::Episode>,
}

/// An environment of a block.
pub struct Member<E: Env> {
    /// The environment.
    pub env: E,
    /// The end of the last step.
    pub end: Option<End>,
    /// The final observation `[O]` of the last episode that ended, or under the last goal that was replaced.
    pub final_observation: Vec<f32>,
    /// Its number, counted over all ranks.
    pub number: usize,
    /// The seed of its episodes.
    pub seed: u64,
    /// The number of its next episode.
    pub next_episode: u64,
    /// By how much the numbers of its episodes increase: the number of all environments, unless its seed is its own.
    pub stride: u64,
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
        let all = in_shard * exchange.shards;
        let sizes = block_sizes(in_shard, all);
        let members = (shards.start * in_shard..).zip(envs);
        let mut members = members.map(|(number, env)| Member {
            env,
            end: None,
            final_observation: vec![0.0; spaces.observation_size],
            number,
            seed,
            next_episode: number as u64,
            stride: all as u64,
        });
        let blocks = (shards.start * sizes.len()..).zip(sizes.repeat(shards.len()));
        let blocks = blocks.map(|(number, size)| EnvBlock {
            number,
            members: members.by_ref().take(size).collect(),
            spaces,
            finished: Vec::new(),
        });
        Self {
            blocks: blocks.collect(),
        }
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
        self.blocks
            .iter()
            .map(|block| block.members.len())
            .collect()
    }

    /// Starts the first episode of every environment, and writes its row `[O]` of the observations. Ages are
    /// random, so that the episodes do not all end together.
    pub fn reset<'a>(&mut self, rows: impl Iterator<Item = &'a mut [f32]> + Send) {
        self.members_mut()
            .zip(rows)
            .par_bridge()
            .for_each(|(member, row)| member.restart(true, row));
    }

    /// Starts the next episode of each environment that is `marked`, at a random age if `aged`, and writes its row of the
    /// `observations` `[N, O]`.
    pub fn restart(&mut self, marked: &[bool], aged: bool, observations: &mut [f32]) {
        let rows = observations.chunks_exact_mut(self.spaces().observation_size);
        let members = self.members_mut().zip(rows).zip(marked);
        members
            .filter(|(_, marked)| **marked)
            .par_bridge()
            .for_each(|((member, row), _)| member.restart(aged, row));
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
        let members: Vec<_> = self.members_mut().zip(rows).collect();
        let ended = members
            .into_par_iter()
            .enumerate()
            .with_max_len(MOST_AT_ONCE)
            .filter_map(|(place, (member, row))| {
                let ended = member.step(autoreset, row).transpose()?;
                Some(ended.map(|episode| (place, episode)))
            });
        ended.collect()
    }

    /// Switches all environments to `lesson` from the next step on.
    pub fn set_lesson(&mut self, lesson: E::Lesson) {
        self.envs_mut().for_each(|env| env.set_lesson(lesson));
    }

    /// The episodes that ended since the last call, ordered by block, then step, then environment.
    pub fn take_finished(&mut self) -> Vec<E::Episode> {
        self.blocks
            .iter_mut()
            .flat_map(|block| block.finished.drain(..))
            .collect()
    }

    /// The environments in order.
    pub fn envs_mut(&mut self) -> impl Iterator<Item = &mut E> {
        self.members_mut().map(|member| &mut member.env)
    }

    /// The environments in order, each with its number.
    pub fn members_mut(&mut self) -> impl Iterator<Item = &mut Member<E>> {
        self.blocks.iter_mut().flat_map(|block| &mut block.members)
    }
}

impl<E: Resumable> EnvPool<E> {
    /// The state of every environment. It does not include finished episodes that have not been taken yet.
    pub fn save(&self) -> EnvState {
        let mut state = EnvState::default();
        for member in self.blocks.iter().flat_map(|block| &block.members) {
            state.counters.push(member.next_episode);
            member.env.save(&mut state);
        }
        state
    }

    /// Resumes, bit for bit, from the states of all environments, and writes the observation `[O]` of each to act on
    /// next.
    ///
    /// # Errors
    /// Fails if no such pool can have saved this state.
    pub fn restore<'a>(
        &mut self,
        state: &EnvState,
        rows: impl Iterator<Item = &'a mut [f32]>,
    ) -> Result<()> {
        let first = &self.blocks[0].members[0];
        let states = state.rows(first.stride as usize)?.skip(first.number);
        for (member, (row, mut state)) in self.members_mut().zip(rows.zip(states)) {
            let number = member.number;
            let restore = || {
                let [next_episode] = state.counters()?;
                ensure!(
                    next_episode < 1 << 60,
                    "episode number {next_episode} is out of range"
                );
                member.next_episode = next_episode;
                member.env.restore(&mut state, row)?;
                state.finish()
            };
            stepping("environment", number, restore)
                .with_context(|| format!("environment {number}"))?;
        }
        self.take_finished();
        Ok(())
    }
}

impl<E: Env> EnvBlock<E> {
    /// Steps every environment with its row of `actions` `[n, A]`. Where an episode ended, starts a new one. Where a goal was
    /// replaced, continues under another one. Writes the `rewards` `[n]`, and the `observations` `[n, O]` to act on next. These
    /// belong to the new episode or show the new goal.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics. The pool must not be stepped again.
    pub fn step(
        &mut self,
        actions: &[f32],
        rewards: &mut [f32],
        observations: &mut [f32],
    ) -> Result<()> {
        let rows = rows(
            self.spaces,
            self.members.len(),
            actions,
            rewards,
            observations,
        );
        for (member, row) in self.members.iter_mut().zip(rows) {
            self.finished.extend(member.step(Autoreset::SameStep, row)?);
        }
        Ok(())
    }
}

/// The action `[A]`, the reward and the observation `[O]` of an environment: what a step reads, and what it writes.
type Row<'a> = ((&'a [f32], &'a mut f32), &'a mut [f32]);

/// The rows of `n` environments in the arrays `[n, A]`, `[n]` and `[n, O]`.
///
/// # Panics
/// Panics if the arrays have other lengths.
fn rows<'a>(
    Spaces {
        observation_size,
        action_size,
        ..
    }: Spaces,
    n: usize,
    actions: &'a [f32],
    rewards: &'a mut [f32],
    observations: &'a mut [f32],
) -> impl Iterator<Item = Row<'a>> {
    assert_eq!(
        [actions.len(), rewards.len(), observations.len()],
        [n * action_size, n, n * observation_size],
        "lengths of the actions, rewards and observations"
    );
    actions
        .chunks_exact(action_size)
        .zip(rewards)
        .zip(observations.chunks_exact_mut(observation_size))
}

impl<E: Env> Member<E> {
    /// Starts the next episode, at a random age if `aged`, and writes the observation.
    fn restart(&mut self, aged: bool, observation: &mut [f32]) {
        stepping("environment", self.number, || {
            let mut rng = rng::stream(self.seed, "age", self.next_episode);
            self.start(observation);
            if aged {
                self.env.skip_ahead(rng::uniform(&mut rng, 0.0, 1.0));
            }
        });
    }

    fn start(&mut self, observation: &mut [f32]) {
        self.end = None;
        self.env.reset(
            rng::stream(self.seed, "episode", self.next_episode),
            observation,
        );
        self.next_episode += self.stride;
    }

    /// Steps the environment, or starts its next episode where that takes the place of a step. The result is the episode that
    /// ended.
    ///
    /// # Errors
    /// Fails with the environment's number if it panics.
    fn step(
        &mut self,
        autoreset: Autoreset,
        ((action, reward), observation): Row,
    ) -> Result<Option<E::Episode>> {
        let number = self.number;
        let step = || {
            let is_over = |end| matches!(end, Some(End::Truncated | End::Terminated));
            if autoreset == Autoreset::NextStep && is_over(self.end) {
                *reward = 0.0;
                self.start(observation);
                return None;
            }
            let transition = self.env.step(action, observation);
            *reward = transition.reward;
            if transition.end.is_some() {
                self.final_observation.copy_from_slice(observation);
            }
            let ended = is_over(transition.end).then(|| self.env.episode());
            if transition.end == Some(End::Redirected) {
                self.env.redirect(observation);
            } else if ended.is_some() && autoreset == Autoreset::SameStep {
                self.start(observation);
            }
            self.end = transition.end;
            ended
        };
        stepping("environment", number, || caught(step))
            .map_err(|panic| anyhow!("environment {number} panicked: {panic}"))
    }
}
