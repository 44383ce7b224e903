//! The learning rate, which keeps the KL divergence of an update near the desired one.

use crate::config::{PpoConfig, Ramp};

/// A learning rate that is adapted after each minibatch but the first of an update, as in the reference implementation.
pub(super) struct LearningRate {
    /// The rate of the next step.
    pub rate: f64,
    /// The desired KL divergence at this time, nats; 0: the rate is fixed.
    pub desired_kl: f64,
    /// The desired KL divergence in the course of the run.
    ramp: Ramp,
    /// The configured rate.
    configured: f64,
    /// The lowest and the highest adapted rate.
    range: [f64; 2],
}

impl LearningRate {
    /// Creates the rate for the beginning of a run.
    pub(super) fn new(config: &PpoConfig) -> Self {
        let (ramp, configured) = (config.desired_kl, config.learning_rate);
        let desired_kl = ramp.by_equal_factors(0);
        Self { rate: configured, desired_kl, ramp, configured, range: config.learning_rate_range }
    }

    /// Sets the desired KL divergence to where its ramp is after `env_steps` control steps of the run.
    pub(super) fn follow_ramp(&mut self, env_steps: u64) {
        self.desired_kl = self.ramp.by_equal_factors(env_steps);
    }

    /// After a fork, whose parent had the settings `before`: uses the configured rate if the user changed it or fixed it, else
    /// keeps the adapted one within its bounds.
    pub(super) fn reconcile(&mut self, before: &PpoConfig) {
        if self.ramp.to == 0.0 || self.configured != before.learning_rate {
            self.rate = self.configured;
        } else {
            self.rate = self.rate.clamp(self.range[0], self.range[1]);
        }
    }

    /// Adapts the rate, given the KL divergence of the current policy from the one that collected.
    pub(super) fn adapt(&mut self, kl: f64) {
        let [lowest, highest] = self.range;
        if self.desired_kl == 0.0 {
            return;
        }
        if kl > 2.0 * self.desired_kl {
            self.rate = (self.rate / 1.5).max(lowest);
        } else if kl < 0.5 * self.desired_kl {
            self.rate = (self.rate * 1.5).min(highest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn config(learning_rate: f64, desired_kl: Ramp) -> PpoConfig {
        let config = Config::resolve(None, &[]).unwrap().ppo;
        PpoConfig { learning_rate, desired_kl, learning_rate_range: [5e-4, 2e-3], ..config }
    }

    fn adapting_to(desired_kl: Ramp) -> LearningRate {
        LearningRate::new(&config(1e-3, desired_kl))
    }

    #[test]
    fn the_learning_rate_follows_the_divergence_within_its_range() {
        let mut of = adapting_to(Ramp::constant(0.01));
        // The KL divergence and the expected factor on the learning rate.
        for (kl, factor) in [(0.021, 1.0 / 1.5), (0.019, 1.0), (0.006, 1.0), (0.004, 1.5), (0.0, 1.5)] {
            of.rate = 1e-3;
            of.adapt(kl);
            assert!((of.rate / 1e-3 - factor).abs() < 1e-12, "KL {kl}: {}", of.rate);
        }
        (0..9).for_each(|_| of.adapt(1.0));
        assert_eq!(of.rate, 5e-4);
        (0..9).for_each(|_| of.adapt(1e-4));
        assert_eq!(of.rate, 2e-3);
    }

    #[test]
    fn the_desired_divergence_follows_its_ramp_by_equal_factors() {
        let mut of = adapting_to(Ramp { from: 0.016, to: 0.004, steps: 1000, after: 0 });
        // Control steps of the run, and the divergence there above which the rate falls.
        for (env_steps, most) in [(0, 0.032), (500, 0.016), (1000, 0.008), (5000, 0.008)] {
            of.follow_ramp(env_steps);
            for (kl, lowered) in [(0.99 * most, false), (1.01 * most, true)] {
                of.rate = 1e-3;
                of.adapt(kl);
                assert_eq!(of.rate < 1e-3, lowered, "KL {kl} after {env_steps} steps");
            }
        }
    }

    #[test]
    fn a_fork_takes_the_learning_rate_of_its_settings_where_they_name_another_or_keep_it_fixed() {
        let before = config(1e-3, Ramp::constant(0.01));
        // The adapted rate, the rate in the new settings, the desired KL divergence and the expected rate.
        for (adapted, configured, desired, expected) in
            [(7e-4, 1e-3, 0.01, 7e-4), (7e-4, 6e-4, 0.01, 6e-4), (7e-4, 1e-3, 0.0, 1e-3), (1e-4, 1e-3, 0.01, 5e-4)]
        {
            let mut of = LearningRate::new(&config(configured, Ramp::constant(desired)));
            of.rate = adapted;
            of.reconcile(&before);
            assert_eq!(of.rate, expected);
        }
    }

    #[test]
    fn without_a_desired_divergence_the_learning_rate_is_fixed() {
        let mut of = adapting_to(Ramp::constant(0.0));
        [1e-6, 1.0].into_iter().for_each(|kl| of.adapt(kl));
        assert_eq!(of.rate, 1e-3);
    }
}
