//! The settings of environments as the user sets them.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, ensure};
use serde_json::json;
use shadow_repose::config::{Config, Override, Settings};
use shadow_repose::repose::{Task, is_physical};

/// Settings as a user gives them: dotted keys, and values in TOML.
pub(crate) type Set = Vec<(String, String)>;

/// The settings in the form of the library.
///
/// # Errors
/// Fails if one is not a setting of the task or, with `training`, of a training.
pub(crate) fn overrides(set: Set, training: bool) -> Result<Vec<Override>> {
    for (key, _) in &set {
        let section = key.split('.').next().unwrap_or(key);
        ensure!(
            key != "env.num_envs",
            "env.num_envs: the number of hands is num_envs, not a setting"
        );
        ensure!(
            !matches!(section, "ppo" | "run"),
            "{key}: it is a setting of a learner, and here is none"
        );
        let only_training = matches!(section, "training" | "randomization");
        ensure!(
            training || !only_training,
            "{key}: it holds only for VectorEnv(training=True)"
        );
    }
    Ok(set
        .into_iter()
        .map(|(key, value)| Override { key, value })
        .collect())
}

/// The settings in the form of the library, if they say how the world moves.
///
/// # Errors
/// Fails if one of them says something else.
pub(crate) fn of_world(world: Set) -> Result<Vec<Override>> {
    for (key, _) in &world {
        let is_of_world = key.strip_prefix("env.").is_some_and(is_physical);
        ensure!(
            is_of_world,
            "{key}: `world` holds only settings that say how the hand and the object move"
        );
    }
    Ok(world
        .into_iter()
        .map(|(key, value)| Override { key, value })
        .collect())
}

/// The settings and the task of environments without a policy. What `world` changes, no prediction knows.
///
/// # Errors
/// Fails if the settings are invalid, or if the scene cannot be used.
pub(crate) fn resolve(
    config: Option<&Path>,
    overrides: &[Override],
    world: &[Override],
) -> Result<(Config, Arc<Task>)> {
    let resolve = |sets: &[Override]| Settings::new().user_file(config)?.sets(sets).resolve();
    let config = resolve(&[overrides, world].concat())?;
    let mut task = Task::new(&config)?;
    if !world.is_empty() {
        task = task.predicted_by(&*Task::new(&resolve(overrides)?)?);
    }
    Ok((
        Config {
            env: task.config.clone(),
            ..config
        },
        task,
    ))
}

/// The settings of a task as JSON: an object of sections.
pub(crate) fn text(task: &Task) -> String {
    json!({ "env": task.config.at(0), "hand": task.hand.parts }).to_string()
}
