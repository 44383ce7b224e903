//! Episodes as one HTML file.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};

use super::columns::{About, Columns, MOST};
use crate::draw::Page;
use crate::env::End;
use crate::evaluate::Moment;
use crate::repose::{Task, TaskReward};
use crate::sim::Camera;

/// The most episodes of a file, and the most steps of all of them. A browser reads the file at once, and 1000 steps add 57 kB.
const MOST_EPISODES: usize = 20;
const MOST_STEPS: usize = 60_000;

/// Episodes that become a file.
pub struct Replay {
    columns: Columns,
    /// By their numbers.
    episodes: BTreeMap<usize, Recorded>,
}

/// An episode: its rows, and how it ended.
#[derive(Default)]
struct Recorded {
    rows: Vec<Vec<f64>>,
    end: Option<&'static str>,
}

impl Replay {
    /// Begins a file of so many `episodes` of `task`, which was loaded for display, perhaps with another camera than its own.
    ///
    /// # Errors
    /// Fails if they are longer than a page can count, or than a browser opens soon.
    pub fn new(task: &Arc<Task>, camera: Option<Camera>, episodes: usize) -> Result<Self> {
        let steps = task.config.max_episode_steps();
        let all = steps as usize * episodes;
        ensure!(episodes <= MOST_EPISODES, "an HTML file shows at most {MOST_EPISODES} episodes, not {episodes}");
        ensure!(
            steps <= MOST,
            "env.max_episode_seconds: an HTML file shows episodes of at most {MOST} steps, not {steps}"
        );
        ensure!(all <= MOST_STEPS, "an HTML file shows at most {MOST_STEPS} steps, not {all}: play fewer episodes");
        Ok(Self { columns: Columns::new(task, camera), episodes: BTreeMap::new() })
    }

    /// Records a moment of an episode.
    pub fn observe(&mut self, moment: &Moment) {
        let last = &moment.env.last;
        let begins = moment.step.is_none();
        let row = self.columns.of(moment.env, if begins { TaskReward::default() } else { last.reward });
        let end = moment.step.and_then(|(_, end)| end).map(|end| match end {
            End::Terminated if last.diverged => "diverged",
            End::Terminated => "terminated",
            End::Truncated | End::Redirected => "truncated",
        });
        self.add(moment.episode, row, end);
    }

    /// Records the first `MOST_EPISODES` episodes of a trace, and returns how many more it has.
    ///
    /// # Errors
    /// Fails if the text is no trace, or one of another scene.
    pub fn read(&mut self, trace: &str) -> Result<usize> {
        let mut begun = 0;
        let mut rows = 0;
        let lines = trace.lines().enumerate().skip(1).filter(|(_, line)| !line.is_empty());
        for (number, line) in lines {
            let what = || format!("line {}", number + 1);
            let record: Value = serde_json::from_str(line).ok().context("it is not JSON").with_context(what)?;
            begun += usize::from(record["reset"] == true);
            ensure!(begun > 0, "{}: it is not the first record of an episode", what());
            if begun <= MOST_EPISODES {
                let row = self.columns.of_record(&record).with_context(what)?;
                let end = ["diverged", "terminated", "truncated"].into_iter().find(|end| record[end] == true);
                self.add(begun - 1, row, end);
                rows += 1;
                ensure!(rows <= MOST_STEPS + MOST_EPISODES, "it has more than {MOST_STEPS} steps");
            }
        }
        Ok(begun.saturating_sub(MOST_EPISODES))
    }

    /// Adds a row to an episode, and how the episode ended, if it did, by the name that a trace gives it.
    fn add(&mut self, episode: usize, mut row: Vec<f64>, end: Option<&'static str>) {
        let Recorded { rows, end: ended } = self.episodes.entry(episode).or_default();
        if let Some(before) = rows.last() {
            self.columns.go_on(&mut row, before);
            if end == Some("diverged") {
                self.columns.stay(&mut row, before);
            }
        }
        // A trace has no rotation error of a reset. The error of the first step is the same to a hundredth.
        let error = self.columns.error();
        if let [first] = &mut rows[..]
            && first[error] == 0.0
        {
            first[error] = row[error];
        }
        rows.push(row);
        *ended = end;
    }

    /// The file.
    ///
    /// # Errors
    /// Fails if there are no episodes.
    pub fn page(mut self, about: &About) -> Result<Page> {
        ensure!(!self.episodes.is_empty(), "it has no records of an episode");
        let mut rows = Vec::new();
        let mut episodes = Vec::new();
        for Recorded { rows: own, end } in self.episodes.into_values() {
            let end = match end {
                Some("diverged") => "the physics diverged",
                Some("terminated") => "the object was dropped",
                Some(_) => "the time was up",
                None => "it is not shown",
            };
            episodes.push(json!({ "row": rows.len(), "hand": 0, "end": end }));
            rows.extend(own);
        }
        self.columns.page(about, json!({ "episodes": episodes }), rows)
    }
}
