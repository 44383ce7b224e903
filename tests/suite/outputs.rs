//! Output files that the user names, and messages on the terminal.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::support::{
    SCENE, command, has, must_be_possible, names, obeying_signals, program, stderr, succeeded,
    train,
};

/// The arguments for very short episodes.
const SHORT: [&str; 6] = [
    "play",
    "--ckpt",
    "zero",
    "--set",
    "env.max_episode_seconds=0.1",
    "--headless",
];

/// Runs the program in a shell, with `before` and `after` around its command line.
fn shell(folder: &Path, before: &str, args: &[&str], after: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_shadow-repose");
    let args: Vec<String> = args.iter().map(|arg| format!("'{arg}'")).collect();
    let text = format!("{before} '{program}' {} {after}", args.join(" "));
    Command::new("sh")
        .args(["-c", &text])
        .current_dir(folder)
        .env_remove("DISPLAY")
        .output()
        .unwrap()
}

#[test]
fn what_a_link_leads_to_is_written_and_the_link_stays() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::write(folder.join("target"), "old").unwrap();
    std::os::unix::fs::symlink("target", folder.join("link")).unwrap();
    succeeded(program(
        folder,
        &[&SHORT[..], &["--episodes", "1", "--out", "jsonl:link"]].concat(),
    ));
    assert!(folder.join("link").is_symlink());
    assert!(
        fs::read_to_string(folder.join("target"))
            .unwrap()
            .starts_with("{\"sim_dt\"")
    );
    // A link to stdout, as /dev/stdout is: it gets the trace, then the table.
    let to_stdout = folder.join("stdout");
    std::os::unix::fs::symlink("/dev/fd/1", &to_stdout).unwrap();
    let args = [&SHORT[..], &["--episodes", "1", "--out", "jsonl:stdout"]].concat();
    succeeded(shell(folder, "", &args, "> both"));
    let both = fs::read_to_string(folder.join("both")).unwrap();
    assert!(
        both.starts_with("{\"sim_dt\"") && both.contains("goals per episode"),
        "{both}"
    );
    assert!(to_stdout.is_symlink());
}

#[test]
fn a_result_that_cannot_be_printed_is_an_error() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let bench = [
        "bench",
        "--json",
        "--only",
        "learner",
        "--set",
        "env.num_envs=16",
        "--set",
        "ppo.hidden=[8]",
    ];
    for args in [
        &[&SHORT[..], &["--episodes", "1", "--json"]].concat()[..],
        &SHORT,
        &bench,
        &["--help"],
        &["--version"],
    ] {
        if has("/dev/full") {
            let output = shell(folder, "", args, "> /dev/full");
            assert_eq!(output.status.code(), Some(1), "{args:?}");
            assert!(
                stderr(&output).contains("cannot write to stdout"),
                "{args:?}: {}",
                stderr(&output)
            );
        }
        // A reader that closes the pipe is no error.
        let output = shell(folder, "{ ", args, "; echo $? > code; } | true");
        assert!(stderr(&output).is_empty(), "{args:?}: {}", stderr(&output));
        assert_eq!(
            fs::read_to_string(folder.join("code")).unwrap(),
            "0\n",
            "{args:?}"
        );
    }
}

#[test]
fn a_file_that_grows_beyond_its_limit_is_an_error_like_a_full_disk() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let args = [&SHORT[..], &["--episodes", "30", "--out", "jsonl:trace"]].concat();
    let output = shell(folder, "ulimit -f 1;", &args, "");
    assert_eq!(output.status.code(), Some(1), "{:?}", output.status);
    assert!(
        stderr(&output).contains("File too large"),
        "{}",
        stderr(&output)
    );
    assert_eq!(names(folder), [""; 0]);
}

#[test]
fn one_file_cannot_be_trace_and_page_and_a_folder_must_be_there() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let refused = |args: &[&str], reason: &str| {
        let output = program(folder, args);
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(
            stderr(&output).contains(reason),
            "{args:?}: {}",
            stderr(&output)
        );
        assert_eq!(names(folder), [""; 0], "{args:?}");
    };
    let play = ["play", "--ckpt", "zero", "--plain"];
    refused(
        &[&play[..], &["--out", "a.html", "--out", "jsonl:./a.html"]].concat(),
        "one file cannot be both",
    );
    refused(
        &["play", "--ckpt", "zero", "--out", "jsonl:not there/a"],
        "mkdir -p 'not there'",
    );
    #[cfg(feature = "video")]
    refused(
        &[&play[..], &["--out", "films/a.gif"]].concat(),
        "mkdir -p films",
    );
    refused(&["view", "--out", "pictures/a.png"], "mkdir -p pictures");
    refused(
        &["plot", "runs/*", "--out", "charts/a.svg"],
        "mkdir -p charts",
    );
}

