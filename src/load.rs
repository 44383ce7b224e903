//! Reads checkpoints and policies from untrusted files. A bad file can do no harm: it is refused.
//!
//! Its size is checked before it is read, its shapes before anything is allocated for them, and its checksum before its content
//! is used. No path in it is followed.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Error, Result, ensure};

use crate::config::{Config, MODEL, Override, PpoConfig, Reader, Settings, Source};
use crate::evaluate::Actor;
use crate::os::{self, say};
use crate::ppo::{Checkpoint, Damaged, Policy, Progress};
use crate::repose::{Record, Task, physical};
use crate::run;
use crate::sim::SceneFiles;

/// A policy that is built into the program.
pub struct BuiltIn {
    /// The name that is accepted in place of a file or a run.
    name: &'static str,
    /// Its description for the user.
    title: &'static str,
    /// The name of its checkpoint in a score.
    place: &'static str,
    bytes: &'static [u8],
}

/// The built-in policies. The first one is played where there is no run.
static BUILTIN: [BuiltIn; 2] = [
    BuiltIn {
        name: "builtin",
        title: "the built-in policy, repose.safetensors",
        place: "built into the program",
        bytes: include_bytes!("../assets/policies/repose.safetensors"),
    },
    BuiltIn {
        name: "robust",
        title: "the built-in policy for other hands, robust.safetensors",
        place: "robust, built into the program",
        bytes: include_bytes!("../assets/policies/robust.safetensors"),
    },
];

/// The source of a policy.
pub enum PolicySource {
    /// A policy that is built into the program.
    BuiltIn(&'static BuiltIn),
    /// A checkpoint, or a file with only a policy.
    File(PathBuf),
}

impl PolicySource {
    /// Finds what `place` names: `builtin`, `robust`, a file, or a run folder. A run folder stands for its best checkpoint or, if
    /// there is none yet, its latest.
    ///
    /// # Errors
    /// Fails if there is no such file, run folder or checkpoint, or if the name is of an actor without a policy.
    pub fn find(place: &Path) -> Result<Self> {
        let name = place.display();
        ensure!(
            Actor::without_policy(place).is_none(),
            "`{name}` acts without a policy; a file or folder of that name is ./{name}"
        );
        let mut built_in = BUILTIN.iter();
        if let Some(policy) = built_in.find(|policy| place == Path::new(policy.name)) {
            return Ok(Self::BuiltIn(policy));
        }
        let newest = run::newest_run()
            .map(|run| format!("; the newest run is {}", run.display()))
            .unwrap_or_default();
        ensure!(
            place.exists(),
            "{name}: no such checkpoint or run folder; built in are builtin and robust{newest}"
        );
        run::resolve_checkpoint(place).map(Self::File)
    }

    /// The file, or the name of what is built in.
    pub fn path(&self) -> &Path {
        match self {
            Self::BuiltIn(policy) => Path::new(policy.name),
            Self::File(path) => path,
        }
    }

    /// The file, unless it is built in.
    pub fn file(&self) -> Option<&Path> {
        match self {
            Self::BuiltIn(_) => None,
            Self::File(path) => Some(path),
        }
    }

    /// Reads the checkpoint or policy.
    ///
    /// # Errors
    /// Fails as [`read`] does.
    pub fn load(&self) -> Result<Checkpoint> {
        match self {
            Self::BuiltIn(policy) => Checkpoint::parse(policy.bytes),
            Self::File(path) => read(path),
        }
    }

