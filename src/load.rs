//! Checkpoints and policies from files, which may come from anybody: such a file can do nothing but be refused.
//!
//! Its size is known before it is read, its shapes before anything is allocated by them, its checksum before anything in it is
//! used; and no path that stands in it is followed.

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::config::{Config, Override};
use crate::env::{ACTION_SIZE, OBSERVATION_SIZE};
use crate::ppo::{Checkpoint, Policy};
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

    /// Reads it, and the configuration in it with `overrides` on top.
    ///
    /// # Errors
    /// Those of [`load`].
    pub fn load(&self, overrides: &[Override]) -> Result<(Checkpoint, Config)> {
        match self {
            Self::BuiltIn => parse(Path::new(BUILTIN), BUILTIN_POLICY, overrides),
            Self::File(path) => load(path, overrides),
        }
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

/// Reads a checkpoint or a policy, and the configuration in it with `overrides` on top.
///
/// # Errors
/// A file that cannot be read, or that [`parse`] refuses.
pub fn load(path: &Path, overrides: &[Override]) -> Result<(Checkpoint, Config)> {
    let bytes = run::read_bytes(path)?;
    parse(path, &bytes, overrides).with_context(|| format!("cannot use {}", path.display()))
}

/// The same of the bytes of a file.
///
/// # Errors
/// Bytes that are no checkpoint or policy of this program, or whose configuration is invalid, belongs to another policy, or
/// names a scene that no override names.
pub fn parse(path: &Path, bytes: &[u8], overrides: &[Override]) -> Result<(Checkpoint, Config)> {
    let checkpoint = Checkpoint::parse(bytes)?;
    let config = Config::from_text(path, &checkpoint.config, overrides)?;
    checkpoint.expect_policy(&config.ppo, OBSERVATION_SIZE, ACTION_SIZE)?;
    let named = overrides.iter().any(|set| set.key == MODEL);
    match config.env.model_file() {
        Some(model) if !named => {
            let set = run::quoted(&format!("{MODEL}={}", model.display()));
            bail!(
                "it was made in a scene of its own, and no path in a file is followed: say --set {set} if you want that one"
            )
        }
        _ => Ok((checkpoint, config)),
    }
}

/// The policy of a checkpoint that was loaded with this configuration.
///
/// # Errors
/// A checkpoint that holds another policy.
pub fn policy(checkpoint: &Checkpoint, config: &Config) -> Result<Policy> {
    Policy::load(&config.ppo, OBSERVATION_SIZE, ACTION_SIZE, checkpoint)
}
