//! Every setting of the program: its type, where its value comes from, and which values are allowed.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, a user's file and `--set` lie on top, all merged as
//! tables before typing, so that each source meets the same checks. Nothing here reads files or knows who uses a setting.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

/// The default configuration, commented.
pub const BASE: &str = include_str!("../configs/repose.toml");

/// `env.model` of the scene that is built into the program.
pub const BUILTIN_MODEL: &str = "builtin";

/// The whole configuration of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The task and its physics.
    pub env: EnvConfig,
    /// The learner.
    pub ppo: PpoConfig,
    /// The course of a training.
    pub run: RunConfig,
}

/// The task; `configs/repose.toml` says what each key means and in which unit.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvConfig {
    pub num_envs: usize,
    pub model: String,
    pub num_hand_dofs: usize,
    pub num_actuators: usize,
    pub sim_dt: f64,
    pub ctrl_dt: f64,
    pub max_episode_seconds: f64,
    pub goal_position: [f64; 3],
    pub target_height: f64,
    pub act_moving_average: f64,
    pub rot_reward_scale: f64,
    pub rot_eps: f64,
    pub dist_reward_scale: f64,
    pub action_penalty_scale: f64,
    pub reach_goal_bonus: f64,
    pub success_tolerance: f64,
    pub max_consecutive_successes: u32,
    pub success_hold: SuccessHold,
    pub fall_dist: f64,
    pub fall_penalty: f64,
    pub reset_position_noise: f64,
    pub reset_dof_pos_noise: f64,
    pub reset_dof_vel_noise: f64,
    pub vel_obs_scale: f64,
}

/// What a step outside the tolerance does to the counter of steps within it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SuccessHold {
    /// It leaves the counter alone.
    Cumulative,
    /// It sets the counter to zero.
    Consecutive,
}

/// The learner; `configs/repose.toml` says what each key means.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PpoConfig {
    pub horizon: usize,
    pub epochs: usize,
    pub minibatches: usize,
    pub hidden: Vec<usize>,
    pub activation: Activation,
    pub learning_rate: f64,
    pub learning_rate_range: [f64; 2],
    pub desired_kl: f64,
    pub gamma: f64,
    pub lambda: f64,
    pub clip: f64,
    pub value_coef: f64,
    pub entropy_coef: f64,
    pub max_grad_norm: f64,
    pub reward_scale: f64,
    pub init_std: f64,
}

/// The function after each hidden layer.
#[allow(missing_docs)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    Elu,
    Relu,
    Silu,
    Tanh,
}

/// The course of a training; `configs/repose.toml` says what each key means.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    pub total_steps: u64,
    pub checkpoint_every: u64,
    pub eval_every: u64,
    pub eval_episodes: usize,
    pub seed: u64,
    pub threads: usize,
}

impl EnvConfig {
    /// Physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.ctrl_dt / self.sim_dt).round() as usize
    }

    /// Control steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> u32 {
        (self.max_episode_seconds / self.ctrl_dt).round() as u32
    }

    /// The user's own scene, or `None` for the built-in one.
    pub fn model_file(&self) -> Option<&Path> {
        (self.model != BUILTIN_MODEL).then(|| Path::new(&self.model))
    }
}

/// One `--set key=value`.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// The dotted key, as `ppo.learning_rate`.
    pub key: String,
    /// The text behind the equals sign.
    pub value: String,
}

impl std::str::FromStr for Override {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((key, value)) if !key.trim().is_empty() => {
                Ok(Self { key: key.trim().into(), value: value.trim().into() })
            }
            _ => Err(format!("`{text}` is not of the form key=value, as in ppo.learning_rate=1e-4")),
        }
    }
}

/// A configuration text and the name to use for it in messages.
pub struct Source {
    /// The file it came from.
    pub path: PathBuf,
    /// Its content.
    pub text: String,
}

