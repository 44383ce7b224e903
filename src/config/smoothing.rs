//! The smoothing of actions, a setting of the task that a training replaces by a ramp.

use std::path::Path;

use anyhow::{Result, ensure};
use toml::Table;

use super::overlay::{lookup, number, table_of};

/// The setting of the task, and the ramp that it follows in a training.
const SMOOTHING: &str = "env.act_moving_average";
const TRAINED: &str = "training.act_moving_average";

/// Returns the settings that make the smoothing of a whole training constant, if `table` sets only the smoothing of the task. The
/// table is about to be laid over `merged`.
pub(super) fn smoothing_named_alone(table: &Table, merged: &Table) -> Option<Table> {
    let constant = lookup(table, SMOOTHING).filter(|value| number(value).is_some())?;
    lookup(table, TRAINED).is_none().then(|| table_of(TRAINED, &constant.to_string(), merged))
}

/// Checks that a file does not set two smoothings, one of which would not be used.
///
/// # Errors
/// Fails if the smoothing of the task is not the initial smoothing of the training.
pub(super) fn expect_one_smoothing(user: Option<&(&Path, Table)>) -> Result<()> {
    let Some((path, table)) = user else { return Ok(()) };
    let [task, training] = [SMOOTHING, TRAINED].map(|key| lookup(table, key));
    let first = training.and_then(|ramp| number(ramp.get("from").unwrap_or(ramp)));
    if let (Some(task), Some(first)) = (task.and_then(number), first) {
        let path = path.display();
        ensure!(task == first, "{path}: {SMOOTHING} = {task}, but {TRAINED} begins with {first}: set only one of them");
    }
    Ok(())
}
