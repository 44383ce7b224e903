//! What a training tells: event file, `metrics.csv`, and a progress bar, or plain lines where there is no terminal.
//!
//! A log that cannot be written is a warning, never the end of a training.

use std::fs::{File, OpenOptions};
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};

use super::events::EventFile;
use super::file::{read_text, write_whole};
use super::folder::METRICS;
use super::say;

/// Time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Share of the newest value in the moving averages that are shown (not in what is logged).
const SHOWN_SHARE: f64 = 0.1;

/// Where a training tells how it goes.
pub struct Report {
    events: Option<EventFile>,
    metrics: Option<File>,
    columns: Vec<String>,
    bar: Option<ProgressBar>,
    last_line: Option<Instant>,
    shown: Shown,
    total_steps: u64,
    /// When this session began, and the steps made before it.
    begun: (Instant, u64),
}

/// What is shown of an iteration; `NaN` where nothing is known.
#[derive(Clone, Copy, Debug)]
pub struct Status {
    /// Control steps made.
    pub env_steps: u64,
    /// Control steps per second.
    pub steps_per_s: f64,
    /// Goals per episode that ended.
    pub goals: f64,
    /// Fraction of the episodes that ended with a drop.
    pub drop_rate: f64,
}

/// Moving averages.
#[derive(Clone, Copy, Debug)]
struct Shown {
    steps_per_s: f64,
    goals: f64,
    drop_rate: f64,
}

impl Report {
    /// Opens the logs in `folder`, for metrics with these names, behind the first `iterations` rows of earlier sessions.
    pub fn open(folder: &Path, tags: &[&str], iterations: u64, env_steps: u64, total_steps: u64) -> Self {
        let columns: Vec<String> = ["iteration", "env_steps"].iter().chain(tags).map(|&name| name.to_owned()).collect();
        let terminal = std::io::stderr().is_terminal();
        let mut report = Self {
            events: None,
            metrics: None,
            columns,
            bar: terminal.then(|| progress_bar(env_steps, total_steps)),
            last_line: None,
            shown: Shown { steps_per_s: f64::NAN, goals: f64::NAN, drop_rate: f64::NAN },
            total_steps,
            begun: (Instant::now(), env_steps),
        };
        // Later steps of a session that did not come to its checkpoint are made again.
        match EventFile::create(folder, env_steps + u64::from(iterations > 0)) {
            Ok(events) => report.events = Some(events),
            Err(error) => report.warn(&format!("no event file is written: {error:#}")),
        }
        match open_metrics(&folder.join(METRICS), &report.columns, iterations) {
            Ok((metrics, dropped)) => {
                report.metrics = Some(metrics);
                if dropped > 0 {
                    report.say(&format!("{dropped} rows of {METRICS} after iteration {iterations} are dropped"));
                }
            }
            Err(error) => report.warn(&format!("no metrics are written: {error:#}")),
        }
        report
    }

    /// Logs the values of an iteration, in the order of the tags, and shows the status.
    pub fn iteration(&mut self, iteration: u64, values: &[(&str, f64)], status: &Status) {
        if let Some(Err(error)) = self.events.as_mut().map(|events| events.scalars(status.env_steps, values)) {
            self.events = None;
            self.warn(&format!("the event file is not written any more: {error:#}"));
        }
        if let Some(mut metrics) = self.metrics.take() {
            let cell = |&(_, value): &(&str, f64)| if value.is_nan() { String::new() } else { value.to_string() };
            let cells: Vec<String> = values.iter().map(cell).collect();
            let row = format!("{iteration},{},{}\n", status.env_steps, cells.join(","));
            match metrics.write_all(row.as_bytes()) {
                Ok(()) => self.metrics = Some(metrics),
                Err(error) => self.warn(&format!("metrics.csv is not written any more: {error}")),
            }
        }
        self.shown.take(status);
        let text = self.shown.text(self.time_left(status.env_steps));
        if let Some(bar) = &self.bar {
            bar.set_position(status.env_steps);
            bar.set_message(text);
        } else if self.last_line.is_none_or(|last| last.elapsed() >= LINE_EVERY) || status.env_steps >= self.total_steps
        {
            self.last_line = Some(Instant::now());
            say(&format!("{} of {} steps  {text}", status.env_steps, self.total_steps));
        }
    }

    /// At the pace of this session, evaluations included.
    fn time_left(&self, env_steps: u64) -> Duration {
        let (start, before) = self.begun;
        let pace = start.elapsed().as_secs_f64() / env_steps.saturating_sub(before).max(1) as f64;
        Duration::from_secs_f64(pace * self.total_steps.saturating_sub(env_steps) as f64)
    }

