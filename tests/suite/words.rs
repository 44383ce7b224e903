//! What the program says about itself: help, version, completions, and what comes next.

use clap::ValueEnum;

use crate::support::{command, program, stderr, succeeded, train};

const COMMANDS: [&str; 9] = [
    "train",
    "play",
    "view",
    "export",
    "plot",
    "runs",
    "bench",
    "completions",
    "man",
];

fn stdout(args: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    String::from_utf8(succeeded(program(folder.path(), args)).stdout).unwrap()
}

#[test]
fn each_help_fits_a_terminal_and_ends_with_two_examples_that_are_valid() {
    for name in COMMANDS.iter().copied().chain([""]) {
        let args: Vec<&str> = if name.is_empty() {
            vec!["--help"]
        } else {
            vec![name, "--help"]
        };
        let help = stdout(&args);
        assert!(
            help.lines().all(|line| line.chars().count() <= 100),
            "{help}"
        );
        assert!(
            !help.contains("{") && !help.contains("run."),
            "defaults are values: {help}"
        );
        let (_, examples) = help.split_once("\nExamples:\n").unwrap();
        let examples: Vec<&str> = examples.lines().collect();
        assert_eq!(examples.len(), 2, "{help}");
        for example in examples {
            let words: Vec<&str> = example
                .split(['|', '>'])
                .next()
                .unwrap()
                .split_whitespace()
                .collect();
            assert!(
                words[0] == "shadow-repose" && (name.is_empty() || words[1] == name),
                "{example}"
            );
            shadow_repose::cli::command()
                .try_get_matches_from(words)
                .unwrap();
        }
        assert_eq!(stdout(&[&args[..args.len() - 1], &["-h"]].concat()), help);
    }
}

#[test]
fn no_help_shows_what_its_command_does_not_do() {
    let (view, play) = (stdout(&["view", "--help"]), stdout(&["play", "--help"]));
    assert!(
        !view.contains("for a film") && !view.contains("640x480") && view.contains("1280x720"),
        "{view}"
    );
    assert!(
        !play.contains("1280x720") && play.contains("[default: 640x480]"),
        "{play}"
    );
    let folder = tempfile::tempdir().unwrap();
    for args in [
        &["view", "--size", "64x64"][..],
        &["play", "--window", "--size", "64x64"],
    ] {
        let output = program(folder.path(), args);
        assert!(
            output.status.code() == Some(2)
                && stderr(&output).contains("it applies only to a film or a picture"),
            "{args:?}"
        );
    }
    assert!(stdout(&["train", "--help"]).contains("[default: 200000000]"));
}

#[test]
fn the_version_names_the_commit_and_mujoco() {
    let version = stdout(&["--version"]);
    let inside = version
        .strip_prefix("shadow-repose 0.3.0 (")
        .unwrap()
        .strip_suffix(")\n")
        .unwrap();
    let (commit, mujoco) = inside.split_once(", ").unwrap();
    assert!(!commit.is_empty() && mujoco == "MuJoCo 3.17.0", "{version}");
}

#[test]
fn completions_and_a_manual_page_know_every_command() {
    for shell in ["bash", "zsh", "fish"] {
        let text = stdout(&["completions", shell]);
        let is_word = |word: &str| {
            text.split(|c: char| !c.is_alphanumeric() && c != '-')
                .any(|found| found == word)
        };
        assert!(
            COMMANDS.iter().all(|name| is_word(name)) && text.contains("stop-after"),
            "{shell}"
        );
    }
    // The program writes these two lines itself, also where there is no fish to try them.
    let fish = stdout(&["completions", "fish"]);
    let shells = clap_complete::Shell::value_variants();
    let shells = Vec::from_iter(shells.iter().map(ToString::to_string)).join(" ");
    for words in [shells, format!("{} help", COMMANDS.join(" "))] {
        assert!(fish.contains(&format!("-a \"{words}\"\n")), "{words}");
    }
    let page = stdout(&["man"]);
    for name in COMMANDS {
        assert!(
            page.contains(&format!(".SH \"SHADOW-REPOSE {}\"", name.to_uppercase())),
            "{name}"
        );
    }
    assert!(page.starts_with(".ie") || page.starts_with(".TH"), "{page}");
}

