//! Stands in for `window` in a build without the feature `viewer`.

use std::sync::Arc;

use anyhow::{Result, bail};

use crate::env::Task;
use crate::evaluate::{Actor, Episodes};

/// Whether this build has windows.
pub const PRESENT: bool = false;

/// There is none.
pub enum Window {}

impl Window {
    /// Refuses.
    ///
    /// # Errors
    /// Always.
    pub fn open(_: &Task, _: Vec<&'static str>, _: usize) -> Result<Self> {
        bail!(
            "this build opens no windows: it was built without the feature `viewer`; `play --headless` scores, `play --video \
             film.mp4` films, `view --screenshot picture.png` draws"
        )
    }

    /// Cannot be called.
    ///
    /// # Errors
    /// None.
    pub fn play(self, _: &Arc<Task>, _: &[Actor], _: Episodes) -> Result<String> {
        match self {}
    }
}
