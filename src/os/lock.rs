//! The lock of a run folder: only one training process at a time may write to it.
//!
//! On a file system without locks, a heartbeat replaces the lock: the lock file changes as long as the training runs. Whoever wants
//! the folder watches it for some seconds of his own clock, since the dates of files come from another one.
//!
//! The file contains the name of its holder. A training run that ends normally removes that name. So a name in a file that nobody
//! holds means that the training run has failed or was killed.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, Result, bail, ensure};

use super::file::{Cannot, expect_named};
use super::machine::Machine;
use super::output::{Unfinished, nicety};
use super::threads::locked;
use super::{say, shortened, shown};

/// The name of the lock file.
pub const LOCK: &str = "run.lock";

/// The time between two heartbeats, where there are no locks.
const BEAT: Duration = Duration::from_secs(1);

/// The time without a heartbeat after which nobody trains any more.
const WATCHED: Duration = Duration::from_secs(6);

/// The age from which a lock file with a heartbeat is shown as left behind. Two clocks may differ.
const LAPSED: Duration = Duration::from_secs(60);

/// The time after which a second program that began at the same moment has written its name over this one's.
const SETTLED: Duration = Duration::from_millis(500);

/// The most bytes of a lock file that are read.
const LONGEST: u64 = 200;

/// The number of pauses in which a taken lock may become free, and their length. [`Hold::of`] takes a lock for an instant.
const PAUSES: usize = 5;
const PAUSE: Duration = Duration::from_millis(20);

/// The lock on a run folder. The system releases it when the program ends, however it ends.
#[derive(Debug)]
pub struct Locked {
    path: PathBuf,
    file: File,
    /// It replaces the lock where there are no locks.
    heart: Option<Arc<Heart>>,
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
        let heart = loop {
            match file.try_lock() {
                Ok(()) => break None,
                Err(TryLockError::WouldBlock) if pauses.next().is_some() => thread::sleep(PAUSE),
                Err(TryLockError::WouldBlock) => bail!(in_use(folder, &path)),
                // Some network file systems do not support locks.
                Err(TryLockError::Error(_)) => break Some(Heart::start(folder, &path)?),
            }
        };
        Ok(Self { path, file, heart })
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
            nicety(file.try_lock());
            fs::rename(&own.path, &self.path).cannot("write", &self.path)?;
            self.file = file;
        }
        match &self.heart {
            Some(heart) => {
                heart.beat(0);
            }
            None => {
                nicety(write(&self.file, &name()));
            }
        }
        Ok(self)
    }

    /// Releases the lock and removes the name of this program, after a training run that ended normally.
    pub fn release(self) {
        if self.heart.as_ref().is_none_or(|heart| heart.stop()) {
            nicety(self.file.set_len(0));
        }
    }

    /// Whether the folder still has this lock file. It may have been deleted and created again.
    pub fn holds(&self) -> bool {
        expect_named(&self.path, &self.file).is_ok() && self.expect_own().is_ok()
    }

    /// A function that checks the same later, without borrowing the lock.
    pub fn watch(&self) -> impl Fn() -> bool + Send + use<> {
        let path = self.path.clone();
        let file = self.file.try_clone();
        let heart = self.heart.clone();
        move || {
            heart.as_ref().is_none_or(|heart| heart.beats())
                && file
                    .as_ref()
                    .is_ok_and(|file| expect_named(&path, file).is_ok())
        }
    }

    /// Checks that no other program has taken the folder where there are no locks: this one may have been suspended for longer than
    /// others wait for its heartbeat.
    ///
    /// # Errors
    /// Fails with the name of the other program.
    pub fn expect_own(&self) -> Result<()> {
        ensure!(
            self.heart.as_ref().is_none_or(|heart| heart.beats()),
            in_use(self.path.parent().unwrap_or(&self.path), &self.path)
        );
        Ok(())
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        // The name stays, as in a file that was locked. Without a heartbeat, the next training need not wait.
        if self.heart.as_ref().is_some_and(|heart| heart.stop()) {
            nicety(write(&self.file, &name()));
        }
    }
}

/// The heartbeat of a training run where there are no locks.
#[derive(Debug)]
struct Heart {
    /// The lock file.
    path: PathBuf,
    /// The time of the last heartbeat, until the heart stops.
    last: Mutex<Option<Instant>>,
}