/// Returns what a shell answers to a script.
fn shell(name: &str, args: &[&str]) -> Option<String> {
    let output = std::process::Command::new(name).args(args).output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

#[test]
fn shells_complete_options_and_values_after_a_command() {
    let folder = tempfile::tempdir().unwrap();
    let script = |shell: &str| {
        let path = folder.path().join(shell);
        std::fs::write(&path, stdout(&["completions", shell])).unwrap();
        path.display().to_string()
    };
    let (bash, fish) = (script("bash"), script("fish"));
    let cases = [
        (&["train", "--re"][..], "--resume"),
        (&["play", "--rob"], "--robustness"),
        (&["bench", "--only", "le"], "learner"),
        (&["completions", "zs"], "zsh"),
        (&["play", "--quality", "fa"], "fast"),
        (&["view", "--quality", "hi"], "high"),
        (&["pla"], "play"),
    ];
    for (words, expected) in cases {
        let (line, last) = (words.join(" "), words.len());
        let text = format!(
            "source '{bash}'; f=$(complete -p shadow-repose | sed 's/.*-F \\([^ ]*\\).*/\\1/'); \
             COMP_WORDS=(shadow-repose {line}); COMP_CWORD={last}; \
             $f shadow-repose \"${{COMP_WORDS[{last}]}}\" \"${{COMP_WORDS[{last}-1]}}\"; echo \"${{COMPREPLY[*]}}\""
        );
        assert_eq!(
            shell("bash", &["-c", &text]).as_deref(),
            Some(expected),
            "bash: {line}"
        );
        let text = format!("source '{fish}'; complete -C 'shadow-repose {line}'");
        if let Some(found) = shell("fish", &["--no-config", "-c", &text]) {
            assert!(
                found
                    .lines()
                    .any(|answer| answer.split('\t').next() == Some(expected)),
                "fish: {line}: {found}"
            );
        }
    }
    for (line, expected) in [
        ("completions ", "bash elvish fish powershell zsh"),
        ("help ", &COMMANDS.join(" ")),
    ] {
        let text = format!("source '{fish}'; complete -C 'shadow-repose {line}'");
        if let Some(found) = shell("fish", &["--no-config", "-c", &text]) {
            let found: Vec<&str> = found
                .lines()
                .filter_map(|answer| answer.split('\t').next())
                .collect();
            assert!(
                expected.split(' ').all(|word| found.contains(&word)),
                "fish: {line}: {found:?}"
            );
            assert!(found.len() <= COMMANDS.len() + 1, "no files: {found:?}");
        }
    }
}

#[test]
fn a_run_says_at_its_end_what_comes_next_in_the_way_it_was_called() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&["--total-steps", "128", "--run-dir", "my runs/run"]);
    let said = stderr(&succeeded(program(folder.path(), &args)));
    let path = env!("CARGO_BIN_EXE_shadow-repose");
    for line in [
        &format!("{path} play --ckpt 'my runs/run'"),
        &format!("{path} plot 'my runs/run'"),
        "tensorboard --logdir 'my runs'",
    ] {
        assert!(
            said.lines().any(|found| found.trim() == line),
            "{line} is not in\n{said}"
        );
    }
    // As `cargo run --release` calls it.
    let args = train(&["--total-steps", "128", "--run-dir", "run"]);
    let said = stderr(&succeeded(
        command(folder.path(), &args)
            .env("CARGO_PKG_NAME", "shadow-repose")
            .output()
            .unwrap(),
    ));
    assert!(
        said.contains("\n  cargo run --release -- play --ckpt run\n"),
        "{said}"
    );
    let stopped = ["--run-dir", "kept", "--keep", "6", "--stop-after", "1s"];
    let said = stderr(&succeeded(program(folder.path(), &train(&stopped))));
    let resumes = format!("{path} train --resume kept --keep 6");
    assert!(said.lines().any(|line| line.trim() == resumes), "{said}");
    let args = train(&["--total-steps", "128", "--run-dir", "quiet", "--quiet"]);
    let said = stderr(&succeeded(program(folder.path(), &args)));
    assert!(
        said.trim_end()
            .lines()
            .last()
            .unwrap()
            .starts_with("finished: "),
        "{said}"
    );
}

#[test]
fn resume_without_a_value_takes_the_newest_run_and_a_finished_one_says_how_to_continue() {
    let folder = tempfile::tempdir().unwrap();
    let none = program(folder.path(), &["train", "--resume"]);
    assert!(
        !none.status.success() && stderr(&none).contains("there is no run"),
        "{}",
        stderr(&none)
    );
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--name", "first"]),
    ));
    succeeded(program(
        folder.path(),
        &train(&["--total-steps", "128", "--name", "second"]),
    ));
    let done = stderr(&succeeded(program(folder.path(), &["train", "--resume"])));
    assert!(
        done.contains("second is finished: 1 iterations") && done.contains("--total-steps"),
        "{done}"
    );
    let said = stderr(&succeeded(program(
        folder.path(),
        &["train", "--resume", "--total-steps", "256"],
    )));
    assert!(said.contains("finished: 2 iterations"), "{said}");
}

#[test]
fn the_score_fits_60_columns_and_one_episode_has_no_interval() {
    let short = [
        "play",
        "--ckpt",
        "builtin",
        "--headless",
        "--set",
        "env.max_episode_seconds=0.1",
        "--episodes",
    ];
    for (count, has_interval) in [("1", false), ("2", true)] {
        let folder = tempfile::tempdir().unwrap();
        let output = succeeded(program(folder.path(), &[&short[..], &[count]].concat()));
        let table = String::from_utf8(output.stdout.clone()).unwrap();
        assert!(
            table.lines().all(|line| line.chars().count() <= 60),
            "{table}"
        );
        assert_eq!(table.contains("95 % interval"), has_interval, "{table}");
        assert!(
            stderr(&output).starts_with("playing the built-in policy"),
            "{}",
            stderr(&output)
        );
    }
}
