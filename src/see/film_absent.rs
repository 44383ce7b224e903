//! The replacement for `film` in a build without the feature `video`.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Result, bail};

use crate::config::EnvConfig;
use crate::evaluate::{Actor, Episodes, Moment};
use crate::repose::Task;
use crate::run::Animation;

const ABSENT: &str = "this build cannot make films or pictures: it was built without the feature `video`";

/// A type without values: this build has no films.
pub enum Film {}

impl Film {
    /// Fails, since this build has no films.
    ///
    /// # Errors
    /// Always fails.
    pub fn create(_: &Path, _: &Task, _: u32, _: u64) -> Result<Self> {
        bail!(ABSENT)
    }

    /// Never called, since the type has no value.
    ///
    /// # Errors
    /// Never fails.
    pub fn observe(&mut self, _: &Moment) -> Result<()> {
        match *self {}
    }

    /// Never called, since the type has no value.
    pub fn abandon(self) -> Option<anyhow::Error> {
        match self {}
    }

    /// Never called, since the type has no value.
    ///
    /// # Errors
    /// Never fails.
    pub fn finish(self) -> Result<String> {
        match self {}
    }
}

/// A type without values: this build has no films.
pub enum EpisodeFilms {}

impl EpisodeFilms {
    /// Fails, since this build has no films.
    ///
    /// # Errors
    /// Always fails.
    pub fn new(_: &EnvConfig) -> Result<Self> {
        bail!(ABSENT)
    }

    /// Never called, since the type has no value.
    ///
    /// # Errors
    /// Never fails.
    pub fn film(&mut self, _: &Actor, _: Episodes, _: &AtomicBool) -> Result<Option<Animation>> {
        match *self {}
    }
}

/// Fails, since this build has no pictures.
///
/// # Errors
/// Always fails.
pub fn screenshot(_: &Path, _: &Arc<Task>, _: &Actor, _: Episodes, _: f64) -> Result<[u32; 2]> {
    bail!(ABSENT)
}
