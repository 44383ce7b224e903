//! Playing for a browser: as one HTML file, or on a page while it plays.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;

use anyhow::{Context, Result, ensure};
use serde_json::Value;
use toml::Table;

use super::files::PageFile;
use crate::cli::{Baseline, PlayArgs};
use crate::config::{Config, Source};
use crate::evaluate::{Actor, Player};
use crate::load::{Loaded, MODEL, PolicySource, expect_named_scene};
use crate::os::{self, Stamp};
use crate::ppo::FixedPolicy;
use crate::repose::Task;
use crate::run::{self, RunFolder};
use crate::see::{self, About, Live, Turn};
use crate::sim::Quality;

/// Returns what a page says of who plays.
pub(super) fn about(loaded: Option<&Loaded>, args: &PlayArgs) -> About {
    let Some(loaded) = loaded else {
        let title = if args.policy == Some(Baseline::Random) { "Random actions" } else { "Zero actions" };
        return About { title: title.into(), policy: None, seed: Some(args.seed) };
    };
    let title = match &loaded.origin {
        PolicySource::BuiltIn(_) => "A built-in policy".to_owned(),
        PolicySource::File(path) => path.display().to_string(),
    };
    let policy = if args.stochastic { format!("{}, stochastic actions", loaded.name) } else { loaded.name.clone() };
    About { title, policy: Some(policy), seed: Some(args.seed) }
}

/// Shows the hand on a page for as long as the program runs; with `followed`, played by the newest policy in this file.
///
/// # Errors
/// Fails if the port cannot be had.
pub(super) fn live(
    port: u16,
    args: &PlayArgs,
    task: &Task,
    loaded: Option<Loaded>,
    followed: Option<&Path>,
) -> Result<ExitCode> {
    let task = see::task_for_display(task, &args.shot, [1280, 720], Quality::Fast)?;
    let mut about = about(loaded.as_ref(), args);
    if let Some(run) = followed.and_then(Path::parent).and_then(Path::parent) {
        about = About { title: run.display().to_string(), policy: None, ..about };
    }
    let mut turn = match &loaded {
        Some(loaded) => turn_of(loaded, args.stochastic),
        None => {
            let actor = if args.policy == Some(Baseline::Random) { Actor::Random } else { Actor::Zero };
            Turn { step: Rc::new(move |player| player.step(&actor)), policy: None }
        }
    };
    let mut stamp = followed.and_then(Stamp::of);
    let record = loaded.map(|loaded| loaded.record);
    let live = Live::open(port, &task, (&about, args.shot.camera), args.hands as usize, &turn, None)?;
    live.show(&mut || {
        let Some(path) = followed.filter(|path| Stamp::of(path) != stamp) else { return turn.clone() };
        stamp = Stamp::of(path);
        match Loaded::find(Some(path), &args.set) {
            Ok(newer) if Some(&newer.record) == record.as_ref() => turn = turn_of(&newer, args.stochastic),
            Ok(_) => os::say(&format!("warning: {} is for another hand; the one before plays on", path.display())),
            Err(error) => os::say(&format!("warning: {error:#}\n  The policy before plays on.")),
        }
        turn.clone()
    })
}

/// Returns the file whose newest content a page follows.
///
/// # Errors
/// Fails if the user names no run, and there is none.
pub(super) fn followed(args: &PlayArgs) -> Result<PathBuf> {
    let place = args.ckpt.clone().or_else(run::newest_run).context("--follow needs a run, and there is none here")?;
    let run = RunFolder::containing(&place).context("--follow needs a run")?;
    Ok(run.checkpoints().latest())
}

fn turn_of(loaded: &Loaded, stochastic: bool) -> Turn {
    let policy = FixedPolicy::new(loaded.policy.clone());
    let step = move |player: &mut Player| {
        let frozen = policy.frozen();
        player.step(&if stochastic { Actor::Stochastic(frozen) } else { Actor::Mean(frozen) })
    };
    Turn { step: Rc::new(step), policy: Some(loaded.name.clone()) }
}

/// Shows the episodes of the trace in the file `path` as an HTML file.
///
/// # Errors
/// Fails if the file is no trace, if its scene is not the built-in one and the user does not name it, or if the HTML file cannot be
/// written.
pub(super) fn from_trace(path: &Path, args: &PlayArgs) -> Result<()> {
    let cannot = || format!("cannot use the trace {}", path.display());
    let is_begun = |start: &[u8]| {
        ensure!(start.starts_with(b"{"), "{}: it does not begin with the header of a trace", cannot());
        Ok(())
    };
    let text = String::from_utf8(os::read_bytes_if(path, is_begun)?).with_context(cannot)?;
    let header = serde_json::from_str::<Value>(text.lines().next().unwrap_or_default()).ok();
    let header = header.filter(|header| header.get("observation").is_some());
    let header = header.context("it does not begin with the header of a trace").with_context(cannot)?;
    let config = Config::resolve(Some(&settings(path, &header).with_context(cannot)?), &args.set)?;
    expect_named_scene(&config.env, args.set.iter().any(|set| set.key == MODEL)).with_context(cannot)?;
    let task = Task::new(&config.env, &config.hand)?;
    let html = args.html.as_deref().context("a file to write")?;
    run::expect_output(html, Some(path), task.config().model_file())?;
    let mut page = PageFile::begin(&task, args)?.context("a file to write")?;
    let left_out = page.read(&text).with_context(cannot)?;
    if left_out > 0 {
        os::say(&format!("note: {left_out} more episodes of {} are not in the file", path.display()));
    }
    let policy = header["checkpoint"].as_str();
    let title = format!("{}, played before", policy.unwrap_or("A hand without a policy"));
    page.finish(&About { title, policy: policy.map(str::to_owned), seed: header["seed"].as_u64() })
}

/// Returns the settings of the header of a trace as a configuration file; a file of an older version has none.
fn settings(path: &Path, header: &Value) -> Result<Source> {
    let mut env = Table::new();
    for (key, value) in header["settings"].as_object().into_iter().flatten() {
        let value = toml::Value::try_from(value).with_context(|| format!("its setting {}", os::shortened(key)))?;
        env.insert(key.strip_prefix("env.").unwrap_or(key).to_owned(), value);
    }
    let text = Table::from_iter([("env".to_owned(), env.into())]).to_string();
    Ok(Source { path: path.to_owned(), text })
}
