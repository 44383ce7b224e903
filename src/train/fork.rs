//! Forks: new runs in their own folder that start from the full state of another run's checkpoint, with changed settings.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};

use super::plan::{Plan, Start, overrides, settle_model};
use super::session::SCENE;
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::{Config, user_file};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Checkpoint, Fork};
use crate::repose::{SPACES, Task};
use crate::run::RunFolder;

impl Plan {
    /// Plans a new run that starts from the newest undamaged checkpoint of another, or from the given one. Settings may
    /// change unless they determine the size of the state or the kind of policy; nets may become wider.
    ///
    /// # Errors
    /// Fails if the checkpoint cannot be resumed from, or if the settings do not fit it.
    pub(super) fn fork(place: &Path, args: &TrainArgs) -> Result<Self> {
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
        Self::forked(&path, checkpoint, args).with_context(|| format!("cannot fork {}", path.display()))
    }

    fn forked(path: &Path, mut checkpoint: Checkpoint, args: &TrainArgs) -> Result<Self> {
        let user = user_file(args.settings.config.as_deref())?;
        let (parent, mut config) = load::for_fork(&checkpoint, path, user.as_ref(), &overrides(args))?;
        expect_states(&checkpoint, &parent)?;
        expect_kept(&parent, &config)?;
        settle_model(&mut config)?;
        expect_scene(&parent, &config, &mut checkpoint)?;
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
        let start = Start::Fork(checkpoint, Box::new(parent));
        Ok(Self { start, context: format!("cannot fork {}", path.display()), ..Self::new(config, args) })
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