#[test]
fn a_trace_that_is_interrupted_leaves_nothing_behind() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    for (signal, number) in [("TERM", 15), ("INT", 2), ("HUP", 1)] {
        let args = [
            "play",
            "--ckpt",
            "random",
            "--headless",
            "--episodes",
            "100000",
            "--out",
            "jsonl:trace",
        ];
        let mut child = command(folder, &args)
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let begun = Instant::now();
        while names(folder).is_empty() && begun.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(
            Command::new("kill")
                .args([&format!("-{signal}"), &child.id().to_string()])
                .status()
                .unwrap()
                .success()
        );
        // As for a program without handlers. A shell reports 128 plus the signal's number.
        assert_eq!(child.wait().unwrap().signal(), Some(number));
        assert_eq!(names(folder), [""; 0], "{signal}");
    }
}

#[test]
fn a_fatal_error_of_mujoco_leaves_no_unfinished_file() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let little = SCENE.replace("memory=\"2M\"", "memory=\"45K\"");
    fs::write(folder.join("small.xml"), little).unwrap();
    let play = [
        "play",
        "--ckpt",
        "random",
        "--headless",
        "--episodes",
        "64",
        "--out",
        "jsonl:trace",
        "--set",
        "env.model=small.xml",
    ];
    let output = program(folder, &play);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("MuJoCo cannot continue"));
    assert_eq!(names(folder), ["small.xml"]);
}

#[test]
fn as_the_first_process_of_a_container_it_ends_with_128_and_the_number_of_the_signal() {
    let isolates = |flags: &str| {
        Command::new("unshare")
            .args([flags, "--fork", "true"])
            .status()
            .is_ok_and(|s| s.success())
    };
    let Some(flags) = ["--pid", "-Urp"].into_iter().find(|flags| isolates(flags)) else {
        must_be_possible("a container: unshare is missing or not permitted");
        return;
    };
    obeying_signals();
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    for (signal, code) in [("TERM", 143), ("INT", 130), ("HUP", 129)] {
        let mut unshare = Command::new("unshare");
        unshare.args([
            flags,
            "--fork",
            env!("CARGO_BIN_EXE_shadow-repose"),
            "play",
            "--ckpt",
            "random",
            "--headless",
        ]);
        unshare
            .args(["--episodes", "100000", "--out", "jsonl:trace"])
            .current_dir(folder)
            .stderr(Stdio::null());
        let mut unshare = unshare.spawn().unwrap();
        let begun = Instant::now();
        while names(folder).is_empty() && begun.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(5));
        }
        let id = unshare.id();
        let child = fs::read_to_string(format!("/proc/{id}/task/{id}/children")).unwrap();
        assert!(
            Command::new("kill")
                .args([&format!("-{signal}"), child.trim()])
                .status()
                .unwrap()
                .success()
        );
        assert_eq!(unshare.wait().unwrap().code(), Some(code), "{signal}");
        assert_eq!(names(folder), [""; 0], "{signal}");
    }
}

#[test]
fn a_pipe_that_does_not_block_and_is_read_slowly_gets_all_data() {
    let place = tempfile::tempdir().unwrap();
    // F_SETPIPE_SZ makes the pipe small.
    let script = "import fcntl, os, subprocess, sys, time\n\
        read, write = os.pipe()\n\
        fcntl.fcntl(write, 1031, 4096)\n\
        os.set_blocking(write, False)\n\
        child = subprocess.Popen(sys.argv[1:], stdout=write)\n\
        os.close(write)\n\
        while part := os.read(read, 4096):\n    \
            sys.stdout.buffer.write(part)\n    \
            time.sleep(0.02)\n\
        sys.exit(child.wait())\n";
    for args in [
        &["man"][..],
        &["completions", "fish"],
        &["train", "--help"],
        &["runs", "--help"],
    ] {
        let mut python = Command::new("python3");
        python
            .args(["-c", script, env!("CARGO_BIN_EXE_shadow-repose")])
            .args(args)
            .current_dir(place.path());
        let Ok(slow) = python.output() else {
            eprintln!("not tested: python3 is missing");
            return;
        };
        let whole = succeeded(program(place.path(), args)).stdout;
        assert!(succeeded(slow).stdout == whole, "{args:?}");
    }
}

