//! Reading `metrics.csv`, for charts. Any file may be given: sizes are bounded, and messages quote little of it.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};

use super::folder::METRICS;
use super::metrics::next_row;
use crate::os::{Cannot, shortened};

/// The most bytes that are read of a table. A million rows take half of this.
const LARGEST_TABLE: u64 = 1 << 30;

/// The most rows that are read for a chart. Ten times the default training has fewer.
const MOST_ROWS: usize = 2_000_000;

/// The largest value that is drawn. No metric comes near it, and a chart cannot be laid out far beyond.
const LARGEST_VALUE: f64 = 1e30;

/// The most columns whose names are kept, and the most characters of such a name.
const MOST_NAMES: usize = 1000;
const LONGEST_NAME: usize = 64;

/// Some columns of a table.
#[derive(Debug)]
pub struct MetricsTable {
    /// The names of all its columns.
    pub names: Vec<String>,
    /// The values of the requested columns that it has, by name.
    pub columns: HashMap<String, Vec<f64>>,
}

impl MetricsTable {
    /// The values of a column, or none if there is no such column.
    pub fn column(&self, name: &str) -> &[f64] {
        self.columns.get(name).map_or(&[], Vec::as_slice)
    }
}

/// The table that `place` means: a file, or the table of a run folder.
pub fn table_of(place: &Path) -> PathBuf {
    if place.is_dir() {
        place.join(METRICS)
    } else {
        place.to_owned()
    }
}

/// Reads these columns of a table. A value is `NaN` if its cell is empty or cannot be drawn: infinite, or beyond 1e30. `place`
/// is the file or its run folder.
///
/// # Errors
/// Fails if the file cannot be read, lacks a required column, has too many rows, or contains anything but numbers.
pub fn read_metrics(place: &Path, required: &[&str], wanted: &[&str]) -> Result<MetricsTable> {
    let path = table_of(place);
    ensure!(
        !place.is_dir() || !path.exists() || path.is_file(),
        "cannot read {}: not a regular file",
        path.display()
    );
    let file = File::open(&path).cannot("read", &path)?.take(LARGEST_TABLE);
    let mut reader = BufReader::with_capacity(1 << 16, file);
    let mut line = Vec::new();
    next_row(&mut reader, &mut line).cannot("read", &path)?;
    let header = String::from_utf8_lossy(&line).trim_end().to_owned();
    let names: Vec<&str> = header.split(',').collect();
    if let Some(column) = required.iter().find(|column| !names.contains(column)) {
        bail!(
            "{} has no column {column}; it has {}",
            path.display(),
            shortened(&header)
        );
    }
    let places: Vec<usize> = required
        .iter()
        .chain(wanted)
        .filter_map(|column| names.iter().position(|name| name == column))
        .collect();
    let columns = read_columns(reader, &path, &places, names.len())?;
    let columns = places
        .iter()
        .map(|&place| names[place].to_owned())
        .zip(columns)
        .collect();
    let known = names
        .iter()
        .filter(|name| name.len() <= LONGEST_NAME)
        .take(MOST_NAMES);
    Ok(MetricsTable {
        names: known.map(|name| (*name).to_owned()).collect(),
        columns,
    })
}

/// Reads the cells at these places of all rows of `path` that have this number of cells.
fn read_columns(
    mut reader: impl BufRead,
    path: &Path,
    places: &[usize],
    count: usize,
) -> Result<Vec<Vec<f64>>> {
    let mut columns = vec![Vec::new(); places.len()];
    let mut line = Vec::new();
    let mut row = 0;
    while next_row(&mut reader, &mut line).cannot("read", path)? > 0 {
        row += 1;
        ensure!(
            row <= MOST_ROWS,
            "{}: more than {MOST_ROWS} rows",
            path.display()
        );
        let cells: Vec<&[u8]> = line.trim_ascii_end().split(|&byte| byte == b',').collect();
        // Skips incomplete rows: the last row of a run in progress may be one.
        if cells.len() != count {
            continue;
        }
        for (column, &place) in columns.iter_mut().zip(places) {
            column.push(number(cells[place]).with_context(|| {
                format!(
                    "{}, row {row}: not a number: `{}`",
                    path.display(),
                    shortened(&String::from_utf8_lossy(cells[place]))
                )
            })?);
        }
    }
    Ok(columns)
}

/// The number in a cell, NaN where there is none or it cannot be drawn.
fn number(cell: &[u8]) -> Result<f64> {
    let number: f64 = if cell.is_empty() {
        f64::NAN
    } else {
        str::from_utf8(cell)?.parse()?
    };
    let is_drawn = number.abs() <= LARGEST_VALUE;
    Ok(if is_drawn { number } else { f64::NAN })
}

/// The value at `x` on the straight lines between `points`, or `None` outside of them.
pub fn value_at(points: &[[f64; 2]], x: f64) -> Option<f64> {
    let after = points.partition_point(|point| point[0] < x);
    let [right, high] = *points.get(after)?;
    if right == x {
        return Some(high);
    }
    let [left, low] = *points.get(after.checked_sub(1)?)?;
    Some(low + (high - low) * (x - left) / (right - left))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn columns_are_read_by_name_with_gaps_and_without_the_row_under_way() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(METRICS);
        fs::write(&path, "iteration,loss\n1,0.5\n2,\n3").unwrap();
        let read = read_metrics(&path, &["loss", "iteration"], &["iteration", "goals"]).unwrap();
        assert!(
            read.columns["loss"][0] == 0.5 && read.columns["loss"][1].is_nan(),
            "{read:?}"
        );
        assert!(
            read.columns["iteration"] == [1.0, 2.0] && !read.columns.contains_key("goals"),
            "{read:?}"
        );
        assert_eq!(read.names, ["iteration", "loss"]);
        assert_eq!(
            read_metrics(place.path(), &["loss"], &[]).unwrap().columns["loss"].len(),
            2
        );
        let refusal = read_metrics(&path, &["goals"], &[])
            .unwrap_err()
            .to_string();
        assert!(
            refusal.contains("no column goals; it has iteration,loss"),
            "{refusal}"
        );
    }

    #[test]
    fn numbers_that_cannot_be_drawn_are_gaps_and_what_is_quoted_is_short() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(METRICS);
        fs::write(&path, "iteration,loss\n1,1.7e308\r\n2,-inf\n3,7\n").unwrap();
        let read = &read_metrics(&path, &["loss"], &[]).unwrap().columns["loss"];
        assert!(
            read[0].is_nan() && read[1].is_nan() && read[2] == 7.0,
            "{read:?}"
        );
        for text in [
            format!("{{{}\n", "\"a\": 1,".repeat(100_000)),
            format!("iteration,loss\n1,{}\n", "x".repeat(99_999)),
        ] {
            fs::write(&path, text).unwrap();
            let refusal = format!("{:#}", read_metrics(&path, &["loss"], &[]).unwrap_err());
            assert!(refusal.len() < 500 + path.as_os_str().len(), "{refusal}");
        }
    }
}
