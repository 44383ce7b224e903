//! Environments that step together.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};

use anyhow::{Context, ensure};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::prelude::*;
use shadow_repose::config::{Config, EnvConfig, PpoConfig};
use shadow_repose::env::{Autoreset, End, EnvPool, EnvState};
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{
    EpisodeStats, Lesson, Randomization, Record, Repose, Task, TaskReward, TrainingReward,
    task_terms, training_terms,
};
use shadow_repose::sim::mujoco_version;

use crate::episodes::columns;
use crate::errors::{guarded, refused};
use crate::pictures::{self, picture};
use crate::policy::Policy;
use crate::settings::{Made, Parts, Set, of_world, overrides, resolve, text};
use crate::workers::Workers;

/// The most environments, as in a training run.
const MOST_HANDS: usize = 65536;

/// N environments of one task, with O values in an observation and A in an action.
#[pyclass(frozen, module = "shadow_repose._native")]
pub(crate) struct Hands {
    made: Made,
    training: bool,
    autoreset: Autoreset,
    /// Whether a new goal cuts off the return.
    truncates: bool,
    /// Whether a step returns the terms of its reward.
    terms: bool,
    count: usize,
    /// None after `close`.
    state: Mutex<Option<State>>,
}

struct State {
    pool: EnvPool<Repose>,
    workers: Workers,
    /// The task on display, once pictures were asked for.
    shown: Option<Arc<Task>>,
    /// Control steps of all environments together. In a training they determine the lesson.
    env_steps: u64,
    /// The number of steps at which the current lesson began, if there is one.
    lesson_from: Option<u64>,
    /// `[N, O]`: what to act on next.
    observations: Vec<f32>,
    /// `[N]`: the rewards of each running episode.
    returns: Vec<f64>,
    can_step: Result<(), &'static str>,
}

/// What the user says of the task: a settings file, a policy, settings, and settings of the world.
type Said = (Option<PathBuf>, Option<Py<Policy>>, Set, Set);

/// The ends, at the numbers that Python gets for them.
const ENDS: [Option<End>; 4] = [
    None,
    Some(End::Terminated),
    Some(End::Truncated),
    Some(End::Redirected),
];

const NOT_RESET: &str = "reset the hands before they step";
const FAILED: &str = "an earlier step failed: reset the hands before they step again";
const NOT_SET: &str = "the state could not be set: reset the hands before they step";

/// The terms `[N]` of a step's reward by name, and the rotation errors `[N]` after it.
type Terms<'py> = (Bound<'py, PyDict>, Bound<'py, PyArray1<f32>>);

/// What a step returns: observations `[N, O]`, rewards `[N]`, ends `[N]`, and the episodes that ended as columns. The final
/// observations `[N, O]` follow if there are any, and the terms if they were requested.
type Stepped<'py> = (
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray1<u8>>,
    Option<Bound<'py, PyDict>>,
    Option<Bound<'py, PyArray2<f32>>>,
    Option<Terms<'py>>,
);

/// The task that the user says.
///
/// # Errors
/// Fails if the settings are invalid, or if the scene cannot be used.
fn made_of((config, policy, set, world): Said, training: bool) -> anyhow::Result<Made> {
    let overrides = overrides(set, training)?;
    let world = of_world(world)?;
    let Some(policy) = policy else {
        return resolve(config.as_deref(), &overrides, &world);
    };
    ensure!(
        config.is_none(),
        "give config or policy, not both: a policy brings the settings of its task"
    );
    let overrides = [overrides, world].concat();
    policy.get().resolve(&overrides, training)
}

