//! What a training leaves on the disk and takes up again: checkpoints, the best policy, what diverged.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};

use super::{Session, is_better, version};
use crate::config::{Config, Override};
use crate::dump;
use crate::env::EnvState;
use crate::load::{self, MODEL};
use crate::ppo::{Array, Checkpoint, Progress};
use crate::run::{self, Report, RunFolder};

// Where a checkpoint keeps the states of the environments, and the fingerprint of the scene that they live in.
const NUMBERS: &str = "envs.numbers";
const COUNTERS: &str = "envs.counters";
const SCENE: &str = "scene";

impl Session {
    /// The state at the end of an iteration, whole.
    pub(super) fn checkpoint(&mut self) -> Result<Checkpoint> {
        let mut checkpoint = self.ppo.checkpoint(&self.config.to_text(), self.progress)?;
        let EnvState { numbers, counters } = self.pool.save();
        let rows = self.pool.len();
        checkpoint.insert(NUMBERS, Array::F64(vec![rows, numbers.len() / rows], numbers));
        checkpoint.insert(COUNTERS, Array::U64(vec![rows, counters.len() / rows], counters));
        checkpoint.insert(SCENE, Array::U64(vec![1], vec![self.scene]));
        if std::mem::take(&mut self.found_best) {
            self.best = Some(checkpoint.clone());
        }
        Ok(checkpoint)
    }

    /// Goes on from what [`Session::checkpoint`] has saved.
    pub(super) fn restore(&mut self, mut checkpoint: Checkpoint) -> Result<()> {
        self.progress = checkpoint.progress;
        let Progress { iteration, env_steps, .. } = self.progress;
        let steps = iteration.checked_mul(self.config.steps_per_iteration());
        ensure!(steps == Some(env_steps), "{iteration} iterations cannot have made {env_steps} steps");
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

    /// The best policy of the folder may have been saved after the checkpoint that is resumed from; it is not given up for a
    /// worse one. If it is lost, the next one is the best.
    fn remember_best(&mut self) {
        let saved = run::read_bytes(&self.folder.checkpoints().best()).and_then(|bytes| Checkpoint::parse(&bytes));
        let saved = saved.ok().and_then(|checkpoint| checkpoint.progress.best);
        self.progress.best = self.progress.best.and_then(|known| match saved {
            Some(saved) if !is_better(known, Some(saved)) => Some(saved),
            other => other.map(|_| known),
        });
    }

    /// Writes logs, the best policy and the checkpoint, each before what speaks of it.
    pub(super) fn save(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        report.sync();
        self.folder.describe(&self.config.to_text(), &version())?;
        if !self.folder.has_lock() {
            // The folder was deleted and is made anew.
            self.lock = self.folder.lock()?;
        }
        self.write_to(&self.folder, end)?;
        self.best = None;
        Ok(())
    }

    fn write_to(&self, folder: &RunFolder, end: &Checkpoint) -> Result<()> {
        let checkpoints = folder.checkpoints();
        if let Some(best) = &self.best {
            run::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
            checkpoints.write_best(&best.to_bytes()?)?;
        } else if self.progress.best.is_none() {
            run::write_whole(&folder.policy(), &end.policy_alone().to_bytes()?)?;
        }
        checkpoints.write(end.progress.iteration, &end.to_bytes()?, self.keep)
    }

    /// The same when there is no next time: where it cannot be, it is tried elsewhere. Ends the report.
    pub(super) fn save_at_last(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        let saved = self.save(end, report);
        report.finish();
        let Err(error) = saved else { return Ok(()) };
        let elsewhere = RunFolder::for_now();
        match elsewhere.and_then(|run| self.write_to(&run, end).map(|()| run)) {
            Ok(run) => bail!(
                "{error:#}\nThe state after {} is in {} instead; go on with\n  {}",
                self.steps_made(),
                run.path().display(),
                self.how_to_resume(run.path())
            ),
            Err(other) => bail!(
                "{error:#}\nNor could it be saved elsewhere: {other:#}\nTMPDIR=PATH names a place to try; go on from the last \
                 checkpoint with\n  {}",
                self.how_to_resume(self.folder.path())
            ),
        }
    }

    pub(super) fn how_to_resume(&self, run: &Path) -> String {
        let model = self.config.env.model_file();
        let model = model.map_or(String::new(), |model| format!(" --set {MODEL}={}", model.display()));
        format!("shadow-repose train --resume {}{model}", run.display())
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
