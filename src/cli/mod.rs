//! The command line: its structure and help texts. What the commands do is elsewhere.

mod results;
mod together;
mod values;

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::builder::PossibleValuesParser;
use clap::error::ErrorKind;
use clap::{ArgAction, Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};

use crate::config::{Config, Override};
use crate::evaluate::Actor;
use crate::os::Destination;
use crate::sim::{self, Camera, Look, Quality};
pub use results::{Along, PlotArgs, RunsArgs};
use together::given;
pub use together::{Made, expect_together};
use values::{
    camera, count, destination, host, quality, seconds, seed, size, steps, threads, time,
};

// The groups of options in the help.
const SETTINGS: &str = "Settings";
const START: &str = "Start from";
const RUN_FOLDER: &str = "Run folder";
const POLICY: &str = "Policy";
const TASK: &str = "Task";
const OUTPUT: &str = "Output";
const PICTURE: &str = "Film, picture and window";

/// Trains a simulated Shadow Hand to turn a cube in its palm to any requested orientation, on a CPU.
#[derive(Parser)]
#[command(
    arg_required_else_help = true,
    disable_help_flag = true,
    max_term_width = 100
)]
#[command(after_help = "Examples:\n  shadow-repose play --ckpt builtin\n  shadow-repose train")]
pub struct Cli {
    /// The command to run.
    #[command(subcommand)]
    pub command: Command,
    /// Print help
    #[arg(short, long, global = true, action = ArgAction::HelpShort)]
    help: Option<bool>,
}

/// The commands of the program.
#[derive(Subcommand)]
pub enum Command {
    /// Train a policy; Ctrl-C saves and stops
    #[command(
        after_help = "Examples:\n  shadow-repose train --seed 1 --name first\n  shadow-repose train --resume"
    )]
    Train(TrainArgs),
    /// Play a policy in a window or a browser, as a film, or for its score alone
    #[command(
        after_help = "Examples:\n  shadow-repose play --ckpt builtin --headless\n  shadow-repose play --ckpt builtin --web"
    )]
    Play(PlayArgs),
    /// Show the scene without a policy, in a window or a browser
    #[command(
        after_help = "Examples:\n  shadow-repose view --actions wave\n  shadow-repose view --web"
    )]
    View(ViewArgs),
    /// Write a policy as an ONNX file, for programs in other languages
    #[command(
        after_help = "Examples:\n  shadow-repose export --out policy.onnx\n  shadow-repose export --ckpt builtin --out builtin.onnx"
    )]
    Export(ExportArgs),
    /// Plot the learning curves of runs as SVG or PNG
    #[command(after_help = concat!(
        "Examples:\n  shadow-repose plot runs/shadow-hand-repose/*",
        "\n  shadow-repose plot RUN --metric eval/goals --out goals.png"
    ))]
    Plot(PlotArgs),
    /// List runs with state, time left, steps, goals and settings, or compare two runs
    #[command(after_help = "Examples:\n  shadow-repose runs --watch\n  shadow-repose runs RUN RUN")]
    Runs(RunsArgs),
    /// Measure the speed of this machine: physics, environments, learner and whole iterations
    #[command(
        after_help = "Examples:\n  shadow-repose bench\n  shadow-repose bench --only training --threads 4"
    )]
    Bench(BenchArgs),
    /// Print completions for a shell
    #[command(after_help = concat!(
        "Examples:\n  shadow-repose completions bash > ~/.local/share/bash-completion/completions/shadow-repose",
        "\n  shadow-repose completions zsh > ~/.zfunc/_shadow-repose"
    ))]
    Completions {
        /// Shell to print completions for
        shell: clap_complete::Shell,
    },
    /// Print a manual page
    #[command(
        after_help = "Examples:\n  shadow-repose man | man -l -\n  shadow-repose man > ~/.local/share/man/man1/shadow-repose.1"
    )]
    Man,
}

/// The command line with what is only known at run time: version, examples, defaults that are settings.
pub fn command() -> clap::Command {
    let run = Config::default().run;
    let defaults = [
        ("{seed}", run.seed.to_string()),
        ("{threads}", run.threads.to_string()),
        ("{total_steps}", run.total_steps.to_string()),
    ];
    let with_defaults = |arg: clap::Arg| {
        let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
        arg.help(
            defaults
                .iter()
                .fold(help, |help, (key, value)| help.replace(key, value)),
        )
    };
    Cli::command()
        .version(format!(
            "{} ({}, MuJoCo {})",
            env!("CARGO_PKG_VERSION"),
            env!("SHADOW_REPOSE_COMMIT"),
            sim::mujoco_version()
        ))
        .mut_subcommands(|command| command.mut_args(with_defaults))
}

