//! The replacement for `film` in a build without the feature `video`.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};

use crate::env::Task;
use crate::evaluate::{Actor, Episodes, Moment};

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

/// Fails, since this build has no pictures.
///
/// # Errors
/// Always fails.
pub fn screenshot(_: &Path, _: &Arc<Task>, _: &Actor, _: Episodes, _: f64) -> Result<[u32; 2]> {
    bail!(ABSENT)
}
