//! What a training starts from: settings, and a policy or a state. Only who leads a training needs the files; others receive the
//! plan.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use super::saver::best_so_far;
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::{Config, NetConfig, Override, PolicyConfig, user_file};
use crate::load::{self, MODEL, PolicySource};
use crate::os::{self, Locked};
use crate::ppo::{Checkpoint, Evaluation, Fork};
use crate::ranks::Exchange;
use crate::repose::{SPACES, Task};
use crate::run::{self, RunFolder};

/// The settings of a training and what it starts from.
pub(super) struct Plan {
    /// The settings of the run.
    pub config: Config,
    /// What it starts from.
    pub from: StartFrom,
    /// What cannot be done if it cannot start from that.
    pub context: Option<String>,
    /// Whether to write the steps that led to diverged states.
    pub dumps: bool,
}

/// What a training starts from.
pub(super) enum StartFrom {
    /// Random weights.
    Scratch,
    /// The policy of this checkpoint; all else is as in any new run.
    Policy(Checkpoint),
    /// The whole state in this checkpoint of a run.
    State(Checkpoint),
    /// The whole state in this checkpoint of another run, under settings that have changed from these.
    Fork(Checkpoint, Box<Config>),
}

/// The folder of a run that is resumed.
pub(super) struct Existing {
    /// The folder.
    pub folder: RunFolder,
    /// The lock on it.
    pub lock: Locked,
    /// Whether the checkpoint that is resumed is the newest one.
    pub from_newest: bool,
    /// The best evaluation so far.
    pub best: Option<Evaluation>,
}

/// A plan as it is sent.
#[derive(Serialize, Deserialize)]
struct Message {
    config: String,
    /// The file of the checkpoint.
    checkpoint: Option<Vec<u8>>,
    /// The settings of the parent of a fork.
    parent: Option<String>,
    starts_from_state: bool,
    context: Option<String>,
    dumps: bool,
}

impl Plan {
    /// Plans a new training with the requested settings.
    ///
    /// # Errors
    /// Fails if the settings or the initial policy cannot be used.
    pub(super) fn new_run(args: &TrainArgs) -> Result<Self> {
        let (user, overrides) = (user_file(args.settings.config.as_deref())?, overrides(args));
        let Some(place) = &args.init else {
            let mut config = Config::resolve(user.as_ref(), &overrides)?;
            absolute_model_path(&mut config)?;
            return Ok(Self::new(config, args));
        };
        let origin = PolicySource::find(place)?;
        let (checkpoint, PolicyConfig { net, .. }) = origin.load_for_any_scene()?;
        let mut config = Config::resolve_around(&net, user.as_ref(), &overrides)?;
        absolute_model_path(&mut config)?;
        expect_net(&checkpoint, &net, &config).with_context(|| format!("cannot start from the policy {origin}"))?;
        let context = Some(format!("cannot start from the policy {}", place.display()));
        Ok(Self { from: StartFrom::Policy(checkpoint), context, ..Self::new(config, args) })
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
        absolute_model_path(&mut config)?;
        // The best is the one in the folder. It may have been saved after the checkpoint that is resumed, and a worse one must
        // not replace it.
        let best = best_so_far(&folder, checkpoint.progress.best);
        let from_newest = os::same_file(&path, &newest[0]);
        let plan = Self { from: StartFrom::State(checkpoint), context: Some(context), ..Self::new(config, args) };
        Ok((plan, Existing { folder, lock, from_newest, best }))
    }

    /// Returns the plan of a training that starts from random weights.
    pub(super) fn new(config: Config, args: &TrainArgs) -> Self {
        Self { config, from: StartFrom::Scratch, context: None, dumps: args.dump_diverged }
    }

    /// Plans a new run that starts from the newest undamaged checkpoint of another, or from the given one. Settings may
    /// change unless they determine the size of the state or the kind of policy; nets may become wider.
    ///
    /// # Errors
    /// Fails if the checkpoint cannot be resumed from, or if the settings do not fit it.
    pub(super) fn fork(place: &Path, args: &TrainArgs) -> Result<Self> {
        if matches!(PolicySource::find(place), Ok(PolicySource::BuiltIn(_))) {
            let name = place.display();
            bail!("--fork {name}: a policy alone, without the state of a training; use --init {name} to start from it");
        }
        let places = if place.is_dir() {
            RunFolder::containing(place)?.checkpoints().newest_first()
        } else {
            vec![place.to_owned()]
        };
        let context = || format!("cannot fork {}", place.display());
        let (path, checkpoint) = load::newest_sound(&places).with_context(context)?;
        Self::forked(&path, checkpoint, args).with_context(|| format!("cannot fork {}", path.display()))
    }

