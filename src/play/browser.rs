//! Playing for a browser: as one HTML file, or on a page while it plays.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;

use anyhow::{Context, Result, bail, ensure};
use serde_json::{Value, json};
use toml::Table;

use super::actors::{actor_of, baseline};
use super::files::PageFile;
use crate::cli::PlayArgs;
use crate::config::{MODEL, Reader, Settings, Source, short};
use crate::evaluate::{Actor, Player};
use crate::load::Loaded;
use crate::os::{self, Stamp};
use crate::ppo::FixedPolicy;
use crate::repose::Task;
use crate::run::{self, RunFolder};
use crate::see::{self, About, Live, LiveActor};
use crate::sim::Quality;

/// The text for the origin of a built-in policy.
const BUILT_IN: &str = "built into the program";

/// Returns what a page says about an actor, the place and the description of its policy, and a seed.
pub(super) fn about(actor: &str, policy: Option<(&str, &str)>, seed: Option<u64>) -> About {
    let title = match policy.map(|(place, _)| place) {
        Some(place) if place.ends_with(BUILT_IN) => "A built-in policy".to_owned(),
        Some(place) => place.to_owned(),
        None => format!("{}{}", actor[..1].to_uppercase(), &actor[1..]),
    };
    let policy = policy.map(|(_, name)| match actor {
        "policy" => name.to_owned(),
        other => format!("{name} ({other})"),
    });
    About { title, policy, seed }
}

/// The newest policy of a run.
pub(super) struct Followed {
    run: RunFolder,
    /// Its file, and the stamp of that file before it was last read.
    pub(super) path: PathBuf,
    stamp: Option<Stamp>,
}

impl Followed {
    /// Finds the run that the user wants to follow, by default the newest.
    ///
    /// # Errors
    /// Fails if the user names no run, or if there is none.
    pub(super) fn find(args: &PlayArgs) -> Result<Self> {
        let place =
            args.ckpt.clone().or_else(run::newest_run).context("--follow needs a run, and there is none here")?;
        let run = RunFolder::containing(&place).context("--follow needs a run")?;
        let path = run.checkpoints().latest();
        Ok(Self { stamp: Stamp::of(&path), run, path })
    }

    /// Returns whether the file has changed since the last call.
    fn has_changed(&mut self) -> bool {
        let before = self.stamp;
        self.stamp = Stamp::of(&self.path);
        self.stamp != before
    }
}

/// Shows the hand on a page for as long as the program runs. If a run is `followed`, each episode uses its newest policy.
///
/// # Errors
/// Fails if the port cannot be opened.
pub(super) fn live(
    port: u16,
    args: &PlayArgs,
    task: &Task,
    loaded: Option<Loaded>,
    mut followed: Option<Followed>,
) -> Result<ExitCode> {
    let task = see::task_for_display(task, &args.shot, [1280, 720], Quality::Fast)?;
    let baseline = baseline(args);
    let (mut about, mut acting) = match &loaded {
        Some(loaded) => {
            let name = actor_of(loaded, args).name();
            (
                about(name, Some((&loaded.origin.to_string(), &loaded.name)), Some(args.seed)),
                acting_of(loaded, args, &task)?,
            )
        }
        None => {
            let about = about(baseline.name(), None, Some(args.seed));
            let step = Rc::new(move |player: &mut Player| player.step(&baseline));
            (about, LiveActor { step, policy: None, task: task.clone() })
        }
    };
    if let Some(followed) = &followed {
        about = About { title: followed.run.path().display().to_string(), policy: None, ..about };
    }
    let record = loaded.map(|loaded| loaded.record);
    let hands = args.hands.unwrap_or(1) as usize;
    let live = Live::open(port, (&about, args.shot.camera), hands, &acting, None)?;
    live.show(&mut || {
        if let Some(followed) = &mut followed
            && followed.has_changed()
        {
            let newer = Loaded::find(Some(&followed.path), &args.set).and_then(|newer| {
                let same = Some(&newer.record) == record.as_ref();
                ensure!(same, "{} is for another hand", followed.path.display());
                let mut newer = acting_of(&newer, args, &task)?;
                // The page shows the settings of the first policy.
                for (key, value) in newer.task.config().unlike(task.config()) {
                    newer.policy.iter_mut().for_each(|name| *name += &format!(", {key} {}", short(&value)));
                }
                Ok(newer)
            });
            match newer {
                Ok(newer) => acting = newer,
                Err(error) => os::say(&format!("warning: {error:#}\n  The previous policy continues.")),
            }
        }
        acting.clone()
    })
}

