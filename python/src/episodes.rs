//! Episodes that ended, as columns with a row for each environment.

use numpy::{Element, IntoPyArray, PyArray1};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shadow_repose::repose::{EpisodeStats, task_terms};

/// Puts the episodes that ended into columns `[N]`, and resets their sums of rewards.
pub(crate) fn columns<'py>(
    py: Python<'py>,
    count: usize,
    episodes: &[(usize, EpisodeStats)],
    returns: &mut [f64],
) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    let floats = |of: &dyn Fn(usize, &EpisodeStats) -> f64| column(py, count, episodes, of);
    let counts = |of: fn(&EpisodeStats) -> u32| {
        column(py, count, episodes, &|_, episode| i64::from(of(episode)))
    };
    let flags =
        |of: fn(&EpisodeStats) -> bool| column(py, count, episodes, &|_, episode| of(episode));
    columns.set_item("r", floats(&|hand, _| returns[hand]))?;
    columns.set_item("l", counts(|episode| episode.length))?;
    columns.set_item("goals", counts(|episode| episode.goals))?;
    columns.set_item("dropped", flags(|episode| episode.dropped))?;
    columns.set_item("diverged", flags(|episode| episode.diverged))?;
    columns.set_item("randomized", flags(|episode| episode.randomized))?;
    columns.set_item(
        "rot_dist",
        floats(&|_, episode| episode.rot_dist_sum / f64::from(episode.length.max(1))),
    )?;
    let terms = PyDict::new(py);
    for (i, name) in task_terms().into_iter().map(|term| term.0).enumerate() {
        terms.set_item(name, floats(&|_, episode| episode.reward[i]))?;
    }
    columns.set_item("reward", terms)?;
    episodes.iter().for_each(|(hand, _)| returns[*hand] = 0.0);
    Ok(columns)
}

/// A value for each environment, zero where no episode has ended.
fn column<'py, T: Element + Default + Clone>(
    py: Python<'py>,
    count: usize,
    episodes: &[(usize, EpisodeStats)],
    of: &dyn Fn(usize, &EpisodeStats) -> T,
) -> Bound<'py, PyArray1<T>> {
    let mut column = vec![T::default(); count];
    for (hand, episode) in episodes {
        column[*hand] = of(*hand, episode);
    }
    column.into_pyarray(py)
}
