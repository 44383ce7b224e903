//! Scores of policies, and policies that were learnt elsewhere.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Result;
use numpy::{
    IntoPyArray, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use shadow_repose::config::Symmetry;
use shadow_repose::evaluate::{Actor, Episodes, Trial};
use shadow_repose::goal_times::GoalTimes;
use shadow_repose::os::{Interrupted, OutputFile};
use shadow_repose::play::json_score;
use shadow_repose::ppo::{Array, Checkpoint};
use shadow_repose::repose::Score;
use shadow_repose::run;
use shadow_repose::spaces::Spaces;
use shadow_repose::trace::Trace;

use crate::errors::refused;
use crate::hands::Hands;
use crate::policy::Policy;
use crate::settings::{Set, overrides, resolve};
use crate::workers::Workers;

/// A layer: its weights `[outputs, inputs]` and biases `[outputs]`.
type Layer<'py> = (PyReadonlyArray2<'py, f32>, PyReadonlyArray1<'py, f32>);

/// The number of observations that the normaliser of a policy is said to have seen, so that it changes slowly where training continues.
const SEEN: f64 = 1e8;

/// The numbers of a normaliser: means `[O]`, variances `[O]`, what is added to variances, and the limit of normalised values.
type Normalisation = (Vec<f64>, Vec<f64>, f64, f64);

/// The file of a policy for the task of `hands` that was learnt elsewhere: an actor of these layers without a critic. It knows of no
/// symmetry. There is a standard deviation `[A]` for each action.
#[pyfunction]
pub(crate) fn file_of<'py>(
    py: Python<'py>,
    hands: &Hands,
    layers: Vec<Layer>,
    activation: &str,
    normalisation: Normalisation,
    std: Vec<f32>,
) -> PyResult<Bound<'py, PyBytes>> {
    let (mean, variance, epsilon, clip) = normalisation;
    let (mut config, record, scene, env_steps) = hands.learnt_task()?;
    config.ppo.symmetry = Symmetry::None;
    config.ppo.activation = serde_json::from_value(activation.into())
        .map_err(|_| PyValueError::new_err(format!("the activation {activation} is unknown")))?;
    let inner = &layers[..layers.len().saturating_sub(1)];
    config.ppo.hidden = inner.iter().map(|(_, biases)| biases.len()).collect();
    let mut checkpoint = Checkpoint::default();
    checkpoint.config = config.to_text();
    checkpoint.hand = record.with(Symmetry::None).to_text();
    checkpoint.scene = scene;
    checkpoint.progress.env_steps = env_steps;
    for (i, (weights, biases)) in layers.iter().enumerate() {
        let numbers = weights.as_array().iter().copied().collect();
        let weights = Array::F32(weights.shape().to_vec(), numbers);
        checkpoint.insert(&format!("actor.{i}.weight"), weights);
        let numbers = biases.as_array().to_vec();
        let biases = Array::F32(vec![numbers.len()], numbers);
        checkpoint.insert(&format!("actor.{i}.bias"), biases);
    }
    let log_std = std.iter().map(|std| std.ln()).collect();
    checkpoint.insert("log_std", Array::F32(vec![std.len()], log_std));
    for (name, numbers) in [
        ("mean", mean),
        ("variance", variance),
        ("count", vec![SEEN]),
        ("constants", vec![epsilon, clip]),
    ] {
        let numbers = Array::F64(vec![numbers.len()], numbers);
        checkpoint.insert(&format!("normalizer.{name}"), numbers);
    }
    Ok(PyBytes::new(py, &checkpoint.to_bytes().map_err(refused)?))
}

/// Lets the function write `actions`, a row for each row of observations. At an exception it sets `stop`.
fn ask(
    act: &Py<PyAny>,
    spaces: Spaces,
    (observations, actions): (&[f32], &mut [f32]),
    stop: &AtomicBool,
) -> PyResult<()> {
    let size = spaces.action_size;
    let rows = actions.len() / size;
    let asked = Python::try_attach(|py| {
        let seen = observations
            .to_vec()
            .into_pyarray(py)
            .reshape([rows, spaces.observation_size])?;
        let chosen: PyReadonlyArrayDyn<f32> = act.call1(py, (seen,))?.extract(py)?;
        if chosen.shape() != [rows, size] {
            let text = format!(
                "actions have the shape {:?}, expected [{rows}, {size}]",
                chosen.shape()
            );
            return Err(PyValueError::new_err(text));
        }
        actions
            .iter_mut()
            .zip(chosen.as_array())
            .for_each(|(action, chosen)| *action = *chosen);
        Ok(())
    });
    let ended = || Err(PyRuntimeError::new_err("Python has ended"));
    let asked = asked.unwrap_or_else(ended);
    stop.fetch_or(asked.is_err(), Ordering::Relaxed);
    asked
}

