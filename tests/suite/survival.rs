//! A training that is stopped or killed resumes as if nothing had happened.

use std::fs;
use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rand::RngExt;
use shadow_repose::rng;
use shadow_repose::sim::{Compilation, Cone, Scene, Simulation};

use crate::support::{
    SCENE, command, events, metrics, names, obeying_signals, preloaded, program, stderr, succeeded,
    train, weights,
};

/// The result of a run: weights, optimizer and environments of its latest checkpoint, its policy, its metrics, its score.
pub(crate) type Result = (
    Vec<(String, Vec<u8>)>,
    Vec<(String, Vec<u8>)>,
    Vec<Vec<String>>,
    String,
);

pub(crate) fn result(folder: &Path, run: &str) -> Result {
    let run = folder.join(run);
    let checkpoint = run
        .join("checkpoints/latest.safetensors")
        .display()
        .to_string();
    let score = succeeded(program(
        folder,
        &["play", "--ckpt", &checkpoint, "--episodes", "3", "--json"],
    ))
    .stdout;
    let mut score: serde_json::Value = serde_json::from_slice(&score).unwrap();
    score.as_object_mut().unwrap().remove("checkpoint");
    (
        weights(checkpoint.into()),
        weights(run.join("policy.safetensors")),
        metrics(&run),
        score.to_string(),
    )
}

pub(crate) fn resume(folder: &Path, more: &[&str]) -> Output {
    program(folder, &[&["train", "--resume", "run"], more].concat())
}

/// Starts a training in `run` that does not end by itself, and waits until it has reported its first iteration.
pub(crate) fn endless(folder: &Path, more: &[&str]) -> (Child, Lines<BufReader<ChildStderr>>) {
    let args = train(&[&["--total-steps", "100000000", "--run-dir", "run"], more].concat());
    begun(command(folder, &args))
}

pub(crate) fn begun(mut command: Command) -> (Child, Lines<BufReader<ChildStderr>>) {
    obeying_signals();
    let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
    kill_after_five_minutes(&child);
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    while !lines
        .next()
        .expect("the training is running")
        .unwrap()
        .contains("steps/s")
    {}
    (child, lines)
}

/// Whatever goes wrong, no test waits forever.
fn kill_after_five_minutes(child: &Child) {
    let id = child.id().to_string();
    std::thread::spawn(move || {
        std::thread::sleep(Duration::from_secs(300));
        let _ = Command::new("kill").args(["-KILL", &id]).status();
    });
}

pub(crate) fn send(signal: &str, child: &Child) {
    let sent = Command::new("kill")
        .args([&format!("-{signal}"), &child.id().to_string()])
        .status()
        .unwrap();
    assert!(sent.success());
}

/// Ends a training by a signal. Returns its exit code and what it printed afterwards.
pub(crate) fn ended_by(
    signal: &str,
    mut child: Child,
    lines: Lines<BufReader<ChildStderr>>,
) -> (Option<i32>, String) {
    send(signal, &child);
    let rest: Vec<String> = lines.map_while(|line| line.ok()).collect();
    (child.wait().unwrap().code(), rest.join("\n"))
}

pub(crate) fn iterations(folder: &Path) -> u64 {
    metrics(&folder.join("run")).last().unwrap()[0]
        .parse()
        .unwrap_or(0)
}

/// Settings for episodes with contacts, goals that are reached and replaced, and ends, some of them in every iteration.
/// Evaluations are rarer than checkpoints. Everything that training adds is there, with ramps that end during the run.
const LONG: &[&str] = &[
    "--set=env.max_episode_seconds=2",
    "--set=env.success_tolerance=2",
    "--set=env.max_consecutive_successes=5",
    "--set=run.eval_every=7",
    "--set=run.checkpoint_every=3",
    "--set=training.progress_reward=50",
    "--set=training.drop_reward={from=-9,to=-100,steps=2000}",
    "--set=training.tolerance={from=3,to=1.4,steps=4000}",
    "--set=training.hold.steps=3000",
    "--set=training.goal_lifetime=20",
    "--set=training.hold_reward=1",
    "--set=training.task_reward={from=1,to=0.03,steps=4000}",
    "--set=ppo.symmetry=cube",
    "--set=ppo.std={from=0.6,to=0.4,steps=4000}",
    "--set=ppo.desired_kl={from=0.016,to=0.004,steps=4500}",
    "--set=ppo.away_std=0.7",
];

