//! The output of a training run: event file, `metrics.csv`, and a progress line.
//!
//! A log that cannot be written causes a warning and never ends the training run. Lost iterations are counted, and the log is
//! opened again at the next checkpoint.

use std::borrow::Borrow;
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::Result;
use toml::Table;

use super::events::{EventFile, cut_off_after};
use super::folder::METRICS;
use super::histogram::Histogram;
use super::hparams::{self, HPARAMS};
use super::metrics::Metrics;
use super::summary::Descriptions;
use crate::os::{Status, StatusLine};

/// The logs and the progress line of a training run.
pub struct Report {
    /// The path of the run folder.
    pub folder: PathBuf,
    header: String,
    /// The descriptions of all that is logged, for TensorBoard.
    pub descriptions: Descriptions,
    /// The settings of the run (TOML), for TensorBoard.
    pub settings: String,
    events: Log<EventFile>,
    metrics: Log<Metrics>,
    /// The settings by dotted key, for TensorBoard's HPARAMS.
    pub hparams: Table,
    /// The goals of the best evaluation so far, which is confirmed, once there was one.
    pub best: f64,
    /// The row of TensorBoard's HPARAMS.
    session: Log<EventFile>,
    /// From the iteration before the first one of the run to the last one that was logged.
    iterations: Range<u64>,
    /// Control steps up to its end.
    env_steps: u64,
    /// The line on the terminal.
    pub progress: StatusLine,
}

/// A log, which has no writer while it cannot be written.
struct Log<W> {
    name: &'static str,
    writer: Option<W>,
    /// Whether the last iteration could not be written.
    failing: bool,
    /// Iterations missing from the log.
    lost: u64,
    /// Iterations written since the log was last known to be on the disk.
    unsynced: u64,
}

impl<W> Log<W> {
    fn new(name: &'static str) -> Self {
        Self {
            name,
            writer: None,
            failing: false,
            lost: 0,
            unsynced: 0,
        }
    }

    /// Opens the log if it is not open. Reports if that fails.
    fn open(&mut self, progress: &StatusLine, open: impl FnOnce() -> Result<W>) {
        if self.writer.is_none() {
            match open() {
                Ok(writer) => self.writer = Some(writer),
                Err(error) => self.give_up(progress, 0, &error),
            }
        }
    }

    /// Writes an iteration if possible. Reports if the log fails or recovers.
    fn write(&mut self, progress: &StatusLine, write: impl FnOnce(&mut W) -> Result<()>) {
        match self.writer.as_mut().map(write) {
            Some(Ok(())) => {
                self.unsynced += 1;
                if std::mem::take(&mut self.failing) {
                    progress.warn(&format!("logging to {} has resumed", self.name));
                }
            }
            Some(Err(error)) => self.give_up(progress, 1, &error),
            None => self.lost += 1,
        }
    }

    /// Ensures that everything is on the disk. Reports if it is not.
    fn sync(&mut self, progress: &StatusLine, sync: impl FnOnce(&mut W) -> Result<()>) {
        if let Some(result) = self.writer.as_mut().map(sync) {
            let unsynced = std::mem::take(&mut self.unsynced);
            result.unwrap_or_else(|error| self.give_up(progress, unsynced, &error));
        }
    }

    /// Stops writing, and counts the iterations that are `lost`. Reports this unless it is known.
    fn give_up(&mut self, progress: &StatusLine, lost: u64, error: &anyhow::Error) {
        self.lost += lost;
        self.writer = None;
        if !std::mem::replace(&mut self.failing, true) {
            progress.warn(&format!("logging to {} is suspended: {error:#}", self.name));
        }
    }
}