/// The score that `play --json` prints, as JSON, and warnings about it. Who is scored is a policy, or a function that returns the actions
/// `[N, A]`, float32, for the observations `[N, O]`. Without `hands`, the task is the policy's or has the default settings. The first
/// episodes are written to the file `trace`.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python names them")]
pub(crate) fn evaluate(
    py: Python,
    scored: Py<PyAny>,
    hands: Option<&Hands>,
    set: Set,
    episodes: usize,
    seed: u64,
    threads: usize,
    trace: Option<PathBuf>,
) -> PyResult<(String, Vec<String>)> {
    let most = 1 << 20;
    if !(1..=most).contains(&episodes) {
        return Err(PyValueError::new_err(format!(
            "episodes = {episodes}: must lie in [1, {most}]"
        )));
    }
    let policy = scored.cast_bound::<Policy>(py).ok().map(Bound::get);
    let raised = Mutex::new(None);
    let played = Workers::new(threads).long(py, |stop| {
        let set = overrides(set, false)?;
        let task = match (policy, hands) {
            (Some(policy), Some(hands)) => hands.task_for(&policy.loaded.record)?,
            (None, Some(hands)) => hands.task(),
            (Some(policy), None) => policy.loaded.task(&policy.with(&set))?,
            (None, None) => resolve(None, &set, &[])?.task,
        };
        let loaded = policy.map(|policy| &policy.loaded);
        let outside = |observations: &[f32], actions: &mut [f32]| {
            if let Err(error) = ask(&scored, task.spaces(), (observations, actions), stop) {
                raised
                    .lock()
                    .expect("no panic while it is held")
                    .get_or_insert(error);
            }
        };
        let actor = loaded.map_or(Actor::Outside(&outside), |loaded| {
            Actor::Mean(loaded.policy.freeze())
        });
        let checkpoint = loaded.map(|loaded| loaded.origin.to_string());
        if let Some(path) = &trace {
            run::expect_output(
                path,
                loaded.and_then(|loaded| loaded.origin.file()),
                task.config.model_file(),
            )?;
        }
        let trial = Trial {
            task: &task,
            actor: &actor,
            episodes: Episodes::scored(seed, episodes),
            stop,
        };
        let failed = || raised.lock().expect("no panic while it is held").is_some();
        played(
            &trial,
            seed,
            checkpoint.as_deref(),
            trace.as_deref(),
            &failed,
        )
    })?;
    raised
        .into_inner()
        .ok()
        .flatten()
        .map_or_else(|| played.map_err(refused), Err)
}

/// Plays the episodes, and writes the first ones to the file `trace`. The result is their score as JSON, and warnings, or nothing if they
/// were stopped or have `failed`.
fn played(
    trial: &Trial,
    seed: u64,
    checkpoint: Option<&str>,
    trace: Option<&Path>,
    failed: &dyn Fn() -> bool,
) -> Result<(String, Vec<String>)> {
    let config = &trial.task.config;
    let output = trace.map(OutputFile::create).transpose()?;
    let mut output = output.map(|file| {
        (
            file,
            Trace::new(trial.task, trial.actor.name(), checkpoint, seed),
        )
    });
    let mut goal_times = GoalTimes::new(config);
    let played = trial.play(&mut |moment| {
        goal_times.observe(&moment);
        output
            .iter_mut()
            .for_each(|(_, trace)| trace.record(&moment));
        Ok(())
    });
    let played = match played {
        Err(error) if error.is::<Interrupted>() => return Ok(Default::default()),
        played => played?,
    };
    if failed() {
        return Ok(Default::default());
    }
    if let Some((file, trace)) = output {
        file.finish(trace.finish().as_bytes())?;
    }
    let score = Score::of(&played, config.ctrl_dt);
    let warnings = trial.task.warnings.iter().cloned();
    let warnings = warnings.chain(score.divergence()).collect();
    let json = json_score(&score, &goal_times, checkpoint, seed);
    Ok((json.to_string(), warnings))
}
