//! The layers of a configuration: the defaults, overlaid with the user's file, overlaid with single settings.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow, bail};
use toml::{Table, Value};

use super::overlay::{DEFAULTS, lookup, names_scene, overlay, settings, table_of};
use super::rules::violations;
use super::settings::{BUILTIN_MODEL, Config, EnvConfig};
use super::{BASE, Ramp, SHIPPED};
use crate::os;

/// The key of the only setting that is a path.
pub const MODEL: &str = "env.model";

/// One `--set key=value`.
#[derive(Clone, PartialEq)]
pub struct Override {
    /// The dotted key, e.g. `ppo.learning_rate`.
    pub key: String,
    /// The text after the equals sign.
    pub value: String,
}

impl Override {
    /// A setting by its dotted key.
    pub fn new(key: impl Into<String>, value: impl ToString) -> Self {
        Self {
            key: key.into(),
            value: value.to_string(),
        }
    }
}

impl std::str::FromStr for Override {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((key, value)) if !key.trim().is_empty() => Ok(Self::new(key.trim(), value.trim())),
            _ => Err(format!(
                "`{text}` is not of the form key=value, e.g. ppo.learning_rate=1e-4"
            )),
        }
    }
}

/// A configuration text and the path to name in messages about it.
#[derive(Clone)]
pub struct Source {
    /// The file it came from.
    pub path: PathBuf,
    /// Its content.
    pub text: String,
}

/// Who reads the settings that a run has written, which decides what is taken from them.
#[derive(Clone, Copy, PartialEq)]
pub enum Reader {
    /// The run itself, or a fork of it: everything. The number of shards is kept if it still fits.
    Run,
    /// A new run that begins with the policy: the structure of its net.
    NewRun,
    /// A player of the policy, after this many control steps of the run: the task, the hand and the net. Ramps have the values that
    /// they had reached. Values that came from one scene do not apply to another scene.
    Player {
        /// Control steps over all environments.
        env_steps: u64,
    },
}

impl Reader {
    /// The part of the settings of a run that it takes, if the user gives these single settings.
    fn take(self, mut table: Table, sets: &[Override]) -> Table {
        if self == Self::Run {
            return table;
        }
        let stored = model(&table).to_owned();
        let asked = sets.iter().rev().find_map(|Override { key, value }| {
            lookup(&table_of(key, value, &DEFAULTS), MODEL).cloned()
        });
        let is_kept = |place: &Value| {
            let is_own = stored != BUILTIN_MODEL || *place != DEFAULTS["env"]["goal_position"];
            is_own
                && asked
                    .as_ref()
                    .is_none_or(|asked| names_scene(asked, &stored))
        };
        table.retain(|section, _| ["env", "hand", "ppo"].contains(&section));
        for (section, keys) in &mut table {
            let Value::Table(keys) = keys else { continue };
            keys.retain(|key, value| match &**section {
                // What describes a policy.
                "ppo" => ["hidden", "activation", "symmetry"].contains(&key),
                _ if self == Self::NewRun => false,
                "env" if key == "goal_position" => is_kept(value),
                // The sizes of its hand are part of the policy.
                _ => !["num_envs", "num_hand_dofs", "num_actuators"].contains(&key),
            });
            for (_, value) in keys {
                if let Self::Player { env_steps } = self
                    && let Some(ramp) = Ramp::read(value)
                {
                    *value = ramp.at(env_steps).into();
                }
            }
        }
        table
    }
}

/// The scene that the settings of a run name.
fn model(table: &Table) -> &str {
    lookup(table, MODEL)
        .and_then(Value::as_str)
        .unwrap_or(BUILTIN_MODEL)
}

/// The setting that names this scene, for a shell.
fn scene_setting(model: &str) -> String {
    os::quoted(&format!("{MODEL}={model}"))
}

/// The option that names the scene of these settings, with a space before it, or nothing for the built-in scene.
pub fn scene_option(env: &EnvConfig) -> String {
    env.model_file().map_or(String::new(), |_| {
        format!(" --set {}", scene_setting(&env.model))
    })
}

