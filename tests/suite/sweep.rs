//! The script that trains variants of a training under several seeds and compares them (examples/sweep).

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::support::{SMALL, metrics, names, succeeded, weights};

fn has_python() -> bool {
    let found = Command::new("python3")
        .args(["-c", "import tomllib"])
        .status()
        .is_ok_and(|status| status.success());
    if !found {
        eprintln!("not tested: there is no Python 3.11");
    }
    found
}

fn sweep(folder: &Path) -> Command {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/sweep/sweep.py");
    let mut command = Command::new("python3");
    command.current_dir(folder).arg(script).args([
        "what.toml",
        "runs",
        "--program",
        env!("CARGO_BIN_EXE_shadow-repose"),
    ]);
    command
}

#[test]
fn a_sweep_is_killed_goes_on_and_compares_its_variants_with_the_base() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    // An iteration has 128 steps.
    let what = format!(
        "steps = 1280\nkeep = [640]\nruns = 2\nwindow = 256\nset = {SMALL:?}\n\
         [[stop]]\nat = 640\nmetric = \"policy/std\"\nabove = 1.1\n\
         [variants.same]\nset = []\n[variants.louder]\nset = [\"ppo.std=0.8\"]\n"
    );
    fs::write(folder.join("what.toml"), what).unwrap();
    let mut killed = sweep(folder).stdout(Stdio::null()).spawn().unwrap();
    let begun = Instant::now();
    while !folder.join("runs/base-0/metrics.csv").exists()
        && begun.elapsed() < Duration::from_secs(60)
    {
        std::thread::sleep(Duration::from_millis(20));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    let said = String::from_utf8(succeeded(sweep(folder).output().unwrap()).stdout).unwrap();

    let runs = folder.join("runs");
    for seed in [0, 1] {
        let [base, same] = ["base", "same"].map(|name| runs.join(format!("{name}-{seed}")));
        assert_eq!(metrics(&base), metrics(&same), "seed {seed}");
        let [base, same] =
            [base, same].map(|run| weights(run.join("checkpoints/iteration-00000010.safetensors")));
        assert_eq!(base, same, "seed {seed}");
    }
    let kept = |name: &str| [0, 1].map(|seed| format!("{name}-{seed}-640.safetensors"));
    assert_eq!(
        names(&runs.join("kept")),
        [kept("base"), kept("louder"), kept("same")].concat()
    );
    assert!(
        said.contains("louder is stopped: policy/std at 640 steps is 1.3")
            && said.contains(", above 1.1 in all seeds"),
        "{said}"
    );
    assert_eq!(metrics(&runs.join("louder-1")).last().unwrap()[1], "640");
    let row = said
        .lines()
        .skip_while(|line| *line != "at 1,280 steps:")
        .find(|line| line.starts_with("| same"));
    assert!(
        row.is_some_and(|row| row.contains("(+0.000 ± 0.000, up in 0 of 2)")),
        "{said}"
    );
    assert!(runs.join("picture.svg").exists());
    succeeded(
        sweep(folder)
            .args(["--publish", "published"])
            .output()
            .unwrap(),
    );
    let published = folder.join("published");
    assert!(published.join("README.md").exists() && published.join("sweep.toml").exists());
    let table = fs::read_to_string(published.join("louder-1/metrics.csv")).unwrap();
    assert!(
        table.starts_with("env_steps,episode/goals,") && table.contains(",time/update_s\n"),
        "{table}"
    );
    // Other settings are refused in the same folder.
    let changed = fs::read_to_string(folder.join("what.toml"))
        .unwrap()
        .replace("0.8", "0.9");
    fs::write(folder.join("what.toml"), changed).unwrap();
    let refused = sweep(folder).output().unwrap();
    assert!(
        !refused.status.success()
            && String::from_utf8_lossy(&refused.stderr).contains("louder, seed 0")
    );
}

#[test]
fn a_sweep_keeps_a_checkpoint_although_its_iteration_is_longer_than_the_ones_before() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    // The first iteration has 128 steps, the second one 512.
    let what = format!(
        "steps = 1000\nseeds = [0]\nkeep = [300]\nset = {:?}\n",
        [SMALL, &["ppo.horizon={ from = 8, to = 64, steps = 256 }"]].concat()
    );
    fs::write(folder.join("what.toml"), what).unwrap();
    succeeded(sweep(folder).output().unwrap());
    assert_eq!(metrics(&folder.join("runs/base-0"))[2][1], "640");
    assert_eq!(names(&folder.join("runs/kept")), ["base-0-300.safetensors"]);
}

