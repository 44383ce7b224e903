//! `metrics.csv`: one row per iteration, appended, and on the disk no later than the checkpoint of its iteration.
//!
//! Rows after the checkpoint that is resumed from are cut off, so that no row is missing or duplicated.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::checkpoints::expect_no_link;
use super::folder::METRICS;
use crate::os::{Cannot, expect_named, make_own, put_aside, shown, sync, sync_folder};

/// The most bytes of a row. This program writes none that is longer, and the rest of a longer one is not a row either.
const LONGEST_ROW: u64 = 1 << 20;

/// The table being written.
pub struct Metrics {
    path: PathBuf,
    file: File,
    /// Bytes of the header and of whole rows.
    length: u64,
}

impl Metrics {
    /// Opens or creates the table with this header, to continue after the rows of these iterations. Tells of rows
    /// that are cut off or missing. A table with a different header is kept under another name.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn open(
        path: &Path,
        header: &str,
        iterations: Range<u64>,
        mut tell: impl FnMut(&str),
    ) -> Result<Self> {
        expect_no_link(path)?;
        let found = match File::open(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Some(Rows::default()),
            file => file
                .and_then(|file| rows(file, header, iterations.end))
                .cannot("write", path)?,
        };
        let mut expected = iterations.end - iterations.start;
        if found.is_none() {
            let extension = format!("before-{}.csv", iterations.end);
            let aside = put_aside(path, &extension).cannot("write", path)?;
            tell(&format!(
                "{METRICS} has a different header from the one this program writes; it was renamed to {}",
                shown(&aside).display()
            ));
            expected = 0;
        }
        let found = found.unwrap_or_default();
        if found.dropped > 0 {
            tell(&format!(
                "{} rows of {METRICS} after iteration {} are dropped",
                found.dropped, iterations.end
            ));
        }
        make_own(path)?;
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .cannot("write", path)?;
        if found.kept < expected && path.is_file() {
            tell(&format!(
                "{METRICS} lacks {} of the {expected} rows up to iteration {}",
                expected - found.kept,
                iterations.end
            ));
        }
        let mut metrics = Self {
            path: path.to_owned(),
            file,
            length: found.length,
        };
        metrics.repair().cannot("write", path)?;
        if found.length == 0 {
            metrics.row(&format!("{header}\n"))?;
            sync_folder(path);
        }
        Ok(metrics)
    }

    /// Adds a row, which ends with a line feed.
    ///
    /// # Errors
    /// Fails if the file cannot be written. [`Metrics::repair`] must succeed before the next row.
    pub fn row(&mut self, row: &str) -> Result<()> {
        self.file
            .write_all(row.as_bytes())
            .cannot("write", &self.path)?;
        self.length += row.len() as u64;
        Ok(())
    }

    /// Cuts off a row that was written only in part.
    fn repair(&mut self) -> std::io::Result<()> {
        let facts = self.file.metadata()?;
        if facts.is_file() && facts.len() != self.length {
            self.file.set_len(self.length)?;
        }
        self.file.seek(SeekFrom::Start(self.length)).map(drop)
    }

    /// Ensures that all rows are on the disk, in a file that still has its name.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or was deleted.
    pub fn sync(&mut self) -> Result<()> {
        expect_named(&self.path, &self.file)?;
        self.repair()
            .and_then(|()| sync(&self.file))
            .cannot("write", &self.path)
    }
}

/// The extent of the rows in a table.
#[derive(Default)]
struct Rows {
    /// Bytes of the header and of the rows that are kept.
    length: u64,
    /// The number of rows up to an iteration, which are kept.
    kept: u64,
    /// The number of rows after them.
    dropped: u64,
}

