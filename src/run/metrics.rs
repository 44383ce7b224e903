//! `metrics.csv`: one row per iteration, appended, and on the disk no later than the checkpoint of its iteration.
//!
//! Rows after the checkpoint that is resumed from are cut off, so that no row is missing or duplicated.

use std::borrow::Cow;
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::folder::METRICS;
use crate::os::expect_named;
use crate::os::{make_own, sync_folder, unused_name};

/// The most bytes of a row. This program writes none that is longer, and the rest of a longer one is not a row either.
pub(super) const LONGEST_ROW: u64 = 1 << 20;

/// The table being written.
pub(super) struct Metrics {
    path: PathBuf,
    file: File,
    /// Bytes of the header and of whole rows.
    length: u64,
    /// The indices of the columns that the table has, in a table that was begun when there were fewer.
    columns: Option<Vec<usize>>,
}

impl Metrics {
    /// Opens or creates the table with this header, to continue after the rows of these iterations. Also returns notes about rows
    /// that are cut off or missing. A table that lacks some of the columns continues without them; one with a different header is
    /// kept under another name.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub(super) fn open(path: &Path, header: &str, iterations: Range<u64>) -> Result<(Self, Vec<String>)> {
        let context = || format!("cannot write {}", path.display());
        let (mut found, mut notes) = (Rows::default(), Vec::new());
        let mut expected = iterations.end - iterations.start;
        match File::open(path) {
            Ok(file) => match rows(file, header, iterations.end).with_context(context)? {
                Some(rows) => found = rows,
                None => {
                    let aside = unused_name(&path.with_extension(format!("before-{}.csv", iterations.end)));
                    fs::rename(path, &aside).with_context(context)?;
                    notes.push(format!(
                        "{METRICS} has a different header from the one this program writes; it was renamed to {}",
                        aside.display()
                    ));
                    expected = 0;
                }
            },
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(error).with_context(context),
        }
        if let Some(columns) = &found.columns {
            let lacking = header.split(',').enumerate().filter(|(place, _)| !columns.contains(place));
            let lacking: Vec<&str> = lacking.map(|(_, name)| name).collect();
            notes.push(format!("{METRICS} was begun without these columns and continues so: {}", lacking.join(", ")));
        }
        if found.dropped > 0 {
            notes.push(format!("{} rows of {METRICS} after iteration {} are dropped", found.dropped, iterations.end));
        }
        if found.kept < expected && fs::metadata(path).map_or(true, |facts| facts.is_file()) {
            let lacking = expected - found.kept;
            notes.push(format!("{METRICS} lacks {lacking} of the {expected} rows up to iteration {}", iterations.end));
        }
        make_own(path).with_context(context)?;
        let file = OpenOptions::new().write(true).create(true).truncate(false).open(path).with_context(context)?;
        let mut metrics = Self { path: path.to_owned(), file, length: found.length, columns: found.columns };
        metrics.repair().with_context(context)?;
        if found.length == 0 {
            metrics.row(&format!("{header}\n"))?;
            sync_folder(path).with_context(context)?;
        }
        Ok((metrics, notes))
    }

    /// Adds a row of all columns, which ends with a line feed.
    ///
    /// # Errors
    /// Fails if the file cannot be written; [`Metrics::repair`] must succeed before the next row.
    pub(super) fn row(&mut self, row: &str) -> Result<()> {
        let mut row = Cow::from(row);
        if let Some(columns) = &self.columns {
            let cells: Vec<&str> = row.trim_end().split(',').collect();
            row = (columns.iter().map(|&i| cells[i]).collect::<Vec<_>>().join(",") + "\n").into();
        }
        self.file.write_all(row.as_bytes()).with_context(|| format!("cannot write {}", self.path.display()))?;
        self.length += row.len() as u64;
        Ok(())
    }

    /// Cuts off a row that was written only in part.
    fn repair(&mut self) -> std::io::Result<()> {
        if self.file.metadata()?.is_file() {
            self.file.set_len(self.length)?;
        }
        self.file.seek(SeekFrom::Start(self.length)).map(drop)
    }

    /// Ensures that all rows are on the disk, in a file that still has its name.
    ///
    /// # Errors
    /// Fails if the file cannot be written, or was deleted.
    pub(super) fn sync(&mut self) -> Result<()> {
        expect_named(&self.path, &self.file)?;
        let synced = self.repair().and_then(|()| self.file.sync_data());
        synced.with_context(|| format!("cannot write {}", self.path.display()))
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
    /// The indices of its columns among the expected ones, if it has fewer.
    columns: Option<Vec<usize>>,
}

