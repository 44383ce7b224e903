//! Run folders that are damaged, deleted or replaced while a training writes into them, or whose disk is full.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use shadow_repose::ppo::Checkpoint;

use crate::resume::everything;
use crate::support::{command, metrics, names, preloaded, program, stderr, succeeded, train};
use crate::survival::{begun, ended_by, endless, iterations, result, resume, send};

#[test]
fn the_newest_checkpoints_are_kept_as_many_as_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&[
        "--total-steps",
        "1280",
        "--run-dir",
        "run",
        "--keep",
        "3",
        "--set",
        "run.checkpoint_every=1",
    ]);
    succeeded(program(folder.path(), &args));
    let expected = [
        "best",
        "iteration-00000008",
        "iteration-00000009",
        "iteration-00000010",
        "latest",
    ];
    assert_eq!(
        names(&folder.path().join("run/checkpoints")),
        expected.map(|name| format!("{name}.safetensors"))
    );
    // A resumed run keeps the same number by default.
    succeeded(resume(folder.path(), &["--total-steps", "1408"]));
    let expected = [
        "best",
        "iteration-00000009",
        "iteration-00000010",
        "iteration-00000011",
        "latest",
    ];
    assert_eq!(
        names(&folder.path().join("run/checkpoints")),
        expected.map(|name| format!("{name}.safetensors"))
    );
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_one_before_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&[
        "--total-steps",
        "512",
        "--run-dir",
        "run",
        "--set",
        "run.checkpoint_every=1",
    ]);
    succeeded(program(folder.path(), &args));
    let expected = result(folder.path(), "run");
    let latest = folder.path().join("run/checkpoints/latest.safetensors");
    // Changed in place, as a disk would: both names are the same file.
    let mut bytes = fs::read(&latest).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&latest, bytes).unwrap();
    let output = succeeded(resume(folder.path(), &[]));
    let said = stderr(&output);
    assert!(
        said.contains("warning: cannot use")
            && said.contains("checksum")
            && said.contains("previous"),
        "{said}"
    );
    assert!(
        said.contains("1 rows of metrics.csv after iteration 3 are dropped"),
        "{said}"
    );
    assert!(result(folder.path(), "run") == expected);
    for name in names(&folder.path().join("run/checkpoints")) {
        fs::write(folder.path().join("run/checkpoints").join(name), "gone").unwrap();
    }
    let output = resume(folder.path(), &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        stderr(&output).contains("error: cannot resume run"),
        "{}",
        stderr(&output)
    );
}

/// Begins a training without end in `run`, and exchanges what lies there while it is suspended. Returns its exit code and what it said
/// after one more checkpoint.
fn exchanged_meanwhile(folder: &Path, exchange: impl FnOnce(&Path)) -> (Option<i32>, String) {
    fs::create_dir(folder.join("tmp")).unwrap();
    let args = train(&[
        "--total-steps",
        "100000000",
        "--run-dir",
        "run",
        "--set",
        "run.checkpoint_every=1",
    ]);
    let mut training = command(folder, &args);
    training.env("TMPDIR", folder.join("tmp"));
    let (child, lines) = begun(training);
    send("STOP", &child);
    exchange(folder);
    send("CONT", &child);
    std::thread::sleep(Duration::from_millis(500));
    ended_by("TERM", child, lines)
}

#[test]
fn a_training_whose_folder_was_moved_goes_on_there_and_leaves_what_has_its_place_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&["--total-steps", "256", "--run-dir", "finished"]);
    succeeded(program(folder.path(), &args));
    let before = everything(&folder.path().join("finished"));
    let (code, said) = exchanged_meanwhile(folder.path(), |folder| {
        fs::rename(folder.join("run"), folder.join("moved")).unwrap();
        fs::rename(folder.join("finished"), folder.join("run")).unwrap();
    });
    assert_eq!(code, Some(143), "{said}");
    assert_eq!(
        said.matches("the run folder was moved").count(),
        1,
        "{said}"
    );
    assert!(
        said.contains("--resume") && said.contains("/moved"),
        "{said}"
    );
    assert!(everything(&folder.path().join("run")) == before);
    let moved = folder.path().join("moved");
    let rows = |run: &Path| metrics(run).len() as u64 - 1;
    let made = rows(&moved);
    let steps = ((made + 1) * 128).to_string();
    let args = ["train", "--resume", "moved", "--total-steps", &steps];
    let said = stderr(&succeeded(program(folder.path(), &args)));
    assert!(
        !said.contains("lacks") && !said.contains("dropped"),
        "{said}"
    );
    assert_eq!(rows(&moved), made + 1);
}

