//! What is fuzzed: everything that reads text or bytes from somebody else. A target may return anything, but must not panic,
//! abort, or take much memory. The seeds run through the same functions as ordinary tests.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

use shadow_repose::agent::Agent;
use shadow_repose::config::{Config, Override, Source};
use shadow_repose::env::{ACTION_SIZE, OBSERVATION_SIZE, SPACES, Task};
use shadow_repose::load;
use shadow_repose::ppo::{Checkpoint, Policy, sealed};
use shadow_repose::run::{self, Progress, Report};

/// Tells whether it accepts what it is given, and whether it does so once the checksum fits, where there is one.
pub type Target = fn(&[u8]) -> [bool; 2];

/// The targets by their names.
#[allow(dead_code)]
pub const TARGETS: [(&str, Target); 6] = [
    ("config", config),
    ("set", set),
    ("checkpoint", checkpoint),
    ("policy", policy),
    ("events", events),
    ("metrics", metrics),
];

/// A file of settings.
pub fn config(data: &[u8]) -> [bool; 2] {
    let Ok(text) = str::from_utf8(data) else { return [false; 2] };
    let source = Source { path: "my.toml".into(), text: text.into() };
    let Ok(config) = Config::resolve(Some(&source), &[]) else { return [false; 2] };
    let again = Config::from_text(Path::new("config.toml"), &config.to_text(), &[]);
    assert_eq!(again.expect("what is written can be read"), config);
    [true; 2]
}

/// Lines of `--set`.
pub fn set(data: &[u8]) -> [bool; 2] {
    let parse = |text: &str| text.lines().map(str::parse).collect::<Result<Vec<Override>, _>>();
    let sets = str::from_utf8(data).ok().and_then(|text| parse(text).ok());
    [sets.is_some_and(|sets| Config::resolve(None, &sets).is_ok()); 2]
}

/// The bytes of a checkpoint of one environment, to resume from: learner and environment, which then go through an iteration.
pub fn checkpoint(data: &[u8]) -> [bool; 2] {
    static TASK: OnceLock<Arc<Task>> = OnceLock::new();
    let task = TASK.get_or_init(|| Task::new(&Config::resolve(None, &[]).unwrap().env).unwrap());
    let resume = |bytes: &[u8]| -> anyhow::Result<()> {
        let mut checkpoint = Checkpoint::parse(bytes)?;
        let mut config = load::for_training(&checkpoint, Path::new("x.safetensors"), &[])?;
        // What a training needs besides grows with these, and is the user's to allow.
        (config.env.num_envs, config.ppo.horizon, config.ppo.minibatches, config.ppo.epochs) = (1, 3, 1, 1);
        config.run.shards = 1;
        let mut agent = Agent::of_task(task, &config)?;
        agent.restore(&mut checkpoint)?;
        checkpoint.take_counters("scene")?;
        checkpoint.finish()?;
        // It may fail at learning from numbers that nobody has trained, but not otherwise.
        if let Err(error) = agent.iterate(&AtomicBool::new(false)) {
            assert!(format!("{error:#}").contains("the training has failed"), "{error:#}");
        }
        Ok(())
    };
    [resume(data).is_ok(), sealed(data).is_ok_and(|data| resume(&data).is_ok())]
}

/// The bytes of a policy, to play.
pub fn policy(data: &[u8]) -> [bool; 2] {
    let play = |bytes: &[u8]| -> anyhow::Result<()> {
        let checkpoint = Checkpoint::parse(bytes)?;
        let config = load::for_playing(&checkpoint, Path::new("x.safetensors"), &[])?;
        let policy = Policy::load(&config.net, SPACES, &checkpoint)?;
        let frozen = policy.freeze();
        let (mut action, mut work) = ([0.0; ACTION_SIZE], frozen.workspace(1));
        frozen.forward(&[0.5; OBSERVATION_SIZE], Some(&mut action), None, &mut work);
        Ok(())
    };
    [play(data).is_ok(), sealed(data).is_ok_and(|data| play(&data).is_ok())]
}

/// An event file in the folder of a run that is resumed after 1000 steps: is it left whole, or cut?
pub fn events(data: &[u8]) -> [bool; 2] {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("events.out.tfevents.1700000000.0000001.shadow-repose");
    std::fs::write(&file, data).unwrap();
    resume_logs(folder.path());
    let left = std::fs::read(&file).unwrap();
    assert!(data.starts_with(&left), "what is left is the beginning of what was there");
    [left.len() == data.len(); 2]
}

/// A table of metrics, to be drawn, and to be resumed: can it be drawn?
pub fn metrics(data: &[u8]) -> [bool; 2] {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("metrics.csv");
    std::fs::write(&file, data).unwrap();
    let drawn = run::read_metrics(folder.path(), &["env_steps", "eval/goals"]);
    if let Err(error) = &drawn {
        assert!(format!("{error:#}").len() < 500 + folder.path().as_os_str().len(), "{error:#}");
    }
    resume_logs(folder.path());
    // Rows are kept whatever stands in their other columns.
    if let Ok(kept) = run::read_metrics(folder.path(), &["iteration"]) {
        assert!(kept[0].iter().all(|&iteration| iteration <= 10.0));
    }
    [drawn.is_ok(); 2]
}

fn resume_logs(folder: &Path) {
    let mut report = Report::new(folder, &["eval/goals"], Progress::new(1000, 2000, true));
    report.open_logs(0..10, 1000);
    report.sync();
}