#[test]
fn more_threads_than_make_sense_are_refused() {
    let place = tempfile::tempdir().unwrap();
    for args in [
        &["train", "--threads", "3000"][..],
        &["play", "--threads", "3000", "--headless"],
    ] {
        let output = program(place.path(), args);
        assert_eq!(output.status.code(), Some(1));
        assert!(
            stderr(&output).contains("3000 worker threads: at most"),
            "{}",
            stderr(&output)
        );
    }
    assert_eq!(names(place.path()), [""; 0]);
}

#[test]
fn signals_that_are_ignored_at_the_start_stay_ignored_and_steps_may_be_written_as_powers() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let args = train(&["--total-steps", "9e3", "--run-dir", "run"]);
    let program = env!("CARGO_BIN_EXE_shadow-repose");
    let text = format!("trap '' INT TERM; exec '{program}' \"$@\"");
    let mut shell = Command::new("sh");
    let mut child = shell
        .args(["-c", &text, "sh"])
        .args(&args)
        .current_dir(folder)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(child.stderr.take().unwrap()).lines();
    while !said.next().unwrap().unwrap().contains("run folder") {}
    let rest = std::thread::spawn(move || said.for_each(drop));
    for signal in ["-INT", "-TERM"] {
        let _ = Command::new("kill")
            .args([signal, &child.id().to_string()])
            .status()
            .unwrap();
    }
    assert!(child.wait().unwrap().success(), "it ends by itself");
    rest.join().unwrap();
    assert!(
        fs::read_to_string(folder.join("run/config.toml"))
            .unwrap()
            .contains("total_steps = 9000")
    );
    let refused = crate::support::program(folder, &["train", "--total-steps", "9.5"]);
    assert_eq!(refused.status.code(), Some(2));
}

#[test]
fn a_name_that_is_no_text_is_resumed_as_the_program_says() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let odd = std::ffi::OsStr::from_bytes(b"a \xff\n'x");
    let mut command = command(
        folder,
        &train(&[
            "--total-steps",
            "100000000",
            "--stop-after",
            "50ms",
            "--run-dir",
        ]),
    );
    let output = succeeded(command.arg(odd).output().unwrap());
    let said = stderr(&output);
    let advice = said.lines().last().unwrap().trim();
    // $'…' needs bash.
    let (_, made) = said.split_once(" iterations, ").unwrap();
    let steps: u64 = made.split(' ').next().unwrap().parse().unwrap();
    let text = format!("{advice} --total-steps {}", steps + 128);
    succeeded(
        Command::new("bash")
            .args(["-c", &text])
            .current_dir(folder)
            .output()
            .unwrap(),
    );
    // The plot of such a run is an SVG without control characters.
    let plot = crate::support::command(folder, &["plot"])
        .arg(odd)
        .output()
        .unwrap();
    succeeded(plot);
    let svg = fs::read_to_string(folder.join("learning.svg")).unwrap();
    assert!(
        svg.contains("a \u{fffd}\u{fffd}") && !svg.chars().any(|c| c.is_control() && c != '\n')
    );
}

/// Returns what the program prints on a terminal of this type and width, or `None` if there is no Python to create one.
fn on_a_terminal(folder: &Path, kind: &str, columns: u32, args: &[&str]) -> Option<String> {
    let script = "import fcntl, os, pty, struct, sys, termios\n\
        pid, fd = pty.fork()\n\
        if pid == 0:\n    \
            fcntl.ioctl(2, termios.TIOCSWINSZ, struct.pack('HHHH', 24, int(sys.argv[1]), 0, 0))\n    \
            os.execv(sys.argv[2], sys.argv[2:])\n\
        while True:\n    \
            try:\n        data = os.read(fd, 65536)\n    \
            except OSError:\n        break\n    \
            if not data:\n        break\n    \
            os.write(1, data)\n\
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))\n";
    let mut python = Command::new("python3");
    python
        .args([
            "-c",
            script,
            &columns.to_string(),
            env!("CARGO_BIN_EXE_shadow-repose"),
        ])
        .args(args);
    python
        .current_dir(folder)
        .env("TERM", kind)
        .env_remove("DISPLAY")
        .stderr(Stdio::null());
    let output = python.output().ok()?;
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stdout)
    );
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

