//! Reading whole files, and checking which file a path names.

#[cfg(target_vendor = "apple")]
use std::ffi::OsString;
use std::fs::{self, File, Metadata};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
#[cfg(target_vendor = "apple")]
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result, ensure};
use flate2::Compression;
use flate2::read::MultiGzDecoder;
use flate2::write::GzEncoder;

/// The most bytes of a text file. A configuration takes a few KiB.
const LARGEST_TEXT: u64 = 1 << 20;

/// The most bytes of a binary file. The largest policy that the settings allow, its optimizer and 65536 environments take less.
const LARGEST_BYTES: u64 = 1 << 30;

/// Where the system lists what is open, or everything, by number. A path through it leads there, whatever its name is.
pub const HANDLES: &str = if cfg!(target_vendor = "apple") {
    "/.vol"
} else {
    "/proc/self/fd"
};

/// The path of an open folder by its number in [`HANDLES`]: that of the handle or, on macOS, those of the volume and of the folder.
pub fn through(handle: &File) -> io::Result<PathBuf> {
    let by_number = if cfg!(target_vendor = "apple") {
        let facts = handle.metadata()?;
        format!("{}/{}", facts.dev(), facts.ino())
    } else {
        handle.as_raw_fd().to_string()
    };
    Ok(Path::new(HANDLES).join(by_number))
}

/// Where the system says that the folder with this path through [`HANDLES`] lies.
#[cfg(target_vendor = "apple")]
pub fn place_of(through: &Path) -> Option<PathBuf> {
    let place = rustix::fs::getpath(File::open(through).ok()?).ok()?;
    Some(OsString::from_vec(place.into_bytes()).into())
}

/// Where the system says that the folder with this path through [`HANDLES`] lies.
#[cfg(not(target_vendor = "apple"))]
pub fn place_of(through: &Path) -> Option<PathBuf> {
    fs::read_link(through).ok()
}

/// An operation on a file or folder, whose error says what could not be done.
pub trait Cannot<T> {
    /// Says that one cannot `do_what` with `path`.
    ///
    /// # Errors
    /// Fails if the operation has failed.
    fn cannot(self, do_what: &str, path: &Path) -> Result<T>;
}

impl<T> Cannot<T> for io::Result<T> {
    fn cannot(self, do_what: &str, path: &Path) -> Result<T> {
        self.with_context(|| format!("cannot {do_what} {}", shown(path).display()))
    }
}

/// A path for a message: one that leads through a handle is given as it would be without, from the working folder if it lies there.
pub fn shown(path: &Path) -> PathBuf {
    let through = || {
        let mut parts = path.strip_prefix(HANDLES).ok()?.components();
        let numbers = if cfg!(target_vendor = "apple") { 2 } else { 1 };
        let by_number: PathBuf = parts.by_ref().take(numbers).collect();
        let folder = place_of(&Path::new(HANDLES).join(by_number))?;
        let whole = folder.join(parts.as_path());
        let here = std::env::current_dir().unwrap_or_default();
        Some(
            whole
                .strip_prefix(here)
                .map(Path::to_owned)
                .unwrap_or(whole),
        )
    };
    through().unwrap_or_else(|| path.to_owned())
}

/// Reads the text of a file.
///
/// # Errors
/// Fails if the file cannot be read, is not UTF-8, or is too large for a configuration.
pub fn read_text(path: &Path) -> Result<String> {
    let mut text = String::new();
    let file = File::open(path).cannot("read", path)?;
    file.take(LARGEST_TEXT + 1)
        .read_to_string(&mut text)
        .cannot("read", path)?;
    ensure!(
        text.len() as u64 <= LARGEST_TEXT,
        "{}: larger than {LARGEST_TEXT} bytes",
        path.display()
    );
    Ok(text)
}

/// Bytes compressed by gzip.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes).expect("memory takes all");
    encoder.finish().expect("memory takes all")
}

/// Reads the bytes of a regular file, which may be compressed by gzip.
///
/// # Errors
/// Fails as [`read_bytes`] does, or if what is compressed is damaged or too large.
pub fn read_unpacked(path: &Path) -> Result<Vec<u8>> {
    let bytes = read_bytes(path)?;
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return Ok(bytes);
    }
    let mut unpacked = Vec::new();
    let decoder = MultiGzDecoder::new(&bytes[..]);
    decoder
        .take(LARGEST_BYTES + 1)
        .read_to_end(&mut unpacked)
        .cannot("unpack", path)?;
    ensure!(
        unpacked.len() as u64 <= LARGEST_BYTES,
        "{}: its content is larger than any file of this program",
        path.display()
    );
    Ok(unpacked)
}

/// Reads the bytes of a regular file.
///
/// # Errors
/// Fails if the file cannot be read, is not a regular file, or is larger than any file of this program.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let facts = fs::metadata(path).cannot("read", path)?;
    ensure!(
        facts.is_file(),
        "cannot read {}: not a regular file",
        path.display()
    );
    let size = facts.len();
    ensure!(
        size <= LARGEST_BYTES,
        "{}: {size} bytes is larger than any file of this program",
        path.display()
    );
    let mut bytes = Vec::new();
    let room = bytes.try_reserve_exact(size as usize);
    room.with_context(|| {
        format!(
            "{}: there is no memory for its {size} bytes",
            path.display()
        )
    })?;
    File::open(path)
        .and_then(|file| file.take(LARGEST_BYTES).read_to_end(&mut bytes))
        .cannot("read", path)?;
    Ok(bytes)
}

/// What changes when a file is replaced or written to: its number, and the time of the last change.
pub type Stamp = (u64, SystemTime);

/// The stamp of a file, if it is there.
pub fn stamp(path: &Path) -> Option<Stamp> {
    let facts = fs::metadata(path).ok()?;
    Some((facts.ino(), facts.modified().ok()?))
}

/// Checks that `path` still names this open file, which may have been deleted or replaced.
///
/// # Errors
/// Fails if it does not.
pub fn expect_named(path: &Path, file: &File) -> Result<()> {
    let named = fs::metadata(path).cannot("find", path)?;
    let held = file.metadata().cannot("find", path)?;
    ensure!(
        identity(&named) == identity(&held),
        "{} has been replaced",
        shown(path).display()
    );
    Ok(())
}

/// Whether two paths name the same file.
pub fn same_file(a: &Path, b: &Path) -> bool {
    let named = |path| fs::metadata(path).ok().map(|facts| identity(&facts));
    named(a).is_some() && named(a) == named(b)
}

/// The device and the number of a file on it.
fn identity(facts: &Metadata) -> (u64, u64) {
    (facts.dev(), facts.ino())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_never_end_or_are_too_large_are_refused_unread() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("sparse");
        File::create(&path).unwrap().set_len(1 << 40).unwrap();
        assert!(
            read_bytes(&path)
                .unwrap_err()
                .to_string()
                .contains("larger than any file")
        );
        assert!(
            read_text(&path)
                .unwrap_err()
                .to_string()
                .contains("larger than")
        );
        assert!(
            read_bytes(Path::new("/dev/zero"))
                .unwrap_err()
                .to_string()
                .contains("not a regular file")
        );
        assert!(
            read_text(Path::new("/dev/zero"))
                .unwrap_err()
                .to_string()
                .contains("larger than")
        );
    }
}
