//! The command `runs`: what it finds in folders of runs, and how it compares two.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::Value;

use crate::resume::everything;
use crate::support::{command, metrics, names, program, stderr, succeeded, train};
use crate::survival::{begun, ended_by, send};

/// Returns what `runs` prints on stdout.
fn listed(folder: &Path, args: &[&str]) -> String {
    String::from_utf8(succeeded(program(folder, &[&["runs"], args].concat())).stdout).unwrap()
}

/// Returns the object of a run in the list of the folder `all`.
fn told(folder: &Path, name: &str) -> Value {
    let all: Vec<Value> = serde_json::from_str(&listed(folder, &["all", "--json"])).unwrap();
    let found = all.iter().find(|run| run["name"] == name);
    found
        .unwrap_or_else(|| panic!("{name} is not in {all:?}"))
        .clone()
}

/// Returns the values of a column of a run's table.
fn column(run: &Path, name: &str) -> Vec<f64> {
    let rows = metrics(run);
    let place = rows[0].iter().position(|column| column == name).unwrap();
    rows[1..]
        .iter()
        .map(|row| row[place].parse().unwrap_or(f64::NAN))
        .collect()
}

#[test]
fn the_state_of_a_run_is_found_while_it_trains_and_after_each_kind_of_end() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let state = || told(folder, "run")["state"].as_str().unwrap().to_owned();
    let (child, lines) = begun(command(
        folder,
        &train(&["--total-steps", "100000000", "--run-dir", "all/run"]),
    ));
    let run = told(folder, "run");
    assert!(
        run["state"] == "training" && run["seconds_left"].as_u64().unwrap() > 0,
        "{run}"
    );
    assert!(
        run["steps_per_s"].as_f64().unwrap() > 0.0 && run["total_steps"] == 100_000_000,
        "{run}"
    );
    assert_eq!(ended_by("TERM", child, lines).0, Some(143));
    let run = told(folder, "run");
    assert!(
        run["state"] == "stopped" && run["seconds_left"].is_null(),
        "{run}"
    );
    assert_eq!(
        run["env_steps"],
        *column(&folder.join("all/run"), "env_steps").last().unwrap() as u64
    );

    let resumed = || begun(command(folder, &["train", "--resume", "all/run"]));
    let (mut child, lines) = resumed();
    send("KILL", &child);
    child.wait().unwrap();
    drop(lines);
    assert_eq!(state(), "failed");
    let (mut child, lines) = resumed();
    assert_eq!(state(), "training");
    fs::write(folder.join("all/run/stop"), "").unwrap();
    lines.for_each(drop);
    assert!(child.wait().unwrap().success());
    assert_eq!(state(), "stopped");

    // An error that the training itself reports: a file stands in place of its folder of checkpoints.
    let (mut child, lines) = resumed();
    fs::remove_dir_all(folder.join("all/run/checkpoints")).unwrap();
    fs::write(folder.join("all/run/checkpoints"), "").unwrap();
    send("TERM", &child);
    lines.for_each(drop);
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert_eq!(state(), "failed");
}

#[test]
fn runs_are_listed_newest_first_with_steps_goals_and_settings_and_nothing_is_changed() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    assert!(
        stderr(&program(folder, &["runs"]))
            .contains("there are no runs in runs/shadow-hand-repose")
    );
    for (name, seed) in [("first", "0"), ("second", "7")] {
        let more = [
            "--total-steps",
            "256",
            "--name",
            name,
            "--seed",
            seed,
            "--set",
            "env.success_tolerance=3",
        ];
        succeeded(program(folder, &train(&more)));
    }
    let all = folder.join("runs/shadow-hand-repose");
    let before = everything(&all);
    let lines: Vec<String> = listed(folder, &[]).lines().map(String::from).collect();
    assert!(
        lines.len() == 3 && lines[0].starts_with("run "),
        "{lines:?}"
    );
    assert!(
        lines[1].contains("-second ") && lines[2].contains("-first "),
        "{lines:?}"
    );
    for part in [
        " finished ",
        " 256 of 256 ",
        " env.num_envs=16 ",
        " ppo.hidden=[16,8] ",
        " run.seed=7",
    ] {
        assert!(lines[1].contains(part), "{part} is not in {lines:?}");
    }
    assert!(
        !lines[1].contains("total_steps") && !lines[2].contains("run.seed"),
        "{lines:?}"
    );
    let run = all.join(&names(&all)[0]);
    let goals = column(&run, "eval/goals");
    let json: Vec<Value> =
        serde_json::from_str(&listed(folder, &[run.to_str().unwrap(), "--json"])).unwrap();
    assert!(
        json.len() == 1 && json[0]["problems"] == Value::Array(Vec::new()),
        "{json:?}"
    );
    assert_eq!(json[0]["goals"].as_f64(), goals.last().copied());
    assert_eq!(
        json[0]["best_goals"].as_f64(),
        goals.iter().copied().reduce(f64::max)
    );
    assert_eq!(json[0]["changed"]["env.success_tolerance"], 3.0);
    assert!(everything(&all) == before);
}

