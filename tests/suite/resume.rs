//! `--resume`: which files it uses, and what may change.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Stdio;

use shadow_repose::ppo::Checkpoint;

use crate::support::{
    SCENE, command, metrics, names, preloaded, program, stderr, succeeded, train,
};
use crate::survival::{iterations, result, resume};

/// Trains a run of ten iterations in `run` and keeps all its checkpoints.
fn run_of_ten(folder: &Path, more: &[&str]) {
    let args = [
        "--total-steps",
        "1280",
        "--run-dir",
        "run",
        "--keep",
        "9",
        "--set",
        "run.checkpoint_every=2",
    ];
    succeeded(program(folder, &train(&[&args, more].concat())));
}

/// Returns the inode number and the bytes of every file in a folder and below, by name. Two names of one file share the inode.
pub(crate) fn everything(folder: &Path) -> BTreeMap<String, (u64, Vec<u8>)> {
    let mut found = BTreeMap::new();
    for name in names(folder) {
        let path = folder.join(&name);
        if path.is_dir() {
            found.extend(
                everything(&path)
                    .into_iter()
                    .map(|(inside, file)| (format!("{name}/{inside}"), file)),
            );
        } else {
            found.insert(
                name,
                (fs::metadata(&path).unwrap().ino(), fs::read(&path).unwrap()),
            );
        }
    }
    found
}

fn refused(folder: &Path, args: &[&str], reasons: &[&str]) {
    let before = everything(&folder.join("run"));
    let output = program(folder, &[&["train"], args].concat());
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    reasons.iter().for_each(|reason| {
        assert!(
            stderr(&output).contains(reason),
            "{reason}: {}",
            stderr(&output)
        )
    });
    assert!(
        everything(&folder.join("run")) == before,
        "nothing is changed"
    );
}

/// The path of a checkpoint of `run`.
fn checkpoint(iteration: u64) -> String {
    format!("run/checkpoints/iteration-{iteration:08}.safetensors")
}

#[test]
fn a_run_that_is_resumed_is_left_as_it_was_until_an_iteration_is_done() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    // An iteration takes a second.
    let sets = [
        "env.num_envs=256",
        "ppo.horizon=64",
        "run.checkpoint_every=1",
        "run.eval_every=9",
    ];
    let mut args = train(&["--total-steps", "49152", "--run-dir", "run", "--keep", "9"]);
    sets.iter().for_each(|set| args.extend(["--set", set]));
    succeeded(program(folder, &args));
    let expected = result(folder, "run");
    let before = everything(&folder.join("run"));
    let older = checkpoint(1);
    for place in ["run", &older] {
        let args = [
            "train",
            "--resume",
            place,
            "--total-steps",
            "65536",
            "--keep",
            "2",
        ];
        succeeded(program(
            folder,
            &[&args[..], &["--stop-after", "1ms"]].concat(),
        ));
        assert!(
            everything(&folder.join("run")) == before,
            "{place}, stopped"
        );
        let mut child = command(folder, &args)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = BufReader::new(child.stderr.take().unwrap()).lines();
        assert!(said.next().unwrap().unwrap().contains("run folder"));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(everything(&folder.join("run")) == before, "{place}, killed");
    }
    // Once an iteration is done, the run continues from the older checkpoint, and nothing is deleted.
    let output = succeeded(program(
        folder,
        &[
            "train",
            "--resume",
            &older,
            "--total-steps",
            "32768",
            "--keep",
            "9",
        ],
    ));
    assert!(
        stderr(&output).contains("2 rows of metrics.csv after iteration 1 are dropped"),
        "{}",
        stderr(&output)
    );
    assert_eq!(iterations(folder), 2);
    assert!(
        names(&folder.join("run/checkpoints")).contains(&"iteration-00000003.later".to_owned())
    );
    succeeded(resume(folder, &["--total-steps", "49152"]));
    assert!(result(folder, "run") == expected);
}

