//! The score of a set of episodes.
//!
//! A measure is one row of [`MEASURES`]. Its key in JSON, its column in `metrics.csv`, its tag, its line in the table of `play` and its
//! title in a chart follow from that row.

use std::ops::Index;

use serde_json::{Map, Value, json};

use super::divergence::divergence;
use super::{EpisodeStats, TaskReward, add, named, task_terms};
use crate::os::number;

/// Which values of a measure are better.
#[derive(Clone, Copy)]
pub enum Better {
    /// The higher ones.
    Higher,
    /// The lower ones.
    Lower,
}

use Better::{Higher, Lower};

/// A measure of a set of episodes.
pub struct Measure {
    /// The key in JSON.
    pub key: &'static str,
    /// The name in columns and tags, by which a [`Score`] is indexed.
    pub column: &'static str,
    /// The name in tables and charts.
    pub title: &'static str,
    /// The unit in tables. It is `%` for a fraction, and empty for a plain number.
    pub unit: &'static str,
    /// The decimals in tables.
    pub decimals: usize,
    /// Which values are better.
    pub better: Better,
    /// A description in a sentence.
    pub description: &'static str,
    value: fn(&Played) -> f64,
}

/// All measures, in the order of JSON and of the table of `play`.
#[rustfmt::skip]
pub const MEASURES: [Measure; 11] = [
    Measure { key: "goals_per_episode", column: "goals", title: "goals per episode", unit: "", decimals: 3, better: Higher,
        description: "Goals reached and held in an episode.",
        value: |played| played.mean(|e| e.goals.into()) },
    Measure { key: "in_tolerance", column: "in_tolerance", title: "steps in tolerance", unit: "%", decimals: 2, better: Higher,
        description: "Fraction of the steps within the task's tolerance.",
        value: |played| played.sum(|e| e.in_tolerance.into()) / played.steps() },
    Measure { key: "rot_dist", column: "rot_dist", title: "rotation error", unit: "rad", decimals: 3, better: Lower,
        description: "Rotation error, mean over the steps.",
        value: |played| played.sum(|e| e.rot_dist_sum) / (played.steps() - played.diverged() as f64) },
    Measure { key: "steps_per_goal", column: "steps_per_goal", title: "steps per goal", unit: "", decimals: 0, better: Lower,
        description: "Control steps per goal reached.",
        value: |played| played.steps_per_goal() },
    Measure { key: "seconds_per_goal", column: "seconds_per_goal", title: "seconds per goal", unit: "", decimals: 2, better: Lower,
        description: "Seconds of the simulation per goal reached.",
        value: |played| played.steps_per_goal() * played.ctrl_dt },
    Measure { key: "success_rate", column: "success_rate", title: "success rate", unit: "%", decimals: 1, better: Higher,
        description: "Fraction of the episodes with at least one goal.",
        value: |played| played.share(|e| e.goals >= 1) },
    Measure { key: "success_rate_5", column: "success_rate_5", title: "five-goal rate", unit: "%", decimals: 1, better: Higher,
        description: "Fraction of the episodes with at least five goals.",
        value: |played| played.share(|e| e.goals >= 5) },
    Measure { key: "turned", column: "turned", title: "turned", unit: "rad/100 steps", decimals: 2, better: Higher,
        description: "Rotation towards the goal in 100 steps, rad.",
        value: |played| 100.0 * played.sum(|e| e.turned) / played.steps() },
    Measure { key: "drop_rate", column: "drop_rate", title: "drop rate", unit: "%", decimals: 1, better: Lower,
        description: "Fraction of the episodes that ended with a drop.",
        value: |played| played.share(|e| e.dropped) },
    Measure { key: "episode_length", column: "length", title: "episode length", unit: "steps", decimals: 1, better: Higher,
        description: "Control steps of an episode.",
        value: |played| played.mean(|e| e.length.into()) },
    Measure { key: "return", column: "return", title: "return", unit: "", decimals: 2, better: Higher,
        description: "Sum of the task's rewards of an episode.",
        value: |played| played.reward().iter().sum::<f64>() / played.count() },
];

/// The measures of a training run's own episodes, in the order of their columns.
pub const OF_TRAINING: [&str; 7] = [
    "return",
    "length",
    "goals",
    "in_tolerance",
    "drop_rate",
    "rot_dist",
    "steps_per_goal",
];

/// The measures of an evaluation during training, in the order of their columns.
pub const OF_EVALUATIONS: [&str; 8] = [
    "goals",
    "drop_rate",
    "rot_dist",
    "return",
    "success_rate",
    "success_rate_5",
    "seconds_per_goal",
    "turned",
];

/// The measures that summarise an evaluation.
pub const HEADLINE: [&str; 3] = ["goals", "rot_dist", "drop_rate"];

/// The measure with this column.
///
/// # Panics
/// Panics if there is none.
pub fn measure(column: &str) -> &'static Measure {
    &MEASURES[place(column)]
}

