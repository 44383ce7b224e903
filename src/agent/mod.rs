//! The agent: environments, a learner, and the rollout between them. One of its iterations is the whole algorithm.
//!
//! The training loop is separate: it decides how long to train, scores, reports and saves. So benchmarks and tests run
//! exactly the same iterations.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context, Result, ensure};

use crate::config::{Config, PpoConfig};
use crate::env::{End, Env, EnvBlock, EnvPool, EnvState, Resumable};
use crate::os::expect_no_stop;
use crate::ppo::{
    Array, Checkpoint, Fork, Ppo, Progress, Rollout, RolloutBlock, UpdateStats, Workspace,
};
use crate::ranks::Exchange;
use crate::repose::{Lesson, Randomization, Repose, Task};
use crate::schedule::in_rounds;
use crate::spaces::Spaces;

// The names under which a checkpoint stores the states of the environments.
const NUMBERS: &str = "envs.numbers";
const COUNTERS: &str = "envs.counters";

/// Environments and the learner that acts in them.
pub struct Agent<E: Env> {
    /// The environments.
    pub pool: EnvPool<E>,
    /// The learner.
    pub ppo: Ppo,
    /// The last rollout. Its first observations are acted on next.
    pub rollout: Rollout,
    /// What the policy needs to act, for each block.
    work: Vec<Workspace>,
    /// The lesson at a given number of control steps.
    lessons: Box<dyn Fn(u64) -> E::Lesson + Send>,
    /// The number of finished iterations.
    pub iteration: u64,
    /// The number of control steps so far, over all environments.
    pub env_steps: u64,
    /// The point at which it was forked from another training run, if it was.
    pub fork: Option<Fork>,
    /// The exchange with other ranks, which assigns environments and samples, and adds up results.
    pub exchange: Exchange,
}

/// The record of an iteration.
#[derive(Debug, Default)]
pub struct Iteration<L> {
    /// The lesson that was trained in it.
    pub lesson: L,
    /// The statistics of the update.
    pub update: UpdateStats,
    /// The number of control steps, over all environments.
    pub steps: u64,
    /// The time spent collecting, s.
    pub collect_s: f64,
    /// The time spent learning, s.
    pub update_s: f64,
}

impl<L> Iteration<L> {
    /// The control steps per second.
    pub fn steps_per_s(&self) -> f64 {
        self.steps as f64 / (self.collect_s + self.update_s)
    }

    /// The times and the speed, by name.
    pub fn time_named(&self) -> [(&'static str, f64); 3] {
        [
            ("collect_s", self.collect_s),
            ("update_s", self.update_s),
            ("steps_per_s", self.steps_per_s()),
        ]
    }
}

impl Agent<Repose> {
    /// Creates the agent of a training run with these settings, at the start of its first episodes. It gets the environments
    /// that `exchange` assigns to this rank.
    ///
    /// # Errors
    /// Fails if this machine does not support the precision, or if the scene cannot be randomised in the way that is asked.
    pub fn for_task(task: &Arc<Task>, config: &Config, exchange: Exchange) -> Result<Self> {
        let randomization = Randomization::new(task, &config.randomization)?;
        let envs = exchange
            .own(config.env.num_envs)
            .map(|_| Repose::randomized(task, randomization.as_ref()))
            .collect();
        let settings = config.clone();
        Self::new(
            envs,
            &config.ppo,
            config.run.seed,
            exchange,
            move |env_steps| Lesson::at(env_steps, &settings),
        )
    }
}

impl<E: Env> Agent<E> {
    /// Creates a learner and starts the first episodes of `envs`, the environments that `exchange` assigns. All
    /// randomness follows from `seed`.
    ///
    /// # Errors
    /// Fails if this machine does not support the precision.
    pub fn new(
        envs: Vec<E>,
        config: &PpoConfig,
        seed: u64,
        exchange: Exchange,
        lessons: impl Fn(u64) -> E::Lesson + Send + 'static,
    ) -> Result<Self> {
        let mut pool = EnvPool::new(seed, envs, &exchange);
        let ppo = Ppo::new(config, pool.spaces(), seed, exchange.clone())?;
        let mut rollout = ppo.rollout(&pool.block_sizes());
        pool.set_lesson(lessons(0));
        pool.reset(rollout.first_observations_mut());
        let sizes = pool.block_sizes().into_iter();
        Ok(Self {
            work: sizes.map(|envs| ppo.workspace(envs)).collect(),
            pool,
            ppo,
            rollout,
            lessons: Box::new(lessons),
            iteration: 0,
            env_steps: 0,
            fork: None,
            exchange,
        })
    }

