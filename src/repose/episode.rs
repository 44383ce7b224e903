//! Statistics of an episode, and the score of a set of episodes.

use anyhow::{Result, ensure};

use super::{RewardTerms, Shaping};
use crate::env::{EnvState, SavedEnv};
use crate::ranks::Division;

/// The sums over one episode.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EpisodeStats {
    /// Control steps.
    pub length: u32,
    /// Goals reached: held for the required number of steps and then replaced by a new one.
    pub goals: u32,
    /// Steps within the tolerance.
    pub in_tolerance: u32,
    /// Sum of the rotation error over the steps, rad; a diverged step adds nothing.
    pub rot_dist_sum: f64,
    /// Sums of the reward terms.
    pub reward: RewardTerms,
    /// Whether the cube was dropped.
    pub dropped: bool,
    /// Whether the physics diverged.
    pub diverged: bool,
    /// Whether it was randomised. Who saves the episode saves this.
    pub randomized: bool,
}

impl EpisodeStats {
    /// The number of `f64` values that [`Self::save`] writes.
    pub(super) const NUMBERS: usize = 6;

    /// The number of counters that it writes.
    pub(super) const COUNTERS: usize = 5;

    pub(super) fn save(&self, state: &mut EnvState) {
        state.numbers.push(self.rot_dist_sum);
        let RewardTerms { rotation, distance, action, bonus, fall } = self.reward;
        state.numbers.extend([rotation, distance, action, bonus, fall]);
        state.counters.extend([self.length, self.goals, self.in_tolerance].map(u64::from));
        state.counters.extend([self.dropped, self.diverged].map(u64::from));
    }

    /// Returns the episodes of all ranks to the first rank, in the order of the ranks.
    pub fn gathered(own: Vec<Self>, division: &Division) -> Vec<Self> {
        if division.is_alone() {
            return own;
        }
        let mut state = EnvState::default();
        for episode in own {
            episode.save(&mut state);
            state.counters.push(u64::from(episode.randomized));
        }
        let all = state.gathered(division);
        let count = all.numbers.len() / Self::NUMBERS;
        let read = |mut row: SavedEnv| -> Result<Self> {
            let episode = Self::saved(&mut row)?;
            Ok(Self { randomized: row.counters::<1>()? == [1], ..episode })
        };
        let rows = if count == 0 { Ok(Vec::new()) } else { all.rows(count).and_then(|rows| rows.map(read).collect()) };
        rows.expect("the ranks run the same program")
    }

    /// # Errors
    /// Fails if values are missing, or if no episode can have these counters.
    pub(super) fn saved(state: &mut SavedEnv) -> Result<Self> {
        let [rot_dist_sum] = state.numbers()?;
        let [rotation, distance, action, bonus, fall] = state.numbers()?;
        let reward = RewardTerms { rotation, distance, action, bonus, fall };
        let [length, goals, in_tolerance, dropped, diverged] = state.counters()?;
        let possible = length <= u64::from(u32::MAX / 2) && goals <= length && in_tolerance <= length;
        ensure!(possible, "impossible episode: {length} steps, {goals} goals, {in_tolerance} steps in tolerance");
        let [length, goals, in_tolerance] = [length, goals, in_tolerance].map(|count| count as u32);
        let [dropped, diverged] = [dropped, diverged].map(|flag| flag != 0);
        Ok(Self { length, goals, in_tolerance, rot_dist_sum, reward, dropped, diverged, randomized: false })
    }
}

/// Sums across episodes since they were last taken. They are taken before a state is saved and are not part of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Recent {
    /// Control steps.
    pub steps: u64,
    /// Sums of the reward terms.
    pub reward: RewardTerms,
    /// Sums of the shaping terms that training adds.
    pub shaping: Shaping,
    /// Steps in which the physics diverged.
    pub diverged: u64,
}

impl Recent {
    /// Returns the mean of each term of the task's reward over the steps, by name.
    pub fn reward_named(&self) -> [(&'static str, f64); 5] {
        self.reward.named().map(|(name, sum)| (name, sum / self.steps as f64))
    }

    /// Returns the mean of each shaping term over the steps, by name.
    pub fn shaping_named(&self) -> [(&'static str, f64); 4] {
        self.shaping.named().map(|(name, sum)| (name, sum / self.steps as f64))
    }
}

impl std::ops::AddAssign for Recent {
    fn add_assign(&mut self, other: Self) {
        self.steps += other.steps;
        self.reward += other.reward;
        self.shaping += other.shaping;
        self.diverged += other.diverged;
    }
}

impl Recent {
    /// Returns the sums over all shards, given those of each shard of this rank.
    pub fn total(own: impl Iterator<Item = Self>, division: &Division) -> Self {
        let row = |recent: Self| {
            let RewardTerms { rotation, distance, action, bonus, fall } = recent.reward;
            let Shaping { progress, approach, within, drop } = recent.shaping;
            let [steps, diverged] = [recent.steps, recent.diverged].map(|count| count as f64);
            vec![steps, diverged, rotation, distance, action, bonus, fall, progress, approach, within, drop]
        };
        let total = division.total(own.map(row));
        let [steps, diverged, rotation, distance, action, bonus, fall, progress, approach, within, drop] = total[..]
        else {
            unreachable!("one sum for each number of a row")
        };
        Self {
            steps: steps as u64,
            diverged: diverged as u64,
            reward: RewardTerms { rotation, distance, action, bonus, fall },
            shaping: Shaping { progress, approach, within, drop },
        }
    }
}

/// Means over finished episodes; `NaN` where there is nothing to average.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    /// Fraction of the episodes that ended with a drop.
    pub drop_rate: f64,
    /// Mean length in control steps.
    pub length: f64,
    /// Mean sum of rewards of an episode.
    pub episode_return: f64,
    /// The same, by term.
    pub reward: RewardTerms,
    /// Episodes that ended because the physics diverged.
    pub diverged: usize,
}

/// Returns a warning if more than 1 % of the steps diverged: what is learnt or scored then is not the task.
pub fn divergence(diverged: u64, steps: u64) -> Option<String> {
    (diverged * 100 > steps).then(|| {
        format!(
            "in {diverged} of {steps} steps the physics diverged and the episode ended: this combination of scene, \
             env.sim_dt, masses, friction, gains and damping cannot be simulated"
        )
    })
}

impl Score {
    /// Returns a warning if many of the steps diverged; each such step ended an episode.
    pub fn divergence(&self) -> Option<String> {
        divergence(self.diverged as u64, self.env_steps)
    }

    /// Returns all figures by name.
    pub fn named(&self) -> [(&'static str, f64); 7] {
        [
            ("return", self.episode_return),
            ("length", self.length),
            ("goals", self.goals),
            ("in_tolerance", self.in_tolerance),
            ("drop_rate", self.drop_rate),
            ("rot_dist", self.rot_dist),
            ("steps_per_goal", self.steps_per_goal),
        ]
    }

    /// Returns the figures, by name, that summarise an evaluation during training.
    pub fn headline(&self) -> [(&'static str, f64); 4] {
        [
            ("goals", self.goals),
            ("drop_rate", self.drop_rate),
            ("rot_dist", self.rot_dist),
            ("return", self.episode_return),
        ]
    }

    /// Computes the score of `episodes`.
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