#[test]
fn twenty_iterations_and_twenty_more_are_forty_bit_for_bit_on_any_threads() {
    let undisturbed = tempfile::tempdir().unwrap();
    let total = (40 * 128).to_string();
    let args = train(
        &[
            &[
                "--run-dir",
                "run",
                "--threads",
                "2",
                "--total-steps",
                &total,
            ],
            LONG,
        ]
        .concat(),
    );
    succeeded(program(undisturbed.path(), &args));
    let expected = result(undisturbed.path(), "run");
    assert_eq!(expected.2.len(), 41);
    let goals = expected.2[0]
        .iter()
        .position(|name| name == "episode/goals")
        .unwrap();
    assert!(
        expected.2[1..]
            .iter()
            .any(|row| row[goals].parse().is_ok_and(|goals: f64| goals > 1.0)),
        "no goals are reached"
    );
    let std = expected.2[0]
        .iter()
        .position(|name| name == "policy/std")
        .unwrap();
    let last: f64 = expected.2[40][std].parse().unwrap();
    // The last update comes after the bound was applied.
    assert!(
        (0.2..0.41).contains(&last),
        "the bound on the noise has reached 0.4: {last}"
    );
    for threads in [["1", "8"], ["8", "1"]] {
        let folder = tempfile::tempdir().unwrap();
        let half = (20 * 128).to_string();
        let args = train(
            &[
                &[
                    "--run-dir",
                    "run",
                    "--threads",
                    threads[0],
                    "--total-steps",
                    &half,
                ],
                LONG,
            ]
            .concat(),
        );
        succeeded(program(folder.path(), &args));
        succeeded(resume(
            folder.path(),
            &["--total-steps", &total, "--threads", threads[1]],
        ));
        assert!(
            result(folder.path(), "run") == expected,
            "threads {threads:?}"
        );
    }
}

#[test]
fn other_precision_and_backend_resume_exactly_too() {
    for setting in ["ppo.precision=bf16-rounded", "ppo.backend=candle"] {
        let results = [&["512"][..], &["256", "512"]].map(|totals| {
            let folder = tempfile::tempdir().unwrap();
            let args = train(&[
                "--run-dir",
                "run",
                "--total-steps",
                totals[0],
                "--set",
                setting,
                "--threads",
                "2",
            ]);
            succeeded(program(folder.path(), &args));
            totals[1..].iter().for_each(|total| {
                drop(succeeded(resume(folder.path(), &["--total-steps", total])))
            });
            result(folder.path(), "run")
        });
        assert!(results[0] == results[1], "{setting}");
    }
}

