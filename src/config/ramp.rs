//! Settings that change in the course of a training run.

use serde::ser::SerializeStruct;
use serde::{Deserialize, Serialize, Serializer};
use toml::Value;

/// A value that changes to another one over a given number of control steps (counted over all environments) and then stays
/// constant. It may begin after the first step. A linear one changes by the same difference in each step. A constant is a plain number
/// in the settings.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Ramp {
    /// The value at the first step, and until the ramp begins.
    pub from: f64,
    /// The value at the last step and from then on.
    pub to: f64,
    /// The length of the ramp in control steps. At 0, the value is `to` from its first step on.
    pub steps: u64,
    /// The control steps of the run after which the ramp begins.
    #[serde(default)]
    pub after: u64,
}

impl Ramp {
    /// The ramp that this value of a setting is, unless it is a constant or something else.
    pub(super) fn read(value: &Value) -> Option<Self> {
        // As an array of numbers would also be read.
        value.as_table()?.clone().try_into().ok()
    }

    /// A ramp whose value does not change.
    pub fn constant(value: f64) -> Self {
        Self {
            from: value,
            to: value,
            steps: 0,
            after: 0,
        }
    }

    /// The value after `env_steps` control steps of the run.
    pub fn at(&self, env_steps: u64) -> f64 {
        let fraction = self.fraction(env_steps);
        self.from * (1.0 - fraction) + self.to * fraction
    }

    /// The control steps of the run after which the value does not change any more.
    pub fn end(&self) -> u64 {
        self.after.saturating_add(self.steps)
    }

    /// The fraction of the ramp that is over, from 0 to 1.
    fn fraction(&self, env_steps: u64) -> f64 {
        // Without steps, the quotient is infinite or NaN, of which the minimum is 1.
        let passed = env_steps.checked_sub(self.after);
        passed.map_or(0.0, |passed| (passed as f64 / self.steps as f64).min(1.0))
    }
}

impl Serialize for Ramp {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if *self == Self::constant(self.to) {
            return serializer.serialize_f64(self.to);
        }
        let mut parts = serializer.serialize_struct("Ramp", 4)?;
        parts.serialize_field("from", &self.from)?;
        parts.serialize_field("to", &self.to)?;
        parts.serialize_field("steps", &self.steps)?;
        if self.after > 0 {
            parts.serialize_field("after", &self.after)?;
        }
        parts.end()
    }
}

/// A ramp that changes by the same factor in each step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Geometric(pub Ramp);

impl Geometric {
    /// The value after `env_steps` control steps of the run.
    pub fn at(&self, env_steps: u64) -> f64 {
        let Self(ramp) = self;
        let fraction = ramp.fraction(env_steps);
        ramp.from.powf(1.0 - fraction) * ramp.to.powf(fraction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Reader, Settings, Source};

    #[test]
    fn a_ramp_begins_with_one_value_ends_with_the_other_and_stays_there() {
        let ramp = Ramp {
            from: 0.4,
            to: 0.1,
            steps: 1000,
            after: 0,
        };
        assert_eq!([0, 1000, 9000].map(|steps| ramp.at(steps)), [0.4, 0.1, 0.1]);
        assert_eq!(
            [0, 1000, 9000].map(|steps| Geometric(ramp).at(steps)),
            [0.4, 0.1, 0.1]
        );
        assert!((ramp.at(500) - 0.25).abs() < 1e-12);
        assert!((Geometric(ramp).at(500) - 0.2).abs() < 1e-12);
    }

    #[test]
    fn a_ramp_may_begin_later_and_keeps_its_first_value_until_then() {
        let ramp = Ramp {
            from: 0.0,
            to: 0.5,
            steps: 1000,
            after: 4000,
        };
        assert_eq!(
            [0, 3999, 4000, 5000, 9000].map(|steps| ramp.at(steps)),
            [0.0, 0.0, 0.0, 0.5, 0.5]
        );
        assert!((ramp.at(4500) - 0.25).abs() < 1e-12);
        let step = Ramp { steps: 0, ..ramp };
        assert_eq!([0, 3999, 4000].map(|steps| step.at(steps)), [0.0, 0.0, 0.5]);
        assert_eq!(
            [
                ramp.end(),
                step.end(),
                Ramp {
                    after: u64::MAX,
                    ..ramp
                }
                .end()
            ],
            [5000, 4000, u64::MAX]
        );
        assert_eq!(
            Value::try_from(ramp).unwrap().to_string(),
            "{ from = 0.0, to = 0.5, steps = 1000, after = 4000 }"
        );
    }

    #[test]
    fn a_ramp_of_no_steps_is_at_its_end_from_the_first_step_on() {
        let ramp = Ramp {
            from: 0.4,
            to: 0.1,
            steps: 0,
            after: 0,
        };
        assert_eq!([ramp.at(0), Geometric(ramp).at(0), ramp.at(5)], [0.1; 3]);
        assert_eq!(
            [0, 7].map(|steps| Geometric(Ramp::constant(0.07)).at(steps)),
            [0.07; 2]
        );
        assert_eq!(Ramp::constant(-0.3).at(3), -0.3);
    }

    #[test]
    fn a_ramp_without_a_later_beginning_survives_being_written_and_read_where_the_default_has_one()
    {
        for given in [
            "0",
            "0.7",
            "{from=0,to=0.5,steps=20_000_000}",
            "{from=0.2,to=0.5,steps=0,after=7}",
        ] {
            let config = Settings::new()
                .sets(&[format!("randomization.share={given}").parse().unwrap()])
                .resolve()
                .unwrap();
            let stored = Source::new("config.toml", config.to_text());
            let again = Settings::new().file(stored.clone()).resolve().unwrap();
            let sets = ["ppo.gamma=0.9".parse().unwrap()];
            let forked = Settings::new()
                .stored(stored, Reader::Run)
                .sets(&sets)
                .resolve()
                .unwrap();
            let shares = [&config, &again, &forked].map(|config| config.randomization.share);
            assert_eq!(shares, [shares[0]; 3], "{given}");
            assert_eq!(again.randomization.happens(), given != "0");
            assert_eq!(
                shares[0].after,
                if given.contains("after") { 7 } else { 0 },
                "{given}"
            );
        }
    }
}
