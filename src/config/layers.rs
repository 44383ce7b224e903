//! The layers of a configuration: the defaults, overlaid with the user's file, overlaid with single settings.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow, bail};
use serde::Deserialize;
use toml::{Table, Value};

use super::overlay::{DEFAULTS, lookup, names_scene, overlay, settings, table_of};
use super::rules::violations;
use super::settings::{BUILTIN_MODEL, Config, EnvConfig, NetConfig};
use super::{BASE, Ramp, SHIPPED};
use crate::os;
use crate::sim::Parts;

/// The keys of `[ppo]` that describe a policy.
const OF_NETS: [&str; 3] = ["hidden", "activation", "symmetry"];

/// One `--set key=value`.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// The dotted key, e.g. `ppo.learning_rate`.
    pub key: String,
    /// The text after the equals sign.
    pub value: String,
}

impl std::str::FromStr for Override {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('=').map(|(key, value)| (key.trim(), value.trim()));
        let (key, value) = parts
            .filter(|(key, _)| !key.is_empty())
            .ok_or_else(|| format!("`{text}` is not of the form key=value, e.g. ppo.learning_rate=1e-4"))?;
        Ok(Self { key: key.into(), value: value.into() })
    }
}

/// A configuration text and the path to name in messages about it.
pub struct Source {
    /// The file it came from.
    pub path: PathBuf,
    /// Its content.
    pub text: String,
}

/// The settings for playing a policy: the only ones that are read from its file.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyConfig {
    /// The task that the policy was trained for.
    pub env: EnvConfig,
    /// The parts of its hand that are named.
    pub hand: Parts,
    /// The structure of the policy.
    pub net: NetConfig,
}

impl Config {
    /// Returns the base, overlaid with the user's file and then with `overrides`.
    ///
    /// # Errors
    /// Fails with one error that lists the unknown keys, the values of a wrong type and the values out of range.
    pub fn resolve(user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        layered(Table::new(), user.map(Source::table).transpose()?, overrides)
    }

    /// Returns the settings of a task and of its lesson, as [`Config::resolve`] does. Other settings in the user's file are
    /// ignored.
    ///
    /// # Errors
    /// Fails as [`Config::resolve`] does.
    pub fn resolve_task(user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        let mut user = user.map(Source::table).transpose()?;
        if let Some((_, table)) = &mut user {
            table.retain(|section, _| !matches!(section, "ppo" | "run"));
            table.get_mut("env").and_then(Value::as_table_mut).map(|env| env.remove("num_envs"));
        }
        layered(Table::new(), user, overrides)
    }

    /// Returns the settings of a training that begins with a policy of this net. As [`Config::resolve`], but the base has this net.
    ///
    /// # Errors
    /// Fails as [`Config::resolve`] does.
    pub fn resolve_around(net: &NetConfig, user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        let ppo = Value::try_from(net).expect("the structure of a net is a table");
        layered(Table::from_iter([("ppo".into(), ppo)]), user.map(Source::table).transpose()?, overrides)
    }

    /// Parses a complete configuration that a run has written, overlaid with `overrides`. Settings that did not exist then have
    /// their defaults.
    ///
    /// # Errors
    /// Fails as [`Config::resolve`] does.
    pub fn from_text(path: &Path, text: &str, overrides: &[Override]) -> Result<Self> {
        let source = Source { path: path.into(), text: text.into() };
        layered(Table::new(), Some(source.table()?), overrides)
    }

    /// Returns these settings, overlaid with the user's file and then with `overrides`. The scene is not taken from these
    /// settings, because no path in a checkpoint is followed. The number of shards is kept if it still fits.
    ///
    /// # Errors
    /// Fails as [`Config::resolve`] does.
    pub fn changed(&self, user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        let mut own = self.clone();
        (own.env.model, own.run.shards) = (BUILTIN_MODEL.into(), 0);
        let own = Table::try_from(own).expect("a configuration is a tree of tables");
        let mut changed = layered(own, user.map(Source::table).transpose()?, overrides)?;
        if changed.run.shards == 0 && self.run.shards > 0 && changed.divides(self.run.shards) {
            changed.run.shards = self.run.shards;
        }
        Ok(changed)
    }

