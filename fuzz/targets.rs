//! The fuzz targets: everything that reads untrusted text or bytes. A target may return anything, but must not panic, abort, or
//! use much memory. Ordinary tests run the seeds through the same functions.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};

use shadow_repose::agent::Agent;
use shadow_repose::config::{Config, Override, Ramp, Reader, Settings, Source};
use shadow_repose::load;
use shadow_repose::os::StatusLine;
use shadow_repose::ppo::{Checkpoint, Policy, sealed};
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::{Record, Task};
use shadow_repose::run::{self, Report};
use tensorboard_rs::masked_crc32c::masked_crc32c;

/// Returns whether the input is accepted, and whether it is accepted once its checksum, if any, has been corrected.
pub(crate) type Target = fn(&[u8]) -> [bool; 2];

/// The targets with their names.
#[allow(dead_code)]
pub(crate) const TARGETS: [(&str, Target); 6] = [
    ("config", config),
    ("set", set),
    ("checkpoint", checkpoint),
    ("policy", policy),
    ("events", events),
    ("metrics", metrics),
];

/// Reads a file of settings.
pub(crate) fn config(data: &[u8]) -> [bool; 2] {
    let Ok(text) = str::from_utf8(data) else {
        return [false; 2];
    };
    let source = Source::new("my.toml", text);
    let Ok(config) = Settings::new().file(source).resolve() else {
        return [false; 2];
    };
    let written = Source::new("config.toml", config.to_text());
    let again = Settings::new().file(written).resolve();
    assert_eq!(again.expect("what is written can be read"), config);
    [true; 2]
}

/// Reads lines of `--set`.
pub(crate) fn set(data: &[u8]) -> [bool; 2] {
    let parse = |text: &str| {
        text.lines()
            .map(str::parse)
            .collect::<Result<Vec<Override>, _>>()
    };
    let sets = str::from_utf8(data).ok().and_then(|text| parse(text).ok());
    [sets.is_some_and(|sets| Settings::new().sets(&sets).resolve().is_ok()); 2]
}

/// Resumes from the bytes of a checkpoint of one environment: learner and environment, which then run an iteration.
pub(crate) fn checkpoint(data: &[u8]) -> [bool; 2] {
    static TASK: OnceLock<Arc<Task>> = OnceLock::new();
    let task = TASK.get_or_init(|| Task::new(&Config::default()).unwrap());
    let resume = |bytes: &[u8]| -> anyhow::Result<()> {
        let mut checkpoint = Checkpoint::parse(bytes)?;
        let mut config = load::settings(&checkpoint, Path::new("x.safetensors"), Reader::Run, &[])?;
        // The rest of the memory of a training grows with these, which are the user's choice.
        config.ppo.horizon = Ramp::constant(3.0);
        (
            config.env.num_envs,
            config.ppo.minibatches,
            config.ppo.epochs,
        ) = (1, 1, 1);
        config.run.shards = 1;
        let mut agent = Agent::for_task(task, &config, Exchange::alone(config.shards()))?;
        agent.restore(&mut checkpoint)?;
        checkpoint.finish()?;
        // Learning from untrained values may fail, but nothing else may.
        if let Err(error) = agent.iterate(&AtomicBool::new(false)) {
            assert!(
                format!("{error:#}").contains("the training run has failed"),
                "{error:#}"
            );
        }
        Ok(())
    };
    [
        resume(data).is_ok(),
        sealed(data).is_ok_and(|data| resume(&data).is_ok()),
    ]
}

/// Loads a policy from its bytes and plays it.
pub(crate) fn policy(data: &[u8]) -> [bool; 2] {
    let play = |bytes: &[u8]| -> anyhow::Result<()> {
        let checkpoint = Checkpoint::parse(bytes)?;
        let config = load::settings(
            &checkpoint,
            Path::new("x.safetensors"),
            Reader::Player { env_steps: 0 },
            &[],
        )?;
        let spaces = Record::parse(&checkpoint.hand)?.spaces();
        let policy = Policy::load(&config.ppo, spaces, &checkpoint)?;
        let frozen = policy.freeze();
        let (mut action, mut work) = (vec![0.0; spaces.action_size], frozen.workspace(1));
        frozen.compute(
            &vec![0.5; spaces.observation_size],
            [&mut action, &mut []],
            &mut work,
        );
        Ok(())
    };
    [
        play(data).is_ok(),
        sealed(data).is_ok_and(|data| play(&data).is_ok()),
    ]
}

/// Resumes a run after 1000 steps with this event file in its folder; accepted if the file is left whole, not cut.
pub(crate) fn events(data: &[u8]) -> [bool; 2] {
    let left_whole = |data: &[u8]| {
        let folder = tempfile::tempdir().unwrap();
        let file = folder
            .path()
            .join("events.out.tfevents.1700000000.0000001.shadow-repose");
        std::fs::write(&file, data).unwrap();
        resume_logs(folder.path());
        let left = std::fs::read(&file).unwrap();
        assert!(
            data.starts_with(&left),
            "what is left is a prefix of the original"
        );
        left.len() == data.len()
    };
    [left_whole(data), left_whole(&with_checksums(data))]
}

/// Returns the event file with correct checksums.
fn with_checksums(data: &[u8]) -> Vec<u8> {
    let mut data = data.to_vec();
    let mut place = 0;
    while let Some(length) = data.get(place..place + 8) {
        let end = u64::from_le_bytes(length.try_into().unwrap()).saturating_add(place as u64 + 12);
        for (from, to) in [(place, place + 8), (place + 12, end as usize)] {
            let Some(checksum) = data
                .get(from..to)
                .map(|bytes| masked_crc32c(bytes).to_le_bytes())
            else {
                return data;
            };
            let Some(room) = data.get_mut(to..).and_then(|room| room.get_mut(..4)) else {
                return data;
            };
            room.copy_from_slice(&checksum);
        }
        place = end as usize + 4;
    }
    data
}

/// Reads a table of metrics for plotting, then for resuming; accepted if it can be plotted.
pub(crate) fn metrics(data: &[u8]) -> [bool; 2] {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("metrics.csv");
    std::fs::write(&file, data).unwrap();
    let drawn = run::read_metrics(folder.path(), &["env_steps"], &["eval/goals"]);
    if let Err(error) = &drawn {
        assert!(
            format!("{error:#}").len() < 500 + folder.path().as_os_str().len(),
            "{error:#}"
        );
    }
    resume_logs(folder.path());
    // Rows are kept whatever their other columns contain.
    if let Ok(kept) = run::read_metrics(folder.path(), &["iteration"], &[]) {
        assert!(
            kept.columns["iteration"]
                .iter()
                .all(|&iteration| iteration <= 10.0)
        );
    }
    [drawn.is_ok(); 2]
}

fn resume_logs(folder: &Path) {
    let mut report = Report::new(folder, &["eval/goals"], StatusLine::new(1000, 2000, true));
    report.open_logs(0..10, 1000);
    report.sync();
}