    /// The settings for playing a checkpoint from there, overlaid with `overrides`.
    ///
    /// # Errors
    /// Fails as [`settings`] does.
    pub fn settings(&self, checkpoint: &Checkpoint, overrides: &[Override]) -> Result<Config> {
        let path = self.path();
        let player = Reader::Player {
            env_steps: checkpoint.progress.env_steps,
        };
        let config = settings(checkpoint, path, player, overrides);
        match self {
            Self::BuiltIn(_) => config,
            Self::File(_) => config.with_context(|| cannot_use(path)),
        }
    }
}

impl fmt::Display for PolicySource {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::BuiltIn(policy) => f.write_str(policy.place),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// A policy, and what its file says about the task that it was trained for.
pub struct Loaded {
    /// Where it comes from.
    pub origin: PolicySource,
    /// Its description for the user.
    pub name: String,
    /// The hand and the object that it was trained with.
    pub record: Record,
    /// The policy.
    pub policy: Policy,
    /// The checkpoint that holds it.
    pub checkpoint: Checkpoint,
    /// A scene in memory, which need not be read if its task is in that scene.
    pub files: Arc<SceneFiles>,
}

impl Loaded {
    /// Loads the policy from `place`, by default from the newest run, or the built-in one if there is no run.
    ///
    /// # Errors
    /// Fails as [`PolicySource::find`] and [`PolicySource::load`] do, or if the policy's numbers cannot be used.
    pub fn find(place: Option<&Path>, overrides: &[Override]) -> Result<Self> {
        let origin = match (place, run::newest_run()) {
            (Some(place), _) => PolicySource::find(place)?,
            (None, Some(newest)) => PolicySource::find(&newest)?,
            (None, None) => {
                say!("there is no run here: using the built-in policy");
                PolicySource::BuiltIn(&BUILTIN[0])
            }
        };
        let checkpoint = origin.load()?;
        Self::new(origin, checkpoint, overrides)
    }

    /// Takes the policy from a checkpoint that was read from `origin`.
    ///
    /// # Errors
    /// Fails as [`Loaded::find`] does.
    pub fn new(
        origin: PolicySource,
        checkpoint: Checkpoint,
        overrides: &[Override],
    ) -> Result<Self> {
        let config = origin.settings(&checkpoint, overrides)?;
        let record = Record::parse(&checkpoint.hand)?;
        let policy = Policy::load(&config.ppo, record.spaces(), &checkpoint)
            .with_context(|| format!("cannot use the policy {origin}"))?;
        Ok(Self {
            name: match &origin {
                PolicySource::BuiltIn(policy) => policy.title.to_owned(),
                PolicySource::File(path) if !policy.has_critic => {
                    format!("{}, learnt elsewhere", path.display())
                }
                PolicySource::File(path) => format!(
                    "{}, {} control steps",
                    path.display(),
                    checkpoint.progress.env_steps
                ),
            },
            origin,
            record,
            policy,
            checkpoint,
            files: Arc::default(),
        })
    }

    /// The settings for playing it, overlaid with `overrides`.
    ///
    /// # Errors
    /// Fails as [`settings`] does.
    pub fn settings(&self, overrides: &[Override]) -> Result<Config> {
        self.origin.settings(&self.checkpoint, overrides)
    }

