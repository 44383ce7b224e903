//! What the files of a run show to a reader. Nothing is changed, no link in a folder is followed, and no pipe is opened.

use std::fs::{self, Metadata};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Result, ensure};

use super::checkpoints::modified;
use super::folder::{CONFIG, FINISHED, METRICS, RUNS};
use crate::os::{Cannot, Hold, LOCK};

/// The files of a run.
pub struct Glance {
    /// When its settings were written or, without settings, when its folder was last changed.
    pub begun: Option<SystemTime>,
    /// Who holds its lock.
    pub hold: Hold,
    /// Whether it is marked as one that is not to be continued.
    pub is_marked: bool,
    /// Its settings, if they are there.
    pub config: Option<PathBuf>,
    /// Its table, if it is there.
    pub metrics: Option<PathBuf>,
    /// When a row was last written.
    pub logged: Option<SystemTime>,
}

impl Glance {
    /// Looks at a folder. Returns `None` if it holds no run.
    pub fn of(folder: &Path) -> Option<Self> {
        // Any other kind of file, e.g. a link, is not one of a run.
        let facts = |name: &str| {
            fs::symlink_metadata(folder.join(name))
                .ok()
                .filter(Metadata::is_file)
        };
        let written = |facts: &Option<Metadata>| facts.as_ref()?.modified().ok();
        let [config, metrics, lock, mark] = [CONFIG, METRICS, LOCK, FINISHED].map(facts);
        if config.is_none() && metrics.is_none() && lock.is_none() {
            return None;
        }
        Some(Self {
            begun: written(&config).or_else(|| modified(folder)),
            hold: Hold::of(folder),
            // A file with content is the user's.
            is_marked: mark.is_some_and(|facts| facts.len() == 0),
            logged: written(&metrics),
            config: config.map(|_| folder.join(CONFIG)),
            metrics: metrics.map(|_| folder.join(METRICS)),
        })
    }
}

/// The folders in `folder`, or in the default folder of runs, which may be runs. Links to folders are left out. Someone who
/// `waits` for the first run finds no folders where the folder does not exist yet.
///
/// # Errors
/// Fails if the folder cannot be read.
pub fn folders_of_runs(folder: Option<&Path>, waits: bool) -> Result<Vec<PathBuf>> {
    let path = folder.unwrap_or(Path::new(RUNS));
    if !path.exists() {
        if waits {
            return Ok(Vec::new());
        }
        ensure!(
            folder.is_some(),
            "there are no runs in {RUNS}; begin one with `shadow-repose train`, or name another folder"
        );
    }
    let entries = fs::read_dir(path).cannot("read the folder", path)?;
    Ok(entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path())
        .collect())
}
