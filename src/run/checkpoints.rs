//! The checkpoints of a run. Each is written completely or not at all, the newest few are kept, and `latest` is a second name of
//! the newest.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Result, ensure};

use crate::os::{Cannot, Folder, name_also, nicety, put_aside, same_file, shown, write_whole};

/// The folder of the checkpoints in the folder of a run.
pub const CHECKPOINTS: &str = "checkpoints";

/// The folder `checkpoints` of a run.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    pub(super) folder: Folder,
}

impl Checkpoints {
    /// Creates the folder unless it exists, and holds it open.
    ///
    /// # Errors
    /// Fails as [`Folder::hold`] does.
    pub fn hold(&mut self) -> Result<()> {
        self.folder.hold()
    }

    /// The path of the newest checkpoint.
    pub fn latest(&self) -> PathBuf {
        self.folder.path.join("latest.safetensors")
    }

    /// The path of the checkpoint that scored best.
    pub fn best(&self) -> PathBuf {
        self.folder.path.join("best.safetensors")
    }

    fn path_of(&self, iteration: u64) -> PathBuf {
        self.folder
            .path
            .join(format!("iteration-{iteration:08}.safetensors"))
    }

    /// Writes the checkpoint of an iteration, makes it the latest, and then removes all but the newest `keep`.
    ///
    /// # Errors
    /// Fails if the checkpoint cannot be written. The earlier ones are then kept.
    pub fn write(&self, iteration: u64, bytes: &[u8], keep: usize) -> Result<()> {
        let path = self.path_of(iteration);
        write_whole(&path, bytes)?;
        name_also(&path, &self.latest())?;
        // Later checkpoints exist if the run was resumed from an earlier one. They must not be resumed from, since the logs
        // continue from here, but users who gave the wrong file can still recover them.
        let (later, earlier): (Vec<_>, Vec<_>) = self
            .numbered()
            .into_iter()
            .partition(|(of, _)| *of > iteration);
        for (_, path) in earlier.iter().skip(keep) {
            nicety(fs::remove_file(path));
        }
        for (_, path) in later {
            put_aside(&path, "later").cannot("rename", &path)?;
        }
        Ok(())
    }

    /// All checkpoints that can be resumed from, the newest first. `latest` is a second name of one of the others, or a
    /// copy if the file system does not support hard links. It is older than the newest if the program ended just before updating
    /// it.
    pub fn newest_first(&self) -> Vec<PathBuf> {
        let mut found: Vec<PathBuf> = self.numbered().into_iter().map(|(_, path)| path).collect();
        let latest = self.latest();
        if latest.exists() && !found.iter().any(|path| same_file(path, &latest)) {
            let newer = found
                .first()
                .is_none_or(|newest| modified(&latest) >= modified(newest));
            found.insert(if newer { 0 } else { found.len() }, latest);
        }
        found
    }

    /// The number of checkpoints, not counting `latest` and `best`.
    pub fn count(&self) -> usize {
        self.numbered().len()
    }

    /// The checkpoints named after iterations, the newest first.
    fn numbered(&self) -> Vec<(u64, PathBuf)> {
        let iteration = |name: &str| {
            let digits = name.strip_prefix("iteration-")?;
            digits.strip_suffix(".safetensors")?.parse().ok()
        };
        let mut numbered = numbered_files(&self.folder.path, iteration).unwrap_or_default();
        numbered.sort_unstable_by(|a, b| b.cmp(a));
        numbered
    }

    /// Whether a run has saved anything here.
    pub(super) fn begun(&self) -> bool {
        self.best().exists() || !self.newest_first().is_empty()
    }
}

/// Checks that what is about to be written into is no link: a run folder may have been changed since the training run began.
///
/// # Errors
/// Fails if it is.
pub fn expect_no_link(path: &Path) -> Result<()> {
    ensure!(
        !path.is_symlink(),
        "cannot write {}: links in a run folder are not followed",
        shown(path).display()
    );
    Ok(())
}

