//! The program itself, as a user runs it.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use shadow_repose::ppo::Checkpoint;

use crate::support::{
    OBSERVATION_SIZE, metrics, must_be_possible, names, program, stderr, succeeded, train, weights,
};

/// Returns a folder with a finished run of two iterations in `run`.
fn trained(more: &[&str]) -> tempfile::TempDir {
    trained_for("256", more)
}

fn trained_for(steps: &str, more: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut args = train(&["--total-steps", steps, "--run-dir", "run"]);
    args.extend(more);
    succeeded(program(folder.path(), &args));
    folder
}

fn json(output: &std::process::Output) -> Value {
    serde_json::from_slice(&output.stdout).expect("stdout is one JSON object and nothing else")
}

#[test]
fn a_training_leaves_its_files_and_nothing_else() {
    let folder = trained(&[]);
    assert_eq!(
        names(folder.path()),
        ["run"],
        "no MUJOCO_LOG.TXT, nothing beside the run"
    );
    let run = folder.path().join("run");
    let found = names(&run);
    assert!(found[2].starts_with("events.out.tfevents."), "{found:?}");
    let expected = [
        "checkpoints",
        "config.toml",
        "finished",
        "hparams",
        "metrics.csv",
        "policy.safetensors",
        "run.lock",
        "version.txt",
    ];
    assert_eq!([&found[..2], &found[3..]].concat(), expected);
    let checkpoints = ["best", "iteration-00000000", "iteration-00000002", "latest"]
        .map(|name| format!("{name}.safetensors"));
    assert_eq!(names(&run.join("checkpoints")), checkpoints);
    assert!(
        fs::read_to_string(run.join("version.txt"))
            .unwrap()
            .contains("mujoco 3.17.0")
    );
    let config: toml::Table = fs::read_to_string(run.join("config.toml"))
        .unwrap()
        .parse()
        .unwrap();
    assert_eq!(config["env"]["num_envs"].as_integer(), Some(16));
    assert_eq!(
        config["run"]["shards"].as_integer(),
        Some(16),
        "the number that was chosen"
    );
    assert_eq!(
        config["env"]["reach_goal_bonus"].as_float(),
        Some(2.0),
        "the resolved configuration is complete"
    );
    let rows = metrics(&run);
    assert_eq!(rows.len(), 3);
    for column in [
        "iteration",
        "env_steps",
        "reward/rotation",
        "reward/fall",
        "episode/goals",
        "policy/kl",
        "eval/goals",
    ] {
        assert!(rows[0].iter().any(|name| name == column), "{column}");
    }
    assert_eq!(rows[2][..2], ["2", "256"]);
}

#[test]
fn a_checkpoint_alone_is_played_from_anywhere_and_the_score_is_json() {
    let folder = trained(&[]);
    let elsewhere = tempfile::tempdir().unwrap();
    fs::copy(
        folder.path().join("run/checkpoints/best.safetensors"),
        elsewhere.path().join("it.safetensors"),
    )
    .unwrap();
    let args = [
        "play",
        "--ckpt",
        "it.safetensors",
        "--episodes",
        "5",
        "--json",
    ];
    let score = json(&succeeded(program(elsewhere.path(), &args)));
    assert_eq!(score["episodes"], 5);
    assert_eq!(score["checkpoint"], "it.safetensors");
    // 20 steps at most: the configuration came with the file.
    assert!(score["episode_length"].as_f64().unwrap() <= 20.0);
    assert_eq!(names(elsewhere.path()), ["it.safetensors"]);
}

#[test]
fn the_newest_run_is_played_by_default_and_the_table_compares_it_with_zero_actions() {
    let folder = tempfile::tempdir().unwrap();
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--name", "mine"]),
    ));
    let runs = names(&folder.path().join("runs/shadow-hand-repose"));
    assert!(runs.len() == 1 && runs[0].ends_with("-mine"), "{runs:?}");
    let output = succeeded(program(
        folder.path(),
        &["play", "--episodes", "3", "--headless"],
    ));
    let table = String::from_utf8(output.stdout).unwrap();
    for part in [
        "zero actions",
        "goals per episode",
        "drop rate",
        "best.safetensors",
    ] {
        assert!(table.contains(part), "{part} is not in\n{table}");
    }
}

