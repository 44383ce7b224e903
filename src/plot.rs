//! Learning curves: metrics of one or more runs over control steps or hours. Metrics of each iteration are smoothed.
//! Evaluations are drawn at their own steps.

use std::collections::{BTreeSet, HashSet};
use std::iter;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};

use crate::cli::{Along, PlotArgs};
use crate::draw::{Chart, Curve, Picture, PictureFile, Subplot};
use crate::os::{say, shortened, similar};
use crate::run::{self, MetricsTable, value_at};
use crate::statistics::mean;
use crate::tags::tag;

/// A metric, and what is drawn instead where no run has its values.
type Metric<'a> = (&'a str, Option<&'a str>);

/// The metrics that are drawn by default: the headline, and what explains it. They have no values if all episodes are
/// randomised, or in an older table.
const DEFAULT: [Metric; 4] = [
    ("eval/goals", None),
    ("episode/goals", Some("randomized/goals")),
    ("training/turned", Some("episode/rot_dist")),
    ("episode/drop_rate", Some("randomized/drop_rate")),
];

/// The columns that a run must have: control steps at the end of each iteration, and along hours the seconds of its two parts.
const ALONG: [&str; 3] = ["env_steps", "time/collect_s", "time/update_s"];

/// The group of the metrics of evaluations.
const EVALUATION: &str = "eval/";

/// The most iterations that are averaged into a point by default.
const SMOOTH: usize = 50;

/// The most names that are suggested for one that is not known.
const SUGGESTIONS: usize = 3;

/// A run: name, place on the x axis in each row, and the requested columns.
struct RunTable {
    name: String,
    along: Vec<f64>,
    table: MetricsTable,
}

/// Draws the curves. A run that cannot be drawn is skipped with a warning, e.g. one that was stopped in its first iteration.
///
/// # Errors
/// Fails if no run has readable metrics with at least one row, if none has a requested column, or if the picture cannot be written.
pub fn plot(args: &PlotArgs) -> Result<()> {
    // Opened before anything is read, so that a path that cannot be written to is reported at once.
    let places = args.runs.iter().chain(&args.behind);
    let tables = places.map(|place| run::table_of(place));
    run::expect_output(&args.out.path, tables, None)?;
    let output = PictureFile::create(&args.out)?;
    let mut metrics: Vec<Metric> = args.metric.iter().map(|name| (&name[..], None)).collect();
    if metrics.is_empty() {
        metrics.extend(DEFAULT);
    }
    let wanted: Vec<&str> = metrics
        .iter()
        .flat_map(|(usual, other)| iter::chain([*usual], *other))
        .collect();
    let behind = runs(&args.behind, args.along, &wanted);
    let runs = runs(&args.runs, args.along, &wanted);
    expect_columns(&runs, &args.metric)?;
    ensure!(
        !args.seeds || runs.len() > 1,
        "--seeds: there is only one run; give the runs of several seeds"
    );
    let along = match args.along {
        Along::Steps => "million control steps",
        Along::Hours => "hours of collecting and learning",
    };
    let legend = if args.seeds {
        vec![format!(
            "mean of {} seeds, from the lowest to the highest",
            runs.len()
        )]
    } else {
        runs.iter().map(|run| run.name.clone()).collect()
    };
    let window = window(&runs, args.smooth);
    let panels = metrics
        .into_iter()
        .map(|metric| {
            let name = known_name(metric, &runs);
            Subplot {
                behind: behind.iter().map(|run| run.curve(name, window)).collect(),
                ..panel(name, &runs, window, args.seeds)
            }
        })
        .collect();
    Chart {
        legend,
        along,
        panels,
        size: args.size,
    }
    .write(output)?;
    let plural = if runs.len() == 1 { "" } else { "s" };
    say!("{}: {} run{plural}", args.out.path.display(), runs.len());
    Ok(())
}

/// The name of the metric that is drawn: the other one if only that has values.
fn known_name<'a>((usual, other): Metric<'a>, runs: &[RunTable]) -> &'a str {
    let is_known = |name: &str| {
        let mut values = runs.iter().flat_map(|run| run.table.column(name));
        values.any(|x| !x.is_nan())
    };
    other
        .filter(|other| !is_known(usual) && is_known(other))
        .unwrap_or(usual)
}

/// The panel of a metric: a curve for each run, or for several seeds one curve and a band.
fn panel(name: &str, runs: &[RunTable], window: f64, seeds: bool) -> Subplot {
    let mut title = tag(name).map_or_else(|| name.to_owned(), |known| known.title);
    let mut curves: Vec<Curve> = runs.iter().map(|run| run.curve(name, window)).collect();
    if seeds {
        curves.retain(|curve| !curve.points.is_empty());
        if curves.len() < runs.len() {
            title += &format!(" ({} of {} seeds)", curves.len(), runs.len());
        }
        curves = vec![mean_and_band(&curves)];
    }
    Subplot {
        title,
        curves,
        behind: Vec::new(),
        nothing: if name.starts_with(EVALUATION) {
            "no evaluation yet"
        } else {
            "nothing yet"
        },
    }
}