impl Hands {
    /// The locked state. Fails if it is in use or gone.
    fn locked(&self) -> PyResult<MutexGuard<'_, Option<State>>> {
        let guard = match self.state.try_lock() {
            Ok(guard) => guard,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                return Err(PyRuntimeError::new_err(
                    "another thread is using these hands",
                ));
            }
        };
        if guard.is_some() {
            Ok(guard)
        } else {
            Err(PyRuntimeError::new_err("these hands are closed"))
        }
    }

    /// The task in which it is scored: as it is now, without the help of a training.
    pub(crate) fn task(&self) -> Arc<Task> {
        self.made.task.clone()
    }

    /// The same task for another policy.
    ///
    /// # Errors
    /// Fails if the policy is for another hand.
    pub(crate) fn task_for(&self, policy: &Record) -> anyhow::Result<Arc<Task>> {
        self.made.task_for(policy)
    }

    /// What a policy that has learnt here learnt: the settings with the present smoothing of actions, the hand, the fingerprint of the
    /// scene, and the control steps so far.
    ///
    /// # Errors
    /// Fails if they are in use or closed, or if they are seen in a mirror.
    pub(crate) fn learnt_task(&self) -> PyResult<(Config, Record, String, u64)> {
        let env_steps = self.locked()?.as_ref().map_or(0, |state| state.env_steps);
        let Made {
            config,
            task,
            record,
        } = &self.made;
        if task.mirror().is_some() {
            return Err(PyValueError::new_err(
                "these hands are seen in the mirror of their policy: create them without it",
            ));
        }
        let mut config = config.clone();
        let reached = if self.training { env_steps } else { 0 };
        config.env = config.env.at(reached);
        let record = record.clone().unwrap_or_else(|| task.record());
        Ok((config, record, task.scene.fingerprint(), env_steps))
    }

    fn observation_size(&self) -> usize {
        self.made.task.spaces().observation_size
    }

    fn rows<'py>(&self, py: Python<'py>, rows: Vec<f32>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        rows.into_pyarray(py)
            .reshape([self.count, self.observation_size()])
    }

    /// The lesson after `env_steps`. Every goal that is reached ends with a redirection, which the caller may ignore.
    fn lesson(&self, env_steps: u64) -> Lesson {
        let mut lesson = match self.training {
            true => Lesson::at(env_steps, &self.made.config),
            false => Lesson::task(&self.made.task.config),
        };
        lesson.goals_end = true;
        lesson
    }

    /// Starts the lesson that applies now. As in a training, it applies for the steps of an iteration.
    fn begin_lesson(&self, state: &mut State) {
        let steps = |from| (self.made.config.ppo.horizon_at(from) * self.count) as u64;
        if state
            .lesson_from
            .is_none_or(|from| state.env_steps >= from.saturating_add(steps(from)))
        {
            state.lesson_from = Some(state.env_steps);
            state.pool.set_lesson(self.lesson(state.env_steps));
        }
    }

    /// The last observations `[N, O]` of the environments that the last step cut off or ended, and zeros for the others.
    fn finals<'py>(
        &self,
        py: Python<'py>,
        state: &State,
    ) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let size = self.observation_size();
        let members = || state.pool.blocks.iter().flat_map(|block| &block.members);
        let is_cut =
            |end: &Option<End>| end.is_some_and(|end| end != End::Redirected || self.truncates);
        if self.autoreset != Autoreset::SameStep || !members().any(|member| is_cut(&member.end)) {
            return Ok(None);
        }
        let mut finals = vec![0.0; self.count * size];
        for (to, member) in finals
            .chunks_exact_mut(size)
            .zip(members())
            .filter(|(_, member)| is_cut(&member.end))
        {
            to.copy_from_slice(&member.final_observation);
        }
        self.rows(py, finals).map(Some)
    }

    /// Steps all environments. The result is the episodes that ended.
    fn advance(
        &self,
        py: Python,
        state: &mut State,
        actions: &[f32],
        rewards: &mut [f32],
    ) -> PyResult<Vec<(usize, EpisodeStats)>> {
        let State {
            pool,
            workers,
            observations,
            ..
        } = &mut *state;
        let workers = workers.pool()?;
        let stepped = py.detach(|| {
            guarded(|| {
                workers.install(|| pool.step(actions, self.autoreset, rewards, observations))
            })
        });
        let stepped = stepped.and_then(|stepped| {
            stepped.map_err(|error| PyRuntimeError::new_err(format!("{error:#}")))
        });
        if stepped.is_err() {
            state.can_step = Err(FAILED);
        }
        stepped
    }

    /// The terms of the last step, and zeros where a new episode took the place of the step.
    fn step_terms<'py>(
        &self,
        py: Python<'py>,
        state: &mut State,
        restarted: &[bool],
    ) -> PyResult<Terms<'py>> {
        let weight = state
            .lesson_from
            .map_or(1.0, |from| self.lesson(from).task_reward);
        let steps = state
            .pool
            .envs_mut()
            .zip(restarted)
            .map(|(hand, restarted)| match restarted {
                true => (
                    TaskReward::default(),
                    TrainingReward::default(),
                    hand.rot_dist(),
                ),
                false => {
                    let step = &hand.last;
                    (step.reward, step.training, step.rot_dist)
                }
            });
        let steps: Vec<(TaskReward, TrainingReward, f64)> = steps.collect();
        let terms = PyDict::new(py);
        let put = |name: &str, values: Vec<f64>| {
            let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
            terms.set_item(name, values.into_pyarray(py))
        };
        for (i, term) in task_terms().iter().enumerate() {
            put(
                term.0,
                steps
                    .iter()
                    .map(|(reward, ..)| weight * reward[i])
                    .collect(),
            )?;
        }
        for (i, term) in training_terms()
            .iter()
            .enumerate()
            .filter(|_| self.training)
        {
            put(
                term.0,
                steps.iter().map(|(_, training, _)| training[i]).collect(),
            )?;
        }
        let errors: Vec<f32> = steps
            .iter()
            .map(|(.., rot_dist)| *rot_dist as f32)
            .collect();
        Ok((terms, errors.into_pyarray(py)))
    }
}

