//! The settings of environments: what the user sets, and what comes with a policy.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, ensure};
use serde_json::json;
use shadow_repose::config::{Config, Override, user_file};
use shadow_repose::load;
use shadow_repose::repose::Task;

use crate::policy::Policy;

/// The most environments, as in a training.
const MOST_HANDS: usize = 65536;

/// Settings as a user gives them: dotted keys, and values in TOML.
pub(crate) type Set = Vec<(String, String)>;

/// Returns the settings in the form of the library.
///
/// # Errors
/// Fails if one is not a setting of the task or, with `training`, of a training.
pub(crate) fn overrides(set: Set, training: bool) -> Result<Vec<Override>> {
    for (key, _) in &set {
        let section = key.split('.').next().unwrap_or(key);
        ensure!(key != "env.num_envs", "env.num_envs: the number of hands is num_envs, not a setting");
        ensure!(!matches!(section, "ppo" | "run"), "{key}: it is a setting of a learner, and here is none");
        let only_training = matches!(section, "training" | "randomization");
        ensure!(training || !only_training, "{key}: it holds only for VectorEnv(training=True)");
    }
    Ok(set.into_iter().map(|(key, value)| Override { key, value }).collect())
}

/// Returns the settings and the task of `count` environments.
///
/// # Errors
/// Fails if the settings are invalid, or if the scene cannot be used.
pub(crate) fn resolve(
    count: usize,
    config: Option<&Path>,
    policy: Option<&Policy>,
    overrides: &[Override],
    training: bool,
) -> Result<(Config, Arc<Task>)> {
    ensure!((1..=MOST_HANDS).contains(&count), "num_envs = {count}: must lie in [1, {MOST_HANDS}]");
    let Some(policy) = policy else {
        let config = Config::resolve_task(user_file(config)?.as_ref(), overrides)?;
        ensure!(!config.env.mirror, "env.mirror: it mirrors for a policy, and here is none");
        let task = Task::new(&config.env, &config.hand)?;
        return Ok((Config { env: task.config().clone(), ..config }, task));
    };
    ensure!(config.is_none(), "give config or policy, not both: a policy brings the settings of its task");
    let (loaded, overrides) = (policy.loaded(), policy.with(overrides));
    let of_task: Vec<Override> = overrides.iter().filter(|set| is_of_task(set)).cloned().collect();
    let task = loaded.task(&of_task)?;
    let whole = if training {
        // Nothing assists a trained policy, unless the user sets otherwise.
        let learnt = Override { key: "training.assist".into(), value: "0".into() };
        let overrides: Vec<Override> = [learnt].into_iter().chain(overrides).collect();
        load::for_training(&loaded.checkpoint, loaded.origin.path(), &overrides)?
    } else {
        Config::resolve(None, &[])?
    };
    Ok((Config { env: task.config().clone(), ..whole }, task))
}

fn is_of_task(set: &Override) -> bool {
    matches!(set.key.split('.').next(), Some("env" | "hand"))
}

/// Returns the settings of a task as JSON: an object of sections.
pub(crate) fn text(task: &Task) -> String {
    json!({ "env": task.config().at(0), "hand": task.hand().parts }).to_string()
}
