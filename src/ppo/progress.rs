//! The progress of a run, as checkpoints store it: what is finished, what was best, and where it was forked from.

use serde::{Deserialize, Serialize};

/// The progress of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// The number of finished iterations.
    pub iteration: u64,
    /// Control steps over all environments.
    pub env_steps: u64,
    /// Goals per episode and rotation error, rad, of the best evaluation so far.
    pub best: Option<[f64; 2]>,
    /// The checkpoint that it was forked from, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fork: Option<Fork>,
    /// How evaluations have risen, if the run ends when they no longer do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rise: Option<Rise>,
}

/// How far the evaluations of a run have risen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rise {
    /// Goals per episode, rotation error (rad) and share of drops before the first iteration.
    pub before: [f64; 3],
    /// The same figures of the best evaluation.
    pub best: [f64; 3],
    /// The number of evaluations since then.
    pub since: u32,
}

impl Rise {
    /// Records another evaluation.
    pub fn add(&mut self, figures: [f64; 3]) {
        let of = |[goals, rot_dist, _]: [f64; 3]| [goals, rot_dist];
        self.since = self.since.saturating_add(1);
        if beats(of(figures), Some(of(self.best))) {
            self.best = figures;
            self.since = 0;
        }
    }
}

/// Whether an evaluation is better than the best so far: more goals, or the same number with a smaller error. Both are given by their
/// goals per episode and their rotation error, rad.
pub fn beats(found: [f64; 2], best: Option<[f64; 2]>) -> bool {
    let order = |[goals, rot_dist]: [f64; 2]| (goals, -rot_dist);
    // If every episode diverged at once, there is no rotation error to compare.
    found.iter().all(|figure| figure.is_finite())
        && best.is_none_or(|best| order(found) > order(best))
}

/// The checkpoint of another run that a run was forked from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fork {
    /// The path of its file at that time, for display only.
    pub from: String,
    /// The iterations that the other run had finished.
    pub iteration: u64,
    /// The control steps that the other run had taken.
    pub env_steps: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_evaluation_has_most_goals_and_then_the_least_rotation_error() {
        assert!(beats([0.0, 2.0], None));
        assert!(beats([1.0, 2.0], Some([0.5, 0.1])));
        assert!(!beats([0.5, 0.1], Some([1.0, 2.0])));
        assert!(beats([1.0, 1.9], Some([1.0, 2.0])));
        assert!(!beats([1.0, 2.0], Some([1.0, 2.0])));
        assert!(!beats([0.0, f64::NAN], None));
    }
}