/// Parses a command line, which begins with the name of the program.
///
/// # Errors
/// Fails if the command line is wrong, or asks for help or the version.
pub fn parse_from<T: Into<OsString> + Clone>(
    words: impl IntoIterator<Item = T>,
) -> Result<Cli, clap::Error> {
    let matches = command().try_get_matches_from(words)?;
    let mut cli = Cli::from_arg_matches(&matches).map_err(|error| error.format(&mut command()))?;
    let given = given(&matches);
    match &mut cli.command {
        Command::Play(args) => args.given = given,
        Command::View(args) => args.given = given,
        _ => {}
    }
    Ok(cli)
}

/// The options that change settings.
#[derive(Args, Default)]
pub struct SettingArgs {
    /// TOML file with the settings that differ from the defaults; a relative env.model in it counts from the folder of the file
    #[arg(long, value_name = "FILE", help_heading = SETTINGS)]
    pub config: Option<PathBuf>,
    /// Change one setting that the command uses, e.g. env.sim_dt=0.005; repeatable, overrides the file
    #[arg(long, value_name = "KEY=VALUE", help_heading = SETTINGS)]
    pub set: Vec<Override>,
}

/// The options of `train`.
#[derive(Args, Default)]
pub struct TrainArgs {
    /// The configuration file and single settings.
    #[command(flatten)]
    pub settings: SettingArgs,
    /// Random seed of the run [default: {seed}]
    #[arg(long, value_parser = seed(), help_heading = SETTINGS)]
    pub seed: Option<u64>,
    /// Number of worker threads; 0: one per core [default: {threads}]
    #[arg(long, value_name = "N", value_parser = threads(), help_heading = SETTINGS)]
    pub threads: Option<usize>,
    /// Total control steps over all environments, counted from the start of the run [default: {total_steps}]
    #[arg(long, value_name = "STEPS", value_parser = steps, help_heading = SETTINGS)]
    pub total_steps: Option<u64>,
    /// Suffix of the name of the run folder
    #[arg(long, help_heading = RUN_FOLDER)]
    pub name: Option<String>,
    /// Path of the run folder, instead of runs/shadow-hand-repose/DATE-TIME[-NAME]
    #[arg(long, value_name = "DIR", conflicts_with = "name", help_heading = RUN_FOLDER)]
    pub run_dir: Option<PathBuf>,
    /// Continue the training run in this run folder or from this checkpoint, with its settings [default: the newest run]
    #[arg(long, value_name = "RUN", num_args = 0..=1, conflicts_with_all = ["config", "seed", "name", "run_dir"], help_heading = START)]
    pub resume: Option<Option<PathBuf>>,
    /// Start a new run from an existing policy (fine-tuning): a checkpoint, a run folder, or the built-in `builtin` or `robust`.
    /// Weights, normaliser and structure of the nets come from the policy; everything else starts anew
    #[arg(long, value_name = "FILE|RUN|NAME", conflicts_with = "resume", help_heading = START)]
    pub init: Option<PathBuf>,
    /// Start a new run from the full state of this run or checkpoint (weights, environments, counters), with changed settings;
    /// ramps continue
    #[arg(long, value_name = "RUN|CHECKPOINT", conflicts_with_all = ["resume", "init"], help_heading = START)]
    pub fork: Option<PathBuf>,
    /// Number of newest checkpoints to keep [default: 2, or the number in a resumed run if larger]
    #[arg(long, value_name = "N", value_parser = count(), help_heading = RUN_FOLDER)]
    pub keep: Option<usize>,
    /// Save and exit with code 0 after this time, e.g. 3h50m
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub stop_after: Option<Duration>,
    /// Hide progress and notes; still print warnings, evaluations and the final line
    #[arg(long)]
    pub quiet: bool,
    /// Write the last steps of every episode whose physics diverged, for replay
    #[arg(long, help_heading = RUN_FOLDER)]
    pub dump_diverged: bool,
}

