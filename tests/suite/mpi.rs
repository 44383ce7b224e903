//! Trainings on several ranks. Those by MPI need a program that was built with it, and its launcher.

use std::ffi::OsString;
use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use crate::support::{command, program, stderr, succeeded, train};
use crate::survival::{begun, ended_by, iterations, result, resume};

/// Iterations that have everything in them: episodes end, goals are reached, evaluations are rarer than checkpoints.
const LONG: &[&str] = &[
    "--set=env.max_episode_seconds=1",
    "--set=run.eval_every=7",
    "--set=run.eval_episodes=5",
    "--set=run.checkpoint_every=3",
    "--set=training.tolerance=1.4",
    "--set=training.hold=3",
    "--set=randomization.share=0.5",
    "--set=randomization.friction=[0.5,1.5]",
];

/// The launcher, and the program that was built with MPI.
struct Mpi {
    launcher: OsString,
    program: OsString,
}

/// Returns the launcher and program that CI has prepared.
fn mpi() -> Option<Mpi> {
    let [launcher, program] =
        ["SHADOW_REPOSE_MPIRUN", "SHADOW_REPOSE_MPI_PROGRAM"].map(std::env::var_os);
    if launcher.is_none() || program.is_none() {
        eprintln!(
            "not tested: SHADOW_REPOSE_MPIRUN and SHADOW_REPOSE_MPI_PROGRAM do not name an mpirun and a program with MPI"
        );
    }
    Some(Mpi {
        launcher: launcher?,
        program: program?,
    })
}

impl Mpi {
    /// Returns the command that runs the program on this number of ranks in `folder`.
    fn command(&self, folder: &Path, ranks: usize, args: &[&str]) -> Command {
        crate::support::obeying_signals();
        let mut command = Command::new(&self.launcher);
        command
            .current_dir(folder)
            .env_remove("DISPLAY")
            .env_remove("WAYLAND_DISPLAY")
            .env_remove("CARGO_PKG_NAME");
        // More ranks than cores, and CI runs as root.
        command
            .env("OMPI_ALLOW_RUN_AS_ROOT", "1")
            .env("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1");
        command.args([
            "--map-by",
            ":OVERSUBSCRIBE",
            "--bind-to",
            "none",
            "-n",
            &ranks.to_string(),
        ]);
        command.arg(&self.program).args(args);
        command
    }

    fn run(&self, folder: &Path, ranks: usize, args: &[&str]) -> Output {
        self.command(folder, ranks, args).output().unwrap()
    }
}

fn steps(iterations: usize) -> String {
    (iterations * 128).to_string()
}

fn training<'a>(more: &[&'a str]) -> Vec<&'a str> {
    train(&[&["--run-dir", "run", "--threads", "1"], LONG, more].concat())
}

#[test]
fn several_ranks_come_to_the_bits_of_one_and_resume_on_another_number() {
    let Some(mpi) = mpi() else { return };
    let alone = tempfile::tempdir().unwrap();
    succeeded(program(
        alone.path(),
        &training(&["--total-steps", &steps(20)]),
    ));
    let expected = result(alone.path(), "run");
    for ranks in [2, 4] {
        let folder = tempfile::tempdir().unwrap();
        let said = stderr(&succeeded(mpi.run(
            folder.path(),
            ranks,
            &training(&["--total-steps", &steps(20)]),
        )));
        assert!(result(folder.path(), "run") == expected, "on {ranks} ranks");
        // The others are silent.
        assert!(
            said.matches("finished: 20 iterations").count() == 1 && !said.contains("rank "),
            "{said}"
        );
        let again = mpi.run(
            folder.path(),
            ranks,
            &["train", "--resume", "run", "--total-steps", &steps(20)],
        );
        assert!(
            stderr(&succeeded(again)).contains("is finished: 20 iterations"),
            "all of them end"
        );
    }
    for [first, second] in [[4, 1], [1, 4]] {
        let folder = tempfile::tempdir().unwrap();
        succeeded(mpi.run(
            folder.path(),
            first,
            &training(&["--total-steps", &steps(10)]),
        ));
        let more = ["train", "--resume", "run", "--total-steps", &steps(20)];
        succeeded(mpi.run(folder.path(), second, &more));
        assert!(
            result(folder.path(), "run") == expected,
            "on {first}, then on {second} ranks"
        );
    }
}

#[test]
fn evaluations_that_no_longer_rise_end_all_ranks_after_the_same_iteration() {
    let Some(mpi) = mpi() else { return };
    let waits = [
        "--total-steps",
        &steps(200),
        "--set=run.patience=1",
        "--set=run.eval_every=2",
    ];
    let [alone, together] = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    succeeded(program(alone.path(), &training(&waits)));
    let said = stderr(&succeeded(mpi.run(together.path(), 2, &training(&waits))));
    assert!(said.contains("evaluations no longer rise: "), "{said}");
    assert!(result(together.path(), "run") == result(alone.path(), "run"));
}

