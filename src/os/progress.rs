//! Progress on the terminal: a line that is redrawn in place, or plain lines if that is impossible.

use std::time::{Duration, Instant};

use console::Term;
use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use super::machine::is_shared;
use super::stderr::progress_target;
use super::{is_terminal, number, say, say_line};

/// The time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The weight of the newest value in the moving averages that are shown (logged values are not averaged).
const SHOWN_SHARE: f64 = 0.1;

/// The fewest columns of a terminal in which a line is redrawn.
const NARROWEST: usize = 60;

/// The values shown for an iteration, `NaN` if unknown.
#[derive(Clone, Copy)]
pub struct Status {
    /// Control steps so far.
    pub env_steps: u64,
    /// Control steps per second.
    pub steps_per_s: f64,
    /// Goals per episode that ended, by the rules of the lesson that is trained.
    pub goals: f64,
    /// The fraction of episodes that ended with a drop.
    pub drop_rate: f64,
    /// Goals per episode of an evaluation.
    pub evaluation: f64,
    /// Whether training helps with turning the object.
    pub assisted: bool,
    /// Whether other programs use the machine.
    pub shared: bool,
}

/// The progress of a training run.
pub struct StatusLine {
    bar: Option<ProgressBar>,
    quiet: bool,
    last_line: Option<Instant>,
    /// Moving averages, and the latest evaluation.
    shown: Status,
    total_steps: u64,
    /// The time when this session began.
    begun: Instant,
    /// Steps made before this session.
    steps_before: u64,
}

impl StatusLine {
    /// Creates the line of a training run that has made `env_steps` of its steps. If `quiet`, no progress is shown.
    pub fn new(env_steps: u64, total_steps: u64, quiet: bool) -> Self {
        // A line can be redrawn in place on a terminal that is wide enough.
        let wide = Term::stderr()
            .size_checked()
            .is_some_and(|(_, columns)| usize::from(columns) >= NARROWEST);
        let bar = (!quiet && is_terminal() && !is_dumb() && wide).then(|| {
            // Cuts off what does not fit, even after the terminal is resized.
            let style = ProgressStyle::with_template("{wide_msg}").expect("the template is valid");
            let bar = ProgressBar::with_draw_target(None, progress_target()).with_style(style);
            bar.enable_steady_tick(Duration::from_secs(1));
            bar
        });
        let unknown = f64::NAN;
        let shown = Status {
            env_steps,
            steps_per_s: unknown,
            goals: unknown,
            drop_rate: unknown,
            evaluation: unknown,
            assisted: false,
            shared: false,
        };
        Self {
            bar,
            quiet,
            last_line: None,
            shown,
            total_steps,
            begun: Instant::now(),
            steps_before: env_steps,
        }
    }

    /// Shows the values of an iteration.
    pub fn show(&mut self, status: &Status) {
        self.shown.update(status);
        self.shown.shared = is_shared();
        let left = self.time_left();
        if let Some(bar) = &self.bar {
            let width = usize::from(Term::stderr().size().1).saturating_sub(1);
            bar.set_message(self.shown.line(self.total_steps, &left, width));
        } else if !self.quiet
            && (self
                .last_line
                .is_none_or(|last| last.elapsed() >= LINE_EVERY)
                || status.env_steps >= self.total_steps)
        {
            self.last_line = Some(Instant::now());
            say!("{}", self.shown.line(self.total_steps, &left, usize::MAX));
        }
    }

    /// Estimates the time left at the pace of this session, including evaluations.
    fn time_left(&self) -> String {
        let made = self
            .shown
            .env_steps
            .saturating_sub(self.steps_before)
            .max(1);
        let pace = self.begun.elapsed().as_secs_f64() / made as f64;
        let left = pace * self.total_steps.saturating_sub(self.shown.env_steps) as f64;
        let left = span(Duration::try_from_secs_f64(left).unwrap_or(Duration::MAX));
        format!("{left} left")
    }

    /// Prints a line above the progress line.
    pub fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say_line(line)),
            None => say_line(line),
        }
    }

    /// Prints a warning above the progress line.
    pub fn warn(&self, text: &str) {
        self.say(&format!("warning: {text}"));
    }

    /// Ends the line and leaves it on the terminal.
    pub fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.abandon();
            // The cursor is left at the end of the line.
            say_line("");
        }
    }
}

impl Status {
    fn update(&mut self, status: &Status) {
        self.env_steps = status.env_steps;
        self.assisted = status.assisted;
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
        if !status.evaluation.is_nan() {
            self.evaluation = status.evaluation;
        }
    }