#[test]
fn where_there_is_no_run_the_built_in_policy_is_played_and_turns_the_cube() {
    let folder = tempfile::tempdir().unwrap();
    let args = ["play", "--episodes", "32", "--json"];
    let score = json(&succeeded(program(folder.path(), &args)));
    assert_eq!(score["checkpoint"], "built into the program");
    // 5.8 are expected, with a standard error of 0.3. A hand that hovers beside its goals, or holds still, reaches none.
    assert!(
        score["goals_per_episode"].as_f64().unwrap() > 1.5,
        "{score}"
    );
    assert!(score["drop_rate"].as_f64().unwrap() < 0.4, "{score}");
    assert!(include_bytes!("../../assets/policies/repose.safetensors").len() < 4 << 20);
    assert!(names(folder.path()).is_empty());
}

#[test]
fn the_built_in_policy_can_be_named_where_there_are_runs_and_be_begun_with() {
    let folder = tempfile::tempdir().unwrap();
    let small = [
        "env.num_envs=16",
        "ppo.minibatches=4",
        "ppo.horizon=8",
        "run.eval_episodes=1",
    ];
    let mut args = vec![
        "train",
        "--init",
        "builtin",
        "--total-steps",
        "128",
        "--keep",
        "9",
    ];
    small.iter().for_each(|set| args.extend(["--set", set]));
    succeeded(program(folder.path(), &args));
    let play = ["play", "--ckpt", "builtin", "--episodes", "1", "--json"];
    assert_eq!(
        json(&succeeded(program(folder.path(), &play)))["checkpoint"],
        "built into the program"
    );
    let run = names(&folder.path().join("runs/shadow-hand-repose")).remove(0);
    let checkpoints = folder
        .path()
        .join("runs/shadow-hand-repose")
        .join(run)
        .join("checkpoints");
    let begun = names(&checkpoints)
        .into_iter()
        .find(|name| name == "iteration-00000000.safetensors")
        .unwrap();
    let actor = |path: PathBuf| {
        weights(path)
            .into_iter()
            .find(|(name, _)| name == "actor.0.weight")
            .unwrap()
    };
    let built_in = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/policies/repose.safetensors");
    assert_eq!(actor(checkpoints.join(begun)), actor(built_in));
}

#[test]
fn a_training_can_begin_with_the_policy_of_another_if_it_fits() {
    let folder = trained(&[]);
    let args = train(&[
        "--run-dir",
        "on",
        "--init",
        "run",
        "--total-steps",
        "128",
        "--seed",
        "9",
        "--keep",
        "9",
    ]);
    succeeded(program(folder.path(), &args));
    let of = |path: &str, name: &str| {
        let all = weights(folder.path().join(path));
        all.into_iter()
            .find(|(found, _)| found == name)
            .expect("the tensor exists")
            .1
    };
    let begun = names(&folder.path().join("on/checkpoints"))
        .into_iter()
        .find(|name| name.starts_with("iteration"));
    let begun = format!("on/checkpoints/{}", begun.unwrap());
    assert_eq!(
        of(&begun, "actor.0.weight"),
        of("run/checkpoints/best.safetensors", "actor.0.weight")
    );
    assert!(of(&begun, "adam.steps").iter().all(|&byte| byte == 0));
    let other = train(&[
        "--run-dir",
        "other",
        "--init",
        "run",
        "--set",
        "ppo.symmetry=none",
    ]);
    let refused = program(folder.path(), &other);
    assert!(
        !refused.status.success() && stderr(&refused).contains("symmetry"),
        "{}",
        stderr(&refused)
    );
    assert!(!folder.path().join("other").exists(), "nothing is started");
}

