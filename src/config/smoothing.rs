//! The smoothing of actions, a setting of the task that a training replaces by a ramp.

use std::path::Path;

use anyhow::{Result, ensure};
use serde::Deserialize;
use toml::Table;

use super::Ramp;
use super::overlay::{DEFAULTS, lookup, number, overlay, table_of};

/// The setting of the task, and the ramp that it follows in a training.
const SMOOTHING: &str = "env.act_moving_average";
const TRAINED: &str = "training.act_moving_average";

/// Returns the settings that make the smoothing of a whole training constant, if `table` sets only the smoothing of the task. The
/// table is about to be laid over `merged`.
pub(super) fn smoothing_named_alone(table: &Table, merged: &Table) -> Option<Table> {
    let constant = lookup(table, SMOOTHING).filter(|value| number(value).is_some())?;
    lookup(table, TRAINED).is_none().then(|| table_of(TRAINED, &constant.to_string(), merged))
}

/// Checks that a file, which is about to be laid over `under`, does not set two smoothings, one of which would not be used.
///
/// # Errors
/// Fails if the smoothing of the task is not the initial smoothing of the training.
pub(super) fn expect_one_smoothing(path: &Path, table: &Table, under: &Table) -> Result<()> {
    let given = [SMOOTHING, TRAINED].map(|key| lookup(table, key));
    let [Some(task), Some(_)] = given else { return Ok(()) };
    let mut merged = DEFAULTS.clone();
    [under, table].into_iter().for_each(|table| overlay(&mut merged, table, &DEFAULTS, "", &mut Vec::new()));
    let ramp = lookup(&merged, TRAINED).and_then(|ramp| Ramp::deserialize(ramp.clone()).ok());
    if let (Some(task), Some(ramp)) = (number(task), ramp) {
        let (path, first) = (path.display(), ramp.by_equal_steps(0));
        ensure!(task == first, "{path}: {SMOOTHING} = {task}, but {TRAINED} begins with {first}: set only one of them");
    }
    Ok(())
}
