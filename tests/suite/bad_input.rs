//! User errors: one clear message, exit code 1 (2 for the command line itself), nothing overwritten.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use shadow_repose::ppo::{Array, Checkpoint};

use crate::support::{OBSERVATION_SIZE, names, program, stderr, succeeded, train};

/// Fails unless the program exits with `code` and prints each of `parts` on stderr.
#[track_caller]
fn refused(folder: &Path, args: &[&str], code: i32, parts: &[&str]) {
    let output = program(folder, args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{args:?}\n{said}");
    assert!(output.stdout.is_empty());
    for part in parts {
        assert!(said.contains(part), "{part:?} is not in\n{said}");
    }
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn settings_that_cannot_be_are_named_all_at_once() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("my.toml"),
        "[ppo]\nlearningrate = 1\nhorizon = \"long\"\n[env]\nnum_envs = 0\n",
    )
    .unwrap();
    let args = [
        "train",
        "--config",
        "my.toml",
        "--set",
        "ppo.gamma=1.5",
        "--set",
        "env.ctrl_dt=0.015",
    ];
    refused(
        folder.path(),
        &args,
        1,
        &[
            "my.toml",
            "ppo.learningrate: unknown key; did you mean ppo.learning_rate?",
            "ppo.horizon = \"long\": must be a number, or { from = …",
            "env.num_envs = 0: must be at least 1",
            "ppo.gamma = 1.5: must lie in [0, 1]",
            "env.ctrl_dt = 0.015: must be a whole multiple of env.sim_dt = 0.01",
        ],
    );
    refused(
        folder.path(),
        &["train", "--set", "ppo.minibatches=7"],
        1,
        &["must divide num_envs * horizon = 16384"],
    );
    refused(
        folder.path(),
        &["bench", "--set", "ppo.minibatches=7"],
        1,
        &["must divide"],
    );
    let words = [
        "train",
        "--set",
        "ppo.activation=gelu",
        "--set",
        "env.success_hold=x",
        "--set",
        "ppo.gamma=2",
    ];
    let parts = [
        "ppo.activation = \"gelu\": unknown variant",
        "`tanh`",
        "env.success_hold = \"x\"",
        "ppo.gamma = 2",
    ];
    refused(folder.path(), &words, 1, &parts);
    let deep = format!("{}=1", ["a"; 60_000].join("."));
    refused(
        folder.path(),
        &["train", "--set", &deep],
        1,
        &["unknown key"],
    );
    assert!(!folder.path().join("runs").exists(), "nothing is started");
}

#[test]
fn bf16_that_the_processor_lacks_is_refused_before_anything_is_begun() {
    let folder = tempfile::tempdir().unwrap();
    let bf16 = [
        "--set",
        "ppo.precision=bf16",
        "--set",
        "env.num_envs=4",
        "--set",
        "ppo.hidden=[8]",
    ];
    let output = program(
        folder.path(),
        &[&["bench", "--only", "learner"], &bf16[..]].concat(),
    );
    if !output.status.success() {
        let parts = [
            "ppo.precision = \"bf16\"",
            "\"f32\"",
            "(AMX)",
            "(AVX-512 BF16)",
        ];
        assert!(
            parts.iter().all(|part| stderr(&output).contains(part)),
            "{}",
            stderr(&output)
        );
        refused(folder.path(), &[&["train"], &bf16[..]].concat(), 1, &parts);
        assert!(!folder.path().join("runs").exists(), "nothing is started");
    }
    let both = [
        "train",
        "--set",
        "ppo.precision=bf16-rounded",
        "--set",
        "ppo.backend=candle",
    ];
    refused(
        folder.path(),
        &both,
        1,
        &["ppo.precision = \"bf16-rounded\": must be \"f32\" with ppo.backend"],
    );
}