#[test]
fn of_two_runs_the_settings_that_differ_and_the_figures_at_equal_steps_are_told() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    for (name, steps, seed) in [("long", "640", "1"), ("short", "384", "2")] {
        let more = [
            "--total-steps",
            steps,
            "--run-dir",
            name,
            "--seed",
            seed,
            "--set",
            "env.success_tolerance=3",
        ];
        succeeded(program(folder, &train(&more)));
    }
    let told: Value = serde_json::from_str(&listed(folder, &["long", "short", "--json"])).unwrap();
    assert_eq!(told["settings"], serde_json::json!({ "run.seed": [1, 2] }));
    assert!(
        told["runs"][0]["name"] == "long" && told["runs"][1]["name"] == "short",
        "{told}"
    );
    let rows = told["at_equal_steps"].as_array().unwrap();
    let steps: Vec<u64> = rows
        .iter()
        .map(|row| row["env_steps"].as_u64().unwrap())
        .collect();
    assert_eq!(steps, [128, 256, 384], "as far as both have come");
    let keys = [
        ("goals", "eval/goals"),
        ("drop_rate", "eval/drop_rate"),
        ("rot_dist", "eval/rot_dist"),
        ("turned", "training/turned"),
    ];
    for (key, name) in keys {
        let both = ["long", "short"].map(|run| column(&folder.join(run), name));
        for (i, row) in rows.iter().enumerate() {
            for (run, values) in both.iter().enumerate() {
                assert_eq!(
                    row[key][run].as_f64(),
                    Some(values[i]),
                    "{key} of run {run} in {row}"
                );
            }
        }
    }
    let table = listed(folder, &["long", "short"]);
    for line in ["setting   A  B", "run.seed  1  2"] {
        assert!(
            table.lines().any(|found| found == line),
            "{line} is not in\n{table}"
        );
    }
    assert!(listed(folder, &["long", "long"]).contains("the settings are the same"));
    assert_eq!(
        listed(folder, &["short", "long", "short"]).lines().count(),
        4,
        "a list of just these"
    );
}

#[test]
fn damaged_and_foreign_folders_are_told_or_left_out_and_no_link_or_pipe_is_followed() {
    let place = tempfile::tempdir().unwrap();
    let (folder, all) = (place.path(), place.path().join("all"));
    let make = |name: &str, files: &[(&str, &str)]| {
        fs::create_dir_all(all.join(name)).unwrap();
        files
            .iter()
            .for_each(|(file, text)| fs::write(all.join(name).join(file), text).unwrap());
        all.join(name)
    };
    make("foreign", &[("notes.txt", "mine")]);
    make(
        "older",
        &[
            ("config.toml", "[ppo]\nof_old = 1\n"),
            ("metrics.csv", "env_steps\n7\n"),
        ],
    );
    make(
        "noise\u{1b}[2J\u{9b}\n",
        &[
            ("config.toml", "\u{1b}[31m"),
            ("metrics.csv", "\u{1b}]0;x\u{7}"),
            ("finished", ""),
        ],
    );
    make(
        "half",
        &[
            ("run.lock", ": process 1 on elsewhere"),
            ("metrics.csv", "env_steps,eval/goals\n128,1e999\n25"),
        ],
    );
    make(
        "letters",
        &[("metrics.csv", "env_steps,eval/goals\n128,many\n")],
    );
    let sparse = make("sparse", &[]);
    for name in ["config.toml", "metrics.csv", "run.lock"] {
        fs::File::create(sparse.join(name))
            .unwrap()
            .set_len(1 << 40)
            .unwrap();
    }
    let odd = make("odd", &[("run.lock", "")]);
    fs::create_dir(odd.join("metrics.csv")).unwrap();
    assert!(
        Command::new("mkfifo")
            .arg(odd.join("config.toml"))
            .status()
            .unwrap()
            .success()
    );
    let linked = make("linked", &[("run.lock", "")]);
    fs::write(folder.join("secret"), "env_steps\n99\n").unwrap();
    symlink(folder.join("secret"), linked.join("metrics.csv")).unwrap();
    symlink(&linked, all.join("latest")).unwrap();
    fs::write(all.join("file"), "").unwrap();

    let table = listed(folder, &["all"]);
    assert!(
        !table.chars().any(|c| c.is_control() && c != '\n')
            && table.contains(r"noise\u001b[2J\u009b\u000a"),
        "{table}"
    );
    assert_eq!(table.lines().count(), 8, "{table}");
    let json = listed(folder, &["all", "--json"]);
    assert!(!json.trim_end().chars().any(char::is_control), "{json}");
    let all: Vec<Value> = serde_json::from_str(&json).unwrap();
    let about = |name: &str| {
        all.iter()
            .find(|run| run["name"].as_str().unwrap().starts_with(name))
            .unwrap()
    };
    let problem = |name: &str| about(name)["problems"].to_string();
    assert!(
        problem("older").contains("does not fit this version")
            && problem("older").contains("ppo.of_old: unknown key")
    );
    assert!(about("older")["changed"].is_null() && about("older")["env_steps"] == 7);
    assert!(
        problem("noise").contains("not a TOML file")
            && problem("noise").contains("no column env_steps")
    );
    assert_eq!(about("noise")["state"], "finished");
    assert!(
        about("half")["state"] == "training" && about("half")["env_steps"] == 128,
        "{}",
        about("half")
    );
    assert!(
        problem("letters").contains("not a number: `many`")
            && about("letters")["state"] == "stopped"
    );
    assert!(
        problem("sparse").contains("larger than"),
        "{}",
        about("sparse")
    );
    assert!(about("odd")["env_steps"].is_null() && about("linked")["env_steps"].is_null());
    for (args, reason) in [
        (
            &["runs", "all/foreign", "all/half"][..],
            "all/foreign holds no run; to list a folder of runs, name it alone",
        ),
        (&["runs", "all/half", "absent"], "absent: no such folder"),
        (&["runs", "absent"], "absent"),
        (&["runs", "all/letters", "all/half"], "cannot compare"),
    ] {
        let output = program(folder, args);
        assert!(
            output.status.code() == Some(1) && stderr(&output).contains(reason),
            "{args:?}: {}",
            stderr(&output)
        );
    }
    assert!(
        listed(folder, &["all/half", "all/half"]).contains("the settings of one run are not known")
    );
    assert!(
        stderr(&succeeded(program(folder, &["runs", "all/foreign"])))
            .contains("there are no runs in this folder")
    );
}

