//! Every setting of the program: its type, where its value comes from, and which values are allowed.
//!
//! No default is written in Rust: `configs/repose.toml` is the base, a user's file and `--set` lie on top, all merged as
//! tables before typing, so that each source meets the same checks. Nothing here reads files or knows who uses a setting.

mod overlay;
mod rules;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use overlay::overlay;

/// The default configuration, commented.
pub const BASE: &str = include_str!("../../configs/repose.toml");

/// What a run did that was begun before a setting existed, also where that is the default of today.
const BEFORE: &str = include_str!("before.toml");

/// `env.model` of the scene that is built into the program.
pub const BUILTIN_MODEL: &str = "builtin";

/// The whole configuration of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The task and its physics.
    pub env: EnvConfig,
    /// What training changes of the task and adds to its reward.
    pub training: TrainingConfig,
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
    pub friction_scale: f64,
    pub cube_mass_scale: f64,
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

/// What only training sees; `configs/repose.toml` says what each key means and in which unit.
#[allow(missing_docs)]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    pub task_reward: f64,
    pub task_reward_start: f64,
    pub task_reward_steps: u64,
    pub progress_reward: f64,
    pub hold_reward: f64,
    pub goal_reward: f64,
    pub drop_reward: f64,
    pub drop_reward_start: f64,
    pub drop_reward_steps: u64,
    pub tolerance_scale: f64,
    pub tolerance_start: f64,
    pub tolerance_steps: u64,
    pub hold_scale: f64,
    pub hold_start: u32,
    pub hold_steps: u64,
    pub goal_angle_start: f64,
    pub goal_angle_steps: u64,
    pub goal_lifetime: u64,
    pub episode_seconds: f64,
    pub bootstrap_reached: bool,
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
    pub symmetry: Symmetry,
    pub backend: Backend,
    pub precision: Precision,
    pub learning_rate: f64,
    pub learning_rate_range: [f64; 2],
    pub desired_kl: f64,
    pub critic_learning_rate: f64,
    pub gamma: f64,
    pub lambda: f64,
    pub clip: f64,
    pub value_clip: f64,
    pub value_coef: f64,
    pub entropy_coef: f64,
    pub bounds_coef: f64,
    pub max_grad_norm: f64,
    pub reward_scale: f64,
    pub init_std: f64,
    pub max_std: f64,
    pub max_std_steps: u64,
    pub min_std: f64,
    pub away_std: f64,
    pub away_range: [f64; 2],
    pub exploring_share: f64,
    pub exploring_scale: f64,
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

/// What a policy takes to be the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Symmetry {
    /// Nothing.
    None,
    /// A cube and the same cube turned onto itself.
    Cube,
}

/// What computes the nets, their gradients and the steps of the optimizer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Our own kernels.
    Fused,
    /// candle's tensors and automatic gradients: slower, the reference for the other.
    Candle,
}

/// The numbers that are multiplied in the nets while learning and collecting; all else is in floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Floats.
    F32,
    /// bf16, with sums in floats, on the tiles of processors that have them.
    Bf16,
    /// The rounding of bf16 without its speed, on any processor.
    Bf16Rounded,
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

impl PpoConfig {
    /// How far a value may move from the one that was there when the rollout was collected.
    pub fn value_clip(&self) -> f64 {
        if self.value_clip == 0.0 { self.clip } else { self.value_clip }
    }

    /// The least and the largest standard deviation of the actions after `env_steps` control steps of the whole run.
    pub fn std_bounds(&self, env_steps: u64) -> [f64; 2] {
        let share = share(env_steps, self.max_std_steps);
        let falling = self.init_std.powf(1.0 - share) * self.max_std.powf(share);
        [self.min_std, if self.max_std_steps > 0 { falling } else { f64::INFINITY }]
    }
}

/// How much of a schedule of so many steps is behind us, from 0 to 1; one that lasts no steps is over.
pub fn share(env_steps: u64, steps: u64) -> f64 {
    if steps == 0 { 1.0 } else { (env_steps as f64 / steps as f64).min(1.0) }
}

impl EnvConfig {
    /// Physics steps in one control step.
    pub fn substeps(&self) -> usize {
        (self.ctrl_dt / self.sim_dt).round() as usize
    }

    /// Control steps after which an episode is truncated.
    pub fn max_episode_steps(&self) -> u32 {
        self.control_steps(self.max_episode_seconds)
    }

    /// So many seconds in control steps.
    pub fn control_steps(&self, seconds: f64) -> u32 {
        (seconds / self.ctrl_dt).round() as u32
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
        Self::layered("", user, overrides)
    }

