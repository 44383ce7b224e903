//! The checkpoints of a run: each there whole or not at all, the newest few kept, and `latest` another name of the newest.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::file::{PARTIAL, name_also, write_whole};

const LATEST: &str = "latest.safetensors";
const BEST: &str = "best.safetensors";

/// The folder `checkpoints` of a run.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    folder: PathBuf,
}

impl Checkpoints {
    pub(super) fn of(run: &Path) -> Self {
        Self { folder: run.join("checkpoints") }
    }

    /// Where they are.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The newest one.
    pub fn latest(&self) -> PathBuf {
        self.folder.join(LATEST)
    }

    /// The one that scored best.
    pub fn best(&self) -> PathBuf {
        self.folder.join(BEST)
    }

    fn of_iteration(&self, iteration: u64) -> PathBuf {
        self.folder.join(format!("iteration-{iteration:08}.safetensors"))
    }

    /// Writes the checkpoint of an iteration, calls it the latest, and then removes all but the newest `keep`.
    ///
    /// # Errors
    /// A place that cannot be written to; what was there before is still there then.
    pub fn write(&self, iteration: u64, bytes: &[u8], keep: usize) -> Result<()> {
        self.create_folder()?;
        let path = self.of_iteration(iteration);
        write_whole(&path, bytes)?;
        name_also(&path, &self.latest())?;
        // Later ones are of a course that was given up when an earlier checkpoint was resumed from.
        let (later, earlier): (Vec<_>, Vec<_>) = self.numbered().into_iter().partition(|(of, _)| *of > iteration);
        for (_, path) in later.into_iter().chain(earlier.into_iter().skip(keep)) {
            // One too many does no harm.
            let _ = fs::remove_file(path);
        }
        Ok(())
    }

    /// Writes the one that scored best.
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub fn write_best(&self, bytes: &[u8]) -> Result<()> {
        self.create_folder()?;
        write_whole(&self.best(), bytes)
    }

    pub(super) fn create_folder(&self) -> Result<()> {
        fs::create_dir_all(&self.folder).with_context(|| format!("cannot create {}", self.folder.display()))
    }

    /// All that may be gone on from, the newest first: the latest, then those of iterations.
    pub fn newest_first(&self) -> Vec<PathBuf> {
        let latest = [self.latest()].into_iter().filter(|path| path.exists());
        latest.chain(self.numbered().into_iter().map(|(_, path)| path)).collect()
    }

    /// Those of iterations, the newest first.
    fn numbered(&self) -> Vec<(u64, PathBuf)> {
        let entries = fs::read_dir(&self.folder).into_iter().flatten().flatten();
        let numbered = entries.filter_map(|entry| {
            let name = entry.file_name();
            let number = name.to_str()?.strip_prefix("iteration-")?.strip_suffix(".safetensors")?.parse().ok()?;
            Some((number, entry.path()))
        });
        let mut numbered: Vec<_> = numbered.collect();
        numbered.sort_unstable_by(|a, b| b.cmp(a));
        numbered
    }

    /// Whether a run has been here.
    pub(super) fn begun(&self) -> bool {
        fs::read_dir(&self.folder).is_ok_and(|mut entries| entries.next().is_some())
    }

    /// Removes what a crash in the middle of writing left.
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub(super) fn clean(&self) -> Result<()> {
        for entry in fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == PARTIAL) {
                match fs::remove_file(&path) {
                    Err(error) if error.kind() == ErrorKind::NotFound => {}
                    result => result.with_context(|| format!("cannot remove {}", path.display()))?,
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(checkpoints: &Checkpoints) -> Vec<String> {
        let entries = fs::read_dir(checkpoints.folder()).unwrap();
        let mut names: Vec<String> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn the_newest_are_kept_and_latest_names_the_newest() {
        let place = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of(place.path());
        for iteration in [0, 20, 40, 60] {
            checkpoints.write(iteration, format!("{iteration}").as_bytes(), 2).unwrap();
            assert_eq!(fs::read_to_string(checkpoints.latest()).unwrap(), iteration.to_string());
        }
        let kept = ["iteration-00000040.safetensors", "iteration-00000060.safetensors", "latest.safetensors"];
        assert_eq!(names(&checkpoints), kept);
        checkpoints.write(60, b"again", 2).unwrap();
        assert_eq!(
            (names(&checkpoints), fs::read(checkpoints.latest()).unwrap()),
            (kept.map(String::from).into(), b"again".into())
        );
        let newest: Vec<PathBuf> = checkpoints.newest_first();
        assert!(newest[0].ends_with("latest.safetensors") && newest[2].ends_with(kept[0]), "{newest:?}");
    }

    #[test]
    fn those_of_a_course_that_was_given_up_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of(place.path());
        for iteration in [20, 40, 60, 30] {
            checkpoints.write(iteration, b"", 3).unwrap();
        }
        assert_eq!(names(&checkpoints)[..2], ["iteration-00000020.safetensors", "iteration-00000030.safetensors"]);
        assert_eq!(names(&checkpoints).len(), 3);
    }

    #[test]
    fn what_was_there_stays_when_the_next_cannot_be_written() {
        let place = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of(place.path());
        checkpoints.write(20, b"good", 1).unwrap();
        // A folder in its place cannot be replaced, whoever the user is.
        fs::create_dir(checkpoints.of_iteration(40)).unwrap();
        assert!(checkpoints.write(40, b"bad", 1).is_err());
        assert_eq!(fs::read(checkpoints.latest()).unwrap(), b"good");
        assert_eq!(fs::read(checkpoints.of_iteration(20)).unwrap(), b"good");
    }
}