#[test]
fn a_variant_that_fails_is_named_and_the_others_are_trained() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let what = format!(
        "steps = 256\nset = {SMALL:?}\n[variants]\nwrong = {{ set = [\"ppo.epoch=2\"] }}\nshort = {{ steps = 128 }}\n"
    );
    fs::write(folder.join("what.toml"), &what).unwrap();
    let output = sweep(folder).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("ppo.epoch: unknown key"), "{said}");
    assert!(
        said.contains("failed: wrong, seed 0; wrong, seed 1; the same command tries again"),
        "{said}"
    );
    for (name, last) in [
        ("base-0", "256"),
        ("base-1", "256"),
        ("short-0", "128"),
        ("short-1", "128"),
    ] {
        assert_eq!(
            metrics(&folder.join("runs").join(name)).last().unwrap()[1],
            last,
            "{name}"
        );
    }
    // What had not begun may be corrected.
    fs::write(
        folder.join("what.toml"),
        what.replace("ppo.epoch=2", "ppo.epochs=2"),
    )
    .unwrap();
    succeeded(sweep(folder).output().unwrap());
    assert_eq!(
        metrics(&folder.join("runs/wrong-1")).last().unwrap()[1],
        "256"
    );
}

#[test]
fn a_program_that_trains_nothing_is_not_started_again() {
    if !has_python() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("what.toml"),
        "steps = 256\nseeds = [0]\n",
    )
    .unwrap();
    let output = sweep(folder.path())
        .args(["--program", "/bin/true"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("base, seed 0 failed, it made no step"),
        "{said}"
    );
}

#[test]
fn whatever_is_wrong_in_the_file_of_a_sweep_is_told_in_a_line() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    fs::write(folder.join("foreign"), [255; 100]).unwrap();
    fs::write(folder.join("short"), b"\x02\0\0\0\0\0\0\0{}").unwrap();
    let policy = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/assets/policies/repose.safetensors"
    );
    let forked = format!("steps = 9\nseeds = [0]\nfork = {policy:?}");
    for (text, part) in [
        ("", "`steps` is missing"),
        ("steps = 0", "steps = 0 must be a whole number"),
        ("steps = \"9\"", "steps = '9' must be"),
        ("steps = 9.5", "steps = 9.5 must be"),
        ("steps = true", "steps = True must be"),
        ("steps = [[[", "what.toml: "),
        ("steps = 9\nkeep = [\"x\"]", "keep = ['x'] must be a list"),
        ("steps = 9\ntable = 3", "table = 3 must be a list"),
        (
            "steps = 9\nseeds = [[0], [1]]",
            "seeds = [[0], [1]] must be",
        ),
        ("steps = 9\nseeds = [0, 0]", "seeds = [0, 0] must be"),
        ("steps = 9\nseeds = [-1]", "seeds = [-1] must be"),
        ("steps = 9\nseeds = []", "seeds = [] must be"),
        ("steps = 9\nset = [1]", "set = [1] must be"),
        (
            "steps = 9\nset = [\"a\\u0000\"]",
            "set = ['a\\x00'] must be",
        ),
        ("steps = 9\nruns = 0", "runs = 0 must be"),
        ("steps = 9\nwindow = nan", "window = nan must be"),
        ("steps = 9\nconfig = \"none.toml\"", "there is no such file"),
        ("steps = 9\nconfig = \"foreign\"", "foreign: "),
        ("steps = 9\nvariants = 3", "variants = 3 must be"),
        (
            "steps = 9\n[variants]\na = 3",
            "the variant a must be a table",
        ),
        (
            "steps = 9\n[variants.a]\nsteps = \"x\"",
            "variant a: steps = 'x' must be",
        ),
        (
            "steps = 9\n[variants.a]\nset = \"x\"",
            "variant a: set = 'x'",
        ),
        ("steps = 9\nstop = [3]", "stop = [3] must be"),
        (
            "steps = 9\n[[stop]]\nat = \"x\"\nmetric = \"a\"",
            "stop rule: at = 'x' must be",
        ),
        (
            "steps = 9\n[[stop]]\nat = 9\nmetric = \"a\"\nbelow = \"x\"",
            "stop rule: below = 'x' must be a number",
        ),
        (
            "steps = 9\n[[stop]]\nat = 9\nmetric = [1]\nabove = 1",
            "stop rule: metric = [1] must be",
        ),
        (
            "steps = 9\n[[stop]]\nat = 9\nmetric = \"a\"",
            "needs `at`, `metric`, and",
        ),
        (
            "steps = 9\nseeds = [0]\nfork = \"../none\"",
            "there is no such checkpoint",
        ),
        (
            "steps = 9\nseeds = [0]\nfork = \"../foreign\"",
            "no checkpoint of a training run",
        ),
        (
            "steps = 9\nseeds = [0]\nfork = \"../short\"",
            "no checkpoint of a training run",
        ),
        (&forked, "`steps` must be above"),
        (
            "steps = 9\nfork = \"{seed}{other}{0}{\"",
            "there is no such checkpoint",
        ),
    ] {
        fs::write(folder.join("what.toml"), text).unwrap();
        let output = sweep(folder).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{text}: {said}");
        assert!(
            said.contains(part) && said.lines().count() == 1,
            "{text}: {part:?} is not alone in\n{said}"
        );
    }
}

