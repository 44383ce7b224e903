//! The settings of environments as the user sets them.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, ensure};
use serde_json::json;
use shadow_repose::config::{BUILTIN_MODEL, Config, EnvConfig, Override, Settings, Source};
use shadow_repose::repose::{Record, Task, physical};
use shadow_repose::sim::SceneFiles;

/// Settings as a user gives them: dotted keys, and values in TOML.
pub(crate) type Set = Vec<(String, String)>;

/// The files of a scene: their names and contents.
pub(crate) type Files = Vec<(String, Vec<u8>)>;

/// All that a task is made of, so that a copy needs no file: its settings without the scene, the path of the scene, the record of its
/// policy, the settings of the model that predicts, and the files of the scene.
pub(crate) type Parts = (String, String, Option<String>, Option<String>, Files);

/// A task, all settings with which it was made, and the record of its policy, if it is the task of one.
pub(crate) struct Made {
    pub(crate) config: Config,
    pub(crate) task: Arc<Task>,
    pub(crate) record: Option<Record>,
}

impl Made {
    /// All that it is made of, with these settings.
    pub(crate) fn parts(&self, config: &Config) -> Parts {
        let text = |env: &EnvConfig| {
            let env = EnvConfig {
                model: BUILTIN_MODEL.into(),
                num_envs: config.env.num_envs,
                ..env.clone()
            };
            let config = config.clone();
            Config { env, ..config }.to_text()
        };
        (
            text(&config.env),
            config.env.model.clone(),
            self.record.as_ref().map(Record::to_text),
            self.task.predicted_with().map(text),
            self.task.files().0.clone(),
        )
    }

    /// The task that is made of these parts.
    ///
    /// # Errors
    /// Fails if they are not what [`Made::parts`] returns.
    pub(crate) fn of((settings, model, record, predicted, files): Parts) -> Result<Self> {
        let files = Arc::new(SceneFiles(files));
        let config = |text: String| -> Result<Config> {
            let source = Source::new("the copy", text);
            let mut config = Settings::new().file(source).resolve()?;
            config.env.model.clone_from(&model);
            Ok(config)
        };
        let whole = config(settings)?;
        let mut task = Task::with_files(&whole, &files)?;
        let record = record.as_deref().map(Record::parse).transpose()?;
        if let Some(record) = &record {
            task = task.for_policy(record)?;
        }
        if let Some(text) = predicted {
            task = task.predicted_by(&*Task::with_files(&config(text)?, &files)?);
        }
        Ok(Self::new(whole, task, record))
    }

    /// Its task for another policy.
    ///
    /// # Errors
    /// Fails if the policy is for another hand.
    pub(crate) fn task_for(&self, policy: &Record) -> Result<Arc<Task>> {
        if self.record.is_none() {
            return self.task.clone().for_policy(policy);
        }
        // The task of a policy has taken over what that policy observes.
        let (settings, model, _, predicted, files) = self.parts(&self.config);
        let plain = Self::of((settings, model, None, predicted, files))?;
        plain.task.for_policy(policy)
    }

    /// A task and all settings, with those of the task as the scene has settled them.
    pub(crate) fn new(whole: Config, task: Arc<Task>, record: Option<Record>) -> Self {
        let env = task.config.clone();
        Self {
            config: Config { env, ..whole },
            task,
            record,
        }
    }
}

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
    let physical = physical(&Config::default().env);
    for (key, _) in &world {
        let name = key.strip_prefix("env.");
        let is_of_world = name.is_some_and(|name| physical.contains_key(name));
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

/// The task of environments without a policy. What `world` changes, no prediction knows.
///
/// # Errors
/// Fails if the settings are invalid, or if the scene cannot be used.
pub(crate) fn resolve(
    config: Option<&Path>,
    overrides: &[Override],
    world: &[Override],
) -> Result<Made> {
    let resolve = |sets: &[Override]| Settings::new().user_file(config)?.sets(sets).resolve();
    let config = resolve(&[overrides, world].concat())?;
    let mut task = Task::new(&config)?;
    if !world.is_empty() {
        let model = Task::with_files(&resolve(overrides)?, task.files())?;
        task = task.predicted_by(&model);
    }
    Ok(Made::new(config, task, None))
}

/// The settings of a task as JSON: an object of sections.
pub(crate) fn text(task: &Task) -> String {
    json!({ "env": task.config.at(0), "hand": task.hand.parts }).to_string()
}