#[test]
fn a_run_that_is_resumed_where_nothing_can_be_saved_is_left_as_it_was() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    // Refuses to rename a file, always or once.
    let refusing = "#define _GNU_SOURCE\n#include <dlfcn.h>\n#include <errno.h>\n#include <stdlib.h>\n#include <string.h>\n\
        static int refused;\nint rename(const char *a, const char *b) {\n\
        if (!strcmp(getenv(\"REFUSED\"), \"always\") || !refused++) { errno = EIO; return -1; }\n\
        return ((int (*)(const char *, const char *))dlsym(RTLD_NEXT, \"rename\"))(a, b); }\n";
    let Some(library) = preloaded(folder, refusing) else {
        return;
    };
    succeeded(program(
        folder,
        &train(&["--total-steps", "512", "--run-dir", "run"]),
    ));
    let of_run = || {
        let mut files = everything(&folder.join("run"));
        files.retain(|name, _| !name.contains("run.lock"));
        files
    };
    let before = of_run();
    for refused in ["always", "once"] {
        let mut resumed = command(
            folder,
            &["train", "--resume", "run", "--total-steps", "1024"],
        );
        resumed.env("LD_PRELOAD", &library).env("REFUSED", refused);
        let output = resumed.output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        let said = stderr(&output);
        assert!(
            said.contains("cannot write run/") && said.contains("the run folder was not changed"),
            "{said}"
        );
        assert!(of_run() == before, "{refused}: {said}");
    }
}

#[test]
fn rollouts_grow_by_whole_multiples_and_resume_on_either_side_of_it() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let more = [
        "--set",
        "run.checkpoint_every=1",
        "--set",
        "ppo.horizon={from=8,to=24,steps=512}",
    ];
    let args = train(
        &[
            &more[..],
            &["--total-steps", "1280", "--run-dir", "run", "--keep", "9"],
        ]
        .concat(),
    );
    succeeded(program(folder, &args));
    let rows = metrics(&folder.join("run"));
    let at = rows[0].iter().position(|name| name == "env_steps").unwrap();
    let steps: Vec<&str> = rows[1..].iter().map(|row| row[at].as_str()).collect();
    // 16 environments make 8 steps each up to 256, 16 up to 512, and then 24.
    assert_eq!(steps, ["128", "256", "512", "896", "1280"]);
    let expected = result(folder, "run");
    for iteration in [1, 2, 3] {
        succeeded(program(
            folder,
            &[
                "train",
                "--resume",
                &checkpoint(iteration),
                "--total-steps",
                "1280",
                "--keep",
                "9",
            ],
        ));
        assert!(
            result(folder, "run") == expected,
            "from iteration {iteration}"
        );
    }
    for (set, reason) in [
        (
            "ppo.horizon={from=8,to=20}",
            "must be a whole number, or a ramp that ends at a multiple of its start",
        ),
        (
            "ppo.horizon={from=8,to=4}",
            "must be a whole number, or a ramp that ends at a multiple of its start",
        ),
        ("ppo.horizon=2.5", "must be a whole number"),
        (
            "ppo.horizon={from=16,to=1600000}",
            "must give at most 2^22 samples",
        ),
    ] {
        let output = program(folder, &train(&["--set", set]));
        assert!(
            output.status.code() == Some(1) && stderr(&output).contains(reason),
            "{set}: {}",
            stderr(&output)
        );
    }
}

#[test]
fn a_run_whose_folder_is_deleted_before_its_first_iteration_is_done_is_made_anew() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let mut args = train(&["--total-steps", "16384", "--run-dir", "run", "--keep", "9"]);
    ["env.num_envs=256", "ppo.horizon=64"]
        .iter()
        .for_each(|set| args.extend(["--set", set]));
    succeeded(program(folder, &args));
    let args = ["train", "--resume", "run", "--total-steps", "32768"];
    let mut child = command(folder, &args)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(said.next().unwrap().unwrap().contains("run folder"));
    fs::remove_dir_all(folder.join("run")).unwrap();
    said.for_each(drop);
    assert!(child.wait().unwrap().success());
    let latest =
        Checkpoint::parse(&fs::read(folder.join("run/checkpoints/latest.safetensors")).unwrap())
            .unwrap();
    assert_eq!(latest.progress.iteration, 2);
}

