//! A training that leaves another one: with all that its checkpoint holds, in a folder of its own, under other settings.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};

use super::saver::{Begin, Saver};
use super::session::{SCENE, Session, overrides, settle_model, user_file};
use crate::agent::expect_states;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::env::{SPACES, Task};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Checkpoint, Fork};
use crate::run::{self, RunFolder};

impl Session {
    /// A new run that begins with the newest sound checkpoint of another, or with the one that is named. Settings may
    /// change unless they size its state or say what its policy is; nets may become wider.
    ///
    /// # Errors
    /// A checkpoint that cannot be gone on from; settings that it cannot take; a folder that cannot be made.
    pub fn fork(place: &Path, args: &TrainArgs) -> Result<(Self, Saver)> {
        if matches!(Origin::of(place), Ok(Origin::BuiltIn)) {
            bail!(
                "--fork builtin: a policy alone, without what a training goes on from; --init builtin begins with it"
            );
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
        let user = user_file(&args.settings)?;
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
        // Scores under other settings are not compared: the best is found anew.
        agent.fork = Some(Fork { from, iteration: agent.iteration, env_steps: agent.env_steps });
        ensure!(
            !session.finished(),
            "run.total_steps = {}: it has made {} already; --total-steps says how far the fork is to go",
            session.config.run.total_steps,
            session.agent.env_steps
        );
        Ok(session)
    }
}

/// Makes sure that the settings which size the state, or say what its policy is, are those of before.
fn expect_kept(parent: &Config, config: &Config) -> Result<()> {
    let of = |config: &Config| {
        let net = config.ppo.net();
        let kept = [format!("{}", config.env.num_envs), format!("{:?}", net.symmetry), format!("{:?}", net.activation)];
        kept.map(|value| value.to_lowercase())
    };
    let keys = ["env.num_envs", "ppo.symmetry", "ppo.activation"];
    for (key, (before, now)) in keys.into_iter().zip(of(parent).into_iter().zip(of(config))) {
        ensure!(before == now, "{key} = {now}: a fork keeps {before}, which its checkpoint was made with");
    }
    Ok(())
}

/// Makes sure that the scene is the one of the checkpoint, whatever its friction, masses and timestep are to be now.
fn expect_scene(parent: &Config, config: &Config, checkpoint: &mut Checkpoint) -> Result<()> {
    let mut before = parent.env.clone();
    before.model.clone_from(&config.env.model);
    let same = checkpoint.take_counters(SCENE)? == [Task::new(&before)?.scene().fingerprint()?];
    ensure!(same, "{MODEL} = {}: another scene than the one of the checkpoint, which a fork keeps", config.env.model);
    Ok(())
}