    /// The parts of the line, the most important first.
    fn parts(&self, left: &str) -> Vec<String> {
        let evaluated = if self.evaluation.is_nan() {
            String::new()
        } else {
            format!(" (eval {:.2})", self.evaluation)
        };
        let goals = if self.assisted {
            "assisted goals"
        } else {
            "goals"
        };
        let per_cent = if self.drop_rate.is_nan() { "" } else { "%" };
        let mut parts = vec![
            format!("{} steps/s", count(self.steps_per_s)),
            left.into(),
            format!("{goals} {}{evaluated}", number(self.goals, 2)),
            format!("drops {}{per_cent}", number(100.0 * self.drop_rate, 0)),
        ];
        if self.shared {
            parts.push("others use the machine".into());
        }
        parts
    }

    /// The line with the parts that fit into `width` columns.
    fn line(&self, total_steps: u64, left: &str, width: usize) -> String {
        let mut line = format!("{} steps", of_all(self.env_steps, total_steps));
        for part in self.parts(left) {
            if line.len() + 2 + part.len() > width {
                break;
            }
            line += &format!("  {part}");
        }
        line
    }
}

/// A part of a whole, e.g. `65.5 k of 200 M`.
pub fn of_all(made: u64, all: u64) -> String {
    format!("{} of {}", count(made as f64), count(all as f64))
}

/// A count with three digits, e.g. `65.5 k`.
pub fn count(count: f64) -> String {
    let (unit, name) = match count {
        999_500.0.. => (1e6, " M"),
        999.5.. => (1e3, " k"),
        _ => return number(count, 0),
    };
    let decimals = (2.0 - (count / unit).log10().floor()).max(0.0) as usize;
    let digits = format!("{:.decimals$}", count / unit);
    let digits = if decimals > 0 {
        digits.trim_end_matches('0').trim_end_matches('.')
    } else {
        &digits
    };
    format!("{digits}{name}")
}

/// A time by its two largest units, e.g. `2 h 35 min`.
pub fn span(time: Duration) -> String {
    let seconds = time.as_secs();
    let [minutes, hours, days] = [60, 3600, 86_400].map(|unit| seconds / unit);
    match [days, hours, minutes] {
        [0, 0, 0] => format!("{seconds} s"),
        [0, 0, _] => format!("{minutes} min {} s", seconds % 60),
        [0, ..] => format!("{hours} h {} min", minutes % 60),
        _ => format!("{days} d {} h", hours % 24),
    }
}

/// Whether nothing can be redrawn on the terminal.
pub fn is_dumb() -> bool {
    std::env::var("TERM").map_or(true, |kind| kind.is_empty() || kind == "dumb")
}

/// The progress bar of a job with many items.
pub type Bar = ProgressBar;

/// The progress bar of a job, at zero of `total` items, e.g. frames. It is shown on a terminal only, until it is dropped.
/// `job` distinguishes several jobs, e.g. by the policy that plays.
pub fn progress_bar(total: u64, items: &str, job: &str) -> Bar {
    let style = format!(
        "{job:<12} [{{bar:12}}] {{human_pos}}/{{human_len}} {items}, ETA {{eta}}  {{wide_msg}}"
    );
    let style = ProgressStyle::with_template(&style)
        .expect("the template is valid")
        .progress_chars("=> ");
    ProgressBar::with_draw_target(Some(total), progress_target())
        .with_style(style)
        .with_finish(ProgressFinish::AndClear)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_has_what_fits() {
        let status = Status {
            env_steps: 10_012_345,
            steps_per_s: 12_345.6,
            goals: 0.24,
            drop_rate: 0.335,
            evaluation: 5.75,
            assisted: false,
            shared: false,
        };
        let left = span(Duration::from_secs(7533));
        let line = |width| status.line(100_000_000, &left, width);
        let short = "10 M of 100 M steps  12.3 k steps/s  2 h 5 min  goals 0.24 (eval 5.75)";
        assert_eq!(line(70), short);
        assert_eq!(line(80), short);
        assert_eq!(line(81), format!("{short}  drops 34%"));
        let few = Status {
            env_steps: 256,
            evaluation: f64::NAN,
            goals: f64::NAN,
            assisted: true,
            ..status
        };
        assert!(
            few.line(1280, "0 s", 79)
                .starts_with("256 of 1.28 k steps  12.3 k steps/s  0 s  assisted goals -  drops")
        );
    }

    #[test]
    fn counts_and_times_are_short() {
        assert_eq!(
            [
                f64::NAN,
                0.0,
                999.0,
                1000.0,
                65_536.0,
                999_499.0,
                999_999.0,
                10_049_000.0,
                2e8
            ]
            .map(count),
            [
                "-", "0", "999", "1 k", "65.5 k", "999 k", "1 M", "10 M", "200 M"
            ]
        );
        assert_eq!(
            [0, 59, 61, 3600, 9300, 100_000].map(|seconds| span(Duration::from_secs(seconds))),
            [
                "0 s",
                "59 s",
                "1 min 1 s",
                "1 h 0 min",
                "2 h 35 min",
                "1 d 3 h"
            ]
        );
    }
}