    /// Runs one iteration: collects a rollout and learns from it. After an error, the agent must be restored before it is used
    /// again.
    ///
    /// # Errors
    /// Fails if an environment panics, or if a loss, gradient or weight is not finite. Fails as interrupted if `stop` was set
    /// meanwhile.
    pub fn iterate(&mut self, stop: &AtomicBool) -> Result<Iteration<E::Lesson>> {
        let started = Instant::now();
        let lesson = self.collect(stop)?;
        let collected = Instant::now();
        let update = self
            .ppo
            .update(&mut self.rollout, self.iteration + 1, stop)?;
        self.rollout.carry_over();
        let steps = self.exchange.of_all(self.rollout.samples()) as u64;
        self.iteration += 1;
        self.env_steps += steps;
        let [collect_s, update_s] =
            [collected - started, collected.elapsed()].map(|time| time.as_secs_f64());
        Ok(Iteration {
            lesson,
            update,
            steps,
            collect_s,
            update_s,
        })
    }

    /// Runs the first half of [`Agent::iterate`]: steps the environments through a whole rollout with the learner's actions. Returns
    /// the lesson.
    ///
    /// # Errors
    /// Fails with the environment's number if an environment panics. Fails as interrupted if `stop` was set meanwhile: the blocks
    /// may then be at different steps.
    pub fn collect(&mut self, stop: &AtomicBool) -> Result<E::Lesson> {
        let lesson = (self.lessons)(self.env_steps);
        self.pool.set_lesson(lesson);
        self.ppo.follow_ramps(self.env_steps, &mut self.rollout);
        let ppo = &self.ppo;
        let iteration = self.iteration + 1;
        let horizon = self.rollout.horizon;
        let acting = ppo.acting();
        let parts = self
            .pool
            .blocks
            .iter_mut()
            .zip(&mut self.rollout.blocks)
            .zip(&mut self.work);
        let blocks = parts.map(|((envs, rollout), work)| {
            (
                ppo.noise(iteration, envs.number),
                envs,
                rollout,
                work,
                Ok(()),
            )
        });
        // Each block goes through its steps independently: no thread waits for the others before the rollout is complete.
        let collected = in_rounds(
            blocks,
            horizon,
            |(noise, envs, rollout, work, result), t| {
                if result.is_err() || stop.load(Ordering::Relaxed) {
                    return;
                }
                acting.act(rollout, t, noise, work);
                *result = step_block(envs, rollout, t);
                let row = rollout.step(t, 1);
                let cut_off = envs.members.iter().map(|member| match member.end {
                    Some(End::Truncated | End::Redirected) => Some(&member.final_observation[..]),
                    Some(End::Terminated) | None => None,
                });
                acting.scale_and_bootstrap(&mut rollout.rewards[row], cut_off, work);
                if t + 1 == horizon {
                    acting.finish(rollout, horizon, work);
                }
            },
        );
        collected.into_iter().try_for_each(|(.., result)| result)?;
        expect_no_stop(stop)?;
        Ok(lesson)
    }
}

impl<E: Resumable> Agent<E> {
    /// Adds the complete state at the end of an iteration. All ranks call it together.
    pub fn save(&self, checkpoint: &mut Checkpoint) {
        let progress = &mut checkpoint.progress;
        progress.iteration = self.iteration;
        progress.env_steps = self.env_steps;
        progress.fork.clone_from(&self.fork);
        self.ppo.save(checkpoint);
        let EnvState { numbers, counters } =
            EnvState::joined(self.exchange.all_gather(self.pool.save()));
        let rows = self.exchange.of_all(self.pool.count());
        checkpoint.insert(
            NUMBERS,
            Array::F64(vec![rows, numbers.len() / rows], numbers),
        );
        checkpoint.insert(
            COUNTERS,
            Array::U64(vec![rows, counters.len() / rows], counters),
        );
    }

