//! Forks: new runs in their own folder that start from the full state of another run's checkpoint, with changed settings.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};

use super::saver::{Begin, Saver};
use super::session::{SCENE, Session, overrides, settle_model};
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::{Config, user_file};
use crate::env::{SPACES, Task};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Checkpoint, Fork};
use crate::run::{self, RunFolder};

impl Session {
    /// Sets up a new run that starts from the newest undamaged checkpoint of another, or from the given one. Settings may
    /// change unless they determine the size of the state or the kind of policy; nets may become wider.
    ///
    /// # Errors
    /// Fails if the checkpoint cannot be resumed from, if the settings do not fit it, or if the folder cannot be created.
    pub(super) fn fork(place: &Path, args: &TrainArgs) -> Result<(Self, Saver)> {
        if matches!(Origin::of(place), Ok(Origin::BuiltIn(_))) {
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
        let session =
            Self::forked(&path, checkpoint, args).with_context(|| format!("cannot fork {}", path.display()))?;
        let (folder, lock) = RunFolder::create(args.run_dir.as_deref(), args.name.as_deref())?;
        let saver = session.saver(folder, lock, args, Begin::New);
        Ok((session, saver))
    }

    fn forked(path: &Path, mut checkpoint: Checkpoint, args: &TrainArgs) -> Result<Self> {
        let user = user_file(args.settings.config.as_deref())?;
        let (parent, mut config) = load::for_fork(&checkpoint, path, user.as_ref(), &overrides(args))?;
        expect_states(&checkpoint, &parent)?;
        expect_kept(&parent, &config)?;
        settle_model(&mut config)?;
        expect_scene(&parent, &config, &mut checkpoint)?;
        run::start_threads(config.run.threads)?;
        checkpoint.grow(&parent.ppo.net(), &config.ppo.net(), SPACES, config.run.seed)?;
        let from = path.canonicalize().unwrap_or_else(|_| path.to_owned()).display().to_string();
        let mut session = Self::new(config)?;
        let agent = &mut session.agent;
        agent.restore(&mut checkpoint)?;
        checkpoint.finish()?;
        agent.ppo.settle_learning_rate(&parent.ppo);
        // Scores under different settings are not comparable, so the best one is not kept.
        agent.fork = Some(Fork { from, iteration: agent.iteration, env_steps: agent.env_steps });
        ensure!(
            !session.finished(),
            "run.total_steps = {}: the checkpoint has made {} already; set the new total with --total-steps",
            session.config.run.total_steps,
            session.agent.env_steps
        );
        Ok(session)
    }
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
fn expect_scene(parent: &Config, config: &Config, checkpoint: &mut Checkpoint) -> Result<()> {
    let mut before = parent.env.clone();
    before.model.clone_from(&config.env.model);
    let same = checkpoint.take_counters(SCENE)? == [Task::new(&before)?.scene().fingerprint()?];
    ensure!(same, "{MODEL} = {}: not the scene of the checkpoint, which a fork keeps", config.env.model);
    Ok(())
}