#[test]
fn files_that_are_missing_or_no_configurations_are_named() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("broken.toml"), "[env\n").unwrap();
    refused(
        folder.path(),
        &["train", "--config", "absent.toml"],
        1,
        &["absent.toml"],
    );
    refused(
        folder.path(),
        &["train", "--config", "."],
        1,
        &["cannot read ."],
    );
    refused(
        folder.path(),
        &["train", "--config", "broken.toml"],
        1,
        &["broken.toml", "not a TOML file"],
    );
    refused(
        folder.path(),
        &["train", "--set", "env.model=absent.xml"],
        1,
        &["absent.xml"],
    );
    refused(
        folder.path(),
        &["train", "--resume", "absent"],
        1,
        &["absent"],
    );
    refused(
        folder.path(),
        &["play", "--ckpt", "absent.safetensors"],
        1,
        &["absent.safetensors"],
    );
    fs::create_dir(folder.path().join("empty")).unwrap();
    refused(
        folder.path(),
        &["play", "--ckpt", "empty"],
        1,
        &["empty holds no checkpoint"],
    );
    refused(
        folder.path(),
        &["train", "--resume", "empty"],
        1,
        &["empty holds no checkpoint"],
    );
    assert_eq!(
        fs::read_dir(folder.path().join("empty")).unwrap().count(),
        0
    );
}

#[test]
fn checkpoints_that_are_damaged_or_of_something_else_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let good = fs::read(folder.path().join("run/checkpoints/latest.safetensors")).unwrap();
    let write = |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).unwrap();
    write("cut.safetensors", &good[..good.len() - 100]);
    write("text.safetensors", b"hello");
    let mut flipped = good.clone();
    flipped[good.len() - 77] ^= 4;
    write("flipped.safetensors", &flipped);
    // Intact, but its configuration describes a wider net.
    let mut wider = Checkpoint::parse(&good).unwrap();
    wider.config = wider.config.replace("hidden = [16, 8]", "hidden = [17, 8]");
    write("wider.safetensors", &wider.to_bytes().unwrap());
    for (file, parts) in [
        (
            "cut.safetensors",
            &["cannot use cut.safetensors", "cut off"][..],
        ),
        ("text.safetensors", &["text.safetensors"]),
        ("flipped.safetensors", &["damaged", "checksum"]),
        ("wider.safetensors", &["`actor.0.weight`", "[16, ", "[17, "]),
        (
            "/dev/zero",
            &["cannot read /dev/zero", "not a regular file"],
        ),
    ] {
        refused(folder.path(), &["play", "--ckpt", file], 1, parts);
    }
    refused(
        folder.path(),
        &["train", "--resume", "cut.safetensors"],
        1,
        &["does not lie in the checkpoints folder"],
    );
}