/// Kills a training `kills` times at random times, resumes it each time, and compares it with an undisturbed one.
fn killed(kills: usize, iterations: u64) {
    let undisturbed = tempfile::tempdir().unwrap();
    let total = (iterations * 128).to_string();
    let args = train(&[&["--run-dir", "run", "--total-steps", &total], LONG].concat());
    let started = Instant::now();
    succeeded(program(undisturbed.path(), &args));
    let whole = started.elapsed().as_secs_f64();
    let expected = result(undisturbed.path(), "run");

    let folder = tempfile::tempdir().unwrap();
    let mut noise = rng::stream(kills as u64, "test", 0);
    let mut args = args;
    let resume = ["train", "--resume", "run", "--total-steps", &total];
    let mut hit = 0;
    for _ in 0..kills {
        let mut child = command(folder.path(), &args)
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let patience = 1.5 * whole / kills as f64 + 0.05;
        std::thread::sleep(Duration::from_secs_f64(patience * noise.random::<f64>()));
        child.kill().unwrap();
        hit += usize::from(!child.wait().unwrap().success());
        // If it was killed before its first checkpoint, it must be started again.
        if folder
            .path()
            .join("run/checkpoints/latest.safetensors")
            .exists()
        {
            args = resume.to_vec();
        }
    }
    succeeded(program(folder.path(), &args));
    println!("{hit} of {kills} were killed before their end");
    assert!(hit * 4 > kills, "only {hit} of {kills} were killed in time");
    assert!(
        result(folder.path(), "run") == expected,
        "after {kills} kills"
    );
    let left = names(&folder.path().join("run/checkpoints"));
    assert!(
        left.iter().all(|name| name.ends_with(".safetensors")),
        "{left:?}"
    );
    assert_eq!(
        logged(&folder.path().join("run")),
        logged(&undisturbed.path().join("run"))
    );
}

/// Returns the steps in the event files of a run, in order, with the number of values of each. Every session writes the settings.
fn logged(run: &Path) -> Vec<(i64, usize)> {
    let events = events(run).into_iter().filter(|event| event.has_summary());
    let all = events.map(|event| (event.get_step(), event.get_summary().get_value().to_vec()));
    all.filter(|(_, values)| values[0].get_tag() != "settings")
        .map(|(step, values)| (step, values.len()))
        .collect()
}

#[test]
fn killed_at_random_moments_and_resumed_it_comes_to_the_same_end() {
    killed(8, 120);
}

#[test]
#[ignore = "takes minutes: the same with a hundred kills"]
fn killed_a_hundred_times_and_resumed_it_comes_to_the_same_end() {
    killed(100, 1500);
}

#[test]
fn each_signal_saves_the_last_whole_iteration_and_has_its_exit_code() {
    for (signal, code) in [("INT", 130), ("TERM", 143), ("HUP", 129)] {
        let folder = tempfile::tempdir().unwrap();
        let (child, lines) = endless(folder.path(), &["--set", "run.checkpoint_every=1000000"]);
        let (found, said) = ended_by(signal, child, lines);
        assert_eq!(found, Some(code), "{said}");
        assert!(
            said.contains("stopped after") && said.contains("train --resume run"),
            "{said}"
        );
        let made = iterations(folder.path());
        let more = succeeded(resume(
            folder.path(),
            &["--total-steps", &((made + 1) * 128).to_string()],
        ));
        assert!(
            !stderr(&more).contains("dropped"),
            "every row belongs to a saved iteration: {}",
            stderr(&more)
        );
        assert_eq!(iterations(folder.path()), made + 1);
    }
}

#[test]
fn a_second_signal_ends_the_program_at_once_and_one_that_follows_the_first_immediately_does_not() {
    let folder = tempfile::tempdir().unwrap();
    // A disk that hangs from some moment on: the training waits for its last checkpoint.
    let hanging = "#include <unistd.h>\n\
        int fsync(int f) { (void)f; while (access(\"hangs\", 0) == 0) usleep(1000); return 0; }\n";
    let Some(library) = preloaded(folder.path(), hanging) else {
        return;
    };
    let args = train(&["--total-steps", "100000000", "--run-dir", "run"]);
    let mut training = command(folder.path(), &args);
    training.env("LD_PRELOAD", library);
    let (mut child, _lines) = begun(training);
    fs::write(folder.path().join("hangs"), "").unwrap();
    let twice = format!("kill -TERM {0}; kill -TERM {0}", child.id());
    assert!(
        Command::new("sh")
            .args(["-c", &twice])
            .status()
            .unwrap()
            .success()
    );
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(
        child.try_wait().unwrap(),
        None,
        "two signals at once are one request"
    );
    let asked = Instant::now();
    send("TERM", &child);
    assert_eq!(child.wait().unwrap().code(), Some(143));
    assert!(
        asked.elapsed() < Duration::from_secs(20),
        "{:?}",
        asked.elapsed()
    );
}

