//! What is found in the folder of a run: its state, its figures, and its settings.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::Result;
use serde_json::{Value, json};

use crate::config::{Config, Difference, Source, is_derived, short};
use crate::os::{self, Hold, Stamp, count, harmless, number, of_all, span};
use crate::run::{Glance, read_metrics};
use crate::statistics::mean;

/// The last rows of a table over which its speed is averaged.
const LAST: usize = 20;

/// The age from which the last row says that nobody trains, where a lock cannot be seen. An evaluation or a film takes less.
const SILENT: Duration = Duration::from_secs(120);

/// The most characters of a name in the table.
const LONGEST_NAME: usize = 40;

/// Where a run stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RunState {
    /// A training run writes into it.
    Training,
    /// All steps are made.
    Finished,
    /// It was stopped by a signal, by `--stop-after` or by a file `stop`.
    Stopped,
    /// It ended by an error, or was killed.
    Failed,
}

/// A run as it is shown.
pub struct Run {
    pub path: PathBuf,
    pub name: String,
    state: RunState,
    total_steps: Option<u64>,
    pub figures: Figures,
    pub config: Option<Config>,
    /// How its settings differ from the default.
    changed: Vec<Difference>,
    /// Why files of it cannot be read.
    problems: Vec<String>,
}

/// The figures in the table of a run, NaN where it has none.
#[derive(Clone)]
pub struct Figures {
    /// The stamp of the table that they were read from.
    stamp: Option<Stamp>,
    env_steps: Option<u64>,
    steps_per_s: f64,
    /// Goals of the last evaluation and of the best one.
    goals: f64,
    best_goals: f64,
    problem: Option<String>,
}

impl Run {
    /// Reads what the files of a run show at the time `now`. Figures that are `known` are read again only if the table has changed.
    pub fn of(
        path: &Path,
        glance: &Glance,
        default: &Config,
        known: Option<&Figures>,
        now: SystemTime,
    ) -> Self {
        let read = |path: &PathBuf| Source::new(path, os::read_text(path)?).resolve();
        let mut problems = Vec::new();
        let config = glance.config.as_ref().and_then(|path| {
            let unfit =
                |error| problems.push(format!("config.toml does not fit this version: {error:#}"));
            read(path).map_err(unfit).ok()
        });
        let stamp = glance.metrics.as_deref().and_then(os::stamp);
        let figures = match known.filter(|known| known.stamp == stamp) {
            Some(known) => known.clone(),
            None => Figures::of(path, stamp),
        };
        problems.extend(figures.problem.clone());
        let total_steps = config.as_ref().map(|config| config.run.total_steps);
        // A run that waits for evaluations to rise may end before, and its mark says so.
        let ends_early = config
            .as_ref()
            .is_some_and(|config| config.run.patience > 0);
        let needed = total_steps.filter(|_| !ends_early);
        let whole = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        Self {
            name: whole
                .file_name()
                .unwrap_or(whole.as_os_str())
                .display()
                .to_string(),
            state: RunState::of(glance, figures.env_steps, needed, now),
            total_steps,
            changed: config
                .as_ref()
                .map_or(Vec::new(), |config| default.compared_with(config)),
            problems,
            path: path.to_owned(),
            figures,
            config,
        }
    }

    /// Whether it has a table of figures.
    pub fn has_table(&self) -> bool {
        self.figures.stamp.is_some()
    }

    /// The time that its steps take at its present speed, if it trains.
    fn left(&self) -> Option<Duration> {
        let steps = self.total_steps?.saturating_sub(self.figures.env_steps?);
        let left = Duration::try_from_secs_f64(steps as f64 / self.figures.steps_per_s).ok();
        left.filter(|_| self.state == RunState::Training)
    }

    /// The cells of its row.
    pub fn cells(&self) -> Vec<String> {
        let Figures {
            env_steps,
            steps_per_s,
            goals,
            best_goals,
            ..
        } = self.figures;
        let steps = match (env_steps, self.total_steps) {
            (Some(made), Some(all)) => of_all(made, all),
            (Some(made), None) => count(made as f64),
            (None, _) => "-".into(),
        };
        let changed = self.changed.iter().filter(|(key, _)| !is_derived(key));
        let settings = match (&self.problems[..], &self.config) {
            ([], None) => "no config.toml".into(),
            ([], _) => {
                let changed = changed.map(|(key, [_, own])| format!("{key}={}", short(own)));
                Vec::from_iter(changed).join(" ")
            }
            (problems, _) => Vec::from_iter(problems.join("; ").lines().map(str::trim)).join(" "),
        };
        let name = match self.name.char_indices().nth(LONGEST_NAME) {
            Some((end, _)) => format!("{}…", &self.name[..end]),
            None => self.name.clone(),
        };
        vec![
            harmless(&name),
            self.state.name().into(),
            self.left().map_or("-".into(), span),
            steps,
            count(steps_per_s),
            number(goals, 2),
            number(best_goals, 2),
            harmless(&settings),
        ]
    }