impl Heart {
    /// Writes this program's name and a heartbeat into the lock file from now on, until the heart stops.
    ///
    /// # Errors
    /// Fails if the heart of another program beats in the file, or if it cannot be written to.
    fn start(folder: &Path, path: &Path) -> Result<Arc<Self>> {
        let found = content(path);
        let watching = Instant::now();
        while has_beat(&found) && !found.starts_with(&name()) && watching.elapsed() < WATCHED {
            thread::sleep(BEAT / 4);
            ensure!(
                content(path) == found,
                "{}; there are no file locks here, but {LOCK} changes",
                in_use(folder, path)
            );
        }
        write_at(path, &beat(0)).cannot("write", path)?;
        thread::sleep(SETTLED);
        ensure!(!is_anothers(&content(path)), in_use(folder, path));
        say!(
            "note: there are no file locks in {}; a heartbeat in {LOCK} replaces them",
            shown(folder).display()
        );
        let heart = Arc::new(Self {
            path: path.to_owned(),
            last: Mutex::new(Some(Instant::now())),
        });
        let beating = heart.clone();
        let keep_beating = move || {
            let mut number = 0;
            while beating.beat(number) {
                thread::sleep(BEAT);
                number += 1;
            }
        };
        thread::Builder::new()
            .spawn(keep_beating)
            .context("cannot start a thread for the lock")?;
        Ok(heart)
    }

    /// Whether the lock file still belongs to this program. It is lost for ever if it has the name of another program. It is
    /// also lost without this program's name after a pause in which another program may have come and gone.
    fn beats(&self) -> bool {
        self.look().is_some()
    }

    /// The time of the last heartbeat, if the lock file still belongs to this program.
    fn look(&self) -> MutexGuard<'_, Option<Instant>> {
        let mut last = locked(&self.last);
        let lost = |time: Instant, content: String| {
            if time.elapsed() > WATCHED / 2 {
                !content.starts_with(&name())
            } else {
                is_anothers(&content)
            }
        };
        // Nothing is known about a file that cannot be read now.
        let content = read(&self.path).ok();
        if last
            .zip(content)
            .is_some_and(|(time, content)| lost(time, content))
        {
            *last = None;
        }
        last
    }

    /// Writes a heartbeat. Returns whether the lock file still belongs to this program.
    fn beat(&self, number: u64) -> bool {
        let mut last = self.look();
        if last.is_some() && write_at(&self.path, &beat(number)).is_ok() {
            *last = Some(Instant::now());
        }
        last.is_some()
    }

    /// Stops. Returns whether the lock file belonged to this program until now.
    fn stop(&self) -> bool {
        self.look().take().is_some()
    }
}

/// What the lock file contains at this heartbeat.
fn beat(number: u64) -> String {
    format!("{}\nheartbeat {number}", name())
}

/// Whether the content of a lock file has a heartbeat.
fn has_beat(content: &str) -> bool {
    content.contains("\nheartbeat ")
}

/// Replaces the content of a lock file. At no moment is it empty.
fn write(file: &File, content: &str) -> io::Result<()> {
    file.write_all_at(content.as_bytes(), 0)?;
    file.set_len(content.len() as u64)
}

/// Replaces the content of the lock file at this path.
fn write_at(path: &Path, content: &str) -> io::Result<()> {
    let opened = File::options().write(true).open(path);
    opened.and_then(|file| write(&file, content))
}

/// Whether this content of a lock file has the whole name of another program. Damaged content is nobody's.
fn is_anothers(content: &str) -> bool {
    let number = content.lines().nth(1);
    number.is_some_and(|line| line.starts_with("number ")) && !content.starts_with(&name())
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
        let beats = || {
            let is_fresh = |time: SystemTime| time.elapsed().unwrap_or_default() <= LAPSED;
            has_beat(&content(&path)) && facts.modified().is_ok_and(is_fresh)
        };
        let signed = holder(&path);
        match File::open(&path).map(|file| file.try_lock_shared()) {
            Ok(Err(TryLockError::WouldBlock)) => Self::Held,
            Ok(Err(TryLockError::Error(_))) if beats() => Self::Held,
            _ if facts.len() == 0 => Self::Released,
            _ if signed.ends_with(&format!(" on {}", Machine::this().name)) => Self::Left,
            _ => Self::Elsewhere,
        }
    }
}

fn in_use(folder: &Path, lock: &Path) -> String {
    format!(
        "{} is in use by another program{}",
        shown(folder).display(),
        holder(lock)
    )
}

/// Who holds the lock file, as it was signed.
fn holder(path: &Path) -> String {
    shortened(content(path).lines().next().unwrap_or_default())
}

/// The content of a lock file, or nothing if it cannot be read.
fn content(path: &Path) -> String {
    read(path).unwrap_or_default()
}

/// Reads a lock file. Only files are opened: opening a pipe would wait.
fn read(path: &Path) -> io::Result<String> {
    if !fs::metadata(path)?.is_file() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    io::read_to_string(File::open(path)?.take(LONGEST))
}

