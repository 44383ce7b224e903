//! What a training run starts from: settings, and a policy or a state. Only the first rank needs the files. The others receive the
//! plan.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use super::saver::best_so_far;
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::{
    BUILTIN_MODEL, Config, MODEL, Override, PpoConfig, Reader, Settings, Source, short,
};
use crate::load::{self, PolicySource};
use crate::os::Locked;
use crate::ppo::{Checkpoint, Fork};
use crate::ranks::Exchange;
use crate::repose::{Record, Task};
use crate::run::{self, RunFolder};

/// The settings of a training run and what it starts from.
pub struct Plan {
    /// The settings of the run.
    pub config: Config,
    /// The checkpoint that it starts from, and what it takes from it. Without one, it starts from random weights.
    pub from: Option<(Takes, Checkpoint)>,
    /// The best evaluation so far.
    pub best: Option<[f64; 2]>,
    /// The context of the error if it cannot start from that.
    pub context: Option<String>,
    /// Whether to write the steps that led to diverged states.
    pub dumps: bool,
    /// The folder of a run that is resumed, and the lock on it.
    pub existing: Option<(RunFolder, Locked)>,
}

/// What a training run takes from the checkpoint that it starts from.
#[derive(Clone, Copy, Serialize, Deserialize)]
pub enum Takes {
    /// The policy. Everything else is as in any new run.
    Policy,
    /// The whole state.
    State,
    /// The whole state, under settings that differ from the checkpoint's.
    Fork,
}

/// The settings that a fork keeps: they determine the size of the state or the kind of policy.
const KEPT: [&str; 4] = [
    "env.num_envs",
    "ppo.hidden",
    "ppo.symmetry",
    "ppo.activation",
];

/// The parts of a plan as they are sent: the settings as text, the checkpoint as a file.
type PlanParts = (
    String,
    Option<(Takes, Vec<u8>)>,
    Option<[f64; 2]>,
    Option<String>,
    bool,
);

impl Plan {
    /// Plans what the command line asks for.
    ///
    /// # Errors
    /// Fails as [`Plan::new_run`], [`Plan::resume`] and [`Plan::fork`] do.
    pub fn of(args: &TrainArgs) -> Result<Self> {
        match (&args.resume, &args.fork) {
            (Some(place), _) => Self::resume(place.as_deref(), args),
            (None, Some(place)) => Self::fork(place, args),
            (None, None) => Self::new_run(args),
        }
    }

    /// The plan of a training run that starts from random weights. The path of its scene is made absolute, so that the run does
    /// not depend on the folder in which it was started.
    ///
    /// # Errors
    /// Fails if the scene does not exist.
    pub fn new(mut config: Config, args: &TrainArgs) -> Result<Self> {
        if let Some(model) = config.env.model_file() {
            let model = model
                .canonicalize()
                .with_context(|| format!("{MODEL}: cannot find {}", model.display()))?;
            config.env.model = model.display().to_string();
        }
        Ok(Self {
            config,
            from: None,
            best: None,
            context: None,
            dumps: args.dump_diverged,
            existing: None,
        })
    }

    /// Plans a new training with the requested settings.
    ///
    /// # Errors
    /// Fails if the settings or the initial policy cannot be used.
    fn new_run(args: &TrainArgs) -> Result<Self> {
        let settings = settings(args)?;
        let Some(place) = &args.init else {
            return Self::new(settings.resolve()?, args);
        };
        let origin = PolicySource::find(place)?;
        let checkpoint = origin.load()?;
        // Regardless of its training scene.
        let any_scene = Override::new(MODEL, BUILTIN_MODEL);
        let played = origin.settings(&checkpoint, &[any_scene])?;
        let settings = settings.stored(load::source(&checkpoint, place), Reader::NewRun);
        let mut plan = Self::new(settings.resolve()?, args)?;
        expect_net(&checkpoint, &played.ppo, &plan.config.ppo)
            .with_context(|| format!("cannot start from the policy {origin}"))?;
        plan.from = Some((Takes::Policy, checkpoint));
        plan.context = Some(format!("cannot start from the policy {}", place.display()));
        Ok(plan)
    }

