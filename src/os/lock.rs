//! The lock of a run folder: only one training process at a time may write to it.
//!
//! On a file system without locks, the time of the lock file replaces the lock: it is renewed as long as the training runs.
//!
//! The file contains the name of its holder. A training run that ends normally removes that name. So a name in a file that nobody
//! holds means that the training run has failed or was killed.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::Read;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail, ensure};

use super::file::{Cannot, expect_named};
use super::machine::Machine;
use super::output::Unfinished;
use super::{say, shortened};

/// The name of the lock file.
pub const LOCK: &str = "run.lock";

/// The time between two renewals of a lock file, where there are no locks.
const RENEWED_EVERY: Duration = Duration::from_secs(10);

/// The age from which such a file no longer counts as a lock.
const LAPSED: Duration = Duration::from_secs(60);

/// The time after which a second program that began at the same moment has written its name over this one's.
const SETTLED: Duration = Duration::from_millis(500);

/// The number of pauses in which a taken lock may become free, and their length. [`Hold::of`] takes a lock for an instant.
const PAUSES: usize = 5;
const PAUSE: Duration = Duration::from_millis(20);

/// The lock on a run folder. The system releases it when the program ends, however it ends.
#[derive(Debug)]
pub struct Locked {
    path: PathBuf,
    file: File,
    /// Without locks: as long as this lives, the lock file is renewed.
    renewal: Option<Arc<()>>,
}

impl Locked {
    /// Locks a folder against other training processes for as long as the result lives. Creates the folder and the lock file if
    /// they are missing, and changes nothing else.
    ///
    /// # Errors
    /// Fails if another training process uses the folder, or if it cannot be written to.
    pub fn acquire(folder: &Path) -> Result<Self> {
        let path = folder.join(LOCK);
        let open = |()| {
            OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&path)
        };
        let file = fs::create_dir_all(folder)
            .and_then(open)
            .cannot("write", &path)?;
        let mut pauses = 0..PAUSES;
        let renewal = loop {
            match file.try_lock() {
                Ok(()) => break None,
                Err(TryLockError::WouldBlock) if pauses.next().is_some() => thread::sleep(PAUSE),
                Err(TryLockError::WouldBlock) => bail!(in_use(folder, &path)),
                // Some network file systems do not support locks.
                Err(TryLockError::Error(_)) => break Some(renew(folder, &path)?),
            }
        };
        Ok(Self {
            path,
            file,
            renewal,
        })
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
        // Best effort: shows others who holds the lock. Where there are no locks, a file without a name does not count as one.
        let said = name();
        let _ = self
            .file
            .set_len(0)
            .and_then(|()| self.file.write_all_at(said.as_bytes(), 0));
        Ok(self)
    }

    /// Releases the lock and removes the name of this program, after a training run that ended normally.
    pub fn release(self) {
        // The file may belong to another program by now.
        if holder(&self.path) == name() {
            let _ = self.file.set_len(0);
        }
    }

    /// Whether the folder still has this lock file. It may have been deleted and created again.
    pub fn holds(&self) -> bool {
        expect_named(&self.path, &self.file).is_ok()
    }

    /// A function that checks the same later, without borrowing the lock.
    pub fn watch(&self) -> impl Fn() -> bool + Send + use<> {
        let path = self.path.clone();
        let file = self.file.try_clone();
        move || {
            file.as_ref()
                .is_ok_and(|file| expect_named(&path, file).is_ok())
        }
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        // The next training need not wait, unless the file belongs to another one by now. The name stays, as in a file
        // that was locked.
        if self.renewal.is_some() && holder(&self.path) == name() {
            set_time(&self.path, UNIX_EPOCH);
        }
    }
}

/// Writes this program's name into the lock file, and renews it from now on, as long as the result lives.
///
/// # Errors
/// Fails if the file has another name and was renewed a short time ago, or if it cannot be written to.
fn renew(folder: &Path, path: &Path) -> Result<Arc<()>> {
    let renewed = fs::metadata(path)
        .and_then(|facts| facts.modified())
        .cannot("read", path)?;
    let age = renewed.elapsed().unwrap_or_default();
    ensure!(
        holder(path).is_empty() || age > LAPSED,
        "{}, or was {} s ago; there are no file locks here, so try again when {LOCK} is a minute old",
        in_use(folder, path),
        age.as_secs()
    );
    let own = name();
    fs::write(path, &own).cannot("write", path)?;
    thread::sleep(SETTLED);
    ensure!(holder(path) == own, in_use(folder, path));
    say!(
        "note: there are no file locks in {}; {LOCK} is renewed instead",
        folder.display()
    );
    let file = path.to_owned();
    let lives = Arc::new(());
    let alive = Arc::downgrade(&lives);
    let renew = move || {
        while alive.strong_count() > 0 {
            set_time(&file, SystemTime::now());
            thread::sleep(RENEWED_EVERY);
        }
    };
    thread::Builder::new()
        .spawn(renew)
        .context("cannot start a thread for the lock")?;
    Ok(lives)
}