#[test]
fn a_training_whose_checkpoints_were_exchanged_goes_on_with_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&["--total-steps", "256", "--run-dir", "finished"]);
    succeeded(program(folder.path(), &args));
    let before = everything(&folder.path().join("finished/checkpoints"));
    let (code, said) = exchanged_meanwhile(folder.path(), |folder| {
        fs::rename(folder.join("run/checkpoints"), folder.join("own")).unwrap();
        fs::rename(
            folder.join("finished/checkpoints"),
            folder.join("run/checkpoints"),
        )
        .unwrap();
    });
    assert_eq!(code, Some(143), "{said}");
    assert!(said.contains("its checkpoints lie in"), "{said}");
    assert!(everything(&folder.path().join("run/checkpoints")) == before);
    let made = metrics(&folder.path().join("run")).len() - 1;
    let newest = format!("iteration-{made:08}.safetensors");
    assert!(names(&folder.path().join("own")).contains(&newest));
}

#[test]
fn a_training_whose_folder_was_given_to_another_one_keeps_out_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let mut second = None;
    let (code, said) = exchanged_meanwhile(folder.path(), |folder| {
        fs::remove_dir_all(folder.join("run")).unwrap();
        second = Some(endless(folder, &[]));
    });
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("exists") && said.contains("instead; resume with"),
        "{said}"
    );
    let (second, second_lines) = second.unwrap();
    assert_eq!(ended_by("TERM", second, second_lines).0, Some(143));
    let made = iterations(folder.path());
    succeeded(resume(
        folder.path(),
        &["--total-steps", &((made + 1) * 128).to_string()],
    ));
}

#[test]
fn a_file_that_may_not_grow_any_more_costs_rows_but_not_the_training() {
    let folder = tempfile::tempdir().unwrap();
    let settings = train(&[
        "--total-steps",
        "64000",
        "--run-dir",
        "run",
        "--set",
        "run.checkpoint_every=5",
    ])
    .join(" ");
    // In blocks of 512 bytes: enough for a checkpoint of 124 KB, not for 500 rows. Writes beyond that fail as on a full disk.
    let script = format!(
        "trap '' XFSZ; ulimit -f 280; exec {} {settings}",
        env!("CARGO_BIN_EXE_shadow-repose")
    );
    let output = Command::new("sh")
        .args(["-c", &script])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = stderr(&succeeded(output));
    assert!(
        said.contains("logging to metrics.csv is suspended") && said.contains("metrics.csv lacks"),
        "{said}"
    );
    let rows = iterations(folder.path());
    assert!((100..500).contains(&rows), "{rows} rows");
    succeeded(program(
        folder.path(),
        &["play", "--ckpt", "run", "--episodes", "2", "--json"],
    ));
    succeeded(resume(folder.path(), &["--total-steps", "64128"]));
}

#[test]
fn two_trainings_in_one_folder_are_refused_and_a_crash_leaves_no_lock() {
    let folder = tempfile::tempdir().unwrap();
    let (mut child, lines) = endless(folder.path(), &[]);
    let second = resume(folder.path(), &[]);
    assert_eq!(second.status.code(), Some(1));
    let who = format!("another program: process {}", child.id());
    assert!(stderr(&second).contains(&who), "{}", stderr(&second));
    child.kill().unwrap();
    child.wait().unwrap();
    drop(lines);
    succeeded(resume(folder.path(), &["--total-steps", "128"]));
}

/// A library that makes file locks fail, as on a file system without them.
fn without_locks(folder: &Path) -> Option<String> {
    preloaded(
        folder,
        "#include <errno.h>\nint flock(int f, int o) { (void)f; (void)o; errno = ENOLCK; return -1; }\n",
    )
}

/// Refuses whatever else is done to a file than to write, read, rename and remove it, as some file systems do.
const WITHOUT_NICETIES: &str = "#define _GNU_SOURCE\n#include <dlfcn.h>\n#include <errno.h>\n#include <sys/stat.h>\n\
    #define REFUSED(name, ...) int name(__VA_ARGS__) { errno = EPERM; return -1; }\n\
    REFUSED(fchmod, int f, mode_t m)\nREFUSED(chmod, const char *p, mode_t m)\nREFUSED(flock, int f, int o)\n\
    REFUSED(link, const char *a, const char *b)\nREFUSED(linkat, int a, const char *b, int c, const char *d, int e)\n\
    REFUSED(fchown, int f, int u, int g)\nREFUSED(futimens, int f, const struct timespec *t)\n\
    int fsync(int f) { errno = EINVAL; return -1; }\nint fdatasync(int f) { errno = EINVAL; return -1; }\n";