impl State {
    /// The ends `[N]` of the last step as numbers.
    fn ends(&self) -> Vec<u8> {
        let number =
            |end: &Option<End>| ENDS.iter().position(|one| one == end).expect("an end") as u8;
        self.pool
            .blocks
            .iter()
            .flat_map(|block| &block.members)
            .map(|member| number(&member.end))
            .collect()
    }

    /// Which environments have finished an episode and have not begun the next one.
    fn waiting(&self) -> Vec<bool> {
        let members = self.pool.blocks.iter().flat_map(|block| &block.members);
        members
            .map(|member| matches!(member.end, Some(End::Terminated | End::Truncated)))
            .collect()
    }

    /// Restores the environments and their ends, and has them observe `size` values each.
    fn restore(
        &mut self,
        saved: &EnvState,
        ends: Vec<Option<End>>,
        size: usize,
    ) -> anyhow::Result<()> {
        let rows = self.observations.chunks_exact_mut(size);
        self.pool.restore(saved, rows)?;
        let all = self.pool.members_mut().map(|member| &mut member.end);
        all.zip(ends).for_each(|(own, end)| *own = end);
        self.can_step = Ok(());
        Ok(())
    }

    /// Lets the first episodes of `seed` start next, which the environments share among them.
    fn seed_together(&mut self, seed: u64) {
        let all = self.pool.count() as u64;
        for member in self.pool.members_mut() {
            member.seed = seed;
            member.next_episode = member.number as u64;
            member.stride = all;
        }
    }

    /// Lets the first episode of its own seed start next in each environment that has one, and then the following ones.
    fn seed_each(&mut self, seeds: Vec<Option<u64>>) {
        for (member, seed) in self.pool.members_mut().zip(seeds) {
            if let Some(seed) = seed {
                member.seed = seed;
                member.next_episode = 0;
                member.stride = 1;
            }
        }
    }

