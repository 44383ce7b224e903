//! Which files an output may not replace.

use std::path::Path;

use anyhow::{Result, bail, ensure};

use super::checkpoints::CHECKPOINTS;
use super::folder::{DIVERGED, OURS, RunFolder};
use crate::os::{LOCK, same_file};

/// The prefixes of the names of checkpoints and of dumps.
const NUMBERED: [&str; 3] = ["iteration-", "latest.", "best."];

/// Checks that an output replaces neither one of the files that are `read` nor a file that a run keeps. New names in the folder of
/// a run are free.
///
/// # Errors
/// Fails if it would, through whatever links.
pub fn expect_output<'a>(path: &Path, read: impl IntoIterator<Item = &'a Path>) -> Result<()> {
    if let Some(read) = read.into_iter().find(|read| same_file(path, read)) {
        bail!("{}: would replace {}, which is read; choose another name", path.display(), read.display());
    }
    let Ok(whole) = path.canonicalize() else { return Ok(()) };
    let (Some(folder), Some(name)) = (whole.parent(), whole.file_name()) else { return Ok(()) };
    let inner = folder.ends_with(CHECKPOINTS) || folder.ends_with(DIVERGED);
    let (run, names) = if inner { (folder.parent(), &NUMBERED[..]) } else { (Some(folder), &OURS[..]) };
    let run = RunFolder::at(run.unwrap_or(folder).to_owned());
    let is_run = run.checkpoints().begun() || run.path().join(LOCK).exists();
    let ours = names.iter().any(|begin| name.as_encoded_bytes().starts_with(begin.as_bytes()));
    let place = run.path().display();
    ensure!(!is_run || !ours, "{}: the run {place} keeps this file; choose another name", path.display());
    Ok(())
}