#[test]
fn if_a_rank_is_killed_all_end_at_once_and_the_run_resumes() {
    let Some(mpi) = mpi() else { return };
    let folder = tempfile::tempdir().unwrap();
    let (mut launcher, _lines) =
        begun(mpi.command(folder.path(), 2, &training(&["--total-steps", "100000000"])));
    while iterations(folder.path()) < 5 {
        std::thread::sleep(Duration::from_millis(50));
    }
    let ranks = Command::new("pgrep")
        .args(["--parent", &launcher.id().to_string()])
        .output()
        .unwrap()
        .stdout;
    let ranks = String::from_utf8(ranks).unwrap();
    let killed = ranks
        .lines()
        .last()
        .expect("the launcher has started ranks");
    let since = Instant::now();
    assert!(
        Command::new("kill")
            .args(["-KILL", killed])
            .status()
            .unwrap()
            .success()
    );
    assert!(!launcher.wait().unwrap().success());
    assert!(
        since.elapsed() < Duration::from_secs(10),
        "it took {:?}",
        since.elapsed()
    );
    // One process continues where both were, and comes to the same end.
    let total = steps(iterations(folder.path()) as usize + 10);
    succeeded(resume(folder.path(), &["--total-steps", &total]));
    let undisturbed = tempfile::tempdir().unwrap();
    succeeded(program(
        undisturbed.path(),
        &training(&["--total-steps", &total]),
    ));
    assert!(result(folder.path(), "run") == result(undisturbed.path(), "run"));
}

#[test]
fn an_error_of_one_rank_names_it_and_ends_all() {
    let Some(mpi) = mpi() else { return };
    let folder = tempfile::tempdir().unwrap();
    let refused = mpi.run(
        folder.path(),
        2,
        &["train", "--set", "env.model=nowhere.xml"],
    );
    let said = stderr(&refused);
    assert!(
        !refused.status.success() && said.matches("cannot find nowhere.xml").count() == 1,
        "{said}"
    );
    let refused = mpi.run(folder.path(), 4, &training(&["--set", "run.shards=2"]));
    let said = stderr(&refused);
    assert!(
        !refused.status.success()
            && said
                .matches("4 ranks, but the training run has only 2 shards")
                .count()
                == 1,
        "{said}"
    );
    assert!(
        !folder.path().join("run").exists(),
        "a start that is refused leaves nothing"
    );
    // A rank that runs another program than the first.
    let copy = folder.path().join("other");
    fs::copy(&mpi.program, &copy).unwrap();
    fs::OpenOptions::new()
        .append(true)
        .open(&copy)
        .unwrap()
        .write_all(b"changed")
        .unwrap();
    let mut mixed = mpi.command(folder.path(), 1, &training(&[]));
    mixed.args([":", "-n", "1"]).arg(&copy).args(training(&[]));
    let refused = mixed.output().unwrap();
    let said = stderr(&refused);
    assert!(
        !refused.status.success()
            && said
                .matches("rank 1 runs another program than rank 0")
                .count()
                == 1,
        "{said}"
    );
    assert!(!folder.path().join("run").exists());
}

#[test]
fn a_file_named_stop_ends_a_training_after_it_has_saved() {
    let folder = tempfile::tempdir().unwrap();
    let endless = training(&[
        "--total-steps",
        "100000000",
        "--set=run.checkpoint_every=1000000",
    ]);
    let mut commands = vec![command(folder.path(), &endless)];
    commands.extend(mpi().map(|mpi| mpi.command(folder.path(), 2, &["train", "--resume", "run"])));
    for start in commands {
        let (mut child, lines) = begun(start);
        fs::write(folder.path().join("run/stop"), "").unwrap();
        let said: Vec<String> = lines.map_while(Result::ok).collect();
        assert!(child.wait().unwrap().success(), "{said:?}");
        assert!(
            said.iter()
                .any(|line| line.contains("stopped by the file `stop` after")),
            "{said:?}"
        );
        assert!(!folder.path().join("run/stop").exists());
    }
    let saved = iterations(folder.path());
    let resumed = succeeded(resume(
        folder.path(),
        &["--total-steps", &(128 * (saved + 1)).to_string()],
    ));
    assert!(
        stderr(&resumed).contains(&format!("finished: {} iterations", saved + 1)),
        "{}",
        stderr(&resumed)
    );
}

#[test]
fn ranks_that_cannot_find_one_another_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let in_launcher = |args: &[&str], rank: &str| {
        let mut command = command(folder.path(), args);
        command
            .env("PMI_SIZE", "2")
            .env("PMI_RANK", rank)
            .output()
            .unwrap()
    };
    let refused = in_launcher(&training(&[]), "0");
    assert!(
        refused.status.code() == Some(1) && stderr(&refused).contains("this build has no MPI"),
        "{}",
        stderr(&refused)
    );
    assert!(!folder.path().join("run").exists());
    for command in [
        &["play", "--ckpt", "builtin"][..],
        &["plot", "."],
        &["bench"],
    ] {
        let refused = in_launcher(command, "0");
        assert!(
            refused.status.code() == Some(1)
                && stderr(&refused).contains("only `train` runs on several ranks")
        );
        let other = in_launcher(command, "1");
        assert_eq!(
            (other.status.code(), stderr(&other)),
            (Some(1), String::new()),
            "one of them says it"
        );
    }
}

#[test]
fn a_signal_to_save_reaches_all_ranks() {
    let Some(mpi) = mpi() else { return };
    let folder = tempfile::tempdir().unwrap();
    let rare = [
        "--total-steps",
        "100000000",
        "--set=run.checkpoint_every=1000000",
    ];
    let (child, lines) = begun(mpi.command(folder.path(), 2, &training(&rare)));
    crate::survival::send("USR1", &child);
    let checkpoints = folder.path().join("run/checkpoints");
    let since = Instant::now();
    while crate::support::names(&checkpoints)
        .iter()
        .filter(|name| name.starts_with("iteration-"))
        .count()
        < 2
    {
        assert!(
            since.elapsed() < Duration::from_secs(60),
            "nothing was saved"
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    let (code, _) = ended_by("TERM", child, lines);
    assert_ne!(code, Some(0));
    succeeded(resume(folder.path(), &["--stop-after", "1s"]));
}