#[test]
fn a_garbled_file_of_a_run_ends_that_training_and_the_others_go_on() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    let begin = |steps: u64| {
        let what = format!(
            "steps = {steps}\nseeds = [0, 1, 2, 3]\nset = {SMALL:?}\n[[stop]]\nat = 256\nmetric = \"policy/std\"\nabove = 9\n"
        );
        fs::write(folder.join("what.toml"), what).unwrap();
        sweep(folder).output().unwrap()
    };
    succeeded(begin(256));
    let run = |name: &str| folder.join("runs").join(name);
    let checkpoints = |name: &str| {
        let folder = run(name).join("checkpoints");
        let found = names(&folder).into_iter();
        let found = found.filter(|name| name.starts_with("iteration-"));
        found.map(|name| folder.join(name)).collect::<Vec<_>>()
    };
    let garble = |path: &Path| fs::write(path, [255; 1000]).unwrap();
    for path in checkpoints("base-0") {
        garble(&path);
    }
    garble(&run("base-0").join("checkpoints/latest.safetensors"));
    garble(checkpoints("base-1").last().unwrap());
    garble(&run("base-2").join("metrics.csv"));
    let output = begin(384);
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!errors.contains("Traceback"), "{errors}");
    assert!(said.contains("base, seed 0 failed"), "{said}");
    assert!(!said.contains("base, seed 1 failed"), "{said}");
    for name in ["base-1", "base-3"] {
        assert_eq!(metrics(&run(name)).last().unwrap()[1], "384", "{name}");
    }
    succeeded(sweep(folder).arg("--table").output().unwrap());
}

#[test]
fn a_sweep_keeps_the_program_that_it_began_with_and_its_folder_for_itself() {
    if !has_python() {
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let folder = place.path();
    // It trains for longer than this test.
    fs::write(
        folder.join("what.toml"),
        format!("steps = 100_000_000\nseeds = [0]\nset = {SMALL:?}\n"),
    )
    .unwrap();
    let own = folder.join("own");
    fs::copy(env!("CARGO_BIN_EXE_shadow-repose"), &own).unwrap();
    let mut first = sweep(folder);
    let mut first = first
        .args(["--program", "own"])
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let begun = Instant::now();
    while !folder.join("runs/base-0/metrics.csv").exists()
        && begun.elapsed() < Duration::from_secs(60)
    {
        std::thread::sleep(Duration::from_millis(20));
    }
    fs::write(&own, "rebuilt").unwrap();
    let second = sweep(folder).output().unwrap();
    first.kill().unwrap();
    first.wait().unwrap();
    assert!(
        String::from_utf8_lossy(&second.stderr).contains("another sweep.py is at work here"),
        "{second:?}"
    );
    assert_eq!(
        fs::read(folder.join("runs/program")).unwrap(),
        fs::read(env!("CARGO_BIN_EXE_shadow-repose")).unwrap()
    );
    let table = succeeded(sweep(folder).arg("--table").output().unwrap()).stdout;
    assert!(String::from_utf8_lossy(&table).contains("base, seed 0: "));
    // Its training saves and ends by itself. Until then the folder cannot be removed.
    let lock = fs::File::open(folder.join("runs/base-0/run.lock")).unwrap();
    lock.lock().unwrap();
}
