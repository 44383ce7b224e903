//! Configurations as trees of settings: where two differ, and which settings are ramps.

use toml::{Table, Value};

use super::overlay::{brief, settings};
use super::ramp::Ramp;
use super::settings::{BUILTIN_MODEL, Config, EnvConfig};

/// A setting by its dotted key, and its values in both configurations.
pub type Difference = (String, [Value; 2]);

impl Config {
    /// Lists the settings that differ in `other`. Leaves out what may change during a run: the total number of steps, the
    /// number of threads and the path of the scene.
    pub fn differences(&self, other: &Self) -> Vec<String> {
        let differing = differing([self, other].map(|of| {
            let mut same = of.settled();
            same.env.model = BUILTIN_MODEL.into();
            same
        }));
        differing.into_iter().map(|(key, [own, other])| format!("{key} = {other}, not {own}")).collect()
    }

    /// The settings that make `other` another training run: all but the total number of steps and the number of threads.
    pub fn compared_with(&self, other: &Self) -> Vec<Difference> {
        differing([self, other].map(Self::settled))
    }

    /// All settings by dotted key, except settings that only divide the work.
    ///
    /// # Panics
    /// Never panics: a configuration is a tree of tables.
    pub fn dotted(&self) -> Table {
        let own = Table::try_from(self).expect("a configuration is a tree of tables");
        let of_training = settings(&own).filter(|(key, _)| !matches!(&**key, "run.threads" | "run.shards"));
        of_training.map(|(key, value)| (key, value.clone())).collect()
    }

    /// The settings that change in the course of a run, by dotted key.
    ///
    /// # Panics
    /// Never panics: a configuration is a tree of tables.
    pub fn ramps(&self) -> Vec<(String, Ramp)> {
        let own = Table::try_from(self).expect("a configuration is a tree of tables");
        settings(&own).filter_map(|(key, value)| Some((key, Ramp::read(value)?))).collect()
    }

    /// These settings without the length of the run and without what depends on the machine.
    fn settled(&self) -> Self {
        let mut same = self.clone();
        (same.run.total_steps, same.run.threads, same.run.shards) = (0, 0, self.shards());
        same
    }
}

impl EnvConfig {
    /// The settings of the task that differ from the default's at its first step, by dotted key.
    ///
    /// # Panics
    /// Never panics: the defaults are valid.
    pub fn unlike_default(&self) -> Table {
        self.unlike(&Config::default().env.at(0))
    }

    /// The settings of the task that differ from those of `other`, by dotted key.
    ///
    /// # Panics
    /// Never panics: the defaults are valid.
    pub fn unlike(&self, other: &Self) -> Table {
        let default = Config::default();
        let num_envs = default.env.num_envs;
        let [own, other] = [self, other].map(|env| Config { env: Self { num_envs, ..env.clone() }, ..default.clone() });
        differing([other, own]).into_iter().map(|(key, [_, own])| (key, own)).collect()
    }
}

fn differing(both: [Config; 2]) -> Vec<Difference> {
    let [own, other] = both.map(|of| Table::try_from(of).expect("a configuration is a tree of tables"));
    let both = settings(&own).zip(settings(&other)).filter(|((_, own), (_, other))| own != other);
    both.map(|((key, own), (_, other))| (key, [own.clone(), other.clone()])).collect()
}

/// A value as `--set` takes it, without spaces.
pub fn short(value: &Value) -> String {
    let joined = |parts: Vec<String>| parts.join(",");
    match value {
        Value::Array(values) => format!("[{}]", joined(values.iter().map(inner).collect())),
        Value::Table(parts) => {
            format!("{{{}}}", joined(parts.iter().map(|(key, value)| format!("{key}={}", inner(value))).collect()))
        }
        Value::String(text) => text.clone(),
        Value::Float(x) => brief(*x),
        value => value.to_string(),
    }
}

/// A value as part of another one, where text has quotes.
fn inner(value: &Value) -> String {
    if value.is_str() { value.to_string() } else { short(value) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    #[test]
    fn what_makes_another_training_is_listed_in_the_form_of_an_option_that_sets_it() {
        let sets = [
            "env.num_envs=64",
            "ppo.hidden=[64, 64]",
            "env.noise={joint_pos=0.1}",
            "training.tolerance.to=0.05",
            "ppo.std=1",
        ];
        let more = ["run.seed=7", "ppo.precision=bf16-rounded", "run.threads=3", "run.total_steps=7"];
        let sets: Vec<_> = sets.iter().chain(&more).map(|set| set.parse().unwrap()).collect();
        let [default, own] = [&[], &sets[..]].map(|sets| Settings::new().sets(sets).resolve().unwrap());
        let found: Vec<String> =
            default.compared_with(&own).iter().map(|(key, [_, own])| format!("{key}={}", short(own))).collect();
        let expected = [
            "env.num_envs=64",
            "env.noise={joint_pos=0.1}",
            "training.tolerance={from=0.4,to=0.05,steps=20000000}",
            "ppo.hidden=[64,64]",
            "ppo.precision=bf16-rounded",
            "ppo.std=1",
            "run.seed=7",
        ];
        assert_eq!(found, expected);
        let again: Vec<_> = found.iter().map(|set| set.parse().unwrap()).collect();
        assert!(Settings::new().sets(&again).resolve().unwrap().compared_with(&own).is_empty());
    }
}
