//! A setting that changes in the course of a training.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Goes from one value to another in so many control steps over all hands, and stays there. A plain number in the settings is a
/// constant.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ramp {
    /// The value at the first step.
    pub from: f64,
    /// The value at the last step, and ever after.
    pub to: f64,
    /// How long that takes; 0: `to` from the first step on.
    pub steps: u64,
}

impl Ramp {
    /// A value that does not change.
    pub fn constant(value: f64) -> Self {
        Self { from: value, to: value, steps: 0 }
    }

    /// The value after `env_steps` control steps, which grows by as much in each.
    pub fn by_equal_steps(&self, env_steps: u64) -> f64 {
        let share = self.share(env_steps);
        self.from * (1.0 - share) + self.to * share
    }

    /// The value after `env_steps` control steps, which grows by the same factor in each.
    pub fn by_equal_factors(&self, env_steps: u64) -> f64 {
        let share = self.share(env_steps);
        self.from.powf(1.0 - share) * self.to.powf(share)
    }

    /// How much of it is over, from 0 to 1.
    fn share(&self, env_steps: u64) -> f64 {
        if self.steps == 0 { 1.0 } else { (env_steps as f64 / self.steps as f64).min(1.0) }
    }
}

impl fmt::Display for Ramp {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { from, to, steps } = self;
        let constant = *self == Self::constant(*to);
        if constant { to.fmt(f) } else { write!(f, "{{ from = {from}, to = {to}, steps = {steps} }}") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_begins_with_one_value_ends_with_the_other_and_stays_there() {
        let ramp = Ramp { from: 0.4, to: 0.1, steps: 1000 };
        assert_eq!([0, 1000, 9000].map(|steps| ramp.by_equal_steps(steps)), [0.4, 0.1, 0.1]);
        assert_eq!([0, 1000, 9000].map(|steps| ramp.by_equal_factors(steps)), [0.4, 0.1, 0.1]);
        assert!((ramp.by_equal_steps(500) - 0.25).abs() < 1e-12);
        assert!((ramp.by_equal_factors(500) - 0.2).abs() < 1e-12);
    }

    #[test]
    fn a_ramp_of_no_steps_is_at_its_end_from_the_first_step_on() {
        let ramp = Ramp { from: 0.4, to: 0.1, steps: 0 };
        assert_eq!([ramp.by_equal_steps(0), ramp.by_equal_factors(0), ramp.by_equal_steps(5)], [0.1; 3]);
        assert_eq!([0, 7].map(|steps| Ramp::constant(0.07).by_equal_factors(steps)), [0.07; 2]);
        assert_eq!(Ramp::constant(-0.3).by_equal_steps(3), -0.3);
    }
}
