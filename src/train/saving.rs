//! What a training leaves on the disk and takes up again: checkpoints, the best policy, what diverged.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Error, Result, anyhow, ensure};

use super::{Session, version};
use crate::config::{BUILTIN_MODEL, Config, Override, PpoConfig};
use crate::dump;
use crate::env::{ACTION_SIZE, EnvState, OBSERVATION_SIZE};
use crate::load::{self, MODEL, Origin};
use crate::ppo::{Array, Checkpoint, Progress};
use crate::run::{self, Report, RunFolder};
use crate::{env, sim};

// Where a checkpoint keeps the states of the environments, and the fingerprint of the scene that they live in.
const NUMBERS: &str = "envs.numbers";
const COUNTERS: &str = "envs.counters";
const SCENE: &str = "scene";

impl Session {
    /// The state at the end of an iteration, whole.
    pub(super) fn checkpoint(&self) -> Result<Checkpoint> {
        let mut checkpoint = self.ppo.checkpoint(&self.config.to_text(), self.progress)?;
        let EnvState { numbers, counters } = self.pool.save();
        let rows = self.pool.len();
        checkpoint.insert(NUMBERS, Array::F64(vec![rows, numbers.len() / rows], numbers));
        checkpoint.insert(COUNTERS, Array::U64(vec![rows, counters.len() / rows], counters));
        checkpoint.insert(SCENE, Array::U64(vec![1], vec![self.scene]));
        Ok(checkpoint)
    }

    /// Goes on from what [`Session::checkpoint`] has saved.
    pub(super) fn restore(&mut self, mut checkpoint: Checkpoint) -> Result<()> {
        self.progress = checkpoint.progress;
        self.ppo.restore(&mut checkpoint)?;
        let state =
            EnvState { numbers: checkpoint.take_doubles(NUMBERS)?, counters: checkpoint.take_counters(COUNTERS)? };
        self.pool.restore(&state, self.rollout.first_observations_mut())?;
        if checkpoint.take_counters(SCENE)? != [self.scene] {
            run::say("warning: the scene is not the one of the checkpoint: what follows is another training");
        }
        self.remember_best();
        checkpoint.finish()
    }

    /// The best is what is in the folder. It may have been saved after the checkpoint that is resumed from, and is not given up for
    /// a worse one; if it is lost, the next one is the best.
    fn remember_best(&mut self) {
        self.progress.best = best_of(&self.folder.checkpoints().best());
    }

    /// Writes logs, the best policy and the checkpoint, each before what speaks of it.
    pub(super) fn save(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        if !self.lock.holds() {
            // The folder was deleted and is made anew; if not by another training.
            self.lock = Arc::new(self.folder.lock()?);
        }
        report.sync();
        self.folder.describe(&self.config.to_text(), &version())?;
        self.write_to(&self.folder, end)?;
        self.best_is_saved = true;
        Ok(())
    }

    pub(super) fn write_to(&self, folder: &RunFolder, end: &Checkpoint) -> Result<()> {
        let unsaved = !self.best_is_saved || !folder.checkpoints().best().exists();
        write(folder, self.best.as_deref().filter(|_| unsaved), end, self.keep)
    }

    /// The same when there is no next time: where it cannot be, it is tried elsewhere. Ends the report.
    pub(super) fn save_at_last(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        let saved = self.save(end, report);
        report.finish();
        saved.map_err(|error| elsewhere(error, self.best.as_deref(), end, &self.resuming()))
    }

    pub(super) fn how_to_resume(&self, run: &Path) -> String {
        how_to_resume(run, &self.resuming())
    }

    /// The options with which this training is resumed.
    fn resuming(&self) -> String {
        let model = self.config.env.model_file().map(|model| run::quoted(&format!("{MODEL}={}", model.display())));
        let model = model.map_or(String::new(), |set| format!(" --set {set}"));
        format!("{model}{}", if self.dump_diverged { " --dump-diverged" } else { "" })
    }

    /// Has `end` saved where MuJoCo ends the process by itself.
    pub(super) fn save_before_fatal_errors(&self, end: &Arc<Checkpoint>) {
        let (end, folder, lock, keep) = (end.clone(), self.folder.clone(), self.lock.clone(), self.keep);
        let best = self.best.clone().filter(|_| !self.best_is_saved);
        let options = self.resuming();
        sim::before_fatal_error(move |said| {
            let whose = env::stepping().map_or(String::new(), |number| format!("environment {number}: "));
            run::say(&format!("error: {whose}MuJoCo cannot go on: {said}"));
            let held =
                if lock.holds() { Ok(()) } else { Err(anyhow!("{} has been replaced", folder.path().display())) };
            match held.and_then(|()| write(&folder, best.as_deref(), &end, keep)) {
                Ok(()) => {
                    let iteration = end.progress.iteration;
                    let command = how_to_resume(folder.path(), &options);
                    run::say(&format!("saved the state after {iteration} iterations; go on with\n  {command}"));
                }
                Err(error) => run::say(&format!("error: {:#}", elsewhere(error, best.as_deref(), &end, &options))),
            }
        });
    }