impl Report {
    /// Creates the report of a run in `folder`, for numbers with these names. Writes nothing yet.
    pub fn new(folder: &Path, names: &[impl Borrow<str>], progress: StatusLine) -> Self {
        Self {
            folder: folder.to_owned(),
            header: format!("iteration,env_steps,{}", names.join(",")),
            descriptions: Descriptions::new(),
            settings: String::new(),
            events: Log::new("the event file"),
            metrics: Log::new(METRICS),
            hparams: Table::new(),
            best: f64::NAN,
            session: Log::new(HPARAMS),
            iterations: 0..0,
            env_steps: 0,
            progress,
        }
    }

    /// Opens the logs to continue after these iterations, which ended after `env_steps` steps.
    pub fn open_logs(&mut self, iterations: Range<u64>, env_steps: u64) {
        self.iterations = iterations;
        self.env_steps = env_steps;
        self.open();
    }

    /// Opens the logs that are not open.
    fn open(&mut self) {
        let Self {
            progress,
            folder,
            env_steps,
            iterations,
            ..
        } = self;
        self.events.open(progress, || {
            // A session that ended before its next checkpoint may have logged later steps. These are made again.
            cut_off_after(folder, *env_steps)?;
            let first_step = *env_steps + u64::from(iterations.end > 0);
            EventFile::create(folder, first_step, &self.descriptions, &self.settings)
        });
        let is_first = !self.metrics.failing;
        self.metrics.open(progress, || {
            let tell = |note: &str| {
                if is_first {
                    progress.say(note);
                }
            };
            Metrics::open(
                &folder.join(METRICS),
                &self.header,
                iterations.clone(),
                tell,
            )
        });
        self.session.open(progress, || {
            hparams::begin(folder, *env_steps, &self.hparams)
        });
    }

