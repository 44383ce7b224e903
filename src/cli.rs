//! The command line: its shape and its help, no logic.

use std::path::PathBuf;

use clap::builder::RangedU64ValueParser;
use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::config::Override;

/// The largest whole number of a TOML file.
const LARGEST: u64 = i64::MAX as u64;

/// Accepts a number of threads, within the rule of `run.threads`.
fn threads() -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(0..=4096)
}

/// Trains a simulated Shadow Hand to turn a cube in its palm to any asked orientation, on a CPU.
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train a policy; Ctrl-C saves and stops
    Train(TrainArgs),
    /// Let a policy play whole episodes and print its score
    Play(PlayArgs),
    /// Measure this machine: physics, environments, learner, and all together
    Bench(BenchArgs),
}

/// Settings as every command takes them.
#[derive(Args, Debug, Default)]
pub struct Settings {
    /// Settings that differ from the defaults (TOML)
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One setting, as ppo.learning_rate=1e-4; may be repeated and wins over the file
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<Override>,
}

/// `train`
#[derive(Args, Debug, Default)]
pub struct TrainArgs {
    /// File and single settings.
    #[command(flatten)]
    pub settings: Settings,
    /// All randomness follows from it [default: run.seed]
    #[arg(long, value_parser = clap::value_parser!(u64).range(..=LARGEST))]
    pub seed: Option<u64>,
    /// Worker threads, 0 for one per core [default: run.threads]
    #[arg(long, value_name = "N", value_parser = threads())]
    pub threads: Option<usize>,
    /// Control steps over all hands, counted from the start of the run [default: run.total_steps]
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u64).range(1..=LARGEST))]
    pub total_steps: Option<u64>,
    /// Added to the name of the run folder
    #[arg(long)]
    pub name: Option<String>,
    /// The run folder itself, instead of runs/shadow-hand-repose/DATE-TIME[-NAME]
    #[arg(long, value_name = "DIR", conflicts_with = "name")]
    pub run_dir: Option<PathBuf>,
    /// Go on with a run, in its folder and with its settings; takes the folder or one of its checkpoints
    #[arg(long, value_name = "RUN", conflicts_with_all = ["config", "set", "seed", "name", "run_dir"])]
    pub resume: Option<PathBuf>,
}

/// `play`
#[derive(Args, Debug)]
pub struct PlayArgs {
    /// A checkpoint, or a run folder (its best checkpoint, or its latest) [default: the newest run]
    #[arg(long, value_name = "FILE|RUN")]
    pub ckpt: Option<PathBuf>,
    /// Whole episodes to play, every one counted
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: u64,
    /// Episode k is drawn from (seed, k)
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=LARGEST))]
    pub seed: u64,
    /// Worker threads, 0 for one per core
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = threads())]
    pub threads: usize,
    /// Draw actions from the policy's distribution instead of taking their mean
    #[arg(long, conflicts_with = "policy")]
    pub stochastic: bool,
    /// Play without a window (the only mode so far)
    #[arg(long)]
    pub headless: bool,
    /// One env.* setting of the task that is scored; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<Override>,
    /// Play this instead of a checkpoint
    #[arg(long, conflicts_with = "ckpt")]
    pub policy: Option<Baseline>,
    /// Print one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
    /// Write the first episodes, whole, as JSON lines: at least 2000 records
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
}

/// Policies that need no checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Baseline {
    /// Always answers 0: every actuator in the middle of its range
    Zero,
    /// Uniformly random actions
    Random,
}

/// `bench`
#[derive(Args, Debug)]
pub struct BenchArgs {
    /// File and single settings.
    #[command(flatten)]
    pub settings: Settings,
    /// Worker threads, 0 for one per core [default: run.threads]
    #[arg(long, value_name = "N", value_parser = threads())]
    pub threads: Option<usize>,
    /// Measure only this part
    #[arg(long, value_enum, value_name = "PART")]
    pub only: Option<Part>,
    /// Print one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
}

/// A part of the machine's speed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Part {
    /// The bare physics, and the environments around it
    Physics,
    /// Gradient steps, and their bare matrix products
    Learner,
    /// Whole iterations
    Training,
}
