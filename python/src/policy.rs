//! Trained policies.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use anyhow::Result;
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray2, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use shadow_repose::config::{Override, Reader};
use shadow_repose::load::{self, Loaded, PolicySource};
use shadow_repose::ppo::{self, Checkpoint, GROUP};
use shadow_repose::sim::SceneFiles;

use crate::errors::{guarded, refused};
use crate::settings::{Files, Made, Set, overrides, text};
use crate::workers::Workers;

/// The threads that compute large batches of actions.
static WORKERS: Mutex<Option<Workers>> = Mutex::new(None);

/// A policy and the task that it was trained for.
#[pyclass(frozen, module = "shadow_repose._native")]
pub(crate) struct Policy {
    pub(crate) loaded: Loaded,
    /// The settings with which it was loaded.
    set: Vec<Override>,
    settings: String,
    warnings: Vec<String>,
}

impl Policy {
    /// The settings with which it was loaded, and then these.
    pub(crate) fn with(&self, overrides: &[Override]) -> Vec<Override> {
        [&self.set, overrides].concat()
    }

    /// The task of environments for this policy. With `training`, nothing assists it, unless the user sets otherwise.
    ///
    /// # Errors
    /// Fails if the settings are invalid, or if the scene cannot be used.
    pub(crate) fn resolve(&self, overrides: &[Override], training: bool) -> Result<Made> {
        let overrides = self.with(overrides);
        let is_of_task =
            |set: &&Override| matches!(set.key.split('.').next(), Some("env" | "hand"));
        let of_task: Vec<Override> = overrides.iter().filter(is_of_task).cloned().collect();
        let task = self.loaded.task(&of_task)?;
        let whole = if training {
            let learnt = Override::new("training.assist", 0);
            let overrides: Vec<Override> = [learnt].into_iter().chain(overrides).collect();
            load::settings(
                &self.loaded.checkpoint,
                self.loaded.origin.path(),
                Reader::Run,
                &overrides,
            )?
        } else {
            self.loaded.settings(&of_task)?
        };
        Ok(Made::new(whole, task, Some(self.loaded.record.clone())))
    }

    /// Computes rows of `width` values for the observations.
    fn computed<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
        width: usize,
        compute: impl Fn(&ppo::Policy, &[f32]) -> Vec<f32> + Sync,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let size = self.loaded.policy.spaces.observation_size;
        let [rows, found] = [observations.shape()[0], observations.shape()[1]];
        if found != size {
            return Err(PyValueError::new_err(format!(
                "observations of {found} values, this policy reads {size}"
            )));
        }
        let seen: Vec<f32> = observations.as_array().iter().copied().collect();
        // Another call may be using the threads. In a fork made meanwhile, they stay in use for ever.
        let mut shared = WORKERS.try_lock();
        let mut own = Workers::new(1);
        let computed = if rows <= GROUP {
            py.detach(|| guarded(|| compute(&self.loaded.policy, &seen)))?
        } else {
            let workers = match &mut shared {
                Ok(shared) => shared.get_or_insert_with(|| Workers::new(0)),
                Err(_) => &mut own,
            };
            let pool = workers.pool()?;
            py.detach(|| guarded(|| pool.install(|| compute(&self.loaded.policy, &seen))))?
        };
        computed.into_pyarray(py).reshape([rows, width])
    }
}

#[pymethods]
impl Policy {
    /// Loads a built-in policy by its name, a policy file, or the best policy of a run folder. A copy has the content of a file, and the
    /// files of its scene.
    #[new]
    #[pyo3(signature = (place, set, content = None, files = Files::new()))]
    fn new(
        py: Python,
        place: PathBuf,
        set: Set,
        content: Option<Vec<u8>>,
        files: Files,
    ) -> PyResult<Self> {
        let load = || {
            let set = overrides(set, false)?;
            let mut loaded = match content {
                None => Loaded::find(Some(&place), &set)?,
                Some(bytes) => {
                    Loaded::new(PolicySource::File(place), Checkpoint::parse(&bytes)?, &set)?
                }
            };
            loaded.files = Arc::new(SceneFiles(files));
            let task = loaded.task(&set)?;
            loaded.files = task.files().clone();
            anyhow::Ok(Self {
                loaded,
                set,
                settings: text(&task),
                warnings: task.warnings.clone(),
            })
        };
        py.detach(|| guarded(load))?.map_err(refused)
    }

    /// Its description for the user.
    #[getter]
    fn name(&self) -> &str {
        &self.loaded.name
    }

    /// Warnings where it does not fit its task well.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.warnings.clone()
    }

    /// All that a copy is made of: the name of a built-in policy, or its file with the content, and the files of its scene.
    fn parts(&self) -> PyResult<(PathBuf, Option<Vec<u8>>, Files)> {
        let loaded = &self.loaded;
        let content = loaded.origin.file();
        let content = content.map(|_| loaded.checkpoint.policy_alone().to_bytes());
        Ok((
            loaded.origin.path().into(),
            content.transpose().map_err(refused)?,
            loaded.files.0.clone(),
        ))
    }

    /// The settings of its task, as JSON.
    fn settings(&self) -> &str {
        &self.settings
    }

    /// The numbers of values in an observation and in an action.
    fn sizes(&self) -> [usize; 2] {
        let spaces = &self.loaded.policy.spaces;
        [spaces.observation_size, spaces.action_size]
    }

    /// `[A]`: the standard deviation of each action.
    #[getter]
    fn std<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let logs = self.loaded.policy.log_std.iter();
        logs.map(|log| log.exp())
            .collect::<Vec<f32>>()
            .into_pyarray(py)
    }

    /// Its file.
    fn content<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self.loaded.checkpoint.policy_alone().to_bytes();
        Ok(PyBytes::new(py, &bytes.map_err(refused)?))
    }

    /// The mean actions `[B, A]` for raw observations `[B, O]`.
    fn actions<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let width = self.loaded.policy.spaces.action_size;
        self.computed(py, observations, width, ppo::Policy::mean_actions)
    }

    /// The values `[B]` of raw observations `[B, O]`.
    fn values<'py>(
        &self,
        py: Python<'py>,
        observations: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        if !self.loaded.policy.has_critic {
            return Err(PyValueError::new_err(
                "this policy was learnt elsewhere and has no critic",
            ));
        }
        let rows = observations.shape()[0];
        self.computed(py, observations, 1, ppo::Policy::values)?
            .reshape([rows])
    }
}
