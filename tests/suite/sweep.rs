//! The script that compares ways of learning (benches/learning).

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::support::{SMALL, metrics, names, succeeded, weights};

fn experiment(folder: &Path) -> Command {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/learning/experiment.py");
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
fn an_experiment_is_killed_goes_on_and_compares_its_variants_with_the_base() {
    if !Command::new("python3").args(["-c", "import tomllib"]).status().is_ok_and(|status| status.success()) {
        eprintln!("not tested: there is no Python 3.11");
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
    let mut killed = experiment(folder).stdout(Stdio::null()).spawn().unwrap();
    let begun = Instant::now();
    while !folder.join("runs/base-0/metrics.csv").exists() && begun.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(20));
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    let said = String::from_utf8(succeeded(experiment(folder).output().unwrap()).stdout).unwrap();

    let runs = folder.join("runs");
    for seed in [0, 1] {
        let [base, same] = ["base", "same"].map(|name| runs.join(format!("{name}-{seed}")));
        assert_eq!(metrics(&base), metrics(&same), "seed {seed}");
        let [base, same] = [base, same].map(|run| weights(run.join("checkpoints/iteration-00000010.safetensors")));
        assert_eq!(base, same, "seed {seed}");
    }
    let kept = |name: &str| [0, 1].map(|seed| format!("{name}-{seed}-640.safetensors"));
    assert_eq!(names(&runs.join("kept")), [kept("base"), kept("louder"), kept("same")].concat());
    assert!(said.contains("louder is stopped: policy/std at 640 steps is 1.3"), "{said}");
    assert_eq!(metrics(&runs.join("louder-1")).last().unwrap()[1], "640");
    let row = said.lines().skip_while(|line| *line != "at 1,280 steps:").find(|line| line.starts_with("| same"));
    assert!(row.is_some_and(|row| row.contains("(+0.000 ± 0.000, up in 0 of 2)")), "{said}");
    assert!(runs.join("picture.svg").exists());
    succeeded(experiment(folder).args(["--publish", "published"]).output().unwrap());
    let published = folder.join("published");
    assert!(published.join("README.md").exists() && published.join("experiment.toml").exists());
    let table = fs::read_to_string(published.join("louder-1/metrics.csv")).unwrap();
    assert!(table.starts_with("env_steps,episode/goals,") && table.contains(",time/update_s\n"), "{table}");
    // Other settings are refused in the same folder.
    let changed = fs::read_to_string(folder.join("what.toml")).unwrap().replace("0.8", "0.9");
    fs::write(folder.join("what.toml"), changed).unwrap();
    let refused = experiment(folder).output().unwrap();
    assert!(!refused.status.success() && String::from_utf8_lossy(&refused.stderr).contains("louder, seed 0"));
}