#[test]
fn a_newest_checkpoint_that_cannot_be_used_as_asked_is_not_passed_over() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::write(folder.join("own.xml"), SCENE).unwrap();
    run_of_ten(folder, &[]);
    succeeded(resume(
        folder,
        &["--total-steps", "1536", "--set", "env.model=own.xml"],
    ));
    refused(
        folder,
        &["--resume", "run", "--total-steps", "1792"],
        &["no path in a file is followed", "env.model="],
    );
    // A checkpoint of another version.
    let newest = folder.join(checkpoint(12));
    let whole = fs::read(&newest).unwrap();
    let text = String::from_utf8_lossy(&whole).replacen(
        "shadow-repose checkpoint 5",
        "shadow-repose checkpoint 9",
        1,
    );
    let at = whole
        .windows(12)
        .position(|window| window == b"checkpoint 5")
        .unwrap();
    let mut newer = whole.clone();
    newer[at + 11] = b'9';
    assert!(text.contains("checkpoint 9"));
    fs::write(&newest, shadow_repose::ppo::sealed(&newer).unwrap()).unwrap();
    refused(
        folder,
        &["--resume", "run", "--total-steps", "1792"],
        &["its format is `shadow-repose checkpoint 9`"],
    );
    // A checkpoint that no user can read: a folder in its place.
    fs::remove_file(&newest).unwrap();
    fs::remove_file(folder.join("run/checkpoints/latest.safetensors")).unwrap();
    fs::create_dir(folder.join("run/checkpoints/latest.safetensors")).unwrap();
    refused(
        folder,
        &["--resume", "run", "--total-steps", "1792"],
        &["not a regular file"],
    );
}

#[test]
fn a_policy_that_was_moved_away_is_made_anew_from_the_best_checkpoint() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &["--set", "run.eval_every=3"]);
    let best = folder.join("run/checkpoints/best.safetensors");
    let policy = folder.join("run/policy.safetensors");
    // A best checkpoint that nothing can beat.
    let mut unbeatable = Checkpoint::parse(&fs::read(&best).unwrap()).unwrap();
    unbeatable.progress.best = Some([9.0, 0.0]);
    fs::write(&best, unbeatable.to_bytes().unwrap()).unwrap();
    for lose in [true, false] {
        if lose {
            fs::remove_file(&policy).unwrap();
        }
        let total = if lose { "1536" } else { "1792" };
        succeeded(resume(folder, &["--total-steps", total]));
        assert!(
            fs::read(&policy).unwrap() == unbeatable.policy_alone().to_bytes().unwrap(),
            "lost: {lose}"
        );
    }
    // If both are lost, it is the latest policy, without another policy's score.
    fs::remove_file(&policy).unwrap();
    fs::remove_file(&best).unwrap();
    succeeded(resume(folder, &["--total-steps", "1920"]));
    let found = Checkpoint::parse(&fs::read(&policy).unwrap()).unwrap();
    assert_eq!((found.progress.best, found.progress.iteration), (None, 15));
}

#[test]
fn a_damaged_best_checkpoint_is_named_and_put_aside_and_its_score_stays_the_bar() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &["--set", "run.eval_every=3"]);
    let best = folder.join("run/checkpoints/best.safetensors");
    let policy = folder.join("run/policy.safetensors");
    let mut unbeatable = Checkpoint::parse(&fs::read(&policy).unwrap()).unwrap();
    unbeatable.progress.best = Some([9.0, 0.0]);
    let unbeatable = unbeatable.to_bytes().unwrap();
    fs::write(&policy, &unbeatable).unwrap();
    let mut bytes = fs::read(&best).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&best, &bytes).unwrap();
    let output = succeeded(resume(folder, &["--total-steps", "1920"]));
    assert!(
        stderr(&output).contains("best.safetensors is damaged; renamed to")
            && !stderr(&output).contains("/proc/"),
        "{}",
        stderr(&output)
    );
    assert_eq!(
        fs::read(folder.join("run/checkpoints/best.damaged")).unwrap(),
        bytes
    );
    assert!(fs::read(&policy).unwrap() == unbeatable && !best.exists());
}