/// Counts the rows of a table up to an iteration and after it. Returns `None` if the header is different.
fn rows(file: File, header: &str, iterations: u64) -> std::io::Result<Option<Rows>> {
    // A device has no rows to keep, and may have no end.
    if !file.metadata()?.is_file() {
        return Ok(Some(Rows::default()));
    }
    let mut reader = BufReader::new(file);
    let mut line = Vec::new();
    let length = next_row(&mut reader, &mut line)?;
    // The header may have been written only in part, e.g. on a full disk.
    if !line.ends_with(b"\n") && header.as_bytes().starts_with(&line) {
        return Ok(Some(Rows::default()));
    }
    if line.strip_suffix(b"\n") != Some(header.as_bytes()) {
        return Ok(None);
    }
    let commas = |line: &[u8]| line.iter().filter(|&&byte| byte == b',').count();
    let columns = commas(&line);
    let mut found = Rows {
        length,
        ..Rows::default()
    };
    while let read @ 1.. = next_row(&mut reader, &mut line)? {
        let number = line
            .split(|&byte| byte == b',')
            .next()
            .and_then(|cell| str::from_utf8(cell).ok()?.parse().ok());
        let whole = line.ends_with(b"\n") && commas(&line) == columns;
        if found.dropped == 0 && whole && number.is_some_and(|number: u64| number <= iterations) {
            found.length += read;
            found.kept += 1;
        } else {
            found.dropped += 1;
        }
    }
    Ok(Some(found))
}

/// Reads the next row into `row`, with its line feed, and returns its length, or 0 at the end. The rest of a row that is too
/// long is read as another one.
pub fn next_row(reader: &mut impl BufRead, row: &mut Vec<u8>) -> std::io::Result<u64> {
    row.clear();
    reader
        .take(LONGEST_ROW)
        .read_until(b'\n', row)
        .map(|length| length as u64)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn table(rows: &str) -> (tempfile::TempDir, PathBuf) {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("metrics.csv");
        fs::write(&path, format!("iteration,loss\n{rows}")).unwrap();
        (place, path)
    }

    fn open(path: &Path, header: &str, iterations: Range<u64>) -> (Metrics, Vec<String>) {
        let mut notes = Vec::new();
        let metrics =
            Metrics::open(path, header, iterations, |note| notes.push(note.to_owned())).unwrap();
        (metrics, notes)
    }

    #[test]
    fn rows_behind_the_checkpoint_and_half_rows_are_cut_off() {
        for (rows, iterations, dropped, kept) in [
            ("1,0.5\n2,0.25\n3,0.1\n", 2, 1, "1,0.5\n2,0.25\n"),
            ("1,0.5\n2,0.25\n3", 3, 1, "1,0.5\n2,0.25\n"),
            ("1,0.5\n2\n3,0.1\n", 3, 2, "1,0.5\n"),
            ("", 3, 0, ""),
        ] {
            let (_place, path) = table(rows);
            let (mut metrics, notes) = open(&path, "iteration,loss", 0..iterations);
            metrics.row("9,9\n").unwrap();
            let said = |text: &str| notes.iter().any(|note| note.contains(text));
            assert_eq!(said("dropped"), dropped > 0, "{notes:?}");
            let lacking = iterations - kept.lines().count() as u64;
            assert_eq!(
                said(&format!("lacks {lacking} of the {iterations} rows")),
                lacking > 0,
                "{notes:?}"
            );
            assert_eq!(
                fs::read_to_string(&path).unwrap(),
                format!("iteration,loss\n{kept}9,9\n")
            );
        }
    }

    #[test]
    fn a_table_with_other_columns_is_kept_under_another_name() {
        let (place, path) = table("1,0.5\n");
        for columns in ["iteration,return", "iteration,loss"] {
            let (_, notes) = open(&path, columns, 0..1);
            assert!(
                notes.len() == 1 && notes[0].contains("different header"),
                "{notes:?}"
            );
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("{columns}\n"));
        }
        // Both tables are kept, although they were replaced at the same iteration.
        let old = ["metrics.before-1.csv", "metrics.before-1-2.csv"];
        let old = old.map(|name| fs::read_to_string(place.path().join(name)).unwrap());
        assert_eq!(old, ["iteration,loss\n1,0.5\n", "iteration,return\n"]);
    }

    #[test]
    fn a_header_that_did_not_fit_is_written_again() {
        let (place, path) = table("");
        fs::write(&path, "iterat").unwrap();
        open(&path, "iteration,loss", 0..3);
        assert_eq!(fs::read_to_string(&path).unwrap(), "iteration,loss\n");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_table_that_was_deleted_or_replaced_is_noticed() {
        let (_place, path) = table("");
        let (mut metrics, _) = open(&path, "iteration,loss", 0..0);
        metrics.sync().unwrap();
        fs::remove_file(&path).unwrap();
        metrics.row("1,2\n").unwrap();
        assert!(metrics.sync().is_err());
        fs::write(&path, "of somebody else").unwrap();
        assert!(metrics.sync().is_err());
    }
}
