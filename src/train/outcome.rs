//! The results of an iteration of a training run, and what follows it.

use crate::agent::Iteration;
use crate::repose::{EpisodeStats, Lesson, Score, StepSums};
use crate::run::Histogram;

/// Why a run ends before all its steps are made.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// Whether the user has asked for it by a file.
    pub by_file: bool,
    /// The signal that has asked for it, or 0.
    pub signal: i32,
}

/// What follows an iteration.
#[derive(Debug, Default)]
pub struct Decision {
    /// Whether to save, although the run goes on.
    pub save: bool,
    /// Whether the state is handed to the saver. If nobody else waits, it always is: the next iteration may be cut short.
    pub hand_over: bool,
    /// Whether the run stops here, before its end.
    pub stop: Option<Stop>,
}

/// The results of one iteration, of all ranks unless stated otherwise.
#[derive(Debug, Default)]
pub struct Outcome {
    /// The record of the iteration on this rank.
    pub iteration: Iteration<Lesson>,
    /// The episodes that ended.
    pub ended: Vec<EpisodeStats>,
    /// The sums over its steps.
    pub steps: StepSums,
    /// The score of its evaluation, which has no episodes if there was none.
    pub evaluation: Score,
    /// The cost of the exchange while collecting and learning, by name.
    pub traffic: [(&'static str, f64); 2],
    /// Histograms of the rollout on this rank, by tag, if they are due.
    pub histograms: Vec<(&'static str, Histogram)>,
    /// The steps that led to each divergence, as files with these names and texts.
    pub dumps: Vec<(String, String)>,
    /// What follows the iteration.
    pub decision: Decision,
}