#[test]
fn where_a_file_system_refuses_modes_locks_links_and_syncs_every_checkpoint_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let Some(library) = preloaded(folder.path(), WITHOUT_NICETIES) else {
        return;
    };
    let run = |args: &[&str]| {
        let mut command = command(folder.path(), args);
        command.env("LD_PRELOAD", &library);
        succeeded(command.output().unwrap())
    };
    let every = ["--set", "run.checkpoint_every=1", "--run-dir", "run"];
    let said = run(&train(&[&["--total-steps", "256"][..], &every].concat()));
    assert!(!stderr(&said).contains("warning"), "{}", stderr(&said));
    run(&["train", "--resume", "run", "--total-steps", "512"]);
    for _ in 0..2 {
        run(&["export", "--ckpt", "run", "--out", "p.onnx"]);
        run(&[
            "play",
            "--ckpt",
            "run",
            "--episodes",
            "1",
            "--out",
            "p.html",
        ]);
    }
    let checkpoints = names(&folder.path().join("run/checkpoints"));
    assert!(checkpoints.contains(&"iteration-00000004.safetensors".to_owned()));
    let plain = train(&["--total-steps", "512", "--run-dir", "plain"]);
    succeeded(program(folder.path(), &plain));
    assert_eq!(
        result(folder.path(), "run").2,
        result(folder.path(), "plain").2
    );
}

#[test]
fn a_training_that_was_suspended_where_there_are_no_locks_looks_again_before_it_writes() {
    let folder = tempfile::tempdir().unwrap();
    let Some(library) = without_locks(folder.path()) else {
        return;
    };
    fs::create_dir(folder.path().join("tmp")).unwrap();
    let run = |args: &[&str]| {
        let mut command = command(folder.path(), args);
        command
            .env("LD_PRELOAD", &library)
            .env("TMPDIR", folder.path().join("tmp"));
        command
    };
    let args = train(&["--total-steps", "100000000", "--run-dir", "run"]);
    let place = folder.path().join("run");
    // The second training has ended, was killed, or lives when the first one wakes up.
    for (signal, code) in [
        (Some("TERM"), Some(143)),
        (Some("KILL"), None),
        (None, Some(143)),
    ] {
        let begin = if place.exists() {
            &["train", "--resume", "run"][..]
        } else {
            &args
        };
        let (mut first, first_lines) = begun(run(begin));
        send("STOP", &first);
        let (second, second_lines) = begun(run(&["train", "--resume", "run"]));
        let second = match signal {
            Some(signal) => {
                assert_eq!(ended_by(signal, second, second_lines).0, code);
                None
            }
            None => Some((second, second_lines)),
        };
        let left = everything(&place);
        send("CONT", &first);
        let said: Vec<String> = first_lines.map_while(|line| line.ok()).collect();
        let said = said.join("\n");
        assert!(
            said.contains("is in use by another program") && said.contains("instead; resume with"),
            "{signal:?}: {said}"
        );
        assert_eq!(first.wait().unwrap().code(), Some(1));
        match second {
            Some((second, lines)) => assert_eq!(ended_by("TERM", second, lines).0, code),
            None => assert!(everything(&place) == left, "{signal:?}"),
        }
        let numbers: Vec<String> = metrics(&place)
            .into_iter()
            .map(|row| row[0].clone())
            .collect();
        let expected = (1..numbers.len()).map(|number| number.to_string());
        assert!(numbers[1..].iter().cloned().eq(expected), "{numbers:?}");
    }
}

#[test]
fn where_there_are_no_locks_a_second_training_is_kept_out_as_well() {
    let folder = tempfile::tempdir().unwrap();
    let Some(library) = without_locks(folder.path()) else {
        return;
    };
    let run = |args: &[&str]| {
        let mut command = command(folder.path(), args);
        command.env("LD_PRELOAD", &library);
        command
    };
    let args = train(&["--total-steps", "100000000", "--run-dir", "run"]);
    let (child, lines) = begun(run(&args));
    let second = run(&["train", "--resume", "run"]).output().unwrap();
    assert_eq!(second.status.code(), Some(1));
    let who = format!("another program: process {} on ", child.id());
    assert!(
        stderr(&second).contains(&who) && stderr(&second).contains("no file locks"),
        "{}",
        stderr(&second)
    );
    // After it has ended, the next one need not wait.
    let (code, _) = ended_by("TERM", child, lines);
    assert_eq!(code, Some(143));
    let third = succeeded(
        run(&["train", "--resume", "run", "--total-steps", "128"])
            .output()
            .unwrap(),
    );
    let said = stderr(&third);
    assert!(
        said.contains("is finished") || said.contains("there are no file locks in "),
        "{said}"
    );
}