#[test]
fn a_training_goes_on_when_nobody_reads_what_it_says_and_saves_at_a_signal_or_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let (reader, mut writer) = std::io::pipe().unwrap();
    let more = ["--total-steps", "100000000", "--run-dir", "run"];
    let args = train(&more);
    let run = folder.path().join("run");
    let mut child = command(folder.path(), &args)
        .stderr(writer.try_clone().unwrap())
        .stdout(writer.try_clone().unwrap())
        .spawn()
        .unwrap();
    kill_after_five_minutes(&child);
    let mut lines = BufReader::new(reader).lines();
    while !lines.next().unwrap().unwrap().contains("steps/s") {}
    // The pipe is full, and nobody reads it any more.
    std::thread::spawn(move || while writer.write_all(&[b'\n'; 4096]).is_ok() {});
    std::thread::sleep(Duration::from_millis(500));
    for stop in ["file", "TERM"] {
        let before = iterations(folder.path());
        // Each iteration says the score of an evaluation.
        let patience = Instant::now();
        while iterations(folder.path()) < before + 3 {
            assert!(patience.elapsed() < Duration::from_secs(60), "it waits");
            std::thread::sleep(Duration::from_millis(20));
        }
        let asked = Instant::now();
        match stop {
            "file" => fs::write(run.join("stop"), "").unwrap(),
            signal => send(signal, &child),
        }
        let code = if stop == "file" { 0 } else { 143 };
        assert_eq!(child.wait().unwrap().code(), Some(code), "{stop}");
        assert!(asked.elapsed() < Duration::from_secs(10), "{stop}");
        let newest = format!("iteration-{:08}.safetensors", iterations(folder.path()));
        assert!(names(&run.join("checkpoints")).contains(&newest), "{stop}");
        let (reader, writer) = std::io::pipe().unwrap();
        let mut filled = writer.try_clone().unwrap();
        std::thread::spawn(move || while filled.write_all(&[b'\n'; 4096]).is_ok() {});
        std::mem::forget(reader);
        child = command(folder.path(), &["train", "--resume", "run"])
            .stderr(writer)
            .spawn()
            .unwrap();
        kill_after_five_minutes(&child);
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn a_request_that_is_sent_twice_as_by_a_closed_terminal_is_one_and_the_state_is_saved() {
    for (signal, code) in [("HUP", 129), ("INT", 130)] {
        let folder = tempfile::tempdir().unwrap();
        let (mut child, lines) = endless(folder.path(), &["--set", "run.checkpoint_every=1000000"]);
        // Sent by one shell: two processes could take longer than the time within which signals count as one.
        let twice = format!("kill -{signal} {0}; kill -{signal} {0}", child.id());
        assert!(
            Command::new("sh")
                .args(["-c", &twice])
                .status()
                .unwrap()
                .success()
        );
        let said: Vec<String> = lines.map_while(|line| line.ok()).collect();
        assert_eq!(child.wait().unwrap().code(), Some(code));
        assert!(
            said.iter().any(|line| line.contains("stopped after")),
            "{said:?}"
        );
    }
}

#[test]
fn a_signal_in_the_middle_of_a_long_update_or_evaluation_is_answered_at_once() {
    for setting in ["ppo.epochs=100000", "run.eval_episodes=10000"] {
        let folder = tempfile::tempdir().unwrap();
        let args = train(&["--run-dir", "run", "--set", setting]);
        let mut child = command(folder.path(), &args)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(700));
        send("TERM", &child);
        let asked = Instant::now();
        assert_eq!(child.wait().unwrap().code(), Some(143), "{setting}");
        assert!(
            asked.elapsed() < Duration::from_secs(20),
            "{setting}: {:?}",
            asked.elapsed()
        );
        assert_eq!(
            metrics(&folder.path().join("run")).len(),
            1,
            "the unfinished iteration is dropped"
        );
    }
}

