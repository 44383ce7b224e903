//! Files that are written completely or not at all: they have a temporary name until they are complete.
//!
//! No two processes share a temporary name, and unfinished files are removed when the program ends.

use std::collections::BTreeSet;
use std::collections::hash_map::RandomState;
use std::fs::{self, DirEntry, File, OpenOptions, TryLockError};
use std::hash::{BuildHasher, Hasher};
use std::io::{self, ErrorKind, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

use anyhow::{Result, bail, ensure};

use super::file::{Cannot, expect_named, gzip, read_bytes};
use super::quoted_path;
use super::threads::locked;

/// The prefix of the name of a file that is not complete yet, followed by the process id.
const OUR_PARTIAL: &str = ".shadow-repose-";

/// The age from which an unfinished file is taken for abandoned where there are no locks.
const LONG_AGO: Duration = Duration::from_secs(24 * 3600);

/// The most consecutive symbolic links that are followed.
const MOST_LINKS: usize = 40;

/// The files and folders that this process has not finished.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A file or folder that is removed when this is dropped or when a signal ends the program, unless it has been renamed by then.
#[derive(Debug)]
pub struct Unfinished {
    pub path: PathBuf,
}

impl Unfinished {
    /// Registers a unique name in the same folder as the final `path`, where something is about to be created.
    pub fn beside(path: &Path) -> Self {
        // Processes on different machines may have the same id.
        let chance = RandomState::new().build_hasher().finish();
        let path = folder_of(path).join(format!(
            "{OUR_PARTIAL}{}-{chance:016x}.partial",
            std::process::id()
        ));
        locked(&UNFINISHED).insert(path.clone());
        Self { path }
    }

    /// Gives what has been created the name `target`, in place of whatever has it.
    fn become_named(&self, target: &Path) -> io::Result<()> {
        fs::rename(&self.path, target)?;
        sync_folder(target);
        Ok(())
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        let mut unfinished = locked(&UNFINISHED);
        remove(&self.path);
        unfinished.remove(&self.path);
    }
}

/// Removes everything that this process has not finished, just before it exits. Nothing can be started afterwards.
pub fn remove_unfinished() {
    let unfinished = locked(&UNFINISHED);
    unfinished.iter().for_each(|path| remove(path));
    std::mem::forget(unfinished);
}

fn remove(path: &Path) {
    let _ = fs::remove_file(path);
    let _ = fs::remove_dir_all(path);
}

/// Whether a file or folder is unfinished and nobody writes it any more: its lock is free. A process id would mean nothing on
/// another machine or in another container. Where there are no locks, a day must have passed.
pub fn is_abandoned(entry: &DirEntry) -> bool {
    let name = entry.file_name().to_string_lossy().into_owned();
    // Opening a pipe would wait.
    let is_plain = entry
        .file_type()
        .is_ok_and(|kind| kind.is_file() || kind.is_dir());
    if !(is_plain && name.starts_with(OUR_PARTIAL) && name.ends_with(".partial")) {
        return false;
    }
    match File::open(entry.path()).map(|file| file.try_lock()) {
        Ok(Ok(())) => true,
        Ok(Err(TryLockError::WouldBlock)) => false,
        _ => {
            let written = entry.metadata().and_then(|facts| facts.modified()).ok();
            written
                .and_then(|written| written.elapsed().ok())
                .is_some_and(|age| age > LONG_AGO)
        }
    }
}

/// A file to be written, at a path that is known to be writable. Devices and pipes are written to directly.
#[derive(Debug)]
pub struct OutputFile {
    /// The path as the user gave it.
    pub path: PathBuf,
    /// Where the content is written.
    pub file: File,
    /// The temporary name and the final one.
    names: Option<(Unfinished, PathBuf)>,
}

impl OutputFile {
    /// Opens a path given by the user. An existing file stays until the new one is complete. A symbolic link stays: its target is
    /// written.
    ///
    /// # Errors
    /// Fails if the path cannot be written to. If its folder does not exist, the message says how to create it.
    pub fn create(path: &Path) -> Result<Self> {
        let direct = |file: File| Self {
            path: path.to_owned(),
            file,
            names: None,
        };
        match fs::metadata(path) {
            Ok(facts) if facts.is_dir() => bail!("cannot write {}: it is a folder", path.display()),
            Ok(facts) if !facts.is_file() => {
                return OpenOptions::new()
                    .write(true)
                    .open(path)
                    .map(direct)
                    .cannot("write", path);
            }
            // A link to a stream of this process, such as /dev/stdout: both share a file offset, so neither overwrites the other.
            Ok(_) if path.is_symlink() => {
                let streams = [
                    io::stdout().as_fd().try_clone_to_owned(),
                    io::stderr().as_fd().try_clone_to_owned(),
                ];
                let mut streams = streams.into_iter().flatten().map(File::from);
                if let Some(stream) = streams.find(|stream| expect_named(path, stream).is_ok()) {
                    return Ok(direct(stream));
                }
            }
            _ => {}
        }
        let end = end_of_links(path).cannot("write", path)?;
        // Without a slash at its end, which would make it a folder.
        let target: PathBuf = end.components().collect();
        if target.exists() {
            // A file that is protected from being written is not replaced.
            OpenOptions::new()
                .write(true)
                .open(&target)
                .cannot("write", path)?;
        }
        Self::named(path, target)
    }

    /// Opens `target`, which is `path` without its links. Whatever has this name is replaced, even a symbolic link.
    fn named(path: &Path, target: PathBuf) -> Result<Self> {
        let folder = folder_of(&target);
        ensure!(
            folder.is_dir(),
            "cannot write {}: the folder {} does not exist; create it with\n  mkdir -p {}",
            path.display(),
            folder.display(),
            quoted_path(folder)
        );
        let unfinished = Unfinished::beside(&target);
        let file = File::create_new(&unfinished.path).cannot("write", path)?;
        // Held as long as the file is open: others see that somebody writes it.
        nicety(file.try_lock());
        if let Ok(old) = fs::symlink_metadata(&target)
            && old.is_file()
        {
            nicety(file.set_permissions(old.permissions()));
        }
        Ok(Self {
            path: path.to_owned(),
            file,
            names: Some((unfinished, target)),
        })
    }

    /// Writes the content and gives the file its final name. What ends in `.gz` is compressed.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn finish(mut self, bytes: &[u8]) -> Result<()> {
        let packed = self
            .path
            .extension()
            .is_some_and(|extension| extension == "gz");
        let packed = packed.then(|| gzip(bytes));
        self.file
            .write_all(packed.as_deref().unwrap_or(bytes))
            .cannot("write", &self.path)?;
        self.complete()
    }

    /// Gives the file its final name, after its content was written.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn complete(self) -> Result<()> {
        let Some((unfinished, target)) = &self.names else {
            return Ok(());
        };
        sync(&self.file)
            .and_then(|()| unfinished.become_named(target))
            .cannot("write", &self.path)
    }
}

