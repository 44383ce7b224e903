//! Hands that step together.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};

use anyhow::{Context, ensure};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::prelude::*;
use shadow_repose::config::Config;
use shadow_repose::env::{Autoreset, End, EnvPool, EnvState};
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{EpisodeStats, Lesson, Randomization, Repose, Task};

use crate::policy::Policy;
use crate::settings::{Set, overrides, resolve, text};
use crate::workers::Workers;
use crate::{guarded, refused};

/// N hands of one task, with O values in an observation and A in an action.
#[pyclass(frozen, module = "shadow_repose._native")]
pub(crate) struct Hands {
    task: Arc<Task>,
    config: Config,
    training: bool,
    autoreset: Autoreset,
    count: usize,
    /// None after `close`.
    state: Mutex<Option<State>>,
}

struct State {
    pool: EnvPool<Repose>,
    workers: Workers,
    seed: u64,
    /// Control steps, over all hands; in a training they decide the lesson.
    env_steps: u64,
    /// The number of steps from which on the next lesson holds.
    next_lesson: u64,
    /// `[N, O]`: what to act on next.
    observations: Vec<f32>,
    /// `[N]`: the rewards of each running episode.
    returns: Vec<f64>,
    can_step: Result<(), &'static str>,
}

/// What Python is told of an end: nothing, or one of three numbers.
const ENDS: [Option<End>; 4] = [None, Some(End::Terminated), Some(End::Truncated), Some(End::Redirected)];

const NOT_RESET: &str = "reset the hands before they step";
const FAILED: &str = "an earlier step failed: reset the hands before they step again";

/// What a step returns: observations `[N, O]`, rewards `[N]`, ends `[N]`, and the episodes that ended as columns.
type Stepped<'py> =
    (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray1<f32>>, Bound<'py, PyArray1<u8>>, Option<Bound<'py, PyDict>>);

impl Hands {
    /// Returns the state, unless it is in use or gone.
    fn locked(&self) -> PyResult<MutexGuard<'_, Option<State>>> {
        let guard = match self.state.try_lock() {
            Ok(guard) => guard,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                return Err(PyRuntimeError::new_err("another thread is using these hands"));
            }
        };
        if guard.is_some() { Ok(guard) } else { Err(PyRuntimeError::new_err("these hands are closed")) }
    }

    fn observation_size(&self) -> usize {
        self.task.spaces().observation_size
    }

    fn rows<'py>(&self, py: Python<'py>, rows: Vec<f32>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        rows.into_pyarray(py).reshape([self.count, self.observation_size()])
    }

    /// Returns the lesson after `env_steps`. Every goal that is reached ends with a redirection, which the caller may ignore.
    fn lesson(&self, env_steps: u64) -> Lesson {
        let mut lesson = match self.training {
            true => Lesson::at(env_steps, &self.config),
            false => Lesson::task(self.task.config()),
        };
        lesson.goals_end = true;
        lesson
    }

    /// Starts the lesson that holds now. As in a training, it holds for the steps of an iteration.
    fn begin_lesson(&self, state: &mut State) {
        if state.env_steps < state.next_lesson {
            return;
        }
        state.pool.set_lesson(self.lesson(state.env_steps));
        let steps = self.config.ppo.horizon_at(state.env_steps) * self.count;
        state.next_lesson = state.env_steps.saturating_add(steps as u64);
    }
}

impl State {
    /// Returns the ends `[N]` of the last step as numbers.
    fn ends(&self) -> Vec<u8> {
        let number = |end: &Option<End>| ENDS.iter().position(|one| one == end).expect("an end") as u8;
        self.pool.blocks.iter().flat_map(|block| &block.ends).map(number).collect()
    }

    fn started(&mut self, marked: &[bool]) {
        self.returns.iter_mut().zip(marked).filter(|(_, marked)| **marked).for_each(|(sum, _)| *sum = 0.0);
    }
}

