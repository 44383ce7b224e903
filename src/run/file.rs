//! Files that are read whole, and written whole or not at all.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};

/// How the name of a file ends that is not complete yet.
pub const PARTIAL: &str = "partial";

/// A text of settings takes a few KiB.
const LARGEST_TEXT: u64 = 1 << 20;

/// The largest policy that the settings allow, its optimizer, and 65536 hands take less.
const LARGEST_BYTES: u64 = 1 << 30;

/// The text of a file.
///
/// # Errors
/// A file that cannot be read, is not UTF-8, or is too large for a text of settings.
pub fn read_text(path: &Path) -> Result<String> {
    let context = || format!("cannot read {}", path.display());
    let mut text = String::new();
    let file = File::open(path).with_context(context)?;
    file.take(LARGEST_TEXT + 1).read_to_string(&mut text).with_context(context)?;
    ensure!(text.len() as u64 <= LARGEST_TEXT, "{}: larger than {LARGEST_TEXT} bytes", path.display());
    Ok(text)
}

/// The bytes of a regular file.
///
/// # Errors
/// A file that cannot be read, or is larger than any of ours.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let context = || format!("cannot read {}", path.display());
    let facts = fs::metadata(path).with_context(context)?;
    ensure!(facts.is_file(), "cannot read {}: not a regular file", path.display());
    let size = facts.len();
    ensure!(size <= LARGEST_BYTES, "{}: {size} bytes are more than any file of this program has", path.display());
    let mut bytes = Vec::with_capacity(size as usize);
    File::open(path).and_then(|file| file.take(LARGEST_BYTES).read_to_end(&mut bytes)).with_context(context)?;
    Ok(bytes)
}

/// Gives a file another name as well, in place of whatever has it. Where the file system knows no second names, it is a copy.
///
/// # Errors
/// A place that cannot be written to.
pub fn name_also(path: &Path, name: &Path) -> Result<()> {
    let partial = partial(name);
    // Of an earlier attempt.
    let _ = fs::remove_file(&partial);
    if fs::hard_link(path, &partial).is_err() {
        return write_whole(name, &read_bytes(path)?);
    }
    let named = fs::rename(&partial, name).and_then(|()| sync_folder(name));
    named.with_context(|| format!("cannot write {}", name.display()))
}

/// Makes sure that `path` still names this open file: it may have been deleted, or replaced by another.
///
/// # Errors
/// It does not.
pub fn expect_named(path: &Path, file: &File) -> Result<()> {
    let context = || format!("cannot find {}", path.display());
    let [named, held] = [fs::metadata(path).with_context(context)?, file.metadata().with_context(context)?];
    let same = (named.dev(), named.ino()) == (held.dev(), held.ino());
    ensure!(same, "{} has been replaced", path.display());
    Ok(())
}

/// Whether two names are of one file.
pub fn same_file(a: &Path, b: &Path) -> bool {
    let identity = |path| fs::metadata(path).ok().map(|facts| (facts.dev(), facts.ino()));
    identity(a).is_some() && identity(a) == identity(b)
}

fn partial(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(PARTIAL);
    PathBuf::from(name)
}

/// Brings the name of a new file onto the disk: it is there once its folder is.
///
/// # Errors
/// A folder that cannot be read, or a disk that fails.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match File::open(folder)?.sync_all() {
        // Some network file systems cannot do this to folders, and do not need it.
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}

/// Writes a file so that whoever looks finds the whole old one or the whole new one.
///
/// # Errors
/// A place that cannot be written to.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    OutputFile::create(path)?.finish(bytes)
}

/// A file to be written, in a place that is known to be writable: it has another name until it is complete and on the disk.
/// Devices and pipes are written to directly.
pub struct OutputFile {
    path: PathBuf,
    /// The file under its other name.
    partial: Option<PathBuf>,
    file: File,
}

impl OutputFile {
    /// Opens the place for writing; what is there stays.
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub fn create(path: &Path) -> Result<Self> {
        let special = fs::metadata(path).is_ok_and(|facts| !facts.is_file());
        let partial = (!special).then(|| partial(path));
        let file = match &partial {
            Some(partial) => {
                // Of an earlier attempt; or a link that somebody laid, which is not to be written through.
                let _ = fs::remove_file(partial);
                File::create_new(partial)
            }
            None => File::create(path),
        };
        let file = file.with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { path: path.to_owned(), partial, file })
    }

    /// Writes the content and gives the file its name.
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub fn finish(mut self, bytes: &[u8]) -> Result<()> {
        let written = self.file.write_all(bytes);
        written.with_context(|| format!("cannot write {}", self.path.display()))?;
        self.complete()
    }

    /// Gives the file its name, with what was written to it through [`std::io::Write`].
    ///
    /// # Errors
    /// A place that cannot be written to.
    pub fn complete(self) -> Result<()> {
        let complete = || {
            if let Some(partial) = &self.partial {
                self.file.sync_all()?;
                fs::rename(partial, &self.path)?;
                sync_folder(&self.path)?;
            }
            Ok::<(), std::io::Error>(())
        };
        complete().with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Where it will be.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Seek for OutputFile {
    fn seek(&mut self, place: SeekFrom) -> io::Result<u64> {
        self.file.seek(place)
    }
}

impl Drop for OutputFile {
    fn drop(&mut self) {
        // After a failure or an early end; a finished file has lost this name.
        if let Some(partial) = &self.partial {
            let _ = fs::remove_file(partial);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_file_that_is_not_finished_leaves_the_old_one_as_it_was() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("trace");
        write_whole(&path, b"old").unwrap();
        drop(OutputFile::create(&path).unwrap());
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn files_that_never_end_or_are_too_large_are_refused_unread() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("sparse");
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        assert!(read_bytes(&path).unwrap_err().to_string().contains("more than any file"));
        assert!(read_text(&path).unwrap_err().to_string().contains("larger than"));
        assert!(read_bytes(Path::new("/dev/zero")).unwrap_err().to_string().contains("not a regular file"));
        assert!(read_text(Path::new("/dev/zero")).unwrap_err().to_string().contains("larger than"));
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

    #[test]
    fn devices_are_written_to_and_stay_devices() {
        write_whole(Path::new("/dev/null"), b"gone").unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());
        assert!(write_whole(Path::new("/dev/full"), b"no room").is_err());
    }
}