    fn started(&mut self, marked: &[bool]) {
        self.returns
            .iter_mut()
            .zip(marked)
            .filter(|(_, marked)| **marked)
            .for_each(|(sum, _)| *sum = 0.0);
    }
}

#[pymethods]
impl Hands {
    #[new]
    #[pyo3(signature = (count, threads, seed, said, parts, training, autoreset, truncates, terms))]
    #[expect(clippy::too_many_arguments, reason = "Python names each of them")]
    fn new(
        py: Python,
        count: usize,
        threads: usize,
        seed: u64,
        said: Said,
        parts: Option<Parts>,
        training: bool,
        autoreset: &str,
        truncates: bool,
        terms: bool,
    ) -> PyResult<Self> {
        let autoreset = match autoreset {
            "SameStep" => Autoreset::SameStep,
            "NextStep" => Autoreset::NextStep,
            "Disabled" => Autoreset::Disabled,
            other => {
                return Err(PyValueError::new_err(format!(
                    "autoreset_mode = {other}: unknown"
                )));
            }
        };
        let mut workers = Workers::new(threads);
        let made = workers.long(py, |stop| {
            ensure!(
                (1..=MOST_HANDS).contains(&count),
                "num_envs = {count}: must lie in [1, {MOST_HANDS}]"
            );
            let made = match parts {
                Some(parts) => Made::of(parts)?,
                None => made_of(said, training)?,
            };
            let randomization = if training {
                Randomization::new(&made.task, &made.config.randomization)?
            } else {
                None
            };
            let hand = |_| {
                let goes_on = !stop.load(std::sync::atomic::Ordering::Relaxed);
                goes_on.then(|| Repose::randomized(&made.task, randomization.as_ref()))
            };
            let hands: Option<Vec<Repose>> = (0..count).into_par_iter().map(hand).collect();
            let pool = EnvPool::new(seed, hands.context("interrupted")?, &Exchange::alone(1));
            anyhow::Ok((made, pool))
        })?;
        let (made, pool) = made.map_err(refused)?;
        let state = State {
            pool,
            workers,
            shown: None,
            env_steps: 0,
            lesson_from: None,
            observations: vec![0.0; count * made.task.spaces().observation_size],
            returns: vec![0.0; count],
            can_step: Err(NOT_RESET),
        };
        Ok(Self {
            made,
            training,
            autoreset,
            truncates,
            terms,
            count,
            state: Mutex::new(Some(state)),
        })
    }

    /// The groups of an observation: (name, first index, length, unit).
    fn layout(&self) -> Vec<(&'static str, usize, usize, &'static str)> {
        self.made
            .task
            .hand
            .layout
            .groups()
            .map(|group| (group.name, group.start, group.length, group.unit))
            .collect()
    }

    /// The number of values in an action.
    #[getter]
    fn action_size(&self) -> usize {
        self.made.task.spaces().action_size
    }

    /// The length of an episode that no drop ends.
    #[getter]
    fn max_episode_steps(&self) -> u32 {
        self.made.task.config.max_episode_steps()
    }

    /// The settings of the task and the names of the hand's parts, as JSON.
    fn settings(&self) -> String {
        text(&self.made.task)
    }

    /// All that they are made of, for a copy that needs no file.
    fn parts(&self) -> Parts {
        self.made.parts(&self.made.config)
    }

    /// What their task and its randomisation depend on, as texts.
    fn facts(&self) -> Vec<String> {
        let config = self.made.config.clone();
        let known = Config::default();
        let env = EnvConfig {
            num_envs: known.env.num_envs,
            ..config.env
        };
        let task = Config {
            env,
            hand: config.hand,
            ..known
        };
        let whole = if self.training {
            // Of a learner, a lesson depends on this alone.
            let ppo = PpoConfig {
                horizon: config.ppo.horizon,
                ..task.ppo
            };
            Config {
                ppo,
                training: config.training,
                randomization: config.randomization,
                ..task
            }
        } else {
            task
        };
        let (settings, _, record, predicted, _) = self.made.parts(&whole);
        let fingerprint = self.made.task.scene.fingerprint();
        let physics = format!("{} {fingerprint}", mujoco_version());
        let others = [record, predicted].map(Option::unwrap_or_default);
        [settings, physics, self.training.to_string()]
            .into_iter()
            .chain(others)
            .collect()
    }

