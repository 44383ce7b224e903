//! What several tests need.

use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use shadow_repose::config::{Config, EnvConfig, Override};
use shadow_repose::env::{Env, OBSERVATION_SIZE, Repose, Task};
use shadow_repose::rng;

/// The built-in scene as text.
pub const SCENE: &str = include_str!("../../assets/shadow_hand/scene.xml");

/// Settings of a training that takes a second: 2 iterations are 256 steps.
pub const SMALL: &[&str] = &[
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

/// The default configuration with these settings on top.
pub fn config(settings: &[&str]) -> Config {
    let settings: Vec<Override> = settings.iter().map(|s| s.parse().unwrap()).collect();
    Config::resolve(None, &settings).unwrap()
}

/// The task with these settings.
pub fn task(settings: &[&str]) -> Arc<Task> {
    Task::new(&config(settings).env).unwrap()
}

/// The settings of the task.
pub fn env_config(settings: &[&str]) -> EnvConfig {
    config(settings).env
}

/// An environment of `task` at the start of episode 0, and its observation.
pub fn started(task: &Arc<Task>) -> (Repose, Vec<f32>) {
    let mut env = Repose::new(task);
    let mut observation = vec![0.0; OBSERVATION_SIZE];
    env.reset(rng::stream(7, "test", 0), &mut observation);
    (env, observation)
}

/// Runs the program in `folder`.
pub fn program(folder: &Path, args: &[&str]) -> Output {
    command(folder, args).output().expect("the program starts")
}

/// The program in `folder`, not started yet.
pub fn command(folder: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_shadow-repose"));
    command.current_dir(folder).args(args);
    command
}

/// `train` with the settings of [`SMALL`] and more arguments.
pub fn train<'a>(more: &[&'a str]) -> Vec<&'a str> {
    let mut args = vec!["train"];
    SMALL.iter().for_each(|setting| args.extend(["--set", setting]));
    args.extend(more);
    args
}

/// What a program said on stderr.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Fails with what the program said unless it exited with 0.
#[track_caller]
pub fn succeeded(output: Output) -> Output {
    assert!(output.status.success(), "{:?}\n{}", output.status, stderr(&output));
    output
}
