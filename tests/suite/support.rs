//! Helpers shared by several tests.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Once};

use shadow_repose::agent::Agent;
use shadow_repose::config::{Config, EnvConfig, Override, Settings};
use shadow_repose::env::Env;
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{Repose, Task};
use shadow_repose::rng;
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1};

/// The size of an observation of the built-in hand.
pub(crate) const OBSERVATION_SIZE: usize = 157;

/// The built-in scene as text.
pub(crate) const SCENE: &str = include_str!("../../assets/shadow_hand/scene.xml");

/// The settings of a training that takes a second: 2 iterations are 256 steps.
pub(crate) const SMALL: &[&str] = &[
    "env.num_envs=16",
    "ppo.horizon=8",
    "ppo.hidden=[16,8]",
    "ppo.minibatches=2",
    "ppo.epochs=2",
    "env.max_episode_seconds=0.2",
    "run.eval_episodes=2",
    "run.checkpoint_every=100",
    "run.eval_every=1",
];

/// Returns the default configuration with these settings applied over it.
pub(crate) fn config(settings: &[&str]) -> Config {
    let settings: Vec<Override> = settings.iter().map(|s| s.parse().unwrap()).collect();
    Settings::new().sets(&settings).resolve().unwrap()
}

/// Returns the task with these settings.
pub(crate) fn task(settings: &[&str]) -> Arc<Task> {
    let config = config(settings);
    Task::new(&config).unwrap()
}

/// Returns the `[env]` settings of the default configuration with these settings applied over it.
pub(crate) fn env_config(settings: &[&str]) -> EnvConfig {
    config(settings).env
}

/// Returns an environment of `task` at the start of episode 0, and its observation.
pub(crate) fn started(task: &Arc<Task>) -> (Repose, Vec<f32>) {
    let mut env = Repose::new(task);
    let mut observation = vec![0.0; task.record().spaces().observation_size];
    env.reset(rng::stream(7, "test", 0), &mut observation);
    (env, observation)
}

/// Returns the agent of a training by this process alone.
pub(crate) fn started_agent(task: &Arc<Task>, config: &Config) -> Agent<Repose> {
    Agent::for_task(task, config, Exchange::alone(config.shards())).unwrap()
}

/// Runs the program in `folder`.
pub(crate) fn program(folder: &Path, args: &[&str]) -> Output {
    command(folder, args).output().expect("the program starts")
}

/// Has the programs that this process starts obey signals. A signal that is ignored here, as under `nohup` or in a background job,
/// would be ignored by them. One that is caught here has its default effect on them.
pub(crate) fn obeying_signals() {
    static ONCE: Once = Once::new();
    let ignored = |signal: i32| {
        // Other systems than Linux do not tell.
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let mut lines = status.lines();
        let mask = lines.find_map(|line| line.strip_prefix("SigIgn:"));
        let mask = mask.map_or(0, |mask| u64::from_str_radix(mask.trim(), 16).unwrap());
        mask >> (signal - 1) & 1 == 1
    };
    ONCE.call_once(|| {
        for signal in [SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1] {
            if ignored(signal) {
                signal_hook::flag::register(signal, Arc::default()).unwrap();
            }
        }
    });
}

/// Returns the command that runs the program in `folder`.
pub(crate) fn command(folder: &Path, args: &[&str]) -> Command {
    obeying_signals();
    let mut command = Command::new(env!("CARGO_BIN_EXE_shadow-repose"));
    // Otherwise the window of a test would open on the user's own display.
    command
        .current_dir(folder)
        .args(args)
        .env_remove("DISPLAY")
        .env_remove("WAYLAND_DISPLAY");
    // Commands that it prints depend on whether cargo has called it.
    command.env_remove("CARGO_PKG_NAME");
    command
}

/// Compiles a library from this C code, for `LD_PRELOAD`. It stands for a system that behaves so. Returns `None` without a compiler for
/// the programs that run here, or without such a variable.
pub(crate) fn preloaded(folder: &Path, code: &str) -> Option<String> {
    if !has("/proc/self/fd") || is_emulated() {
        return None;
    }
    let (source, library) = (folder.join("preloaded.c"), folder.join("preloaded.so"));
    fs::write(&source, code).unwrap();
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-o"])
        .args([&library, &source])
        .status();
    if compiled.is_ok_and(|status| status.success()) {
        return Some(library.display().to_string());
    }
    must_be_possible("a library that is preloaded: there is no C compiler");
    None
}

