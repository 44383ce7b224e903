//! What is fuzzed: everything that reads text or bytes from somebody else. A target may return anything, but must not panic,
//! abort, or take much memory. The seeds run through the same functions as ordinary tests.

use std::path::Path;

use shadow_repose::config::{Config, Override, Source};
use shadow_repose::env::{ACTION_SIZE, OBSERVATION_SIZE};
use shadow_repose::load;
use shadow_repose::ppo::{Ppo, sealed};

/// Tells whether it accepts what it is given.
pub type Target = fn(&[u8]) -> bool;

/// The targets by their names.
#[allow(dead_code)]
pub const TARGETS: [(&str, Target); 4] =
    [("config", config), ("set", set), ("checkpoint", checkpoint), ("policy", policy)];

/// A file of settings; whether it is accepted.
pub fn config(data: &[u8]) -> bool {
    let Ok(text) = str::from_utf8(data) else { return false };
    let source = Source { path: "my.toml".into(), text: text.into() };
    let Ok(config) = Config::resolve(Some(&source), &[]) else { return false };
    let again = Config::from_text(Path::new("config.toml"), &config.to_text(), &[]);
    assert_eq!(again.expect("what is written can be read"), config);
    true
}

/// Lines of `--set`; whether they are accepted.
pub fn set(data: &[u8]) -> bool {
    let Ok(text) = str::from_utf8(data) else { return false };
    let Ok(sets) = text.lines().map(str::parse).collect::<Result<Vec<Override>, _>>() else { return false };
    Config::resolve(None, &sets).is_ok()
}

/// The bytes of a checkpoint, as they are and with a checksum that fits, to resume the learner from; whether it is accepted.
pub fn checkpoint(data: &[u8]) -> bool {
    let resume = |bytes: &[u8]| -> anyhow::Result<()> {
        let (mut checkpoint, mut config) = load::parse(Path::new("x.safetensors"), bytes, &[])?;
        // What a training needs besides grows with these, and is the user's to allow.
        (config.env.num_envs, config.ppo.horizon, config.ppo.minibatches) = (1, 1, 1);
        let mut ppo = Ppo::new(&config.ppo, OBSERVATION_SIZE, ACTION_SIZE, 0)?;
        ppo.restore(&mut checkpoint)?;
        checkpoint.take_doubles("envs.numbers")?;
        checkpoint.take_counters("envs.counters")?;
        checkpoint.take_counters("scene")?;
        checkpoint.finish()
    };
    let accepted = resume(data).is_ok();
    if let Ok(sealed) = sealed(data) {
        let _ = resume(&sealed);
    }
    accepted
}

/// The bytes of a policy, as they are and with a checksum that fits, to play; whether it is accepted.
pub fn policy(data: &[u8]) -> bool {
    let play = |bytes: &[u8]| -> anyhow::Result<()> {
        let (checkpoint, config) = load::parse(Path::new("x.safetensors"), bytes, &[])?;
        let policy = load::policy(&checkpoint, &config)?;
        let frozen = policy.freeze()?;
        let (mut action, mut work) = ([0.0; ACTION_SIZE], frozen.workspace(1));
        frozen.forward(&[0.5; OBSERVATION_SIZE], [Some(&mut action), None], &mut work)
    };
    let accepted = play(data).is_ok();
    if let Ok(sealed) = sealed(data) {
        let _ = play(&sealed);
    }
    accepted
}
