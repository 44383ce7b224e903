//! Trained policies, and their scores.

use std::path::PathBuf;
use std::sync::Mutex;

use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use shadow_repose::config::Override;
use shadow_repose::evaluate::{Actor, Episodes, Trial};
use shadow_repose::goal_times::GoalTimes;
use shadow_repose::load::Loaded;
use shadow_repose::play::json_score;
use shadow_repose::ppo::{FixedPolicy, GROUP};
use shadow_repose::repose::Score;

use crate::settings::{Set, overrides, text};
use crate::workers::Workers;
use crate::{guarded, refused};

/// The threads that compute large batches of actions.
static WORKERS: Mutex<Option<Workers>> = Mutex::new(None);

/// A policy and the task that it was trained for.
#[pyclass(frozen, module = "shadow_repose._native")]
pub(crate) struct Policy {
    loaded: Loaded,
    /// The settings with which it was loaded.
    set: Vec<Override>,
    fixed: FixedPolicy,
    settings: String,
}

impl Policy {
    pub(crate) fn loaded(&self) -> &Loaded {
        &self.loaded
    }

    /// Returns the settings with which it was loaded, and then these.
    pub(crate) fn with(&self, overrides: &[Override]) -> Vec<Override> {
        [&self.set, overrides].concat()
    }

    /// Computes rows of `width` values for the observations.
    fn computed<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
        width: usize,
        compute: impl Fn(&FixedPolicy, &[f32]) -> Vec<f32> + Sync,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let size = self.fixed.policy().spaces.observation_size;
        let [rows, found] = [observations.shape()[0], observations.shape()[1]];
        if found != size {
            return Err(PyValueError::new_err(format!("observations of {found} values, this policy reads {size}")));
        }
        let seen: Vec<f32> = observations.as_array().iter().copied().collect();
        // Another call may be using the threads. In a fork made meanwhile, they stay in use for ever.
        let (mut shared, mut own) = (WORKERS.try_lock(), Workers::new(1));
        let computed = if rows <= GROUP {
            py.detach(|| guarded(|| compute(&self.fixed, &seen)))?
        } else {
            let workers = match &mut shared {
                Ok(shared) => shared.get_or_insert_with(|| Workers::new(0)),
                Err(_) => &mut own,
            };
            let pool = workers.pool()?;
            py.detach(|| guarded(|| pool.install(|| compute(&self.fixed, &seen))))?
        };
        computed.into_pyarray(py).reshape([rows, width])
    }
}

#[pymethods]
impl Policy {
    /// Loads a built-in policy by its name, a policy file, or the best policy of a run folder.
    #[new]
    fn new(py: Python, place: PathBuf, set: Set) -> PyResult<Self> {
        let load = || {
            let set = overrides(set, false)?;
            let loaded = Loaded::find(Some(&place), &set)?;
            let settings = text(&*loaded.task(&set)?);
            let fixed = FixedPolicy::new(loaded.policy.clone());
            anyhow::Ok(Self { loaded, set, fixed, settings })
        };
        py.detach(|| guarded(load))?.map_err(refused)
    }

    /// Its description for the user.
    #[getter]
    fn name(&self) -> &str {
        &self.loaded.name
    }

    /// Where it was found: the name of a built-in policy, or its file.
    #[getter]
    fn place(&self) -> PathBuf {
        let path = self.loaded.origin.path();
        if self.loaded.origin.file().is_some() { std::path::absolute(path).unwrap_or(path.into()) } else { path.into() }
    }

    /// The settings of its task, as JSON.
    fn settings(&self) -> &str {
        &self.settings
    }

    /// The numbers of values in an observation and in an action.
    fn sizes(&self) -> [usize; 2] {
        let spaces = &self.fixed.policy().spaces;
        [spaces.observation_size, spaces.action_size]
    }

    /// The standard deviation of each action.
    #[getter]
    fn std(&self) -> f32 {
        self.fixed.policy().std()
    }

    /// The mean actions `[B, A]` for raw observations `[B, O]`.
    fn actions<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let width = self.fixed.policy().spaces.action_size;
        self.computed(py, observations, width, FixedPolicy::mean_actions)
    }

    /// The values `[B]` of raw observations `[B, O]`.
    fn values<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let rows = observations.shape()[0];
        self.computed(py, observations, 1, FixedPolicy::values)?.reshape([rows])
    }
}

/// The score that `play --json` prints, as JSON.
#[pyfunction]
pub(crate) fn evaluate(
    py: Python,
    policy: Py<Policy>,
    set: Set,
    episodes: usize,
    seed: u64,
    threads: usize,
) -> PyResult<String> {
    let most = 1 << 20;
    if !(1..=most).contains(&episodes) {
        return Err(PyValueError::new_err(format!("episodes = {episodes}: must lie in [1, {most}]")));
    }
    let played = Workers::new(threads).long(py, |stop| {
        let loaded = policy.get().loaded();
        let task = loaded.task(&policy.get().with(&overrides(set, false)?))?;
        let (actor, mut goal_times) = (Actor::Mean(loaded.policy.freeze()), GoalTimes::new(task.config()));
        let trial = Trial { task: &task, actor: &actor, episodes: Episodes::scored(seed, episodes), stop };
        let played = trial.play(&mut |moment| {
            goal_times.observe(&moment);
            Ok(())
        })?;
        let checkpoint = loaded.origin.to_string();
        let score = played.map(|played| Score::of(&played, task.config().ctrl_dt));
        let score = score.map(|score| json_score(&score, &goal_times, Some(&checkpoint), seed));
        anyhow::Ok(score.map_or(String::new(), |score| score.to_string()))
    })?;
    played.map_err(refused)
}
