//! Learning curves: metrics of one or more runs, smoothed, along control steps or hours.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::cli::{Along, PlotArgs};
use crate::run::{self, Chart, Curve, Panel};

/// What is drawn when nothing else is asked for: the headline, and what explains it.
const DEFAULT: [&str; 4] = ["eval/goals", "episode/goals", "episode/rot_dist", "episode/drop_rate"];

/// Pixels of a picture whose size is not asked for: its width, and the height of a panel.
const SIZE: [u32; 2] = [800, 260];

/// Draws the curves as asked. Of several runs those that cannot be drawn are left out, with a warning: one that was stopped in its
/// first iteration, or was made before there was such a column.
///
/// # Errors
/// No run with metrics that can be read, have the columns and a row; a picture that cannot be written.
pub fn plot(args: &PlotArgs) -> Result<()> {
    let asked: Vec<&str> = args.metric.iter().map(String::as_str).collect();
    let metrics = if asked.is_empty() { DEFAULT.to_vec() } else { asked };
    let mut panels: Vec<Panel> =
        metrics.iter().map(|name| Panel { name: (*name).to_owned(), curves: Vec::new() }).collect();
    let mut drawn = 0;
    for (i, place) in args.runs.iter().enumerate() {
        let table = match rows(place, &metrics) {
            Ok(table) => table,
            // The last hope.
            Err(error) if drawn == 0 && i + 1 == args.runs.len() => return Err(error),
            Err(error) => {
                run::say(&format!("warning: {error:#}; it is left out"));
                continue;
            }
        };
        drawn += 1;
        let mut seconds = 0.0;
        let mut along = Vec::with_capacity(table.len());
        for row in &table {
            seconds += row[1] + row[2];
            along.push(match args.along {
                Along::Steps => row[0] / 1e6,
                Along::Hours => seconds / 3600.0,
            });
        }
        for (i, panel) in panels.iter_mut().enumerate() {
            let values: Vec<f64> = table.iter().map(|row| row[3 + i]).collect();
            panel.curves.push(Curve { name: name_of(place), points: smooth(&along, &values, args.smooth) });
        }
    }
    let along = match args.along {
        Along::Steps => "million control steps",
        Along::Hours => "hours of collecting and learning",
    };
    let size = args.size.unwrap_or([SIZE[0], SIZE[1] * panels.len() as u32]);
    Chart { along: along.to_owned(), panels, size }.write(&args.out)?;
    run::say(&format!("{}: {drawn} runs", args.out.display()));
    Ok(())
}

/// Of each iteration of a run: the control steps at its end, the seconds of its two parts, and these metrics.
fn rows(place: &Path, metrics: &[&str]) -> Result<Vec<Vec<f64>>> {
    let columns = [&["env_steps", "time/collect_s", "time/update_s"], metrics].concat();
    let table = run::read_metrics(place, &columns)?;
    ensure!(!table.is_empty(), "{}: there are no rows yet", place.display());
    Ok(table)
}

/// The name of a run: that of its folder.
fn name_of(place: &Path) -> String {
    let whole = place.canonicalize().unwrap_or_else(|_| place.to_owned());
    let folder = if whole.is_dir() { Some(whole.as_path()) } else { whole.parent() };
    folder.and_then(Path::file_name).map_or_else(|| place.display().to_string(), |name| name.to_string_lossy().into())
}

/// Means over windows of `width` rows, one after the other; rows without a value are passed over, and so are windows of them.
fn smooth(along: &[f64], values: &[f64], width: usize) -> Vec<[f64; 2]> {
    let windows = along.chunks(width).zip(values.chunks(width));
    let means = windows.filter_map(|(along, values)| {
        let known: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        (!known.is_empty()).then(|| [mean(along), mean(&known)])
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
        assert_eq!(smooth(&along, &values, 2), [[1.5, 1.0], [5.0, 7.0]]);
        assert_eq!(smooth(&along, &values, 10), [[3.0, 4.0]]);
    }
}
