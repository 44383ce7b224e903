//! Learning curves: metrics of one or more runs, smoothed, over control steps or hours.

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};

use crate::cli::{Along, PlotArgs};
use crate::run::{self, Chart, Curve, OutputFile, Picture, Subplot};

/// The metrics that are drawn by default: the headline, and what explains it.
const DEFAULT: [&str; 4] = ["eval/goals", "episode/goals", "episode/rot_dist", "episode/drop_rate"];

/// The default size in pixels: the width of the picture, and the height of a panel.
const SIZE: [u32; 2] = [800, 260];

/// The values of a run, column by column.
type Table = Vec<Vec<f64>>;

/// Draws the curves. Of several runs, those that cannot be drawn are skipped with a warning, e.g. one that was stopped in its
/// first iteration, or is too old to have a column.
///
/// # Errors
/// Fails if no run has readable metrics with these columns and at least one row, or if the picture cannot be written.
pub fn plot(args: &PlotArgs) -> Result<()> {
    // Opened before anything is read, so that a path that cannot be written to is reported at once.
    let output = OutputFile::create(&args.out)?;
    let asked: Vec<&str> = args.metric.iter().map(String::as_str).collect();
    let metrics = if asked.is_empty() { DEFAULT.to_vec() } else { asked };
    let mut panels: Vec<Subplot> =
        metrics.iter().map(|name| Subplot { name: (*name).to_owned(), curves: Vec::new() }).collect();
    let tables = tables(&args.runs, &metrics)?;
    // A window is as many steps for all runs, so that a table with fewer rows, as in docs/metrics, is not smoothed more.
    let in_row =
        tables.iter().filter_map(|(_, table)| Some(table[0].get(1)? - table[0][0])).fold(f64::INFINITY, f64::min);
    let window = args.smooth as f64 * in_row;
    for (place, table) in &tables {
        let [steps, collect_s, update_s, values @ ..] = &table[..] else {
            unreachable!("one column for each requested name")
        };
        let along = match args.along {
            Along::Steps => steps.iter().map(|steps| steps / 1e6).collect(),
            Along::Hours => hours(collect_s, update_s),
        };
        let lengths = lengths_of_windows(steps, window);
        for (panel, values) in panels.iter_mut().zip(values) {
            panel.curves.push(Curve { name: name_of(place), points: smooth(&along, values, &lengths) });
        }
    }
    let along = match args.along {
        Along::Steps => "million control steps",
        Along::Hours => "hours of collecting and learning",
    };
    let size = args.size.unwrap_or([SIZE[0], SIZE[1] * panels.len() as u32]);
    Chart { along: along.to_owned(), panels, size }.write(output)?;
    run::say(&format!("{}: {} runs", args.out.display(), tables.len()));
    Ok(())
}

/// Reads the columns of each run that can be drawn, and warns of each that cannot.
///
/// # Errors
/// Fails if none of them can be drawn.
fn tables<'a>(runs: &'a [PathBuf], metrics: &[&str]) -> Result<Vec<(&'a Path, Table)>> {
    let mut tables = Vec::new();
    for (i, place) in runs.iter().enumerate() {
        match rows(place, metrics) {
            Ok(table) => tables.push((place.as_path(), table)),
            Err(error) if tables.is_empty() && i + 1 == runs.len() => return Err(error),
            Err(error) => run::say(&format!("warning: {error:#}; skipped")),
        }
    }
    Ok(tables)
}

/// Returns the numbers of consecutive rows that lie in the same window of so many steps.
fn lengths_of_windows(steps: &[f64], window: f64) -> Vec<usize> {
    let first = steps[0];
    // Rounded, because steps are whole numbers and the window is a multiple of their difference.
    steps
        .chunk_by(|a, b| ((a - first) / window + 1e-9).floor() == ((b - first) / window + 1e-9).floor())
        .map(<[f64]>::len)
        .collect()
}

/// Returns the hours until the end of each iteration of a run.
fn hours(collect_s: &[f64], update_s: &[f64]) -> Vec<f64> {
    let mut seconds = 0.0;
    let until = |(collect, update): (&f64, &f64)| {
        seconds += collect + update;
        seconds / 3600.0
    };
    collect_s.iter().zip(update_s).map(until).collect()
}

/// Reads columns of a run, with one row for each iteration: the control steps at its end, the seconds of its two parts, and these
/// metrics.
fn rows(place: &Path, metrics: &[&str]) -> Result<Table> {
    let columns = [&["env_steps", "time/collect_s", "time/update_s"], metrics].concat();
    let table = run::read_metrics(place, &columns)?;
    ensure!(!table[0].is_empty(), "{}: no rows yet", place.display());
    Ok(table)
}

/// Returns the name of a run: that of its folder, with control characters replaced.
fn name_of(place: &Path) -> String {
    let whole = place.canonicalize().unwrap_or_else(|_| place.to_owned());
    let folder = if whole.is_dir() { Some(whole.as_path()) } else { whole.parent() };
    let name =
        folder.and_then(Path::file_name).map_or_else(|| place.display().to_string(), |n| n.to_string_lossy().into());
    name.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect()
}

/// Returns the means over consecutive windows of these numbers of rows. Rows without a value are skipped, as are windows with
/// only such rows.
fn smooth(along: &[f64], values: &[f64], lengths: &[usize]) -> Vec<[f64; 2]> {
    let mut begin = 0;
    let means = lengths.iter().filter_map(|length| {
        let window = begin..begin + length;
        begin = window.end;
        let (along, values) = (&along[window.clone()], &values[window]);
        let mean = |values: &[f64]| {
            let known: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
            (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
        };
        Some([mean(along)?, mean(values)?])
    });
    means.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_the_mean_of_the_rows_that_have_a_value() {
        let along = [1.0, 2.0, 3.0, 4.0, 5.0];
        let values = [1.0, f64::NAN, f64::NAN, f64::NAN, 7.0];
        assert_eq!(smooth(&along, &values, &[2, 2, 1]), [[1.5, 1.0], [5.0, 7.0]]);
        assert_eq!(smooth(&along, &values, &[5]), [[3.0, 4.0]]);
    }

    #[test]
    fn a_window_is_as_many_steps_in_a_table_with_fewer_rows() {
        let rows = |step: u32, count: u32| (1..=count).map(|i| f64::from(step * i)).collect::<Vec<f64>>();
        assert_eq!(lengths_of_windows(&rows(16_384, 7), 3.0 * 16_384.0), [3, 3, 1]);
        assert_eq!(lengths_of_windows(&rows(100, 5), 250.0), [3, 2]);
        assert_eq!(lengths_of_windows(&rows(400, 3), 250.0), [1, 1, 1]);
        assert_eq!(lengths_of_windows(&[5.0], f64::INFINITY), [1]);
    }
}
