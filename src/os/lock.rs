//! The lock of a run folder: only one training process at a time may write to it.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::Read;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use super::file::{Cannot, expect_named};
use super::output::Unfinished;

/// The name of the lock file.
pub const LOCK: &str = "run.lock";

/// The lock on a run folder. The system releases it when the program ends, however it ends.
#[derive(Debug)]
pub struct Locked {
    path: PathBuf,
    file: File,
}

impl Locked {
    /// Locks a folder against other training processes for as long as the result lives. Creates the folder and the lock file if
    /// they are missing, and changes nothing else.
    ///
    /// # Errors
    /// Fails if another training process uses the folder, or if it cannot be written to.
    pub fn acquire(folder: &Path) -> Result<Self> {
        let path = folder.join(LOCK);
        let open = |()| OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let file = fs::create_dir_all(folder).and_then(open).cannot("write", &path)?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            let mut holder = String::new();
            let _ = file.take(100).read_to_string(&mut holder);
            bail!("{} is being trained in by another program{holder}", folder.display());
        }
        // Some network file systems do not support locks. The folder is then used without one.
        Ok(Self { path, file })
    }

    /// Writes the process id into the lock file. A lock file that has other hard links, e.g. in a copied folder, is first
    /// replaced by a new one.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn sign(mut self) -> Result<Self> {
        if self.file.metadata().is_ok_and(|facts| facts.nlink() > 1) {
            let own = Unfinished::beside(&self.path);
            let file = File::create_new(&own.path).cannot("write", &self.path)?;
            let _ = file.try_lock();
            fs::rename(&own.path, &self.path).cannot("write", &self.path)?;
            self.file = file;
        }
        // Best effort: tells others who holds the lock.
        let said = format!(": process {}", std::process::id());
        let _ = self.file.set_len(0).and_then(|()| self.file.write_all_at(said.as_bytes(), 0));
        Ok(self)
    }

    /// Whether the folder still has this lock file. It may have been deleted and created again.
    pub fn holds(&self) -> bool {
        expect_named(&self.path, &self.file).is_ok()
    }

    /// Returns a function that checks the same later, without borrowing the lock.
    pub fn watch(&self) -> impl Fn() -> bool + Send + use<> {
        let (path, file) = (self.path.clone(), self.file.try_clone());
        move || file.as_ref().is_ok_and(|file| expect_named(&path, file).is_ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_training_in_a_folder_is_refused_until_the_first_ends() {
        let place = tempfile::tempdir().unwrap();
        let first = Locked::acquire(place.path()).unwrap().sign().unwrap();
        let refusal = Locked::acquire(place.path()).unwrap_err().to_string();
        assert!(refusal.ends_with(&format!("another program: process {}", std::process::id())), "{refusal}");
        drop(first.sign().unwrap());
        Locked::acquire(place.path()).unwrap();
    }

    #[test]
    fn a_lock_that_was_copied_by_a_second_name_is_not_shared() {
        let place = tempfile::tempdir().unwrap();
        let [run, copy] = ["run", "copy"].map(|name| place.path().join(name));
        drop(Locked::acquire(&run).unwrap());
        fs::create_dir(&copy).unwrap();
        fs::hard_link(run.join(LOCK), copy.join(LOCK)).unwrap();
        let lock = Locked::acquire(&copy).unwrap().sign().unwrap();
        Locked::acquire(&run).unwrap();
        assert!(Locked::acquire(&copy).is_err() && lock.holds());
    }
}
