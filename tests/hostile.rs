//! Memory stays small with untrusted files and inputs, and during days of logging. A separate binary, because the memory of the
//! whole process is measured.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::sync::Mutex;

use rand::RngExt;
use rand::seq::SliceRandom;
use shadow_repose::agent::Agent;
use shadow_repose::config::{Config, Settings};
use shadow_repose::os::{Status, StatusLine};
use shadow_repose::ppo::Checkpoint;
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::Task;
use shadow_repose::rng::{self, Rng};
use shadow_repose::run::Report;

#[path = "../fuzz/targets.rs"]
mod targets;

/// Held by each test, so that they run one at a time: they measure memory.
static ALONE: Mutex<()> = Mutex::new(());

/// Returns the memory of this process in KiB, by the system's name for it: `VmRSS:` is the current value, `VmHWM:` the peak.
fn memory(name: &str) -> u64 {
    let Ok(status) = fs::read_to_string("/proc/self/status") else {
        eprintln!("not tested: how much memory is used, which only Linux reports here");
        return 0;
    };
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix(name))
        .expect("Linux reports it");
    line.trim_matches(|c: char| !c.is_ascii_digit())
        .parse()
        .unwrap()
}

/// Returns a small but complete checkpoint.
fn a_checkpoint() -> Checkpoint {
    let sets =
        ["env.num_envs=1", "ppo.hidden=[1]", "ppo.minibatches=1"].map(|set| set.parse().unwrap());
    let config = Settings::new().sets(&sets).resolve().unwrap();
    let task = Task::new(&config).unwrap();
    let agent = Agent::for_task(&task, &config, Exchange::alone(config.shards())).unwrap();
    let mut checkpoint = Checkpoint::default();
    agent.save(&mut checkpoint);
    checkpoint.config = config.to_text();
    checkpoint.scene = task.scene.fingerprint();
    checkpoint.hand = task.record().to_text();
    checkpoint
}

/// Returns the bytes with bits flipped, parts cut out, shuffled, repeated or overwritten, or lengths made huge. This happens more
/// often in the first `structured` bytes.
fn mutated(good: &[u8], structured: usize, rng: &mut Rng) -> Vec<u8> {
    let mut bytes = good.to_vec();
    for _ in 0..rng.random_range(1..4) {
        let end = if rng.random::<bool>() {
            bytes.len().min(structured)
        } else {
            bytes.len()
        };
        if end < 16 {
            break;
        }
        let from = rng.random_range(0..end - 8);
        let length = rng.random_range(1..=(end - from).min(64));
        match rng.random_range(0..8) {
            0 | 1 => bytes[from] ^= 1 << rng.random_range(0..8),
            2 => bytes.truncate(from),
            3 => drop(bytes.drain(from..from + length)),
            4 => bytes[from..from + length].shuffle(rng),
            5 => bytes.extend_from_within(from..from + length),
            6 => bytes[from..from + 8].copy_from_slice(
                &[u64::MAX, 1 << 62, 1 << 33, 0][rng.random_range(0..4)].to_le_bytes(),
            ),
            // Changes a digit or inserts some: sizes in the header, values in the settings.
            _ => match bytes[from..end].iter().position(u8::is_ascii_digit) {
                Some(digit) if rng.random::<bool>() => bytes[from + digit] = b'9',
                Some(digit) => bytes
                    .splice(from + digit..from + digit, *b"99999999")
                    .for_each(drop),
                None => {}
            },
        }
    }
    bytes
}

#[test]
fn ten_thousand_mutations_of_a_checkpoint_and_of_a_config_do_no_harm() {
    let _alone = ALONE.lock().unwrap();
    let whole = a_checkpoint();
    let alone = whole.policy_alone().to_bytes().unwrap();
    let whole = whole.to_bytes().unwrap();
    let config = Config::default().to_text().into_bytes();
    let header = |bytes: &[u8]| 8 + u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    let mut rng = rng::stream(0, "test", 0);
    for (good, target) in [
        (&whole, targets::checkpoint as targets::Target),
        (&alone, targets::policy),
    ] {
        assert_eq!(target(good), [true; 2]);
        for _ in 0..10_000 {
            let bad = mutated(good, header(good), &mut rng);
            // If it is accepted, its content has not changed, whatever the layout of its header.
            if target(&bad)[0] {
                let [found, expected] =
                    [&bad, good].map(|bytes| Checkpoint::parse(bytes).unwrap().to_bytes().unwrap());
                assert_eq!(found.len(), expected.len());
                let [found, expected] =
                    [&found, &expected].map(|bytes| bytes[header(bytes)..].to_vec());
                assert!(found == expected, "a changed checkpoint was accepted");
            }
        }
    }
    assert_eq!(
        [
            targets::config(&config),
            targets::set(b"ppo.gamma=0.9\nenv.model=x.xml")
        ],
        [[true; 2]; 2]
    );
    for _ in 0..10_000 {
        targets::config(&mutated(&config, config.len(), &mut rng));
        targets::set(&mutated(
            b"ppo.learning_rate=1e-4\nppo.hidden=[64, 32]\nenv.success_hold=consecutive",
            80,
            &mut rng,
        ));
    }
    let most = memory("VmHWM:");
    println!("peak: {most} KiB");
    assert!(most < 1 << 20, "{most} KiB");
}

