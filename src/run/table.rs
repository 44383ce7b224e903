//! Reading `metrics.csv`, for charts. Any file may be given: sizes are bounded, and messages quote little of it.

use std::collections::{BTreeSet, HashMap};
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

/// The table that `place` means: a file, or the table of a run folder.
pub fn table_of(place: &Path) -> PathBuf {
    if place.is_dir() { place.join(METRICS) } else { place.to_owned() }
}

/// Reads these columns of a table. A value is `NaN` if its cell is empty or cannot be drawn: infinite, or beyond 1e30. `place`
/// is the file or its run folder.
///
/// # Errors
/// Fails if the file cannot be read, lacks a required column, has too many rows, or contains anything but numbers.
pub fn read_metrics(place: &Path, required: &[&str], wanted: &[&str]) -> Result<MetricsTable> {
    let path = table_of(place);
    let odd = place.is_dir() && path.exists() && !path.is_file();
    ensure!(!odd, "cannot read {}: not a regular file", path.display());
    let file = File::open(&path).cannot("read", &path)?.take(LARGEST_TABLE);
    let mut reader = BufReader::with_capacity(1 << 16, file);
    let mut line = Vec::new();
    next_row(&mut reader, &mut line).cannot("read", &path)?;
    let header = String::from_utf8_lossy(&line).trim_end().to_owned();
    let names: Vec<&str> = header.split(',').collect();
    if let Some(column) = required.iter().find(|column| !names.contains(column)) {
        bail!("{} has no column {column}; it has {}", path.display(), shortened(&header));
    }
    let asked = required.iter().chain(wanted).map(|column| names.iter().position(|name| name == column));
    let places: Vec<usize> = BTreeSet::from_iter(asked.flatten()).into_iter().collect();
    let columns = read_columns(reader, &path, &places, names.len())?;
    let columns = places.iter().map(|&place| names[place].to_owned()).zip(columns).collect();
    let known = names.iter().filter(|name| name.len() <= LONGEST_NAME).take(MOST_NAMES);
    Ok(MetricsTable { names: known.map(|name| (*name).to_owned()).collect(), columns })
}

/// Reads the cells at these places, in rising order, of all rows of `path` that have this number of cells.
fn read_columns(mut reader: impl BufRead, path: &Path, places: &[usize], count: usize) -> Result<Vec<Vec<f64>>> {
    let mut columns = vec![Vec::new(); places.len()];
    let mut line = Vec::new();
    let mut row = 0;
    while next_row(&mut reader, &mut line).cannot("read", path)? > 0 {
        row += 1;
        ensure!(row <= MOST_ROWS, "{}: more than {MOST_ROWS} rows", path.display());
        // Skips incomplete rows: the last row of a run in progress may be one.
        let Some(cells) = cells(line.trim_ascii_end(), places, count) else { continue };
        for (column, cell) in columns.iter_mut().zip(cells) {
            column.push(number(cell).with_context(|| {
                let cell = String::from_utf8_lossy(cell);
                format!("{}, row {row}: not a number: `{}`", path.display(), shortened(&cell))
            })?);
        }
    }
    Ok(columns)
}

/// The cells at these places of a row, in rising order, or `None` if it does not have this number of cells.
fn cells<'a>(row: &'a [u8], places: &[usize], count: usize) -> Option<Vec<&'a [u8]>> {
    let mut rest = row;
    let mut first = 0;
    let mut found = Vec::with_capacity(places.len());
    for &place in places {
        rest = after_commas(rest, place - first)?;
        first = place;
        found.push(rest.split(|&byte| byte == b',').next().unwrap_or_default());
    }
    let left = count.checked_sub(first + 1)?;
    let is_last = after_commas(rest, left).is_some() && after_commas(rest, left + 1).is_none();
    is_last.then_some(found)
}

/// What follows this number of commas, if there are as many. Most of a long row is counted in chunks, a few
/// instructions each.
fn after_commas(row: &[u8], mut count: usize) -> Option<&[u8]> {
    let mut begin = 0;
    for chunk in row.as_chunks::<32>().0 {
        let commas: u8 = chunk.iter().map(|&byte| u8::from(byte == b',')).sum();
        if usize::from(commas) >= count {
            break;
        }
        begin += chunk.len();
        count -= usize::from(commas);
    }
    let commas = row[begin..].iter().enumerate().filter(|(_, byte)| **byte == b',').map(|(at, _)| begin + at + 1);
    [0].into_iter().chain(commas).nth(count).map(|after| &row[after..])
}

/// The number in a cell, NaN where there is none or it cannot be drawn.
fn number(cell: &[u8]) -> Result<f64> {
    let number: f64 = if cell.is_empty() { f64::NAN } else { str::from_utf8(cell)?.parse()? };
    Ok(if number.abs() <= LARGEST_VALUE { number } else { f64::NAN })
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
        assert!(read.columns["loss"][0] == 0.5 && read.columns["loss"][1].is_nan(), "{read:?}");
        assert!(read.columns["iteration"] == [1.0, 2.0] && !read.columns.contains_key("goals"), "{read:?}");
        assert_eq!(read.names, ["iteration", "loss"]);
        assert_eq!(read_metrics(place.path(), &["loss"], &[]).unwrap().columns["loss"].len(), 2);
        let refusal = read_metrics(&path, &["goals"], &[]).unwrap_err().to_string();
        assert!(refusal.contains("no column goals; it has iteration,loss"), "{refusal}");
    }

    #[test]
    fn cells_are_found_by_their_place_in_rows_of_any_length() {
        for width in [0, 1, 2, 31, 32, 33] {
            let of = |place: usize| format!("{place}{}", "x".repeat(width * (place % 3)));
            let row = (0..70).map(of).collect::<Vec<_>>().join(",");
            for places in [&[0, 1, 69][..], &[3, 40], &[68], &[]] {
                let expected: Vec<String> = places.iter().map(|place| of(*place)).collect();
                assert_eq!(
                    cells(row.as_bytes(), places, 70).unwrap(),
                    expected.iter().map(String::as_bytes).collect::<Vec<_>>()
                );
                assert!([1, 69, 71].iter().all(|count| cells(row.as_bytes(), places, *count).is_none()), "{places:?}");
            }
        }
        assert_eq!(cells(b"", &[0], 1), Some(vec![&b""[..]]));
        assert_eq!(cells(b",,", &[0, 2], 3), Some(vec![&b""[..]; 2]));
    }

    #[test]
    fn numbers_that_cannot_be_drawn_are_gaps_and_what_is_quoted_is_short() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join(METRICS);
        fs::write(&path, "iteration,loss\n1,1.7e308\r\n2,-inf\n3,7\n").unwrap();
        let read = &read_metrics(&path, &["loss"], &[]).unwrap().columns["loss"];
        assert!(read[0].is_nan() && read[1].is_nan() && read[2] == 7.0, "{read:?}");
        for text in
            [format!("{{{}\n", "\"a\": 1,".repeat(100_000)), format!("iteration,loss\n1,{}\n", "x".repeat(99_999))]
        {
            fs::write(&path, text).unwrap();
            let refusal = format!("{:#}", read_metrics(&path, &["loss"], &[]).unwrap_err());
            assert!(refusal.len() < 500 + path.as_os_str().len(), "{refusal}");
        }
    }
}
