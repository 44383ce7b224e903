//! Playing for a browser: as one HTML file, or on a page while it plays.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use toml::Table;

use super::stage::{Stage, with_warnings};
use crate::cli::PlayArgs;
use crate::config::{MODEL, Override, Reader, Settings, Source, short};
use crate::load::PolicySource;
use crate::os::{self, Destination, Stamp, say};
use crate::repose::Task;
use crate::run::{self, RunFolder};
use crate::see::{self, About, Live, LiveActor, Replay, Slider, Sliders};
use crate::sim::Look;

/// The most bytes of a line of a trace. A step of the Shadow Hand has 5000.
const LONGEST_LINE: usize = 1 << 22;

/// The text for the origin of a built-in policy.
const BUILT_IN: &str = "built into the program";

/// What a page says about who acts in episodes that are drawn from this seed.
pub fn about(stage: &Stage, seed: u64) -> About {
    let policy = stage.origin().zip(stage.described());
    described(stage.actor().name(), policy, Some(seed))
}

/// What a page says about an actor, the place and the description of its policy, and a seed.
fn described(actor: &str, policy: Option<(String, String)>, seed: Option<u64>) -> About {
    About {
        title: match &policy {
            Some((place, _)) if place.ends_with(BUILT_IN) => "A built-in policy".to_owned(),
            Some((place, _)) => place.clone(),
            None => format!("{}{}", actor[..1].to_uppercase(), &actor[1..]),
        },
        policy: policy.map(|(_, name)| match actor {
            "policy" => name,
            other => format!("{name} ({other})"),
        }),
        seed,
    }
}

/// The newest policy of a run.
pub struct Followed {
    run: RunFolder,
    /// Its file, and the stamp of that file before it was last read.
    pub path: PathBuf,
    stamp: Option<Stamp>,
}

impl Followed {
    /// Finds the run at `place`, by default the newest.
    ///
    /// # Errors
    /// Fails if there is no run.
    pub fn find(place: Option<&Path>) -> Result<Self> {
        let place = place.map(Path::to_owned).or_else(run::newest_run);
        let place = place.context("--follow needs a run, and there is none here")?;
        let needs = "--follow needs a run";
        PolicySource::find(&place).context(needs)?;
        let run = RunFolder::containing(&place).context(needs)?;
        let path = run.checkpoints.latest();
        Ok(Self {
            stamp: os::stamp(&path),
            run,
            path,
        })
    }

    /// Whether the file has changed since the last call.
    fn has_changed(&mut self) -> bool {
        let before = self.stamp;
        self.stamp = os::stamp(&self.path);
        self.stamp != before
    }
}

/// The sliders of a page for quantities of the physics: quantity, name, ends.
const FACTORS: [(&str, &str, [f64; 2]); 4] = [
    ("friction", "friction, ×", [0.3, 2.0]),
    ("cube_mass", "mass of the object, ×", [0.3, 3.0]),
    ("damping", "damping of the joints, ×", [0.2, 5.0]),
    ("gains", "stiffness of the servos, ×", [0.5, 2.0]),
];

/// The sliders for settings of the next episode: setting, name, ends, distance between values.
const SETTINGS: [(&str, &str, [f64; 2], f64); 3] = [
    (
        "env.cube_size_scale",
        "size of the object, ×, from the next episode on",
        [0.8, 1.2],
        0.05,
    ),
    (
        "env.action_delay",
        "delay, control steps, from the next episode on",
        [0.0, 8.0],
        1.0,
    ),
    (
        "env.prediction",
        "prediction, control steps, from the next episode on",
        [0.0, 8.0],
        1.0,
    ),
];

/// The sliders for the world of a task, and for the noise of a policy's actions.
fn sliders(stage: &Stage) -> Sliders {
    let env = &stage.task.config;
    let mut sliders: Vec<Slider> = FACTORS
        .into_iter()
        .map(|(quantity, name, range)| Slider::new(name, range, 0.0, 1.0, Some(quantity)))
        .collect();
    let starts = [
        env.cube_size_scale,
        env.action_delay.into(),
        env.prediction.into(),
    ];
    for ((_, name, [low, high], step), start) in SETTINGS.into_iter().zip(starts) {
        let range = [low.min(start), high.max(start)];
        sliders.push(Slider::new(name, range, step, start, None));
    }
    if stage.policy.is_some() {
        sliders.push(Slider::new(
            "0: mean actions, 1: actions with noise",
            [0.0, 1.0],
            1.0,
            stage.choice as f64,
            None,
        ));
    }
    Sliders::new(sliders, true)
}

/// The settings of sliders whose values are not the `usual` ones.
fn changed(usual: &[f64], values: &[f64]) -> Vec<Override> {
    let values = usual.iter().zip(values).skip(FACTORS.len());
    let changed = SETTINGS
        .iter()
        .zip(values)
        .filter(|(_, (usual, value))| usual != value);
    changed
        .map(|((key, ..), (_, value))| Override::new(*key, value))
        .collect()
}

/// The policy at `path` in a task with these settings, for a page that began with a stage and the task on display.
///
/// # Errors
/// Fails as [`Stage::find`] does, or if the policy is for another hand.
fn another(
    path: &Path,
    sets: &[Override],
    (first, task, shot): (&Stage, &Task, &Look),
    sliders: &Sliders,
) -> Result<LiveActor> {
    let newer = Stage {
        choice: first.choice,
        ..Stage::find(Some(path), sets)?
    };
    let record = |stage: &Stage| stage.policy.as_ref().map(|policy| policy.record.clone());
    ensure!(
        record(&newer) == record(first),
        "{} is for another hand",
        path.display()
    );
    let shown = see::task_for_display(&newer.task, shot)?;
    let mut acting = Rc::new(newer).acting(shown, sliders.clone());
    // The page shows the settings of the first policy.
    for (key, value) in acting.task.config.unlike(&task.config) {
        if let Some(name) = &mut acting.policy {
            *name += &format!(", {key} {}", short(&value));
        }
    }
    Ok(acting)
}

