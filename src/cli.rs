//! The command line: its shape and its help, no logic.

use std::path::PathBuf;
use std::time::Duration;

use clap::builder::RangedU64ValueParser;
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};

use crate::config::Override;
use crate::sim::{Camera, Quality};

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
    /// Let a policy play: in a window, as a film, or without either, for its score
    Play(PlayArgs),
    /// Look at the scene, without a policy
    View(ViewArgs),
    /// Draw the learning curves of runs: SVG, or PNG
    Plot(PlotArgs),
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
    #[arg(long, value_name = "STEPS", value_parser = steps)]
    pub total_steps: Option<u64>,
    /// Added to the name of the run folder
    #[arg(long)]
    pub name: Option<String>,
    /// The run folder itself, instead of runs/shadow-hand-repose/DATE-TIME[-NAME]
    #[arg(long, value_name = "DIR", conflicts_with = "name")]
    pub run_dir: Option<PathBuf>,
    /// Go on with a run, in its folder and with its settings; takes the folder or one of its checkpoints
    #[arg(long, value_name = "RUN", conflicts_with_all = ["config", "seed", "name", "run_dir"])]
    pub resume: Option<PathBuf>,
    /// Begin with the policy of a checkpoint or run, or the built-in one, weights and normaliser; everything else is as in a new
    /// run
    #[arg(long, value_name = "FILE|RUN|builtin", conflicts_with = "resume")]
    pub init: Option<PathBuf>,
    /// Begin a new run with everything of another one's checkpoint (weights, hands, counters; ramps go on), under changed settings;
    /// takes the folder or one of its checkpoints
    #[arg(long, value_name = "RUN|CHECKPOINT", conflicts_with_all = ["resume", "init"])]
    pub fork: Option<PathBuf>,
    /// How many of the newest checkpoints to keep [default: 2, or as many as there are in a run that is resumed]
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=1_000_000))]
    pub keep: Option<usize>,
    /// Save and exit with 0 after this time, as 3h50m
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub stop_after: Option<Duration>,
    /// No progress and no hints; warnings, evaluations and the last line are still said
    #[arg(long)]
    pub quiet: bool,
    /// Write the last steps of every episode whose physics diverged, for replay
    #[arg(long)]
    pub dump_diverged: bool,
}

/// `play`
#[derive(Args, Debug)]
pub struct PlayArgs {
    /// A checkpoint, a run folder (its best checkpoint, or its latest), or builtin: the policy that comes with the program
    /// [default: the newest run, or if there is none the policy that comes with the program]
    #[arg(long, value_name = "FILE|RUN|builtin")]
    pub ckpt: Option<PathBuf>,
    /// Whole episodes to play, every one counted [default: 256; in a window, until it is closed; in a film, 1]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: Option<u64>,
    /// Episode k is drawn from (seed, k)
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=LARGEST))]
    pub seed: u64,
    /// Worker threads, 0 for one per core
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = threads())]
    pub threads: usize,
    /// Draw actions from the policy's distribution instead of taking their mean
    #[arg(long, conflicts_with = "policy")]
    pub stochastic: bool,
    /// One env.* setting of the task that is played; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<Override>,
    /// Play this instead of a checkpoint
    #[arg(long, conflicts_with = "ckpt")]
    pub policy: Option<Baseline>,
    /// Play in a window, at real time [default: where there is a display]
    #[arg(long, conflicts_with_all = ["headless", "json", "trace", "video"])]
    pub window: bool,
    /// Play without a window and print the score
    #[arg(long)]
    pub headless: bool,
    /// Print the score as one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
    /// Write the first episodes, whole, as JSON lines: at least 2000 records
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Film the episodes, one after the other: MP4 or GIF, by the name; needs no display
    #[arg(long, value_name = "FILE")]
    pub video: Option<PathBuf>,
    /// Frames of a film per second of its episodes
    #[arg(long, default_value_t = 50, requires = "video", value_parser = clap::value_parser!(u32).range(1..=120))]
    pub fps: u32,
    /// How it is looked at.
    #[command(flatten)]
    pub shot: Shot,
}

/// `view`
#[derive(Args, Debug)]
pub struct ViewArgs {
    /// File and single settings.
    #[command(flatten)]
    pub settings: Settings,
    /// What moves the hand
    #[arg(long, value_enum, default_value_t = Motion::Zero)]
    pub actions: Motion,
    /// Episode k is drawn from (seed, k)
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=LARGEST))]
    pub seed: u64,
    /// Draw one picture (PNG) instead of opening a window, and exit; needs no display
    #[arg(long, value_name = "FILE")]
    pub screenshot: Option<PathBuf>,
    /// Seconds of the episode before the picture
    #[arg(long, value_name = "SECONDS", default_value_t = 0.5, requires = "screenshot", value_parser = seconds)]
    pub at: f64,
    /// How it is looked at.
    #[command(flatten)]
    pub shot: Shot,
}