impl Config {
    /// The base, overlaid by the user's file and then by `overrides`.
    ///
    /// # Errors
    /// One error that lists every unknown key, every value of a wrong type and every value out of range.
    pub fn resolve(user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        let base: Table = BASE.parse().expect("the built-in configuration is TOML");
        let mut merged = base.clone();
        let mut problems = Vec::new();
        if let Some(Source { path, text }) = user {
            match text.parse::<Table>() {
                Ok(table) => overlay(&mut merged, &table, &base, "", &mut problems),
                Err(error) => bail!("{}: not a TOML file: {error}", path.display()),
            }
        }
        for set in overrides {
            overlay(&mut merged, &set.as_table(&base), &base, "", &mut problems);
        }
        match Self::deserialize(Value::Table(merged)) {
            Ok(config) => {
                problems.extend(config.violations());
                if problems.is_empty() {
                    return Ok(config);
                }
            }
            Err(error) => problems.push(error.to_string().trim().replace('\n', " ")),
        }
        let origin = user.map_or(String::new(), |s| format!(" ({})", s.path.display()));
        bail!("invalid configuration{origin}:\n  {}", problems.join("\n  "))
    }

    /// A configuration that a run has written whole.
    ///
    /// # Errors
    /// As [`Config::resolve`].
    pub fn from_text(path: &Path, text: &str, overrides: &[Override]) -> Result<Self> {
        let source = Source { path: path.into(), text: text.into() };
        Self::resolve(Some(&source), overrides)
    }

    /// The whole configuration as TOML.
    pub fn to_text(&self) -> String {
        toml::to_string(self).expect("a configuration is a tree of tables")
    }

    /// Control steps in one iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.env.num_envs * self.ppo.horizon) as u64
    }

    /// Every rule that the values break, as "key = value: must …".
    fn violations(&self) -> Vec<String> {
        let Self { env, ppo, run } = self;
        let mut rules = Rules::default();
        rules.at_least("env.num_envs", env.num_envs, 1);
        rules.at_most("env.num_envs", env.num_envs, 1 << 20);
        rules.check(!env.model.is_empty(), "env.model", &env.model, "be a path or \"builtin\"");
        rules.equal("env.num_hand_dofs", env.num_hand_dofs, 24);
        rules.equal("env.num_actuators", env.num_actuators, 20);
        rules.positive("env.sim_dt", env.sim_dt);
        rules.positive("env.ctrl_dt", env.ctrl_dt);
        let ratio = env.ctrl_dt / env.sim_dt;
        rules.check(
            !(ratio.is_finite() && ratio > 0.0) || (ratio.round() >= 1.0 && (ratio / ratio.round() - 1.0).abs() < 1e-6),
            "env.ctrl_dt",
            env.ctrl_dt,
            &format!("be a whole multiple of env.sim_dt = {}", env.sim_dt),
        );
        rules.check(
            (1.0..=1e9).contains(&(env.max_episode_seconds / env.ctrl_dt).round()),
            "env.max_episode_seconds",
            env.max_episode_seconds,
            "last between one and 1e9 steps of env.ctrl_dt",
        );
        rules.between("env.act_moving_average", env.act_moving_average, 0.0, 1.0);
        rules.check(
            env.act_moving_average != 0.0,
            "env.act_moving_average",
            env.act_moving_average,
            "be above 0 (at 0 no action would have an effect)",
        );
        rules.positive("env.rot_eps", env.rot_eps);
        rules.positive("env.success_tolerance", env.success_tolerance);
        rules.at_least("env.max_consecutive_successes", env.max_consecutive_successes as usize, 1);
        rules.positive("env.fall_dist", env.fall_dist);
        rules.not_negative("env.reset_position_noise", env.reset_position_noise);
        rules.not_negative("env.reset_dof_pos_noise", env.reset_dof_pos_noise);
        rules.not_negative("env.reset_dof_vel_noise", env.reset_dof_vel_noise);

        rules.at_least("ppo.horizon", ppo.horizon, 1);
        rules.at_least("ppo.epochs", ppo.epochs, 1);
        let samples = env.num_envs.saturating_mul(ppo.horizon);
        rules.check(
            ppo.minibatches >= 1 && samples.is_multiple_of(ppo.minibatches),
            "ppo.minibatches",
            ppo.minibatches,
            &format!("divide num_envs * horizon = {samples}"),
        );
        rules.check(
            samples < 2 || samples / ppo.minibatches.max(1) >= 2,
            "ppo.minibatches",
            ppo.minibatches,
            "leave at least two samples in a minibatch",
        );
        let sizes_fit = !ppo.hidden.is_empty() && ppo.hidden.iter().all(|h| (1..=16384).contains(h));
        let hidden = format!("{:?}", ppo.hidden);
        rules.check(sizes_fit, "ppo.hidden", hidden, "hold one or more sizes from 1 to 16384");
        rules.positive("ppo.learning_rate", ppo.learning_rate);
        let [low, high] = ppo.learning_rate_range;
        let range = format!("[{low}, {high}]");
        rules.check(0.0 < low && low <= high, "ppo.learning_rate_range", range, "rise from above 0");
        rules.not_negative("ppo.desired_kl", ppo.desired_kl);
        rules.between("ppo.gamma", ppo.gamma, 0.0, 1.0);
        rules.between("ppo.lambda", ppo.lambda, 0.0, 1.0);
        rules.positive("ppo.clip", ppo.clip);
        rules.not_negative("ppo.value_coef", ppo.value_coef);
        rules.not_negative("ppo.entropy_coef", ppo.entropy_coef);
        rules.positive("ppo.max_grad_norm", ppo.max_grad_norm);
        rules.positive("ppo.reward_scale", ppo.reward_scale);
        rules.positive("ppo.init_std", ppo.init_std);

        rules.at_least("run.total_steps", run.total_steps as usize, 1);
        rules.at_least("run.checkpoint_every", run.checkpoint_every as usize, 1);
        rules.at_least("run.eval_every", run.eval_every as usize, 1);
        rules.at_least("run.eval_episodes", run.eval_episodes, 1);
        rules.at_most("run.eval_episodes", run.eval_episodes, 1 << 20);
        rules.at_most("run.threads", run.threads, 4096);
        rules.broken
    }
}