#[test]
fn scores_do_not_depend_on_threads_or_on_how_many_episodes_are_asked_for() {
    let folder = trained(&[]);
    let play = |threads: &str, episodes: &str, more: &[&str]| {
        let trace = format!("trace-{threads}-{episodes}.jsonl");
        let mut args = vec![
            "play",
            "--ckpt",
            "run",
            "--json",
            "--threads",
            threads,
            "--episodes",
            episodes,
        ];
        args.extend(["--out", &trace]);
        args.extend(more);
        let score = json(&succeeded(program(folder.path(), &args)));
        (
            score,
            fs::read_to_string(folder.path().join(trace)).unwrap(),
        )
    };
    for more in [&[][..], &["--stochastic"]] {
        let (one, one_trace) = play("1", "70", more);
        let (four, four_trace) = play("4", "70", more);
        assert_eq!(one, four);
        assert!(one_trace == four_trace);
        let (_, fewer) = play("2", "3", more);
        let whole: Vec<&str> = one_trace.lines().collect();
        let part: Vec<&str> = fewer.lines().collect();
        assert_eq!(
            whole[..part.len()],
            part[..],
            "the first episodes are the same"
        );
    }
}

#[test]
fn the_trace_holds_whole_episodes_in_order_until_there_are_enough_records() {
    let folder = trained(&[]);
    let args = [
        "play",
        "--ckpt",
        "run",
        "--episodes",
        "150",
        "--json",
        "--out",
        "t.jsonl",
    ];
    succeeded(program(folder.path(), &args));
    let text = fs::read_to_string(folder.path().join("t.jsonl")).unwrap();
    let lines: Vec<Value> = text
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let mut header: Vec<&str> = lines[0]
        .as_object()
        .unwrap()
        .keys()
        .map(String::as_str)
        .collect();
    let expected = "sim_dt ctrl_dt act_moving_average success_tolerance max_consecutive_successes max_episode_steps model goal_position \
                    friction_scale cube_mass_scale checkpoint observation joint_names actuator_names fingertip_names \
                    quaternion_order vel_obs_scale mirror_matrix hand_mass_scale cube_size_scale gains_scale damping_scale \
                    frictionloss_scale cube_com gravity cone action_delay prediction predicted_with noise bias actor seed settings \
                    warnings";
    let mut expected: Vec<&str> = expected.split_whitespace().collect();
    header.sort_unstable();
    expected.sort_unstable();
    assert_eq!(header, expected);
    let part = serde_json::json!({ "name": "cube_angvel", "start": 58, "length": 3, "unit": "rad/s * vel_obs_scale" });
    assert_eq!(
        (&lines[0]["observation"][5], &lines[0]["quaternion_order"]),
        (&part, &Value::from("wxyz"))
    );
    let names = |key: &str| {
        lines[0][key]
            .as_array()
            .unwrap()
            .iter()
            .map(|name| name.as_str().unwrap())
            .collect()
    };
    let (joints, actuators): (Vec<&str>, Vec<&str>) =
        (names("joint_names"), names("actuator_names"));
    assert_eq!(
        (joints.len(), joints[0], joints[23]),
        (24, "rh_THJ5", "rh_WRJ1")
    );
    assert_eq!(
        (actuators.len(), actuators[7], actuators[19]),
        (20, "rh_A_FFJ0", "rh_A_WRJ1")
    );
    assert_eq!(lines[0]["fingertip_names"][4], "rh_thdistal");
    let records = &lines[1..];
    // Episodes have 21 records: 96 of them are enough, and the 97th is left out.
    assert!(
        (2000..2025).contains(&records.len()),
        "{} records",
        records.len()
    );
    let (mut episode, mut step) = (0, 0);
    for (i, record) in records.iter().enumerate() {
        if record["reset"] == true && i > 0 {
            assert!(records[i - 1]["terminated"] == true || records[i - 1]["truncated"] == true);
            (episode, step) = (episode + 1, 0);
        }
        assert_eq!(
            (record["episode"].as_u64(), record["step"].as_u64()),
            (Some(episode), Some(step))
        );
        assert_eq!(record["obs"].as_array().unwrap().len(), OBSERVATION_SIZE);
        assert_eq!(record["qpos"].as_array().unwrap().len(), 31);
        if step > 0 {
            let terms = record["reward"].as_object().unwrap();
            let sum: f64 = ["rotation", "distance", "action", "bonus", "fall"]
                .map(|t| terms[t].as_f64().unwrap())
                .iter()
                .sum();
            assert_eq!(terms["total"].as_f64().unwrap(), sum);
            assert_eq!(record["ctrl"].as_array().unwrap().len(), 20);
        }
        step += 1;
    }
    assert!(
        records[records.len() - 1]["truncated"] == true
            || records[records.len() - 1]["terminated"] == true
    );
}