/// Where settings come from: the base, over it what a run has written, then the user's file, then single settings.
#[derive(Default)]
pub struct Settings {
    stored: Option<(Source, Reader)>,
    file: Option<Source>,
    sets: Vec<Override>,
}

impl Settings {
    /// The base alone.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds what a run has written, as this reader takes it. Settings that did not exist then have their defaults.
    pub fn stored(self, stored: Source, reader: Reader) -> Self {
        Self {
            stored: Some((stored, reader)),
            ..self
        }
    }

    /// Adds a file that the user trusts.
    pub fn file(self, file: Source) -> Self {
        Self {
            file: Some(file),
            ..self
        }
    }

    /// Adds the user's file, if one is given. If it is called as one that comes with the program and is not there, it is taken from
    /// the program. So the documented commands work in any folder.
    ///
    /// # Errors
    /// Fails if the file cannot be read.
    pub fn user_file(self, path: Option<&Path>) -> Result<Self> {
        let Some(path) = path else { return Ok(self) };
        let own = SHIPPED
            .into_iter()
            .find(|(place, _)| path == Path::new(place) && !path.exists());
        let text = match own {
            Some((place, text)) => {
                os::say!("note: there is no {place} here: using the one in the program");
                text.to_owned()
            }
            None => os::read_text(path)?,
        };
        Ok(self.file(Source::new(path, text)))
    }

    /// Adds single settings.
    pub fn sets(self, sets: &[Override]) -> Self {
        Self {
            sets: sets.to_vec(),
            ..self
        }
    }

    /// The configuration that they make together.
    ///
    /// # Errors
    /// Fails with one error that lists the unknown keys, the values of a wrong type and the values out of range. Fails if a run has
    /// stored the path of a scene that the user does not name, because no path in a checkpoint is followed.
    pub fn resolve(self) -> Result<Config> {
        let mut layers = Layers {
            merged: DEFAULTS.clone(),
            named: BTreeSet::new(),
            problems: Vec::new(),
        };
        let mut kept = 0;
        let mut scene = BUILTIN_MODEL.to_owned();
        if let Some((source, reader)) = &self.stored {
            let mut table = reader.take(source.table()?, &self.sets);
            scene = model(&table).to_owned();
            if let Some(Value::Integer(shards)) =
                table.get_mut("run").and_then(|run| run.get_mut("shards"))
            {
                kept = std::mem::take(shards) as usize;
            }
            layers.lay(&table);
            layers.named.remove(MODEL);
        }
        if let Some(file) = &self.file {
            let table = file.table()?;
            layers.lay(&table);
            let scene = model(&table);
            // What comes through a pipe has no folder.
            if scene != BUILTIN_MODEL && file.path.is_file() {
                let place = file.path.with_file_name(scene);
                layers.merged["env"]["model"] = place.display().to_string().into();
            }
        }
        for Override { key, value } in &self.sets {
            layers.lay(&table_of(key, value, &layers.merged));
        }
        let is_named = layers.named.contains(MODEL);
        let origin = match (self.file, self.stored, self.sets.is_empty()) {
            (Some(file), _, true) | (None, Some((file, _)), true) => {
                format!(" ({})", file.path.display())
            }
            (Some(file), _, false) => format!(" ({} and options)", file.path.display()),
            _ => String::new(),
        };
        let mut config = layers.resolve(&origin)?;
        if scene != BUILTIN_MODEL && !is_named {
            let set = scene_setting(&config.env.model);
            bail!(
                "it uses a custom scene, and no path in a file is followed: set {set} to use that scene"
            );
        }
        if config.run.shards == 0 && kept.is_power_of_two() && config.divides(kept) {
            config.run.shards = kept;
        }
        Ok(config)
    }
}

/// The settings of all layers so far.
struct Layers {
    merged: Table,
    /// The settings that a layer has set.
    named: BTreeSet<String>,
    /// What does not fit.
    problems: Vec<String>,
}

