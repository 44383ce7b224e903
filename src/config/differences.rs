//! Configurations as trees of settings: where two differ, and which settings are ramps.

use toml::{Table, Value};

use super::layers::MODEL;
use super::overlay::{DEFAULTS, brief, lookup, settings};
use super::ramp::Ramp;
use super::settings::{Config, EnvConfig};

/// A setting by its dotted key, and its values in both configurations.
pub type Difference = (String, [Value; 2]);

impl Config {
    /// Lists the settings that differ in `other`. Leaves out what may change during a run: the total number of steps, the
    /// number of threads and the path of the scene.
    pub fn differences(&self, other: &Self) -> Vec<String> {
        self.compared_with(other)
            .into_iter()
            .filter(|(key, _)| key != MODEL)
            .map(|(key, [own, other])| format!("{key} = {other}, not {own}"))
            .collect()
    }

    /// The settings that make `other` another training run: all but the total number of steps and the number of threads.
    pub fn compared_with(&self, other: &Self) -> Vec<Difference> {
        let [own, other] = [self, other].map(|of| {
            let mut same = of.clone();
            same.run.total_steps = 0;
            same.run.threads = 0;
            same.run.shards = of.shards();
            same.flat()
        });
        own.into_iter()
            .zip(other)
            .map(|((key, own), (_, other))| (key, [own, other]))
            .filter(|(_, [own, other])| own != other)
            .collect()
    }

    /// All settings by dotted key, except settings that only divide the work, each of one type in every run: what may be a ramp or a
    /// table is a text.
    pub fn dotted(&self) -> Table {
        let mut own = self.flat();
        own.retain(|key, _| !["run.threads", "run.shards"].contains(&key));
        for (key, value) in &mut own {
            if lookup(&DEFAULTS, key).is_some_and(Value::is_table) {
                *value = value.to_string().into();
            }
        }
        own
    }

    /// The settings that change in the course of a run, by dotted key.
    pub fn ramps(&self) -> Vec<(String, Ramp)> {
        self.flat()
            .into_iter()
            .filter_map(|(key, value)| Some((key, Ramp::read(&value)?)))
            .collect()
    }

    /// All settings by dotted key.
    pub fn flat(&self) -> Table {
        let own = Table::try_from(self).expect("a configuration is a tree of tables");
        settings(&own)
            .map(|(key, value)| (key, value.clone()))
            .collect()
    }
}

impl EnvConfig {
    /// The settings of the task that differ from the default's at its first step, by dotted key.
    pub fn unlike_default(&self) -> Table {
        self.unlike(&Config::default().env.at(0))
    }

    /// The settings of the task that differ from those of `other`, by dotted key.
    pub fn unlike(&self, other: &Self) -> Table {
        let [own, other] = [self, other].map(|env| Config {
            env: Self {
                num_envs: 1,
                ..env.clone()
            },
            ..Config::default()
        });
        other
            .compared_with(&own)
            .into_iter()
            .map(|(key, [_, own])| (key, own))
            .collect()
    }
}

/// Whether a setting follows from the scene.
pub fn is_derived(key: &str) -> bool {
    ["env.num_hand_dofs", "env.num_actuators"].contains(&key)
}

/// A value as `--set` takes it, without spaces.
pub fn short(value: &Value) -> String {
    value.as_str().map_or_else(|| inner(value), str::to_owned)
}

/// A value as part of another one, where text has quotes.
fn inner(value: &Value) -> String {
    match value {
        Value::Array(values) => {
            let values = Vec::from_iter(values.iter().map(inner));
            format!("[{}]", values.join(","))
        }
        Value::Table(parts) => {
            let parts = parts
                .iter()
                .map(|(key, value)| format!("{key}={}", inner(value)));
            format!("{{{}}}", Vec::from_iter(parts).join(","))
        }
        Value::Float(x) => brief(*x),
        value => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    #[test]
    fn a_setting_that_may_be_a_ramp_is_a_text_in_every_run_and_any_other_setting_keeps_its_type() {
        let of = |sets: &[&str]| {
            let sets: Vec<_> = sets.iter().map(|set| set.parse().unwrap()).collect();
            let config = Settings::new().sets(&sets).resolve().unwrap();
            config.dotted()
        };
        let all = |to: &str| {
            let ramps = DEFAULTS.iter().flat_map(|(section, keys)| {
                let ramps = keys.as_table().unwrap().iter();
                let ramps = ramps.filter(|(_, value)| value.get("from").is_some());
                ramps.map(move |(key, _)| format!("{section}.{key}"))
            });
            let sets: Vec<String> = ramps.map(|key| format!("{key}={to}")).collect();
            of(&sets.iter().map(String::as_str).collect::<Vec<_>>())
        };
        let default = of(&[]);
        let constant = all("1");
        for other in [
            &constant,
            &all("{from=1,to=1,steps=7}"),
            &of(&["env.noise={joint_pos=0.1}"]),
        ] {
            assert_eq!(other.len(), default.len());
            for ((key, value), usual) in other.iter().zip(default.values()) {
                assert!(value.same_type(usual), "{key}: {value} and {usual}");
            }
        }
        assert_eq!(
            of(&["training.tolerance=0.07"])["training.tolerance"].as_str(),
            Some("0.07")
        );
        assert!(default["ppo.gamma"].is_float());
    }

    #[test]
    fn what_makes_another_training_is_listed_in_the_form_of_an_option_that_sets_it() {
        let sets = [
            "env.num_envs=64",
            "ppo.hidden=[64, 64]",
            "env.noise={joint_pos=0.1}",
            "training.tolerance.to=0.05",
            "ppo.std=1",
        ];
        let more = [
            "run.seed=7",
            "ppo.precision=bf16-rounded",
            "run.threads=3",
            "run.total_steps=7",
        ];
        let sets: Vec<_> = sets
            .iter()
            .chain(&more)
            .map(|set| set.parse().unwrap())
            .collect();
        let [default, own] =
            [&[], &sets[..]].map(|sets| Settings::new().sets(sets).resolve().unwrap());
        let found: Vec<String> = default
            .compared_with(&own)
            .iter()
            .map(|(key, [_, own])| format!("{key}={}", short(own)))
            .collect();
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
        assert!(
            Settings::new()
                .sets(&again)
                .resolve()
                .unwrap()
                .compared_with(&own)
                .is_empty()
        );
    }
}
