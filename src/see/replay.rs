//! Episodes as one HTML file, made of the records of a trace.

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};

use crate::draw::Page;
use crate::repose::{Task, TaskReward};
use crate::sim::Drawing;

/// The most episodes of a file: it is read at once, and each adds 57 kB.
pub const MOST_EPISODES: u64 = 20;

/// The most records: those of so many episodes of an hour.
const MOST_RECORDS: usize = 1 << 20;

/// The scalars of a row before the terms of the reward.
const SCALARS: [&str; 5] = ["step", "error", "distance", "held", "goals"];

/// What a replay says of the episodes in it.
pub struct About {
    /// What is shown, in a few words.
    pub title: String,
    /// The policy, by its name or place.
    pub policy: Option<String>,
    /// What the episodes are drawn from.
    pub seed: Option<u64>,
    /// The settings that differ from the default ones, by dotted key.
    pub settings: Value,
}

/// Returns the page that shows the first `episodes` of a trace of `task`, which was loaded for display.
///
/// # Errors
/// Fails if the text is no trace, or one of another scene.
pub fn replay(task: &Task, trace: &str, episodes: usize, about: About) -> Result<Page> {
    let mut lines = trace.lines();
    let header: Value =
        lines.next().and_then(|line| serde_json::from_str(line).ok()).context("it does not begin with a header")?;
    let mut drawing = task.scene().drawing(task.config().model_file().is_none());
    let mut rows = Rows::new(task, &drawing);
    for (number, line) in lines.enumerate() {
        ensure!(number < MOST_RECORDS, "it has more than {MOST_RECORDS} records");
        let record: Value = serde_json::from_str(line).with_context(|| format!("record {number} is not JSON"))?;
        if record["episode"].as_u64().is_some_and(|episode| episode < episodes as u64) {
            rows.add(&record).with_context(|| format!("record {number}"))?;
        }
    }
    ensure!(!rows.rows.is_empty(), "it has no records of an episode");
    let numbers = drawing.start.len();
    let number = |key: &str, own: f64| header[key].as_f64().filter(|x| x.is_finite() && *x > 0.0).unwrap_or(own);
    let config = task.config();
    let terms: Vec<&str> = TaskReward::default().named().map(|(name, _)| name).collect();
    let scalars = [&SCALARS[..], &terms].concat();
    let meta = json!({
        "format": 1,
        "title": about.title,
        "program": format!("shadow-repose {}", env!("CARGO_PKG_VERSION")),
        "policy": about.policy,
        "seed": about.seed,
        "settings": about.settings,
        "dt": number("ctrl_dt", config.ctrl_dt),
        "every": 1,
        "tolerance": number("success_tolerance", config.success_tolerance),
        "hold": number("max_consecutive_successes", config.max_consecutive_successes.into()),
        "hands": 1,
        "numbers": numbers,
        "scalars": scalars,
        "terms": terms,
        "live": false,
        "episodes": rows.episodes,
    });
    let meshes = std::mem::take(&mut drawing.meshes).into_iter().map(|mesh| (mesh.corners, mesh.triangles)).collect();
    let scene = serde_json::to_value(&drawing).context("the scene")?;
    Ok(Page { meta, scene, meshes, rows: rows.rows, counts: [0, 3, 4].map(|scalar| numbers + scalar).to_vec() })
}

/// The rows of a replay.
struct Rows {
    /// The poses at the start; those of mocap bodies but the goal's stay.
    start: Vec<f64>,
    positions: usize,
    /// Where the goal's orientation is among the numbers.
    goal: usize,
    /// Where quaternions are among the numbers.
    quaternions: Vec<usize>,
    rows: Vec<Vec<f64>>,
    episodes: Vec<Value>,
}

impl Rows {
    fn new(task: &Task, drawing: &Drawing) -> Self {
        let (mut start, positions) = (drawing.start.clone(), drawing.positions());
        let goal = positions + 7 * task.hand().target.number();
        start[goal..goal + 3].copy_from_slice(&task.goal_place());
        let quaternions = drawing.quaternions();
        Self { start, positions, goal: goal + 3, quaternions, rows: Vec::new(), episodes: Vec::new() }
    }

    /// Adds a record of a trace.
    ///
    /// # Errors
    /// Fails if it is none, or of another scene.
    fn add(&mut self, record: &Value) -> Result<()> {
        let list = |key: &str, length: usize| {
            let found: Option<Vec<f64>> =
                record[key].as_array().and_then(|list| list.iter().map(Value::as_f64).collect());
            let fits = found.filter(|found| found.len() == length && found.iter().all(|x| x.abs() < 1e9));
            fits.with_context(|| format!("{key} is not a list of {length} numbers, as in this scene"))
        };
        let mut row = self.start.clone();
        row[..self.positions].copy_from_slice(&list("qpos", self.positions)?);
        row[self.goal..self.goal + 4].copy_from_slice(&list("goal", 4)?);
        let number = |value: &Value| value.as_f64().filter(|x| x.abs() < 1e9);
        let begins = record["reset"] == true;
        ensure!(begins || !self.episodes.is_empty(), "it is not the first one of an episode");
        if begins {
            self.episodes.push(json!({ "row": self.rows.len(), "hand": 0, "end": "it goes on" }));
        } else if let Some(before) = self.rows.last() {
            // q and -q are the same turn; the page moves from one to the other.
            for &place in &self.quaternions {
                let same: f64 = (place..place + 4).map(|i| row[i] * before[i]).sum();
                if same < 0.0 {
                    row[place..place + 4].iter_mut().for_each(|x| *x = -*x);
                }
            }
        }
        for key in ["step", "rot_dist", "goal_dist", "held", "goals"] {
            row.push(number(&record[key]).unwrap_or(0.0));
        }
        row.extend(TaskReward::default().named().map(|(term, _)| number(&record["reward"][term]).unwrap_or(0.0)));
        let (error, places) = (self.start.len() + 1, self.rows.len());
        // A reset has no error of its own; it is that of the first step, to a hundredth.
        if let Some(first) = self.rows.last_mut().filter(|first| first[error - 1] == 0.0 && places > 0 && !begins) {
            first[error] = row[error];
        }
        for (key, end) in [
            ("terminated", "the cube was dropped"),
            ("truncated", "the time was up"),
            ("diverged", "the physics diverged"),
        ] {
            if record[key] == true
                && let Some(episode) = self.episodes.last_mut()
            {
                episode["end"] = end.into();
            }
        }
        self.rows.push(row);
        Ok(())
    }
}
