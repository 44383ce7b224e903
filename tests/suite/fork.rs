//! `train --fork`: a new run that continues from the checkpoint of another one.

use std::fs;
use std::path::Path;
use std::process::Output;

use crate::support::{SCENE, metrics, program, stderr, succeeded, train, weights};

/// Trains a run of this name for 256 steps, which are two iterations.
fn parent(folder: &Path, name: &str, more: &[&str]) {
    succeeded(program(
        folder,
        &train(&[&["--total-steps", "256", "--run-dir", name], more].concat()),
    ));
}

fn fork(folder: &Path, from: &str, to: &str, more: &[&str]) -> Output {
    program(
        folder,
        &[&["train", "--fork", from, "--run-dir", to], more].concat(),
    )
}

fn config(folder: &Path, run: &str) -> String {
    fs::read_to_string(folder.join(run).join("config.toml")).unwrap()
}

#[test]
fn a_policy_of_a_fork_does_not_tell_the_path_of_its_parent() {
    let folder = tempfile::tempdir().unwrap();
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--run-dir", "secret"]),
    ));
    let fork = [
        "train",
        "--fork",
        "secret",
        "--run-dir",
        "fork",
        "--total-steps",
        "256",
        "--set",
        "run.eval_every=1",
    ];
    succeeded(program(folder.path(), &fork));
    let tells = |file: &str| {
        let bytes = fs::read(folder.path().join("fork").join(file)).unwrap();
        bytes.windows(6).any(|window| window == b"secret")
    };
    assert!(tells("checkpoints/latest.safetensors") && !tells("policy.safetensors"));
}

#[test]
fn a_fork_that_changes_nothing_continues_bit_for_bit() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    parent(folder, "run", &["--seed", "3"]);
    let before = fs::read(folder.join("run/checkpoints/latest.safetensors")).unwrap();
    succeeded(fork(folder, "run", "fork", &["--total-steps", "640"]));
    assert_eq!(
        fs::read(folder.join("run/checkpoints/latest.safetensors")).unwrap(),
        before,
        "the other run is unchanged"
    );
    succeeded(program(
        folder,
        &["train", "--resume", "run", "--total-steps", "640"],
    ));
    let latest = |run: &str| weights(folder.join(run).join("checkpoints/latest.safetensors"));
    assert_eq!(latest("fork"), latest("run"));
    let [fork, run] = ["fork", "run"].map(|name| metrics(&folder.join(name)));
    assert_eq!(
        (&fork[0], &fork[1..]),
        (&run[0], &run[3..]),
        "its rows are those after the fork"
    );
}

#[test]
fn a_fork_goes_on_under_its_own_settings_and_says_where_it_came_from() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    parent(folder, "run", &[]);
    fs::write(
        folder.join("own.toml"),
        "[ppo]\nhorizon = 4\ngamma = 0.9\n[training]\ntolerance.to = 0.2",
    )
    .unwrap();
    let mut sets = vec!["--config", "own.toml", "--total-steps", "384"];
    // Shorter than the episodes in progress.
    sets.extend(
        [
            "env.max_episode_seconds=0.05",
            "env.sim_dt=0.005",
            "env.friction_scale=0.9",
        ]
        .iter()
        .flat_map(|x| ["--set", x]),
    );
    sets.extend(
        [
            "ppo.minibatches=4",
            "ppo.learning_rate=2e-5",
            "ppo.desired_kl=0",
            "run.seed=7",
        ]
        .iter()
        .flat_map(|x| ["--set", x]),
    );
    succeeded(fork(
        folder,
        "run/checkpoints/iteration-00000002.safetensors",
        "fork",
        &sets,
    ));
    let (parent, own) = (config(folder, "run"), config(folder, "fork"));
    let first = own.lines().next().unwrap();
    let from = folder
        .canonicalize()
        .unwrap()
        .join("run/checkpoints/iteration-00000002.safetensors");
    assert_eq!(
        first,
        format!("# Forked from {from:?} after 2 iterations, 256 steps.")
    );
    for set in [
        "horizon = 4.0\n",
        "gamma = 0.9\n",
        "tolerance = { from = 0.4, to = 0.2, steps = 20000000 }",
        "seed = 7",
    ] {
        assert!(own.contains(set) && !parent.contains(set), "{own}");
    }
    assert!(
        own.contains("num_envs = 16") && own.contains("hidden = [16, 8]"),
        "the rest is unchanged: {own}"
    );
    let rows = metrics(&folder.join("fork"));
    let rate = rows[0]
        .iter()
        .position(|name| name == "optim/learning_rate")
        .unwrap();
    assert_eq!(rows[1][..2], ["3", "320"], "both counters continue");
    assert_eq!(rows[1][rate].parse::<f64>().unwrap() as f32, 2e-5);
    // The result is a run like any other.
    succeeded(program(
        folder,
        &["train", "--resume", "fork", "--total-steps", "512"],
    ));
    assert_eq!(config(folder, "fork").lines().next().unwrap(), first);
    succeeded(fork(folder, "fork", "next", &["--total-steps", "640"]));
    let again = config(folder, "next");
    assert!(
        again.starts_with("# Forked from") && again.contains("after 6 iterations, 512 steps"),
        "{again}"
    );
    // A new training with these settings does not mention the fork.
    let args = [
        "train",
        "--config",
        "next/config.toml",
        "--total-steps",
        "64",
        "--run-dir",
        "new",
    ];
    succeeded(program(folder, &args));
    assert!(!config(folder, "new").contains("Forked"));
}

