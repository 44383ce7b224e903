//! The results of an iteration of a training run.

use super::lockstep::Decision;
use crate::agent::Iteration;
use crate::repose::{EpisodeStats, Lesson, Score, StepSums};
use crate::run::Histogram;

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