/// The absolute path to which a path leads through links. The file need not exist, but its folder must.
pub fn final_path(path: &Path) -> Option<PathBuf> {
    let end = end_of_links(path).ok()?;
    Some(folder_of(&end).canonicalize().ok()?.join(end.file_name()?))
}

/// Writes one of the program's own files atomically: a reader finds either the whole old file or the whole new one.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    OutputFile::named(path, path.to_owned())?.finish(bytes)
}

/// Gives a file a second name, replacing whatever has it. Makes a copy if the file system does not support hard links.
///
/// # Errors
/// Fails if the second name cannot be created.
pub fn name_also(path: &Path, name: &Path) -> Result<()> {
    let unfinished = Unfinished::beside(name);
    if nicety(fs::hard_link(path, &unfinished.path)).is_none() {
        return write_whole(name, &read_bytes(path)?);
    }
    unfinished.become_named(name).cannot("write", name)
}

/// Takes the result of what a file is better with and complete without. Some file systems refuse some of these, so none may fail a
/// save. They are all that this program does to its files beside writing, reading, renaming and removing:
///
/// | what | if it is refused |
/// |---|---|
/// | the mode of the file that is replaced | the new file has the default mode |
/// | the lock of a file that is being written | it counts as abandoned after a day |
/// | a second name (hard link) | the file is copied |
/// | the sync of a file, where the system has none | a loss of power may cost the last save |
/// | the sync of a folder | the same |
/// | the lock of a run folder | a heartbeat in the lock file replaces it |
/// | the name of the holder in the lock file | others do not see who trains |
/// | the removal of an old checkpoint, or of what a crash left | it stays |
pub fn nicety<T, E>(result: Result<T, E>) -> Option<T> {
    result.ok()
}

/// Brings the content of a file onto the disk.
///
/// # Errors
/// Fails if the disk does, or if it is full. A file system that cannot sync is no reason.
pub fn sync(file: &File) -> io::Result<()> {
    use ErrorKind::{InvalidInput, PermissionDenied, Unsupported};
    match file.sync_all() {
        Err(error) if matches!(error.kind(), InvalidInput | PermissionDenied | Unsupported) => {
            Ok(())
        }
        synced => synced,
    }
}