/// How a scene is looked at.
#[derive(Args, Clone, Debug)]
pub struct Shot {
    /// Width and height of film or picture in pixels [default: 640x480; of one picture 1280x720]
    #[arg(long, value_name = "WxH", value_parser = size)]
    pub size: Option<[u32; 2]>,
    /// The direction of view in degrees and its distance in m, as 150,-27,0.66
    #[arg(long, value_name = "AZIMUTH,ELEVATION,DISTANCE", value_parser = camera, allow_hyphen_values = true)]
    pub camera: Option<Camera>,
    /// fast, or high: with shadows, reflections and smooth edges [default: fast for a film, else high]
    #[arg(long, value_parser = quality, value_name = "fast|high")]
    pub quality: Option<Quality>,
    /// Show the primitives that collide instead of the real hand's meshes
    #[arg(long)]
    pub plain: bool,
}

impl Shot {
    /// The first of the options that were given.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            ("--size", self.size.is_some()),
            ("--camera", self.camera.is_some()),
            ("--quality", self.quality.is_some()),
            ("--plain", self.plain),
        ];
        given.into_iter().find(|(_, given)| *given).map(|(option, _)| option)
    }
}

/// A line for the command of this name that cannot be meant, though each of its parts can.
pub fn usage_error(name: &str, text: &str) -> clap::Error {
    let mut command = Cli::command();
    command.build();
    command.find_subcommand_mut(name).expect("a command").error(ErrorKind::ArgumentConflict, text)
}

/// What moves the hand in `view`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Motion {
    /// Every actuator in the middle of its range
    Zero,
    /// Uniformly random actions
    Random,
    /// Each actuator swings slowly around the middle, a little after the one before it
    Wave,
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let (width, height) = text.split_once('x').ok_or("must be WIDTHxHEIGHT, as 640x480")?;
    let pixels = |text: &str, largest: u32| match text.parse() {
        Ok(pixels) if (16..=largest).contains(&pixels) => Ok(pixels),
        _ => Err(format!("{text} must be a whole number from 16 to {largest}")),
    };
    Ok([pixels(width, 3840)?, pixels(height, 2160)?])
}

fn camera(text: &str) -> Result<Camera, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[azimuth, elevation, distance]) if azimuth.is_finite() && elevation.is_finite() => {
            match (0.05..=10.0).contains(&distance) {
                true => Ok(Camera { azimuth, elevation, distance }),
                false => Err(format!("the distance {distance} m must be from 0.05 to 10")),
            }
        }
        _ => Err("must be three numbers, as 150,-27,0.66".into()),
    }
}

fn steps(text: &str) -> Result<u64, String> {
    // 1e8 is how people write a large number of steps.
    let float = text.parse::<f64>().ok().filter(|x| x.fract() == 0.0 && (0.0..9e15).contains(x)).map(|x| x as u64);
    let steps = text.parse().ok().or(float).filter(|steps| (1..=LARGEST).contains(steps));
    steps.ok_or_else(|| "must be a whole number from 1, as 30000000 or 3e7".into())
}

fn time(text: &str) -> Result<Duration, String> {
    let time = text.parse::<jiff::SignedDuration>().ok().and_then(|time| Duration::try_from(time).ok());
    time.filter(|time| !time.is_zero()).ok_or_else(|| "must be a time, as 3h50m, 90m or 30s".into())
}

fn quality(text: &str) -> Result<Quality, String> {
    match text {
        "fast" => Ok(Quality::Fast),
        "high" => Ok(Quality::High),
        _ => Err("must be fast or high".into()),
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=3600.0).contains(seconds));
    seconds.ok_or_else(|| "must be a number of seconds from 0 to 3600".into())
}

/// Policies that need no checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Baseline {
    /// Always answers 0: every actuator in the middle of its range
    Zero,
    /// Uniformly random actions
    Random,
}

/// `plot`
#[derive(Args, Debug)]
pub struct PlotArgs {
    /// Run folders, or their metrics.csv
    #[arg(required = true, value_name = "RUN")]
    pub runs: Vec<PathBuf>,
    /// The picture: SVG or PNG, by the name
    #[arg(long, value_name = "FILE", default_value = "learning.svg")]
    pub out: PathBuf,
    /// A column of metrics.csv, each in a panel of its own; may be repeated [default: goals, rotation error and drops per episode]
    #[arg(long, value_name = "COLUMN")]
    pub metric: Vec<String>,
    /// What is laid along
    #[arg(long, value_enum, default_value_t = Along::Steps)]
    pub along: Along,
    /// Iterations that a point of a curve is the mean of
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = RangedU64ValueParser::<usize>::new().range(1..=1_000_000))]
    pub smooth: usize,
    /// Pixels of the whole picture [default: 800 wide, 260 for each panel]
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    pub size: Option<[u32; 2]>,
}

/// What a learning curve is drawn along.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Along {
    /// Control steps over all environments
    Steps,
    /// Hours spent collecting and learning, without evaluations and saving
    Hours,
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