    /// Prints a line above the progress bar.
    pub fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say(line)),
            None => say(line),
        }
    }

    /// Prints a warning above the progress bar.
    pub fn warn(&self, text: &str) {
        self.say(&format!("warning: {text}"));
    }

    /// Leaves the progress bar as it is and ends it.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.abandon();
        }
    }
}

impl Shown {
    fn take(&mut self, status: &Status) {
        for (shown, new) in [
            (&mut self.steps_per_s, status.steps_per_s),
            (&mut self.goals, status.goals),
            (&mut self.drop_rate, status.drop_rate),
        ] {
            if shown.is_nan() {
                *shown = new;
            } else if !new.is_nan() {
                *shown += SHOWN_SHARE * (new - *shown);
            }
        }
    }

    fn text(&self, left: Duration) -> String {
        let known = |value: f64, text: String| if value.is_nan() { "-".to_owned() } else { text };
        format!(
            "{:.0} steps/s  ETA {}  goals {}/episode  drops {}",
            self.steps_per_s,
            indicatif::FormattedDuration(left),
            known(self.goals, format!("{:.2}", self.goals)),
            known(self.drop_rate, format!("{:.0} %", 100.0 * self.drop_rate)),
        )
    }
}

/// How far a job has come; on a terminal only.
pub struct Bar {
    bar: ProgressBar,
}

impl Bar {
    /// A bar at zero of `total` things of this name.
    pub fn new(total: u64, name: &str) -> Self {
        let style = format!("{{elapsed_precise}} [{{bar:24}}] {{human_pos}}/{{human_len}} {name}  {{msg}}");
        let style = ProgressStyle::with_template(&style).expect("a template that indicatif knows");
        Self { bar: ProgressBar::new(total).with_style(style.progress_chars("=> ")) }
    }

    /// Counts one.
    pub fn count(&self) {
        self.bar.inc(1);
    }

    /// So many of them will not come.
    pub fn shorten(&self, by: u64) {
        self.bar.dec_length(by);
    }

    /// Says something beside it.
    pub fn say(&self, message: String) {
        self.bar.set_message(message);
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

fn progress_bar(done: u64, total: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{elapsed_precise} [{bar:24}] {human_pos}/{human_len} steps  {msg}");
    let bar = ProgressBar::new(total).with_style(style.expect("a template that indicatif knows").progress_chars("=> "));
    bar.set_position(done);
    bar.enable_steady_tick(Duration::from_secs(1));
    bar
}

/// Keeps the header and the rows of the first `iterations` of an existing file, drops the rest, and opens it for more; the
/// file and the number of rows dropped.
fn open_metrics(path: &Path, columns: &[String], iterations: u64) -> Result<(File, usize)> {
    let header = columns.join(",");
    let (mut kept, mut dropped) = (format!("{header}\n"), 0);
    if let Ok(text) = read_text(path) {
        let done = |row: &&str| {
            let number = row.split(',').next().and_then(|cell| cell.parse::<u64>().ok());
            number.is_some_and(|number| number <= iterations) && row.matches(',').count() == columns.len() - 1
        };
        let rows: Vec<&str> = text.lines().skip(1).collect();
        for row in rows.iter().copied().filter(done) {
            kept.push_str(row);
            kept.push('\n');
        }
        dropped = rows.len() + 1 - kept.lines().count();
    }
    write_whole(path, kept.as_bytes())?;
    let file = OpenOptions::new().append(true).open(path);
    Ok((file.with_context(|| format!("cannot append to {}", path.display()))?, dropped))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(env_steps: u64) -> Status {
        Status { env_steps, steps_per_s: 10.0, goals: f64::NAN, drop_rate: 0.5 }
    }

    #[test]
    fn metrics_have_one_row_per_iteration_and_rows_after_the_checkpoint_are_written_anew() {
        let place = tempfile::tempdir().unwrap();
        let tags = ["loss/policy", "eval/goals"];
        let mut report = Report::open(place.path(), &tags, 0, 0, 100);
        for iteration in 1..=3 {
            let values = [("loss/policy", 0.5 * iteration as f64), ("eval/goals", f64::NAN)];
            report.iteration(iteration, &values, &status(10 * iteration));
        }
        let mut resumed = Report::open(place.path(), &tags, 2, 20, 100);
        resumed.iteration(3, &[("loss/policy", 7.0), ("eval/goals", 1.0)], &status(30));
        let text = std::fs::read_to_string(place.path().join("metrics.csv")).unwrap();
        assert_eq!(text, "iteration,env_steps,loss/policy,eval/goals\n1,10,0.5,\n2,20,1,\n3,30,7,1\n");
    }

    #[test]
    fn logs_that_cannot_be_opened_do_not_end_the_training() {
        let place = tempfile::tempdir().unwrap();
        let mut report = Report::open(&place.path().join("gone"), &["a"], 0, 0, 100);
        report.iteration(1, &[("a", 1.0)], &status(10));
    }
}
