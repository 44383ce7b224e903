//! What learns: environments, a learner, and what they leave to each other. One iteration of it is the algorithm.
//!
//! Apart from the training, which decides how long, scores, reports and saves: benchmarks and tests run the very same iterations.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Result, ensure};

use crate::collect::{Scratch, collect};
use crate::config::{Config, PpoConfig};
use crate::env::{Env, EnvPool, EnvState, Lesson, Repose, Resumable, Task};
use crate::ppo::{Array, Checkpoint, Fork, Ppo, Progress, Rollout, UpdateStats};
use crate::ranks::Division;

// Where a checkpoint keeps the states of the environments.
const NUMBERS: &str = "envs.numbers";
const COUNTERS: &str = "envs.counters";

/// Environments and the learner that acts in them.
pub struct Agent<E: Env> {
    /// The environments.
    pub pool: EnvPool<E>,
    /// The learner.
    pub ppo: Ppo,
    /// What was collected last; its first observations are those that are acted on next.
    pub rollout: Rollout,
    scratch: Scratch,
    /// What is trained after so many control steps.
    lessons: Box<dyn Fn(u64) -> E::Lesson + Send>,
    /// Control steps of an iteration over the environments of all ranks.
    steps: u64,
    /// Iterations finished.
    pub iteration: u64,
    /// Control steps over all environments.
    pub env_steps: u64,
    /// Where it left another training, if it did.
    pub fork: Option<Fork>,
}

/// What is known of an iteration.
#[derive(Clone, Copy, Debug)]
pub struct Iteration<L> {
    /// What was trained in it.
    pub lesson: L,
    /// What was learnt.
    pub update: UpdateStats,
    /// Control steps over all environments.
    pub steps: u64,
    /// Seconds of collecting.
    pub collect_s: f64,
    /// Seconds of learning.
    pub update_s: f64,
}

impl<L> Iteration<L> {
    /// Control steps a second.
    pub fn steps_per_s(&self) -> f64 {
        self.steps as f64 / (self.collect_s + self.update_s)
    }
}

impl Agent<Repose> {
    /// The agent of a training with these settings, which is at the start of its first episodes.
    ///
    /// # Errors
    /// A precision that this machine does not have.
    pub fn of_task(task: &Arc<Task>, config: &Config) -> Result<Self> {
        let envs = (0..config.env.num_envs).map(|_| Repose::new(task)).collect();
        let training = config.training.clone();
        let division = Division::alone(config.shards());
        Self::new(envs, &config.ppo, config.run.seed, division, move |env_steps| Lesson::at(env_steps, &training))
    }
}

impl<E: Env> Agent<E> {
    /// A learner in these environments, those of this rank's shards, which are at the start of their first episodes; all randomness
    /// follows from `seed`.
    ///
    /// # Errors
    /// A precision that this machine does not have, or a symmetry that the observations do not have.
    pub fn new(
        envs: Vec<E>,
        config: &PpoConfig,
        seed: u64,
        division: Division,
        lessons: impl Fn(u64) -> E::Lesson + Send + 'static,
    ) -> Result<Self> {
        let mut pool = EnvPool::of_shards(seed, envs, &division);
        let steps = (config.horizon * pool.count() / division.own().len() * division.shards()) as u64;
        let ppo = Ppo::new(config, E::SPACES, seed, division)?;
        let mut rollout = ppo.rollout(&pool.block_sizes());
        let scratch = Scratch::new(&pool, &ppo);
        pool.set_lesson(lessons(0));
        pool.reset(rollout.first_observations_mut());
        Ok(Self {
            pool,
            ppo,
            rollout,
            scratch,
            lessons: Box::new(lessons),
            steps,
            iteration: 0,
            env_steps: 0,
            fork: None,
        })
    }

