//! Checkpoints and policies from files, which may come from anybody: such a file can do nothing but be refused.
//!
//! Its size is known before it is read, its shapes before anything is allocated by them, its checksum before anything in it is
//! used; and no path that stands in it is followed.

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, bail, ensure};

use crate::config::{Config, EnvConfig, NetConfig, Override, PolicyConfig, Source};
use crate::env::SPACES;
use crate::ppo::{Checkpoint, Damaged};
use crate::run;

/// The key of the one setting that is a path.
pub const MODEL: &str = "env.model";

/// The name of the policy that comes with the program, where a file or a run could be named.
const BUILTIN: &str = "builtin";

/// That policy.
const BUILTIN_POLICY: &[u8] = include_bytes!("../assets/policies/repose.safetensors");

/// Where a policy comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// It comes with the program.
    BuiltIn,
    /// A checkpoint, or a file with a policy alone.
    File(PathBuf),
}

impl Origin {
    /// The one that `place` means: `builtin`, a file, or a run folder's best checkpoint, or its latest where there is none yet.
    ///
    /// # Errors
    /// Nothing there.
    pub fn of(place: &Path) -> Result<Self> {
        if place == Path::new(BUILTIN) { Ok(Self::BuiltIn) } else { run::resolve_checkpoint(place).map(Self::File) }
    }

    /// Reads it, and how its policy is to be played, with `overrides` on top.
    ///
    /// # Errors
    /// Those of [`read`] and [`for_playing`].
    pub fn load(&self, overrides: &[Override]) -> Result<(Checkpoint, PolicyConfig)> {
        let (checkpoint, path) = match self {
            Self::BuiltIn => (Checkpoint::parse(BUILTIN_POLICY)?, Path::new(BUILTIN)),
            Self::File(path) => (read(path)?, path.as_path()),
        };
        let config = for_playing(&checkpoint, path, overrides);
        let config = if *self == Self::BuiltIn { config } else { config.with_context(|| cannot_use(path)) }?;
        Ok((checkpoint, config))
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::BuiltIn => f.write_str("built into the program"),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// Reads a checkpoint or a policy.
///
/// # Errors
/// A file that cannot be read, or is damaged or none of this program.
pub fn read(path: &Path) -> Result<Checkpoint> {
    Checkpoint::parse(&run::read_bytes(path)?).with_context(|| cannot_use(path))
}

/// The first of these files, the newest first, that is not damaged, with a warning for each one before it. One that cannot be read,
/// or used, is not passed over: it may be all right tomorrow, and what comes after the one before it would be lost.
///
/// # Errors
/// No file; one that cannot be read; of the last one, if all are damaged.
pub fn newest_sound(places: &[PathBuf]) -> Result<(PathBuf, Checkpoint)> {
    let (last, others) = places.split_last().context("there is no checkpoint")?;
    for path in others {
        match read(path) {
            Err(error) if is_damage(&error) => run::say(&format!("warning: {error:#}\n  The one before is tried.")),
            result => return Ok((path.clone(), result?)),
        }
    }
    Ok((last.clone(), read(last)?))
}

/// Whether it is the bytes of a file that are wrong, and not whether or how they can be used.
pub fn is_damage(error: &Error) -> bool {
    error.is::<Damaged>()
}

/// The configuration to go on training with, from a checkpoint in the file `path`, with `overrides` on top.
///
/// # Errors
/// A checkpoint of another version, or whose configuration is invalid, belongs to another policy, or names a scene that no override
/// names.
pub fn for_training(checkpoint: &Checkpoint, path: &Path, overrides: &[Override]) -> Result<Config> {
    expect_trainable(checkpoint)?;
    let config = Config::from_text(path, &checkpoint.config, overrides)?;
    expect_usable(checkpoint, &config.ppo.net(), &config.env, overrides)?;
    Ok(config)
}

/// The configuration of the training that has left a checkpoint in the file `path`, and that of a fork of it, with the `user`'s
/// file and `overrides` on top.
///
/// # Errors
/// As [`for_training`].
pub fn for_fork(
    checkpoint: &Checkpoint,
    path: &Path,
    user: Option<&Source>,
    overrides: &[Override],
) -> Result<(Config, Config)> {
    expect_trainable(checkpoint)?;
    let parent = Config::from_text(path, &checkpoint.config, &[])?;
    checkpoint.expect_policy(&parent.ppo.net(), &SPACES)?;
    let config = parent.changed(user, overrides)?;
    expect_named_scene(&parent.env, config.env.model_file().is_some())?;
    Ok((parent, config))
}

/// How the policy of a checkpoint in the file `path` is to be played, with `overrides` on top.
///
/// # Errors
/// Settings of task or net that are invalid, belong to another policy, or name a scene that no override names.
pub fn for_playing(checkpoint: &Checkpoint, path: &Path, overrides: &[Override]) -> Result<PolicyConfig> {
    let config = PolicyConfig::from_text(path, &checkpoint.config, overrides)?;
    expect_usable(checkpoint, &config.net, &config.env, overrides)?;
    Ok(config)
}

fn cannot_use(path: &Path) -> String {
    format!("cannot use {}", path.display())
}

/// Makes sure that a checkpoint holds this policy, and that a scene comes from who runs the program, not from the file.
fn expect_usable(checkpoint: &Checkpoint, net: &NetConfig, env: &EnvConfig, overrides: &[Override]) -> Result<()> {
    checkpoint.expect_policy(net, &SPACES)?;
    expect_named_scene(env, overrides.iter().any(|set| set.key == MODEL))
}

/// Makes sure that it holds more than a policy, in a form that this version goes on from.
fn expect_trainable(checkpoint: &Checkpoint) -> Result<()> {
    let advice = "go on with that version, or begin a new run with its policy (--init)";
    ensure!(!checkpoint.is_of_0_1, "made by 0.1.0: {advice}");
    Ok(())
}

/// Makes sure that a scene is named by who runs the program, if it is not the built-in one.
fn expect_named_scene(env: &EnvConfig, named: bool) -> Result<()> {
    if let Some(model) = env.model_file().filter(|_| !named) {
        let set = run::quoted(&format!("{MODEL}={}", model.display()));
        bail!(
            "it was made in a scene of its own, and no path in a file is followed: say --set {set} if you want that one"
        );
    }
    Ok(())
}
