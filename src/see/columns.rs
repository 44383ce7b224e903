//! What a page shows of a task: its scene, and for each step a row of numbers, which are poses and then scalars.

use std::sync::Arc;

use anyhow::{Context, Result};
use serde_json::{Value, json};

use crate::draw::Page;
use crate::env::Env;
use crate::repose::{Repose, Task, TaskReward, task_terms};
use crate::sim::{Camera, Drawing};

/// The scalars before the terms of the reward.
const SCALARS: [&str; 4] = ["step", "error", "held", "goals"];

/// The largest number of a pose (m, rad) and of a scalar that a page is given. The largest one of a column sets its precision.
const FARTHEST: f64 = 100.0;
const LARGEST: f64 = 1e9;

/// The largest count: a page counts in 16 bits.
pub const MOST: u32 = 32_767;

/// The scene of a task, and where the numbers of a row are.
pub struct Columns {
    /// The task, which was loaded for display.
    pub task: Arc<Task>,
    /// Its numbers at the start are the poses in which nothing has moved, with the goal in its place. Mocap bodies other than the
    /// goal stay.
    drawing: Drawing,
    /// Where the orientation of the goal begins.
    goal: usize,
}

impl Columns {
    pub fn new(task: &Arc<Task>, camera: Option<Camera>) -> Self {
        let is_builtin = task.config.model_file().is_none();
        let mut drawing = task
            .scene
            .drawing(task.hand.side().filter(|_| is_builtin), camera);
        if is_builtin && camera.is_none() {
            // Near enough for hand, cube and goal to fill the picture.
            drawing.scene["camera"] = json!({
                "azimuth": 142.0,
                "elevation": -33.0,
                "distance": 0.58,
                "center": [0.315, 0.0, 0.362],
                "fovy": 40.0,
                "fit": false,
            });
        }
        let goal = drawing.positions + 7 * task.hand.goal.0;
        drawing.start[goal..goal + 3].copy_from_slice(&task.goal_place());
        Self {
            task: task.clone(),
            drawing,
            goal: goal + 3,
        }
    }

    /// How many numbers give the poses.
    fn poses(&self) -> usize {
        self.drawing.start.len()
    }

    /// The names of the terms of the reward.
    fn terms() -> impl Iterator<Item = &'static str> {
        task_terms().into_iter().map(|term| term.0)
    }

    /// The place of the rotation error.
    pub fn error(&self) -> usize {
        self.poses() + 1
    }

    /// The row of an environment after a reset or a step, with these terms of the reward.
    pub fn of(&self, env: &Repose, reward: TaskReward) -> Vec<f64> {
        let last = &env.last;
        let episode = env.episode();
        let (goal, error) = if episode.length == 0 {
            (env.goal, env.rot_dist())
        } else {
            (last.goal, last.rot_dist)
        };
        let scalars = [
            episode.length.into(),
            error,
            env.held.into(),
            episode.goals.into(),
        ];
        self.row(env.sim.qpos(), &goal, scalars, &reward)
    }

    /// The row of a record of a trace.
    ///
    /// # Errors
    /// Fails if it is not a record, or is one of another scene.
    pub fn of_record(&self, record: &Value) -> Result<Vec<f64>> {
        let number = |value: &Value| value.as_f64().filter(|x| x.abs() < LARGEST);
        let list = |key: &str, length: usize| {
            let list = record[key].as_array().filter(|list| list.len() == length);
            let numbers: Option<Vec<f64>> = list.and_then(|list| list.iter().map(number).collect());
            numbers.with_context(|| {
                format!("`{key}` is not a list of {length} numbers, as in this scene")
            })
        };
        // A reset has no errors, no counts and no reward.
        let is_reset = record["reset"] == true;
        let value = |value: &Value, what: &str| match number(value) {
            None if is_reset => Ok(0.0),
            found => found.with_context(|| format!("`{what}` is not a number")),
        };
        let count = |key: &str| {
            if is_reset && key != "step" {
                return Ok(0.0);
            }
            let count = record[key].as_u64().filter(|count| *count <= MOST.into());
            count
                .map(|count| count as f64)
                .with_context(|| format!("`{key}` is not a count up to {MOST}"))
        };
        let scalars = [
            count("step")?,
            value(&record["rot_dist"], "rot_dist")?,
            count("held")?,
            count("goals")?,
        ];
        let reward: Result<Vec<f64>> = Self::terms()
            .map(|term| value(&record["reward"][term], term))
            .collect();
        Ok(self.row(
            &list("qpos", self.drawing.positions)?,
            &list("goal", 4)?,
            scalars,
            &reward?,
        ))
    }

    fn row(
        &self,
        qpos: &[f64],
        goal: &[f64],
        scalars: [f64; SCALARS.len()],
        reward: &[f64],
    ) -> Vec<f64> {
        let mut row = self.drawing.start.clone();
        row[..self.drawing.positions].copy_from_slice(qpos);
        row[self.goal..self.goal + 4].copy_from_slice(goal);
        row.extend(scalars.iter().chain(reward));
        // The physics of the last step of an episode may have diverged.
        for (place, x) in row.iter_mut().enumerate() {
            let is_pose = place < self.poses();
            let most = if is_pose { FARTHEST } else { LARGEST };
            *x = if x.is_nan() {
                0.0
            } else {
                x.clamp(-most, most)
            };
        }
        row
    }

    /// Gives a row the poses of the row before: poses after a step that diverged mean nothing.
    pub fn stay(&self, row: &mut [f64], before: &[f64]) {
        row[..self.poses()].copy_from_slice(&before[..self.poses()]);
    }

    /// Chooses the signs of the quaternions of a row to continue the row before: q and -q are the same rotation.
    pub fn go_on(&self, row: &mut [f64], before: &[f64]) {
        for &place in &self.drawing.quaternions {
            let same: f64 = (place..place + 4).map(|i| row[i] * before[i]).sum();
            if same < 0.0 {
                row[place..place + 4].iter_mut().for_each(|x| *x = -*x);
            }
        }
    }

    /// The page of these rows, with more entries for what it says of itself. Only the first one has a scene.
    pub fn page(&mut self, about: &About, more: Value, rows: Vec<Vec<f64>>) -> Page {
        let config = &self.task.config;
        let mut meta = json!({
            "format": 1,
            "title": about.title,
            "program": format!("shadow-repose {}", env!("CARGO_PKG_VERSION")),
            "policy": about.policy,
            "seed": about.seed.map(|seed| seed.to_string()),
            "settings": config.unlike_default(),
            "dt": config.ctrl_dt,
            "every": 1,
            "tolerance": config.success_tolerance,
            "hold": config.max_consecutive_successes,
            "hands": 1,
            "numbers": self.poses(),
            "scalars": Vec::from_iter(SCALARS.into_iter().chain(Self::terms())),
            "terms": Vec::from_iter(Self::terms()),
            "live": false,
        });
        for (key, value) in more.as_object().into_iter().flatten() {
            meta[key] = value.clone();
        }
        let mut scene = self.drawing.scene.take();
        scene["start"] = json!(self.drawing.start);
        Page {
            meta,
            scene,
            meshes: std::mem::take(&mut self.drawing.meshes),
            rows,
            counts: [0, 2, 3].map(|scalar| self.poses() + scalar).to_vec(),
        }
    }
}

/// What a page says of all that it shows.
#[derive(Clone)]
pub struct About {
    /// What is shown, in a few words.
    pub title: String,
    /// The policy, by its place.
    pub policy: Option<String>,
    /// What the episodes are drawn from.
    pub seed: Option<u64>,
}