#[test]
fn a_checkpoint_that_was_made_to_harm_can_only_be_refused() {
    let folder = tempfile::tempdir().unwrap();
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let path = folder.path().join("run/checkpoints/latest.safetensors");
    let good = Checkpoint::parse(&fs::read(&path).unwrap()).unwrap();
    let rows = |name: &str| good.shape(name).unwrap().to_vec();
    let [numbers, counters] = ["envs.numbers", "envs.counters"].map(rows);
    let huge = Array::U64(counters.clone(), vec![u64::MAX; counters[0] * counters[1]]);
    let short = Array::F64(vec![numbers[0], 3], vec![0.5; numbers[0] * 3]);
    let set = |name: &'static str, array: &Array| {
        let mut bad = good.clone();
        bad.insert(name, array.clone());
        bad
    };
    let config = |from: &str, to: &str| {
        let mut bad = good.clone();
        bad.config = good.config.replace(from, to);
        assert_ne!(bad.config, good.config, "{from}");
        bad
    };
    let alone = good.policy_alone();
    let mut behind = good.clone();
    behind.progress.iteration = u64::MAX;
    for (bad, part) in [
        (set("envs.counters", &huge), "environment 0"),
        (set("envs.numbers", &short), "environment 0"),
        (
            set("envs.numbers", &Array::F64(vec![1], vec![0.0])),
            "the states of 1 environments, expected 16",
        ),
        (
            set("learning_rate", &Array::F64(vec![1], vec![-1.0])),
            "its learning rate is -1",
        ),
        (
            set("adam.steps", &Array::U64(vec![1], vec![u64::MAX])),
            "`adam.steps`",
        ),
        (
            set(
                "normalizer.variance",
                &Array::F64(vec![OBSERVATION_SIZE], vec![-1.0; OBSERVATION_SIZE]),
            ),
            "`normalizer.variance`",
        ),
        (
            set("log_std", &Array::F64(vec![20], vec![1.0; 20])),
            "`log_std` must be of type F32",
        ),
        (
            set("extra", &Array::U64(vec![1], vec![1])),
            "`extra` is not part of this policy",
        ),
        (
            config("num_envs = 16", "num_envs = 32"),
            "cannot have made 128 steps",
        ),
        (
            config("hidden = [16, 8]", "hidden = [16384, 16384, 8]"),
            "at most 2^25 weights",
        ),
        (
            config("model = \"builtin\"", "model = \"/etc/passwd\""),
            "no path in a file is followed",
        ),
        (config("ctrl_dt = 0.01", "ctrl_dt = 1e300"), "ctrl_dt"),
        (behind, "cannot have made"),
        (alone, "a policy alone, which can be played but not resumed"),
    ] {
        fs::write(&path, bad.to_bytes().unwrap()).unwrap();
        let checkpoint = path.display().to_string();
        refused(
            folder.path(),
            &["train", "--resume", &checkpoint, "--total-steps", "999"],
            1,
            &["latest.safetensors", part],
        );
    }
}

#[test]
fn a_folder_that_holds_a_run_is_neither_taken_nor_changed() {
    let folder = tempfile::tempdir().unwrap();
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let before = fs::read(folder.path().join("run/metrics.csv")).unwrap();
    refused(
        folder.path(),
        &train(&["--run-dir", "run"]),
        1,
        &["already holds a run"],
    );
    assert_eq!(
        before,
        fs::read(folder.path().join("run/metrics.csv")).unwrap()
    );
}

#[test]
fn files_of_something_else_are_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["metrics.csv", "version.txt", "config.toml"] {
        let path = folder.path().join(name);
        fs::write(&path, "mine").unwrap();
        refused(
            folder.path(),
            &train(&["--run-dir", "."]),
            1,
            &["already holds a run"],
        );
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
        fs::remove_file(path).unwrap();
    }
}

#[test]
fn a_training_that_fails_names_the_iteration_and_leaves_the_last_checkpoint_intact() {
    let folder = tempfile::tempdir().unwrap();
    let settings = [
        "ppo.learning_rate=1e30",
        "ppo.desired_kl=0",
        "run.checkpoint_every=1",
    ];
    let mut args = train(&["--run-dir", "run"]);
    settings
        .iter()
        .for_each(|setting| args.extend(["--set", setting]));
    refused(
        folder.path(),
        &args,
        1,
        &["iteration 1", "the training run has failed"],
    );
    succeeded(program(
        folder.path(),
        &["play", "--ckpt", "run", "--episodes", "1"],
    ));
}

#[test]
fn a_trace_that_cannot_be_written_is_refused_before_playing_and_a_device_is_written_to() {
    let folder = tempfile::tempdir().unwrap();
    let play = |trace: &'static str| ["play", "--ckpt", "zero", "--episodes", "1", "--out", trace];
    refused(
        folder.path(),
        &play("absent/t.jsonl"),
        1,
        &["cannot write absent/t.jsonl"],
    );
    succeeded(program(folder.path(), &play("jsonl:/dev/null")));
    assert!(!fs::metadata("/dev/null").unwrap().is_file());
}

#[test]
fn a_run_folder_that_cannot_be_written_to_is_an_error_before_anything_is_trained() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("file"), "").unwrap();
    refused(
        folder.path(),
        &train(&["--run-dir", "file/run"]),
        1,
        &["cannot create the folder file/run"],
    );
    // Permissions do not stop root, who may be running the tests.
    let locked = folder.path().join("locked");
    fs::create_dir(&locked).unwrap();
    fs::set_permissions(&locked, fs::Permissions::from_mode(0o555)).unwrap();
    if fs::write(locked.join("probe"), "").is_err() {
        refused(
            folder.path(),
            &train(&["--run-dir", "locked/run"]),
            1,
            &["cannot create the run folder"],
        );
    }
}

