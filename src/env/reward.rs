//! The reward of one control step, term by term.

use std::ops::AddAssign;

use crate::config::EnvConfig;

/// The terms of a reward; their sum is what is paid.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RewardTerms {
    /// For a small rotation error.
    pub rotation: f64,
    /// For the cube's distance from the goal position.
    pub distance: f64,
    /// For the size of the action.
    pub action: f64,
    /// For being within the tolerance.
    pub bonus: f64,
    /// For dropping the cube.
    pub fall: f64,
}

impl RewardTerms {
    /// The terms of a step that ends with the rotation error `rot_dist` (rad) and the distance `goal_dist` (m), after the
    /// clipped `action`.
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

    /// The terms by name.
    pub fn named(&self) -> [(&'static str, f64); 5] {
        let Self { rotation, distance, action, bonus, fall } = *self;
        [("rotation", rotation), ("distance", distance), ("action", action), ("bonus", bonus), ("fall", fall)]
    }

    /// The terms alone, in the same order.
    pub fn values(&self) -> [f64; 5] {
        self.named().map(|(_, value)| value)
    }

    /// What is paid.
    pub fn total(&self) -> f64 {
        self.values().iter().sum()
    }
}

/// In the order of [`RewardTerms::named`].
impl From<[f64; 5]> for RewardTerms {
    fn from([rotation, distance, action, bonus, fall]: [f64; 5]) -> Self {
        Self { rotation, distance, action, bonus, fall }
    }
}

impl AddAssign for RewardTerms {
    fn add_assign(&mut self, other: Self) {
        let (a, b) = (self.values(), other.values());
        *self = std::array::from_fn(|i| a[i] + b[i]).into();
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
        let expected = [2.0, -0.5, -0.00025, 0.0, 0.0];
        assert!(reward.values().iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{reward:?}");
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