/// The options of `play`.
#[derive(Args)]
pub struct PlayArgs {
    /// Who acts: a checkpoint, a run folder (its best checkpoint, else its latest), a built-in policy (builtin, or robust for other
    /// hands and cubes), or actions without a policy (zero, random, wave) [default: the newest run, or builtin if there is none]
    #[arg(long, value_name = "FILE|RUN|NAME", help_heading = POLICY)]
    pub ckpt: Option<PathBuf>,
    /// Number of episodes to play, each to its end [default: 256; 1 in a film or an HTML file; no limit in a window]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000), help_heading = TASK)]
    pub episodes: Option<u64>,
    /// Random seed; episode k is drawn from (seed, k)
    #[arg(long, default_value_t = 0, value_parser = seed(), help_heading = TASK)]
    pub seed: u64,
    /// Number of worker threads; 0: one per core
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = threads())]
    pub threads: usize,
    /// Sample actions from the policy's distribution instead of using its mean
    #[arg(long, help_heading = POLICY)]
    pub stochastic: bool,
    /// Change one env.* or hand.* setting of the task; repeatable
    #[arg(long, value_name = "KEY=VALUE", help_heading = TASK)]
    pub set: Vec<Override>,
    /// Play in a window in real time [default if there is a display]
    #[arg(long, help_heading = OUTPUT)]
    pub window: bool,
    /// Play without a window and print the score
    #[arg(long, help_heading = OUTPUT)]
    pub headless: bool,
    /// Print only the score, as one JSON object
    #[arg(long, help_heading = OUTPUT)]
    pub json: bool,
    /// Play under changed physics, noise and delays, one change at a time, and print a table of the share of goals retained
    #[arg(long, help_heading = OUTPUT)]
    pub robustness: bool,
    /// Write a film (.mp4, .gif), a file for any browser (.html; at most 20 episodes), the first episodes as JSON lines (.jsonl,
    /// .jsonl.gz; until 2000 records), or the table of --robustness (.svg, .png); repeatable; jsonl:FILE names the format of a
    /// FILE without an extension
    #[arg(long, value_name = "FILE", help_heading = OUTPUT, value_parser = destination(&["mp4", "gif", "html", "jsonl", "svg", "png"]))]
    pub out: Vec<Destination>,
    /// Write the episodes of this trace as the .html of --out, without playing again
    #[arg(long, value_name = "FILE", help_heading = OUTPUT)]
    pub from_trace: Option<PathBuf>,
    /// Number of hands on the page of --web, at most 16
    #[arg(long, value_name = "N", default_value_t = 1, help_heading = OUTPUT, value_parser = clap::value_parser!(u64).range(1..=16))]
    pub hands: u64,
    /// Follow a training run with --web: its newest policy plays each episode
    #[arg(long, help_heading = OUTPUT)]
    pub follow: bool,
    /// Frames of the film per second of simulated time
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=120), help_heading = PICTURE)]
    pub fps: u32,
    /// Size of the film in pixels [default: 640x480]
    #[arg(long, value_name = "WxH", value_parser = size, help_heading = PICTURE)]
    pub size: Option<[u32; 2]>,
    /// Rendering quality; high adds shadows, reflections and smooth edges [default: fast for a film, else high]
    #[arg(long, value_parser = quality(), hide_possible_values = true, value_name = "fast|high", help_heading = PICTURE)]
    pub quality: Option<Quality>,
    /// Page, camera and meshes.
    #[command(flatten)]
    pub shot: ShotArgs,
    /// The options that were given, for [`expect_together`].
    #[arg(skip)]
    pub given: Vec<String>,
}

/// The options of `export`.
#[derive(Args)]
pub struct ExportArgs {
    /// Policy to export: a checkpoint, a run folder (its best checkpoint, else its latest), or a built-in policy:
    /// builtin, or robust for other hands and cubes [default: the newest run, or builtin if there is none]
    #[arg(long, value_name = "FILE|RUN|NAME", help_heading = POLICY)]
    pub ckpt: Option<PathBuf>,
    /// Change one env.* setting that the file records, e.g. env.model=my_scene.xml; repeatable
    #[arg(long, value_name = "KEY=VALUE", help_heading = TASK)]
    pub set: Vec<Override>,
    /// File to write
    #[arg(long, value_name = "FILE", default_value = "policy.onnx", help_heading = OUTPUT)]
    pub out: PathBuf,
}