/// The files of `folder` whose names contain a number, as `number` reads it.
///
/// # Errors
/// Fails if the folder cannot be read.
pub fn numbered_files(
    folder: &Path,
    number: impl Fn(&str) -> Option<u64>,
) -> io::Result<Vec<(u64, PathBuf)>> {
    let numbered = fs::read_dir(folder)?.flatten().filter_map(|entry| {
        let number = number(entry.file_name().to_str()?)?;
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        is_file.then(|| (number, entry.path()))
    });
    Ok(numbered.collect())
}

/// The time when a file was written, if it is there.
pub fn modified(path: &Path) -> Option<SystemTime> {
    fs::metadata(path).and_then(|facts| facts.modified()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(checkpoints: &Checkpoints) -> Vec<String> {
        let entries = fs::read_dir(&checkpoints.folder.path).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    fn checkpoints_of(run: &Path) -> Checkpoints {
        Checkpoints {
            folder: Folder::at(run.join(CHECKPOINTS)),
        }
    }

    #[test]
    fn the_newest_are_kept_and_latest_names_the_newest() {
        let place = tempfile::tempdir().unwrap();
        let mut checkpoints = checkpoints_of(place.path());
        checkpoints.hold().unwrap();
        for iteration in [0, 20, 40, 60] {
            checkpoints
                .write(iteration, format!("{iteration}").as_bytes(), 2)
                .unwrap();
            assert_eq!(
                fs::read_to_string(checkpoints.latest()).unwrap(),
                iteration.to_string()
            );
        }
        let kept = [
            "iteration-00000040.safetensors",
            "iteration-00000060.safetensors",
            "latest.safetensors",
        ];
        assert_eq!(names(&checkpoints), kept);
        checkpoints.write(60, b"again", 2).unwrap();
        assert_eq!(
            (names(&checkpoints), fs::read(checkpoints.latest()).unwrap()),
            (kept.map(String::from).into(), b"again".into())
        );
        let newest: Vec<PathBuf> = checkpoints.newest_first();
        assert!(
            newest.len() == 2 && newest[0].ends_with(kept[1]) && newest[1].ends_with(kept[0]),
            "{newest:?}"
        );
        // A crash just before the new one becomes the latest.
        fs::write(checkpoints.path_of(80), "newer").unwrap();
        assert_eq!(checkpoints.newest_first()[0], checkpoints.path_of(80));
        // A copy, as in a folder that was moved to a file system without hard links.
        fs::remove_file(checkpoints.latest()).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(20));
        fs::write(checkpoints.latest(), "copy").unwrap();
        assert_eq!(checkpoints.newest_first()[0], checkpoints.latest());
        std::thread::sleep(std::time::Duration::from_millis(20));
        fs::write(checkpoints.path_of(100), "newer than the copy").unwrap();
        assert_eq!(checkpoints.newest_first()[0], checkpoints.path_of(100));
    }

    #[test]
    fn later_ones_are_put_aside_when_an_earlier_one_is_gone_on_from() {
        let place = tempfile::tempdir().unwrap();
        let mut checkpoints = checkpoints_of(place.path());
        checkpoints.hold().unwrap();
        for iteration in [20, 40, 60, 30] {
            checkpoints.write(iteration, b"", 3).unwrap();
        }
        let expected = ["20.safetensors", "30.safetensors", "40.later", "60.later"]
            .map(|name| format!("iteration-000000{name}"));
        assert_eq!(names(&checkpoints)[..4], expected);
        assert_eq!(checkpoints.newest_first().len(), 2);
    }

    #[test]
    fn what_was_there_stays_when_the_next_cannot_be_written() {
        let place = tempfile::tempdir().unwrap();
        let mut checkpoints = checkpoints_of(place.path());
        checkpoints.hold().unwrap();
        checkpoints.write(20, b"good", 1).unwrap();
        // A folder with this name cannot be replaced, not even by root.
        fs::create_dir(checkpoints.path_of(40)).unwrap();
        assert!(checkpoints.write(40, b"bad", 1).is_err());
        assert_eq!(fs::read(checkpoints.latest()).unwrap(), b"good");
        assert_eq!(fs::read(checkpoints.path_of(20)).unwrap(), b"good");
    }
}
