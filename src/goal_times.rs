//! Steps needed per goal, and early drops: weaknesses that the mean score hides.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::config::EnvConfig;
use crate::env::Env;
use crate::evaluate::Moment;
use crate::statistics::{line, mean, percentile};

/// The goals reached in a set of episodes, and their early drops.
pub struct GoalTimes {
    /// Steps within the tolerance that reach a goal.
    hold: u32,
    /// Control steps per second.
    second: u32,
    /// For each running episode, the number of goals reached and the current goal.
    under_way: BTreeMap<usize, (u32, Goal)>,
    /// The goals reached, with the steps that each took.
    reached: Vec<Goal>,
    episodes: usize,
    early_drops: usize,
}

/// A goal of an episode.
#[derive(Clone, Copy)]
struct Goal {
    /// Once reached, the control steps that it took. Before that, the step of the episode at which it was given.
    steps: u32,
    /// Rotation error when it was given, rad.
    angle: f64,
}

impl GoalTimes {
    /// Creates an empty `GoalTimes` for episodes with these settings.
    pub fn new(config: &EnvConfig) -> Self {
        Self {
            hold: config.max_consecutive_successes,
            second: (1.0 / config.ctrl_dt).round() as u32,
            under_way: BTreeMap::new(),
            reached: Vec::new(),
            episodes: 0,
            early_drops: 0,
        }
    }

    /// Adds a reset or step. The steps of one episode must come in order.
    pub fn observe(&mut self, moment: &Moment) {
        let stats = moment.env.episode();
        let next = Goal {
            steps: stats.length,
            angle: moment.env.rot_dist(),
        };
        let Some((_, end)) = moment.step else {
            self.under_way.insert(moment.episode, (0, next));
            return;
        };
        let (goals, goal) = self.under_way.entry(moment.episode).or_insert((0, next));
        if stats.goals > *goals {
            self.reached.push(Goal {
                steps: stats.length - goal.steps,
                angle: goal.angle,
            });
            *goals = stats.goals;
            *goal = next;
        }
        if end.is_some() {
            self.under_way.remove(&moment.episode);
            self.episodes += 1;
            self.early_drops += usize::from(stats.dropped && stats.length <= self.second);
        }
    }

    /// Three values by name, each null where unknown. `steps_to_goal` holds mean and percentiles, in control steps including
    /// the hold. `drops_first_second` is a fraction of the episodes. `steps_fit` is the line of the steps without the hold over
    /// the angle: its offset, and its slope in steps per rad.
    pub fn named(&self) -> [(&'static str, Value); 3] {
        let mut steps: Vec<f64> = self
            .reached
            .iter()
            .map(|goal| f64::from(goal.steps))
            .collect();
        steps.sort_by(f64::total_cmp);
        let at = |fraction: f64| percentile(&steps, fraction);
        let to_goal = json!({
            "mean": mean(&steps),
            "p10": at(0.1), "p50": at(0.5), "p90": at(0.9), "p99": at(0.99),
        });
        let turning = |goal: &Goal| [goal.angle, f64::from(goal.steps) - f64::from(self.hold)];
        let [offset, slope] = line(self.reached.iter().map(turning));
        [
            ("steps_to_goal", to_goal),
            (
                "drops_first_second",
                json!(self.early_drops as f64 / self.episodes as f64),
            ),
            ("steps_fit", json!({ "settle": offset, "per_rad": slope })),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn goal_times(reached: &[(u32, f64)]) -> GoalTimes {
        let mut goal_times = GoalTimes::new(&Config::default().env);
        goal_times.reached = reached
            .iter()
            .map(|&(steps, angle)| Goal { steps, angle })
            .collect();
        goal_times
    }

    #[test]
    fn percentiles_lie_between_neighbours_and_the_line_is_the_one_that_was_laid() {
        // 50 steps to hold, 34 to settle, 30 per rad.
        let reached: Vec<(u32, f64)> = (0..=10).map(|i| (84 + 3 * i, 0.1 * f64::from(i))).collect();
        let named = goal_times(&reached).named();
        assert_eq!(
            named[0].1,
            json!({ "mean": 99.0, "p10": 87.0, "p50": 99.0, "p90": 111.0, "p99": 113.7 })
        );
        let [settle, per_rad] = ["settle", "per_rad"].map(|key| named[2].1[key].as_f64().unwrap());
        assert!(
            (settle - 34.0).abs() < 1e-9 && (per_rad - 30.0).abs() < 1e-9,
            "{settle} {per_rad}"
        );
    }

    #[test]
    fn of_no_goals_nothing_is_known_and_of_one_no_line() {
        let none = goal_times(&[]).named();
        assert!(none[0].1["mean"].is_null() && none[0].1["p50"].is_null() && none[1].1.is_null());
        let one = goal_times(&[(90, 1.0)]).named();
        assert_eq!(
            (&one[0].1["p99"], &one[2].1["per_rad"]),
            (&json!(90.0), &Value::Null)
        );
    }
}