    /// Plans to resume a training run from the newest undamaged checkpoint of a run, or from the given one. Locks its folder.
    ///
    /// # Errors
    /// Fails if a setting is given that cannot be changed, or if the run cannot be resumed.
    fn resume(place: Option<&Path>, args: &TrainArgs) -> Result<Self> {
        let place = place.map(Path::to_owned).or_else(run::newest_run);
        let place = place.context(
            "--resume: there is no run in runs/shadow-hand-repose; name the folder of a run",
        )?;
        let mut folder = RunFolder::containing(&place)?;
        ensure!(
            !folder.checkpoints.newest_first().is_empty(),
            "{} holds no checkpoint: the run ended before it saved one; repeat the command that started it",
            place.display()
        );
        let lock = folder.lock()?;
        let (path, checkpoint) = load::newest_sound(|| checkpoints_at(&place))
            .with_context(|| format!("cannot resume {}", place.display()))?;
        let context = format!("cannot resume from {}", path.display());
        let config = load::settings(&checkpoint, &path, Reader::Run, &overrides(args))
            .context(context.clone())?;
        let stored = load::source(&checkpoint, &path).resolve()?;
        let differing = stored.differences(&config);
        ensure!(
            differing.is_empty(),
            "{}: a resumed run accepts only {MODEL}, --total-steps and --threads; use --fork for other settings",
            differing.join("; ")
        );
        expect_states(&checkpoint, &config).context(context.clone())?;
        expect_config(&folder, &config)?;
        // The best evaluation comes from the folder. It may have been saved after the checkpoint that is resumed, and a worse
        // one must not replace it.
        let best = best_so_far(&folder, checkpoint.progress.best);
        Ok(Self {
            from: Some((Takes::State, checkpoint)),
            best,
            context: Some(context),
            existing: Some((folder, lock)),
            ..Self::new(config, args)?
        })
    }

    /// Plans a new run that starts from the newest undamaged checkpoint of another, or from the given one. Settings may
    /// change unless they determine the size of the state or the kind of policy.
    ///
    /// # Errors
    /// Fails if the checkpoint cannot be resumed from, or if the settings do not fit it.
    fn fork(place: &Path, args: &TrainArgs) -> Result<Self> {
        if matches!(PolicySource::find(place), Ok(PolicySource::BuiltIn(_))) {
            let name = place.display();
            bail!(
                "--fork {name}: a built-in policy has no training state; use --init {name} to start from it"
            );
        }
        let context = || format!("cannot fork {}", place.display());
        let (path, checkpoint) =
            load::newest_sound(|| checkpoints_at(place)).with_context(context)?;
        let context = format!("cannot fork {}", path.display());
        let mut plan = Self::forked(&path, checkpoint, args).context(context.clone())?;
        plan.context = Some(context);
        Ok(plan)
    }

    fn forked(path: &Path, mut checkpoint: Checkpoint, args: &TrainArgs) -> Result<Self> {
        let (parent, config) = load::for_fork(&checkpoint, path, settings(args)?)?;
        expect_states(&checkpoint, &parent)?;
        for (key, [before, now]) in parent.compared_with(&config) {
            ensure!(
                !KEPT.contains(&&*key),
                "{key} = {}: a fork keeps {}, the value of its checkpoint",
                short(&now),
                short(&before)
            );
        }
        let mut plan = Self::new(config, args)?;
        let config = &plan.config;
        expect_scene(&parent, config, &checkpoint)?;
        let whole = path.canonicalize();
        let progress = &mut checkpoint.progress;
        ensure!(
            progress.env_steps < config.run.total_steps,
            "run.total_steps = {}: the checkpoint is at step {} already; set a larger total with --total-steps",
            config.run.total_steps,
            progress.env_steps
        );
        progress.fork = Some(Fork {
            from: whole.as_deref().unwrap_or(path).display().to_string(),
            iteration: progress.iteration,
            env_steps: progress.env_steps,
        });
        // Scores under different settings are not comparable, so the best one is not kept.
        progress.best = None;
        plan.from = Some((Takes::Fork, checkpoint));
        Ok(plan)
    }

    /// Loads the task for the policy of the plan, and takes over what its scene gives. Returns it with the policy's record.
    ///
    /// # Errors
    /// Fails if the scene cannot be used, or if the policy is for another hand.
    pub fn load_task(&mut self) -> Result<(Arc<Task>, Record)> {
        let task = Task::new(&self.config)?;
        let record = match &self.from {
            Some((_, checkpoint)) => Record::parse(&checkpoint.hand)?,
            None => task.record().with(self.config.ppo.symmetry),
        };
        // What is written must be readable.
        Record::parse(&record.to_text())?;
        let task = task.for_policy(&record)?;
        self.config.env = task.config.clone();
        Ok((task, record))
    }