#[test]
fn plain_lines_where_a_line_cannot_be_drawn_again_and_one_that_fits_where_it_can() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    for (run, (kind, columns, drawn)) in [
        ("dumb", 80, false),
        ("xterm", 5, false),
        ("", 80, false),
        ("xterm", 120, true),
        ("xterm", 60, true),
    ]
    .iter()
    .enumerate()
    {
        let run = format!("run-{run}");
        let args = train(&[
            "--total-steps",
            "25600",
            "--run-dir",
            &run,
            "--set",
            "run.eval_every=20",
        ]);
        let Some(said) = on_a_terminal(folder, kind, *columns, &args) else {
            eprintln!("not tested: there is no Python to create a terminal");
            return;
        };
        assert!(
            said.contains("steps/s") && said.contains("goals "),
            "{kind} {columns}: {said}"
        );
        assert_eq!(
            said.contains("25.6 k of 25.6 k steps") && !said.contains('\u{1b}'),
            !drawn,
            "{kind} {columns}: {said}"
        );
        if *drawn {
            // The text between control sequences that move the cursor.
            let lines = said
                .split(['\r', '\n', '\u{1b}'])
                .map(|line| line.split_once('K').map_or(line, |(_, rest)| rest));
            let lines: Vec<&str> = lines.filter(|line| line.contains("steps/s")).collect();
            assert!(
                !lines.is_empty()
                    && lines
                        .iter()
                        .all(|line| line.trim_end().len() < *columns as usize),
                "{lines:?}"
            );
            assert_eq!(
                lines
                    .iter()
                    .any(|line| line.contains("drops") && line.contains("eval ")),
                *columns == 120,
                "{lines:?}"
            );
        }
    }
}

#[test]
fn a_quiet_training_says_its_folder_its_evaluations_and_its_end() {
    let place = tempfile::tempdir().unwrap();
    let args = train(&["--total-steps", "256", "--run-dir", "run", "--quiet"]);
    let said = stderr(&succeeded(program(place.path(), &args)));
    assert!(
        said.contains("evaluation of 2 episodes") && said.contains("finished: 2 iterations"),
        "{said}"
    );
    assert!(
        !said.contains("note:") && !said.contains("steps/s"),
        "{said}"
    );
    let args = train(&["--total-steps", "256", "--run-dir", "loud"]);
    let said = stderr(&succeeded(program(place.path(), &args)));
    assert!(
        said.contains("note: minibatches of 64 samples")
            && said.contains("note: run.total_steps = 256"),
        "{said}"
    );
}

#[test]
fn a_training_or_a_score_that_mostly_diverges_says_so() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let sets = [
        "--set",
        "env.cube_mass_scale=1e6",
        "--set",
        "env.sim_dt=0.01",
        "--set",
        "env.friction_scale=1e6",
    ];
    let heavy = SCENE
        .replacen("<option", "<option gravity=\"0 0 -1e12\"", 1)
        .replacen("gravity=\"0 0 -9.81\"", "", 1);
    fs::write(folder.join("heavy.xml"), heavy).unwrap();
    let args = train(
        &[
            &[
                "--total-steps",
                "384",
                "--run-dir",
                "run",
                "--set",
                "env.model=heavy.xml",
            ],
            &sets[..],
        ]
        .concat(),
    );
    let said = stderr(&succeeded(program(folder, &args)));
    assert_eq!(
        said.matches("the physics diverged and the episode ended")
            .count(),
        1,
        "{said}"
    );
    assert!(said.contains("steps of this session diverged"), "{said}");
    let args = [
        &SHORT[..],
        &["--episodes", "4", "--json", "--set", "env.model=heavy.xml"],
        &sets[..],
    ]
    .concat();
    let output = succeeded(program(folder, &args));
    assert!(
        stderr(&output).contains("warning: in 4 of 4 steps the physics diverged"),
        "{}",
        stderr(&output)
    );
    let score: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(score["diverged"], 4);
    let args = [
        &["view", "--check", "--set", "env.model=heavy.xml"][..],
        &sets[..],
    ]
    .concat();
    let table = stderr(&succeeded(program(folder, &args)));
    let held = table
        .lines()
        .find(|line| line.starts_with("zero actions hold it"))
        .expect(&table);
    assert!(!held.ends_with("good"), "{table}");
}