    /// Warnings where the policy does not fit well.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.made.task.warnings.to_vec()
    }

    /// What the settings replace in the user's scene, and what was found in it.
    #[getter]
    fn notes(&self) -> Vec<String> {
        self.made.task.notes()
    }

    /// Whether the environments have been reset and no step has failed since.
    #[getter]
    fn can_step(&self) -> PyResult<bool> {
        Ok(self
            .locked()?
            .as_ref()
            .is_some_and(|state| state.can_step.is_ok()))
    }

    /// Whether an episode must be reset before the next step: it has not begun, or is over and no other one begins by itself.
    #[getter]
    fn needs_reset(&self) -> PyResult<bool> {
        let guard = self.locked()?;
        let state = guard.as_ref().expect("not closed");
        let waits = self.autoreset == Autoreset::Disabled && state.waiting().contains(&true);
        Ok(waits || state.can_step.is_err())
    }

    #[getter]
    fn env_steps(&self) -> PyResult<u64> {
        Ok(self.locked()?.as_ref().map_or(0, |state| state.env_steps))
    }

    #[setter]
    fn set_env_steps(&self, env_steps: u64) -> PyResult<()> {
        if let Some(state) = self.locked()?.as_mut() {
            state.env_steps = env_steps;
            state.lesson_from = None;
        }
        Ok(())
    }

    /// Starts episodes in the marked environments, or in all, then at random ages if `aged`. Returns all observations. A seed is for all
    /// environments together. `seeds` are for each of them as if it was alone, and those without one go on.
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seed: Option<u64>,
        seeds: Option<Vec<Option<u64>>>,
        marked: Option<PyReadonlyArray1<'py, bool>>,
        aged: bool,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let marked = marked.map_or(vec![true; self.count], |marked| {
            marked.as_array().iter().copied().collect()
        });
        if marked.len() != self.count {
            return Err(PyValueError::new_err(format!(
                "{} marks for {} hands",
                marked.len(),
                self.count
            )));
        }
        let all = marked.iter().all(|marked| *marked);
        if (seed.is_some() || seeds.is_some()) && !all {
            return Err(PyValueError::new_err(
                "a seed restarts all hands: give no seed with a reset_mask",
            ));
        }
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        if let (Err(reason), false) = (state.can_step, all) {
            return Err(PyRuntimeError::new_err(reason));
        }
        if let Some(seed) = seed {
            state.seed_together(seed);
        }
        if let Some(seeds) = seeds {
            state.seed_each(seeds);
        }
        self.begin_lesson(state);
        let State {
            pool,
            workers,
            observations,
            ..
        } = &mut *state;
        let workers = workers.pool()?;
        let started = py.detach(|| {
            guarded(|| workers.install(|| pool.restart(&marked, aged && all, observations)))
        });
        if let Err(error) = started {
            state.can_step = Err(FAILED);
            return Err(error);
        }
        state.can_step = Ok(());
        state.started(&marked);
        self.rows(py, state.observations.clone())
    }

    /// Steps all environments once.
    fn step<'py>(
        &self,
        py: Python<'py>,
        actions: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Stepped<'py>> {
        let n = self.count;
        let size = self.action_size();
        if actions.shape() != [n, size] {
            return Err(PyValueError::new_err(format!(
                "actions must have the shape ({n}, {size})"
            )));
        }
        // A copy, because another Python thread may write to the array meanwhile.
        let actions: Vec<f32> = actions.as_array().iter().copied().collect();
        if let Some(at) = actions.iter().position(|x| x.is_nan()) {
            return Err(PyValueError::new_err(format!(
                "actions[{}, {}] is NaN",
                at / size,
                at % size
            )));
        }
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        state.can_step.map_err(PyRuntimeError::new_err)?;
        let waiting = state.waiting();
        if let (Autoreset::Disabled, Some(hand)) =
            (self.autoreset, waiting.iter().position(|waits| *waits))
        {
            let text = format!("the episode of hand {hand} is over: reset it with a reset_mask");
            return Err(PyRuntimeError::new_err(text));
        }
        let restarted = if self.autoreset == Autoreset::NextStep {
            waiting
        } else {
            vec![false; n]
        };
        self.begin_lesson(state);
        let mut rewards = vec![0.0; n];
        let episodes = self.advance(py, state, &actions, &mut rewards)?;
        let stepped = restarted.iter().filter(|restarted| !**restarted).count() as u64;
        state.env_steps = state.env_steps.saturating_add(stepped);
        state
            .returns
            .iter_mut()
            .zip(&rewards)
            .for_each(|(sum, reward)| *sum += f64::from(*reward));
        let ended = if episodes.is_empty() {
            None
        } else {
            Some(columns(py, n, &episodes, &mut state.returns)?)
        };
        let observations = self.rows(py, state.observations.clone())?;
        let ends = state.ends().into_pyarray(py);
        let finals = self.finals(py, state)?;
        let terms = self
            .terms
            .then(|| self.step_terms(py, state, &restarted))
            .transpose()?;
        Ok((
            observations,
            rewards.into_pyarray(py),
            ends,
            ended,
            finals,
            terms,
        ))
    }

    /// The complete state of the environments: numbers `[N, k]`, counters `[N, m]`, ends `[N]`, returns `[N]`, seeds `[N, 2]` with the
    /// distances between the numbers of episodes. The last array holds the steps, and the steps at which the lesson began.
    #[expect(clippy::type_complexity, reason = "Python takes it apart")]
    fn state<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(
        Bound<'py, PyArray2<f64>>,
        Bound<'py, PyArray2<u64>>,
        Bound<'py, PyArray1<u8>>,
        Bound<'py, PyArray1<f64>>,
        Bound<'py, PyArray2<u64>>,
        Bound<'py, PyArray1<u64>>,
    )> {
        let guard = self.locked()?;
        let state = guard.as_ref().expect("not closed");
        state.can_step.map_err(PyRuntimeError::new_err)?;
        let EnvState { numbers, counters } = guarded(|| state.pool.save())?;
        // Where a new episode begins at once, the future does not depend on an end.
        let ends = if self.autoreset == Autoreset::SameStep {
            vec![0; self.count]
        } else {
            state.ends()
        };
        let members = state.pool.blocks.iter().flat_map(|block| &block.members);
        let seeds: Vec<u64> = members
            .flat_map(|member| [member.seed, member.stride])
            .collect();
        let wide = numbers.len() / self.count;
        let long = counters.len() / self.count;
        Ok((
            numbers.into_pyarray(py).reshape([self.count, wide])?,
            counters.into_pyarray(py).reshape([self.count, long])?,
            ends.into_pyarray(py),
            state.returns.clone().into_pyarray(py),
            seeds.into_pyarray(py).reshape([self.count, 2])?,
            vec![
                state.env_steps,
                state.lesson_from.unwrap_or(state.env_steps),
            ]
            .into_pyarray(py),
        ))
    }

    /// Continues, bit for bit, from what `state` returned, and returns the observations `[N, O]` to act on.
    #[expect(clippy::too_many_arguments, reason = "the parts of a state")]
    fn set_state<'py>(
        &self,
        py: Python<'py>,
        numbers: PyReadonlyArray2<'py, f64>,
        counters: PyReadonlyArray2<'py, u64>,
        ends: PyReadonlyArray1<'py, u8>,
        returns: PyReadonlyArray1<'py, f64>,
        seeds: PyReadonlyArray2<'py, u64>,
        times: PyReadonlyArray1<'py, u64>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        let ends: Option<Vec<Option<End>>> = ends
            .as_array()
            .iter()
            .map(|end| ENDS.get(usize::from(*end)).copied())
            .collect();
        let returns: Vec<f64> = returns.as_array().iter().copied().collect();
        let times: Vec<u64> = times.as_array().iter().copied().collect();
        let seeds: Vec<u64> = seeds.as_array().iter().copied().collect();
        let rows = [
            numbers.shape()[0],
            counters.shape()[0],
            returns.len(),
            seeds.len() / 2,
        ];
        let n = self.count;
        let saved = EnvState {
            numbers: numbers.as_array().iter().copied().collect(),
            counters: counters.as_array().iter().copied().collect(),
        };
        let restore = || {
            let ends = ends.context("an end is none of 0, 1, 2, 3")?;
            ensure!(
                rows == [n; 4] && ends.len() == n,
                "it is the state of {} hands, these are {n}",
                ends.len()
            );
            let waits = |end: &Option<End>| matches!(end, Some(End::Terminated | End::Truncated));
            let due = self.autoreset == Autoreset::SameStep && ends.iter().any(waits);
            ensure!(
                !due,
                "there, hands wait for their next episode; here they never do (autoreset_mode)"
            );
            let &[env_steps, lesson_from] = times.as_slice() else {
                anyhow::bail!("it has {} times, not 2", times.len())
            };
            state.can_step = Err(NOT_SET);
            state.pool.set_lesson(self.lesson(lesson_from));
            state.seed_together(0);
            state.env_steps = env_steps;
            state.lesson_from = Some(lesson_from);
            state.returns = returns;
            state.restore(&saved, ends, self.observation_size())?;
            let members = state.pool.members_mut().zip(seeds.chunks_exact(2));
            for (member, seed) in members {
                member.seed = seed[0];
                member.stride = seed[1];
            }
            Ok(())
        };
        guarded(restore)?
            .context("not a state of such hands")
            .map_err(refused)?;
        self.rows(py, state.observations.clone())
    }

    /// A picture `[480, 640, 3]` of each environment as it is now. A randomised object is shown with the size that the task gives it.
    fn render<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyArray3<u8>>>> {
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        state.can_step.map_err(PyRuntimeError::new_err)?;
        let State { pool, shown, .. } = state;
        let draw = || -> anyhow::Result<Vec<Vec<u8>>> {
            let own = match shown.take() {
                Some(own) => own,
                None => pictures::shown(&self.made.task)?,
            };
            let own = shown.insert(own);
            let states = pool.envs_mut().map(|hand| hand.sim.state());
            states.map(|state| picture(own, state)).collect()
        };
        let pictures = py.detach(|| guarded(draw))?;
        let pictures = pictures.map_err(|error| PyRuntimeError::new_err(format!("{error:#}")))?;
        let [width, height] = pictures::SIZE.map(|pixels| pixels as usize);
        pictures
            .into_iter()
            .map(|picture| picture.into_pyarray(py).reshape([height, width, 3]))
            .collect()
    }

    /// Frees the environments and their threads.
    fn close(&self, py: Python) -> PyResult<()> {
        if let Ok(mut guard) = self.locked() {
            let state = guard.take();
            drop(guard);
            py.detach(|| drop(state));
        }
        Ok(())
    }

    /// For tests: a panic on a worker thread.
    fn _panic_for_a_test(&self, py: Python) -> PyResult<()> {
        let mut guard = self.locked()?;
        let workers = guard.as_mut().expect("not closed").workers.pool()?;
        py.detach(|| {
            guarded(|| {
                workers.install(|| {
                    (0..4)
                        .into_par_iter()
                        .for_each(|i| assert!(i != 2, "as asked"))
                })
            })
        })
    }
}