#[test]
fn a_training_that_was_killed_before_its_first_checkpoint_is_begun_again_by_the_same_command() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let args = train(&["--total-steps", "128", "--run-dir", "run"]);
    for left in [
        &["run.lock"][..],
        &[
            "run.lock",
            "policy.safetensors",
            "checkpoints/.shadow-repose-1-0.partial",
        ],
    ] {
        fs::create_dir_all(run.join("checkpoints")).unwrap();
        left.iter()
            .for_each(|name| fs::write(run.join(name), "").unwrap());
        let refused = resume(folder.path(), &[]);
        assert!(
            stderr(&refused).contains("repeat the command that started it"),
            "{}",
            stderr(&refused)
        );
        succeeded(program(folder.path(), &args));
        assert!(!run.join("checkpoints/.shadow-repose-1-0.partial").exists());
        fs::remove_dir_all(&run).unwrap();
    }
    // What has settings and logs has lost its checkpoints, but is a run.
    fs::create_dir_all(&run).unwrap();
    ["run.lock", "config.toml"]
        .iter()
        .for_each(|name| fs::write(run.join(name), "").unwrap());
    assert_eq!(program(folder.path(), &args).status.code(), Some(1));
}

#[test]
fn a_file_stop_that_was_there_before_or_is_not_empty_is_the_users() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    fs::create_dir(&run).unwrap();
    for content in ["kill $(cat pid)", ""] {
        fs::write(run.join("stop"), content).unwrap();
        let args = train(&["--total-steps", "384", "--run-dir", "run"]);
        let output = succeeded(program(folder.path(), &args));
        assert!(
            stderr(&output).contains("finished: 3 iterations"),
            "{}",
            stderr(&output)
        );
        assert_eq!(fs::read_to_string(run.join("stop")).unwrap(), content);
        fs::remove_dir_all(&run).unwrap();
        fs::create_dir(&run).unwrap();
    }
    let (mut child, lines) = endless(folder.path(), &[]);
    fs::write(run.join("stop"), "").unwrap();
    assert!(
        lines
            .map_while(|line| line.ok())
            .any(|line| line.contains("stopped by the file `stop`"))
    );
    assert!(child.wait().unwrap().success() && !run.join("stop").exists());
}

#[test]
fn a_folder_that_is_deleted_meanwhile_is_made_anew() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&[
        "--total-steps",
        "100000000",
        "--run-dir",
        "run",
        "--set",
        "run.checkpoint_every=1",
    ]);
    let (child, lines) = begun(command(folder.path(), &args));
    let run = folder.path().join("run");
    // The training may be writing into it at the same time.
    let patience = Instant::now();
    while fs::remove_dir_all(&run).is_err() && run.exists() {
        assert!(patience.elapsed() < Duration::from_secs(30));
    }
    while !run.join("checkpoints/latest.safetensors").exists() {
        assert!(
            patience.elapsed() < Duration::from_secs(30),
            "no checkpoint is written"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    let (code, said) = ended_by("TERM", child, lines);
    assert_eq!(code, Some(143), "{said}");
    let made = iterations(folder.path());
    succeeded(resume(
        folder.path(),
        &["--total-steps", &((made + 1) * 128).to_string()],
    ));
    assert!(names(&run).contains(&"config.toml".to_owned()));
}

#[test]
fn a_state_that_cannot_be_saved_in_its_place_in_the_end_is_saved_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("tmp")).unwrap();
    let args = train(&[
        "--total-steps",
        "100000000",
        "--run-dir",
        "run",
        "--set",
        "run.checkpoint_every=1000000",
    ]);
    let mut training = command(folder.path(), &args);
    training.env("TMPDIR", folder.path().join("tmp"));
    let (child, lines) = begun(training);
    // A file in place of a folder stops every user, even root.
    let checkpoints = folder.path().join("run/checkpoints");
    fs::remove_dir_all(&checkpoints).unwrap();
    fs::write(&checkpoints, "in the way").unwrap();
    let (code, said) = ended_by("TERM", child, lines);
    assert_eq!(code, Some(1), "{said}");
    let elsewhere = folder
        .path()
        .join("tmp")
        .join(&names(&folder.path().join("tmp"))[0])
        .display()
        .to_string();
    assert!(
        said.contains(&format!("--resume {elsewhere}"))
            && said.contains("error: cannot create the folder run/checkpoints"),
        "{said}"
    );
    let resumed = program(
        folder.path(),
        &["train", "--resume", &elsewhere, "--stop-after", "2s"],
    );
    assert!(stderr(&succeeded(resumed)).contains("stopped after"));
}

