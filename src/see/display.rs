//! The task in a scene for display: the real hand's meshes, how it is seen.

use std::sync::Arc;

use anyhow::{Error, Result};

use super::dress::{dress, mesh_files};
use crate::os;
use crate::repose::Task;
use crate::sim::Look;

/// Loads the task for display with this look, which gets the hand's meshes unless it is plain. If the meshes are not available,
/// prints a note and shows the primitives.
///
/// # Errors
/// Fails like [`Task::for_display`].
pub fn task_for_display(task: &Task, look: &Look) -> Result<Arc<Task>> {
    let note = |error: &Error| {
        os::say!(
            "note: {error:#}; primitives are shown instead, as with --plain\n  `shadow-repose view --fetch` fetches the meshes, even beforehand"
        )
    };
    // Only the built-in hand has meshes.
    let prefix = task
        .hand
        .side()
        .filter(|_| !look.plain && task.config.model_file().is_none());
    let meshes = |prefix: &str| {
        os::hand_meshes(&mesh_files(), false)
            .inspect_err(note)
            .ok()
            .map(|meshes| dress(prefix, meshes))
    };
    let dressed = Look {
        dress: prefix.and_then(meshes),
        ..look.clone()
    };
    match task.for_display(&dressed) {
        Err(error) if dressed.dress.is_some() => {
            note(&error);
            task.for_display(look)
        }
        shown => shown,
    }
}
