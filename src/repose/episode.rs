//! Statistics of an episode, and the score of a set of episodes.

use std::ops::AddAssign;

use anyhow::{Result, ensure};
use serde::{Deserialize, Serialize};

use super::divergence::divergence;
use super::{TaskReward, TrainingReward};
use crate::env::{EnvState, SavedEnv};

/// The sums over one episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeStats {
    /// Control steps.
    pub length: u32,
    /// Goals reached: held for the required number of steps and then replaced by a new one.
    pub goals: u32,
    /// Steps within the tolerance.
    pub in_tolerance: u32,
    /// Sum of the rotation error over the steps, rad. A diverged step adds nothing.
    pub rot_dist_sum: f64,
    /// Sums of the reward terms.
    pub reward: TaskReward,
    /// Whether the object was dropped.
    pub dropped: bool,
    /// Whether the physics diverged.
    pub diverged: bool,
    /// Whether it was randomised. Not written by `save`, because the environment stores it beside the episode.
    pub randomized: bool,
    /// Sum of the rotation towards the goal, rad (negative away from it). Only known for an episode that was played for a score.
    pub turned: f64,
}

impl EpisodeStats {
    /// The number of `f64` values that [`Self::save`] writes.
    pub(super) const NUMBERS: usize = 6;

    pub(super) fn save(&self, state: &mut EnvState) {
        state.numbers.push(self.rot_dist_sum);
        state.numbers.extend(self.reward.values());
        state.counters.extend([self.length, self.goals, self.in_tolerance].map(u64::from));
        state.counters.extend([self.dropped, self.diverged].map(u64::from));
    }

    /// # Errors
    /// Fails if values are missing, or if no episode can have these counters.
    pub(super) fn saved(state: &mut SavedEnv) -> Result<Self> {
        let [rot_dist_sum] = state.numbers()?;
        let reward = TaskReward::new(state.numbers()?);
        let [length, goals, in_tolerance, dropped, diverged] = state.counters()?;
        let possible = length <= u64::from(u32::MAX / 2) && goals <= length && in_tolerance <= length;
        ensure!(possible, "impossible episode: {length} steps, {goals} goals, {in_tolerance} steps in tolerance");
        let [length, goals, in_tolerance] = [length, goals, in_tolerance].map(|count| count as u32);
        let [dropped, diverged] = [dropped, diverged].map(|flag| flag != 0);
        Ok(Self { length, goals, in_tolerance, rot_dist_sum, reward, dropped, diverged, ..Self::default() })
    }
}

/// Sums over steps, across episodes, since they were last taken. They are taken before a state is saved and are not part of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepSums {
    /// Control steps.
    pub steps: u64,
    /// Sums of the terms of the task's reward.
    pub task: TaskReward,
    /// Sums of the terms that training adds.
    pub training: TrainingReward,
    /// Sum of the rotation towards the goal, rad (negative away from it).
    pub turned: f64,
    /// Steps in which the physics diverged.
    pub diverged: u64,
}

impl StepSums {
    /// Returns the mean of each term of the task's reward over the steps, by name.
    pub fn task_named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        self.task.map(|sum| sum / self.steps as f64).named()
    }

    /// Returns the mean of each term that training adds, by name, and the rotation towards the goal in 100 steps, rad.
    pub fn training_named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let turned = 100.0 * self.turned / self.steps as f64;
        self.training.map(|sum| sum / self.steps as f64).named().chain([("turned", turned)])
    }
}

impl AddAssign for StepSums {
    fn add_assign(&mut self, other: Self) {
        let Self { steps, task, training, turned, diverged } = other;
        self.steps += steps;
        self.task += task;
        self.training += training;
        self.turned += turned;
        self.diverged += diverged;
    }
}

