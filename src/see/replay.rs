//! Episodes as one HTML file.

use std::collections::BTreeMap;

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};

use super::columns::{About, Columns, MOST};
use super::display::task_for_display;
use crate::env::End;
use crate::evaluate::Moment;
use crate::os::{Destination, OutputFile, say};
use crate::repose::{Task, TaskReward};
use crate::sim::Look;

/// The most episodes of a file, and the most steps of all of them. A browser reads the file at once, and 1000 steps add 57 kB.
const MOST_EPISODES: usize = 20;
const MOST_STEPS: usize = 60_000;

/// Episodes that become a file.
pub struct Replay {
    /// The file.
    pub output: OutputFile,
    columns: Columns,
    /// The rows of each episode, and how it ended, by its number.
    episodes: BTreeMap<usize, (Vec<Vec<f64>>, Option<&'static str>)>,
}

impl Replay {
    /// Begins a file of so many `episodes` of `task` with this look.
    ///
    /// # Errors
    /// Fails if it cannot be written, or if the episodes are longer than a page can count, or than a browser opens soon.
    pub fn begin(to: &Destination, task: &Task, look: &Look, episodes: usize) -> Result<Self> {
        let output = OutputFile::create(&to.path)?;
        let task = task_for_display(task, look)?;
        let steps = task.config.max_episode_steps();
        let all = steps as usize * episodes;
        ensure!(
            episodes <= MOST_EPISODES,
            "an HTML file shows at most {MOST_EPISODES} episodes, not {episodes}"
        );
        ensure!(
            steps <= MOST,
            "env.max_episode_seconds: an HTML file shows episodes of at most {MOST} steps, not {steps}"
        );
        ensure!(
            all <= MOST_STEPS,
            "an HTML file shows at most {MOST_STEPS} steps, not {all}: play fewer episodes"
        );
        Ok(Self {
            output,
            columns: Columns::new(&task, look.camera),
            episodes: BTreeMap::new(),
        })
    }

    /// Records a moment of an episode.
    pub fn observe(&mut self, moment: &Moment) {
        let last = &moment.env.last;
        let reward = moment.step.map_or(TaskReward::default(), |_| last.reward);
        let row = self.columns.of(moment.env, reward);
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
        let lines = trace
            .lines()
            .enumerate()
            .skip(1)
            .filter(|(_, line)| !line.is_empty());
        for (number, line) in lines {
            let what = || format!("line {}", number + 1);
            let record: Value = serde_json::from_str(line)
                .ok()
                .context("it is not JSON")
                .with_context(what)?;
            begun += usize::from(record["reset"] == true);
            ensure!(
                begun > 0,
                "{}: it is not the first record of an episode",
                what()
            );
            if begun <= MOST_EPISODES {
                let row = self.columns.of_record(&record).with_context(what)?;
                let end = ["diverged", "terminated", "truncated"]
                    .into_iter()
                    .find(|end| record[end] == true);
                self.add(begun - 1, row, end);
                rows += 1;
                ensure!(
                    rows <= MOST_STEPS + MOST_EPISODES,
                    "it has more than {MOST_STEPS} steps"
                );
            }
        }
        Ok(begun.saturating_sub(MOST_EPISODES))
    }

    /// Adds a row to an episode, and how the episode ended, if it did, by the name that a trace gives it.
    fn add(&mut self, episode: usize, mut row: Vec<f64>, end: Option<&'static str>) {
        let (rows, ended) = self.episodes.entry(episode).or_default();
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

    /// Writes the file.
    ///
    /// # Errors
    /// Fails if there are no episodes, or if it cannot be written.
    pub fn finish(mut self, about: &About) -> Result<()> {
        ensure!(!self.episodes.is_empty(), "it has no records of an episode");
        let mut rows = Vec::new();
        let mut episodes = Vec::new();
        for (own, end) in self.episodes.into_values() {
            let end = match end {
                Some("diverged") => "the physics diverged",
                Some("terminated") => "the object was dropped",
                Some(_) => "the time was up",
                None => "it is not shown",
            };
            episodes.push(json!({ "row": rows.len(), "hand": 0, "end": end }));
            rows.extend(own);
        }
        let html = self
            .columns
            .page(about, json!({ "episodes": episodes }), rows)
            .html();
        let path = self.output.path.display().to_string();
        self.output.finish(html.as_bytes())?;
        say!("{path}: {} kB", html.len().div_ceil(1000));
        Ok(())
    }
}