#[test]
fn a_training_started_with_nohup_outlives_its_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&["--total-steps", "100000000", "--run-dir", "run"]);
    let mut nohup = Command::new("nohup");
    nohup
        .arg(env!("CARGO_BIN_EXE_shadow-repose"))
        .args(args)
        .current_dir(folder.path())
        .stdin(Stdio::null());
    let (child, lines) = begun(nohup);
    send("HUP", &child);
    let (before, patience) = (iterations(folder.path()), Instant::now());
    while iterations(folder.path()) < before + 50 {
        assert!(
            patience.elapsed() < Duration::from_secs(60),
            "it does not continue"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(ended_by("TERM", child, lines).0, Some(143), "not by SIGHUP");
}

#[test]
fn sigusr1_saves_and_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let (child, lines) = endless(folder.path(), &["--set", "run.checkpoint_every=1000000"]);
    let saved = || names(&folder.path().join("run/checkpoints")).len();
    let before = saved();
    send("USR1", &child);
    let patience = Instant::now();
    while saved() == before {
        assert!(
            patience.elapsed() < Duration::from_secs(30),
            "no checkpoint is written"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(ended_by("TERM", child, lines).0, Some(143));
}

#[test]
fn sigusr1_during_an_evaluation_saves_the_last_complete_iteration_at_once() {
    let folder = tempfile::tempdir().unwrap();
    // The evaluation of the second iteration takes hours.
    let evaluation = ["run.eval_every=2", "run.eval_episodes=1000000"];
    let (child, lines) = endless(
        folder.path(),
        &["--set", evaluation[0], "--set", evaluation[1]],
    );
    send("USR1", &child);
    let (saved, patience) = (
        folder
            .path()
            .join("run/checkpoints/iteration-00000001.safetensors"),
        Instant::now(),
    );
    while !saved.exists() {
        assert!(
            patience.elapsed() < Duration::from_secs(30),
            "no checkpoint is written"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(ended_by("TERM", child, lines).0, Some(143));
    assert_eq!(
        iterations(folder.path()),
        1,
        "the evaluation was still running"
    );
}

#[test]
fn a_time_limit_saves_and_exits_with_0() {
    let folder = tempfile::tempdir().unwrap();
    let args = train(&[
        "--total-steps",
        "100000000",
        "--run-dir",
        "run",
        "--stop-after",
        "500ms",
    ]);
    let output = succeeded(program(folder.path(), &args));
    assert!(
        stderr(&output).contains("stopped after"),
        "{}",
        stderr(&output)
    );
    let made = iterations(folder.path());
    assert!(made > 0);
    succeeded(resume(
        folder.path(),
        &["--total-steps", &((made + 1) * 128).to_string()],
    ));
}

/// Returns the built-in scene with a mass on a spring of negative stiffness, which diverges after twenty steps.
pub(crate) fn unstable_scene() -> String {
    let mass = "<body name=\"unstable\" pos=\"5 5 5\"><joint type=\"slide\" axis=\"0 0 1\" stiffness=\"-10000\"/>\
                <geom type=\"sphere\" size=\".1\" mass=\"1\" contype=\"0\" conaffinity=\"0\"/></body></worldbody>";
    SCENE.replace("</worldbody>", mass)
}

#[test]
fn diverged_physics_is_counted_and_leaves_what_is_needed_for_a_replay() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("unstable.xml");
    fs::write(&model, unstable_scene()).unwrap();
    let mut args = train(&[
        "--total-steps",
        "5120",
        "--run-dir",
        "run",
        "--dump-diverged",
    ]);
    args.extend([
        "--set",
        "env.max_episode_seconds=5",
        "--set",
        "env.model=unstable.xml",
    ]);
    succeeded(program(folder.path(), &args));
    let rows = metrics(&folder.path().join("run"));
    let column = rows[0]
        .iter()
        .position(|name| name == "sim/diverged")
        .unwrap();
    let diverged: u64 = rows[1..]
        .iter()
        .map(|row| row[column].parse::<u64>().unwrap())
        .sum();
    let dumps = names(&folder.path().join("run/diverged"));
    assert!(
        diverged > 100 && dumps.len() as u64 == diverged,
        "{diverged} diverged, {} dumps",
        dumps.len()
    );
    let mut simulation = Simulation::new(
        &Scene::load(Some(&model), &Compilation::plain(0.01, Cone::Scene)).unwrap(),
    );
    for dump in [&dumps[0], &dumps[dumps.len() - 1]] {
        let text = fs::read_to_string(folder.path().join("run/diverged").join(dump)).unwrap();
        let dump: serde_json::Value = serde_json::from_str(&text).unwrap();
        let numbers = |value: &serde_json::Value| -> Vec<f64> {
            value
                .as_array()
                .unwrap()
                .iter()
                .map(|x| x.as_f64().unwrap())
                .collect()
        };
        simulation.restore(&numbers(&dump["state"])).unwrap();
        let controls = dump["ctrl"].as_array().unwrap();
        assert!(controls.len() > 15 && dump["actions"].as_array().unwrap().len() == controls.len());
        for (i, ctrl) in controls.iter().enumerate() {
            simulation.ctrl_mut().copy_from_slice(&numbers(ctrl));
            assert_eq!(simulation.step(1), i + 1 == controls.len(), "step {i}");
        }
    }
}

#[test]
fn a_fatal_error_of_mujoco_in_an_evaluation_names_the_episode() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("small.xml"),
        SCENE.replace("memory=\"2M\"", "memory=\"50K\""),
    )
    .unwrap();
    let args = [
        "play",
        "--ckpt",
        "random",
        "--episodes",
        "64",
        "--set",
        "env.model=small.xml",
    ];
    let output = program(folder.path(), &args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let (_, error) = said.split_once("error: episode ").expect(&said);
    assert!(error.contains(": MuJoCo cannot continue: "), "{said}");
}

#[test]
fn a_fatal_error_of_mujoco_names_the_environment_and_the_iteration_before_is_saved() {
    let folder = tempfile::tempdir().unwrap();
    // Enough memory for the first contacts, but not for all later ones.
    assert!(SCENE.contains("<size memory=\"2M\"/>"));
    fs::write(
        folder.path().join("small.xml"),
        SCENE.replace("memory=\"2M\"", "memory=\"80K\""),
    )
    .unwrap();
    let mut args = train(&[
        "--total-steps",
        "100000000",
        "--run-dir",
        "run",
        "--set",
        "env.model=small.xml",
    ]);
    args.extend([
        "--set",
        "env.max_episode_seconds=5",
        "--set",
        "ppo.std=2",
        "--set",
        "run.eval_every=1000000",
    ]);
    let output = program(folder.path(), &args);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let named = ["error: environment ", "error: episode "]
        .iter()
        .any(|start| said.contains(start));
    assert!(named && said.contains("MuJoCo cannot continue"), "{said}");
    assert!(
        said.contains("saved the state after")
            && said.contains("train --resume run --set env.model="),
        "{said}"
    );
    let made = iterations(folder.path());
    assert!(
        made > 0 && said.contains(&format!("after {made} iterations")),
        "{made}: {said}"
    );
    let latest = fs::read(folder.path().join("run/checkpoints/latest.safetensors")).unwrap();
    assert_eq!(
        shadow_repose::ppo::Checkpoint::parse(&latest)
            .unwrap()
            .progress
            .iteration,
        made
    );
}
