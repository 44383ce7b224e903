//! The evaluation of an actor: plays whole episodes of the task, all of which count towards a score.
//!
//! Episode k depends only on the seed, the purpose, k and the actor. Episodes run in groups of a fixed size, one per lane, so
//! the nets always see batches of the same shape. Results therefore do not depend on threads or the number of episodes.

use std::f64::consts::TAU;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Result, anyhow, ensure};
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::env::{End, Env};
use crate::os::{Bar, expect_no_stop};
use crate::ppo::{FrozenPolicy, GROUP, Policy};
use crate::ranks::Exchange;
use crate::repose::{EpisodeStats, Repose, Score, Task};
use crate::rng::{self, Rng};
use crate::schedule::caught;
use crate::sim::stepping;
use crate::spaces::Spaces;

/// The number of episodes that run together.
const LANES: usize = GROUP;

/// The period of [`Actor::Wave`] in control steps.
const SWING: f64 = 300.0;

/// The source of actions.
pub enum Actor<'a> {
    /// The mean action of a policy.
    Mean(FrozenPolicy<'a>),
    /// Actions drawn from the distribution of a policy.
    Stochastic(FrozenPolicy<'a>),
    /// Zero actions.
    Zero,
    /// Uniform random actions in [-1, 1].
    Random,
    /// Slow swings of each actuator around the middle of its range, each a little later than the previous actuator's.
    Wave,
    /// A function from outside the program. It writes the actions `[N, A]` for the observations `[N, O]`.
    Outside(&'a Outside<'a>),
}

/// A function that chooses actions.
pub type Outside<'a> = dyn Fn(&[f32], &mut [f32]) + Sync + 'a;

/// A set of episodes.
#[derive(Clone, Copy)]
pub struct Episodes {
    /// Episode k is drawn from (seed, purpose, k).
    pub seed: u64,
    /// The purpose of the episodes: a policy is not scored on the episodes that selected it.
    pub purpose: &'static str,
    /// The number of the first episode.
    pub first: usize,
    /// The number of episodes.
    pub count: usize,
}

impl Episodes {
    /// The first `count` episodes for a score.
    pub fn scored(seed: u64, count: usize) -> Self {
        Self {
            seed,
            purpose: "score",
            first: 0,
            count,
        }
    }
}

/// An observer's view of an episode after a reset or a step.
pub struct Moment<'a> {
    /// The number of the episode.
    pub episode: usize,
    /// The environment after the reset or step.
    pub env: &'a Repose,
    /// The observation after the reset or step.
    pub observation: &'a [f32],
    /// The action as the actor chose it, and the end of the episode if this step ended it. `None` at a reset.
    pub step: Option<(&'a [f32], Option<End>)>,
}

/// What is told of every moment.
pub type Observer<'a> = dyn FnMut(Moment) -> Result<()> + 'a;

impl Moment<'_> {
    /// Whether this step ended the episode.
    pub fn ends(&self) -> bool {
        self.step.is_some_and(|(_, end)| end.is_some())
    }
}

/// An environment whose episodes are played.
pub struct Lane {
    /// The environment.
    pub env: Repose,
    /// The number of its episode.
    number: usize,
    noise: Rng,
    running: bool,
    end: Option<End>,
}

impl Lane {
    fn new(task: &Arc<Task>) -> Self {
        Self {
            env: Repose::new(task),
            number: 0,
            noise: rng::stream(0, "unused", 0),
            running: false,
            end: None,
        }
    }

    fn start(&mut self, episodes: Episodes, episode: usize, observation: &mut [f32]) {
        self.env.reset(
            rng::stream(episodes.seed, episodes.purpose, episode as u64),
            observation,
        );
        self.env.take_sums();
        self.noise = rng::stream(episodes.seed, "play noise", episode as u64);
        self.number = episode;
        self.running = true;
    }

    /// The record of the episode, once.
    fn episode(&mut self) -> EpisodeStats {
        let sums = self.env.take_sums();
        EpisodeStats {
            turned: sums.turned,
            unpredicted: sums.unpredicted,
            ..self.env.episode()
        }
    }