/// Returns the arguments of `train` with the settings of [`SMALL`] and `more` arguments.
pub(crate) fn train<'a>(more: &[&'a str]) -> Vec<&'a str> {
    let mut args = vec!["train"];
    SMALL
        .iter()
        .for_each(|setting| args.extend(["--set", setting]));
    args.extend(more);
    args
}

/// Returns what a program printed on stderr.
pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Fails with what the program printed on stderr unless it exited with 0.
#[track_caller]
pub(crate) fn succeeded(output: Output) -> Output {
    assert!(
        output.status.success(),
        "{:?}\n{}",
        output.status,
        stderr(&output)
    );
    output
}

/// Prints that something cannot be tested here and returns false. Fails if CI has installed what the test needs.
pub(crate) fn must_be_possible(what: &str) -> bool {
    assert!(
        std::env::var_os("SHADOW_REPOSE_SEES").is_none(),
        "not possible here: {what}"
    );
    eprintln!("not tested: {what}");
    false
}

/// Whether this system has a file that Linux has. If not, prints that something cannot be tested here.
pub(crate) fn has(file: &str) -> bool {
    Path::new(file).exists() || must_be_possible(&format!("{file}, which Linux has"))
}

/// Whether another kind of processor is emulated here. Then prints that something cannot be tested here.
pub(crate) fn is_emulated() -> bool {
    let is_emulated = std::env::var_os("QEMU_LD_PREFIX").is_some();
    if is_emulated {
        eprintln!("not tested: what needs a compiler or a system of the emulated processor");
    }
    is_emulated
}

/// Returns how many of the cube's colours (red, orange, yellow, green, blue) cover more than 0.2 % each of a picture
/// `[height, width, 3]`.
#[cfg(any(feature = "video", feature = "viewer"))]
pub(crate) fn colours_of_the_cube(rgb: &[u8]) -> usize {
    let mut found = [0; 5];
    for pixel in rgb.chunks_exact(3) {
        let [r, g, b] = [0, 1, 2].map(|i| f64::from(pixel[i]));
        let (most, least) = (r.max(g).max(b), r.min(g).min(b));
        if most < 60.0 || least > 0.35 * most {
            continue;
        }
        let range = most - least;
        let hue = if most == r {
            60.0 * (g - b) / range
        } else if most == g {
            120.0 + 60.0 * (b - r) / range
        } else {
            240.0 + 60.0 * (r - g) / range
        };
        let hues = [
            -12.0..12.0,
            18.0..38.0,
            42.0..62.0,
            90.0..160.0,
            200.0..240.0,
        ];
        if let Some(colour) = hues.iter().position(|hues| hues.contains(&hue)) {
            found[colour] += 1;
        }
    }
    found
        .iter()
        .filter(|&&pixels| pixels * 500 > rgb.len() / 3)
        .count()
}

/// Returns the names in a folder, sorted.
pub(crate) fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// Returns the rows of the metrics, with the header, without the `time/` columns.
pub(crate) fn metrics(run: &Path) -> Vec<Vec<String>> {
    let text = fs::read_to_string(run.join("metrics.csv")).unwrap();
    let header: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let kept = |row: &str| {
        let cells = row
            .split(',')
            .zip(&header)
            .filter(|(_, name)| !name.starts_with("time/"));
        cells.map(|(cell, _)| cell.to_owned()).collect()
    };
    text.lines().map(kept).collect()
}

/// Returns the tensors of a checkpoint, sorted by name.
pub(crate) fn weights(path: PathBuf) -> Vec<(String, Vec<u8>)> {
    let bytes = fs::read(path).unwrap();
    let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let mut found: Vec<_> = tensors
        .iter()
        .map(|(name, view)| (name.to_owned(), view.data().to_vec()))
        .collect();
    found.sort();
    found
}

/// Returns the events in the event files of a run, in order.
pub(crate) fn events(run: &Path) -> Vec<tensorboard_proto::event::Event> {
    let files = fs::read_dir(run)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> = files
        .filter(|path| path.to_string_lossy().contains("tfevents"))
        .collect();
    files.sort();
    let mut found = Vec::new();
    for file in files {
        let bytes = fs::read(file).unwrap();
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            found.push(protobuf::Message::parse_from_bytes(&rest[12..12 + length]).unwrap());
            rest = &rest[16 + length..];
        }
    }
    found
}