    /// Loads its task, with settings overlaid with `overrides`.
    ///
    /// # Errors
    /// Fails as [`settings`] does, or if the scene cannot be used, or has another hand.
    pub fn task(&self, overrides: &[Override]) -> Result<Arc<Task>> {
        let config = self.settings(overrides)?;
        let task = Task::with_files(&config, &self.files)?.for_policy(&self.record)?;
        if config.env.prediction == 0 {
            return Ok(task);
        }
        // Who predicts knows the physics that the policy was trained with, and what is known of the world, whatever the world is.
        let scene = Override::new(MODEL, &config.env.model);
        let own = self.settings(&[scene])?.env;
        let mut world = physical(&own);
        if !config.env.is_multiple_of(own.sim_dt) {
            // With the policy's step, the model would end between two control steps.
            world.remove("sim_dt");
        }
        for (name, known) in &config.env.known {
            let scale = &mut world[&format!("{name}_scale")];
            let factor = known / own.known.get(name).unwrap_or(&1.0);
            *scale = (scale.as_float().expect("a factor") * factor).into();
        }
        let sets = world
            .into_iter()
            .map(|(name, value)| Override::new(format!("env.{name}"), value));
        let sets = [overrides, &Vec::from_iter(sets)].concat();
        let model = Task::with_files(&self.settings(&sets)?, task.files())?;
        Ok(task.predicted_by(&model))
    }
}

/// Reads a checkpoint or a policy.
///
/// # Errors
/// Fails if the file cannot be read, is damaged, or is not one of this program.
pub fn read(path: &Path) -> Result<Checkpoint> {
    Checkpoint::parse(&os::read_bytes(path)?).with_context(|| cannot_use(path))
}

/// The first of the listed files (newest first) that is not damaged. A warning names each one before it. A file
/// that cannot be read or used is not skipped, because it may be usable later. Continuing from an older one would discard its
/// progress. If a file has vanished since it was listed, e.g. because training goes on, the list is made once more.
///
/// # Errors
/// Fails if there is no file, if one cannot be read or used, or if all are damaged (with the error of the last one).
pub fn newest_sound(list: impl Fn() -> Result<Vec<PathBuf>>) -> Result<(PathBuf, Checkpoint)> {
    let found = || first_sound(&list()?);
    found().or_else(|error| {
        if is_absence(&error) {
            found()
        } else {
            Err(error)
        }
    })
}

fn first_sound(places: &[PathBuf]) -> Result<(PathBuf, Checkpoint)> {
    let (last, others) = places.split_last().context("there is no checkpoint")?;
    for path in others {
        match read(path) {
            Err(error) if is_damage(&error) => {
                say!("warning: {error:#}\n  Trying the previous one.")
            }
            result => return Ok((path.clone(), result?)),
        }
    }
    Ok((last.clone(), read(last)?))
}

/// Whether the file is not there.
fn is_absence(error: &Error) -> bool {
    let mut causes = error
        .chain()
        .filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    causes.any(|cause| cause.kind() == std::io::ErrorKind::NotFound)
}

/// Whether the bytes of the file are damaged, as opposed to intact but unusable.
pub fn is_damage(error: &Error) -> bool {
    error.is::<Damaged>()
}

/// The settings in a checkpoint in the file `path`, as the `reader` takes them, overlaid with `sets`.
///
/// # Errors
/// Fails if they are invalid, belong to another policy, or name a scene that no setting in `sets` names.
pub fn settings(
    checkpoint: &Checkpoint,
    path: &Path,
    reader: Reader,
    sets: &[Override],
) -> Result<Config> {
    let config = Settings::new()
        .stored(source(checkpoint, path), reader)
        .sets(sets)
        .resolve()?;
    expect_policy(checkpoint, &config.ppo)?;
    Ok(config)
}

/// The settings in a checkpoint in the file `path`, as text.
pub fn source(checkpoint: &Checkpoint, path: &Path) -> Source {
    Source::new(path, &*checkpoint.config)
}

/// The configurations of the training run that wrote a checkpoint in the file `path`, and of a fork of it, which is overlaid with
/// the user's `settings`. If the critic has learnt alone, this is not repeated.
///
/// # Errors
/// Fails as [`settings`] does.
pub fn for_fork(
    checkpoint: &Checkpoint,
    path: &Path,
    settings: Settings,
) -> Result<(Config, Config)> {
    let parent = Settings::new().file(source(checkpoint, path)).resolve()?;
    expect_policy(checkpoint, &parent.ppo)?;
    let Progress {
        iteration,
        ref fork,
        ..
    } = checkpoint.progress;
    let made = iteration.saturating_sub(fork.as_ref().map_or(0, |fork| fork.iteration));
    let mut after = parent.clone();
    if made > parent.ppo.critic_first {
        after.ppo.critic_first = 0;
    }
    let config = settings
        .stored(Source::new(path, after.to_text()), Reader::Run)
        .resolve()?;
    Ok((parent, config))
}

fn cannot_use(path: &Path) -> String {
    format!("cannot use {}", path.display())
}

/// Checks that a checkpoint has a policy with these settings of the learner.
///
/// # Errors
/// Fails if the hand in it cannot be read, or if a tensor is missing or of another shape.
pub fn expect_policy(checkpoint: &Checkpoint, config: &PpoConfig) -> Result<()> {
    checkpoint.expect_policy(config, &Record::parse(&checkpoint.hand)?.spaces())
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn a_checkpoint_that_vanishes_between_listing_and_reading_is_looked_for_once_more() {
        let place = tempfile::tempdir().unwrap();
        let [gone, there] = ["gone", "there"].map(|name| place.path().join(name));
        os::write_whole(&there, BUILTIN[0].bytes).unwrap();
        let lists = Cell::new(0);
        let list = || {
            lists.set(lists.get() + 1);
            Ok(vec![if lists.get() == 1 {
                gone.clone()
            } else {
                there.clone()
            }])
        };
        assert_eq!(newest_sound(list).unwrap().0, there);
        assert!(is_absence(
            &newest_sound(|| Ok(vec![gone.clone()])).err().unwrap()
        ));
    }
}