    /// Sends the plan to the others, if there are any.
    ///
    /// # Errors
    /// Fails if a value in the checkpoint is not finite.
    pub fn send(&self, exchange: &Exchange) -> Result<()> {
        if exchange.is_alone() {
            return Ok(());
        }
        let from = match &self.from {
            Some((takes, checkpoint)) => Some((*takes, checkpoint.to_bytes()?)),
            None => None,
        };
        let config = self.config.to_text();
        let context = self.context.clone();
        exchange.broadcast::<PlanParts>(Some((config, from, self.best, context, self.dumps)));
        Ok(())
    }

    /// The plan that the first rank has sent.
    ///
    /// # Errors
    /// Fails if the sender runs another version of the program.
    pub fn receive(exchange: &Exchange) -> Result<Self> {
        let (config, from, best, context, dumps) = exchange.broadcast::<PlanParts>(None);
        let config = Source::new("the settings that were sent", config).resolve()?;
        let from = match from {
            Some((takes, bytes)) => Some((takes, Checkpoint::parse(&bytes)?)),
            None => None,
        };
        Ok(Self {
            config,
            from,
            best,
            context,
            dumps,
            existing: None,
        })
    }
}

/// The checkpoint `place`, or the checkpoints of the run there, the newest first.
fn checkpoints_at(place: &Path) -> Result<Vec<PathBuf>> {
    if !place.is_dir() {
        return Ok(vec![place.to_owned()]);
    }
    Ok(RunFolder::containing(place)?.checkpoints.newest_first())
}

/// What the user sets.
fn settings(args: &TrainArgs) -> Result<Settings> {
    Ok(Settings::new()
        .user_file(args.settings.config.as_deref())?
        .sets(&overrides(args)))
}

/// The single settings, including settings that have their own options.
fn overrides(args: &TrainArgs) -> Vec<Override> {
    let options = [
        ("run.seed", args.seed),
        ("run.threads", args.threads.map(|n| n as u64)),
        ("run.total_steps", args.total_steps),
    ];
    let given = options
        .into_iter()
        .filter_map(|(key, value)| Some(Override::new(key, value?)));
    args.settings.set.iter().cloned().chain(given).collect()
}

/// Checks that the settings in the folder match the checkpoint, because edits to them would be ignored.
fn expect_config(folder: &RunFolder, config: &Config) -> Result<()> {
    let Some((path, text)) = folder.config()? else {
        return Ok(());
    };
    let advice = format!(
        "restore {} or delete it; to change settings, start a new run with --fork",
        path.display()
    );
    let found = Source::new(&path, text).resolve().context(advice.clone())?;
    let differing = config.differences(&found);
    ensure!(
        differing.is_empty(),
        "{} differs from the checkpoint: {}\n{advice}",
        path.display(),
        differing.join("; ")
    );
    Ok(())
}

/// Checks that a policy with the `stored` settings can begin a training run with these.
fn expect_net(checkpoint: &Checkpoint, stored: &PpoConfig, settings: &PpoConfig) -> Result<()> {
    load::expect_policy(checkpoint, settings)?;
    let [found, expected] =
        [stored, settings].map(|settings| (settings.activation, settings.symmetry));
    ensure!(
        found == expected,
        "its activation and symmetry are {found:?}, but those of this training run are {expected:?}"
    );
    Ok(())
}

/// Checks that the scene is the scene of the checkpoint. Its physics may change: timestep, cones, masses, sizes, servos, joints.
fn expect_scene(parent: &Config, config: &Config, checkpoint: &Checkpoint) -> Result<()> {
    let mut before = parent.clone();
    before.env.model.clone_from(&config.env.model);
    before.hand.clone_from(&config.hand);
    let task =
        Task::new(&before).context("a fork keeps the scene and the hand of its checkpoint")?;
    ensure!(
        checkpoint.scene == task.scene.fingerprint(),
        "{MODEL} = {}: not the scene of the checkpoint, which a fork must keep",
        config.env.model
    );
    Ok(())
}
