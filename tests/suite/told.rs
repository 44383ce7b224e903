//! Policies that are told what is known of their hand and its object.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;
use shadow_repose::env::Env;
use shadow_repose::repose::{Lesson, Randomization, Repose};
use shadow_repose::rng;

use crate::support::{OBSERVATION_SIZE, config, program, stderr, succeeded, task, train};

const BUILTIN: &str = "assets/policies/repose.safetensors";
const ROBUST: &str = "assets/policies/robust.safetensors";

/// The last values of an observation of this environment at the start of an episode, which begin with the group `known`.
fn told(env: &mut Repose, episode: u64) -> Vec<f32> {
    let mut observation = vec![0.0; OBSERVATION_SIZE + 4];
    env.reset(rng::stream(0, "episode", episode), &mut observation);
    observation.split_off(OBSERVATION_SIZE)
}

/// The path of a file of the checkout.
fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// Runs `scripts/tell`.
fn tell(args: &[&Path]) -> Output {
    let mut python = Command::new("python3");
    python
        .arg(file("scripts/tell"))
        .args(args)
        .output()
        .unwrap()
}

/// A folder with the built-in policy, told and untold.
fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("told");
    succeeded(tell(&[&file(BUILTIN), &path]));
    (folder, path)
}

/// The actions of a policy in the first 0.1 s of episodes.
fn actions(folder: &Path, policy: &str) -> Vec<f64> {
    let short = "env.max_episode_seconds=0.1";
    let play = ["play", "--ckpt", policy, "--out", "t.jsonl", "--set", short];
    succeeded(program(folder, &play));
    let trace = fs::read_to_string(folder.join("t.jsonl")).unwrap();
    trace
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap())
        .filter_map(|line| line.get("action").cloned())
        .flat_map(|action| serde_json::from_value::<Vec<f64>>(action).unwrap())
        .collect()
}

fn expect_alike(some: &[f64], others: &[f64]) {
    assert!(some.len() == others.len() && some.len() > 100);
    let far = |(a, b): (&f64, &f64)| (a - b).abs() > 1e-4;
    assert!(!some.iter().zip(others).any(far));
}

fn json(output: Output) -> Value {
    serde_json::from_slice(&succeeded(output).stdout).unwrap()
}

#[test]
fn a_policy_sees_the_logarithms_of_the_factors_that_are_stated_and_zeros_for_the_others() {
    let task = task(&["env.known={cube_size=1.2,friction=0.5}"]);
    let expected = [0.0, 1.2_f64.ln(), 0.0, 0.5_f64.ln()].map(|x| x as f32);
    assert_eq!(told(&mut Repose::new(&task), 0), expected);
}

#[test]
fn in_training_a_policy_sees_what_the_episode_has_drawn_and_nothing_of_what_the_task_sets() {
    let settings = [
        "env.known.cube_mass=2",
        "env.damping_scale=3",
        "randomization.share=1",
        "randomization.each=0.5",
    ];
    let config = config(&settings);
    let task = task(&settings);
    let randomization = Randomization::new(&task, &config.randomization).unwrap();
    let mut environment = Repose::randomized(&task, randomization.as_ref());
    environment.set_lesson(Lesson::at(0, &config));
    let mut varied = [false; 4];
    for episode in 0..40 {
        let found = told(&mut environment, episode);
        let draw = environment.draw().unwrap();
        for (i, name) in ["cube_mass", "cube_size", "damping", "friction"]
            .into_iter()
            .enumerate()
        {
            let values = &draw.physics[name];
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let stated: f64 = if name == "cube_mass" { 2.0 } else { 1.0 };
            assert_eq!(found[i], (stated * mean).ln() as f32, "{name}");
            varied[i] |= mean != 1.0;
        }
    }
    assert_eq!(varied, [true; 4]);
}

#[test]
fn a_policy_that_scripts_tell_has_widened_acts_as_before_until_it_is_trained_whatever_it_is_told() {
    let (folder, path) = folder();
    let play = |policy: &str, more: &[&str]| {
        let args = ["play", "--ckpt", policy, "--episodes", "8", "--json"];
        let mut score = json(program(folder.path(), &[&args, more].concat()));
        score.as_object_mut().unwrap().remove("checkpoint");
        score
    };
    let before = play("builtin", &[]);
    assert_eq!(play("told", &[]), before);
    assert_eq!(play("told", &["--set", "env.known.cube_size=1.2"]), before);
    let untold = folder.path().join("untold");
    succeeded(tell(&["--undo".as_ref(), &path, &untold]));
    assert_eq!(fs::read(untold).unwrap(), fs::read(file(BUILTIN)).unwrap());
    let again = tell(&[&path, &folder.path().join("twice")]);
    assert!(!again.status.success() && stderr(&again).contains("that is told nothing yet"));

    let init = ["--init", "told", "--run-dir", "run", "--total-steps", "256"];
    let sets = ["ppo.hidden=[512,256,128]", "randomization.share=1"];
    let sets = sets.map(|set| ["--set", set]).concat();
    let small = train(&[&init[..], &sets].concat());
    succeeded(program(folder.path(), &small));
    let run = "run/policy.safetensors";
    let (score, other) = (
        play(run, &[]),
        play(run, &["--set", "env.known.cube_size=1.2"]),
    );
    assert!(score != other, "it has learnt to see what it is told");
    let resume = ["train", "--resume", "run", "--total-steps", "384"];
    succeeded(program(folder.path(), &resume));
}

