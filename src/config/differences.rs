//! In what configurations differ: from one another, and from the default one.

use toml::Table;

use super::overlay::settings;
use super::settings::{BUILTIN_MODEL, Config, EnvConfig};

impl Config {
    /// Lists the settings that differ in `other`, except those that may change during a run: the total number of steps, the
    /// number of threads and the path of the scene.
    pub fn differences(&self, other: &Self) -> Vec<String> {
        let table = |of: &Self| {
            let mut same = of.clone();
            (same.run.total_steps, same.run.threads, same.run.shards) = (0, 0, of.shards());
            same.env.model = BUILTIN_MODEL.into();
            Table::try_from(same).expect("a configuration is a tree of tables")
        };
        let (own, other) = (table(self), table(other));
        let both = settings(&own).zip(settings(&other)).filter(|((_, own), (_, other))| own != other);
        both.map(|((key, own), (_, other))| format!("{key} = {other}, not {own}")).collect()
    }

    /// Returns all settings by dotted key, except those that only say how the work is shared.
    ///
    /// # Panics
    /// Never panics: a configuration is a tree of tables.
    pub fn dotted(&self) -> Table {
        let own = Table::try_from(self).expect("a configuration is a tree of tables");
        let settings = settings(&own).filter(|(key, _)| !matches!(&**key, "run.shards" | "run.threads"));
        settings.map(|(key, value)| (key, value.clone())).collect()
    }

    /// Returns the settings that differ from the default ones, by dotted key, as [`Config::dotted`] does.
    ///
    /// # Panics
    /// Never panics: the defaults are valid.
    pub fn unlike_default(&self) -> Table {
        let default = Self::resolve(None, &[]).expect("the defaults are valid").dotted();
        self.dotted().into_iter().filter(|(key, value)| default.get(key) != Some(value)).collect()
    }
}

impl EnvConfig {
    /// Returns the settings that differ from the default ones, by dotted key. The number of hands is none of the task.
    ///
    /// # Panics
    /// Never panics: the defaults are valid.
    pub fn unlike_default(&self) -> Table {
        let default = Config::resolve(None, &[]).expect("the defaults are valid");
        let own = Config { env: Self { num_envs: default.env.num_envs, ..self.clone() }, ..default };
        own.unlike_default()
    }
}