#[test]
fn baselines_need_no_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    for policy in ["zero", "random", "wave"] {
        let args = [
            "play",
            "--ckpt",
            policy,
            "--episodes",
            "4",
            "--json",
            "--set",
            "env.max_episode_seconds=0.1",
        ];
        let score = json(&succeeded(program(folder.path(), &args)));
        assert!(score["checkpoint"].is_null());
        assert_eq!(score["episode_length"], 10.0, "--set changes the task");
    }
}

#[test]
fn the_same_seed_trains_the_same_policy_on_any_number_of_threads() {
    // Twenty iterations.
    let runs: Vec<_> = ["1", "2", "3", "8"]
        .map(|threads| trained_for("2560", &["--seed", "5", "--threads", threads]))
        .into();
    let other = trained_for("2560", &["--seed", "6"]);
    let latest =
        |run: &tempfile::TempDir| weights(run.path().join("run/checkpoints/latest.safetensors"));
    for run in &runs[1..] {
        assert_eq!(
            metrics(&runs[0].path().join("run")),
            metrics(&run.path().join("run"))
        );
        assert!(latest(&runs[0]) == latest(run));
    }
    assert!(latest(&runs[0]) != latest(&other));
}

#[test]
fn the_same_training_writes_the_same_bytes() {
    let runs = [trained(&["--seed", "5"]), trained(&["--seed", "5"])];
    for file in [
        "policy.safetensors",
        "checkpoints/latest.safetensors",
        "checkpoints/best.safetensors",
        "config.toml",
    ] {
        let [one, other] = runs
            .each_ref()
            .map(|run| fs::read(run.path().join("run").join(file)).unwrap());
        assert!(one == other, "{file}");
    }
}

#[test]
fn a_policy_is_played_whatever_its_file_says_of_its_training() {
    let folder = trained(&[]);
    let path = folder.path().join("run/policy.safetensors");
    let play = [
        "play",
        "--ckpt",
        "run/policy.safetensors",
        "--episodes",
        "2",
        "--json",
    ];
    let expected = succeeded(program(folder.path(), &play)).stdout;
    let mut policy = Checkpoint::parse(&fs::read(&path).unwrap()).unwrap();
    policy.config = policy
        .config
        .replace("goal_lifetime", "key_of_tomorrow")
        .replace("gamma = 0.995", "gamma = [1, 2]");
    fs::write(&path, policy.to_bytes().unwrap()).unwrap();
    assert!(succeeded(program(folder.path(), &play)).stdout == expected);
}

#[test]
fn a_resumed_run_goes_on_in_its_folder_up_to_the_new_total() {
    let folder = trained(&[]);
    let run = folder.path().join("run");
    let done = succeeded(program(folder.path(), &["train", "--resume", "run"]));
    assert!(
        stderr(&done).contains("is finished: 2 iterations"),
        "{}",
        stderr(&done)
    );
    // As if it had been killed before it could write the mark.
    fs::remove_file(run.join("finished")).unwrap();
    succeeded(program(folder.path(), &["train", "--resume", "run"]));
    assert!(
        run.join("finished").exists(),
        "scripts would continue it for ever"
    );
    let before = weights(run.join("checkpoints/latest.safetensors"));
    succeeded(program(
        folder.path(),
        &[
            "train",
            "--resume",
            "run",
            "--total-steps",
            "512",
            "--threads",
            "1",
        ],
    ));
    let rows = metrics(&run);
    let iterations: Vec<&str> = rows[1..].iter().map(|row| row[0].as_str()).collect();
    assert_eq!(iterations, ["1", "2", "3", "4"]);
    assert_eq!(rows[4][1], "512");
    let after = weights(run.join("checkpoints/latest.safetensors"));
    assert_eq!(before.len(), after.len());
    assert!(before != after);
    let checkpoint = run
        .join("checkpoints/latest.safetensors")
        .display()
        .to_string();
    succeeded(program(
        folder.path(),
        &["train", "--resume", &checkpoint, "--total-steps", "600"],
    ));
    assert_eq!(metrics(&run).len(), 6);
}

