//! Which files an output may not replace.

use std::path::Path;

use anyhow::{Result, bail, ensure};

use super::checkpoints::CHECKPOINTS;
use super::folder::{DIVERGED, FINISHED, OURS, RunFolder, is_one_of};
use crate::os::{final_path, same_file};
use crate::sim::scene_files;

/// The names of the files in the folders of the checkpoints and of the dumps of a run. A star stands for anything.
const INSIDE: [&str; 7] = [
    "iteration-*.safetensors",
    "iteration-*.later",
    "iteration-*.json",
    "latest.safetensors",
    "best.safetensors",
    "best*.damaged",
    ".shadow-repose-*",
];

/// Checks that an output replaces no file that is `read`, and no file of the `scene`. It must not have a name that a run keeps
/// for its own files. Other names in the folder of a run are free.
///
/// # Errors
/// Fails if it does, even through links, or as [`scene_files`] does.
pub fn expect_output(
    path: &Path,
    read: impl IntoIterator<Item: AsRef<Path>>,
    scene: Option<&Path>,
) -> Result<()> {
    let of_scene = scene.map(scene_files).transpose()?;
    let mut read = read
        .into_iter()
        .map(|read| read.as_ref().to_owned())
        .chain(of_scene.unwrap_or_default());
    if let Some(read) = read.find(|read| same_file(path, read)) {
        bail!(
            "{}: would replace the input {}; choose another name",
            path.display(),
            read.display()
        );
    }
    let whole = final_path(path).unwrap_or_default();
    let Some((folder, name)) = whole.parent().zip(whole.file_name()) else {
        return Ok(());
    };
    let inside = folder.ends_with(CHECKPOINTS) || folder.ends_with(DIVERGED);
    let place = folder.parent().filter(|_| inside).unwrap_or(folder);
    let run = RunFolder::at(place.to_owned());
    let is_kept = if inside {
        is_one_of(name, &INSIDE)
    } else {
        name == FINISHED || is_one_of(name, &OURS)
    };
    ensure!(
        !run.holds_a_run() || !is_kept,
        "{}: the run {} reserves this file name; choose another name",
        path.display(),
        place.display()
    );
    Ok(())
}

/// Checks that a new run in `folder` does not replace the policy that it begins with.
///
/// # Errors
/// Fails if it does.
pub fn expect_other_policy(folder: &Path, init: &Path) -> Result<()> {
    let own = RunFolder::at(folder.to_owned()).policy();
    ensure!(
        !same_file(&own, init),
        "{}: would replace the policy that the run starts from; choose another folder",
        own.display()
    );
    Ok(())
}