/// Shows the hand on a page for as long as the program runs. If a run is `followed`, each episode uses its newest policy. The page can
/// push the object, and change the world.
///
/// # Errors
/// Fails if the port cannot be opened.
pub fn live(
    args: &PlayArgs,
    port: u16,
    shot: &Look,
    stage: Stage,
    mut followed: Option<Followed>,
) -> Result<ExitCode> {
    let sliders = sliders(&stage);
    let usual = sliders.values();
    let task = see::task_for_display(&stage.task, shot)?;
    let mut about = about(&stage, args.seed);
    // Where the policy of each further episode comes from, or the name of an actor.
    let mut path = match &stage.policy {
        Some(policy) => policy.origin.path().to_owned(),
        None => stage.actors()[stage.choice].0.into(),
    };
    if let Some(followed) = &followed {
        about.title = followed.run.place().display().to_string();
        about.policy = None;
        path.clone_from(&followed.path);
    }
    let stage = Rc::new(stage);
    let mut acting = stage.clone().acting(task.clone(), sliders.clone());
    let look = (&about, shot.camera);
    let place = (port, args.shot.web_host.as_deref());
    let hands = args.hands as usize;
    let live = Live::open(place, look, hands, &acting, sliders.clone())?;
    let mut known = Vec::new();
    live.show(&mut || {
        let sets = changed(&usual, &sliders.values());
        if followed.as_mut().is_some_and(Followed::has_changed) || sets != known {
            match another(
                &path,
                &[&args.set[..], &sets].concat(),
                (&stage, &task, shot),
                &sliders,
            ) {
                Ok(newer) => acting = newer,
                Err(error) => say!("warning: {error:#}\n  The previous one continues."),
            }
            known = sets;
        }
        acting.clone()
    })
}

/// Writes the episodes of the trace in the file `path` as an HTML file.
///
/// # Errors
/// Fails if the file is no trace, or if the HTML file cannot be written. Fails if the user does not name a scene that is not built
/// in.
pub fn from_trace(
    path: &Path,
    to: &Destination,
    shot: &Look,
    set: &[Override],
) -> Result<ExitCode> {
    let cannot = || format!("cannot use the trace {}", path.display());
    let bytes = os::read_unpacked(path)?;
    ensure!(
        bytes.starts_with(b"{"),
        "{}: it does not begin with the header of a trace",
        cannot()
    );
    let text = String::from_utf8(bytes).with_context(cannot)?;
    ensure!(
        text.lines().all(|line| line.len() <= LONGEST_LINE),
        "{}: it has a line of more than {LONGEST_LINE} bytes",
        cannot()
    );
    let header = header(&text).with_context(cannot)?;
    for Override { key, .. } in set {
        ensure!(
            key == MODEL || key.starts_with("hand."),
            "--set {key}: a trace has its own settings; only {MODEL} and the parts of the hand can be set"
        );
    }
    let stored = settings(path, &header).with_context(cannot)?;
    let config = Settings::new()
        .stored(stored, Reader::Run)
        .sets(set)
        .resolve()
        .with_context(cannot)?;
    let task = Task::new(&config)?;
    ensure!(
        header["joint_names"] == json!(task.hand.parts.joints),
        "{}: it was recorded with another hand, which has other joints",
        cannot()
    );
    run::expect_output(&to.path, Some(path), task.config.model_file())?;
    let mut page = Replay::begin(to, &task, shot, 0)?;
    let left_out = page.read(&text).with_context(cannot)?;
    if left_out > 0 {
        say!(
            "note: {left_out} more episodes of {} are not in the HTML file",
            path.display()
        );
    }
    page.finish(&of_trace(&header))?;
    Ok(ExitCode::SUCCESS)
}

/// What a page says about who acts in a trace with this header. Tells the user where the policy did not fit well.
fn of_trace(header: &Value) -> About {
    let actor = header["actor"]
        .as_str()
        .filter(|actor| actor.is_ascii() && !actor.is_empty())
        .unwrap_or("policy");
    let warnings = header["warnings"].as_array().into_iter().flatten();
    let warnings = warnings.filter_map(Value::as_str);
    for warning in warnings.clone() {
        say!("warning: {warning}");
    }
    let policy = header["checkpoint"].as_str();
    let policy = policy.map(|place| (place.to_owned(), with_warnings(place, warnings)));
    described(actor, policy, header["seed"].as_u64())
}

/// The first record of a trace.
fn header(text: &str) -> Result<Value> {
    let header: Option<Value> = serde_json::from_str(text.lines().next().unwrap_or_default()).ok();
    header
        .filter(|header| header.get("observation").is_some())
        .context("it does not begin with the header of a trace")
}

/// The settings of the header of a trace as a configuration file.
///
/// # Errors
/// Fails if there are none.
fn settings(path: &Path, header: &Value) -> Result<Source> {
    let mut env = Table::new();
    let settings = header["settings"].as_object();
    for (key, value) in settings.context("it has no settings: not a trace of this program")? {
        let value = toml::Value::try_from(value)
            .with_context(|| format!("its setting {}", os::shortened(key)))?;
        env.insert(key.strip_prefix("env.").unwrap_or(key).to_owned(), value);
    }
    let text = Table::from_iter([("env".to_owned(), env.into())]).to_string();
    Ok(Source::new(path, text))
}