    /// Returns the whole configuration as TOML.
    pub fn to_text(&self) -> String {
        let sections = Table::try_from(self).expect("a configuration is a tree of tables");
        let mut text = String::new();
        for (section, keys) in &sections {
            text += &format!("[{section}]\n");
            keys.as_table().into_iter().flatten().for_each(|(key, value)| text += &format!("{key} = {value}\n"));
            text.push('\n');
        }
        text
    }
}

impl PolicyConfig {
    /// Reads the settings for playing from the configuration of a run that has made `env_steps` control steps: its ramps have the
    /// values of that moment. All training settings are ignored. Values that came from one scene do not apply to another scene.
    ///
    /// # Errors
    /// Fails as [`Config::resolve`] does.
    pub fn from_text(path: &Path, text: &str, env_steps: u64, overrides: &[Override]) -> Result<Self> {
        let source = Source { path: path.into(), text: text.into() };
        let (path, mut table) = source.table()?;
        table.retain(|section, _| matches!(section, "env" | "hand" | "ppo"));
        let stored = lookup(&table, "env.model").and_then(Value::as_str).unwrap_or(BUILTIN_MODEL).to_owned();
        let asked = overrides.iter().rfind(|set| set.key == "env.model");
        let is_same = asked.is_none_or(|asked| names_scene(&asked.value, &stored));
        for (section, keys) in &mut table {
            let is_used = |key: &str, value: &Value| match section.as_str() {
                // The sizes of its hand are part of the policy.
                "env" if ["num_envs", "num_hand_dofs", "num_actuators"].contains(&key) => false,
                "env" if key == "goal_position" && stored == BUILTIN_MODEL => *value != DEFAULTS["env"][key],
                "env" if key == "goal_position" => is_same,
                "env" | "hand" => true,
                _ => OF_NETS.contains(&key),
            };
            let Some(keys) = keys.as_table_mut() else { continue };
            keys.retain(|key, value| is_used(key, value));
            for (_, value) in keys {
                if let Some(ramp) = Ramp::read(value) {
                    *value = ramp.at(env_steps).into();
                }
            }
        }
        let Config { env, hand, ppo, .. } = layered(Table::new(), Some((path, table)), overrides)?;
        Ok(Self { env, hand, net: ppo.net() })
    }
}

/// Reads the user's configuration file, if one was given. If it is called as one that comes with the program and is not there, it is
/// taken from the program. So the documented commands work in any folder.
///
/// # Errors
/// Fails if the file cannot be read.
pub fn user_file(path: Option<&Path>) -> Result<Option<Source>> {
    let Some(path) = path else { return Ok(None) };
    let own = SHIPPED.into_iter().find(|(place, _)| path == Path::new(place) && !path.exists());
    let text = match own {
        Some((place, text)) => {
            os::say(&format!("note: there is no {place} here: using the one in the program"));
            text.to_owned()
        }
        None => os::read_text(path)?,
    };
    Ok(Some(Source { path: path.to_owned(), text }))
}

impl Source {
    fn table(&self) -> Result<(&Path, Table)> {
        // The base itself counts as setting nothing.
        if self.text == BASE {
            return Ok((&self.path, Table::new()));
        }
        let table = self.text.parse().map_err(|error: toml::de::Error| {
            let lines: Vec<String> = error.to_string().lines().map(os::shortened).collect();
            anyhow!("{}: not a TOML file: {}", self.path.display(), lines.join("\n"))
        })?;
        Ok((&self.path, table))
    }
}