    /// Collects and learns. `None` if `stop` was set meanwhile; then, and after an error, the agent must be restored before it is
    /// used again.
    ///
    /// # Errors
    /// A panic in an environment; a loss, gradient or weight that is not finite.
    pub fn iterate(&mut self, stop: &AtomicBool) -> Result<Option<Iteration<E::Lesson>>> {
        let started = Instant::now();
        let Some(lesson) = self.collect(stop)? else { return Ok(None) };
        let collected = Instant::now();
        let Some(update) = self.ppo.update(&mut self.rollout, self.iteration + 1, stop)? else { return Ok(None) };
        self.rollout.carry_over();
        let steps = self.steps;
        (self.iteration, self.env_steps) = (self.iteration + 1, self.env_steps + steps);
        let [collect_s, update_s] = [collected - started, collected.elapsed()].map(|time| time.as_secs_f64());
        Ok(Some(Iteration { lesson, update, steps, collect_s, update_s }))
    }

    /// The first half of [`Agent::iterate`]: fills the rollout; tells what was trained.
    ///
    /// # Errors
    /// A panic in an environment.
    pub fn collect(&mut self, stop: &AtomicBool) -> Result<Option<E::Lesson>> {
        let lesson = (self.lessons)(self.env_steps);
        self.pool.set_lesson(lesson);
        self.ppo.limit_std(self.env_steps);
        let iteration = self.iteration + 1;
        let whole = collect(&mut self.pool, &self.ppo, &mut self.rollout, iteration, &mut self.scratch, stop)?;
        Ok(whole.then_some(lesson))
    }
}

impl<E: Resumable> Agent<E> {
    /// The state at the end of an iteration, whole, with the configuration of the run (TOML) and its best evaluation.
    pub fn checkpoint(&self, config: &str, best: Option<[f64; 2]>) -> Checkpoint {
        let (iteration, env_steps, fork) = (self.iteration, self.env_steps, self.fork.clone());
        let progress = Progress { iteration, env_steps, best, fork };
        let mut checkpoint = self.ppo.checkpoint(config, progress);
        let EnvState { numbers, counters } = self.pool.save();
        let rows = self.pool.count();
        checkpoint.insert(NUMBERS, Array::F64(vec![rows, numbers.len() / rows], numbers));
        checkpoint.insert(COUNTERS, Array::U64(vec![rows, counters.len() / rows], counters));
        checkpoint
    }

    /// Goes on from what [`Agent::checkpoint`] has saved, bit for bit, and takes it out of the checkpoint.
    ///
    /// # Errors
    /// A state that no such agent can have saved.
    pub fn restore(&mut self, checkpoint: &mut Checkpoint) -> Result<()> {
        let Progress { iteration, env_steps, fork, .. } = &checkpoint.progress;
        (self.iteration, self.env_steps, self.fork) = (*iteration, *env_steps, fork.clone());
        self.ppo.restore(checkpoint)?;
        let numbers = checkpoint.take_doubles(NUMBERS)?;
        let state = EnvState { numbers, counters: checkpoint.take_counters(COUNTERS)? };
        self.pool.restore(&state, self.rollout.first_observations_mut())
    }
}

/// Makes sure that a checkpoint holds the states of as many environments as the configuration in it says, and of as many steps:
/// before anything is allocated by what the configuration says.
///
/// # Errors
/// A policy alone; other numbers.
pub fn expect_states(checkpoint: &Checkpoint, config: &Config) -> Result<()> {
    let Progress { iteration, env_steps, ref fork, .. } = checkpoint.progress;
    // The run that a fork left may have made others in each.
    let [before, steps_before] = fork.as_ref().map_or([0, 0], |fork| [fork.iteration, fork.env_steps]);
    let own = iteration.checked_sub(before).and_then(|own| own.checked_mul(config.steps_per_iteration()));
    let possible = own.is_some() && own == env_steps.checked_sub(steps_before);
    ensure!(possible, "{iteration} iterations cannot have made {env_steps} steps");
    for name in [NUMBERS, COUNTERS] {
        let shape =
            checkpoint.shape(name).context("it holds a policy alone, which can be played but not trained on")?;
        let (rows, expected) = (shape.first().copied().unwrap_or(0), config.env.num_envs);
        ensure!(rows == expected, "it holds the states of {rows} environments, expected {expected}");
    }
    Ok(())
}
