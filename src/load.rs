//! Reads checkpoints and policies from untrusted files. A bad file can do no harm: it is refused.
//!
//! Its size is checked before it is read, its shapes before anything is allocated for them, and its checksum before its content
//! is used. No path in it is followed.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Error, Result, bail};

use crate::config::{BUILTIN_MODEL, Config, EnvConfig, NetConfig, Override, PolicyConfig, Source};
use crate::os;
use crate::ppo::{Checkpoint, Damaged, Policy, Progress, expect_safetensors};
use crate::repose::{Record, Task};
use crate::run;

/// The key of the only setting that is a path.
pub const MODEL: &str = "env.model";

/// A policy that is built into the program.
#[derive(Debug, PartialEq, Eq)]
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
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PolicySource {
    /// A policy that is built into the program.
    BuiltIn(&'static BuiltIn),
    /// A checkpoint, or a file with only a policy.
    File(PathBuf),
}

impl PolicySource {
    /// Returns the origin that `place` names: `builtin`, `robust` (unless there is such a file or folder), a file, or a run
    /// folder. A run folder stands for its best checkpoint or, if there is none yet, its latest.
    ///
    /// # Errors
    /// Fails if there is no such file, run folder or checkpoint.
    pub fn find(place: &Path) -> Result<Self> {
        match BUILTIN.iter().position(|policy| place == Path::new(policy.name)) {
            // A run may have the same name as a later built-in policy.
            Some(i) if i == 0 || !place.exists() => Ok(Self::BuiltIn(&BUILTIN[i])),
            _ => run::resolve_checkpoint(place).map(Self::File),
        }
    }

    /// Returns the file, or the name of what is built in.
    pub fn path(&self) -> &Path {
        match self {
            Self::BuiltIn(policy) => Path::new(policy.name),
            Self::File(path) => path,
        }
    }

    /// Returns the file, unless it is built in.
    pub fn file(&self) -> Option<&Path> {
        match self {
            Self::BuiltIn(_) => None,
            Self::File(path) => Some(path),
        }
    }

    /// Reads the policy for use in any scene, regardless of its training scene.
    ///
    /// # Errors
    /// Fails as [`PolicySource::load`] does.
    pub fn load_for_any_scene(&self) -> Result<(Checkpoint, PolicyConfig)> {
        self.load(&[Override { key: MODEL.into(), value: BUILTIN_MODEL.into() }])
    }

    /// Reads the checkpoint or policy and the settings for playing it, overlaid with `overrides`.
    ///
    /// # Errors
    /// Fails as [`read`] and [`for_playing`] do.
    pub fn load(&self, overrides: &[Override]) -> Result<(Checkpoint, PolicyConfig)> {
        let path = self.path();
        let checkpoint = match self {
            Self::BuiltIn(policy) => Checkpoint::parse(policy.bytes)?,
            Self::File(path) => read(path)?,
        };
        let config = for_playing(&checkpoint, path, overrides);
        let config = match self {
            Self::BuiltIn(_) => config?,
            Self::File(_) => config.with_context(|| cannot_use(path))?,
        };
        Ok((checkpoint, config))
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
    pub policy: Arc<Policy>,
    /// The checkpoint that holds it.
    pub checkpoint: Checkpoint,
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
                os::say("there is no run here: using the built-in policy");
                PolicySource::BuiltIn(&BUILTIN[0])
            }
        };
        let (checkpoint, PolicyConfig { net, .. }) = origin.load(overrides)?;
        let record = record(&checkpoint, &net)?;
        let policy = Policy::load(&net, record.spaces(), &checkpoint)
            .with_context(|| format!("cannot use the policy {origin}"))?;
        let policy = Arc::new(policy);
        let name = match &origin {
            PolicySource::BuiltIn(policy) => policy.title.to_owned(),
            PolicySource::File(path) => format!("{}, {} control steps", path.display(), checkpoint.progress.env_steps),
        };
        Ok(Self { origin, name, record, policy, checkpoint })
    }

    /// Loads its task, with settings overlaid with `overrides`.
    ///
    /// # Errors
    /// Fails as [`for_playing`] does, or if the scene cannot be used, or has another hand.
    pub fn task(&self, overrides: &[Override]) -> Result<Arc<Task>> {
        let config = for_playing(&self.checkpoint, self.origin.path(), overrides)?;
        Task::new(&config.env, &config.hand)?.for_policy(&self.record)
    }
}

/// Returns the hand and the object that a policy with this net was trained with.
///
/// # Errors
/// Fails if the record in its file is damaged.
pub fn record(checkpoint: &Checkpoint, net: &NetConfig) -> Result<Record> {
    Ok(Record::parse(&checkpoint.hand)?.with(net.symmetry))
}

/// Reads a checkpoint or a policy.
///
/// # Errors
/// Fails if the file cannot be read, is damaged, or is not one of this program.
pub fn read(path: &Path) -> Result<Checkpoint> {
    let bytes = os::read_bytes_if(path, |start| expect_safetensors(start).with_context(|| cannot_use(path)))?;
    Checkpoint::parse(&bytes).with_context(|| cannot_use(path))
}

