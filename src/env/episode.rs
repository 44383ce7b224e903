//! What a finished episode leaves behind, and the score of many of them.

use anyhow::{Result, ensure};

use super::{EnvState, RewardTerms, SavedEnv, Shaping};

/// The sums over one episode.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EpisodeStats {
    /// Control steps.
    pub length: u32,
    /// Goals reached: held for as long as asked, after which a new one was drawn.
    pub goals: u32,
    /// Steps within the tolerance.
    pub in_tolerance: u32,
    /// Sum over the steps of the rotation error, rad; a diverged step has none.
    pub rot_dist_sum: f64,
    /// Sum of the rewards, term by term.
    pub reward: RewardTerms,
    /// The cube was dropped.
    pub dropped: bool,
    /// The physics diverged.
    pub diverged: bool,
}

impl EpisodeStats {
    /// How many numbers it saves.
    pub(super) const NUMBERS: usize = 6;

    pub(super) fn save(&self, state: &mut EnvState) {
        state.numbers.push(self.rot_dist_sum);
        state.numbers.extend(self.reward.values());
        state.counters.extend([self.length, self.goals, self.in_tolerance].map(u64::from));
        state.counters.extend([self.dropped, self.diverged].map(u64::from));
    }

    /// # Errors
    /// Counters that no episode has.
    pub(super) fn saved(state: &mut SavedEnv) -> Result<Self> {
        let [rot_dist_sum] = state.numbers()?;
        let reward = RewardTerms::from(state.numbers()?);
        let [length, goals, in_tolerance, dropped, diverged] = state.counters()?;
        let possible = length <= u64::from(u32::MAX / 2) && goals <= length && in_tolerance <= length;
        ensure!(possible, "an episode of {length} steps with {goals} goals and {in_tolerance} steps in tolerance");
        let [length, goals, in_tolerance] = [length, goals, in_tolerance].map(|count| count as u32);
        Ok(Self { length, goals, in_tolerance, rot_dist_sum, reward, dropped: dropped != 0, diverged: diverged != 0 })
    }
}

/// Sums since they were last taken, across episodes; taken before a state is saved, and no part of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Recent {
    /// Control steps.
    pub steps: u64,
    /// Rewards by term.
    pub reward: RewardTerms,
    /// What training pays besides, by term.
    pub shaping: Shaping,
    /// Steps on which the physics diverged.
    pub diverged: u64,
}

impl std::ops::AddAssign for Recent {
    fn add_assign(&mut self, other: Self) {
        self.steps += other.steps;
        self.reward += other.reward;
        self.shaping += other.shaping;
        self.diverged += other.diverged;
    }
}

/// Means over finished episodes; `NaN` where there is nothing to take a mean of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Score {
    /// Episodes counted.
    pub episodes: usize,
    /// Their control steps together.
    pub env_steps: u64,
    /// Goals reached per episode.
    pub goals: f64,
    /// 95 % interval of `goals`: mean ± 1.96 standard errors, not below zero.
    pub goals_ci95: [f64; 2],
    /// Fraction of the steps within tolerance.
    pub in_tolerance: f64,
    /// Mean rotation error over the steps, rad.
    pub rot_dist: f64,
    /// Steps per goal reached.
    pub steps_per_goal: f64,
    /// Fraction of the episodes that ended with a drop.
    pub drop_rate: f64,
    /// Mean length in control steps.
    pub length: f64,
    /// Mean sum of rewards.
    pub episode_return: f64,
    /// The same by term.
    pub reward: RewardTerms,
    /// Episodes that ended because the physics diverged.
    pub diverged: usize,
}

/// What to say where more than a hundredth of these steps diverged: what is learnt or scored then is not the task.
pub fn divergence(diverged: u64, steps: u64) -> Option<String> {
    (diverged * 100 > steps).then(|| {
        format!(
            "in {diverged} of {steps} steps the physics diverged and the episode ended: the masses, friction, \
             env.sim_dt or scene cannot be simulated"
        )
    })
}

impl Score {
    /// What to say where many of the steps diverged; each ended an episode.
    pub fn divergence(&self) -> Option<String> {
        divergence(self.diverged as u64, self.env_steps)
    }

    /// The score of these episodes.
    pub fn of(episodes: &[EpisodeStats]) -> Self {
        let n = episodes.len() as f64;
        let sum = |f: &dyn Fn(&EpisodeStats) -> f64| episodes.iter().map(f).sum::<f64>();
        let count = |f: &dyn Fn(&EpisodeStats) -> bool| episodes.iter().filter(|e| f(e)).count();
        let steps = sum(&|e| f64::from(e.length));
        let goals = sum(&|e| f64::from(e.goals));
        let diverged = count(&|e| e.diverged);
        let mean = goals / n;
        let variance = sum(&|e| (f64::from(e.goals) - mean).powi(2)) / (n - 1.0);
        let margin = 1.96 * (variance / n).sqrt();
        let mut total = RewardTerms::default();
        episodes.iter().for_each(|e| total += e.reward);
        Self {
            episodes: episodes.len(),
            env_steps: steps as u64,
            goals: mean,
            goals_ci95: [mean - margin, mean + margin].map(|x| if x.is_nan() { x } else { x.max(0.0) }),
            in_tolerance: sum(&|e| f64::from(e.in_tolerance)) / steps,
            rot_dist: sum(&|e| e.rot_dist_sum) / (steps - diverged as f64),
            steps_per_goal: if goals > 0.0 { steps / goals } else { f64::NAN },
            drop_rate: count(&|e| e.dropped) as f64 / n,
            length: steps / n,
            episode_return: total.total() / n,
            reward: total.values().map(|term| term / n).into(),
            diverged,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_is_the_mean_worked_out_by_hand() {
        let reward = |rotation| RewardTerms { rotation, ..Default::default() };
        let one = EpisodeStats {
            length: 1000,
            goals: 4,
            in_tolerance: 200,
            rot_dist_sum: 500.0,
            reward: reward(30.0),
            ..Default::default()
        };
        let two = EpisodeStats {
            length: 500,
            rot_dist_sum: 1000.0,
            reward: reward(10.0),
            dropped: true,
            ..Default::default()
        };
        let score = Score::of(&[one, two]);
        assert_eq!((score.episodes, score.env_steps, score.diverged), (2, 1500, 0));
        assert_eq!((score.goals, score.drop_rate, score.length), (2.0, 0.5, 750.0));
        assert_eq!((score.episode_return, score.steps_per_goal, score.rot_dist), (20.0, 375.0, 1.0));
        // Standard deviation √8, standard error 2.
        assert!((score.goals_ci95[1] - (2.0 + 1.96 * 2.0)).abs() < 1e-12);
        assert_eq!(score.goals_ci95[0], 0.0);
        assert!((score.in_tolerance - 200.0 / 1500.0).abs() < 1e-12);
    }

    #[test]
    fn nothing_scores_nothing() {
        let score = Score::of(&[]);
        assert!(score.goals.is_nan() && score.rot_dist.is_nan() && score.goals_ci95[0].is_nan());
        assert!(Score::of(&[EpisodeStats { length: 5, ..Default::default() }]).steps_per_goal.is_nan());
    }
}