/// Counts the rows of a table up to an iteration and after it; returns `None` if the header is different.
fn rows(file: File, header: &str, iterations: u64) -> std::io::Result<Option<Rows>> {
    // A device has no rows to keep, and may have no end.
    if !file.metadata()?.is_file() {
        return Ok(Some(Rows::default()));
    }
    let (mut reader, mut line) = (BufReader::new(file), Vec::new());
    let mut next = |line: &mut Vec<u8>| {
        line.clear();
        reader.by_ref().take(LONGEST_ROW).read_until(b'\n', line)
    };
    if next(&mut line)? == 0 {
        return Ok(Some(Rows::default()));
    }
    let mut columns = None;
    match line.strip_suffix(b"\n") {
        Some(found) if found == header.as_bytes() => {}
        // A header that was written only in part, e.g. on a full disk.
        None if header.as_bytes().starts_with(&line) => return Ok(Some(Rows::default())),
        found => match found.and_then(|found| among(found, header)) {
            Some(places) => columns = Some(places),
            None => return Ok(None),
        },
    }
    let commas = line.iter().filter(|&&byte| byte == b',').count();
    let mut found = Rows { length: line.len() as u64, columns, ..Rows::default() };
    while next(&mut line)? > 0 {
        let number =
            line.split(|&byte| byte == b',').next().and_then(|cell| str::from_utf8(cell).ok()?.parse::<u64>().ok());
        let whole = line.ends_with(b"\n") && line.iter().filter(|&&byte| byte == b',').count() == commas;
        if found.dropped == 0 && whole && number.is_some_and(|number| number <= iterations) {
            (found.length, found.kept) = (found.length + line.len() as u64, found.kept + 1);
        } else {
            found.dropped += 1;
        }
    }
    Ok(Some(found))
}

/// Returns the indices of these columns among the expected ones; `None` if one is not among them, or if the order differs.
fn among(columns: &[u8], expected: &str) -> Option<Vec<usize>> {
    let mut places = expected.split(',').enumerate();
    let place = |column: &[u8]| places.find(|(_, name)| name.as_bytes() == column).map(|(place, _)| place);
    columns.split(|&byte| byte == b',').map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(rows: &str) -> (tempfile::TempDir, PathBuf) {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("metrics.csv");
        fs::write(&path, format!("iteration,loss\n{rows}")).unwrap();
        (place, path)
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
            let (mut metrics, notes) = Metrics::open(&path, "iteration,loss", 0..iterations).unwrap();
            metrics.row("9,9\n").unwrap();
            let said = |text: &str| notes.iter().any(|note| note.contains(text));
            assert_eq!(said("dropped"), dropped > 0, "{notes:?}");
            let lacking = iterations - kept.lines().count() as u64;
            assert_eq!(said(&format!("lacks {lacking} of the {iterations} rows")), lacking > 0, "{notes:?}");
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("iteration,loss\n{kept}9,9\n"));
        }
    }

    #[test]
    fn a_table_with_other_columns_is_kept_under_another_name() {
        let (place, path) = table("1,0.5\n");
        for columns in ["iteration,return", "iteration,loss"] {
            let (_, notes) = Metrics::open(&path, columns, 0..1).unwrap();
            assert!(notes.len() == 1 && notes[0].contains("different header"), "{notes:?}");
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("{columns}\n"));
        }
        // Both tables are kept, although they were replaced at the same iteration.
        let old = ["metrics.before-1.csv", "metrics.before-1-2.csv"];
        let old = old.map(|name| fs::read_to_string(place.path().join(name)).unwrap());
        assert_eq!(old, ["iteration,loss\n1,0.5\n", "iteration,return\n"]);
    }

    #[test]
    fn a_table_that_was_begun_with_fewer_columns_continues_without_the_new_ones() {
        let (place, path) = table("1,0.5\n2,0.25\n");
        let (mut metrics, notes) = Metrics::open(&path, "iteration,speed,loss,drops", 0..1).unwrap();
        assert!(notes.len() == 2 && notes[0].contains("speed, drops") && notes[1].contains("1 rows"), "{notes:?}");
        metrics.row("2,9,0.125,\n").unwrap();
        metrics.sync().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "iteration,loss\n1,0.5\n2,0.125\n");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_header_that_did_not_fit_is_written_again() {
        let (place, path) = table("");
        fs::write(&path, "iterat").unwrap();
        Metrics::open(&path, "iteration,loss", 0..3).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "iteration,loss\n");
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_table_that_was_deleted_or_replaced_is_noticed() {
        let (_place, path) = table("");
        let (mut metrics, _) = Metrics::open(&path, "iteration,loss", 0..0).unwrap();
        metrics.sync().unwrap();
        fs::remove_file(&path).unwrap();
        metrics.row("1,2\n").unwrap();
        assert!(metrics.sync().is_err());
        fs::write(&path, "of somebody else").unwrap();
        assert!(metrics.sync().is_err());
    }
}