/// What this program signs lock files with: a line that names it, and a number that no other process of this name has, e.g. in
/// another container.
fn name() -> String {
    static OWN: LazyLock<u64> = LazyLock::new(rand::random);
    format!(
        ": process {} on {}\nnumber {:016x}",
        std::process::id(),
        Machine::this().name,
        *OWN
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

    /// A lock as it is taken where there are no locks.
    fn beating(folder: &Path) -> Result<Locked> {
        let path = folder.join(LOCK);
        let open = OpenOptions::new().read(true).write(true).open(&path);
        let heart = Some(Heart::start(folder, &path)?);
        let file = open.unwrap();
        Locked { path, file, heart }.sign()
    }

    #[test]
    fn where_there_are_no_locks_the_name_stays_in_a_lock_file_of_its_own_and_anothers_is_left() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(LOCK);
        fs::write(&path, "").unwrap();
        fs::hard_link(&path, place.path().join("copy")).unwrap();
        let lock = beating(place.path()).unwrap();
        assert!(content(&path).starts_with(&name()) && has_beat(&content(&path)));
        drop(lock);
        assert_eq!(content(&path), name(), "it has failed");
        let begun = Instant::now();
        let lock = beating(place.path()).unwrap();
        assert!(begun.elapsed() < WATCHED, "the next one need not wait");
        // A beat that is under way overwrites the first of them.
        let lost = (0..3).any(|_| {
            fs::write(&path, ANOTHERS).unwrap();
            !lock.holds()
        });
        assert!(
            lost && !lock.watch()() && lock.expect_own().is_err(),
            "it looks again"
        );
        drop(lock);
        assert_eq!(content(&path), ANOTHERS);
    }

    const ANOTHERS: &str = ": process 1 on another\nnumber 7";

    #[test]
    fn where_there_are_no_locks_a_folder_is_lost_while_its_training_is_suspended() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(LOCK);
        // The other program goes on, has ended, or has failed.
        for left in [&format!("{ANOTHERS}\nheartbeat 3"), "", ANOTHERS] {
            fs::write(&path, "").unwrap();
            let lock = beating(place.path()).unwrap();
            let heart = lock.heart.as_ref().unwrap();
            {
                let mut last = heart.last.lock().unwrap();
                *last = last.map(|time| time.checked_sub(WATCHED).unwrap());
                fs::write(&path, left).unwrap();
            }
            thread::sleep(2 * BEAT);
            assert!(!lock.holds() && !lock.watch()(), "{left}");
            fs::write(&path, beat(9)).unwrap();
            assert!(lock.expect_own().is_err(), "lost for ever");
            fs::write(&path, left).unwrap();
            lock.release();
            assert_eq!(content(&path), left);
        }
    }

    #[test]
    fn where_there_are_no_locks_a_heart_that_beats_keeps_others_out_whatever_the_date_is() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(LOCK);
        // Another container may have the same name and the same process id.
        let same = name().lines().next().unwrap().to_owned();
        let beats = (0..).map(move |number| format!("{same}\nnumber 7\nheartbeat {number}"));
        fs::write(&path, "").unwrap();
        let file = path.clone();
        let other = thread::spawn(move || {
            for content in beats.take(8) {
                let file = File::options().write(true).open(&file).unwrap();
                write(&file, &content).unwrap();
                file.set_modified(SystemTime::UNIX_EPOCH).unwrap();
                thread::sleep(BEAT / 4);
            }
        });
        thread::sleep(BEAT / 8);
        let refusal = beating(place.path()).unwrap_err().to_string();
        assert!(
            refusal.contains("is in use") && refusal.contains("changes"),
            "{refusal}"
        );
        other.join().unwrap();
        assert!(content(&path).contains("number 7"), "nothing was written");
    }

    #[test]
    fn where_there_are_no_locks_a_lock_file_that_is_lost_or_cannot_be_read_is_nobodys() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(LOCK);
        fs::write(&path, "").unwrap();
        let lock = beating(place.path()).unwrap();
        let [short, zeros] = [&name()[..9], &"\0".repeat(60)];
        for damaged in ["", short, zeros, "number 7"] {
            fs::write(&path, damaged).unwrap();
            assert!(lock.holds(), "{damaged}");
            thread::sleep(2 * BEAT);
            assert!(has_beat(&content(&path)), "the heart goes on");
        }
        fs::remove_file(&path).unwrap();
        assert!(lock.expect_own().is_ok() && !lock.holds());
        fs::write(&path, "").unwrap();
        beating(place.path()).unwrap();
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