/// The policy as an actor in this task, in which the actions of each checkpoint of a run are smoothed as it has learnt it.
fn acting_of(loaded: &Loaded, args: &PlayArgs, task: &Task) -> Result<LiveActor> {
    let task = task.smoothed_as_in(&loaded.settings(&args.set)?.env);
    let (policy, stochastic) = (FixedPolicy::new(loaded.policy.clone()), args.stochastic);
    let step = move |player: &mut Player| {
        let frozen = policy.frozen();
        player.step(&if stochastic { Actor::Stochastic(frozen) } else { Actor::Mean(frozen) })
    };
    Ok(LiveActor { step: Rc::new(step), policy: Some(loaded.name.clone()), task })
}

/// Writes the episodes of the trace in the file `path` as the file `html`.
///
/// # Errors
/// Fails if the file is no trace, or if the HTML file cannot be written. Fails if the user does not name a scene that is not built
/// in.
pub(super) fn from_trace(path: &Path, html: &Path, args: &PlayArgs) -> Result<()> {
    let cannot = || format!("cannot use the trace {}", path.display());
    let is_begun = |start: &[u8]| {
        ensure!(start.starts_with(b"{"), "{}: it does not begin with the header of a trace", cannot());
        Ok(())
    };
    let text = String::from_utf8(os::read_bytes_if(path, is_begun)?).with_context(cannot)?;
    let header = serde_json::from_str::<Value>(text.lines().next().unwrap_or_default()).ok();
    let header = header.filter(|header| header.get("observation").is_some());
    let header = header.context("it does not begin with the header of a trace").with_context(cannot)?;
    if let Some(set) = args.set.iter().find(|set| set.key != MODEL && !set.key.starts_with("hand.")) {
        bail!("--set {}: a trace has its own settings; only {MODEL} and the parts of the hand can be set", set.key);
    }
    let stored = settings(path, &header).with_context(cannot)?;
    let config = Settings::new().stored(stored, Reader::Run).sets(&args.set).resolve().with_context(cannot)?;
    let task = Task::new(&config.env, &config.hand)?;
    let joints = json!(task.hand().parts.joints);
    ensure!(header["joint_names"] == joints, "{}: it was recorded with another hand, which has other joints", cannot());
    run::expect_output(html, Some(path), task.config().model_file())?;
    let mut page = PageFile::begin(html, &task, args)?;
    let left_out = page.read(&text).with_context(cannot)?;
    if left_out > 0 {
        os::say(&format!("note: {left_out} more episodes of {} are not in the HTML file", path.display()));
    }
    let actor = header["actor"].as_str().filter(|actor| actor.is_ascii() && !actor.is_empty()).unwrap_or("policy");
    let policy = header["checkpoint"].as_str().map(|place| (place, place));
    page.finish(&about(actor, policy, header["seed"].as_u64()))
}

/// Returns the settings of the header of a trace as a configuration file.
///
/// # Errors
/// Fails if there are none.
fn settings(path: &Path, header: &Value) -> Result<Source> {
    let mut env = Table::new();
    let settings = header["settings"].as_object();
    for (key, value) in settings.context("it has no settings: not a trace of this program")? {
        let value = toml::Value::try_from(value).with_context(|| format!("its setting {}", os::shortened(key)))?;
        env.insert(key.strip_prefix("env.").unwrap_or(key).to_owned(), value);
    }
    let text = Table::from_iter([("env".to_owned(), env.into())]).to_string();
    Ok(Source::new(path, text))
}