/// Means over finished episodes, or `NaN` where there is nothing to average.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Score {
    /// The number of episodes.
    pub episodes: usize,
    /// Control steps of all episodes together.
    pub env_steps: u64,
    /// Goals reached per episode.
    pub goals: f64,
    /// 95 % confidence interval of `goals`: mean ± 1.96 standard errors, clipped at zero.
    pub goals_ci95: [f64; 2],
    /// Fraction of the steps within the tolerance.
    pub in_tolerance: f64,
    /// Mean rotation error over the steps, rad.
    pub rot_dist: f64,
    /// Steps per goal reached.
    pub steps_per_goal: f64,
    /// Seconds of the simulation per goal reached.
    pub seconds_per_goal: f64,
    /// Fraction of the episodes with at least one goal.
    pub success_rate: f64,
    /// Fraction of the episodes with at least five goals.
    pub success_rate_5: f64,
    /// Rotation towards the goal in 100 steps, rad.
    pub turned: f64,
    /// Fraction of the episodes that ended with a drop.
    pub drop_rate: f64,
    /// Mean length in control steps.
    pub length: f64,
    /// Mean sum of rewards of an episode.
    pub episode_return: f64,
    /// The same, by term.
    pub reward: TaskReward,
    /// Episodes that ended because the physics diverged.
    pub diverged: usize,
}