#[test]
fn usage_errors_exit_with_2() {
    let folder = tempfile::tempdir().unwrap();
    for args in [
        &["fly"][..],
        &["train", "--sed", "1"],
        &["train", "--set", "ppo.gamma"],
        &["train", "--total-steps", "many"],
        &["train", "--resume", "run", "--seed", "1"],
        &["train", "--keep", "0"],
        &["train", "--stop-after", "soon"],
        &["train", "--stop-after", "0s"],
        &["train", "--stop-after", "3-4h"],
        &["train", "--name", "a", "--run-dir", "b"],
        &["play", "--out", "x.pdf"],
        &[
            "play", "--ckpt", "zero", "--out", "x.html", "--out", "y.html",
        ],
        &["view", "--out", "x.html"],
        &["plot", "run", "--out", "x.gif"],
        &["play", "--episodes", "0"],
        &["play", "--threads", "5000"],
        &["train", "--seed", "18446744073709551615"],
    ] {
        refused(folder.path(), args, 2, &["--help"]);
    }
    // Options that would have no effect.
    refused(
        folder.path(),
        &["play", "--ckpt", "zero", "--headless", "--size", "64x64"],
        2,
        &["--size cannot be used with a score", "only to a film"],
    );
    refused(
        folder.path(),
        &["play", "--ckpt", "zero", "--json", "--plain"],
        2,
        &["--plain cannot be used with a score", "an HTML file"],
    );
    refused(
        folder.path(),
        &["play", "--ckpt", "zero", "--set", "ppo.gamma=0.5"],
        1,
        &["`play` does not use ppo.gamma"],
    );
    refused(
        folder.path(),
        &["train", "--resume", "run", "--set", "ppo.gamma=1"],
        1,
        &["no such run folder"],
    );
    refused(
        folder.path(),
        &["train", "--name", "../x"],
        1,
        &["the name ../x of a run"],
    );
    // Who needs no policy is none.
    let none = "`zero` acts without a policy; a file or folder of that name is ./zero";
    for args in [&["export"][..], &["play", "--web", "0", "--follow"]] {
        refused(
            folder.path(),
            &[args, &["--ckpt", "zero"]].concat(),
            1,
            &[none],
        );
    }
    refused(folder.path(), &["train", "--init", "zero"], 1, &[none]);
    refused(
        folder.path(),
        &["play", "--ckpt", "random", "--stochastic"],
        1,
        &["--stochastic samples from a policy"],
    );
    refused(folder.path(), &["play", "--ckpt", "./zero"], 1, &["./zero"]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Writes a copy of the built-in policy in which the weights of this tensor overflow.
fn write_overflowing(tensor: &str, path: &Path) {
    let bytes = include_bytes!("../../assets/policies/repose.safetensors");
    let header = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    let facts: serde_json::Value = serde_json::from_slice(&bytes[8..8 + header]).unwrap();
    let offset =
        |i: usize| 8 + header + facts[tensor]["data_offsets"][i].as_u64().unwrap() as usize;
    let mut bytes = bytes.to_vec();
    for (i, weight) in bytes[offset(0)..offset(1)].chunks_exact_mut(4).enumerate() {
        let large = if i % 2 == 0 { 3e38_f32 } else { -3e38 };
        weight.copy_from_slice(&large.to_le_bytes());
    }
    fs::write(path, shadow_repose::ppo::sealed(&bytes).unwrap()).unwrap();
}

#[test]
fn a_policy_whose_values_overflow_is_refused_where_training_begins_with_it() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    write_overflowing("critic.0.weight", &folder.join("p.safetensors"));
    let init = [
        "--init",
        "p.safetensors",
        "--run-dir",
        "run",
        "--set",
        "ppo.hidden=[512,256,128]",
    ];
    refused(
        folder,
        &train(&init),
        1,
        &["the values of the policy are not finite"],
    );
    assert_eq!(names(folder), ["p.safetensors"]);
    // Playing needs no values.
    succeeded(program(
        folder,
        &[
            "play",
            "--ckpt",
            "p.safetensors",
            "--headless",
            "--episodes",
            "1",
        ],
    ));
}

#[test]
fn a_policy_whose_actions_overflow_is_named_as_such_by_every_command() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    write_overflowing("actor.0.weight", &folder.join("p.safetensors"));
    for args in [
        &[
            "play",
            "--ckpt",
            "p.safetensors",
            "--headless",
            "--episodes",
            "2",
        ][..],
        &["export", "--ckpt", "p.safetensors"],
        &train(&[
            "--init",
            "p.safetensors",
            "--run-dir",
            "run",
            "--set",
            "ppo.hidden=[512,256,128]",
        ]),
    ] {
        let output = program(folder, args);
        assert_eq!(
            output.status.code(),
            Some(1),
            "{args:?}: {}",
            stderr(&output)
        );
        assert!(
            stderr(&output).contains("actions of the policy are not finite"),
            "{args:?}: {}",
            stderr(&output)
        );
    }
    assert_eq!(names(folder), ["p.safetensors"]);
}