#[test]
fn the_best_policy_of_a_run_is_not_given_up_when_an_older_checkpoint_is_resumed() {
    let folder = trained(&[]);
    let run = folder.path().join("run");
    // A best checkpoint that nothing can beat.
    let best = run.join("checkpoints/best.safetensors");
    let mut unbeatable = Checkpoint::parse(&fs::read(&best).unwrap()).unwrap();
    unbeatable.progress.best = Some([9.0, 0.0]);
    let unbeatable = unbeatable.to_bytes().unwrap();
    fs::write(&best, &unbeatable).unwrap();
    succeeded(program(
        folder.path(),
        &["train", "--resume", "run", "--total-steps", "512"],
    ));
    assert!(fs::read(&best).unwrap() == unbeatable);
}

#[test]
fn an_own_scene_is_trained_on_and_used_again_only_when_it_is_named() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("own.xml"), crate::support::SCENE).unwrap();
    let args = train(&[
        "--total-steps",
        "128",
        "--run-dir",
        "run",
        "--set",
        "env.model=own.xml",
    ]);
    succeeded(program(folder.path(), &args));
    let run = folder.path().join("run").display().to_string();
    let elsewhere = tempfile::tempdir().unwrap();
    let model = format!(
        "env.model={}/own.xml",
        folder.path().canonicalize().unwrap().display()
    );
    for args in [
        &["play", "--ckpt", &run, "--episodes", "2", "--json"][..],
        &["train", "--resume", &run, "--total-steps", "256"],
    ] {
        let refused = program(elsewhere.path(), args);
        assert_eq!(refused.status.code(), Some(1));
        assert!(
            stderr(&refused).contains(&format!("set {model} to")),
            "{}",
            stderr(&refused)
        );
        let named = succeeded(program(
            elsewhere.path(),
            &[args, &["--set", &model]].concat(),
        ));
        assert!(!stderr(&named).contains("warning"), "{}", stderr(&named));
    }
}