    fn step(&mut self, action: &[f32], observation: &mut [f32]) -> Option<End> {
        self.end = self.env.step(action, observation).end;
        self.end
    }
}

/// Episodes of a task that an actor plays.
#[derive(Clone, Copy)]
pub struct Trial<'a> {
    /// The task.
    pub task: &'a Arc<Task>,
    /// The source of the actions.
    pub actor: &'a Actor<'a>,
    /// The episodes.
    pub episodes: Episodes,
    /// A flag that interrupts the trial.
    pub stop: &'a AtomicBool,
}

/// The message about a policy whose numbers overflow.
const NOT_FINITE: &str = "the actions of the policy are not finite";

/// Checks the policy's action at the start of an episode of this task: its weights may be finite and yet overflow. For one that
/// `learns`, checks the value as well. Its square must also be finite, because learning minimises squares.
///
/// # Errors
/// Fails if one of them is not finite.
pub fn expect_finite(task: &Arc<Task>, policy: &Policy, learns: bool) -> Result<()> {
    let player = Player::new(task, Episodes::scored(0, 1));
    let mut actions = policy.mean_actions(&player.observation).into_iter();
    ensure!(actions.all(f32::is_finite), NOT_FINITE);
    if learns {
        let value = policy.values(&player.observation)[0];
        ensure!(
            (value * value).is_finite(),
            "the values of the policy are not finite"
        );
    }
    Ok(())
}

impl Trial<'_> {
    /// Plays the episodes and returns them in order. The observer sees the steps of one
    /// episode in order, interleaved with the steps of other episodes.
    ///
    /// # Errors
    /// Fails if the observer does, if an action is not finite, or, with the episode's number, if an episode panics. Fails as
    /// interrupted if a stop was requested.
    pub fn play(&self, observer: &mut Observer) -> Result<Vec<EpisodeStats>> {
        self.play_together(&Exchange::alone(1), observer)
    }

    /// Plays the episodes and returns their score. `bar` counts them.
    ///
    /// # Errors
    /// Fails as [`Trial::play`] does.
    pub fn score(&self, bar: &Bar, observe: &mut dyn FnMut(&Moment)) -> Result<Score> {
        let played = self.play(&mut |moment| {
            observe(&moment);
            bar.inc(moment.ends().into());
            Ok(())
        })?;
        Ok(Score::of(&played, self.task.config.ctrl_dt))
    }

    /// Plays the episodes that `exchange` assigns to this rank, seen by the observer. Returns the episodes of all ranks in
    /// order.
    ///
    /// # Errors
    /// Fails as [`Trial::play`] does.
    pub fn play_together(
        &self,
        exchange: &Exchange,
        observer: &mut Observer,
    ) -> Result<Vec<EpisodeStats>> {
        let Episodes { first, count, .. } = self.episodes;
        let own = exchange.own(LANES.min(count));
        let groups = (first + own.start..first + count).step_by(LANES);
        // Idle lanes still fill the batch, so that an episode's result does not depend on who plays it.
        let mut group = Lanes::new(self, own);
        let mut results = Vec::with_capacity(count);
        for first in groups {
            let started = group.start(first, observer)?;
            while group.lanes.iter().any(|lane| lane.running) {
                expect_no_stop(self.stop)?;
                group.step(observer)?;
            }
            let lanes = group.lanes[..started].iter_mut();
            results.extend(lanes.map(|lane| (lane.number, lane.episode())));
        }
        let mut all = exchange.all_gather(results).concat();
        all.sort_unstable_by_key(|(number, _)| *number);
        Ok(all.into_iter().map(|(_, episode)| episode).collect())
    }
}

/// Episodes that run together, one in each lane.
struct Lanes<'a> {
    trial: Trial<'a>,
    lanes: Vec<Lane>,
    /// `[LANES, O]`
    observations: Vec<f32>,
    /// `[LANES, A]`
    actions: Vec<f32>,
}

impl<'a> Lanes<'a> {
    fn new(trial: &Trial<'a>, lanes: Range<usize>) -> Self {
        let spaces = trial.task.spaces();
        Self {
            trial: *trial,
            lanes: lanes.map(|_| Lane::new(trial.task)).collect(),
            observations: vec![0.0; LANES * spaces.observation_size],
            actions: vec![0.0; LANES * spaces.action_size],
        }
    }