impl Layers {
    fn lay(&mut self, table: &Table) {
        self.named.extend(settings(table).map(|(key, _)| key));
        overlay(&mut self.merged, table, &DEFAULTS, "", &mut self.problems);
    }

    /// Replaces each value that has no meaning by its default, so that the rules can be checked for the others.
    ///
    /// serde stops at the first error, so each key is tried alone among valid defaults to report all of them.
    fn replace_nonsense(&mut self) {
        for (name, default) in settings(&DEFAULTS) {
            let (section, key) = name.split_once('.').expect("a key is in a section");
            let mut alone = DEFAULTS.clone();
            alone[section][key] = self.merged[section][key].clone();
            if let Err(error) = alone.try_into::<Config>() {
                let value = os::shortened(&self.merged[section][key].to_string());
                let message = os::shortened(error.message().trim());
                self.problems.push(format!("{name} = {value}: {message}"));
                self.merged[section][key] = default.clone();
            }
        }
    }

    /// The configuration. An error says where it came from.
    fn resolve(mut self, origin: &str) -> Result<Config> {
        if self.merged.clone().try_into::<Config>().is_err() {
            self.replace_nonsense();
        }
        let mut config: Config = self.merged.try_into()?;
        let env = &mut config.env;
        if env.model_file().is_some() && !self.named.contains("randomization.cube_size") {
            config.randomization.cube_size = [1.0; 2];
        }
        env.goal_position.named = self.named.contains("env.goal_position");
        env.num_hand_dofs.named = self.named.contains("env.num_hand_dofs");
        env.num_actuators.named = self.named.contains("env.num_actuators");
        self.problems.extend(violations(&config));
        if self.problems.is_empty() {
            return Ok(config);
        }
        bail!(
            "invalid configuration{origin}:\n  {}",
            self.problems.join("\n  ")
        )
    }
}

impl Default for Config {
    /// The base.
    fn default() -> Self {
        Settings::new().resolve().expect("the defaults are valid")
    }
}

impl Config {
    /// The whole configuration as TOML.
    ///
    /// # Panics
    /// Never panics: a configuration is a tree of tables.
    pub fn to_text(&self) -> String {
        let sections = Table::try_from(self).expect("a configuration is a tree of tables");
        let mut text = String::new();
        for (section, keys) in &sections {
            text += &format!("[{section}]\n");
            for (key, value) in keys.as_table().into_iter().flatten() {
                text += &format!("{key} = {value}\n");
            }
            text.push('\n');
        }
        text
    }
}

impl Source {
    /// This text, from the file `path`.
    pub fn new(path: impl Into<PathBuf>, text: impl Into<String>) -> Self {
        Self {
            path: path.into(),
            text: text.into(),
        }
    }

    /// The configuration that it makes over the base.
    ///
    /// # Errors
    /// Fails as [`Settings::resolve`] does.
    pub fn resolve(self) -> Result<Config> {
        Settings::new().file(self).resolve()
    }

    /// Its settings. The base itself counts as setting nothing.
    fn table(&self) -> Result<Table> {
        if self.text == BASE {
            return Ok(Table::new());
        }
        self.text.parse().map_err(|error: toml::de::Error| {
            let lines: Vec<String> = error.to_string().lines().map(os::shortened).collect();
            anyhow!(
                "{}: not a TOML file: {}",
                self.path.display(),
                lines.join("\n")
            )
        })
    }
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
        Settings::new()
            .sets(&overrides)
            .resolve()
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn the_base_is_valid_and_survives_being_written_and_read() {
        let config = Config::default();
        assert_eq!(config.env.max_episode_steps(), 1000);
        assert_eq!(config.env.substeps(), 1);
        assert_eq!(
            Settings::new()
                .file(file(&config.to_text()))
                .resolve()
                .unwrap(),
            config
        );
    }

    fn file(text: &str) -> Source {
        Source::new("x.toml", text)
    }

