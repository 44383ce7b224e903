//! Learning curves: metrics of one or more runs, smoothed, along control steps or hours.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::cli::{Along, PlotArgs};
use crate::run::{self, Chart, Curve, OutputFile, Panel};

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
    // Opened before anything is read: a place that cannot be written to is known at once.
    let output = OutputFile::create(&args.out)?;
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
        let [steps, collect_s, update_s, values @ ..] = &table[..] else {
            unreachable!("as many columns as were asked for")
        };
        let along = match args.along {
            Along::Steps => steps.iter().map(|steps| steps / 1e6).collect(),
            Along::Hours => hours(collect_s, update_s),
        };
        for (panel, values) in panels.iter_mut().zip(values) {
            panel.curves.push(Curve { name: name_of(place), points: smooth(&along, values, args.smooth) });
        }
    }
    let along = match args.along {
        Along::Steps => "million control steps",
        Along::Hours => "hours of collecting and learning",
    };
    let size = args.size.unwrap_or([SIZE[0], SIZE[1] * panels.len() as u32]);
    Chart { along: along.to_owned(), panels, size }.write(output)?;
    run::say(&format!("{}: {drawn} runs", args.out.display()));
    Ok(())
}

/// Of each iteration of a run the hours until its end.
fn hours(collect_s: &[f64], update_s: &[f64]) -> Vec<f64> {
    let mut seconds = 0.0;
    let until = |(collect, update): (&f64, &f64)| {
        seconds += collect + update;
        seconds / 3600.0
    };
    collect_s.iter().zip(update_s).map(until).collect()
}

/// Of each iteration of a run the control steps at its end, the seconds of its two parts, and these metrics: column by column.
fn rows(place: &Path, metrics: &[&str]) -> Result<Vec<Vec<f64>>> {
    let columns = [&["env_steps", "time/collect_s", "time/update_s"], metrics].concat();
    let table = run::read_metrics(place, &columns)?;
    ensure!(!table[0].is_empty(), "{}: there are no rows yet", place.display());
    Ok(table)
}

/// The name of a run: that of its folder, without what no picture can hold.
fn name_of(place: &Path) -> String {
    let whole = place.canonicalize().unwrap_or_else(|_| place.to_owned());
    let folder = if whole.is_dir() { Some(whole.as_path()) } else { whole.parent() };
    let name =
        folder.and_then(Path::file_name).map_or_else(|| place.display().to_string(), |n| n.to_string_lossy().into());
    name.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect()
}

/// Means over windows of `width` rows, one after the other; rows without a value are passed over, and so are windows of them.
fn smooth(along: &[f64], values: &[f64], width: usize) -> Vec<[f64; 2]> {
    let windows = along.chunks(width).zip(values.chunks(width));
    let means = windows.filter_map(|(along, values)| {
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
        assert_eq!(smooth(&along, &values, 2), [[1.5, 1.0], [5.0, 7.0]]);
        assert_eq!(smooth(&along, &values, 10), [[3.0, 4.0]]);
    }
}