#[test]
fn plot_ends_on_any_file_soon_and_says_little() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let header = "iteration,env_steps,time/collect_s,time/update_s,eval/goals,episode/goals,episode/rot_dist,episode/drop_rate\n";
    let write =
        |name: &str, rows: &str| fs::write(folder.join(name), format!("{header}{rows}")).unwrap();
    write(
        "huge.csv",
        "1,1,1,1,1.7e308,1,1,1\n2,2,1,1,-1.7e308,1,1,1\n",
    );
    write(
        "inf.csv",
        "1,inf,inf,1,1,1,1,1\n2,2,1,1,1,1e30,-1e30,1\n3,1e30,1e30,1,1,1,1,1\n",
    );
    fs::write(folder.join("one-line.csv"), "{\"a\": 1, ".repeat(400_000)).unwrap();
    let plot = |more: &[&str]| {
        let mut command = command(folder, &[&["plot"], more].concat());
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        let (begun, mut most) = (Instant::now(), 0);
        while child.try_wait().unwrap().is_none() {
            let status =
                fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
            let line = status
                .lines()
                .find_map(|line| line.strip_prefix("VmHWM:"))
                .unwrap_or("0 kB");
            most = most.max(line.trim().trim_end_matches(" kB").parse::<u64>().unwrap());
            if begun.elapsed() > Duration::from_secs(10) || most > 512 << 10 {
                let _ = child.kill();
                panic!("{more:?}: {most} KiB after {:?}", begun.elapsed());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        let mut said = String::new();
        child
            .stderr
            .take()
            .unwrap()
            .read_to_string(&mut said)
            .unwrap();
        (child.wait().unwrap().code(), said)
    };
    for file in ["huge.csv", "inf.csv"] {
        for along in ["steps", "hours"] {
            let (code, said) = plot(&[file, "--along", along, "--smooth", "1"]);
            assert!(code == Some(0) && said.len() < 500, "{file}: {said}");
        }
    }
    for file in ["one-line.csv", "/dev/zero"] {
        let (code, said) = plot(&[file]);
        assert!(
            code == Some(1) && said.len() < 500,
            "{file}: {} characters",
            said.len()
        );
    }
}

#[test]
fn no_output_replaces_what_is_read_or_what_a_run_keeps() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "256", "--run-dir", "run"]),
    ));
    fs::copy(
        folder.join("run/policy.safetensors"),
        folder.join("p.safetensors"),
    )
    .unwrap();
    fs::hard_link(folder.join("p.safetensors"), folder.join("hard.svg")).unwrap();
    std::os::unix::fs::symlink("p.safetensors", folder.join("soft.svg")).unwrap();
    std::os::unix::fs::symlink("run", folder.join("other")).unwrap();
    fs::copy(folder.join("run/metrics.csv"), folder.join("table.svg")).unwrap();
    fs::write(folder.join("scene.xml"), SCENE).unwrap();
    let content = |path: PathBuf| (path.clone(), fs::read(path).unwrap());
    let files = ["run", "run/checkpoints", "."].map(|inner| {
        let names = names(&folder.join(inner))
            .into_iter()
            .map(|name| folder.join(inner).join(name));
        names
            .filter(|path| path.is_file())
            .map(content)
            .collect::<Vec<_>>()
    });
    let play = [
        "play",
        "--headless",
        "--episodes",
        "1",
        "--set",
        "env.max_episode_seconds=0.1",
    ];
    let own = ["--ckpt", "p.safetensors"];
    let refused: [(&[&str], &[&str], &str); 14] = [
        (
            &["export"],
            &["--ckpt", "p.safetensors", "--out", "p.safetensors"],
            "the input",
        ),
        (
            &["export"],
            &["--ckpt", "p.safetensors", "--out", "./run/../p.safetensors"],
            "the input",
        ),
        (
            &["export"],
            &["--ckpt", "p.safetensors", "--out", "hard.svg"],
            "the input",
        ),
        (
            &["export"],
            &["--ckpt", "p.safetensors", "--out", "soft.svg"],
            "the input",
        ),
        (
            &["export"],
            &["--ckpt", "run", "--out", "run/checkpoints/best.safetensors"],
            "the input",
        ),
        (
            &["export"],
            &[
                "--ckpt",
                "run",
                "--out",
                "run/checkpoints/latest.safetensors",
            ],
            "reserves",
        ),
        (
            &["export"],
            &["--ckpt", "run", "--out", "other/config.toml"],
            "reserves",
        ),
        (
            &["export"],
            &["--ckpt", "builtin", "--out", "run/policy.safetensors"],
            "reserves",
        ),
        (
            &play,
            &["--out", "jsonl:p.safetensors", "--ckpt", "p.safetensors"],
            "the input",
        ),
        (
            &play,
            &["--out", "jsonl:run/metrics.csv", "--ckpt", "builtin"],
            "reserves",
        ),
        (
            &play,
            &["--out", "jsonl:run/finished", "--ckpt", "builtin"],
            "reserves",
        ),
        (
            &play,
            &[
                "--out",
                "jsonl:scene.xml",
                "--ckpt",
                "zero",
                "--set",
                "env.model=scene.xml",
            ],
            "the input",
        ),
        (
            &["play", "--robustness", "--out", "hard.svg"],
            &own,
            "the input",
        ),
        (&["plot", "table.svg"], &["--out", "table.svg"], "the input"),
    ];
    for (command, more, reason) in refused {
        let output = program(folder, &[command, more].concat());
        assert_eq!(
            output.status.code(),
            Some(1),
            "{more:?}: {}",
            stderr(&output)
        );
        assert!(
            stderr(&output).contains(reason),
            "{more:?}: {}",
            stderr(&output)
        );
    }
    for (path, before) in files.into_iter().flatten() {
        assert!(
            fs::read(&path).unwrap() == before,
            "{} has changed",
            path.display()
        );
    }
    // New names are free, and what is not the program's may be replaced.
    for _ in 0..2 {
        succeeded(program(
            folder,
            &["export", "--ckpt", "run", "--out", "run/policy.onnx"],
        ));
        succeeded(program(
            folder,
            &[
                "export",
                "--ckpt",
                "run",
                "--out",
                "run/checkpoints/mine.onnx",
            ],
        ));
    }
}