/// Runs a shell script in `folder` with a temporary file system of `size` mounted at `small`. Returns `None` if the system does
/// not permit this.
fn with_small_disk(folder: &Path, size: &str, script: &str) -> Option<Output> {
    fs::create_dir(folder.join("small")).unwrap();
    let unshared = |script: &str| {
        let mut command = Command::new("unshare");
        command
            .args(["--user", "--map-root-user", "--mount", "sh", "-c", script])
            .current_dir(folder);
        command
            .env("PROGRAM", env!("CARGO_BIN_EXE_shadow-repose"))
            .env("TMPDIR", folder)
            .output()
    };
    let mount = format!("mount -t tmpfs -o size={size} none small && ");
    let possible = unshared(&format!("{mount} true")).is_ok_and(|output| output.status.success());
    if !possible {
        eprintln!("not tested: file systems cannot be mounted here");
        return None;
    }
    Some(unshared(&format!("{mount} {script}")).unwrap())
}

#[test]
fn a_training_whose_disk_fills_up_goes_on_and_its_last_checkpoint_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let settings = train(&[
        "--total-steps",
        "100000",
        "--run-dir",
        "small/run",
        "--set",
        "run.checkpoint_every=5",
    ])
    .join(" ");
    // The disk is full soon after the start. Space is freed before the run is resumed.
    let script = format!(
        "($PROGRAM {settings} 2> said & train=$!
          until grep -q steps/s said || ! kill -0 $train; do sleep 0.01; done
          cat /dev/zero > small/filler 2> /dev/null
          wait $train; echo code $?
          rm small/filler
          $PROGRAM play --ckpt small/run --episodes 2 --json
          $PROGRAM train --resume small/run; echo code $?)"
    );
    let Some(output) = with_small_disk(folder.path(), "2m", &script) else {
        return;
    };
    let said = fs::read_to_string(folder.path().join("said")).unwrap();
    let printed = String::from_utf8_lossy(&output.stdout);
    let lines: Vec<&str> = printed.lines().collect();
    // It is still full at the end: that is an error, and the state is saved elsewhere.
    assert_eq!(lines[0], "code 1", "{said}");
    assert!(
        said.contains("tried again at the next checkpoint") && said.contains("No space left"),
        "{said}"
    );
    assert!(
        said.contains("100 k of 100 k steps"),
        "all steps were made: {said}"
    );
    assert!(said.contains("instead; resume with"), "{said}");
    assert!(
        said.contains("metrics.csv lacks"),
        "what was lost is counted: {said}"
    );
    assert!(
        lines[1].contains("\"episodes\":2"),
        "the last whole checkpoint plays: {printed}"
    );
    assert_eq!(lines[2], "code 0", "{}", stderr(&output));
}

#[test]
fn a_file_tells_scripts_whether_a_training_is_to_be_continued() {
    let folder = tempfile::tempdir().unwrap();
    let finished = folder.path().join("run/finished");
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "256", "--run-dir", "run"]),
    ));
    assert!(finished.exists());
    let (child, lines) = begun(command(
        folder.path(),
        &["train", "--resume", "run", "--total-steps", "100000000"],
    ));
    assert!(!finished.exists());
    assert_eq!(ended_by("TERM", child, lines).0, Some(143));
    assert!(!finished.exists());
    let (mut child, lines) = begun(command(
        folder.path(),
        &["train", "--resume", "run", "--total-steps", "100000000"],
    ));
    fs::write(folder.path().join("run/stop"), "").unwrap();
    lines.for_each(drop);
    assert!(child.wait().unwrap().success() && finished.exists());
    // A file with content is the user's.
    fs::write(&finished, "mine").unwrap();
    let (child, lines) = begun(command(
        folder.path(),
        &["train", "--resume", "run", "--total-steps", "100000000"],
    ));
    assert_eq!(ended_by("TERM", child, lines).0, Some(143));
    assert_eq!(fs::read_to_string(&finished).unwrap(), "mine");
    // A resumed run accepts its own settings, and no others.
    let same = resume(
        folder.path(),
        &["--total-steps", "128", "--set", "env.num_envs=16"],
    );
    assert!(stderr(&succeeded(same)).contains("is finished"));
    let other = resume(folder.path(), &["--set", "env.num_envs=32"]);
    assert!(
        stderr(&other).contains("env.num_envs = 32, not 16: a resumed run accepts only"),
        "{}",
        stderr(&other)
    );
}