fn place(column: &str) -> usize {
    MEASURES
        .iter()
        .position(|measure| measure.column == column)
        .unwrap_or_else(|| panic!("no measure is called {column}"))
}

impl Measure {
    /// The title with the unit, e.g. `drop rate, %`.
    pub fn label(&self) -> String {
        match self.unit {
            "" => self.title.to_owned(),
            unit => format!("{}, {unit}", self.title),
        }
    }

    /// A value as it stands in a table, in the unit.
    pub fn text(&self, value: f64) -> String {
        let factor = if self.unit == "%" { 100.0 } else { 1.0 };
        number(factor * value, self.decimals)
    }
}

/// The episodes of a score.
struct Played<'a> {
    episodes: &'a [EpisodeStats],
    /// Seconds of a control step.
    ctrl_dt: f64,
}

impl Played<'_> {
    fn sum(&self, value: fn(&EpisodeStats) -> f64) -> f64 {
        self.episodes.iter().map(value).sum()
    }

    fn count(&self) -> f64 {
        self.episodes.len() as f64
    }

    fn mean(&self, value: fn(&EpisodeStats) -> f64) -> f64 {
        self.sum(value) / self.count()
    }

    fn share(&self, is: fn(&EpisodeStats) -> bool) -> f64 {
        self.episodes.iter().filter(|episode| is(episode)).count() as f64 / self.count()
    }

    fn steps(&self) -> f64 {
        self.sum(|episode| episode.length.into())
    }

    fn steps_per_goal(&self) -> f64 {
        let goals = self.sum(|episode| episode.goals.into());
        if goals > 0.0 {
            self.steps() / goals
        } else {
            f64::NAN
        }
    }

    /// The episodes that ended because the physics diverged. Sums leave out the steps on which it did.
    fn diverged(&self) -> usize {
        self.episodes
            .iter()
            .filter(|episode| episode.diverged)
            .count()
    }

    fn reward(&self) -> TaskReward {
        let mut total = TaskReward::default();
        for episode in self.episodes {
            add(&mut total, episode.reward);
        }
        total
    }

    /// 95 % confidence interval of the goals per episode: mean ± 1.96 standard errors, clipped at zero.
    fn goals_ci95(&self) -> [f64; 2] {
        let count = self.count();
        let mean = self.mean(|episode| episode.goals.into());
        let errors = self.episodes.iter().map(|e| f64::from(e.goals) - mean);
        let variance = errors.map(|error| error.powi(2)).sum::<f64>() / (count - 1.0);
        let margin = 1.96 * (variance / count).sqrt();
        [mean - margin, mean + margin].map(|x| x.clamp(0.0, f64::INFINITY))
    }
}

/// The measures of finished episodes, `NaN` where there is nothing to average. It is indexed by their columns.
#[derive(Clone, Copy, Debug, Default)]
pub struct Score {
    /// The number of episodes.
    pub episodes: usize,
    /// Control steps of all episodes together.
    pub env_steps: u64,
    /// 95 % confidence interval of the goals per episode.
    pub goals_ci95: [f64; 2],
    /// Mean sum of rewards of an episode, by term.
    pub reward: TaskReward,
    /// Episodes that ended because the physics diverged.
    pub diverged: usize,
    /// Observations whose prediction diverged.
    pub unpredicted: u64,
    /// The values of [`MEASURES`].
    values: [f64; MEASURES.len()],
}

impl Index<&str> for Score {
    type Output = f64;

    /// # Panics
    /// Panics if no measure has this column.
    fn index(&self, column: &str) -> &f64 {
        &self.values[place(column)]
    }
}

impl Score {
    /// Scores `episodes` with control steps of `ctrl_dt` seconds.
    pub fn of(episodes: &[EpisodeStats], ctrl_dt: f64) -> Self {
        let played = Played { episodes, ctrl_dt };
        Self {
            episodes: episodes.len(),
            env_steps: played.steps() as u64,
            goals_ci95: played.goals_ci95(),
            reward: played.reward().map(|term| term / played.count()),
            diverged: played.diverged(),
            unpredicted: episodes.iter().map(|episode| episode.unpredicted).sum(),
            values: MEASURES.each_ref().map(|measure| (measure.value)(&played)),
        }
    }

    /// A warning if many of the steps diverged. Each such step ended an episode.
    pub fn divergence(&self) -> Option<String> {
        divergence(self.diverged as u64, self.unpredicted, self.env_steps)
    }

    /// The values of all measures, in order.
    pub fn measured(&self) -> impl Iterator<Item = (&'static Measure, f64)> {
        MEASURES.iter().zip(self.values)
    }

    /// The values of these measures, by column.
    pub fn named<const N: usize>(&self, columns: [&'static str; N]) -> [(&'static str, f64); N] {
        columns.map(|column| (column, self[column]))
    }

