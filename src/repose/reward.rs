//! The reward of one control step, term by term.

use std::ops::AddAssign;

use crate::config::EnvConfig;

/// The terms of a reward, which is their sum.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RewardTerms {
    /// The term for a small rotation error.
    pub rotation: f64,
    /// The term for the cube's distance from the goal position.
    pub distance: f64,
    /// The term for the size of the action.
    pub action: f64,
    /// The term for being within the tolerance.
    pub bonus: f64,
    /// The term for dropping the cube.
    pub fall: f64,
}

impl RewardTerms {
    /// Computes the terms of a step that ends with the rotation error `rot_dist` (rad) and the distance `goal_dist` (m) after
    /// the clipped `action`.
    pub fn of_step(config: &EnvConfig, rot_dist: f64, goal_dist: f64, action: &[f32]) -> Self {
        let effort: f64 = action.iter().map(|&a| f64::from(a) * f64::from(a)).sum();
        Self {
            rotation: config.rot_reward_scale / (rot_dist + config.rot_eps),
            distance: config.dist_reward_scale * goal_dist,
            action: config.action_penalty_scale * effort,
            bonus: if rot_dist <= config.success_tolerance { config.reach_goal_bonus } else { 0.0 },
            fall: if goal_dist >= config.fall_dist { config.fall_penalty } else { 0.0 },
        }
    }

    /// Returns the terms by name.
    pub fn named(&self) -> [(&'static str, f64); 5] {
        let Self { rotation, distance, action, bonus, fall } = *self;
        [("rotation", rotation), ("distance", distance), ("action", action), ("bonus", bonus), ("fall", fall)]
    }

    /// Returns the sum of the terms.
    pub fn total(&self) -> f64 {
        self.named().iter().map(|(_, value)| value).sum()
    }

    /// Applies `f` to each term.
    pub fn map(self, f: impl Fn(f64) -> f64) -> Self {
        let Self { rotation, distance, action, bonus, fall } = self;
        Self { rotation: f(rotation), distance: f(distance), action: f(action), bonus: f(bonus), fall: f(fall) }
    }
}

impl AddAssign for RewardTerms {
    fn add_assign(&mut self, other: Self) {
        let Self { rotation, distance, action, bonus, fall } = other;
        self.rotation += rotation;
        self.distance += distance;
        self.action += action;
        self.bonus += bonus;
        self.fall += fall;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn terms(rot_dist: f64, goal_dist: f64, action: &[f32]) -> RewardTerms {
        let mut config = Config::resolve(None, &[]).unwrap().env;
        config.fall_penalty = -7.0;
        RewardTerms::of_step(&config, rot_dist, goal_dist, action)
    }

    #[test]
    fn each_term_is_the_one_of_the_task() {
        // 1 / (0.4 + 0.1), -10 * 0.05, -0.0002 * (1 + 0.25)
        let reward = terms(0.4, 0.05, &[1.0, -0.5]);
        let expected = [("rotation", 2.0), ("distance", -0.5), ("action", -0.00025), ("bonus", 0.0), ("fall", 0.0)];
        for ((name, found), (expected_name, expected)) in reward.named().into_iter().zip(expected) {
            assert!(name == expected_name && (found - expected).abs() < 1e-12, "{reward:?}");
        }
        assert!((reward.total() - 1.49975).abs() < 1e-12);
    }

    #[test]
    fn the_bonus_is_paid_up_to_the_tolerance_itself() {
        assert_eq!(terms(0.1, 0.0, &[]).bonus, 2.0);
        assert_eq!(terms(0.1 + 1e-9, 0.0, &[]).bonus, 0.0);
    }

    #[test]
    fn the_fall_penalty_is_paid_from_the_limit_on() {
        assert_eq!(terms(1.0, 0.24, &[]).fall, -7.0);
        assert_eq!(terms(1.0, 0.24 - 1e-9, &[]).fall, 0.0);
    }
}
