//! What a training leaves on the disk and takes up again: checkpoints, the best policy, what diverged.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};

use super::{Session, is_better, version};
use crate::cli::TrainArgs;
use crate::config::{Config, Override};
use crate::dump;
use crate::env::EnvState;
use crate::load::{self, MODEL};
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

    /// The best policy of the folder may have been saved after the checkpoint that is resumed from; it is not given up for a
    /// worse one. If it is lost, the next one is the best.
    fn remember_best(&mut self) {
        let saved = run::read_bytes(&self.folder.checkpoints().best()).and_then(|bytes| Checkpoint::parse(&bytes));
        let saved = saved.ok().and_then(|checkpoint| checkpoint.progress.best);
        let known = self.progress.best.filter(|&known| saved.is_some_and(|saved| is_better(known, Some(saved))));
        self.progress.best = known.or(saved);
    }

    /// Writes logs, the best policy and the checkpoint, each before what speaks of it.
    pub(super) fn save(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        if !self.lock.holds() {
            // The folder was deleted and is made anew; if not by another training.
            self.folder.describe(&self.config.to_text(), &version())?;
            self.lock = self.folder.lock()?;
        }
        report.sync();
        self.folder.describe(&self.config.to_text(), &version())?;
        self.write_to(&self.folder, end)?;
        self.best_is_saved = true;
        Ok(())
    }

    pub(super) fn write_to(&self, folder: &RunFolder, end: &Checkpoint) -> Result<()> {
        let checkpoints = folder.checkpoints();
        let there = checkpoints.best().exists();
        match &self.best {
            Some(_) if self.best_is_saved && there => {}
            Some(best) => {
                run::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
                checkpoints.write_best(&best.to_bytes()?)?;
            }
            None if there => {}
            None => run::write_whole(&folder.policy(), &end.policy_alone().to_bytes()?)?,
        }
        checkpoints.write(end.progress.iteration, &end.to_bytes()?, self.keep)
    }

    /// The same when there is no next time: where it cannot be, it is tried elsewhere. Ends the report.
    pub(super) fn save_at_last(&mut self, end: &Checkpoint, report: &mut Report) -> Result<()> {
        let saved = self.save(end, report);
        report.finish();
        let Err(error) = saved else { return Ok(()) };
        match self.save_elsewhere(end) {
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

    fn save_elsewhere(&self, end: &Checkpoint) -> Result<RunFolder> {
        let run = RunFolder::for_now()?;
        match self.write_to(&run, end) {
            Ok(()) => Ok(run),
            Err(error) => {
                run.remove();
                Err(error)
            }
        }
    }

    /// The command that goes on with a run in this folder, as this training does.
    pub(super) fn how_to_resume(&self, run: &Path) -> String {
        let mut command = format!("shadow-repose train --resume {}", run::quoted(&run.display().to_string()));
        if let Some(model) = self.config.env.model_file() {
            command += &format!(" --set {}", run::quoted(&format!("{MODEL}={}", model.display())));
        }
        if self.keep != TrainArgs::KEEP {
            command += &format!(" --keep {}", self.keep);
        }
        if self.dump_diverged {
            command += " --dump-diverged";
        }
        command
    }

    /// Has `end` saved where MuJoCo ends the process by itself.
    pub(super) fn save_before_fatal_errors(&self, end: &Arc<Checkpoint>) {
        let (end, checkpoints, keep) = (end.clone(), self.folder.checkpoints(), self.keep);
        let how_to_resume = self.how_to_resume(self.folder.path());
        sim::before_fatal_error(move |said| {
            let whose = env::stepping().map_or(String::new(), |number| format!("environment {number}: "));
            run::say(&format!("error: {whose}MuJoCo cannot go on: {said}"));
            let iteration = end.progress.iteration;
            match end.to_bytes().and_then(|bytes| checkpoints.write(iteration, &bytes, keep)) {
                Ok(()) => {
                    run::say(&format!("saved the state after {iteration} iterations; go on with\n  {how_to_resume}"))
                }
                Err(error) => run::say(&format!("error: {error:#}")),
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