    /// The base, overlaid by some settings of ours, the user's file, and `overrides`.
    fn layered(ours: &str, user: Option<&Source>, overrides: &[Override]) -> Result<Self> {
        let [base, ours]: [Table; 2] = [BASE, ours].map(|text| text.parse().expect("our own settings are TOML"));
        let mut merged = base.clone();
        let mut problems = Vec::new();
        overlay(&mut merged, &ours, &base, "", &mut problems);
        if let Some(Source { path, text }) = user {
            match text.parse::<Table>() {
                Ok(table) => overlay(&mut merged, &table, &base, "", &mut problems),
                Err(error) => bail!("{}: not a TOML file: {error}", path.display()),
            }
        }
        for set in overrides {
            overlay(&mut merged, &set.as_table(&base), &base, "", &mut problems);
        }
        // Words and sizes that no key of that type can have; with the default in their place the other rules can be checked.
        for (section, keys) in &base {
            for (key, default) in keys.as_table().into_iter().flatten() {
                let mut alone = base.clone();
                alone[section][key] = merged[section][key].clone();
                if let Err(error) = Self::deserialize(Value::Table(alone)) {
                    let reason = error.message().trim();
                    problems.push(format!("{section}.{key} = {}: {reason}", merged[section][key]));
                    merged[section][key] = default.clone();
                }
            }
        }
        let config = Self::deserialize(Value::Table(merged))?;
        problems.extend(config.violations());
        if problems.is_empty() {
            return Ok(config);
        }
        let origin = user.map_or(String::new(), |s| format!(" ({})", s.path.display()));
        bail!("invalid configuration{origin}:\n  {}", problems.join("\n  "))
    }

    /// A configuration that a run has written whole, maybe before some of today's settings existed.
    ///
    /// # Errors
    /// As [`Config::resolve`].
    pub fn from_text(path: &Path, text: &str, overrides: &[Override]) -> Result<Self> {
        let source = Source { path: path.into(), text: text.into() };
        Self::layered(BEFORE, Some(&source), overrides)
    }

    /// The whole configuration as TOML.
    pub fn to_text(&self) -> String {
        toml::to_string(self).expect("a configuration is a tree of tables")
    }

    /// Control steps in one iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.env.num_envs * self.ppo.horizon) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::Lesson;

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
    fn a_run_from_before_a_setting_existed_goes_on_as_it_was() {
        let config = Config::from_text(Path::new("config.toml"), "[ppo]\ngamma = 0.5", &[]).unwrap();
        assert_eq!((config.ppo.symmetry, config.ppo.gamma), (Symmetry::None, 0.5));
        // What was trained then is the task itself.
        assert_eq!(Lesson::at(0, &config.training, &config.env), Lesson::task(&config.env));
        assert_eq!((config.ppo.bounds_coef, config.ppo.std_bounds(0)), (0.0, [0.0, f64::INFINITY]));
        // A user's own file means today's defaults where it is silent.
        let source = Source { path: "my.toml".into(), text: "[ppo]\ngamma = 0.5".into() };
        assert_eq!(Config::resolve(Some(&source), &[]).unwrap().ppo.symmetry, Symmetry::Cube);
    }

    #[test]
    fn the_other_files_that_come_with_the_program_are_valid() {
        let large = include_str!("../../configs/repose-large.toml");
        let going_on = include_str!("../../configs/repose-continue.toml");
        let [large, going_on] = [large, going_on].map(|text| {
            let source = Source { path: "file.toml".into(), text: text.into() };
            Config::resolve(Some(&source), &[]).unwrap()
        });
        assert_eq!((large.env.num_envs, large.ppo.hidden), (8192, vec![512, 512, 256, 128]));
        assert_eq!(going_on.training.goal_lifetime, 300);
        let Lesson { tolerance, hold, .. } = Lesson::at(0, &going_on.training, &going_on.env);
        assert!((tolerance - 0.07).abs() < 1e-9 && hold == 50, "{tolerance} {hold}");
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
            ("training.bootstrap_reached=1", "must be true or false"),
            ("ppo.away_range=[0.5,0.5]", "must rise from 0 or more"),
            ("env.goal_position=[1,2]", "goal_position"),
            ("nonsense=1", "nonsense: unknown key"),
            ("learning_rate=1", "did you mean ppo.learning_rate?"),
            ("env.act_moving_average=0", "must be above 0"),
            ("env.num_hand_dofs=23", "must be 24, the task is laid out for it"),
            ("env.num_actuators=24", "must be 20, the task is laid out for it"),
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
