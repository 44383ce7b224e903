//! Files that are read whole, and the names of files.

use std::fs::{self, File};
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use anyhow::{Context, Result, ensure};

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

#[cfg(test)]
mod tests {
    use super::*;

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
}
