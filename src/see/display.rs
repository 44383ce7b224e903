//! The task in a scene for display: the real hand's meshes, a camera, a quality.

use std::sync::Arc;

use anyhow::{Error, Result};

use super::dress::{dress, mesh_files};
use crate::os;
use crate::repose::Task;
use crate::sim::{Camera, Look, Quality};

/// How a scene is shown.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// A camera that replaces the scene's own.
    pub camera: Option<Camera>,
    /// The quality of rendering.
    pub quality: Quality,
    /// Whether the hand's primitives are shown in place of its meshes.
    pub plain: bool,
}

/// Loads the task for display. If the meshes are not available, prints a note and shows the primitives.
///
/// # Errors
/// Fails like [`Task::for_display`].
pub fn task_for_display(task: &Task, shot: &Shot) -> Result<Arc<Task>> {
    let note = |error: &Error| os::say!("note: {error:#}; primitives are shown instead");
    // Only the built-in hand has meshes.
    let prefix = task.hand.side().filter(|_| !shot.plain && task.config.model_file().is_none());
    let meshes =
        |prefix: &str| os::hand_meshes(&mesh_files()).inspect_err(note).ok().map(|meshes| dress(prefix, meshes));
    let Shot { size, camera, quality, .. } = *shot;
    let mut look = Look { dress: prefix.and_then(meshes), size, camera, quality };
    let shown = task.for_display(&look);
    match &shown {
        Err(error) if look.dress.is_some() => note(error),
        _ => return shown,
    }
    look.dress = None;
    task.for_display(&look)
}