#[pymethods]
impl Hands {
    #[new]
    #[pyo3(signature = (count, threads, seed, config, policy, set, training, autoreset))]
    #[expect(clippy::too_many_arguments, reason = "Python names each of them")]
    fn new(
        py: Python,
        count: usize,
        threads: usize,
        seed: u64,
        config: Option<PathBuf>,
        policy: Option<Py<Policy>>,
        set: Set,
        training: bool,
        autoreset: &str,
    ) -> PyResult<Self> {
        let autoreset = match autoreset {
            "SameStep" => Autoreset::SameStep,
            "NextStep" => Autoreset::NextStep,
            _ => Autoreset::Disabled,
        };
        let mut workers = Workers::new(threads);
        let made = workers.long(py, |stop| {
            let overrides = overrides(set, training)?;
            let policy = policy.as_ref().map(|policy| policy.get());
            let (config, task) = resolve(count, config.as_deref(), policy, &overrides, training)?;
            let randomization = if training { Randomization::new(&task, &config.randomization)? } else { None };
            let hand = |_| {
                let goes_on = !stop.load(std::sync::atomic::Ordering::Relaxed);
                goes_on.then(|| Repose::randomized(&task, randomization.as_ref()))
            };
            let hands: Option<Vec<Repose>> = (0..count).into_par_iter().map(hand).collect();
            let pool = EnvPool::new(seed, hands.context("interrupted")?, &Exchange::alone(1));
            anyhow::Ok((config, task, pool))
        })?;
        let (config, task, pool) = made.map_err(refused)?;
        let state = State {
            pool,
            workers,
            seed,
            env_steps: 0,
            next_lesson: 0,
            observations: vec![0.0; count * task.spaces().observation_size],
            returns: vec![0.0; count],
            can_step: Err(NOT_RESET),
        };
        Ok(Self { task, config, training, autoreset, count, state: Mutex::new(Some(state)) })
    }

    /// The groups of an observation: (name, first index, length, unit).
    fn layout(&self) -> Vec<(&'static str, usize, usize, &'static str)> {
        self.task.hand().layout.groups.iter().map(|group| (group.name, group.start, group.length, group.unit)).collect()
    }

    /// The number of values in an action.
    #[getter]
    fn action_size(&self) -> usize {
        self.task.spaces().action_size
    }

    /// The length of an episode that no drop ends.
    #[getter]
    fn max_episode_steps(&self) -> u32 {
        self.task.config().max_episode_steps()
    }

    /// The settings of the task and the names of the hand's parts, as JSON.
    fn settings(&self) -> String {
        text(&self.task)
    }

    /// What a user should know of how the policy fits, and of what the settings replace in a scene.
    fn warnings_and_notes(&self) -> (Vec<String>, Vec<String>) {
        (self.task.warnings().to_vec(), self.task.notes())
    }

    #[getter]
    fn env_steps(&self) -> PyResult<u64> {
        Ok(self.locked()?.as_ref().map_or(0, |state| state.env_steps))
    }

    #[setter]
    fn set_env_steps(&self, env_steps: u64) -> PyResult<()> {
        if let Some(state) = self.locked()?.as_mut() {
            (state.env_steps, state.next_lesson) = (env_steps, env_steps);
        }
        Ok(())
    }