impl Override {
    /// The table with this one value; text that is no TOML value, and any text for a string key, is taken as a string.
    fn as_table(&self, base: &Table) -> Table {
        let parsed = format!("value = {}", self.value).parse::<Table>();
        let parsed = parsed.ok().filter(|t| t.len() == 1).and_then(|mut t| t.remove("value"));
        let wants_text = lookup(base, &self.key).is_some_and(Value::is_str);
        let mut value = match parsed {
            Some(value) if !wants_text || value.is_str() => value,
            _ => Value::String(self.value.clone()),
        };
        for part in self.key.rsplit('.') {
            value = Value::Table(Table::from_iter([(part.to_owned(), value)]));
        }
        match value {
            Value::Table(table) => table,
            _ => unreachable!("a key has at least one part"),
        }
    }
}

fn lookup<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let (first, rest) = key.split_once('.').unwrap_or((key, ""));
    match (table.get(first)?, rest) {
        (value, "") => Some(value),
        (Value::Table(inner), rest) => lookup(inner, rest),
        _ => None,
    }
}

/// Lays `table` over `merged`, whose keys and types are those of `base`; what does not fit is left out and reported.
fn overlay(merged: &mut Table, table: &Table, base: &Table, prefix: &str, problems: &mut Vec<String>) {
    for (key, value) in table {
        let name = format!("{prefix}{key}");
        match (base.get(key), value) {
            (None, _) => problems.push(unknown(&name)),
            (Some(Value::Table(expected)), Value::Table(inner)) => {
                let Some(Value::Table(target)) = merged.get_mut(key) else {
                    unreachable!("the merged tables are those of the base")
                };
                overlay(target, inner, expected, &format!("{name}."), problems);
            }
            (Some(expected), value) => match typed(expected, value) {
                Ok(value) => drop(merged.insert(key.clone(), value)),
                Err(rule) => problems.push(format!("{name} = {value}: must be {rule}")),
            },
        }
    }
}

