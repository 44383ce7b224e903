//! How a training comes to be: from settings, or from the checkpoint of another one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};

use super::saver::{Begin, Saver, best_so_far};
use crate::agent::{Agent, expect_states};
use crate::cli::{Settings, TrainArgs};
use crate::config::{BUILTIN_MODEL, Config, Override, Source};
use crate::env::{Repose, SPACES, Task};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Array, Checkpoint};
use crate::run::{self, Locked, RunFolder};

/// Where a checkpoint keeps the fingerprint of the scene that its environments live in.
pub const SCENE: &str = "scene";

/// All that a training owns, but for what saves it.
pub struct Session {
    /// The settings of the run.
    pub config: Config,
    /// What is trained.
    pub task: Arc<Task>,
    /// What learns.
    pub agent: Agent<Repose>,
    /// Goals per episode and rotation error (rad) of the best evaluation.
    pub best: Option<[f64; 2]>,
    /// Steps of this session on which the physics diverged.
    pub diverged: u64,
    /// That they are many was said.
    pub warned: bool,
    /// The fingerprint of the scene.
    scene: u64,
}

impl Session {
    /// A new training, whose folder comes last: it is not touched by one that cannot be set up.
    ///
    /// # Errors
    /// Settings, a policy to begin with or a scene that cannot be used; a folder that cannot be made.
    pub fn begin(args: &TrainArgs) -> Result<(Self, Saver)> {
        let mut config = Config::resolve(user_file(&args.settings)?.as_ref(), &overrides(args))?;
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

    /// Goes on with a training from the newest checkpoint of a run that is not damaged, or from the one that is named.
    ///
    /// # Errors
    /// Settings that cannot be changed; a run that cannot be gone on with.
    pub fn resume(place: &Path, args: &TrainArgs) -> Result<(Self, Saver)> {
        if let Some(set) = args.settings.set.iter().find(|set| set.key != MODEL) {
            bail!(
                "--set {}: of a run that is resumed only {MODEL} can be given again, and --total-steps and --threads; --fork changes settings",
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
                "note: {} was made before trainings had shards: what follows is another sequence than before",
                path.display()
            ));
        }
        let mut session = Self::new(config)?;
        let restored = session.agent.restore(&mut checkpoint).and_then(|()| checkpoint.take_counters(SCENE));
        if restored.with_context(context)? != [session.scene] {
            run::say("warning: the scene is not the one of the checkpoint: what follows is another training");
        }
        let checkpoint_best = checkpoint.progress.best;
        checkpoint.finish().with_context(context)?;
        // The best is what is in the folder. It may have been saved after the checkpoint that is resumed from, and is not given up
        // for a worse one.
        session.best = best_so_far(&folder, checkpoint_best);
        let begin = if run::same_file(&path, &newest[0]) { Begin::FromNewest } else { Begin::FromOlder };
        let saver = session.saver(folder, lock, args, begin);
        Ok((session, saver))
    }

    /// A training at its beginning.
    ///
    /// # Errors
    /// A scene or a precision that cannot be used.
    pub fn new(mut config: Config) -> Result<Self> {
        // What is written says how it was divided.
        config.run.shards = config.shards();
        let task = Task::new(&config.env)?;
        let (agent, scene) = (Agent::of_task(&task, &config)?, task.scene().fingerprint()?);
        Ok(Self { config, task, agent, best: None, diverged: 0, warned: false, scene })
    }

    /// The end of the last iteration, whole.
    pub fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = self.agent.checkpoint(&self.config.to_text(), self.best);
        checkpoint.insert(SCENE, Array::U64(vec![1], vec![self.scene]));
        checkpoint
    }

    /// Whether all steps are made.
    pub fn finished(&self) -> bool {
        self.agent.env_steps >= self.config.run.total_steps
    }

    /// What saves it in this folder.
    pub fn saver(&self, folder: RunFolder, lock: Locked, args: &TrainArgs, begin: Begin) -> Saver {
        let model = self.config.env.model_file().map(|model| run::quoted(&format!("{MODEL}={}", model.display())));
        let model = model.map_or(String::new(), |set| format!(" --set {set}"));
        let options = format!("{model}{}", if args.dump_diverged { " --dump-diverged" } else { "" });
        Saver::new((folder, lock), args.keep, options, self.checkpoint(), begin)
    }
}

/// The user's file of settings, if one was named.
///
/// # Errors
/// A file that cannot be read.
pub fn user_file(settings: &Settings) -> Result<Option<Source>> {
    let read = |path: &PathBuf| Ok(Source { path: path.clone(), text: run::read_text(path)? });
    settings.config.as_ref().map(read).transpose()
}

/// The single settings, with those that have options of their own.
pub fn overrides(args: &TrainArgs) -> Vec<Override> {
    let options = [
        ("run.seed", args.seed),
        ("run.threads", args.threads.map(|n| n as u64)),
        ("run.total_steps", args.total_steps),
    ];
    let given = options.into_iter().filter_map(|(key, value)| Some((key, value?)));
    let given = given.map(|(key, value)| Override { key: key.into(), value: value.to_string() });
    args.settings.set.iter().cloned().chain(given).collect()
}

/// Makes the run independent of the folder that it was begun in.
///
/// # Errors
/// A scene that is not there.
pub fn settle_model(config: &mut Config) -> Result<()> {
    if let Some(model) = config.env.model_file() {
        let model = model.canonicalize().with_context(|| format!("{MODEL}: cannot find {}", model.display()))?;
        config.env.model = model.display().to_string();
    }
    Ok(())
}

/// Makes sure that the settings in the folder are those of the checkpoint: whoever has edited them would be ignored.
fn expect_config(folder: &RunFolder, config: &Config) -> Result<()> {
    let Some((path, text)) = folder.config()? else { return Ok(()) };
    let advice =
        format!("put {} back as it was, or delete it; --fork begins a run with other settings", path.display());
    let found = Config::from_text(&path, &text, &[]).with_context(|| advice.clone())?;
    let differing = config.differences(&found);
    ensure!(
        differing.is_empty(),
        "{} says something else than the checkpoint: {}\n{advice}",
        path.display(),
        differing.join("; ")
    );
    Ok(())
}

/// The policy of a checkpoint or run, for a training with this configuration to begin with.
fn policy_to_begin_with(place: &Path, config: &Config) -> Result<Checkpoint> {
    let origin = Origin::of(place)?;
    // Which scene it was trained in does not matter.
    let any_scene = Override { key: MODEL.into(), value: BUILTIN_MODEL.into() };
    let (checkpoint, of_it) = origin.load(&[any_scene])?;
    let fitting = || {
        let net = config.ppo.net();
        checkpoint.expect_policy(&net, &SPACES)?;
        let (found, expected) = ((of_it.net.activation, of_it.net.symmetry), (net.activation, net.symmetry));
        ensure!(found == expected, "its activation and symmetry are {found:?}, those of this training {expected:?}");
        Ok(())
    };
    fitting().with_context(|| format!("cannot begin with the policy {origin}"))?;
    Ok(checkpoint)
}
