//! The task in a scene for display: the real hand's meshes, how it is seen.

use std::collections::BTreeSet;
use std::sync::Arc;

use anyhow::{Error, Result};

use crate::os;
use crate::repose::Task;
use crate::sim::{Dress, Look, Piece};

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

/// A part of the hand: the end of its body's name, mesh file, material in the built-in scene, height above the body's origin in m.
type MeshPart = (&'static str, &'static str, &'static str, f64);

/// The parts, by what the bodies' names begin with after the hand's prefix. The values come from MuJoCo Menagerie's Shadow Hand.
const PARTS: [(&str, &[MeshPart]); 5] = [
    ("", &HAND),
    ("ff", &FINGER),
    ("mf", &FINGER),
    ("rf", &FINGER),
    ("lf", &FINGER),
];

const HAND: [MeshPart; 8] = [
    ("forearm", "forearm_0.obj", "metal", 0.0),
    ("forearm", "forearm_1.obj", "shell", 0.0),
    ("wrist", "wrist.obj", "metal", 0.0),
    ("palm", "palm.obj", "shell", 0.0),
    ("lfmetacarpal", "lf_metacarpal.obj", "shell", 0.0),
    ("thproximal", "th_proximal.obj", "shell", 0.0),
    ("thmiddle", "th_middle.obj", "shell", 0.0),
    ("thdistal", "th_distal_pst.obj", "rubber", 0.0),
];

const FINGER: [MeshPart; 4] = [
    ("knuckle", "f_knuckle.obj", "metal", 0.0005),
    ("proximal", "f_proximal.obj", "shell", 0.0),
    ("middle", "f_middle.obj", "shell", 0.0),
    ("distal", "f_distal_pst.obj", "rubber", 0.0),
];

/// The mesh files of the hand, sorted and without duplicates.
pub fn mesh_files() -> Vec<&'static str> {
    let files = PARTS
        .iter()
        .flat_map(|(_, parts)| parts.iter().map(|part| part.1));
    Vec::from_iter(BTreeSet::from_iter(files))
}

/// The meshes on a hand whose names have this prefix, given the contents of [`mesh_files`] in that order.
pub fn dress(prefix: &str, contents: Vec<Vec<u8>>) -> Dress {
    let pieces = PARTS.iter().flat_map(|(finger, parts)| {
        parts.iter().map(move |&(part, file, material, height)| {
            let body = format!("{prefix}{finger}{part}");
            Piece {
                body,
                file,
                material,
                height,
            }
        })
    });
    Dress {
        bodies: prefix.to_owned(),
        files: mesh_files().into_iter().zip(contents).collect(),
        pieces: pieces.collect(),
    }
}