/// Reads the table of each run once, however many names the run has, e.g. a link `latest`. Warns of each that cannot be drawn.
fn runs(places: &[PathBuf], along: Along, wanted: &[&str]) -> Vec<RunTable> {
    let mut known = HashSet::new();
    places
        .iter()
        .filter(|place| {
            let whole = run::table_of(place).canonicalize().ok();
            whole.is_none_or(|whole| known.insert(whole))
        })
        .filter_map(|place| {
            RunTable::read(place, along, wanted)
                .inspect_err(|error| say!("warning: {error:#}; skipped"))
                .ok()
        })
        .collect()
}

/// The control steps that are averaged into a point. They are as many for all runs, so that a table with fewer rows, as in docs/curves,
/// is not smoothed more.
fn window(runs: &[RunTable], smooth: Option<usize>) -> f64 {
    let steps = || runs.iter().map(|run| run.table.column(ALONG[0]));
    let shortest = steps().map(<[f64]>::len).min().unwrap_or(0);
    let rows = smooth.unwrap_or((shortest / 10).clamp(1, SMOOTH));
    let in_row = steps().filter_map(|steps| Some(steps.get(1)? - steps[0]));
    rows as f64 * in_row.fold(f64::INFINITY, f64::min)
}

/// Checks that there are runs, and that each of these columns is in at least one of them. Warns of the runs without it.
///
/// # Errors
/// Fails without runs. Fails on the first column that no run has, and names the nearest ones.
fn expect_columns(runs: &[RunTable], metrics: &[String]) -> Result<()> {
    ensure!(!runs.is_empty(), "no run can be drawn");
    for name in metrics {
        let lacking = runs
            .iter()
            .filter(|run| !run.table.columns.contains_key(name));
        let lacking: Vec<&str> = lacking.map(|run| &run.name[..]).collect();
        if lacking.len() == runs.len() {
            let known: BTreeSet<&String> = runs.iter().flat_map(|run| &run.table.names).collect();
            let mut nearest = similar(name, known.into_iter().map(String::as_str), '/');
            nearest.truncate(SUGGESTIONS);
            let hint = match &nearest[..] {
                [] => "the first line of metrics.csv names all columns".to_owned(),
                nearest => format!("did you mean {}?", nearest.join(" or ")),
            };
            bail!("no run has a column {}; {hint}", shortened(name));
        }
        if !lacking.is_empty() {
            say!("warning: no column {name} in {}", lacking.join(", "));
        }
    }
    Ok(())
}

impl RunTable {
    /// Reads the table of a run with these columns.
    fn read(place: &Path, along: Along, wanted: &[&str]) -> Result<Self> {
        let required = match along {
            Along::Steps => &ALONG[..1],
            Along::Hours => &ALONG,
        };
        let table = run::read_metrics(place, required, wanted)?;
        let [steps, collect_s, update_s] = ALONG.map(|name| table.column(name));
        ensure!(!steps.is_empty(), "{}: no rows yet", place.display());
        let along = match along {
            Along::Steps => steps.iter().map(|steps| steps / 1e6).collect(),
            Along::Hours => hours(collect_s, update_s),
        };
        Ok(Self {
            name: name_of(place),
            along,
            table,
        })
    }

    /// The curve of a metric, without points if the run has no such column. Each evaluation counts by itself, at the step at which it
    /// was made. Other values are averaged over windows of so many steps.
    fn curve(&self, name: &str, window: f64) -> Curve {
        let values = self.table.column(name);
        if values.is_empty() {
            return Curve::default();
        }
        let dots = name.starts_with(EVALUATION);
        let lengths = if dots {
            vec![1; values.len()]
        } else {
            lengths_of_windows(self.table.column(ALONG[0]), window)
        };
        Curve {
            points: smooth(&self.along, values, &lengths),
            dots,
            ..Curve::default()
        }
    }
}

/// The mean of these curves and the band from the lowest to the highest, where all of them have values. The points are those of the
/// first curve, and the others are interpolated linearly.
fn mean_and_band(curves: &[Curve]) -> Curve {
    let mut all = Curve {
        dots: curves.iter().any(|curve| curve.dots),
        ..Curve::default()
    };
    for &[x, _] in curves.iter().take(1).flat_map(|first| &first.points) {
        let values = curves.iter().map(|curve| value_at(&curve.points, x));
        let Some(values) = values.collect::<Option<Vec<f64>>>() else {
            continue;
        };
        all.points.push([x, mean(&values)]);
        let values = values.iter().copied();
        all.band.push([
            values.clone().fold(f64::INFINITY, f64::min),
            values.fold(f64::NEG_INFINITY, f64::max),
        ]);
    }
    all
}