    fn forked(path: &Path, mut checkpoint: Checkpoint, args: &TrainArgs) -> Result<Self> {
        let user = user_file(args.settings.config.as_deref())?;
        let (parent, mut config) = load::for_fork(&checkpoint, path, user.as_ref(), &overrides(args))?;
        expect_states(&checkpoint, &parent)?;
        expect_kept(&parent, &config)?;
        absolute_model_path(&mut config)?;
        expect_scene(&parent, &config, &checkpoint)?;
        checkpoint.grow(&parent.ppo.net(), &config.ppo.net(), SPACES, config.run.seed)?;
        let from = path.canonicalize().unwrap_or_else(|_| path.to_owned()).display().to_string();
        let progress = &mut checkpoint.progress;
        ensure!(
            progress.env_steps < config.run.total_steps,
            "run.total_steps = {}: the checkpoint has made {} already; set the new total with --total-steps",
            config.run.total_steps,
            progress.env_steps
        );
        progress.fork = Some(Fork { from, iteration: progress.iteration, env_steps: progress.env_steps });
        // Scores under different settings are not comparable, so the best one is not kept.
        progress.best = None;
        let from_state = StartFrom::Fork(checkpoint, Box::new(parent));
        let context = Some(format!("cannot fork {}", path.display()));
        Ok(Self { from: from_state, context, ..Self::new(config, args) })
    }

    /// Sends the plan to all that pass `None`.
    ///
    /// # Errors
    /// Fails if a value in the checkpoint is not finite, or if the sender runs another version of the program.
    pub(super) fn broadcast(plan: Option<&Self>, exchange: &Exchange) -> Result<Option<Self>> {
        if exchange.is_alone() {
            return Ok(None);
        }
        let message = exchange.broadcast(plan.map(Self::message).transpose()?);
        if plan.is_some() {
            return Ok(None);
        }
        let Message { config, checkpoint, parent, starts_from_state, context, dumps } = message;
        let parse = |text: &str| Config::from_text(Path::new("the settings that were sent"), text, &[]);
        let checkpoint = checkpoint.map(|bytes| Checkpoint::parse(&bytes)).transpose()?;
        let from = match (checkpoint, &parent) {
            (None, _) => StartFrom::Scratch,
            (Some(checkpoint), Some(parent)) => StartFrom::Fork(checkpoint, Box::new(parse(parent)?)),
            (Some(checkpoint), None) if starts_from_state => StartFrom::State(checkpoint),
            (Some(checkpoint), None) => StartFrom::Policy(checkpoint),
        };
        Ok(Some(Self { config: parse(&config)?, from, context, dumps }))
    }

    fn message(&self) -> Result<Message> {
        let (checkpoint, parent) = match &self.from {
            StartFrom::Scratch => (None, None),
            StartFrom::Policy(checkpoint) | StartFrom::State(checkpoint) => (Some(checkpoint), None),
            StartFrom::Fork(checkpoint, parent) => (Some(checkpoint), Some(parent.to_text())),
        };
        Ok(Message {
            config: self.config.to_text(),
            checkpoint: checkpoint.map(Checkpoint::to_bytes).transpose()?,
            parent,
            starts_from_state: matches!(self.from, StartFrom::State(_)),
            context: self.context.clone(),
            dumps: self.dumps,
        })
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
fn overrides(args: &TrainArgs) -> Vec<Override> {
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
fn absolute_model_path(config: &mut Config) -> Result<()> {
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
fn expect_net(checkpoint: &Checkpoint, policy: &NetConfig, config: &Config) -> Result<()> {
    let net = config.ppo.net();
    checkpoint.expect_policy(&net, &SPACES)?;
    let (found, expected) = ((policy.activation, policy.symmetry), (net.activation, net.symmetry));
    ensure!(
        found == expected,
        "its activation and symmetry are {found:?}, but those of this training are {expected:?}"
    );
    Ok(())
}

/// Checks that the settings that determine the size of the state or the kind of policy are unchanged.
fn expect_kept(parent: &Config, config: &Config) -> Result<()> {
    let of = |config: &Config| {
        let net = config.ppo.net();
        let kept = [format!("{}", config.env.num_envs), format!("{:?}", net.symmetry), format!("{:?}", net.activation)];
        kept.map(|value| value.to_lowercase())
    };
    let keys = ["env.num_envs", "ppo.symmetry", "ppo.activation"];
    for (key, (before, now)) in keys.into_iter().zip(of(parent).into_iter().zip(of(config))) {
        ensure!(before == now, "{key} = {now}: a fork keeps {before}, the value of its checkpoint");
    }
    Ok(())
}

/// Checks that the scene is that of the checkpoint. Its physics may change: timestep, cones, masses, sizes, servos, joints.
fn expect_scene(parent: &Config, config: &Config, checkpoint: &Checkpoint) -> Result<()> {
    let mut before = parent.env.clone();
    before.model.clone_from(&config.env.model);
    let same = checkpoint.is_of_scene(&Task::new(&before)?.scene().fingerprint());
    ensure!(same, "{MODEL} = {}: not the scene of the checkpoint, which a fork keeps", config.env.model);
    Ok(())
}
