//! Files that are read whole, and written whole or not at all.

use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

/// The text of a file.
///
/// # Errors
/// A file that cannot be read or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// The bytes of a file.
///
/// # Errors
/// A file that cannot be read.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    fs::read(path).with_context(|| format!("cannot read {}", path.display()))
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
        let partial = (!special).then(|| {
            let mut name = path.as_os_str().to_owned();
            name.push(".partial");
            PathBuf::from(name)
        });
        let file = File::create(partial.as_deref().unwrap_or(path));
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
    fn devices_are_written_to_and_stay_devices() {
        write_whole(Path::new("/dev/null"), b"gone").unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());
        assert!(write_whole(Path::new("/dev/full"), b"no room").is_err());
    }
}