    /// Writes what led to each episode that diverged.
    pub(super) fn dump_diverged(&mut self, report: &Report) {
        let iteration = self.progress.iteration;
        for (env, repose) in self.pool.envs_mut().enumerate() {
            let Some(diverged) = repose.take_diverged() else { continue };
            let text = dump::of(&diverged, &self.config.env, iteration, env);
            if let Err(error) = self.folder.dump(&format!("iteration-{iteration:08}-env-{env}.json"), &text) {
                report.warn(&format!("{error:#}"));
            }
        }
    }
}

/// Writes the best, if there is one to be written, and the checkpoint into a run folder. As long as nothing was scored, the
/// policy to share is that of the checkpoint.
fn write(folder: &RunFolder, best: Option<&Checkpoint>, end: &Checkpoint, keep: usize) -> Result<()> {
    let checkpoints = folder.checkpoints();
    if let Some(best) = best {
        run::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
        checkpoints.write_best(&best.to_bytes()?)?;
    } else if best_of(&folder.policy()).is_none() {
        run::write_whole(&folder.policy(), &end.policy_alone().to_bytes()?)?;
    }
    checkpoints.write(end.progress.iteration, &end.to_bytes()?, keep)
}

/// Saves a state that could not be saved in its place for this reason elsewhere; what there is to say of both.
fn elsewhere(reason: Error, best: Option<&Checkpoint>, end: &Checkpoint, options: &str) -> Error {
    let saved = RunFolder::for_now().and_then(|run| match write(&run, best, end, 1) {
        Ok(()) => Ok(run),
        Err(error) => {
            run.remove();
            Err(error)
        }
    });
    match saved {
        Ok(run) => anyhow!(
            "{reason:#}\nThe state after {} iterations is in {} instead; go on with\n  {}",
            end.progress.iteration,
            run.path().display(),
            how_to_resume(run.path(), options)
        ),
        Err(error) => anyhow!(
            "{reason:#}\nNor could it be saved elsewhere: {error:#}\nTMPDIR=PATH names a place to try; what there is now is the last \
             checkpoint before"
        ),
    }
}

/// The command that goes on with a run in this folder, as this training does.
fn how_to_resume(run: &Path, options: &str) -> String {
    format!("shadow-repose train --resume {}{options}", run::quoted(&run.display().to_string()))
}

/// The evaluation that a checkpoint or a policy is the best of; none where the file is not there or damaged.
fn best_of(path: &Path) -> Option<[f64; 2]> {
    let checkpoint = run::read_bytes(path).and_then(|bytes| Checkpoint::parse(&bytes));
    checkpoint.ok().and_then(|checkpoint| checkpoint.progress.best)
}

/// Makes sure that a checkpoint holds the states of as many environments as its configuration says, and of as many steps:
/// before anything is allocated by what the configuration says.
pub(super) fn expect_states(checkpoint: &Checkpoint, config: &Config) -> Result<()> {
    let Progress { iteration, env_steps, .. } = checkpoint.progress;
    let steps = iteration.checked_mul(config.steps_per_iteration());
    ensure!(steps == Some(env_steps), "{iteration} iterations cannot have made {env_steps} steps");
    let expected = config.env.num_envs;
    for name in [NUMBERS, COUNTERS] {
        let shape =
            checkpoint.shape(name).context("it holds a policy alone, which can be played but not trained on")?;
        let rows = shape.first().copied().unwrap_or(0);
        ensure!(rows == expected, "it holds the states of {rows} environments, expected {expected}");
    }
    Ok(())
}

/// The first of these files that can be used, with a warning for each one before it.
pub(super) fn first_sound(places: &[PathBuf], overrides: &[Override]) -> Result<(PathBuf, Checkpoint, Config)> {
    let (last, others) = places.split_last().context("there is no checkpoint")?;
    for path in others {
        match load::load(path, overrides) {
            Ok((checkpoint, config)) => return Ok((path.clone(), checkpoint, config)),
            Err(error) => run::say(&format!("warning: {error:#}\n  The one before is tried.")),
        }
    }
    let (checkpoint, config) = load::load(last, overrides)?;
    Ok((last.clone(), checkpoint, config))
}

/// The policy of a checkpoint or run, for a training with this configuration to begin with.
///
/// # Errors
/// A file that cannot be used, or a policy that the configuration does not describe.
pub(super) fn policy_to_begin_with(place: &Path, config: &Config) -> Result<Checkpoint> {
    let origin = Origin::of(place)?;
    // Which scene it was trained in does not matter.
    let any_scene = Override { key: MODEL.into(), value: BUILTIN_MODEL.into() };
    let (checkpoint, of_it) = origin.load(&[any_scene])?;
    let fitting = || {
        checkpoint.expect_policy(&config.ppo, OBSERVATION_SIZE, ACTION_SIZE)?;
        let describe = |ppo: &PpoConfig| (ppo.activation, ppo.symmetry);
        let (found, expected) = (describe(&of_it.ppo), describe(&config.ppo));
        ensure!(found == expected, "its activation and symmetry are {found:?}, those of this training {expected:?}");
        Ok(())
    };
    fitting().with_context(|| format!("cannot begin with the policy {origin}"))?;
    Ok(checkpoint)
}