    /// Its object of JSON.
    pub fn as_json(&self) -> Value {
        let changed = self.config.as_ref().map(|_| {
            let changed = self.changed.iter();
            Value::from_iter(changed.map(|(key, [_, own])| (key.clone(), json!(own))))
        });
        let Figures {
            env_steps,
            steps_per_s,
            goals,
            best_goals,
            ..
        } = self.figures;
        json!({
            "name": self.name,
            "path": self.path.to_string_lossy(),
            "state": self.state.name(),
            "seconds_left": self.left().map(|left| left.as_secs()),
            "env_steps": env_steps,
            "total_steps": self.total_steps,
            "steps_per_s": steps_per_s,
            "goals": goals,
            "best_goals": best_goals,
            "changed": changed,
            "problems": self.problems,
        })
    }
}

impl Figures {
    /// Reads the table of a run, if it has one.
    fn of(run: &Path, stamp: Option<Stamp>) -> Self {
        let unknown = f64::NAN;
        let none = Self {
            stamp,
            env_steps: None,
            steps_per_s: unknown,
            goals: unknown,
            best_goals: unknown,
            problem: None,
        };
        if stamp.is_none() {
            return none;
        }
        let read = || -> Result<Self> {
            let names = ["env_steps", "time/steps_per_s", "eval/goals"];
            let table = read_metrics(run, &names[..1], &names[1..])?;
            let [steps, speeds, goals] = names.map(|name| table.column(name));
            let known = |values: &[f64]| {
                let values = values.iter().copied();
                Vec::from_iter(values.filter(|value| !value.is_nan()))
            };
            let speeds = known(&speeds[speeds.len().saturating_sub(LAST)..]);
            let goals = known(goals);
            Ok(Self {
                env_steps: Some(steps.last().map_or(0, |steps| *steps as u64)),
                steps_per_s: mean(&speeds),
                goals: *goals.last().unwrap_or(&unknown),
                best_goals: goals.into_iter().fold(unknown, f64::max),
                ..none.clone()
            })
        };
        read().unwrap_or_else(|error| Self {
            problem: Some(format!("{error:#}")),
            ..none
        })
    }
}

impl RunState {
    /// The state of a run with these files and steps.
    fn of(
        glance: &Glance,
        env_steps: Option<u64>,
        total_steps: Option<u64>,
        now: SystemTime,
    ) -> Self {
        let all = env_steps.zip(total_steps).map(|(made, all)| made >= all);
        let is_silent = |logged| now.duration_since(logged).unwrap_or_default() >= SILENT;
        // One that could not save its end has neither the mark nor released its lock.
        let has_ended = glance.is_marked || glance.hold == Hold::Released;
        match glance.hold {
            Hold::Held => Self::Training,
            _ if has_ended && all.unwrap_or(glance.is_marked) => Self::Finished,
            _ if glance.is_marked => Self::Stopped,
            Hold::Elsewhere if !glance.logged.is_none_or(is_silent) => Self::Training,
            Hold::Released => Self::Stopped,
            Hold::Left | Hold::Elsewhere => Self::Failed,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Finished => "finished",
            Self::Stopped => "stopped",
            Self::Failed => "failed",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_follows_from_the_lock_the_mark_the_steps_and_where_no_lock_is_seen_from_the_age() {
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1000);
        let state = |hold, is_marked, made: Option<u64>, age| {
            let logged = Some(now - Duration::from_secs(age));
            let glance = Glance {
                begun: None,
                hold,
                is_marked,
                config: None,
                metrics: None,
                logged,
            };
            RunState::of(&glance, made, Some(9), now)
        };
        use Hold::{Elsewhere, Held, Left, Released};
        assert_eq!(
            state(Held, true, Some(9), 500),
            RunState::Training,
            "resumed with more steps, before its first iteration"
        );
        assert_eq!(state(Left, true, Some(9), 500), RunState::Finished);
        assert_eq!(state(Released, false, Some(9), 500), RunState::Finished);
        assert_eq!(
            state(Left, false, Some(9), 500),
            RunState::Failed,
            "its end could not be saved"
        );
        assert_eq!(
            state(Released, true, None, 500),
            RunState::Finished,
            "a table that cannot be read"
        );
        assert_eq!(
            state(Released, true, Some(5), 500),
            RunState::Stopped,
            "by a file"
        );
        assert_eq!(state(Released, false, Some(5), 500), RunState::Stopped);
        assert_eq!(
            [state(Left, false, Some(5), 3), state(Left, false, None, 3)],
            [RunState::Failed; 2]
        );
        assert_eq!(state(Elsewhere, false, Some(5), 3), RunState::Training);
        assert_eq!(state(Elsewhere, false, Some(5), 500), RunState::Failed);
    }
}