/// What the lock file of a run folder shows to a reader.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Hold {
    /// A training run holds it.
    Held,
    /// Nobody holds it, and it contains no name or does not exist.
    Released,
    /// Nobody holds it, but it contains a name: its training has failed or was killed.
    Left,
    /// As `Left`, but the name is of another machine, whose locks may not be visible from here.
    Elsewhere,
}

impl Hold {
    /// Looks at the lock file of a folder, and changes nothing.
    pub fn of(folder: &Path) -> Self {
        let path = folder.join(LOCK);
        // Neither a link nor a pipe: opening a pipe would wait.
        let Some(facts) = fs::symlink_metadata(&path)
            .ok()
            .filter(fs::Metadata::is_file)
        else {
            return Self::Released;
        };
        let is_renewed = || {
            facts
                .modified()
                .is_ok_and(|time| time.elapsed().unwrap_or_default() <= LAPSED)
        };
        let signed = holder(&path);
        match File::open(&path).map(|file| file.try_lock_shared()) {
            Ok(Err(TryLockError::WouldBlock)) => Self::Held,
            Ok(Err(TryLockError::Error(_))) if facts.len() > 0 && is_renewed() => Self::Held,
            _ if facts.len() == 0 => Self::Released,
            _ if signed.ends_with(&format!(" on {}", Machine::this().name)) => Self::Left,
            _ => Self::Elsewhere,
        }
    }
}

fn set_time(path: &Path, time: SystemTime) {
    let _ = File::options()
        .write(true)
        .open(path)
        .and_then(|file| file.set_modified(time));
}

fn in_use(folder: &Path, lock: &Path) -> String {
    format!(
        "{} is in use by another program{}",
        folder.display(),
        holder(lock)
    )
}

/// Who holds the lock file, as it was signed.
fn holder(path: &Path) -> String {
    let mut holder = String::new();
    let _ = File::open(path).and_then(|file| file.take(100).read_to_string(&mut holder));
    shortened(&holder)
}

/// The name of this program, as lock files are signed with it.
fn name() -> String {
    format!(
        ": process {} on {}",
        std::process::id(),
        Machine::this().name
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_training_in_a_folder_is_refused_until_the_first_ends() {
        let place = tempfile::tempdir().unwrap();
        let first = Locked::acquire(place.path()).unwrap().sign().unwrap();
        let refusal = Locked::acquire(place.path()).unwrap_err().to_string();
        assert!(
            refusal.contains(&format!(
                "another program: process {} on ",
                std::process::id()
            )),
            "{refusal}"
        );
        drop(first.sign().unwrap());
        Locked::acquire(place.path()).unwrap();
    }

    #[test]
    fn those_who_look_see_who_trains_and_who_has_ended_in_what_way_and_keep_nobody_out() {
        let place = tempfile::tempdir().unwrap();
        let look = || Hold::of(place.path());
        assert_eq!(look(), Hold::Released);
        let lock = Locked::acquire(place.path()).unwrap();
        assert_eq!(look(), Hold::Held, "not signed yet");
        let lock = lock.sign().unwrap();
        assert_eq!(look(), Hold::Held);
        drop(lock);
        assert_eq!(look(), Hold::Left);
        Locked::acquire(place.path())
            .unwrap()
            .sign()
            .unwrap()
            .release();
        assert_eq!(look(), Hold::Released);
        fs::write(place.path().join(LOCK), ": process 1 on another").unwrap();
        assert_eq!(look(), Hold::Elsewhere);
        // Another program that looks at this moment.
        let seen = File::open(place.path().join(LOCK)).unwrap();
        seen.try_lock_shared().unwrap();
        let gone = thread::spawn(move || {
            thread::sleep(PAUSE);
            drop(seen);
        });
        Locked::acquire(place.path()).unwrap();
        gone.join().unwrap();
    }

    #[test]
    fn where_there_are_no_locks_the_name_stays_in_a_lock_file_of_its_own_and_anothers_is_left() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(LOCK);
        fs::write(&path, "").unwrap();
        fs::hard_link(&path, place.path().join("copy")).unwrap();
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&path)
            .unwrap();
        let renewal = Some(renew(place.path(), &path).unwrap());
        let lock = Locked {
            path: path.clone(),
            file,
            renewal,
        }
        .sign()
        .unwrap();
        assert_eq!(holder(&path), name());
        drop(lock);
        assert_eq!(holder(&path), name(), "it has failed");
        // The next one need not wait.
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&path)
            .unwrap();
        let renewal = Some(renew(place.path(), &path).unwrap());
        let lock = Locked {
            path: path.clone(),
            file,
            renewal,
        }
        .sign()
        .unwrap();
        fs::write(&path, ": process 1 on another").unwrap();
        drop(lock);
        assert_eq!(holder(&path), ": process 1 on another");
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