/// Returns the base, overlaid with `under`, with the table of the user's file, and with `overrides`, in this order. An error
/// names the file.
fn layered(under: Table, user: Option<(&Path, Table)>, overrides: &[Override]) -> Result<Config> {
    let (mut merged, mut problems) = (DEFAULTS.clone(), Vec::new());
    let (file, given) = user.unzip();
    let mut named = BTreeSet::new();
    let mut lay = |table: &Table, merged: &mut Table| {
        named.extend(settings(table).map(|(key, _)| key));
        overlay(merged, table, &DEFAULTS, "", &mut problems);
    };
    [Some(under), given].iter().flatten().for_each(|table| lay(table, &mut merged));
    for Override { key, value } in overrides {
        let single = table_of(key, value, &merged);
        lay(&single, &mut merged);
    }
    // serde stops at the first error, so each key is tried alone among valid defaults to report all of them. One that fails is
    // replaced by its default, so that the other rules can be checked.
    let is_whole = Config::deserialize(Value::Table(merged.clone())).is_ok();
    for (name, default) in settings(&DEFAULTS).filter(|_| !is_whole) {
        let (section, key) = name.split_once('.').expect("a key is in a section");
        let mut alone = DEFAULTS.clone();
        alone[section][key] = merged[section][key].clone();
        if let Err(error) = Config::deserialize(Value::Table(alone)) {
            let (value, message) = (merged[section][key].to_string(), error.message().trim());
            problems.push(format!("{name} = {}: {}", os::shortened(&value), os::shortened(message)));
            merged[section][key] = default.clone();
        }
    }
    let mut config = Config::deserialize(Value::Table(merged))?;
    let env = &mut config.env;
    if env.model_file().is_some() && !named.contains("randomization.cube_size") {
        config.randomization.cube_size = [1.0; 2];
    }
    env.goal_position.named = named.contains("env.goal_position");
    env.num_hand_dofs.named = named.contains("env.num_hand_dofs");
    env.num_actuators.named = named.contains("env.num_actuators");
    problems.extend(violations(&config));
    if problems.is_empty() {
        return Ok(config);
    }
    let origin = file.map_or(String::new(), |file| format!(" ({})", file.display()));
    bail!("invalid configuration{origin}:\n  {}", problems.join("\n  "))
}

#[cfg(test)]
mod tests {
    use super::super::{Activation, Ramp};
    use super::*;

    fn set(text: &str) -> Override {
        text.parse().unwrap()
    }

    fn errors(overrides: &[&str]) -> String {
        let overrides: Vec<Override> = overrides.iter().map(|s| set(s)).collect();
        Config::resolve(None, &overrides).unwrap_err().to_string()
    }

    #[test]
    fn the_base_is_valid_and_survives_being_written_and_read() {
        let config = Config::resolve(None, &[]).unwrap();
        assert_eq!(config.env.max_episode_steps(), 1000);
        assert_eq!(config.env.substeps(), 1);
        let again = Config::from_text(Path::new("config.toml"), &config.to_text(), &[]).unwrap();
        assert_eq!(config, again);
    }

    fn file(text: &str) -> Source {
        Source { path: "x.toml".into(), text: text.into() }
    }

    #[test]
    fn a_file_may_set_part_of_a_ramp() {
        let text = "[training]\ntolerance = { steps = 50_000_000 }\n";
        let config = Config::resolve(Some(&file(text)), &[]).unwrap();
        assert_eq!(config.training.tolerance.0, Ramp { from: 0.4, to: 0.07, steps: 50_000_000, after: 0 });
    }