/// Returns the first of the listed files (newest first) that is not damaged, and prints a warning for each one before it. A file
/// that cannot be read or used is not skipped, because it may be usable later. Continuing from an older one would discard its
/// progress. If a file has vanished since it was listed, e.g. because a training goes on, the list is made once more.
///
/// # Errors
/// Fails if there is no file, if one cannot be read or used, or if all are damaged (with the error of the last one).
pub fn newest_sound(list: impl Fn() -> Result<Vec<PathBuf>>) -> Result<(PathBuf, Checkpoint)> {
    let found = || first_sound(&list()?);
    found().or_else(|error| if is_absence(&error) { found() } else { Err(error) })
}

fn first_sound(places: &[PathBuf]) -> Result<(PathBuf, Checkpoint)> {
    let (last, others) = places.split_last().context("there is no checkpoint")?;
    for path in others {
        match read(path) {
            Err(error) if is_damage(&error) => os::say(&format!("warning: {error:#}\n  Trying the previous one.")),
            result => return Ok((path.clone(), result?)),
        }
    }
    Ok((last.clone(), read(last)?))
}

/// Returns whether the file is not there.
fn is_absence(error: &Error) -> bool {
    let kinds = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    kinds.map(std::io::Error::kind).any(|kind| kind == std::io::ErrorKind::NotFound)
}

/// Returns whether the bytes of the file are damaged, as opposed to intact but unusable.
pub fn is_damage(error: &Error) -> bool {
    error.is::<Damaged>()
}

/// Returns the configuration for resuming the training from a checkpoint in the file `path`, overlaid with `overrides`.
///
/// # Errors
/// Fails if its configuration is invalid, belongs to another policy, or names a scene
/// that no override names.
pub fn for_training(checkpoint: &Checkpoint, path: &Path, overrides: &[Override]) -> Result<Config> {
    let config = Config::from_text(path, &checkpoint.config, overrides)?;
    expect_usable(checkpoint, &config.ppo.net(), &config.env, overrides)?;
    Ok(config)
}

/// Returns two configurations: of the training that wrote a checkpoint in the file `path`, and of a fork of it. The latter is
/// overlaid with the `user`'s file and `overrides`. If the critic has learnt alone, this is not repeated.
///
/// # Errors
/// Fails as [`for_training`] does.
pub fn for_fork(
    checkpoint: &Checkpoint,
    path: &Path,
    user: Option<&Source>,
    overrides: &[Override],
) -> Result<(Config, Config)> {
    let parent = Config::from_text(path, &checkpoint.config, &[])?;
    expect_policy(checkpoint, &parent.ppo.net())?;
    let Progress { iteration, ref fork, .. } = checkpoint.progress;
    let made = iteration - fork.as_ref().map_or(0, |fork| fork.iteration).min(iteration);
    let mut own = parent.clone();
    if made > own.ppo.critic_first {
        own.ppo.critic_first = 0;
    }
    let config = own.changed(user, overrides)?;
    expect_named_scene(&parent.env, config.env.model_file().is_some())?;
    Ok((parent, config))
}

/// Returns the settings for playing the policy of a checkpoint in the file `path`, overlaid with `overrides`.
///
/// # Errors
/// Fails if the settings of the task or the net are invalid, belong to another policy, or name a scene that no override names.
pub fn for_playing(checkpoint: &Checkpoint, path: &Path, overrides: &[Override]) -> Result<PolicyConfig> {
    let config = PolicyConfig::from_text(path, &checkpoint.config, checkpoint.progress.env_steps, overrides)?;
    expect_usable(checkpoint, &config.net, &config.env, overrides)?;
    Ok(config)
}

fn cannot_use(path: &Path) -> String {
    format!("cannot use {}", path.display())
}

/// Checks that a checkpoint holds this policy, and that a custom scene was named by the user and not only by the file.
fn expect_usable(checkpoint: &Checkpoint, net: &NetConfig, env: &EnvConfig, overrides: &[Override]) -> Result<()> {
    expect_policy(checkpoint, net)?;
    expect_named_scene(env, overrides.iter().any(|set| set.key == MODEL))
}

fn expect_policy(checkpoint: &Checkpoint, net: &NetConfig) -> Result<()> {
    checkpoint.expect_policy(net, &record(checkpoint, net)?.spaces())
}

/// Checks that a scene other than the built-in one was named by the user.
///
/// # Errors
/// Fails if it was not. The message says how to name it.
pub fn expect_named_scene(env: &EnvConfig, named: bool) -> Result<()> {
    if env.model_file().is_some() && !named {
        bail!("it uses a custom scene, and no path in a file is followed: add{} to use that scene", scene_option(env));
    }
    Ok(())
}

/// Returns the option that names the scene, with a space before it, or nothing for the built-in scene.
pub fn scene_option(env: &EnvConfig) -> String {
    let set = env.model_file().map(|model| os::quoted(&format!("{MODEL}={}", model.display())));
    set.map_or(String::new(), |set| format!(" --set {set}"))
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
            Ok(vec![if lists.get() == 1 { gone.clone() } else { there.clone() }])
        };
        assert_eq!(newest_sound(list).unwrap().0, there);
        assert!(is_absence(&newest_sound(|| Ok(vec![gone.clone()])).err().unwrap()));
    }
}
