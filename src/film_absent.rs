//! Stands in for `film` in a build without the feature `video`.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};

use crate::env::Task;
use crate::evaluate::{Actor, Episodes, Moment};

const ABSENT: &str = "this build makes no films and pictures: it was built without the feature `video`";

/// There is none.
pub enum Film {}

impl Film {
    /// Refuses.
    ///
    /// # Errors
    /// Always.
    pub fn create(_: &Path, _: &Task, _: u32, _: u64) -> Result<Self> {
        bail!(ABSENT)
    }

    /// Cannot be called.
    ///
    /// # Errors
    /// None.
    pub fn observe(&mut self, _: &Moment) -> Result<()> {
        match *self {}
    }

    /// Cannot be called.
    pub fn abandon(self) -> Option<anyhow::Error> {
        match self {}
    }

    /// Cannot be called.
    ///
    /// # Errors
    /// None.
    pub fn finish(self) -> Result<String> {
        match self {}
    }
}

/// Refuses.
///
/// # Errors
/// Always.
pub fn screenshot(_: &Path, _: &Arc<Task>, _: &Actor, _: Episodes, _: f64) -> Result<()> {
    bail!(ABSENT)
}