    /// Starts the episodes from number `first` on, and returns their number. The last group may have fewer of them than lanes.
    fn start(&mut self, first: usize, observer: &mut Observer) -> Result<usize> {
        let episodes = self.trial.episodes;
        let left = episodes.first + episodes.count - first;
        let started = left.min(self.lanes.len());
        let lanes = &mut self.lanes[..started];
        let size = self.trial.task.spaces().observation_size;
        let rows = self.observations.par_chunks_exact_mut(size);
        lanes
            .par_iter_mut()
            .zip(rows)
            .enumerate()
            .for_each(|(i, (lane, row))| {
                stepping("episode", first + i, || {
                    lane.start(episodes, first + i, row)
                });
            });
        let rows = self.observations.chunks_exact(size);
        for (lane, observation) in lanes.iter().zip(rows) {
            observer(Moment {
                episode: lane.number,
                env: &lane.env,
                observation,
                step: None,
            })?;
        }
        Ok(started)
    }

    /// Takes one step in each lane whose episode has not ended.
    fn step(&mut self, observer: &mut Observer) -> Result<()> {
        let Self {
            trial,
            lanes,
            observations,
            actions,
        } = self;
        let Spaces {
            observation_size,
            action_size,
            ..
        } = trial.task.spaces();
        trial.actor.choose(observations, lanes, actions);
        let acted = lanes
            .par_iter_mut()
            .zip(actions.par_chunks_exact(action_size));
        acted
            .zip(observations.par_chunks_exact_mut(observation_size))
            .filter(|((lane, _), _)| lane.running)
            .try_for_each(|((lane, action), row)| {
                ensure!(action.iter().all(|x| x.is_finite()), NOT_FINITE);
                let number = lane.number;
                let stepped = stepping("episode", number, || caught(|| lane.step(action, row)));
                stepped.map_err(|panic| anyhow!("episode {number} panicked: {panic}"))?;
                Ok(())
            })?;
        let rows = observations
            .chunks_exact(observation_size)
            .zip(actions.chunks_exact(action_size));
        let running = lanes.iter_mut().zip(rows);
        for (lane, (observation, action)) in running.filter(|(lane, _)| lane.running) {
            observer(Moment {
                episode: lane.number,
                env: &lane.env,
                observation,
                step: Some((action, lane.end)),
            })?;
            lane.running = lane.end.is_none();
        }
        Ok(())
    }
}

impl Actor<'static> {
    /// The actors that need no policy, by the names that a user gives in place of one.
    pub const WITHOUT_POLICY: [(&'static str, Self); 3] = [
        ("zero", Self::Zero),
        ("random", Self::Random),
        ("wave", Self::Wave),
    ];

    /// The place of this name in [`Self::WITHOUT_POLICY`].
    pub fn without_policy(name: &Path) -> Option<usize> {
        Self::WITHOUT_POLICY
            .iter()
            .position(|(known, _)| name == Path::new(known))
    }
}

impl Actor<'_> {
    /// The actor's name as shown beside its score.
    pub fn name(&self) -> &'static str {
        match self {
            Actor::Mean(_) | Actor::Outside(_) => "policy",
            Actor::Stochastic(_) => "policy, stochastic",
            Actor::Zero => "zero actions",
            Actor::Random => "random actions",
            Actor::Wave => "swinging actions",
        }
    }

    /// Writes the actions of these lanes, of which there is at least one, one row each. Actions of lanes that have ended are not used.
    fn choose(&self, observations: &[f32], lanes: &mut [Lane], actions: &mut [f32]) {
        let Spaces {
            observation_size,
            action_size: size,
            ..
        } = lanes[0].env.spaces();
        match self {
            Actor::Mean(policy) | Actor::Stochastic(policy) => {
                let mut work = policy.workspace(actions.len() / size);
                policy.compute(observations, [actions, &mut []], &mut work);
            }
            Actor::Outside(act) => act(
                &observations[..lanes.len() * observation_size],
                &mut actions[..lanes.len() * size],
            ),
            _ => {}
        }
        for (lane, row) in lanes.iter_mut().zip(actions.chunks_exact_mut(size)) {
            match self {
                Actor::Mean(_) | Actor::Outside(_) => {}
                Actor::Stochastic(frozen) => {
                    for (action, log_std) in row.iter_mut().zip(&frozen.policy.log_std) {
                        let drawn: f32 = StandardNormal.sample(&mut lane.noise);
                        *action += log_std.exp() * drawn;
                    }
                }
                Actor::Zero => row.fill(0.0),
                Actor::Random => row.fill_with(|| rng::uniform(&mut lane.noise, -1.0, 1.0) as f32),
                Actor::Wave => {
                    let swings = f64::from(lane.env.episode().length) / SWING;
                    for (i, action) in row.iter_mut().enumerate() {
                        let phase = swings - i as f64 / size as f64;
                        *action = (0.3 * (TAU * phase).sin()) as f32;
                    }
                }
            }
        }
    }
}