    /// Starts an episode of each hand, or of those that are marked, and returns all observations.
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seed: Option<u64>,
        marked: Option<PyReadonlyArray1<'py, bool>>,
        aged: bool,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let marked = marked.map_or(vec![true; self.count], |marked| marked.as_array().iter().copied().collect());
        if marked.len() != self.count {
            return Err(PyValueError::new_err(format!("{} marks for {} hands", marked.len(), self.count)));
        }
        let all = marked.iter().all(|marked| *marked);
        if let (Some(_), false) = (seed, all) {
            return Err(PyValueError::new_err("a seed restarts all hands: give no seed with a reset_mask"));
        }
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        if let (Err(reason), false) = (state.can_step, all) {
            return Err(PyRuntimeError::new_err(reason));
        }
        if let Some(seed) = seed {
            state.seed = seed;
            state.pool.reseed(seed);
        }
        self.begin_lesson(state);
        let State { pool, workers, observations, .. } = &mut *state;
        let workers = workers.pool()?;
        let started = py.detach(|| guarded(|| workers.install(|| pool.restart(&marked, aged, observations))));
        if let Err(error) = started {
            state.can_step = Err(FAILED);
            return Err(error);
        }
        state.can_step = Ok(());
        state.started(&marked);
        self.rows(py, state.observations.clone())
    }

    /// Steps all hands once.
    fn step<'py>(&self, py: Python<'py>, actions: PyReadonlyArray2<'py, f32>) -> PyResult<Stepped<'py>> {
        let (n, size) = (self.count, self.action_size());
        if actions.shape() != [n, size] {
            let text = format!("actions have the shape {:?}, expected ({n}, {size})", actions.shape());
            return Err(PyValueError::new_err(text.replace('[', "(").replace(']', ")")));
        }
        // A copy, because another Python thread may write to the array meanwhile.
        let actions: Vec<f32> = actions.as_array().iter().copied().collect();
        if let Some(at) = actions.iter().position(|x| x.is_nan()) {
            return Err(PyValueError::new_err(format!("actions[{}, {}] is NaN", at / size, at % size)));
        }
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        state.can_step.map_err(PyRuntimeError::new_err)?;
        let over = state.pool.blocks.iter().flat_map(|block| &block.ends);
        let over = over.map(|end| matches!(end, Some(End::Terminated | End::Truncated)));
        if let Some(hand) =
            (self.autoreset == Autoreset::Disabled).then(|| over.enumerate().find(|(_, over)| *over)).flatten()
        {
            let text = format!("the episode of hand {} is over: reset it with a reset_mask", hand.0);
            return Err(PyRuntimeError::new_err(text));
        }
        self.begin_lesson(state);
        let mut rewards = vec![0.0; n];
        let State { pool, workers, observations, .. } = &mut *state;
        let workers = workers.pool()?;
        let stepped = py
            .detach(|| guarded(|| workers.install(|| pool.step(&actions, self.autoreset, &mut rewards, observations))));
        let stepped =
            stepped.and_then(|stepped| stepped.map_err(|error| PyRuntimeError::new_err(format!("{error:#}"))));
        let episodes = match stepped {
            Ok(episodes) => episodes,
            Err(error) => {
                state.can_step = Err(FAILED);
                return Err(error);
            }
        };
        state.env_steps += n as u64;
        state.returns.iter_mut().zip(&rewards).for_each(|(sum, reward)| *sum += f64::from(*reward));
        let ended = if episodes.is_empty() { None } else { Some(columns(py, n, &episodes, &mut state.returns)?) };
        let observations = self.rows(py, state.observations.clone())?;
        Ok((observations, rewards.into_pyarray(py), state.ends().into_pyarray(py), ended))
    }

    /// The observations `[N, O]` at the ends of the last step, each under its old goal; zeros elsewhere.
    fn final_observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let (guard, size) = (self.locked()?, self.observation_size());
        let blocks = guard.as_ref().into_iter().flat_map(|state| &state.pool.blocks);
        let rows = blocks.flat_map(|block| block.ends.iter().zip(block.final_observations.chunks_exact(size)));
        let mut finals = vec![0.0; self.count * size];
        for (to, (end, row)) in finals.chunks_exact_mut(size).zip(rows) {
            if end.is_some() {
                to.copy_from_slice(row);
            }
        }
        self.rows(py, finals)
    }

    /// The rewards of the last step by term, the task's and those of training, and the rotation errors after it.
    fn terms<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyDict>, Bound<'py, PyArray1<f32>>)> {
        let mut guard = self.locked()?;
        let details = guard.as_mut().into_iter().flat_map(|state| state.pool.envs_mut());
        let details: Vec<_> = details.map(|hand| *hand.last_step()).collect();
        let terms = PyDict::new(py);
        let put = |name: &str, values: Vec<f32>| terms.set_item(name, values.into_pyarray(py));
        for (i, (name, _)) in details[0].reward.named().enumerate() {
            put(name, details.iter().map(|step| step.reward.values()[i] as f32).collect())?;
        }
        for (i, (name, _)) in details[0].training.named().enumerate().filter(|_| self.training) {
            put(name, details.iter().map(|step| step.training.values()[i] as f32).collect())?;
        }
        let errors: Vec<f32> = details.iter().map(|step| step.rot_dist as f32).collect();
        Ok((terms, errors.into_pyarray(py)))
    }

    /// Everything that the future of the hands depends on: (numbers `[N, k]`, counters `[N, m]`, ends `[N]`, returns `[N]`, and the
    /// seed, the steps and the steps at which the next lesson begins).
    #[expect(clippy::type_complexity, reason = "Python takes it apart")]
    fn state<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(
        Bound<'py, PyArray2<f64>>,
        Bound<'py, PyArray2<u64>>,
        Bound<'py, PyArray1<u8>>,
        Bound<'py, PyArray1<f64>>,
        Bound<'py, PyArray1<u64>>,
    )> {
        let guard = self.locked()?;
        let state = guard.as_ref().expect("not closed");
        state.can_step.map_err(PyRuntimeError::new_err)?;
        let EnvState { numbers, counters } = guarded(|| state.pool.save())?;
        let (wide, long) = (numbers.len() / self.count, counters.len() / self.count);
        Ok((
            numbers.into_pyarray(py).reshape([self.count, wide])?,
            counters.into_pyarray(py).reshape([self.count, long])?,
            state.ends().into_pyarray(py),
            state.returns.clone().into_pyarray(py),
            vec![state.seed, state.env_steps, state.next_lesson].into_pyarray(py),
        ))
    }

    /// Goes on, bit for bit, from what `state` returned, and returns the observations `[N, O]` to act on.
    fn set_state<'py>(
        &self,
        py: Python<'py>,
        numbers: PyReadonlyArray2<'py, f64>,
        counters: PyReadonlyArray2<'py, u64>,
        ends: PyReadonlyArray1<'py, u8>,
        returns: PyReadonlyArray1<'py, f64>,
        times: PyReadonlyArray1<'py, u64>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let mut guard = self.locked()?;
        let state = guard.as_mut().expect("not closed");
        let ends: Option<Vec<Option<End>>> =
            ends.as_array().iter().map(|end| ENDS.get(usize::from(*end)).copied()).collect();
        let returns: Vec<f64> = returns.as_array().iter().copied().collect();
        let times: Vec<u64> = times.as_array().iter().copied().collect();
        let (rows, n) = ([numbers.shape()[0], counters.shape()[0], returns.len()], self.count);
        let saved = EnvState {
            numbers: numbers.as_array().iter().copied().collect(),
            counters: counters.as_array().iter().copied().collect(),
        };
        let restore = || {
            let ends = ends.context("an end is none of 0, 1, 2, 3")?;
            ensure!(rows == [n; 3] && ends.len() == n, "it is the state of {} hands, these are {n}", ends.len());
            let &[seed, env_steps, next_lesson] = times.as_slice() else { anyhow::bail!("three numbers are missing") };
            state.can_step = Err(FAILED);
            state.pool.set_lesson(self.lesson(env_steps));
            state.pool.reseed(seed);
            (state.seed, state.env_steps, state.next_lesson, state.returns) = (seed, env_steps, next_lesson, returns);
            let size = self.observation_size();
            let mut rest = &mut state.observations[..];
            let sizes = state.pool.block_sizes().into_iter();
            let rows = sizes.map(|block| rest.split_off_mut(..block * size).expect("rows of each block")).collect();
            state.pool.restore(&saved, rows)?;
            let mut ends = ends.into_iter();
            let all = state.pool.blocks.iter_mut().flat_map(|block| &mut block.ends);
            all.zip(&mut ends).for_each(|(own, end)| *own = end);
            state.can_step = Ok(());
            Ok(())
        };
        guarded(restore)?.context("not a state of such hands").map_err(refused)?;
        self.rows(py, state.observations.clone())
    }

    /// Frees the hands and their threads.
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
        py.detach(|| guarded(|| workers.install(|| (0..4).into_par_iter().for_each(|i| assert!(i != 2, "as asked")))))
    }
}