/// Writes the good seeds, after a change of the format. The bad seeds are made from these by hand.
fn write_good_seeds(folder: &Path) {
    let whole = a_checkpoint();
    let bytes = whole.to_bytes().unwrap();
    fs::write(folder.join("checkpoint/good-whole"), &bytes).unwrap();
    fs::write(folder.join("policy/good-whole"), &bytes).unwrap();
    fs::write(
        folder.join("policy/good-alone"),
        whole.policy_alone().to_bytes().unwrap(),
    )
    .unwrap();
    fs::write(
        folder.join("config/good-whole"),
        Config::default().to_text(),
    )
    .unwrap();
}

#[test]
fn the_seeds_of_the_fuzz_targets_do_no_harm() {
    let _alone = ALONE.lock().unwrap();
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    if std::env::var_os("SHADOW_REPOSE_NEW_SEEDS").is_some() {
        write_good_seeds(&seeds);
    }
    for (name, target) in targets::TARGETS {
        let folder = seeds.join(name);
        let seeds: Vec<_> = fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        assert!(seeds.len() > 3, "{}", folder.display());
        for seed in seeds {
            let [accepted, accepted_sealed] = target(&fs::read(&seed).unwrap());
            let kind = seed
                .file_name()
                .unwrap()
                .to_str()
                .unwrap()
                .split('-')
                .next()
                .unwrap()
                .to_owned();
            assert_eq!(accepted, kind == "good", "{}", seed.display());
            // Bad seeds are refused for their content, not for their checksum.
            assert!(
                kind == "damaged" || accepted_sealed == accepted,
                "{}",
                seed.display()
            );
        }
    }
}

/// Logs this number of rows and returns the growth of memory after the first tenth of them, in KiB.
fn growth(rows: u64) -> i64 {
    let place = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..30).map(|i| format!("group/value_{i}")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut report = Report::new(place.path(), &names, StatusLine::new(0, rows, true));
    report.open_logs(0..0, 0);
    let mut early = 0;
    for row in 1..=rows {
        let values: Vec<(&str, f64)> = names
            .iter()
            .map(|name| (*name, (row as f64).sqrt()))
            .collect();
        report.iteration(
            row,
            &values,
            &[],
            &Status {
                assisted: false,
                shared: false,
                env_steps: row,
                steps_per_s: 1e4,
                goals: 0.5,
                drop_rate: f64::NAN,
                evaluation: f64::NAN,
            },
        );
        if row % 500 == 0 {
            report.sync();
        }
        if row == rows / 10 {
            early = memory("VmRSS:");
        }
    }
    report.finish();
    drop(report);
    // A resumed session reads the whole log.
    let mut resumed = Report::new(place.path(), &names, StatusLine::new(rows - 1, rows, true));
    resumed.open_logs(0..rows - 1, rows - 1);
    resumed.finish();
    let text = fs::metadata(place.path().join("metrics.csv"))
        .unwrap()
        .len();
    assert!(text > rows * 300, "the rows were written");
    memory("VmRSS:") as i64 - early as i64
}

#[test]
fn the_memory_stays_flat_while_rows_are_logged() {
    let _alone = ALONE.lock().unwrap();
    let growth = growth(20_000);
    assert!(growth < 2048, "{growth} KiB");
}

#[test]
#[ignore = "takes a minute: the same with a million rows, as in 12 hours or more"]
fn the_memory_stays_flat_while_a_million_rows_are_logged() {
    let _alone = ALONE.lock().unwrap();
    let growth = growth(1_000_000);
    println!("{growth} KiB");
    assert!(growth < 2048, "{growth} KiB");
}