    #[test]
    fn a_fork_keeps_its_shards_if_they_fit_and_takes_no_scene_from_its_parent() {
        let stored = file("[env]\nmodel = \"/its own.xml\"\n[run]\nshards = 4");
        let fork = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            let config = Settings::new()
                .stored(stored.clone(), Reader::Run)
                .sets(&sets)
                .resolve();
            config
                .map(|config| (config.env.model, config.run.shards))
                .map_err(|error| error.to_string())
        };
        let refused = fork(&[]).unwrap_err();
        assert!(
            refused.ends_with("set \'env.model=/its own.xml\' to use that scene"),
            "{refused}"
        );
        assert_eq!(fork(&["env.model=builtin"]), Ok(("builtin".into(), 4)));
        assert_eq!(
            fork(&["env.model=x.xml", "ppo.minibatches=8192"]),
            Ok(("x.xml".into(), 0))
        );
        assert_eq!(
            fork(&["env.model=x.xml", "run.shards=2"]),
            Ok(("x.xml".into(), 2))
        );
    }

    #[test]
    fn a_relative_scene_counts_from_the_folder_of_the_file_that_names_it() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.toml");
        let model = |text: &str, sets: &[&str]| {
            os::write_whole(&path, text.as_bytes()).unwrap();
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            let settings = Settings::new().user_file(Some(&path)).unwrap().sets(&sets);
            settings.resolve().unwrap().env.model
        };
        let named = |model: &str| format!("[env]\nmodel = \"{model}\"\n");
        let here = place.path().join("own/s.xml").display().to_string();
        assert_eq!(model(&named("own/s.xml"), &[]), here);
        assert_eq!(model(&named(&here), &[]), here);
        assert_eq!(model(&named("/a/s.xml"), &[]), "/a/s.xml");
        assert_eq!(model(&named("builtin"), &[]), "builtin");
        assert_eq!(model(&named("own/s.xml"), &["env.model=s.xml"]), "s.xml");
        assert_eq!(model("", &["env={model=\"s.xml\"}"]), "s.xml");
    }

    #[test]
    fn a_scene_that_a_table_of_a_section_names_is_another_scene() {
        let place = tempfile::tempdir().unwrap();
        let [own, other] =
            ["own.xml", "other.xml"].map(|name| place.path().canonicalize().unwrap().join(name));
        for path in [&own, &other] {
            os::write_whole(path, b"").unwrap();
        }
        let text = format!(
            "[env]\nmodel = \"{}\"\ngoal_position = [1, 2, 3]",
            own.display()
        );
        for (scene, is_kept) in [(&own, true), (&other, false)] {
            for form in ["env.model=PATH", "env={model=\"PATH\"}"] {
                let sets = [set(&form.replace("PATH", &scene.display().to_string()))];
                let player = Reader::Player { env_steps: 0 };
                let config = Settings::new()
                    .stored(file(&text), player)
                    .sets(&sets)
                    .resolve()
                    .unwrap();
                assert_eq!(config.env.goal_position.named, is_kept, "{form}");
            }
        }
    }

    #[test]
    fn a_place_in_the_built_in_scene_is_no_place_in_another_one() {
        let stored = "[env]\ngoal_position = [1, 2, 3]";
        for (model, is_kept) in [("builtin", true), ("own.xml", false)] {
            let player = Reader::Player { env_steps: 0 };
            let config = Settings::new()
                .stored(file(stored), player)
                .sets(&[set(&format!("env.model={model}"))])
                .resolve()
                .unwrap();
            assert_eq!(config.env.goal_position.named, is_kept, "{model}");
        }
    }

    #[test]
    fn a_file_may_set_part_of_a_ramp() {
        let text = "[training]\ntolerance = { steps = 50_000_000 }\n";
        let config = Settings::new().file(file(text)).resolve().unwrap();
        assert_eq!(
            config.training.tolerance.0,
            Ramp {
                from: 0.4,
                to: 0.07,
                steps: 50_000_000,
                after: 0
            }
        );
    }

    #[test]
    fn a_ramp_can_be_set_whole_in_part_or_as_a_constant() {
        let tolerance = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            Settings::new()
                .sets(&sets)
                .resolve()
                .unwrap()
                .training
                .tolerance
                .0
        };
        let default = Ramp {
            from: 0.4,
            to: 0.07,
            steps: 20_000_000,
            after: 0,
        };
        assert_eq!(tolerance(&[]), default);
        assert_eq!(
            tolerance(&["training.tolerance=0.07"]),
            Ramp::constant(0.07)
        );
        assert_eq!(
            tolerance(&["training.tolerance.to=0.05"]),
            Ramp {
                to: 0.05,
                ..default
            }
        );
        assert_eq!(
            tolerance(&["training.tolerance.steps=1e6"]),
            Ramp {
                steps: 1_000_000,
                ..default
            }
        );
        let whole = tolerance(&["training.tolerance={from=0.3,to=0.06,steps=30000000}"]);
        assert_eq!(
            whole,
            Ramp {
                from: 0.3,
                to: 0.06,
                steps: 30_000_000,
                after: 0
            }
        );
        assert_eq!(
            tolerance(&["training.tolerance={to=0.06}"]),
            Ramp {
                to: 0.06,
                ..default
            }
        );
        // Part of a ramp that was set to a constant before.
        let both = tolerance(&["training.tolerance=1", "training.tolerance.to=0.5"]);
        assert_eq!(
            both,
            Ramp {
                from: 1.0,
                to: 0.5,
                steps: 0,
                after: 0
            }
        );
        // A ramp may begin later, whether its default does or not.
        assert_eq!(
            tolerance(&["training.tolerance.after=1e6"]),
            Ramp {
                after: 1_000_000,
                ..default
            }
        );
        let share = |sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            Settings::new()
                .sets(&sets)
                .resolve()
                .unwrap()
                .randomization
                .share
        };
        let later = Ramp {
            from: 0.0,
            to: 0.5,
            steps: 20_000_000,
            after: 40_000_000,
        };
        assert_eq!(share(&[]), later);
        assert_eq!(
            share(&["randomization.share.to=0.7"]),
            Ramp { to: 0.7, ..later }
        );
        assert_eq!(
            share(&["randomization.share=0.7"]),
            Ramp::constant(0.7),
            "from the first step on"
        );
    }

    #[test]
    fn a_table_by_group_is_set_whole_or_one_group_at_a_time() {
        let noise = |text: &str, sets: &[&str]| {
            let sets: Vec<Override> = sets.iter().map(|text| set(text)).collect();
            let noise = Settings::new()
                .file(file(text))
                .sets(&sets)
                .resolve()
                .unwrap()
                .env
                .noise;
            noise
                .into_iter()
                .map(|(group, std)| format!("{group} {std}"))
                .collect::<Vec<_>>()
                .join(", ")
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
        let none = file("[env]\nnoise = {}");
        let fork = Settings::new()
            .stored(file(both), Reader::Run)
            .file(none)
            .resolve()
            .unwrap();
        assert!(fork.env.noise.is_empty());
    }

    #[test]
    fn what_is_wrong_with_a_ramp_is_said_by_name() {
        for (bad, part) in [
            (
                "training.tolerance=0",
                "training.tolerance = 0: must be above 0",
            ),
            (
                "training.tolerance.from=-1",
                "training.tolerance.from = -1: must be above 0",
            ),
            (
                "training.tolerance=wide",
                "training.tolerance = \"wide\": must be a number, or { from = …",
            ),
            (
                "training.tolerance=nan",
                "training.tolerance.from = nan: must be a finite number",
            ),
            (
                "training.tolerance.form=1",
                "training.tolerance.form: unknown key",
            ),
            (
                "training.tolerance.steps=-1",
                "training.tolerance.steps = -1: must be a whole number",
            ),
            (
                "training.hold.to=0.4",
                "training.hold.to = 0.4: must be at least 1",
            ),
            ("ppo.std.to=0", "ppo.std.to = 0: must be above 0"),
            (
                "ppo.desired_kl.to=0",
                "must be above 0 at both ends, or 0 throughout",
            ),
        ] {
            let text = errors(&[bad]);
            assert!(text.contains(part), "{bad}: {part} is not in\n{text}");
        }
    }

    #[test]
    fn of_the_settings_in_a_policys_file_only_those_of_playing_are_read() {
        let trained = "[env]\nnum_envs = 0\nrot_eps = 0.2\n[ppo]\nhidden = [9]\ngamma = \"much\"\nnot_yet = 1\n\
                       [training]\ngoal_reward = 3\n[of_tomorrow]\nx = 1\n[run]\nseed = -1";
        let policy = |text: &str, sets: &[Override]| {
            Settings::new()
                .stored(file(text), Reader::Player { env_steps: 0 })
                .sets(sets)
                .resolve()
        };
        let found = policy(trained, &[set("env.sim_dt=0.005")]).unwrap();
        assert_eq!(
            (found.env.rot_eps, found.env.sim_dt, found.ppo.hidden),
            (0.2, 0.005, vec![9])
        );
        let whole = Config::default();
        let played = policy(&whole.to_text(), &[]).unwrap();
        assert_eq!(
            played,
            Config {
                env: whole.env.at(0),
                ..whole
            }
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
        let source = Source::new(
            "my.toml",
            "[ppo]\ngamma = 0.98\nhidden = [32]\n[env]\nnum_envs = 8",
        );
        let sets = [
            set("ppo.gamma=0.97"),
            set("ppo.activation=tanh"),
            set("run.total_steps=1e6"),
        ];
        let config = Settings::new().file(source).sets(&sets).resolve().unwrap();
        assert_eq!((config.ppo.gamma, config.env.num_envs), (0.97, 8));
        assert_eq!(
            (config.ppo.hidden, config.ppo.activation),
            (vec![32], Activation::Tanh)
        );
        assert_eq!(
            (config.run.total_steps, config.ppo.lambda),
            (1_000_000, 0.95)
        );
    }

    #[test]
    fn all_violations_are_named_together_with_the_rule() {
        let text = errors(&[
            "ppo.minibatches=7",
            "env.rot_eps=0",
            "ppo.gama=1",
            "env.sim_dt=fast",
            "ppo.clip=-1",
        ]);
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
    fn a_wrong_option_is_not_blamed_on_the_file_alone() {
        let message = |text: &str, sets: &[Override]| {
            let settings = Settings::new().file(file(text)).sets(sets);
            settings.resolve().unwrap_err().to_string()
        };
        let wrong = set("env.rot_eps=0");
        let alone = message("[env]\nrot_eps = 0", &[]);
        assert!(alone.starts_with("invalid configuration (x.toml):"));
        let over = message("", &[wrong]);
        assert!(over.starts_with("invalid configuration (x.toml and options):"));
    }

    #[test]
    fn the_control_step_must_be_a_whole_multiple_of_the_physics_step() {
        let text = errors(&["env.sim_dt=0.003"]);
        assert!(
            text.contains("env.ctrl_dt = 0.01: must be a whole multiple of env.sim_dt = 0.003"),
            "{text}"
        );
        let config = Settings::new()
            .sets(&[set("env.sim_dt=0.002")])
            .resolve()
            .unwrap();
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
            (
                "ppo.away_range=[0.5,0.5]",
                "must be [near, far] with 0 <= near < far",
            ),
            ("env.goal_position=[1,2]", "goal_position"),
            ("nonsense=1", "nonsense: unknown key"),
            (
                "training.tolerance.step=5",
                "did you mean training.tolerance.steps?",
            ),
            ("ppo.lr=1", "did you mean ppo.learning_rate?"),
            ("ppo.qqq=1", "configs/repose.toml lists all of them"),
            ("env.cube_size=1", "did you mean env.cube_size_scale?"),
            (
                "randomization.mass=1",
                "did you mean randomization.cube_mass?",
            ),
            ("learning_rate=1", "did you mean ppo.learning_rate?"),
            (
                "env.quixotic=1",
                "env.quixotic: unknown key; configs/repose.toml",
            ),
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