/// `value` as the type that the base has, or what that type is called.
fn typed(expected: &Value, value: &Value) -> Result<Value, String> {
    match (expected, value) {
        (Value::Float(_), Value::Float(x)) if !x.is_finite() => Err("a finite number".into()),
        (Value::Float(_), Value::Float(_)) | (Value::String(_), Value::String(_)) => Ok(value.clone()),
        (Value::Float(_), Value::Integer(i)) => Ok(Value::Float(*i as f64)),
        (Value::Integer(_), Value::Integer(i)) if *i >= 0 => Ok(value.clone()),
        // 1e8 is how people write a large number of steps.
        (Value::Integer(_), Value::Float(x)) if x.fract() == 0.0 && (0.0..9e15).contains(x) => {
            Ok(Value::Integer(*x as i64))
        }
        (Value::Array(expected), Value::Array(values)) => {
            let typed: Result<Vec<_>, _> = values.iter().map(|v| typed(&expected[0], v)).collect();
            typed.map(Value::Array).map_err(|rule| format!("an array, each of it {rule}"))
        }
        (Value::Float(_), _) => Err("a number".into()),
        (Value::Integer(_), _) => Err("a whole number, not negative".into()),
        (Value::String(_), _) => Err("a string".into()),
        (Value::Array(_), _) => Err("an array".into()),
        (Value::Table(_), _) => Err("a section with keys".into()),
        _ => Err("of another type".into()),
    }
}

fn unknown(name: &str) -> String {
    let base: Table = BASE.parse().expect("the built-in configuration is TOML");
    let mut known = Vec::new();
    for (section, keys) in &base {
        known.push(section.clone());
        if let Value::Table(keys) = keys {
            known.extend(keys.keys().map(|key| format!("{section}.{key}")));
        }
    }
    let distance = |candidate: &String| {
        let whole = strsim::damerau_levenshtein(name, candidate);
        let last = |s: &str| s.rsplit('.').next().unwrap_or_default().to_owned();
        // The right key in the wrong section is as near as one wrong letter.
        whole.min(1 + strsim::damerau_levenshtein(&last(name), &last(candidate)))
    };
    let nearest = known.iter().min_by_key(|candidate| distance(candidate));
    match nearest {
        Some(nearest) if distance(nearest) <= 2 + name.len() / 4 => {
            format!("{name}: unknown key; did you mean {nearest}?")
        }
        _ => format!("{name}: unknown key; configs/repose.toml lists all of them"),
    }
}

/// Collects the rules that were broken.
#[derive(Default)]
struct Rules {
    broken: Vec<String>,
}

impl Rules {
    fn check(&mut self, holds: bool, key: &str, value: impl std::fmt::Display, rule: &str) {
        if !holds {
            self.broken.push(format!("{key} = {value}: must {rule}"));
        }
    }

    fn at_least(&mut self, key: &str, value: usize, least: usize) {
        self.check(value >= least, key, value, &format!("be at least {least}"));
    }

    fn at_most(&mut self, key: &str, value: usize, most: usize) {
        self.check(value <= most, key, value, &format!("be at most {most}"));
    }

    fn equal(&mut self, key: &str, value: usize, only: usize) {
        self.check(value == only, key, value, &format!("be {only}, the task is laid out for it"));
    }

    fn positive(&mut self, key: &str, value: f64) {
        self.check(value > 0.0, key, value, "be above 0");
    }

    fn not_negative(&mut self, key: &str, value: f64) {
        self.check(value >= 0.0, key, value, "not be negative");
    }

    fn between(&mut self, key: &str, value: f64, low: f64, high: f64) {
        self.check((low..=high).contains(&value), key, value, &format!("lie in [{low}, {high}]"));
    }
}

#[cfg(test)]
mod tests {
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
            ("ppo.hidden=[]", "must hold one or more sizes"),
            ("ppo=3", "must be a section with keys"),
            ("ppo.activation=gelu", "gelu"),
            ("env.goal_position=[1,2]", "goal_position"),
            ("nonsense=1", "nonsense: unknown key"),
            ("learning_rate=1", "did you mean ppo.learning_rate?"),
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