#[test]
fn a_link_that_takes_the_place_of_the_checkpoints_is_not_followed() {
    let folder = tempfile::tempdir().unwrap();
    let (code, said) = exchanged_meanwhile(folder.path(), |folder| {
        let run = folder.join("run");
        fs::create_dir(folder.join("victim")).unwrap();
        fs::rename(run.join("checkpoints"), run.join("old")).unwrap();
        std::os::unix::fs::symlink("../victim", run.join("checkpoints")).unwrap();
    });
    assert!(said.contains("/old"), "{said}");
    assert_eq!(
        (code, names(&folder.path().join("victim")).len()),
        (Some(143), 0)
    );
}

#[test]
fn the_best_goals_for_hparams_are_those_of_the_best_evaluation_once_it_was_confirmed() {
    let place = tempfile::tempdir().unwrap();
    let differs = ["0", "1", "2"].map(|seed| is_unlike_the_highest(place.path(), seed));
    assert!(differs.contains(&true), "a case in which they differ");
}

/// Checks the best goals of a training run for HPARAMS. Returns whether they differ from the highest in its evaluations.
fn is_unlike_the_highest(folder: &Path, seed: &str) -> bool {
    let run = folder.join(seed);
    let args = [
        "--total-steps",
        "256",
        "--run-dir",
        seed,
        "--seed",
        seed,
        "--set",
        "env.success_tolerance=3",
        "--set",
        "env.max_episode_seconds=2",
        "--set",
        "run.eval_episodes=3",
    ];
    succeeded(program(folder, &train(&args)));
    let latest = fs::read(run.join("checkpoints/latest.safetensors")).unwrap();
    let [best, _] = Checkpoint::parse(&latest).unwrap().progress.best.unwrap();
    let found: Vec<f32> = crate::support::events(&run.join("hparams"))
        .iter()
        .flat_map(|event| event.get_summary().get_value())
        .filter(|value| value.get_tag() == "best_goals")
        .map(|value| value.get_simple_value())
        .collect();
    let rows = metrics(&run);
    let column = rows[0].iter().position(|name| name == "eval/goals");
    let evaluated = rows[1..].iter().map(|row| &row[column.unwrap()]);
    let highest = evaluated
        .filter_map(|goals| goals.parse().ok())
        .fold(0.0, f64::max);
    assert_eq!(found.last(), Some(&(best as f32)));
    best != highest
}

#[test]
fn a_run_is_a_row_for_hparams_with_its_best_goals_and_ends_when_all_steps_are_made() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let tags = || -> Vec<String> {
        let events = crate::support::events(&folder.join("run/hparams"));
        let values = events
            .iter()
            .flat_map(|event| event.get_summary().get_value().iter());
        values.map(|value| value.get_tag().to_owned()).collect()
    };
    let metrics = ["best_goals", "drop_rate", "steps_per_s"].map(str::to_owned);
    let [start, end] = ["start", "end"].map(|part| vec![format!("_hparams_/session_{part}_info")]);
    succeeded(program(
        folder,
        &train(&["--total-steps", "256", "--run-dir", "run"]),
    ));
    assert_eq!(tags(), [&start[..], &metrics, &metrics, &end].concat());
    // A resumed run is one row, and goes on until it ends again.
    succeeded(program(
        folder,
        &["train", "--resume", "run", "--total-steps", "384"],
    ));
    assert_eq!(tags(), [&start[..], &metrics, &end].concat());
    assert_eq!(names(&folder.join("run/hparams")).len(), 1);
    // A file of that name is the user's, and the row is a nicety.
    fs::remove_dir_all(folder.join("run/hparams")).unwrap();
    fs::write(folder.join("run/hparams"), "mine").unwrap();
    let more = ["train", "--resume", "run", "--total-steps", "512"];
    let said = stderr(&succeeded(program(folder, &more)));
    assert!(said.contains("logging to hparams is suspended"), "{said}");
    assert_eq!(
        fs::read_to_string(folder.join("run/hparams")).unwrap(),
        "mine"
    );
}