/// Syncs the folder of a new file: the name of the file is on the disk only once its folder is.
pub fn sync_folder(path: &Path) {
    nicety(File::open(folder_of(path)).and_then(|folder| folder.sync_all()));
}

/// Gives a file another extension, and a number before it if that name is taken. Returns the new path.
///
/// # Errors
/// Fails if the file cannot be renamed.
pub fn put_aside(path: &Path, extension: &str) -> io::Result<PathBuf> {
    let aside = unused_name(&path.with_extension(extension));
    fs::rename(path, &aside).map(|()| aside)
}

/// The first of `path` and its numbered variants that does not exist yet.
pub fn unused_name(path: &Path) -> PathBuf {
    let stem = path
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let end = path
        .extension()
        .map_or(String::new(), |end| format!(".{}", end.to_string_lossy()));
    let names = (2..).map(|number| path.with_file_name(format!("{stem}-{number}{end}")));
    let free = |path: &PathBuf| fs::symlink_metadata(path).is_err();
    std::iter::once(path.to_owned())
        .chain(names)
        .find(free)
        .expect("the numbers are unlimited")
}

/// Replaces a file that has other hard links with a copy, so that later writes to it do not change the others.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn make_own(path: &Path) -> Result<()> {
    if fs::metadata(path).is_ok_and(|facts| facts.nlink() > 1) {
        write_whole(path, &read_bytes(path)?)?;
    }
    Ok(())
}