#[test]
fn a_copy_by_second_names_does_not_write_into_the_original() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &[]);
    assert!(
        std::process::Command::new("cp")
            .args(["-al", "run", "copy"])
            .current_dir(folder)
            .status()
            .unwrap()
            .success()
    );
    let before = everything(&folder.join("run"));
    let args = [
        "train",
        "--resume",
        "copy/checkpoints/iteration-00000006.safetensors",
        "--total-steps",
        "1024",
    ];
    succeeded(program(folder, &args));
    assert_eq!(metrics(&folder.join("copy")).len(), 9);
    assert!(everything(&folder.join("run")) == before);
}

#[test]
fn settings_that_were_edited_in_a_run_folder_are_refused_by_name() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &[]);
    let path = folder.join("run/config.toml");
    let text = fs::read_to_string(&path).unwrap();
    for (from, to, reason) in [
        ("gamma = 0.995", "gamma = 0.5", "ppo.gamma = 0.5, not 0.995"),
        (
            "hold = { from = 3.0,",
            "hold = { from = 4.0,",
            "training.hold = { from = 4.0",
        ),
        ("[ppo]", "[ppo", "not a TOML file"),
        ("gamma = 0.995", "gama = 0.995", "ppo.gama: unknown key"),
    ] {
        assert!(text.contains(from));
        fs::write(&path, text.replace(from, to)).unwrap();
        refused(
            folder,
            &["--resume", "run", "--total-steps", "1408"],
            &[reason, "restore run/config.toml", "delete it"],
        );
    }
    // Edits that do not affect the training are accepted, and so are files from before there were shards.
    let mut sections: Vec<&str> = text.split("\n\n").collect();
    sections.reverse();
    let same = format!("# mine\n{}", sections.join("\n\n"))
        .replace("total_steps = 1280", "total_steps = 9");
    fs::write(
        &path,
        same.replace("shards = 16\n", "")
            .replace("threads = 0", "threads = 1"),
    )
    .unwrap();
    succeeded(resume(folder, &["--total-steps", "1408"]));
    assert!(
        fs::read_to_string(&path)
            .unwrap()
            .contains("total_steps = 1408")
    );
    fs::remove_file(&path).unwrap();
    succeeded(resume(folder, &["--total-steps", "1536"]));
    assert!(fs::read_to_string(&path).unwrap().contains("gamma = 0.995"));
}

#[test]
fn rows_that_are_missing_are_named() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &[]);
    let path = folder.join("run/metrics.csv");
    let text = fs::read_to_string(&path).unwrap();
    let fewer: String = text
        .lines()
        .enumerate()
        .filter(|(i, _)| !(3..=5).contains(i))
        .map(|(_, line)| format!("{line}\n"))
        .collect();
    fs::write(&path, fewer).unwrap();
    let output = succeeded(resume(folder, &["--total-steps", "1408"]));
    assert!(
        stderr(&output).contains("metrics.csv lacks 3 of the 10 rows up to iteration 10"),
        "{}",
        stderr(&output)
    );
    // A fork lacks no rows.
    let output = succeeded(program(
        folder,
        &[
            "train",
            "--fork",
            "run",
            "--total-steps",
            "1536",
            "--run-dir",
            "fork",
        ],
    ));
    assert!(!stderr(&output).contains("lacks"), "{}", stderr(&output));
    let output = succeeded(program(
        folder,
        &["train", "--resume", "fork", "--total-steps", "1664"],
    ));
    assert!(!stderr(&output).contains("lacks"), "{}", stderr(&output));
}

#[test]
fn the_folder_of_its_checkpoints_means_the_run() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    run_of_ten(folder, &[]);
    succeeded(program(
        folder,
        &[
            "play",
            "--ckpt",
            "run/checkpoints",
            "--episodes",
            "1",
            "--json",
        ],
    ));
    succeeded(program(
        folder,
        &[
            "train",
            "--resume",
            "run/checkpoints/",
            "--total-steps",
            "1408",
        ],
    ));
    assert_eq!(iterations(folder), 11);
    refused(
        folder,
        &["--run-dir", "run/checkpoints"],
        &["lies inside the run"],
    );
}
