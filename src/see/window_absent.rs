//! The replacement for `window` in a build without the feature `viewer`.

use std::sync::Arc;

use anyhow::{Result, bail};

use crate::evaluate::{Actor, Episodes};
use crate::repose::Task;

/// Whether this build has windows.
pub const HAS_WINDOWS: bool = false;

/// A type without values: this build has no windows.
pub enum Window {}

impl Window {
    /// Fails, since this build has no windows.
    ///
    /// # Errors
    /// Always fails.
    pub fn open(_: &Task, _: Vec<&'static str>, _: usize) -> Result<Self> {
        bail!(
            "this build cannot open windows: it was built without the feature `viewer`; use `play --headless` to score, `play \
             --video film.mp4` to film, `view --screenshot picture.png` to draw"
        )
    }

    /// Never called, since the type has no value.
    ///
    /// # Errors
    /// Never fails.
    pub fn play(self, _: &Arc<Task>, _: &[Actor], _: Episodes) -> Result<String> {
        match self {}
    }
}