#[test]
fn the_critic_does_not_learn_alone_once_more_in_a_fork_unless_it_was_learning_alone() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let alone = [
        "--set",
        "ppo.critic_first=1",
        "--total-steps",
        "384",
        "--run-dir",
        "run",
        "--keep",
        "9",
    ];
    succeeded(program(
        folder,
        &train(&[&alone[..], &["--set", "run.checkpoint_every=1"]].concat()),
    ));
    for (iteration, left) in [(0, 1), (1, 1), (2, 0)] {
        let (from, to) = (
            format!("run/checkpoints/iteration-0000000{iteration}.safetensors"),
            format!("{iteration}"),
        );
        succeeded(fork(folder, &from, &to, &["--total-steps", "512"]));
        let own = config(folder, &to);
        assert!(
            own.contains(&format!("critic_first = {left}\n")),
            "{iteration}: {own}"
        );
    }
}

#[test]
fn what_sizes_the_saved_state_cannot_be_changed_by_a_fork() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    parent(folder, "run", &[]);
    fs::write(folder.join("own.xml"), SCENE).unwrap();
    let other = SCENE.replacen("size=\".009 .02\"", "size=\".009 .021\"", 1);
    assert!(other != SCENE);
    fs::write(folder.join("other.xml"), other).unwrap();
    for (set, reason) in [
        ("env.num_envs=8", "env.num_envs = 8: a fork keeps 16"),
        (
            "ppo.symmetry=none",
            "ppo.symmetry = none: a fork keeps object",
        ),
        (
            "ppo.activation=tanh",
            "ppo.activation = tanh: a fork keeps elu",
        ),
        ("env.model=other.xml", "not the scene of the checkpoint"),
        (
            "ppo.hidden=[16,9]",
            "ppo.hidden = [16,9]: a fork keeps [16,8]",
        ),
        (
            "run.total_steps=256",
            "run.total_steps = 256: the checkpoint is at step 256 already",
        ),
        ("ppo.horizont=4", "did you mean ppo.horizon?"),
    ] {
        let refused = fork(
            folder,
            "run",
            "fork",
            &["--set", "run.total_steps=512", "--set", set],
        );
        assert_eq!(refused.status.code(), Some(1), "{set}");
        assert!(
            stderr(&refused).contains(reason),
            "{set}: {}",
            stderr(&refused)
        );
        assert!(
            !folder.join("fork").exists(),
            "{set}: nothing is left behind"
        );
    }
    for (from, reason) in [
        ("builtin", "--init builtin"),
        ("run/policy.safetensors", "a policy alone"),
        ("nowhere", "nowhere"),
    ] {
        let refused = fork(folder, from, "fork", &["--total-steps", "512"]);
        assert_eq!(refused.status.code(), Some(1), "{from}");
        assert!(
            stderr(&refused).contains(reason),
            "{from}: {}",
            stderr(&refused)
        );
    }
    // The same scene under another name is still the same scene.
    parent(folder, "own-run", &["--set", "env.model=own.xml"]);
    let unnamed = fork(folder, "own-run", "fork", &["--total-steps", "512"]);
    assert!(
        stderr(&unnamed).contains("no path in a file is followed"),
        "{}",
        stderr(&unnamed)
    );
    fs::rename(folder.join("own.xml"), folder.join("moved.xml")).unwrap();
    succeeded(fork(
        folder,
        "own-run",
        "fork",
        &["--total-steps", "384", "--set", "env.model=moved.xml"],
    ));
}