#[test]
fn no_output_replaces_a_file_that_a_scene_reads() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    ["scenes/parts", "scenes/meshes/in"]
        .iter()
        .for_each(|inner| fs::create_dir_all(folder.join(inner)).unwrap());
    let scene = SCENE.replacen(
        "autolimits=\"true\"/>",
        "autolimits=\"true\" meshdir = 'meshes'/><include file='parts/more.svg'/>",
        1,
    );
    fs::write(folder.join("scenes/s.xml"), &scene).unwrap();
    let more = "<mujoco><!-- <a --><asset><mesh name=\"m\"\n file = \"m.obj\"/>\
        <mesh name=\"<!--\" file=\"in\\a&amp;&#98;.obj\"/></asset></mujoco>";
    fs::write(folder.join("scenes/parts/more.svg"), more).unwrap();
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    for name in ["m.obj", "in/a&b.obj"] {
        fs::write(folder.join("scenes/meshes").join(name), corners).unwrap();
    }
    std::os::unix::fs::symlink("scenes/meshes/m.obj", folder.join("link")).unwrap();
    let play = [
        "play",
        "--headless",
        "--episodes",
        "1",
        "--set",
        "env.max_episode_seconds=0.1",
    ];
    let refused: [(&[&str], &[&str], &str); 5] = [
        (
            &["export", "--ckpt", "builtin"],
            &["--out", "scenes/parts/more.svg"],
            "s.xml",
        ),
        (
            &["export", "--ckpt", "builtin"],
            &["--out", "link"],
            "s.xml",
        ),
        (
            &play,
            &["--out", "html:scenes/meshes/m.obj", "--ckpt", "zero"],
            "s.xml",
        ),
        (
            &play,
            &["--out", "html:scenes/meshes/in/a&b.obj", "--ckpt", "zero"],
            "s.xml",
        ),
        (
            &play,
            &[
                "--robustness",
                "--out",
                "scenes/parts/more.svg",
                "--ckpt",
                "builtin",
            ],
            "s.xml",
        ),
    ];
    for (command, more, scene) in refused {
        let model = format!("env.model=scenes/{scene}");
        let output = program(folder, &[command, more, &["--set", &model]].concat());
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.contains("the input"),
            "{more:?}: {said}"
        );
    }
    assert_eq!(
        fs::read_to_string(folder.join("scenes/meshes/m.obj")).unwrap(),
        corners
    );
    assert_eq!(
        fs::read_to_string(folder.join("scenes/parts/more.svg")).unwrap(),
        more
    );
    // What the scene does not read is free.
    let model = ["--ckpt", "builtin", "--set", "env.model=scenes/s.xml"];
    succeeded(program(
        folder,
        &[&["export", "--out", "scenes/meshes/other.obj"], &model[..]].concat(),
    ));
}