#[test]
fn what_comes_from_a_foreign_file_is_quoted_in_a_hundred_characters() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let long = "9".repeat(200_000);
    let configs = [
        format!("[run]\nseed = {long}\n"),
        format!("a = {}", "[".repeat(10_000)),
        format!("{}\n", "[[env]]\n".repeat(1000)),
        format!("[ppo]\nactivation = \"{long}\"\n"),
        format!("[ppo]\nhidden = [{}]\n", "1.5,".repeat(10_000)),
        format!("[env]\ngoal_position = [{}]\n", "1,".repeat(10_000)),
        format!("[env]\n{long} = 1\n"),
        format!("[env.noise]\n{long} = -1\n"),
        format!("[env.noise]\n{long} = 1\n"),
    ];
    for text in configs {
        fs::write(folder.join("own.toml"), &text).unwrap();
        let output = program(folder, &["train", "--config", "own.toml"]);
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.len() < 2000,
            "{}: {} bytes",
            &text[..30],
            said.len()
        );
    }
    let (mut texts, mut names) = (std::collections::HashMap::new(), Vec::new());
    for (key, name) in [("checksum", "a"), ("other", "a"), ("checksum", &long[..])] {
        texts.clear();
        names.clear();
        texts.insert(key.to_owned(), long.clone());
        let view =
            safetensors::tensor::TensorView::new(safetensors::tensor::Dtype::I8, vec![1], &[0])
                .unwrap();
        names.push((name.to_owned(), view));
        let bytes = safetensors::serialize(names.clone(), Some(texts.clone())).unwrap();
        fs::write(folder.join("p.safetensors"), bytes).unwrap();
        let output = program(folder, &["play", "--ckpt", "p.safetensors", "--headless"]);
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.len() < 1000,
            "{} bytes",
            said.len()
        );
    }
}

#[test]
fn the_policy_that_a_training_begins_with_is_not_replaced_by_its_own() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    fs::create_dir(folder.join("half")).unwrap();
    fs::copy(
        folder.join("run/policy.safetensors"),
        folder.join("half/policy.safetensors"),
    )
    .unwrap();
    fs::write(folder.join("half/run.lock"), "").unwrap();
    std::os::unix::fs::symlink("half/policy.safetensors", folder.join("link")).unwrap();
    for init in ["half/policy.safetensors", "link"] {
        let args = train(&["--init", init, "--run-dir", "half", "--total-steps", "128"]);
        refused(
            folder,
            &args,
            1,
            &["half/policy.safetensors: would replace the policy that the run starts from"],
        );
    }
    assert_eq!(
        names(&folder.join("half")),
        ["policy.safetensors", "run.lock"]
    );
    succeeded(program(
        folder,
        &train(&["--init", "run", "--run-dir", "half", "--total-steps", "128"]),
    ));
}

