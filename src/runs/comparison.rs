//! Two runs beside each other: the settings in which they differ, and their figures at equal steps.

use std::iter;

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::found::Run;
use crate::config::{Difference, is_derived, short};
use crate::os::{aligned, harmless, number};
use crate::run::{read_metrics, value_at};
use crate::statistics::mean;

/// The most steps at which figures are compared.
const MOST_MARKS: usize = 12;

/// The measures that are compared: the group of columns, and the column in it.
const COMPARED: [(&str, &str); 4] = [
    ("eval", "goals"),
    ("eval", "drop_rate"),
    ("eval", "rot_dist"),
    ("training", "turned"),
];

/// Two runs, A and B.
pub struct Comparison {
    /// The settings in which they differ, or `None` if the settings of one are not known.
    settings: Option<Vec<Difference>>,
    /// Steps, and the figures of both there.
    rows: Vec<(f64, [[f64; 2]; COMPARED.len()])>,
}

/// The points of each figure of a run, over control steps.
type Curves = [Vec<[f64; 2]>; COMPARED.len()];

impl Comparison {
    /// Compares two runs.
    ///
    /// # Errors
    /// Fails if the table of one cannot be read.
    pub fn of(a: &Run, b: &Run) -> Result<Self> {
        let configs = a.config.as_ref().zip(b.config.as_ref());
        let curves = [curves(a)?, curves(b)?];
        let mut begin = f64::NEG_INFINITY;
        let row = |step| {
            let figures = std::array::from_fn(|figure| {
                curves.each_ref().map(|of| match COMPARED[figure] {
                    ("eval", _) => value_at(&of[figure], step).unwrap_or(f64::NAN),
                    // The others are logged in every iteration.
                    _ => mean_between(&of[figure], begin, step),
                })
            });
            begin = step;
            (step, figures)
        };
        Ok(Self {
            settings: configs.map(|(a, b)| a.compared_with(b)),
            rows: marks(&curves).into_iter().map(row).collect(),
        })
    }

    /// The lines that follow the table of both runs.
    pub fn lines(&self) -> Vec<String> {
        let of_user = self.settings.as_ref().map(|all| {
            let mut all = all.clone();
            all.retain(|(key, _)| !is_derived(key));
            all
        });
        let settings = match of_user.as_deref() {
            None => vec![vec!["the settings of one run are not known".into()]],
            Some([]) => vec![vec!["the settings are the same".into()]],
            Some(all) => {
                let heads = ["setting", "A", "B"].map(String::from);
                let rows = all.iter().map(|(key, [a, b])| {
                    [key.clone(), short(a), short(b)].map(|cell| harmless(&cell))
                });
                iter::chain([heads], rows).map(Vec::from).collect()
            }
        };
        let heads = COMPARED
            .iter()
            .flat_map(|(_, column)| [format!("{column} A"), "B".to_owned()]);
        let heads = iter::chain(["steps".to_owned()], heads).collect();
        let figures = self.rows.iter().map(|(step, figures)| {
            let cells = figures.iter().flatten().map(|value| number(*value, 2));
            iter::chain([format!("{step:.0}")], cells).collect()
        });
        let figures = if self.rows.is_empty() {
            vec!["the evaluations of the two runs do not overlap in steps".into()]
        } else {
            aligned(&Vec::from_iter(iter::chain([heads], figures)), 0)
        };
        [
            vec![String::new()],
            aligned(&settings, 2),
            vec![String::new()],
            figures,
        ]
        .concat()
    }

    /// Its object of JSON, with these objects of both runs.
    pub fn as_json(&self, runs: Value) -> Value {
        let settings = self.settings.as_ref().map(|all| {
            let all = all.iter().map(|(key, both)| (key.clone(), json!(both)));
            Value::from_iter(all)
        });
        let rows = self.rows.iter().map(|(step, figures)| {
            let mut row = json!({ "env_steps": *step as u64 });
            for ((_, column), both) in COMPARED.iter().zip(figures) {
                row[column] = json!(both);
            }
            row
        });
        json!({
            "runs": runs,
            "settings": settings,
            "at_equal_steps": Value::from_iter(rows),
        })
    }
}

/// Reads the curves of a run. One without a table has none.
fn curves(run: &Run) -> Result<Curves> {
    if !run.has_table() {
        return Ok(Curves::default());
    }
    let columns = COMPARED.map(|(group, column)| format!("{group}/{column}"));
    let wanted = columns.each_ref().map(String::as_str);
    let table = read_metrics(&run.path, &["env_steps"], &wanted).context("cannot compare")?;
    let steps = table.column("env_steps").iter();
    Ok(columns.map(|column| {
        let values = steps.clone().zip(table.column(&column));
        let points = values.map(|(step, value)| [*step, *value]);
        points
            .filter(|[step, value]| !step.is_nan() && !value.is_nan())
            .collect()
    }))
}

/// The steps at which A was evaluated within the evaluations of B: the last one, and others evenly before it.
fn marks([a, b]: &[Curves; 2]) -> Vec<f64> {
    let common: Vec<f64> = a[0]
        .iter()
        .map(|[step, _]| *step)
        .filter(|step| value_at(&b[0], *step).is_some())
        .collect();
    let count = common.len().min(MOST_MARKS);
    (1..=count)
        .map(|mark| common[mark * common.len() / count - 1])
        .collect()
}

/// The mean of the values after `begin` up to `end`, or NaN if there are none.
fn mean_between(points: &[[f64; 2]], begin: f64, end: f64) -> f64 {
    let inside = points
        .iter()
        .filter(|[step, _]| *step > begin && *step <= end)
        .map(|[_, value]| *value);
    mean(&Vec::from_iter(inside))
}