#[test]
fn the_table_is_printed_again_until_a_signal_or_until_nobody_reads_it() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::create_dir_all(folder.join("all/run")).unwrap();
    fs::write(folder.join("all/run/metrics.csv"), "env_steps\n1\n").unwrap();
    let watch = || {
        let mut child = command(folder, &["runs", "all", "--watch"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap())
            .lines()
            .map_while(Result::ok);
        (child, lines)
    };
    let ((mut read, mut lines), (mut unread, mut first)) = (watch(), watch());
    assert!(first.next().unwrap().starts_with("run "));
    drop(first);
    assert!(lines.nth(1).unwrap().starts_with("run  stopped"));
    fs::write(folder.join("all/run/metrics.csv"), "env_steps\n1\n2\n").unwrap();
    let again: Vec<String> = lines.by_ref().take(3).collect();
    assert!(
        again[0].is_empty() && again[1].starts_with("run ") && again[2].contains(" 2 "),
        "{again:?}"
    );
    send("INT", &read);
    assert!(!read.wait().unwrap().success());
    assert!(
        unread.wait().unwrap().success(),
        "a closed pipe is no error"
    );
    assert_eq!(
        program(folder, &["runs", "--watch", "--json"])
            .status
            .code(),
        Some(2)
    );
}

#[test]
fn a_table_that_is_watched_waits_for_the_first_run() {
    let place = tempfile::tempdir().unwrap();
    let mut child = command(place.path(), &["runs", "--watch"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap())
        .lines()
        .map_while(Result::ok);
    assert!(
        lines.next().unwrap().starts_with("run "),
        "the table has only its head"
    );
    let run = place.path().join("runs/shadow-hand-repose/first");
    fs::create_dir_all(&run).unwrap();
    fs::write(run.join("metrics.csv"), "env_steps\n1\n").unwrap();
    assert!(lines.any(|line| line.starts_with("first ")));
    send("INT", &child);
    assert!(!child.wait().unwrap().success());
}

#[test]
fn folders_and_runs_that_are_named_are_waited_for_too() {
    let place = tempfile::tempdir().unwrap();
    let begin = |name: &str| {
        let run = place.path().join(name);
        fs::create_dir_all(&run).unwrap();
        fs::write(run.join("metrics.csv"), "env_steps\n1\n").unwrap();
    };
    for (args, first, then) in [
        (&["notyet"][..], None, "notyet/first"),
        (&["one", "two"], Some("one"), "two"),
    ] {
        first.into_iter().for_each(begin);
        let mut child = command(place.path(), &[&["runs", "--watch"], args].concat())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap())
            .lines()
            .map_while(Result::ok);
        assert!(lines.next().unwrap().starts_with("run "));
        begin(then);
        let name = then.rsplit('/').next().unwrap();
        assert!(lines.any(|line| line.contains(name)), "{args:?}");
        send("INT", &child);
        child.wait().unwrap();
    }
    let unwatched = program(place.path(), &["runs", "never"]);
    assert_eq!(unwatched.status.code(), Some(1));
}
