//! What a training begins with: settings, and the policy or the state that it starts from. The first rank decides it, and the
//! others receive it, so that nothing can differ between them and only the first needs the files.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use super::saver::{Begin, best_so_far};
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::{Config, NetConfig, Override, PolicyConfig, user_file};
use crate::load::{self, MODEL, Origin};
use crate::os::{self, Locked};
use crate::ppo::{Checkpoint, Evaluation};
use crate::ranks::Ranks;
use crate::repose::SPACES;
use crate::run::{self, RunFolder};

/// What a training begins with, the same on all ranks.
pub(super) struct Plan {
    /// The settings of the run.
    pub config: Config,
    /// What it starts from.
    pub start: Start,
    /// What cannot be done if it cannot start from that.
    pub context: String,
    /// Whether to write the steps that led to diverged states.
    pub dumps: bool,
}

/// What a training starts from.
pub(super) enum Start {
    /// Random weights.
    Nothing,
    /// The policy of this checkpoint; all else is as in any new run.
    Policy(Checkpoint),
    /// The whole state in this checkpoint.
    State(Checkpoint),
    /// The whole state in this checkpoint, under settings that have changed from these.
    Fork(Checkpoint, Box<Config>),
}

/// The folder of a run that is resumed.
pub(super) struct Existing {
    /// The folder.
    pub folder: RunFolder,
    /// The lock on it.
    pub lock: Locked,
    /// Which of its checkpoints is resumed.
    pub begin: Begin,
    /// The best evaluation so far.
    pub best: Option<Evaluation>,
}

/// A plan as the first rank sends it, apart from the checkpoint.
#[derive(Serialize, Deserialize)]
struct Message {
    config: String,
    /// The settings of the parent of a fork.
    parent: Option<String>,
    starts_from_state: bool,
    context: String,
    dumps: bool,
}

impl Plan {
    /// Plans a new training with the requested settings.
    ///
    /// # Errors
    /// Fails if the settings or the initial policy cannot be used.
    pub(super) fn begin(args: &TrainArgs) -> Result<Self> {
        let (user, overrides) = (user_file(args.settings.config.as_deref())?, overrides(args));
        let Some(place) = &args.init else {
            let mut config = Config::resolve(user.as_ref(), &overrides)?;
            settle_model(&mut config)?;
            return Ok(Self::new(config, args));
        };
        let origin = Origin::of(place)?;
        let (checkpoint, PolicyConfig { net, .. }) = origin.load_for_any_scene()?;
        let mut config = Config::resolve_around(&net, user.as_ref(), &overrides)?;
        settle_model(&mut config)?;
        expect_net(&checkpoint, &net, &config).with_context(|| format!("cannot start from the policy {origin}"))?;
        let context = format!("cannot start from the policy {}", place.display());
        Ok(Self { start: Start::Policy(checkpoint), context, ..Self::new(config, args) })
    }

    /// Plans to resume a training from the newest undamaged checkpoint of a run, or from the given one. Locks its folder.
    ///
    /// # Errors
    /// Fails if a setting is given that cannot be changed, or if the run cannot be resumed.
    pub(super) fn resume(place: Option<&Path>, args: &TrainArgs) -> Result<(Self, Existing)> {
        let place = run_to_resume(place)?;
        if let Some(set) = args.settings.set.iter().find(|set| set.key != MODEL) {
            bail!(
                "--set {}: a resumed run accepts only {MODEL}, --total-steps and --threads; use --fork for other settings",
                set.key
            );
        }
        let folder = RunFolder::containing(&place)?;
        let checkpoints = folder.checkpoints();
        ensure!(!checkpoints.newest_first().is_empty(), "{} holds no checkpoint", place.display());
        let lock = folder.lock()?;
        let newest = checkpoints.newest_first();
        let places = if place.is_dir() { newest.clone() } else { vec![place.clone()] };
        let (path, checkpoint) =
            load::newest_sound(&places).with_context(|| format!("cannot resume {}", place.display()))?;
        let context = format!("cannot resume from {}", path.display());
        let config = || {
            let config = load::for_training(&checkpoint, &path, &overrides(args))?;
            expect_states(&checkpoint, &config).map(|()| config)
        };
        let mut config = config().context(context.clone())?;
        expect_config(&folder, &config)?;
        settle_model(&mut config)?;
        if config.run.shards == 0 {
            os::say(&format!(
                "note: {} was made before trainings had shards: the resumed run is not the same bit for bit",
                path.display()
            ));
        }
        // The best is the one in the folder. It may have been saved after the checkpoint that is resumed, and a worse one must
        // not replace it.
        let best = best_so_far(&folder, checkpoint.progress.best);
        let begin = if os::same_file(&path, &newest[0]) { Begin::FromNewest } else { Begin::FromOlder };
        let plan = Self { start: Start::State(checkpoint), context, ..Self::new(config, args) };
        Ok((plan, Existing { folder, lock, begin, best }))
    }