/// A figure of a score: name in columns and tags, title (with its unit in brackets), description in a sentence, and value.
#[derive(Clone, Copy)]
pub struct Figure(pub &'static str, pub &'static str, pub &'static str, fn(&Score) -> f64);

/// The figures that a training logs of its own episodes.
#[rustfmt::skip]
pub const FIGURES: [Figure; 7] = [
    Figure("return", "return", "Sum of the task's rewards of an episode.", |score| score.episode_return),
    Figure("length", "episode length (steps)", "Control steps of an episode.", |score| score.length),
    Figure("goals", "goals per episode", "Goals reached and held in an episode.", |score| score.goals),
    Figure("in_tolerance", "share of steps in tolerance", "Fraction of the steps within the task's tolerance.", |score| score.in_tolerance),
    Figure("drop_rate", "share of episodes dropped", "Fraction of the episodes that ended with a drop.", |score| score.drop_rate),
    Figure("rot_dist", "rotation error (rad)", "Rotation error, mean over the steps.", |score| score.rot_dist),
    Figure("steps_per_goal", "steps per goal", "Control steps per goal reached.", |score| score.steps_per_goal),
];

/// The figures that only scores and evaluations have.
#[rustfmt::skip]
pub const OF_EVALUATIONS: [Figure; 4] = [
    Figure("success_rate", "share of episodes with a goal", "Fraction of the episodes with at least one goal.", |score| score.success_rate),
    Figure("success_rate_5", "share of episodes with five goals", "Fraction of the episodes with at least five goals.", |score| score.success_rate_5),
    Figure("seconds_per_goal", "seconds per goal", "Seconds of the simulation per goal reached.", |score| score.seconds_per_goal),
    Figure("turned", "turned towards the goal (rad/100 steps)", "Rotation towards the goal in 100 steps, rad.", |score| score.turned),
];

/// The figures of every score that summarise an evaluation during training.
const HEADLINE: [&str; 4] = ["goals", "drop_rate", "rot_dist", "return"];

impl Score {
    /// Returns a warning if many of the steps diverged. Each such step ended an episode.
    pub fn divergence(&self) -> Option<String> {
        divergence(self.diverged as u64, self.env_steps)
    }

    /// Returns the figures of a training's own episodes by name.
    pub fn named(&self) -> [(&'static str, f64); FIGURES.len()] {
        FIGURES.map(|Figure(name, .., value)| (name, value(self)))
    }

    /// Returns the figures, by name, that summarise an evaluation during training.
    pub fn headline(&self) -> impl Iterator<Item = (&'static str, f64)> + use<> {
        let all = self.named();
        let first = HEADLINE.into_iter().filter_map(move |wanted| all.into_iter().find(|(name, _)| *name == wanted));
        first.chain(OF_EVALUATIONS.map(|Figure(name, .., value)| (name, value(self))))
    }

    /// Computes the score of `episodes` with control steps of `ctrl_dt` seconds.
    pub fn of(episodes: &[EpisodeStats], ctrl_dt: f64) -> Self {
        let n = episodes.len() as f64;
        let sum = |f: &dyn Fn(&EpisodeStats) -> f64| episodes.iter().map(f).sum::<f64>();
        let count = |f: &dyn Fn(&EpisodeStats) -> bool| episodes.iter().filter(|e| f(e)).count();
        let steps = sum(&|e| f64::from(e.length));
        let goals = sum(&|e| f64::from(e.goals));
        let diverged = count(&|e| e.diverged);
        let mean = goals / n;
        let variance = sum(&|e| (f64::from(e.goals) - mean).powi(2)) / (n - 1.0);
        let margin = 1.96 * (variance / n).sqrt();
        let steps_per_goal = if goals > 0.0 { steps / goals } else { f64::NAN };
        let mut total = TaskReward::default();
        episodes.iter().for_each(|e| total += e.reward);
        Self {
            episodes: episodes.len(),
            env_steps: steps as u64,
            goals: mean,
            goals_ci95: [mean - margin, mean + margin].map(|x| if x.is_nan() { x } else { x.max(0.0) }),
            in_tolerance: sum(&|e| f64::from(e.in_tolerance)) / steps,
            rot_dist: sum(&|e| e.rot_dist_sum) / (steps - diverged as f64),
            steps_per_goal,
            seconds_per_goal: steps_per_goal * ctrl_dt,
            success_rate: count(&|e| e.goals >= 1) as f64 / n,
            success_rate_5: count(&|e| e.goals >= 5) as f64 / n,
            turned: 100.0 * sum(&|e| e.turned) / steps,
            drop_rate: count(&|e| e.dropped) as f64 / n,
            length: steps / n,
            episode_return: total.total() / n,
            reward: total.map(|term| term / n),
            diverged,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_is_the_mean_worked_out_by_hand() {
        let reward = |rotation| TaskReward::new([rotation, 0.0, 0.0, 0.0, 0.0]);
        let one = EpisodeStats {
            length: 1000,
            goals: 4,
            in_tolerance: 200,
            rot_dist_sum: 500.0,
            reward: reward(30.0),
            turned: 9.0,
            ..Default::default()
        };
        let two = EpisodeStats {
            length: 500,
            rot_dist_sum: 1000.0,
            reward: reward(10.0),
            dropped: true,
            ..Default::default()
        };
        let score = Score::of(&[one, two], 0.02);
        assert_eq!((score.episodes, score.env_steps, score.diverged), (2, 1500, 0));
        assert_eq!((score.goals, score.drop_rate, score.length), (2.0, 0.5, 750.0));
        assert_eq!((score.episode_return, score.steps_per_goal, score.rot_dist), (20.0, 375.0, 1.0));
        assert_eq!((score.success_rate, score.success_rate_5, score.seconds_per_goal), (0.5, 0.0, 7.5));
        assert_eq!(Score::of(&[EpisodeStats { goals: 5, ..one }, two], 0.02).success_rate_5, 0.5);
        assert!((score.turned - 0.6).abs() < 1e-12);
        // Standard deviation √8, standard error 2.
        assert!((score.goals_ci95[1] - (2.0 + 1.96 * 2.0)).abs() < 1e-12);
        assert_eq!(score.goals_ci95[0], 0.0);
        assert!((score.in_tolerance - 200.0 / 1500.0).abs() < 1e-12);
    }

    #[test]
    fn nothing_scores_nothing() {
        let score = Score::of(&[], 0.01);
        assert!(score.goals.is_nan() && score.rot_dist.is_nan() && score.goals_ci95[0].is_nan());
        let idle = Score::of(&[EpisodeStats { length: 5, ..Default::default() }], 0.01);
        assert!(idle.steps_per_goal.is_nan() && idle.seconds_per_goal.is_nan() && idle.success_rate == 0.0);
    }
}
