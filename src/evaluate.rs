//! Plays whole episodes of the task, every one counted: what a score is made of.
//!
//! Episode k depends on (seed, k) and the actor alone. Episodes run in groups of a fixed size, one in each lane, so that the
//! nets always see batches of one shape and the result does not depend on threads or on how many episodes are asked for.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::env::{ACTION_SIZE, End, Env, EpisodeStats, OBSERVATION_SIZE, Repose, Task};
use crate::ppo::{FrozenPolicy, Workspace};
use crate::rng::{self, Rng};

/// Episodes that run together.
const LANES: usize = 64;

/// What chooses the actions.
pub enum Actor<'a> {
    /// The mean action of a policy.
    Mean(FrozenPolicy<'a>),
    /// Actions drawn from the distribution of a policy.
    Stochastic(FrozenPolicy<'a>),
    /// Always 0.
    Zero,
    /// Uniform in [-1, 1].
    Random,
}

/// A set of episodes.
#[derive(Clone, Copy, Debug)]
pub struct Episodes {
    /// Episode k is drawn from (seed, purpose, k).
    pub seed: u64,
    /// What they are for: the episodes that choose a policy are not those that score it.
    pub purpose: &'static str,
    /// How many.
    pub count: usize,
}

/// What an observer of the episodes sees: a reset, or a step just taken.
pub struct Moment<'a> {
    /// Number of the episode.
    pub episode: usize,
    /// The environment after it.
    pub env: &'a Repose,
    /// The observation after it.
    pub observation: &'a [f32],
    /// The action as the actor gave it and whether the episode ended; `None` at a reset.
    pub step: Option<(&'a [f32], Option<End>)>,
}

struct Lane {
    env: Repose,
    noise: Rng,
    running: bool,
}

impl Lane {
    fn start(&mut self, episodes: Episodes, episode: usize, observation: &mut [f32]) {
        self.running = episode < episodes.count;
        if self.running {
            self.env.reset(rng::stream(episodes.seed, episodes.purpose, episode as u64), observation);
            self.noise = rng::stream(episodes.seed, "play noise", episode as u64);
        }
    }
}

/// Plays the episodes and returns them in order, or `None` if `interrupted` was set meanwhile. The observer sees the moments
/// of one episode in order, those of different episodes interleaved.
///
/// # Errors
/// Only if candle cannot allocate.
pub fn evaluate(
    task: &Arc<Task>,
    actor: &Actor,
    episodes: Episodes,
    interrupted: &AtomicBool,
    observer: &mut dyn FnMut(Moment),
) -> Result<Option<Vec<EpisodeStats>>> {
    let lane = || Lane { env: Repose::new(task), noise: rng::stream(0, "unused", 0), running: false };
    let mut lanes: Vec<Lane> = (0..LANES.min(episodes.count)).map(|_| lane()).collect();
    let mut observations = vec![0.0; LANES * OBSERVATION_SIZE];
    let mut actions = vec![0.0; LANES * ACTION_SIZE];
    let mut work = actor.policy().map(|policy| policy.workspace(LANES));
    let mut results = Vec::with_capacity(episodes.count);
    for first in (0..episodes.count).step_by(LANES) {
        let rows = observations.par_chunks_exact_mut(OBSERVATION_SIZE);
        lanes.par_iter_mut().zip(rows).enumerate().for_each(|(i, (lane, row))| lane.start(episodes, first + i, row));
        let started = lanes.iter().filter(|lane| lane.running).count();
        let mut ends: Vec<Option<End>> = vec![None; lanes.len()];
        for (i, observation) in observations.chunks_exact(OBSERVATION_SIZE).take(started).enumerate() {
            observer(Moment { episode: first + i, env: &lanes[i].env, observation, step: None });
        }
        while lanes.iter().any(|lane| lane.running) {
            if interrupted.load(Ordering::Relaxed) {
                return Ok(None);
            }
            actor.choose(&observations, &mut lanes, &mut actions, work.as_mut())?;
            lanes
                .par_iter_mut()
                .zip(actions.par_chunks_exact(ACTION_SIZE))
                .zip(observations.par_chunks_exact_mut(OBSERVATION_SIZE))
                .zip(&mut ends)
                .filter(|(((lane, _), _), _)| lane.running)
                .for_each(|(((lane, action), row), end)| *end = lane.env.step(action, row).end);
            for (i, lane) in lanes.iter_mut().enumerate().filter(|(_, lane)| lane.running) {
                let observation = &observations[i * OBSERVATION_SIZE..][..OBSERVATION_SIZE];
                let action = &actions[i * ACTION_SIZE..][..ACTION_SIZE];
                let step = Some((action, ends[i]));
                observer(Moment { episode: first + i, env: &lane.env, observation, step });
                lane.running = ends[i].is_none();
            }
        }
        results.extend(lanes[..started].iter().map(|lane| lane.env.episode()));
    }
    Ok(Some(results))
}

impl Actor<'_> {
    fn policy(&self) -> Option<&FrozenPolicy<'_>> {
        match self {
            Actor::Mean(policy) | Actor::Stochastic(policy) => Some(policy),
            Actor::Zero | Actor::Random => None,
        }
    }

    /// Writes the actions of all lanes; a lane that has ended gets one too, which is not used.
    fn choose(
        &self,
        observations: &[f32],
        lanes: &mut [Lane],
        actions: &mut [f32],
        work: Option<&mut Workspace>,
    ) -> Result<()> {
        if let (Some(policy), Some(work)) = (self.policy(), work) {
            policy.forward(observations, [Some(actions), None], work)?;
        }
        for (lane, row) in lanes.iter_mut().zip(actions.chunks_exact_mut(ACTION_SIZE)) {
            match self {
                Actor::Mean(_) => {}
                Actor::Stochastic(policy) => {
                    for (action, std) in row.iter_mut().zip(policy.std()) {
                        let drawn: f32 = StandardNormal.sample(&mut lane.noise);
                        *action += std * drawn;
                    }
                }
                Actor::Zero => row.fill(0.0),
                Actor::Random => row.fill_with(|| rng::uniform(&mut lane.noise, -1.0, 1.0) as f32),
            }
        }
        Ok(())
    }
}
