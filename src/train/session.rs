//! Setting up a training: from settings, or from a checkpoint.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};

use super::films::Films;
use super::saver::{Begin, Saver, best_so_far};
use crate::agent::{Agent, expect_states};
use crate::cli::TrainArgs;
use crate::config::{Config, Override, user_file};
use crate::env::{Repose, SPACES, Task};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Array, Checkpoint, Evaluation};
use crate::run::{self, Locked, RunFolder};

/// The name under which a checkpoint stores the fingerprint of its environments' scene.
pub(super) const SCENE: &str = "scene";

/// Everything that a training owns, except its saver.
pub(super) struct Session {
    /// The settings of the run.
    pub config: Config,
    /// The task that is trained.
    pub task: Arc<Task>,
    /// The environments and the learner.
    pub agent: Agent<Repose>,
    /// The best evaluation so far.
    pub best: Option<Evaluation>,
    /// The films of evaluation episodes.
    pub films: Films,
    /// The number of steps of this session on which the physics diverged.
    pub diverged: u64,
    /// Whether the warning about them was printed.
    pub warned: bool,
    /// The fingerprint of the scene.
    scene: u64,
}

impl Session {
    /// Sets up the requested training and its saver.
    ///
    /// # Errors
    /// Fails as [`Session::begin`], [`Session::resume`] and [`Session::fork`] do.
    pub(crate) fn of(args: &TrainArgs) -> Result<(Self, Saver)> {
        match (&args.resume, &args.fork) {
            (Some(place), _) => Self::resume(&run_to_resume(place.as_deref())?, args),
            (None, Some(place)) => Self::fork(place, args),
            (None, None) => Self::begin(args),
        }
    }

    /// Sets up a new training. The folder is created last, so that a training that cannot be set up leaves none behind.
    ///
    /// # Errors
    /// Fails if the settings, the initial policy or the scene cannot be used, or if the folder cannot be created.
    pub(super) fn begin(args: &TrainArgs) -> Result<(Self, Saver)> {
        let mut config = Config::resolve(user_file(args.settings.config.as_deref())?.as_ref(), &overrides(args))?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        let init = args.init.as_deref().map(|place| policy_to_begin_with(place, &config)).transpose()?;
        let mut session = Self::new(config)?;
        if let Some(policy) = init {
            session.agent.ppo.begin_with(&policy)?;
        }
        let (folder, lock) = RunFolder::create(args.run_dir.as_deref(), args.name.as_deref())?;
        let saver = session.saver(folder, lock, args, Begin::New);
        Ok((session, saver))
    }

    /// Resumes a training from the newest undamaged checkpoint of a run, or from the given one.
    ///
    /// # Errors
    /// Fails if a setting is given that cannot be changed, or if the run cannot be resumed.
    pub(super) fn resume(place: &Path, args: &TrainArgs) -> Result<(Self, Saver)> {
        if let Some(set) = args.settings.set.iter().find(|set| set.key != MODEL) {
            bail!(
                "--set {}: a resumed run accepts only {MODEL}, --total-steps and --threads; use --fork for other settings",
                set.key
            );
        }
        let folder = RunFolder::containing(place)?;
        let checkpoints = folder.checkpoints();
        ensure!(!checkpoints.newest_first().is_empty(), "{} holds no checkpoint", place.display());
        let lock = folder.lock()?;
        let newest = checkpoints.newest_first();
        let places = if place.is_dir() { newest.clone() } else { vec![place.to_owned()] };
        let (path, mut checkpoint) =
            load::newest_sound(&places).with_context(|| format!("cannot resume {}", place.display()))?;
        let context = || format!("cannot resume from {}", path.display());
        let mut config = load::for_training(&checkpoint, &path, &overrides(args)).with_context(context)?;
        expect_states(&checkpoint, &config).with_context(context)?;
        expect_config(&folder, &config)?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        if config.run.shards == 0 {
            run::say(&format!(
                "note: {} was made before trainings had shards: the resumed run is not the same bit for bit",
                path.display()
            ));
        }
        let mut session = Self::new(config)?;
        let restored = session.agent.restore(&mut checkpoint).and_then(|()| checkpoint.take_counters(SCENE));
        if restored.with_context(context)? != [session.scene] {
            run::say("warning: the scene is not the one of the checkpoint: the resumed run is a different training");
        }
        let checkpoint_best = checkpoint.progress.best;
        checkpoint.finish().with_context(context)?;
        // The best is the one in the folder. It may have been saved after the checkpoint that is resumed, and a worse one must
        // not replace it.
        session.best = best_so_far(&folder, checkpoint_best);
        let begin = if run::same_file(&path, &newest[0]) { Begin::FromNewest } else { Begin::FromOlder };
        let saver = session.saver(folder, lock, args, begin);
        Ok((session, saver))
    }

    /// Creates a training at its beginning.
    ///
    /// # Errors
    /// Fails if the scene or the precision cannot be used.
    pub(super) fn new(mut config: Config) -> Result<Self> {
        // The saved configuration contains the actual number of shards.
        config.run.shards = config.shards();
        let task = Task::new(&config.env)?;
        let (agent, scene) = (Agent::of_task(&task, &config)?, task.scene().fingerprint()?);
        let films = Films::new(&config);
        Ok(Self { config, task, agent, best: None, films, diverged: 0, warned: false, scene })
    }

    /// Returns the complete state at the end of the last iteration.
    pub(super) fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = self.agent.checkpoint(&self.config.to_text(), self.best);
        checkpoint.insert(SCENE, Array::U64(vec![1], vec![self.scene]));
        checkpoint
    }

    /// Returns whether all steps are made.
    pub(super) fn finished(&self) -> bool {
        self.agent.env_steps >= self.config.run.total_steps
    }

    /// Returns the saver of this training for `folder`.
    pub(super) fn saver(&self, folder: RunFolder, lock: Locked, args: &TrainArgs, begin: Begin) -> Saver {
        let model = self.config.env.model_file().map(|model| run::quoted(&format!("{MODEL}={}", model.display())));
        let model = model.map_or(String::new(), |set| format!(" --set {set}"));
        let options = format!("{model}{}", if args.dump_diverged { " --dump-diverged" } else { "" });
        Saver::new((folder, lock), args.keep, options, self.checkpoint(), begin)
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

/// Loads the policy of a checkpoint or run for a training with this configuration to begin with.
fn policy_to_begin_with(place: &Path, config: &Config) -> Result<Checkpoint> {
    let origin = Origin::of(place)?;
    let (checkpoint, of_it) = origin.load_for_any_scene()?;
    let fitting = || {
        let net = config.ppo.net();
        checkpoint.expect_policy(&net, &SPACES)?;
        let (found, expected) = ((of_it.net.activation, of_it.net.symmetry), (net.activation, net.symmetry));
        ensure!(
            found == expected,
            "its activation and symmetry are {found:?}, but those of this training are {expected:?}"
        );
        Ok(())
    };
    fitting().with_context(|| format!("cannot start from the policy {origin}"))?;
    Ok(checkpoint)
}
