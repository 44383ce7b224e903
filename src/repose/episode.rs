//! Statistics of an episode.

use std::ops::AddAssign;

use anyhow::{Result, ensure};
use serde::{Deserialize, Serialize};

use super::{TaskReward, TrainingReward, add, named, task_terms, training_terms};
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
    /// Observations whose prediction diverged, in an episode that is scored.
    pub unpredicted: u64,
}

impl EpisodeStats {
    pub(super) fn save(&self, state: &mut EnvState) {
        state.numbers.push(self.rot_dist_sum);
        state.numbers.extend(self.reward);
        state
            .counters
            .extend([self.length, self.goals, self.in_tolerance].map(u64::from));
        state
            .counters
            .extend([self.dropped, self.diverged].map(u64::from));
    }

    /// # Errors
    /// Fails if values are missing, or if no episode can have these counters.
    pub(super) fn saved(state: &mut SavedEnv) -> Result<Self> {
        let [rot_dist_sum] = state.numbers()?;
        let reward = state.numbers()?;
        let [length, goals, in_tolerance, dropped, diverged] = state.counters()?;
        ensure!(
            length <= u64::from(u32::MAX / 2) && goals <= length && in_tolerance <= length,
            "impossible episode: {length} steps, {goals} goals, {in_tolerance} steps in tolerance"
        );
        let [length, goals, in_tolerance] = [length, goals, in_tolerance].map(|count| count as u32);
        let [dropped, diverged] = [dropped, diverged].map(|flag| flag != 0);
        Ok(Self {
            length,
            goals,
            in_tolerance,
            rot_dist_sum,
            reward,
            dropped,
            diverged,
            ..Self::default()
        })
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
    /// Observations whose prediction diverged: the policy saw what was measured.
    pub unpredicted: u64,
}

impl StepSums {
    /// The mean of each term of the task's reward over the steps, by name.
    pub fn task_named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        named(task_terms(), self.task.map(|sum| sum / self.steps as f64))
    }

    /// The mean of each term that training adds, by name, and the rotation towards the goal in 100 steps, rad.
    pub fn training_named(&self) -> impl Iterator<Item = (&'static str, f64)> {
        let turned = 100.0 * self.turned / self.steps as f64;
        named(
            training_terms(),
            self.training.map(|sum| sum / self.steps as f64),
        )
        .chain([("turned", turned)])
    }
}

impl AddAssign for StepSums {
    fn add_assign(&mut self, other: Self) {
        self.steps += other.steps;
        add(&mut self.task, other.task);
        add(&mut self.training, other.training);
        self.turned += other.turned;
        self.diverged += other.diverged;
        self.unpredicted += other.unpredicted;
    }
}