#[test]
fn numbers_that_the_learner_would_take_for_0_or_infinity_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (set, told) in [
        ("ppo.std=1e-320", "ppo.std = "),
        ("ppo.std.to=1e-50", "ppo.std = "),
        ("ppo.clip=1e-320", "ppo.clip = "),
        ("ppo.reward_scale=1e-60", "ppo.reward_scale = "),
        (
            "ppo.learning_rate_range=[1e-90,1]",
            "ppo.learning_rate_range = ",
        ),
        ("training.hold_reward=1e-60", "training.hold_reward = "),
        ("env.rot_reward_scale=-1e-60", "env.rot_reward_scale = "),
        ("env.noise.joint_pos=1e-60", "env.noise = "),
    ] {
        refused(
            folder.path(),
            &["train", "--set", set],
            1,
            &[told, "must be 0, or at least 1e-37 in magnitude"],
        );
    }
    let told = "ppo.away_std = 1e308: must be at most 1e38 in magnitude";
    refused(
        folder.path(),
        &["train", "--set", "ppo.away_std=1e308"],
        1,
        &[told],
    );
    assert_eq!(names(folder.path()), [""; 0]);
}

#[test]
fn what_a_policy_or_a_scene_says_is_cut_to_a_hundred_characters() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let long = "9".repeat(50_000);
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let good =
        Checkpoint::parse(&fs::read(folder.join("run/policy.safetensors")).unwrap()).unwrap();
    let mut odd = [good.clone(), good.clone()];
    odd[0].insert("actor.0.weight", Array::F32(vec![1; 50_000], vec![0.0]));
    odd[1].config = good
        .config
        .replace("model = \"builtin\"", &format!("model = \"{long}\""));
    let mut files: Vec<Vec<u8>> = odd.iter().map(|odd| odd.to_bytes().unwrap()).collect();
    let bytes = good.to_bytes().unwrap();
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    let mut texts = header.metadata().clone().unwrap();
    texts.insert("progress".into(), format!("{{\"{long}\": 1}}"));
    let tensors = safetensors::SafeTensors::deserialize(&bytes)
        .unwrap()
        .tensors();
    files.push(
        shadow_repose::ppo::sealed(&safetensors::serialize(tensors, Some(texts)).unwrap()).unwrap(),
    );
    let brief = |args: &[&str], told: &str| {
        let output = program(folder, args);
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.len() < 700 && said.contains(told),
            "{told}: {} bytes",
            said.len()
        );
    };
    for (bytes, told) in files.iter().zip([
        "has the shape [1, 1",
        "env.model = 999",
        "`progress`: unknown field `999",
    ]) {
        fs::write(folder.join("p.safetensors"), bytes).unwrap();
        brief(&["play", "--ckpt", "p.safetensors", "--headless"], told);
    }
    fs::write(
        folder.join("own.toml"),
        format!("[env]\nmodel = \"{long}\"\n"),
    )
    .unwrap();
    brief(&["train", "--config", "own.toml"], "env.model = 999");
    let named = format!("env.model={}.xml", "9".repeat(250));
    let scene = crate::support::SCENE.replacen(
        "name=\"cube\" type=\"box\"",
        &format!("name=\"{long}\" type=\"box\""),
        1,
    );
    fs::write(
        folder.join("s.xml"),
        scene.replacen("friction=\"1.2\"", "friction=\"nan\"", 1),
    )
    .unwrap();
    brief(
        &[
            "play",
            "--ckpt",
            "zero",
            "--set",
            "env.model=s.xml",
            "--headless",
        ],
        "s.xml: a name in it is not UTF-8, or has more than 255 bytes",
    );
    // The path that a user names stays whole.
    brief(
        &["play", "--ckpt", "zero", "--set", &named, "--headless"],
        &named[10..],
    );
}