#[test]
fn the_built_in_policy_is_robust_without_its_four_inputs_and_acts_as_robust_that_is_told_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    succeeded(tell(&[
        "--undo".as_ref(),
        &file(ROBUST),
        &folder.join("untold"),
    ]));
    let untold = actions(folder, "untold");
    assert!(actions(folder, "builtin") == untold);
    expect_alike(&actions(folder, "robust"), &untold);
}

#[test]
fn a_policy_whose_inputs_scripts_tell_has_taken_acts_as_it_did_with_what_its_settings_state() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let new = ["--run-dir", "run", "--total-steps", "256"];
    let known = ["--set", "env.known={friction=0.5,damping=2}"];
    succeeded(program(folder, &train(&[&new[..], &known].concat())));
    let run = folder.join("run/policy.safetensors");
    succeeded(tell(&["--undo".as_ref(), &run, &folder.join("untold")]));
    expect_alike(&actions(folder, "run"), &actions(folder, "untold"));
}

#[test]
fn a_policy_that_is_not_told_refuses_what_is_stated_and_so_does_one_that_is_told_other_factors() {
    let (folder, _) = folder();
    for (policy, set, why) in [
        (
            "builtin",
            "env.known.cube_size=1.2",
            "env.known: this policy is not told what is known",
        ),
        (
            "told",
            "env.known.hand_mass=1.2",
            "env.known: `hand_mass` is none of cube_mass, cube_size, damping, friction",
        ),
        (
            "told",
            "env.known.cube_size=0",
            "env.known.cube_size = 0: must be above 0",
        ),
        (
            "told",
            "env.known=1.2",
            "env.known = 1.2: must be a table of numbers by name",
        ),
    ] {
        let refused = program(
            folder.path(),
            &["play", "--ckpt", policy, "--json", "--set", set],
        );
        assert_eq!(refused.status.code(), Some(1), "{set}");
        assert!(stderr(&refused).contains(why), "{}", stderr(&refused));
    }
}

#[test]
fn a_new_policy_is_told_if_any_factor_is_given_and_its_files_say_where_the_values_go() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let new = ["--run-dir", "run", "--total-steps", "256"];
    let given = ["--set", "env.known.friction=1"];
    succeeded(program(folder, &train(&[&new[..], &given].concat())));
    let play = ["play", "--ckpt", "run", "--episodes", "1", "--json"];
    for (policy, size) in [("run", 161), ("builtin", 157)] {
        let trace = ["--ckpt", policy, "--out", "t.jsonl"];
        succeeded(program(folder, &[&play[..1], &trace, &play[3..]].concat()));
        let trace = fs::read_to_string(folder.join("t.jsonl")).unwrap();
        let header: Value = serde_json::from_str(trace.lines().next().unwrap()).unwrap();
        let last = header["observation"].as_array().unwrap().last().unwrap();
        let end = last["start"].as_u64().unwrap() + last["length"].as_u64().unwrap();
        assert_eq!((end, last["name"] == "known"), (size, size == 161));
    }
    let export = ["export", "--ckpt", "run", "--set", "env.known.friction=0.5"];
    succeeded(program(folder, &export));
    let onnx = fs::read(folder.join("policy.onnx")).unwrap();
    let holds = |text: &str| onnx.windows(text.len()).any(|part| part == text.as_bytes());
    assert!(holds("fingertips,previous_action,known"));
    assert!(holds("friction = 0.5"));
    let stated = ["--ckpt", "run", "--out", "t.jsonl"];
    let stated = [&play[..1], &stated, &play[3..], &export[3..]].concat();
    succeeded(program(folder, &stated));
    let check = ["policy.onnx", "--check", "t.jsonl"];
    crate::export::check_in_python(folder, &check);
    let late = ["--set", "env.prediction=2"];
    succeeded(program(folder, &[&export[..], &late].concat()));
    let world = ["--set", "env.friction_scale=0.5"];
    succeeded(program(folder, &[&stated[..], &late, &world].concat()));
    crate::export::check_in_python(folder, &check);
    let other = ["--set", "env.friction_scale=0.7"];
    succeeded(program(folder, &[&export[..], &late, &other].concat()));
    if let Some(python) = crate::export::python() {
        let mut python = Command::new(python);
        python.args([&file("examples/deploy/deploy.py"), &folder.join(check[0])]);
        let refused = python.output().unwrap();
        assert!(
            stderr(&refused).contains("env.friction_scale = 0.7 and env.known.friction = 0.5"),
            "{}",
            stderr(&refused)
        );
    }
}
