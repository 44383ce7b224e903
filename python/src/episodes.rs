//! Episodes that ended, as columns with a row for each environment.

use numpy::IntoPyArray;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shadow_repose::repose::EpisodeStats;

/// Puts the episodes that ended into columns `[N]`, and resets their sums of rewards.
pub(crate) fn columns<'py>(
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