/// One environment played episode after episode, one step at a time, by an actor that may change.
pub struct Player {
    /// The environment that it plays.
    pub lane: Lane,
    observation: Vec<f32>,
    action: Vec<f32>,
}

impl Player {
    /// Creates a player at the start of the first of `episodes`. The caller counts the episodes.
    pub fn new(task: &Arc<Task>, episodes: Episodes) -> Self {
        let Spaces {
            observation_size,
            action_size,
            ..
        } = task.spaces();
        let mut player = Self {
            lane: Lane::new(task),
            observation: vec![0.0; observation_size],
            action: vec![0.0; action_size],
        };
        player.start(episodes, episodes.first);
        player
    }

    /// Starts the episode with the given number.
    pub fn start(&mut self, episodes: Episodes, episode: usize) {
        self.lane.start(episodes, episode, &mut self.observation);
    }

    /// Takes one step with the action of `actor`, and returns the end of the episode if the step ended it.
    pub fn step(&mut self, actor: &Actor) -> Option<End> {
        self.step_changed(actor, |_| {})
    }

    /// Takes one step with the action of `actor` after a change to it.
    pub fn step_changed(&mut self, actor: &Actor, change: impl FnOnce(&mut [f32])) -> Option<End> {
        let lane = std::slice::from_mut(&mut self.lane);
        actor.choose(&self.observation, lane, &mut self.action);
        change(&mut self.action);
        self.lane.step(&self.action, &mut self.observation)
    }

    /// Draws another goal.
    pub fn new_goal(&mut self) {
        self.lane.env.redirect(&mut self.observation);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::ppo::Ppo;
    use crate::ranks::Exchange;

    #[test]
    fn a_policy_that_treats_a_cubes_rotations_as_the_same_acts_alike_however_the_cube_is_turned_onto_itself()
     {
        for alike in [true, false] {
            let config = Config::default();
            let task = Task::new(&config).unwrap();
            let mut spaces = task.spaces();
            if !alike {
                spaces
                    .object_and_goal
                    .iter_mut()
                    .for_each(|places| places.rotations = 1);
            }
            let ppo = Ppo::new(&config.ppo, spaces, 0, Exchange::alone(1)).unwrap();
            let actor = Actor::Mean(ppo.policy.freeze());
            // Cube and goal coincide: once unrotated, once both rotated by half a turn about their own x axis.
            let Spaces {
                observation_size: size,
                ..
            } = task.spaces();
            let mut observations = vec![0.1; 2 * size];
            for (row, q) in observations
                .chunks_exact_mut(size)
                .zip([[1.0, 0.0], [0.0, 1.0]])
            {
                let places = task.spaces().object_and_goal.unwrap();
                for place in [places.object, places.goal] {
                    row[place..place + 4].copy_from_slice(&[q[0], q[1], 0.0, 0.0]);
                }
            }
            let (mut lanes, mut actions) =
                ([Lane::new(&task), Lane::new(&task)], vec![0.0; 2 * 20]);
            actor.choose(&observations, &mut lanes, &mut actions);
            let (one, other) = actions.split_at(20);
            assert_eq!(one == other, alike);
        }
    }
}