    /// Returns the plan of a training that starts from random weights.
    pub(super) fn new(config: Config, args: &TrainArgs) -> Self {
        Self { config, start: Start::Nothing, context: "cannot start".into(), dumps: args.dump_diverged }
    }

    /// Sends the plan of the first rank to all others.
    ///
    /// # Errors
    /// Fails if a value in the checkpoint is not finite.
    pub(super) fn send(&self, ranks: &dyn Ranks) -> Result<()> {
        if ranks.size() == 1 {
            return Ok(());
        }
        let (parent, checkpoint) = match &self.start {
            Start::Nothing => (None, None),
            Start::Policy(checkpoint) | Start::State(checkpoint) => (None, Some(checkpoint)),
            Start::Fork(checkpoint, parent) => (Some(parent.to_text()), Some(checkpoint)),
        };
        let starts_from_state = matches!(self.start, Start::State(_));
        let (config, context) = (self.config.to_text(), self.context.clone());
        let message = Message { config, parent, starts_from_state, context, dumps: self.dumps };
        ranks.broadcast(serde_json::to_vec(&message)?);
        ranks.broadcast(checkpoint.map_or(Ok(Vec::new()), Checkpoint::to_bytes)?);
        Ok(())
    }

    /// Receives the plan of the first rank.
    ///
    /// # Errors
    /// Fails if the first rank runs another version of the program.
    pub(super) fn receive(ranks: &dyn Ranks) -> Result<Self> {
        let message: Message = serde_json::from_slice(&ranks.broadcast(Vec::new()))?;
        let bytes = ranks.broadcast(Vec::new());
        let parse = |text: &str| Config::from_text(Path::new("the settings of rank 0"), text, &[]);
        let checkpoint = if bytes.is_empty() { None } else { Some(Checkpoint::parse(&bytes)?) };
        let start = match (checkpoint, &message.parent) {
            (None, _) => Start::Nothing,
            (Some(checkpoint), Some(parent)) => Start::Fork(checkpoint, Box::new(parse(parent)?)),
            (Some(checkpoint), None) if message.starts_from_state => Start::State(checkpoint),
            (Some(checkpoint), None) => Start::Policy(checkpoint),
        };
        Ok(Self { config: parse(&message.config)?, start, context: message.context, dumps: message.dumps })
    }
}

/// Returns the run or checkpoint to resume: the given one, or the newest run.
///
/// # Errors
/// Fails if there is no run.
fn run_to_resume(place: Option<&Path>) -> Result<PathBuf> {
    let place = place.map(Path::to_owned).or_else(run::newest_run);
    place.context("--resume: there is no run in runs/shadow-hand-repose; name the folder of a run")
}

/// Returns the single settings, including those that have their own options.
pub(super) fn overrides(args: &TrainArgs) -> Vec<Override> {
    let options = [
        ("run.seed", args.seed),
        ("run.threads", args.threads.map(|n| n as u64)),
        ("run.total_steps", args.total_steps),
    ];
    let given = options.into_iter().filter_map(|(key, value)| Some((key, value?)));
    let given = given.map(|(key, value)| Override { key: key.into(), value: value.to_string() });
    args.settings.set.iter().cloned().chain(given).collect()
}

/// Makes the path of the scene absolute, so that the run does not depend on the folder in which it was started.
///
/// # Errors
/// Fails if the scene does not exist.
pub(super) fn settle_model(config: &mut Config) -> Result<()> {
    if let Some(model) = config.env.model_file() {
        let model = model.canonicalize().with_context(|| format!("{MODEL}: cannot find {}", model.display()))?;
        config.env.model = model.display().to_string();
    }
    Ok(())
}

/// Checks that the settings in the folder are those of the checkpoint, because edits to them would be ignored.
fn expect_config(folder: &RunFolder, config: &Config) -> Result<()> {
    let Some((path, text)) = folder.config()? else { return Ok(()) };
    let advice = format!("restore {} or delete it; to change settings, start a new run with --fork", path.display());
    let found = Config::from_text(&path, &text, &[]).with_context(|| advice.clone())?;
    let differing = config.differences(&found);
    ensure!(differing.is_empty(), "{} differs from the checkpoint: {}\n{advice}", path.display(), differing.join("; "));
    Ok(())
}

/// Checks that a policy with this net can begin a training with these settings.
fn expect_net(checkpoint: &Checkpoint, of_policy: &NetConfig, config: &Config) -> Result<()> {
    let net = config.ppo.net();
    checkpoint.expect_policy(&net, &SPACES)?;
    let (found, expected) = ((of_policy.activation, of_policy.symmetry), (net.activation, net.symmetry));
    ensure!(
        found == expected,
        "its activation and symmetry are {found:?}, but those of this training are {expected:?}"
    );
    Ok(())
}