    #[test]
    fn a_ramp_can_be_set_whole_in_part_or_as_a_constant() {
        let tolerance = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            Config::resolve(None, &sets).unwrap().training.tolerance.0
        };
        let default = Ramp { from: 0.4, to: 0.07, steps: 20_000_000, after: 0 };
        assert_eq!(tolerance(&[]), default);
        assert_eq!(tolerance(&["training.tolerance=0.07"]), Ramp::constant(0.07));
        assert_eq!(tolerance(&["training.tolerance.to=0.05"]), Ramp { to: 0.05, ..default });
        assert_eq!(tolerance(&["training.tolerance.steps=1e6"]), Ramp { steps: 1_000_000, ..default });
        let whole = tolerance(&["training.tolerance={from=0.3,to=0.06,steps=30000000}"]);
        assert_eq!(whole, Ramp { from: 0.3, to: 0.06, steps: 30_000_000, after: 0 });
        assert_eq!(tolerance(&["training.tolerance={to=0.06}"]), Ramp { to: 0.06, ..default });
        // Part of a ramp that was set to a constant before.
        let both = tolerance(&["training.tolerance=1", "training.tolerance.to=0.5"]);
        assert_eq!(both, Ramp { from: 1.0, to: 0.5, steps: 0, after: 0 });
        // A ramp may begin later, whether its default does or not.
        assert_eq!(tolerance(&["training.tolerance.after=1e6"]), Ramp { after: 1_000_000, ..default });
        let share = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            Config::resolve(None, &sets).unwrap().randomization.share
        };
        let later = Ramp { from: 0.0, to: 0.5, steps: 20_000_000, after: 40_000_000 };
        assert_eq!(share(&[]), later);
        assert_eq!(share(&["randomization.share.to=0.7"]), Ramp { to: 0.7, ..later });
        assert_eq!(share(&["randomization.share=0.7"]), Ramp::constant(0.7), "from the first step on");
    }

    #[test]
    fn a_table_by_group_is_set_whole_or_one_group_at_a_time() {
        let noise = |text: &str, sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            let noise = Config::resolve(Some(&file(text)), &sets).unwrap().env.noise;
            noise.into_iter().map(|(group, std)| format!("{group} {std}")).collect::<Vec<_>>().join(", ")
        };
        let both = "[env]\nnoise = { joint_pos = 1, cube_pos = 0.5 }";
        assert_eq!(noise("", &[]), "");
        assert_eq!(noise(both, &[]), "cube_pos 0.5, joint_pos 1");
        assert_eq!(noise(both, &["env.noise={cube_quat=2}"]), "cube_quat 2");
        assert_eq!(noise(both, &["env.noise={}"]), "");
        assert_eq!(
            noise(both, &["env.noise.joint_pos=3", "env.noise.cube_quat=2"]),
            "cube_pos 0.5, cube_quat 2, joint_pos 3"
        );
        let fork = Config::resolve(Some(&file(both)), &[]).unwrap();
        assert!(fork.changed(Some(&file("[env]\nnoise = {}")), &[]).unwrap().env.noise.is_empty());
    }

    #[test]
    fn what_is_wrong_with_a_ramp_is_said_by_name() {
        for (bad, part) in [
            ("training.tolerance=0", "training.tolerance = 0: must be above 0"),
            ("training.tolerance.from=-1", "training.tolerance.from = -1: must be above 0"),
            ("training.tolerance=wide", "training.tolerance = \"wide\": must be a number, or { from = …"),
            ("training.tolerance=nan", "training.tolerance.from = nan: must be a finite number"),
            ("training.tolerance.form=1", "training.tolerance.form: unknown key"),
            ("training.tolerance.steps=-1", "training.tolerance.steps = -1: must be a whole number"),
            ("training.hold.to=0.4", "training.hold.to = 0.4: must be at least 1"),
            ("ppo.std.to=0", "ppo.std.to = 0: must be above 0"),
            ("ppo.desired_kl.to=0", "must be above 0 at both ends, or 0 throughout"),
        ] {
            let text = errors(&[bad]);
            assert!(text.contains(part), "{bad}: {part} is not in\n{text}");
        }
    }

    #[test]
    fn of_the_settings_in_a_policys_file_only_those_of_playing_are_read() {
        let trained = "[env]\nnum_envs = 0\nrot_eps = 0.2\n[ppo]\nhidden = [9]\ngamma = \"much\"\nnot_yet = 1\n\
                       [training]\ngoal_reward = 3\n[of_tomorrow]\nx = 1\n[run]\nseed = -1";
        let policy = |text: &str, sets: &[Override]| PolicyConfig::from_text(Path::new("x"), text, 0, sets);
        let found = policy(trained, &[set("env.sim_dt=0.005")]).unwrap();
        assert_eq!((found.env.rot_eps, found.env.sim_dt, found.net.hidden), (0.2, 0.005, vec![9]));
        let whole = Config::resolve(None, &[]).unwrap();
        assert_eq!(
            policy(&whole.to_text(), &[]).unwrap(),
            PolicyConfig { env: whole.env, hand: whole.hand, net: whole.ppo.net() }
        );
        for (bad, part) in [
            ("[env]\nrot_eps = 0", "env.rot_eps = 0: must be above 0"),
            ("[env]\nnot_yet = 1", "env.not_yet: unknown key"),
            ("[ppo]\nhidden = []", "must hold one to 64 sizes"),
        ] {
            let text = policy(bad, &[]).unwrap_err().to_string();
            assert!(text.contains(part), "{text}");
        }
    }

    #[test]
    fn a_users_file_holds_only_what_differs_and_set_wins_over_it() {
        let source =
            Source { path: "my.toml".into(), text: "[ppo]\ngamma = 0.98\nhidden = [32]\n[env]\nnum_envs = 8".into() };
        let sets = [set("ppo.gamma=0.97"), set("ppo.activation=tanh"), set("run.total_steps=1e6")];
        let config = Config::resolve(Some(&source), &sets).unwrap();
        assert_eq!((config.ppo.gamma, config.env.num_envs), (0.97, 8));
        assert_eq!((config.ppo.hidden, config.ppo.activation), (vec![32], Activation::Tanh));
        assert_eq!((config.run.total_steps, config.ppo.lambda), (1_000_000, 0.95));
    }

    #[test]
    fn all_violations_are_named_together_with_the_rule() {
        let text = errors(&["ppo.minibatches=7", "env.rot_eps=0", "ppo.gama=1", "env.sim_dt=fast", "ppo.clip=-1"]);
        for part in [
            "ppo.minibatches = 7: must divide num_envs * horizon",
            "env.rot_eps = 0: must be above 0",
            "ppo.gama: unknown key; did you mean ppo.gamma?",
            "env.sim_dt = \"fast\": must be a number",
            "ppo.clip = -1: must be above 0",
        ] {
            assert!(text.contains(part), "{part}\nis not in\n{text}");
        }
    }

    #[test]
    fn the_control_step_must_be_a_whole_multiple_of_the_physics_step() {
        let text = errors(&["env.sim_dt=0.003"]);
        assert!(text.contains("env.ctrl_dt = 0.01: must be a whole multiple of env.sim_dt = 0.003"), "{text}");
        let config = Config::resolve(None, &[set("env.sim_dt=0.002")]).unwrap();
        assert_eq!(config.env.substeps(), 5);
    }

    #[test]
    fn wrong_kinds_of_values_are_refused_by_name() {
        for (bad, part) in [
            ("env.rot_eps=nan", "must be a finite number"),
            ("env.num_envs=-3", "must be a whole number, not negative"),
            ("env.num_envs=0", "must be at least 1"),
            ("env.num_envs=1.5", "must be a whole number, not negative"),
            ("ppo.hidden=3", "must be an array"),
            ("ppo.hidden=[]", "must hold one to 64 sizes"),
            ("ppo=3", "must be a section with keys"),
            ("ppo.activation=gelu", "gelu"),
            ("ppo.away_range=[0.5,0.5]", "must be [near, far] with 0 <= near < far"),
            ("env.goal_position=[1,2]", "goal_position"),
            ("nonsense=1", "nonsense: unknown key"),
            ("training.tolerance.step=5", "did you mean training.tolerance.steps?"),
            ("ppo.lr=1", "configs/repose.toml lists all of them"),
            ("env.cube_size=1", "did you mean env.cube_size_scale?"),
            ("randomization.mass=1", "did you mean randomization.cube_mass?"),
            ("learning_rate=1", "did you mean ppo.learning_rate?"),
            ("env.quixotic=1", "env.quixotic: unknown key; configs/repose.toml"),
            ("env.success_tolerance=3.2", "must be at most 3.14"),
            (
                "env.goal_position=[1e3,0,0]",
                "env.goal_position = [1000.0, 0.0, 0.0]: must have coordinates of at most 100 m",
            ),
            ("env.vel_obs_scale=1e300", "must be at most 1000000"),
            (
                "training.drop_reward.to=-1e10",
                "training.drop_reward = -10000000000: must be at most 1000000000 in magnitude",
            ),
            ("env.act_moving_average=0", "must be above 0"),
        ] {
            let text = errors(&[bad]);
            assert!(text.contains(part), "{bad}: {part} is not in\n{text}");
        }
    }

    #[test]
    fn an_override_without_equals_sign_is_refused() {
        assert!("ppo.gamma".parse::<Override>().is_err());
        assert!("=1".parse::<Override>().is_err());
    }
}