/// The folder that holds a path: `.` for a name alone.
pub fn folder_of(path: &Path) -> &Path {
    path.parent()
        .filter(|folder| !folder.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
}

/// Follows symbolic links to the final path, which need not exist.
fn end_of_links(path: &Path) -> io::Result<PathBuf> {
    let mut end = path.to_owned();
    for _ in 0..MOST_LINKS {
        match fs::read_link(&end) {
            Ok(next) => end = folder_of(&end).join(next),
            Err(_) => return Ok(end),
        }
    }
    Err(io::Error::other("too many levels of symbolic links"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn content(path: &Path) -> String {
        fs::read_to_string(path).unwrap()
    }

    fn names(folder: &Path) -> usize {
        fs::read_dir(folder).unwrap().count()
    }

    #[test]
    fn a_file_that_is_written_leaves_nothing_else_behind() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.safetensors");
        write_whole(&path, b"one").unwrap();
        write_whole(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_slash_behind_the_name_of_a_file_makes_it_no_folder() {
        let place = tempfile::tempdir().unwrap();
        for bytes in ["one", "two"] {
            let output = OutputFile::create(&place.path().join("film.gif/")).unwrap();
            output.finish(bytes.as_bytes()).unwrap();
            assert_eq!(content(&place.path().join("film.gif")), bytes);
        }
    }

    #[test]
    fn a_file_that_is_not_finished_leaves_the_old_one_as_it_was() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("trace");
        OutputFile::create(&path).unwrap().finish(b"old").unwrap();
        drop(OutputFile::create(&path).unwrap());
        assert_eq!((content(&path).as_str(), names(place.path())), ("old", 1));
    }

    #[test]
    fn two_that_write_one_file_do_not_meet_and_nothing_of_the_users_is_taken_for_unfinished() {
        let place = tempfile::tempdir().unwrap();
        let (path, own) = (
            place.path().join("film.gif"),
            place.path().join("film.gif.partial"),
        );
        fs::write(&own, "mine").unwrap();
        let [one, other] = [(); 2].map(|()| OutputFile::create(&path).unwrap());
        one.finish(b"one").unwrap();
        assert_eq!(content(&path), "one");
        other.finish(b"other").unwrap();
        assert_eq!(
            (
                content(&path).as_str(),
                content(&own).as_str(),
                names(place.path())
            ),
            ("other", "mine", 2)
        );
    }

    #[test]
    fn a_file_that_is_replaced_keeps_its_mode() {
        use std::os::unix::fs::PermissionsExt;
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("trace");
        fs::write(&path, "old").unwrap();
        for mode in [0o600, 0o664] {
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            OutputFile::create(&path).unwrap().finish(b"new").unwrap();
            write_whole(&path, b"newer").unwrap();
            assert_eq!(
                fs::metadata(&path).unwrap().permissions().mode() & 0o777,
                mode
            );
        }
    }

    #[test]
    fn a_link_stays_a_link_and_what_it_leads_to_is_written() {
        let place = tempfile::tempdir().unwrap();
        let [link, other, target] = ["link", "other", "target"].map(|name| place.path().join(name));
        std::os::unix::fs::symlink("target", &other).unwrap();
        std::os::unix::fs::symlink(&other, &link).unwrap();
        // Even if the target does not exist yet.
        for text in ["first", "second"] {
            OutputFile::create(&link)
                .unwrap()
                .finish(text.as_bytes())
                .unwrap();
            assert!(link.is_symlink() && other.is_symlink() && !target.is_symlink());
            assert_eq!(content(&target), text);
        }
        write_whole(&link, b"third").unwrap();
        assert!(
            !link.is_symlink() && content(&target) == "second",
            "the program's own files are not written through links"
        );
        std::os::unix::fs::symlink("circle", place.path().join("circle")).unwrap();
        assert!(OutputFile::create(&place.path().join("circle")).is_err());
    }

    #[test]
    fn devices_are_written_to_and_stay_devices() {
        OutputFile::create(Path::new("/dev/null"))
            .unwrap()
            .finish(b"gone")
            .unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());
        let full = Path::new("/dev/full");
        if !full.exists() {
            eprintln!("not tested: a full device, which only Linux has");
            return;
        }
        let device = OutputFile::create(full).unwrap();
        assert!(device.finish(b"no room").is_err());
    }

    #[test]
    fn a_folder_that_is_not_there_is_named_with_how_to_make_it() {
        let place = tempfile::tempdir().unwrap();
        let refusal = OutputFile::create(&place.path().join("my films/a/b.mp4"))
            .unwrap_err()
            .to_string();
        assert!(
            refusal.contains(&format!("mkdir -p '{}/my films/a'", place.path().display())),
            "{refusal}"
        );
    }

    #[test]
    fn a_file_with_two_names_becomes_two_files_before_it_is_written_into() {
        let place = tempfile::tempdir().unwrap();
        let [one, other] = ["one", "other"].map(|name| place.path().join(name));
        fs::write(&one, "both").unwrap();
        fs::hard_link(&one, &other).unwrap();
        make_own(&one).unwrap();
        fs::write(&one, "changed").unwrap();
        assert_eq!(
            (
                content(&one).as_str(),
                content(&other).as_str(),
                names(place.path())
            ),
            ("changed", "both", 2)
        );
    }

    #[test]
    fn a_name_that_is_taken_gets_a_number() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("metrics.before-3.csv");
        assert_eq!(unused_name(&path), path);
        fs::write(&path, "").unwrap();
        std::os::unix::fs::symlink("nowhere", place.path().join("metrics.before-3-2.csv")).unwrap();
        assert_eq!(
            unused_name(&path),
            place.path().join("metrics.before-3-3.csv")
        );
    }

    #[test]
    fn two_names_of_one_file_are_known() {
        let place = tempfile::tempdir().unwrap();
        let [one, other] =
            ["trace", "other"].map(|name| final_path(&place.path().join(name)).unwrap());
        let around = place
            .path()
            .join("../")
            .join(place.path().file_name().unwrap())
            .join("trace");
        assert_eq!(final_path(&around), Some(one));
        assert_ne!(final_path(&around), Some(other));
    }

    #[test]
    fn what_a_process_left_unfinished_is_known_once_it_has_ended() {
        let place = tempfile::tempdir().unwrap();
        for name in [
            ".shadow-repose-1-0.partial",
            "film.gif.partial",
            ".shadow-repose-999999999-0",
        ] {
            fs::write(place.path().join(name), "").unwrap();
        }
        let _living = OutputFile::create(&place.path().join("film.gif")).unwrap();
        let abandoned = fs::read_dir(place.path())
            .unwrap()
            .flatten()
            .filter(is_abandoned);
        let names: Vec<_> = abandoned.map(|entry| entry.file_name()).collect();
        assert_eq!(names, [".shadow-repose-1-0.partial"]);
    }

    #[test]
    fn a_second_name_replaces_what_had_it() {
        let place = tempfile::tempdir().unwrap();
        let [one, two, latest] = ["one", "two", "latest"].map(|name| place.path().join(name));
        for path in [&one, &two] {
            write_whole(path, path.file_name().unwrap().as_encoded_bytes()).unwrap();
            name_also(path, &latest).unwrap();
            assert_eq!(fs::read(&latest).unwrap(), fs::read(path).unwrap());
        }
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 3);
        assert_eq!(fs::read(&one).unwrap(), b"one");
    }
}
