//! Files that the user may not read or write.

use std::fs::{self, Permissions};
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::process::CommandExt;
use std::path::Path;

use crate::support::{command, program, succeeded, train};

/// The user and group `nobody`.
const NOBODY: u32 = 65534;

/// Returns a folder in which everybody may write.
fn public() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    set_mode(folder.path(), 0o777);
    folder
}

fn set_mode(path: &Path, mode: u32) {
    fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
}

/// Fails unless the program exits with 1 and says this. Permissions do not stop root, so nobody runs the program in its place.
#[track_caller]
fn refused_to_a_user(folder: &Path, args: &[&str], reason: &str) {
    let mut command = command(folder, args);
    if fs::metadata(folder).unwrap().uid() == 0 {
        command.uid(NOBODY).gid(NOBODY);
    }
    match command.output() {
        Err(error) if error.kind() == ErrorKind::PermissionDenied => {
            eprintln!("not tested: only root may start the program here");
        }
        output => {
            let output = output.unwrap();
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(
                output.status.code() == Some(1) && said.contains(reason),
                "{args:?}: {said}"
            );
        }
    }
}

#[test]
fn checkpoints_that_may_not_be_read_are_not_taken_for_none() {
    let place = public();
    let folder = place.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let checkpoints = folder.join("run/checkpoints");
    // Neither listed nor entered, or only listed, or only entered.
    for mode in [0o000, 0o444, 0o111] {
        set_mode(&checkpoints, mode);
        for args in [
            ["play", "--headless", "--ckpt", "run"],
            ["export", "--out=policy.onnx", "--ckpt", "run"],
            ["train", "--quiet", "--resume", "run"],
            ["train", "--quiet", "--fork", "run"],
        ] {
            refused_to_a_user(
                folder,
                &args,
                "cannot read run/checkpoints: Permission denied",
            );
        }
    }
    set_mode(&checkpoints, 0o755);
}

#[test]
fn a_file_that_may_not_be_written_is_not_replaced() {
    let place = public();
    let folder = place.path();
    let own = folder.join("own");
    fs::write(&own, "mine").unwrap();
    set_mode(&own, 0o444);
    for args in [
        &["export", "--ckpt", "builtin", "--out", "own"][..],
        &[
            "play",
            "--ckpt",
            "zero",
            "--episodes",
            "1",
            "--out",
            "jsonl:own",
        ],
    ] {
        refused_to_a_user(folder, args, "cannot write own: Permission denied");
        assert_eq!(fs::read_to_string(&own).unwrap(), "mine");
    }
}