/// The options of `view`.
#[derive(Args)]
#[command(next_help_heading = PICTURE)]
pub struct ViewArgs {
    /// The configuration file and single settings.
    #[command(flatten)]
    pub settings: SettingArgs,
    /// Motion of the hand: zero (still), random, or wave (a slow swing of each actuator)
    #[arg(long, default_value = "zero", value_parser = PossibleValuesParser::new(Actor::WITHOUT_POLICY.map(|(name, _)| name)),
        help_heading = SETTINGS)]
    pub actions: String,
    /// Random seed; episode k is drawn from (seed, k)
    #[arg(long, default_value_t = 0, value_parser = seed(), help_heading = SETTINGS)]
    pub seed: u64,
    /// Write one picture (.png) and exit, without opening a window; needs no display
    #[arg(long, value_name = "FILE", value_parser = destination(&["png"]), help_heading = OUTPUT)]
    pub out: Option<Destination>,
    /// Check whether the hand can learn, print a table with a verdict in each row, and exit
    #[arg(long, conflicts_with_all = ["out", "actions"], help_heading = OUTPUT)]
    pub check: bool,
    /// Fetch the meshes of the hand and exit, to show them later without a network
    #[arg(long, exclusive = true)]
    pub fetch: bool,
    /// Time of the picture in the episode, in seconds
    #[arg(long, value_name = "SECONDS", default_value = "0.5", value_parser = seconds)]
    pub at: f64,
    /// Size of the picture in pixels
    #[arg(long, value_name = "WxH", default_value = "1280x720", value_parser = size)]
    pub size: [u32; 2],
    /// Rendering quality; high adds shadows, reflections and smooth edges
    #[arg(long, default_value = "high", value_parser = quality(), hide_possible_values = true, value_name = "fast|high")]
    pub quality: Quality,
    /// Page, camera and meshes.
    #[command(flatten)]
    pub shot: ShotArgs,
    /// The options that were given, for [`expect_together`].
    #[arg(skip)]
    pub given: Vec<String>,
}

/// The options for what is seen, and where.
#[derive(Args)]
pub struct ShotArgs {
    /// Show the hand in a browser, at this port of 127.0.0.1 (0: any free port) [default port: 7070]
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "7070", help_heading = OUTPUT)]
    pub web: Option<u16>,
    /// Host name by which a proxy asks for the page of --web, such as jupyter-server-proxy or Open OnDemand. The page is then served on
    /// all addresses of this machine, and each request needs the token in the address that is printed
    #[arg(long, value_name = "NAME", value_parser = host, help_heading = OUTPUT)]
    pub web_host: Option<String>,
    /// Viewing direction in degrees and distance in m, e.g. 150,-27,0.66
    #[arg(long, value_name = "AZIMUTH,ELEVATION,DISTANCE", value_parser = camera, allow_hyphen_values = true, help_heading = PICTURE)]
    pub camera: Option<Camera>,
    /// Show the primitives used for collisions instead of the hand's meshes
    #[arg(long, help_heading = PICTURE)]
    pub plain: bool,
}

impl ShotArgs {
    /// What to show, with this size and quality.
    pub fn sized(&self, size: [u32; 2], quality: Quality) -> Look {
        Look {
            dress: None,
            size,
            camera: self.camera,
            quality,
            plain: self.plain,
        }
    }
}

impl PlayArgs {
    /// Whether a score or a file is asked for.
    pub fn wants_result(&self) -> bool {
        self.headless || self.json || !self.out.is_empty()
    }
}

/// A usage error for the command `name`, for options that are valid alone but not in combination.
pub fn usage_error(name: &str, text: &str) -> clap::Error {
    let mut command = command();
    command.build();
    command
        .find_subcommand_mut(name)
        .expect("a command")
        .error(ErrorKind::ArgumentConflict, text)
}

/// The options of `bench`.
#[derive(Args)]
pub struct BenchArgs {
    /// The configuration file and single settings.
    #[command(flatten)]
    pub settings: SettingArgs,
    /// Number of worker threads; 0: one per core [default: {threads}]
    #[arg(long, value_name = "N", value_parser = threads(), help_heading = SETTINGS)]
    pub threads: Option<usize>,
    /// Measure only this part
    #[arg(long, value_enum, value_name = "PART")]
    pub only: Option<Part>,
    /// Print only the results, as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// A part of the benchmark.
#[derive(Clone, Copy, PartialEq, ValueEnum)]
pub enum Part {
    /// Bare physics, and the environments around it
    Physics,
    /// Gradient steps, and their matrix products alone
    Learner,
    /// Whole iterations of training
    Training,
    /// Trainings with different numbers of environments, and which of them learns most in the same time
    Environments,
}