#[test]
fn in_a_run_only_the_names_of_its_own_files_are_taken_even_before_they_are_there() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let export = |out: &str| program(folder, &["export", "--ckpt", "builtin", "--out", out]);
    for free in [
        "run/checkpoints/best.onnx",
        "run/checkpoints/latest.onnx",
        "run/checkpoints/iteration-00000001.onnx",
        "run/checkpoints.svg",
        "run/diverged.svg",
        "run/metrics.csv.svg",
        "run/policy.safetensors.onnx",
    ] {
        (0..2).for_each(|_| drop(succeeded(export(free))));
    }
    std::os::unix::fs::symlink(
        "run/checkpoints/iteration-00000098.safetensors",
        folder.join("link"),
    )
    .unwrap();
    for taken in [
        "run/checkpoints/iteration-00000099.safetensors",
        "run/checkpoints/iteration-99.safetensors",
        "run/../run/metrics.before-3.csv",
        "link",
    ] {
        let output = export(taken);
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1)
                && said.contains("the run ")
                && said.contains("reserves"),
            "{taken}: {said}"
        );
    }
    succeeded(program(
        folder,
        &["train", "--resume", "run", "--total-steps", "256"],
    ));
}

#[test]
fn foreign_words_neither_steer_the_terminal_nor_begin_lines() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let scene = SCENE.replacen(
        "name=\"cube\" type=\"box\"",
        "name=\"cu\u{202e}\u{2066}be\" type=\"box\"",
        1,
    );
    fs::write(
        folder.join("s.xml"),
        scene.replacen("friction=\"1.2\"", "friction=\"nan\"", 1),
    )
    .unwrap();
    fs::write(
        folder.join("own.toml"),
        "[env]\n\"a\\nerror: \\u202eb\" = 1\n\"\\u200f\" = 1",
    )
    .unwrap();
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", "run"]),
    ));
    let latest = folder.join("run/checkpoints/latest.safetensors");
    let mut bad = shadow_repose::ppo::Checkpoint::parse(&fs::read(latest).unwrap()).unwrap();
    bad.config = bad
        .config
        .replace("model = \"builtin\"", "model = \"\\nerror: \\u202eb\"");
    fs::write(folder.join("p.safetensors"), bad.to_bytes().unwrap()).unwrap();
    let lock = fs::File::options()
        .write(true)
        .truncate(true)
        .open(folder.join("run/run.lock"))
        .unwrap();
    lock.lock().unwrap();
    fs::write(folder.join("run/run.lock"), "\n\nerror: all lost\u{202e}").unwrap();
    for args in [
        &[
            "play",
            "--ckpt",
            "zero",
            "--set",
            "env.model=s.xml",
            "--headless",
        ][..],
        &["train", "--config", "own.toml"],
        &["play", "--ckpt", "p.safetensors", "--headless"],
        &["train", "--resume", "run", "--total-steps", "256"],
    ] {
        let said = stderr(&program(folder, args));
        let errors = said
            .lines()
            .filter(|line| line.trim_start().starts_with("error"))
            .count();
        let steers = |c: char| ('\u{200b}'..'\u{2070}').contains(&c) && !"–—‘’“”…".contains(c);
        assert!(errors == 1 && !said.contains(steers), "{args:?}: {said:?}");
    }
}