/// The numbers of consecutive rows that lie in the same window of this many steps.
fn lengths_of_windows(steps: &[f64], window: f64) -> Vec<usize> {
    // Rounded, because steps are whole numbers and the window is a multiple of their difference.
    let number = |step: &f64| ((step - steps[0]) / window + 1e-9).floor();
    steps
        .chunk_by(|a, b| number(a) == number(b))
        .map(<[f64]>::len)
        .collect()
}

/// The hours until the end of each iteration of a run.
fn hours(collect_s: &[f64], update_s: &[f64]) -> Vec<f64> {
    let add = |seconds: &mut f64, (collect, update): (&f64, &f64)| {
        *seconds += collect + update;
        Some(*seconds / 3600.0)
    };
    collect_s.iter().zip(update_s).scan(0.0, add).collect()
}

/// The name of a run, with control characters replaced: the name of its folder, or of a table that has a name of
/// its own, as in docs/curves.
fn name_of(place: &Path) -> String {
    let whole = place.canonicalize().unwrap_or_else(|_| place.to_owned());
    let name = if whole.is_dir() {
        whole.file_name()
    } else if whole.file_name().is_some_and(|file| file == "metrics.csv") {
        whole.parent().and_then(Path::file_name)
    } else {
        whole.file_stem()
    };
    let name = name.unwrap_or(place.as_os_str()).to_string_lossy();
    name.replace(char::is_control, "\u{fffd}")
}

/// The means over consecutive windows of these numbers of rows, `[x, value]`. Rows without a value are skipped, as are windows with
/// only such rows.
fn smooth(along: &[f64], values: &[f64], lengths: &[usize]) -> Vec<[f64; 2]> {
    let mut begin = 0;
    let means = lengths.iter().filter_map(|length| {
        let window = begin..begin + length;
        begin = window.end;
        let known = |all: &[f64]| {
            let mut known = all[window.clone()].to_vec();
            known.retain(|value| value.is_finite());
            (!known.is_empty()).then(|| mean(&known))
        };
        Some([known(along)?, known(values)?])
    });
    means.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_named_after_its_folder_and_a_table_by_itself_after_its_file() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let names = [
            "docs/curves",
            "docs/curves/default-0.csv",
            "runs/seed-1/metrics.csv",
        ]
        .map(|of| name_of(&root.join(of)));
        assert_eq!(names, ["curves", "default-0", "seed-1"]);
    }

    #[test]
    fn a_point_is_the_mean_of_the_rows_that_have_a_value() {
        let along = [1.0, 2.0, 3.0, 4.0, 5.0];
        let values = [1.0, f64::NAN, f64::NAN, f64::NAN, 7.0];
        assert_eq!(
            smooth(&along, &values, &[2, 2, 1]),
            [[1.5, 1.0], [5.0, 7.0]]
        );
        assert_eq!(smooth(&along, &values, &[5]), [[3.0, 4.0]]);
    }

    #[test]
    fn a_window_is_as_many_steps_in_a_table_with_fewer_rows() {
        let rows = |step: u32, count: u32| {
            (1..=count)
                .map(|i| f64::from(step * i))
                .collect::<Vec<f64>>()
        };
        assert_eq!(
            lengths_of_windows(&rows(16_384, 7), 3.0 * 16_384.0),
            [3, 3, 1]
        );
        assert_eq!(lengths_of_windows(&rows(100, 5), 250.0), [3, 2]);
        assert_eq!(lengths_of_windows(&rows(400, 3), 250.0), [1, 1, 1]);
        assert_eq!(lengths_of_windows(&[5.0], f64::INFINITY), [1]);
    }

    #[test]
    fn the_mean_of_seeds_is_taken_where_all_of_them_have_values() {
        let curve = |points: &[[f64; 2]]| Curve {
            points: points.to_vec(),
            ..Curve::default()
        };
        let (a, b) = (
            curve(&[[1.0, 0.0], [2.0, 1.0], [4.0, 2.0]]),
            curve(&[[1.5, 4.0], [2.0, 5.0], [3.0, 9.0]]),
        );
        let found = mean_and_band(&[a, b]);
        assert_eq!(
            (found.points, found.band),
            (vec![[2.0, 3.0]], vec![[1.0, 5.0]])
        );
        // The second has no point at 2, but one on each side.
        let (a, b) = (curve(&[[2.0, 1.0]]), curve(&[[1.0, 0.0], [3.0, 6.0]]));
        let found = mean_and_band(&[a, b]);
        assert_eq!(
            (found.points, found.band),
            (vec![[2.0, 2.0]], vec![[1.0, 3.0]])
        );
        assert!(
            mean_and_band(&[curve(&[[1.0, 2.0]]), curve(&[])])
                .points
                .is_empty()
        );
    }
}