/// Returns the episodes that ended as columns `[N]`, and starts their sums of rewards again.
fn columns<'py>(
    py: Python<'py>,
    count: usize,
    episodes: &[(usize, EpisodeStats)],
    returns: &mut [f64],
) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    let floats = |of: &dyn Fn(usize, &EpisodeStats) -> f64| {
        let mut column = vec![0.0; count];
        episodes.iter().for_each(|(hand, episode)| column[*hand] = of(*hand, episode));
        column.into_pyarray(py)
    };
    let counts = |of: fn(&EpisodeStats) -> u32| {
        let mut column = vec![0_i64; count];
        episodes.iter().for_each(|(hand, episode)| column[*hand] = of(episode).into());
        column.into_pyarray(py)
    };
    let flags = |of: fn(&EpisodeStats) -> bool| {
        let mut column = vec![false; count];
        episodes.iter().for_each(|(hand, episode)| column[*hand] = of(episode));
        column.into_pyarray(py)
    };
    columns.set_item("r", floats(&|hand, _| returns[hand]))?;
    columns.set_item("l", counts(|episode| episode.length))?;
    columns.set_item("goals", counts(|episode| episode.goals))?;
    columns.set_item("dropped", flags(|episode| episode.dropped))?;
    columns.set_item("diverged", flags(|episode| episode.diverged))?;
    columns.set_item("randomized", flags(|episode| episode.randomized))?;
    columns.set_item("rot_dist", floats(&|_, episode| episode.rot_dist_sum / f64::from(episode.length.max(1))))?;
    let terms = PyDict::new(py);
    for (i, (name, _)) in episodes[0].1.reward.named().enumerate() {
        terms.set_item(name, floats(&|_, episode| episode.reward.values()[i]))?;
    }
    columns.set_item("reward", terms)?;
    episodes.iter().for_each(|(hand, _)| returns[*hand] = 0.0);
    Ok(columns)
}