#[test]
fn learning_curves_are_drawn_of_any_columns_and_runs() {
    let folder = trained_for("1280", &[]);
    fs::create_dir(folder.path().join("other")).unwrap();
    fs::copy(
        folder.path().join("run/metrics.csv"),
        folder.path().join("other/metrics.csv"),
    )
    .unwrap();
    let plot = |more: &[&str]| {
        program(
            folder.path(),
            &[&["plot", "run", "other/metrics.csv", "--smooth", "2"], more].concat(),
        )
    };
    succeeded(plot(&[]));
    let svg = fs::read_to_string(folder.path().join("learning.svg")).unwrap();
    let panels = [
        "goals per episode, evaluation",
        "goals per episode, training",
        "turned towards the goal (rad/100 steps)",
    ];
    for part in [&panels[..], &["run", "other", "million control steps"]].concat() {
        assert!(
            svg.lines().any(|line| line.trim() == part),
            "{part} is not in\n{svg}"
        );
    }
    // Five points per curve.
    let points = |line: &&str| line.contains("<polyline") && line.matches(',').count() >= 5;
    assert!(
        svg.lines().filter(|line| points(line)).count() >= 6,
        "{svg}"
    );
    succeeded(plot(&[
        "--metric",
        "loss/value",
        "--along",
        "hours",
        "--out",
        "loss.svg",
        "--size",
        "400x300",
    ]));
    let svg = fs::read_to_string(folder.path().join("loss.svg")).unwrap();
    assert!(
        svg.contains("value loss")
            && svg.contains("hours")
            && svg.contains("width=\"400\"")
            && !svg.contains("goals")
    );
    // Runs without rows are left out. Alone they are an error.
    fs::create_dir(folder.path().join("begun")).unwrap();
    let header = fs::read_to_string(folder.path().join("run/metrics.csv"))
        .unwrap()
        .lines()
        .next()
        .unwrap()
        .to_owned();
    fs::write(folder.path().join("begun/metrics.csv"), header + "\n").unwrap();
    let said = stderr(&succeeded(program(
        folder.path(),
        &["plot", "begun", "run", "nowhere"],
    )));
    for part in [
        "begun: no rows yet; skipped",
        "warning: cannot read nowhere",
        ": 1 run\n",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    succeeded(program(
        folder.path(),
        &["plot", "run", "--behind", "begun"],
    ));
    for other in ["nowhere", "begun/metrics.csv"] {
        let refused = program(folder.path(), &["plot", "begun", other]);
        let said = stderr(&refused);
        assert!(
            refused.status.code() == Some(1)
                && said.contains("begun: no rows yet; skipped")
                && said.contains("error: no run can be drawn"),
            "{said}"
        );
    }
    for (more, part) in [
        (
            ["--metric", "loss/vaule"],
            "error: no run has a column loss/vaule; did you mean loss/value?",
        ),
        (["--out", "absent/x.svg"], "cannot write absent/x.svg"),
    ] {
        let refused = plot(&more);
        assert_eq!(refused.status.code(), Some(1));
        assert!(stderr(&refused).contains(part), "{}", stderr(&refused));
        assert!(
            !stderr(&refused).contains("warning"),
            "it is said once: {}",
            stderr(&refused)
        );
    }
    let refused = plot(&["--out", "x.pdf"]);
    assert!(
        refused.status.code() == Some(2) && stderr(&refused).contains("must end in .svg or .png")
    );
    // One run by two names is one run, and a table that is no file is not waited for.
    std::os::unix::fs::symlink("run", folder.path().join("latest")).unwrap();
    let said = stderr(&succeeded(program(
        folder.path(),
        &["plot", "run", "latest", "run/metrics.csv"],
    )));
    assert!(said.contains(": 1 run\n"), "{said}");
    fs::create_dir(folder.path().join("pipe")).unwrap();
    let made = std::process::Command::new("mkfifo")
        .arg(folder.path().join("pipe/metrics.csv"))
        .status()
        .unwrap();
    let refused = program(folder.path(), &["plot", "pipe"]);
    assert!(
        made.success() && stderr(&refused).contains("not a regular file"),
        "{}",
        stderr(&refused)
    );
    // A column that only one of them has.
    let table = fs::read_to_string(folder.path().join("other/metrics.csv"))
        .unwrap()
        .replace("loss/value", "loss/old");
    fs::write(folder.path().join("other/metrics.csv"), table).unwrap();
    let said = stderr(&succeeded(plot(&["--metric", "loss/value"])));
    assert!(
        said.contains("warning: no column loss/value in other") && said.contains("2 runs"),
        "{said}"
    );
    // Before the first evaluation.
    let young = "env_steps,time/collect_s,time/update_s,eval/goals\n1,1,1,\n2,1,1,\n";
    fs::write(folder.path().join("young.csv"), young).unwrap();
    succeeded(program(
        folder.path(),
        &["plot", "young.csv", "--metric", "eval/goals"],
    ));
    let svg = fs::read_to_string(folder.path().join("learning.svg")).unwrap();
    assert!(svg.contains("no evaluation yet"), "{svg}");
    let said = stderr(&succeeded(plot(&["--seeds", "--metric", "episode/length"])));
    let svg = fs::read_to_string(folder.path().join("learning.svg")).unwrap();
    assert!(
        svg.contains("mean of 2 seeds") && svg.contains("<polygon") && said.contains("2 runs"),
        "{svg}"
    );
    succeeded(plot(&["--seeds", "--metric", "loss/value"]));
    let svg = fs::read_to_string(folder.path().join("learning.svg")).unwrap();
    assert!(
        svg.contains("value loss (1 of 2 seeds)") && !svg.contains("nothing yet"),
        "{svg}"
    );
    // A run behind the others is grey and not in the legend.
    succeeded(program(
        folder.path(),
        &["plot", "run", "--behind", "other/metrics.csv"],
    ));
    let svg = fs::read_to_string(folder.path().join("learning.svg")).unwrap();
    assert!(
        svg.contains("#B4B4B4") && svg.contains("\nrun\n") && !svg.contains("\nother\n"),
        "{svg}"
    );
    let refused = program(folder.path(), &["plot", "run", "--seeds"]);
    assert!(
        stderr(&refused).contains("error: --seeds"),
        "{}",
        stderr(&refused)
    );
    // The names of many runs make the picture higher.
    for i in 10..50 {
        let run = folder
            .path()
            .join(format!("20261123-0700{i}-a-long-name-of-a-run"));
        fs::create_dir(&run).unwrap();
        fs::write(run.join("metrics.csv"), young).unwrap();
    }
    let many: Vec<String> = (10..50)
        .map(|i| format!("20261123-0700{i}-a-long-name-of-a-run"))
        .collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    succeeded(program(
        folder.path(),
        &[&["plot", "--metric", "eval/goals"], &many[..]].concat(),
    ));
}

#[test]
fn bench_prints_every_figure() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "bench",
        "--json",
        "--set",
        "env.num_envs=64",
        "--set",
        "ppo.hidden=[16]",
        "--threads",
        "2",
    ];
    let figures = json(&succeeded(program(folder.path(), &args)));
    for key in [
        "physics_steps_per_s",
        "pool_steps_per_s",
        "pool_share",
        "learner_samples_per_s",
        "learner_gflops",
        "matmul_gflops",
        "end_to_end_steps_per_s",
        "default_training_hours",
        "steps_per_s_of_512",
        "steps_per_s_of_1024",
        "steps_per_s_of_2048",
    ] {
        assert!(figures[key].as_f64().unwrap() > 0.0, "{key}: {figures}");
    }
    let waits = figures["learner_waits"].as_f64().unwrap();
    assert!((0.0..=1.0).contains(&waits), "a share of the time: {waits}");
    // The speed of each number of environments, times what its steps are worth (docs/RECIPES.md).
    let worth = [(512, 0.56), (1024, 1.0), (2048, 0.74)].map(|(envs, share)| {
        (
            envs,
            share * figures[format!("steps_per_s_of_{envs}")].as_f64().unwrap(),
        )
    });
    let best = worth
        .into_iter()
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .unwrap()
        .0;
    assert_eq!(
        figures["advised_num_envs"].as_f64(),
        Some(f64::from(best)),
        "{figures}"
    );
    assert_eq!(
        (figures["threads"].as_u64(), figures["num_envs"].as_u64()),
        (Some(2), Some(64))
    );
    assert_eq!(figures["hidden"], serde_json::json!([16]));
}

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
#[test]
fn a_processor_without_avx_is_named_in_a_sentence_and_avx_is_enough() {
    let emulated = |processor: &str, args: &[&str]| {
        let mut qemu = std::process::Command::new("qemu-x86_64");
        let program = env!("CARGO_BIN_EXE_shadow-repose");
        qemu.args(["-cpu", processor, program]).args(args).output()
    };
    let Ok(of_2008) = emulated("Nehalem", &["--version"]) else {
        assert!(!must_be_possible(
            "no qemu-x86_64, which emulates other processors"
        ));
        return;
    };
    assert_eq!(of_2008.status.code(), Some(1), "{}", stderr(&of_2008));
    assert!(
        stderr(&of_2008).starts_with("error: this processor has no AVX"),
        "{}",
        stderr(&of_2008)
    );
    let short = [
        "play",
        "--ckpt=builtin",
        "--headless",
        "--episodes=1",
        "--threads=1",
        "--set=env.max_episode_seconds=1",
    ];
    let of_2011 = succeeded(emulated("SandyBridge", &short).unwrap());
    let said = String::from_utf8(of_2011.stdout).unwrap();
    assert!(said.contains("goals per episode"), "{said}");
}
