//! The learning rate, which keeps the KL divergence of an update near the desired one.

use super::Ppo;
use crate::config::PpoConfig;

/// The learning rate after a minibatch, given the KL divergence of the current policy from the policy that collected, as
/// in the reference implementation. It is fixed if the desired divergence is 0.
pub fn adapted(rate: f64, kl: f64, desired_kl: f64, [lowest, highest]: [f64; 2]) -> f64 {
    if desired_kl == 0.0 {
        rate
    } else if kl > 2.0 * desired_kl {
        (rate / 1.5).max(lowest)
    } else if kl < 0.5 * desired_kl {
        (rate * 1.5).min(highest)
    } else {
        rate
    }
}

impl Ppo {
    /// Brings the learning rate of a fork, whose parent had the settings `before` and had adapted it, in line with its own
    /// settings. It is the configured rate if the user changed it or fixed it, else the adapted rate within its bounds.
    pub fn reconcile_learning_rate(&mut self, before: &PpoConfig) {
        let config = &self.config;
        let [lowest, highest] = config.learning_rate_range;
        let is_kept = config.desired_kl.0.to != 0.0 && config.learning_rate == before.learning_rate;
        self.learning_rate = if is_kept {
            self.learning_rate.clamp(lowest, highest)
        } else {
            config.learning_rate
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Geometric, Ramp};
    use crate::ranks::Exchange;
    use crate::spaces::Spaces;

    const SPACES: Spaces = Spaces {
        observation_size: 1,
        action_size: 1,
        object_and_goal: None,
        distance: |_, _| 0.0,
    };

    const RANGE: [f64; 2] = [5e-4, 2e-3];

    fn config(learning_rate: f64, desired_kl: Ramp) -> PpoConfig {
        let config = Config::default().ppo;
        let desired_kl = Geometric(desired_kl);
        PpoConfig {
            learning_rate,
            desired_kl,
            learning_rate_range: RANGE,
            ..config
        }
    }

    #[test]
    fn the_learning_rate_follows_the_divergence_within_its_range() {
        // The KL divergence and the expected factor on the learning rate.
        for (kl, factor) in [
            (0.021, 1.0 / 1.5),
            (0.019, 1.0),
            (0.006, 1.0),
            (0.004, 1.5),
            (0.0, 1.5),
        ] {
            let rate = adapted(1e-3, kl, 0.01, RANGE);
            assert!((rate / 1e-3 - factor).abs() < 1e-12, "KL {kl}: {rate}");
        }
        assert_eq!(
            (0..9).fold(1e-3, |rate, _| adapted(rate, 1.0, 0.01, RANGE)),
            5e-4
        );
        assert_eq!(
            (0..9).fold(5e-4, |rate, _| adapted(rate, 1e-4, 0.01, RANGE)),
            2e-3
        );
    }

    #[test]
    fn the_desired_divergence_follows_its_ramp_by_equal_factors() {
        let ramp = Ramp {
            from: 0.016,
            to: 0.004,
            steps: 1000,
            after: 0,
        };
        let config = config(1e-3, ramp);
        let mut ppo = Ppo::new(&config, SPACES, 0, Exchange::alone(1)).unwrap();
        let mut rollout = ppo.rollout(&[1]);
        // Control steps of the run, and the divergence there above which the rate falls.
        for (env_steps, most) in [(0, 0.032), (500, 0.016), (1000, 0.008), (5000, 0.008)] {
            ppo.follow_ramps(env_steps, &mut rollout);
            for (kl, lowered) in [(0.99 * most, false), (1.01 * most, true)] {
                assert_eq!(
                    adapted(1e-3, kl, config.desired_kl.at(ppo.env_steps), RANGE) < 1e-3,
                    lowered,
                    "KL {kl} after {env_steps} steps"
                );
            }
        }
    }

    #[test]
    fn a_fork_takes_the_learning_rate_of_its_settings_where_they_name_another_or_keep_it_fixed() {
        let before = config(1e-3, Ramp::constant(0.01));
        // The adapted rate, the rate in the new settings, the desired KL divergence and the expected rate.
        for (rate, configured, desired, expected) in [
            (7e-4, 1e-3, 0.01, 7e-4),
            (7e-4, 6e-4, 0.01, 6e-4),
            (7e-4, 1e-3, 0.0, 1e-3),
            (1e-4, 1e-3, 0.01, 5e-4),
        ] {
            let config = config(configured, Ramp::constant(desired));
            let mut ppo = Ppo::new(&config, SPACES, 0, Exchange::alone(1)).unwrap();
            ppo.learning_rate = rate;
            ppo.reconcile_learning_rate(&before);
            assert_eq!(ppo.learning_rate, expected);
        }
    }

    #[test]
    fn without_a_desired_divergence_the_learning_rate_is_fixed() {
        assert_eq!(
            [1e-6, 1.0].map(|kl| adapted(1e-3, kl, 0.0, RANGE)),
            [1e-3; 2]
        );
    }
}