    /// Restores what [`Agent::save`] has added, bit for bit, and takes it out of the checkpoint.
    ///
    /// # Errors
    /// Fails if no such agent can have saved this state.
    pub fn restore(&mut self, checkpoint: &mut Checkpoint) -> Result<()> {
        let progress = &checkpoint.progress;
        self.iteration = progress.iteration;
        self.env_steps = progress.env_steps;
        self.fork.clone_from(&progress.fork);
        self.ppo
            .begin_after(self.fork.as_ref().map_or(0, |fork| fork.iteration));
        self.ppo.restore(checkpoint)?;
        let state = EnvState {
            numbers: checkpoint.take_doubles(NUMBERS)?,
            counters: checkpoint.take_counters(COUNTERS)?,
        };
        self.pool
            .restore(&state, self.rollout.first_observations_mut())
    }
}

/// Steps a block of environments with the actions of step `t` of its rollout, and writes the results there.
///
/// # Errors
/// Fails with the environment's number if an environment panics.
pub fn step_block<E: Env>(
    envs: &mut EnvBlock<E>,
    rollout: &mut RolloutBlock,
    t: usize,
) -> Result<()> {
    let Spaces {
        observation_size,
        action_size,
        ..
    } = envs.spaces;
    let row = rollout.step(t, 1);
    let actions = rollout.step(t, action_size);
    let next = rollout.step(t + 1, observation_size);
    envs.step(
        &rollout.actions[actions],
        &mut rollout.rewards[row.clone()],
        &mut rollout.observations[next],
    )?;
    rollout.dones[row]
        .iter_mut()
        .zip(&envs.members)
        .for_each(|(done, member)| *done = member.end.is_some());
    Ok(())
}

/// Checks that the number of steps and of environment states in a checkpoint match its configuration. This must be done before
/// anything is allocated according to the configuration.
///
/// # Errors
/// Fails if the checkpoint holds a policy alone, or if the numbers do not match.
pub fn expect_states(checkpoint: &Checkpoint, config: &Config) -> Result<()> {
    let Progress {
        iteration,
        env_steps,
        ref fork,
        ..
    } = checkpoint.progress;
    // The parent of a fork may have made a different number of steps in each iteration.
    let [before, steps_before] = fork
        .as_ref()
        .map_or([0, 0], |fork| [fork.iteration, fork.env_steps]);
    let own = i128::from(iteration) - i128::from(before);
    let steps = i128::from(env_steps) - i128::from(steps_before);
    // An iteration makes at least as many steps as the first one, and at most as many as the last one.
    let least = i128::from(config.steps_per_iteration());
    let most = (config.env.num_envs * config.ppo.horizon_at(u64::MAX)) as i128;
    ensure!(
        own >= 0 && (own * least..=own * most).contains(&steps) && steps % least == 0,
        "{iteration} iterations cannot have made {env_steps} steps"
    );
    for name in [NUMBERS, COUNTERS] {
        let shape = checkpoint
            .shape(name)
            .context("it holds a policy alone, which can be played but not resumed")?;
        let rows = shape.first().copied().unwrap_or(0);
        let expected = config.env.num_envs;
        ensure!(
            rows == expected,
            "it holds the states of {rows} environments, expected {expected}"
        );
    }
    Ok(())
}