    /// All that is known, as an object of JSON in which unknown values are null.
    pub fn as_json(&self) -> Map<String, Value> {
        let reward =
            named(task_terms(), self.reward).map(|(term, value)| (term.to_owned(), json!(value)));
        let mut object = Map::new();
        let mut put = |key: &str, value: Value| object.insert(key.to_owned(), value);
        put("episodes", json!(self.episodes));
        put("env_steps", json!(self.env_steps));
        for (measure, value) in self.measured() {
            put(measure.key, json!(value));
            if measure.column == "goals" {
                put("goals_ci95", json!(self.goals_ci95));
            }
        }
        put("reward", Value::Object(reward.collect()));
        put("diverged", json!(self.diverged));
        if self.unpredicted > 0 {
            put("unpredicted", json!(self.unpredicted));
        }
        object
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_is_the_mean_worked_out_by_hand() {
        let reward = |rotation| [rotation, 0.0, 0.0, 0.0, 0.0];
        let one = EpisodeStats {
            length: 1000,
            goals: 5,
            in_tolerance: 200,
            rot_dist_sum: 500.0,
            reward: reward(30.0),
            turned: 9.0,
            ..Default::default()
        };
        let two = EpisodeStats {
            length: 500,
            goals: 1,
            rot_dist_sum: 1000.0,
            reward: reward(10.0),
            dropped: true,
            ..Default::default()
        };
        let score = Score::of(&[one, two], 0.02);
        let by_hand = [
            ("goals", "goals_per_episode", 3.0),
            ("in_tolerance", "in_tolerance", 200.0 / 1500.0),
            ("rot_dist", "rot_dist", 1.0),
            ("steps_per_goal", "steps_per_goal", 250.0),
            ("seconds_per_goal", "seconds_per_goal", 5.0),
            ("success_rate", "success_rate", 1.0),
            ("success_rate_5", "success_rate_5", 0.5),
            ("turned", "turned", 0.6),
            ("drop_rate", "drop_rate", 0.5),
            ("length", "episode_length", 750.0),
            ("return", "return", 20.0),
        ];
        let found: Vec<_> = score
            .measured()
            .map(|(measure, value)| (measure.column, measure.key, value))
            .collect();
        assert_eq!(found, by_hand);
        assert_eq!(
            [score.episodes, score.env_steps as usize, score.diverged],
            [2, 1500, 0]
        );
        assert_eq!(score.reward[0], 20.0);
        // Standard deviation √8, standard error 2.
        assert!((score.goals_ci95[1] - (3.0 + 1.96 * 2.0)).abs() < 1e-12);
        assert_eq!(score.goals_ci95[0], 0.0);
    }

    #[test]
    fn the_step_on_which_physics_diverged_has_no_rotation_error() {
        let episode = EpisodeStats {
            length: 11,
            rot_dist_sum: 5.0,
            diverged: true,
            ..Default::default()
        };
        assert_eq!(Score::of(&[episode], 0.01)["rot_dist"], 0.5);
    }

    #[test]
    fn nothing_scores_nothing() {
        let score = Score::of(&[], 0.01);
        assert!(
            score["goals"].is_nan() && score["rot_dist"].is_nan() && score.goals_ci95[0].is_nan()
        );
        let idle = Score::of(
            &[EpisodeStats {
                length: 5,
                ..Default::default()
            }],
            0.01,
        );
        assert!(
            idle["steps_per_goal"].is_nan()
                && idle["seconds_per_goal"].is_nan()
                && idle["success_rate"] == 0.0
        );
    }

    #[test]
    fn a_share_is_shown_in_percent_and_the_unit_beside_the_title() {
        let shown = |column, value| {
            format!(
                "{}: {}",
                measure(column).label(),
                measure(column).text(value)
            )
        };
        assert_eq!(shown("drop_rate", 0.125), "drop rate, %: 12.5");
        assert_eq!(shown("goals", 2.0), "goals per episode: 2.000");
        assert_eq!(shown("rot_dist", f64::NAN), "rotation error, rad: -");
    }

    #[test]
    fn the_columns_of_training_and_evaluations_are_measures_and_json_has_them_all() {
        for column in OF_TRAINING.iter().chain(&OF_EVALUATIONS).chain(&HEADLINE) {
            assert_eq!(measure(column).column, *column);
        }
        let object = Score::of(
            &[EpisodeStats {
                length: 10,
                ..Default::default()
            }],
            0.01,
        )
        .as_json();
        let keys: Vec<&str> = object.keys().map(String::as_str).collect();
        assert_eq!(
            keys[..4],
            ["episodes", "env_steps", "goals_per_episode", "goals_ci95"]
        );
        assert_eq!(keys[keys.len() - 3..], ["return", "reward", "diverged"]);
        assert_eq!(keys.len(), MEASURES.len() + 5);
        assert!(
            object["steps_per_goal"].is_null() && object["reward"].as_object().unwrap().len() == 5
        );
    }
}