    /// Logs the values of an iteration, whose names and order are those given at the beginning, and shows the status.
    pub fn iteration(
        &mut self,
        iteration: u64,
        values: &[(impl AsRef<str>, f64)],
        histograms: &[(&'static str, Histogram)],
        status: &Status,
    ) {
        self.iterations.end = iteration;
        self.env_steps = status.env_steps;
        let cell = |value: f64| {
            if value.is_nan() {
                String::new()
            } else {
                value.to_string()
            }
        };
        let cells: Vec<String> = values.iter().map(|(_, value)| cell(*value)).collect();
        let row = format!("{iteration},{},{}\n", status.env_steps, cells.join(","));
        self.events.write(&self.progress, |events| {
            events.iteration(status.env_steps, values, histograms)
        });
        self.metrics
            .write(&self.progress, |metrics| metrics.row(&row));
        if !status.evaluation.is_nan() {
            let drop_rate = values
                .iter()
                .find(|(name, _)| name.as_ref() == "eval/drop_rate");
            let drop_rate = drop_rate.map_or(f64::NAN, |(_, value)| *value);
            let metrics = [
                ("best_goals", self.best),
                ("drop_rate", drop_rate),
                ("steps_per_s", status.steps_per_s),
            ];
            self.session.write(&self.progress, |events| {
                events.iteration(status.env_steps, &metrics, &[])
            });
        }
        self.progress.show(status);
    }

    /// Brings everything that was logged onto the disk, before a checkpoint relies on it. Reopens logs that could not be written.
    pub fn sync(&mut self) {
        self.metrics.sync(&self.progress, Metrics::sync);
        self.events.sync(&self.progress, EventFile::sync);
        self.session.sync(&self.progress, EventFile::sync);
        self.open();
    }

    /// Says in the row of TensorBoard's HPARAMS that the run has made all its steps, or has failed.
    pub fn end(&mut self, succeeded: bool) {
        self.session.write(&self.progress, |events| {
            events.values(hparams::end(succeeded)?, self.env_steps)
        });
    }

    /// Ends the progress line, and reports the iterations that the logs lack.
    pub fn finish(&self) {
        self.progress.end();
        for (name, lost) in [
            (self.metrics.name, self.metrics.lost),
            (self.events.name, self.events.lost),
        ] {
            if lost > 0 {
                self.progress.warn(&format!(
                    "{name} lacks {lost} iterations of this session, which could not be written"
                ));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn status(env_steps: u64) -> Status {
        Status {
            assisted: false,
            shared: false,
            env_steps,
            steps_per_s: 10.0,
            goals: f64::NAN,
            drop_rate: 0.5,
            evaluation: f64::NAN,
        }
    }

    fn open(folder: &Path, tags: &[&str], iteration: u64, env_steps: u64) -> Report {
        let mut report = Report::new(folder, tags, StatusLine::new(env_steps, 100, true));
        report.open_logs(0..iteration, env_steps);
        report
    }

    #[test]
    fn metrics_have_one_row_per_iteration_and_rows_after_the_checkpoint_are_written_anew() {
        let place = tempfile::tempdir().unwrap();
        let tags = ["loss/policy", "eval/goals"];
        let mut report = open(place.path(), &tags, 0, 0);
        for iteration in 1..=3 {
            let values = [
                ("loss/policy", 0.5 * iteration as f64),
                ("eval/goals", f64::NAN),
            ];
            report.iteration(iteration, &values, &[], &status(10 * iteration));
        }
        let mut resumed = open(place.path(), &tags, 2, 20);
        resumed.iteration(
            3,
            &[("loss/policy", 7.0), ("eval/goals", 1.0)],
            &[],
            &status(30),
        );
        let text = std::fs::read_to_string(place.path().join("metrics.csv")).unwrap();
        assert_eq!(
            text,
            "iteration,env_steps,loss/policy,eval/goals\n1,10,0.5,\n2,20,1,\n3,30,7,1\n"
        );
    }

    #[test]
    fn logs_that_cannot_be_written_are_counted_and_tried_again() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("gone");
        let mut report = open(&folder, &["a"], 0, 0);
        report.iteration(1, &[("a", 1.0)], &[], &status(10));
        assert_eq!((report.metrics.lost, report.events.lost), (1, 1));
        fs::create_dir(&folder).unwrap();
        report.sync();
        report.iteration(2, &[("a", 2.0)], &[], &status(20));
        assert_eq!(
            fs::read_to_string(folder.join(METRICS)).unwrap(),
            "iteration,env_steps,a\n2,20,2\n"
        );
        // Deleted during the run, which is noticed at the next checkpoint.
        fs::remove_dir_all(&folder).unwrap();
        fs::create_dir(&folder).unwrap();
        report.iteration(3, &[("a", 3.0)], &[], &status(30));
        report.sync();
        assert_eq!(
            (report.metrics.lost, report.events.lost),
            (3, 3),
            "deleted iterations are lost too"
        );
        report.iteration(4, &[("a", 4.0)], &[], &status(40));
        assert_eq!(
            fs::read_to_string(folder.join(METRICS)).unwrap(),
            "iteration,env_steps,a\n4,40,4\n"
        );
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 3);
    }

    #[test]
    fn a_link_that_takes_the_place_of_a_log_is_not_written_through() {
        let place = tempfile::tempdir().unwrap();
        let [run, other] = ["run", "other"].map(|name| place.path().join(name));
        drop(open_in(&other));
        let mut report = open_in(&run);
        let kept = fs::read(other.join(METRICS)).unwrap();
        for name in [METRICS, HPARAMS] {
            let own = run.join(name);
            fs::rename(&own, place.path().join(name)).unwrap();
            std::os::unix::fs::symlink(other.join(name), own).unwrap();
        }
        report.sync();
        report.iteration(1, &[("a", 1.0)], &[], &status(10));
        assert_eq!((report.metrics.lost, report.events.lost), (1, 0));
        assert_eq!(fs::read(other.join(METRICS)).unwrap(), kept);
        assert_eq!(fs::read_dir(other.join(HPARAMS)).unwrap().count(), 1);
    }

    fn open_in(folder: &Path) -> Report {
        fs::create_dir(folder).unwrap();
        open(folder, &["a"], 0, 0)
    }
}
