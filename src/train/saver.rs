//! What a training leaves on the disk: checkpoints and the best policy, in its run folder or, where that cannot be, elsewhere.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Error, Result, anyhow};

use crate::load;
use crate::ppo::{Checkpoint, Fork};
use crate::run::{self, Locked, Report, RunFolder};
use crate::{env, sim};

/// What saves. It always holds the end of the last whole iteration: that is what is left if the next one does not come to its own.
pub struct Saver {
    folder: RunFolder,
    lock: Arc<Locked>,
    keep: usize,
    /// The options with which this training is resumed.
    options: String,
    end: Arc<Checkpoint>,
    /// The newest checkpoint of the folder is where this session begins.
    begins_saved: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Saver {
    /// Of a training at this `end`, which may be saved already, in a folder in which it keeps so many checkpoints; it is resumed with
    /// these `options`.
    pub fn new(
        (folder, lock): (RunFolder, Locked),
        keep: Option<usize>,
        options: String,
        end: Checkpoint,
        begins_saved: bool,
    ) -> Self {
        // The newest, and one in case it is damaged.
        let keep = keep.unwrap_or_else(|| folder.checkpoints().count().max(2));
        let (lock, end) = (Arc::new(lock), Arc::new(end));
        let saver = Self { folder, lock, keep, options, end, begins_saved, best: None, best_is_saved: true };
        saver.save_before_fatal_errors();
        saver
    }

    /// The run folder.
    pub fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// How far the training has come.
    pub fn steps_made(&self) -> String {
        format!("{} iterations, {} env steps", self.end.progress.iteration, self.end.progress.env_steps)
    }

    /// Takes the end of another iteration. If its best evaluation is another one than before, it is its own.
    pub fn take(&mut self, end: Checkpoint) {
        let is_best = end.progress.best != self.end.progress.best;
        self.end = Arc::new(end);
        if is_best {
            (self.best, self.best_is_saved) = (Some(self.end.clone()), false);
        }
        self.save_before_fatal_errors();
    }

    /// Writes what says with what the folder was made.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn describe(&self) -> Result<()> {
        let fork = self.end.progress.fork.as_ref().map_or(String::new(), |Fork { from, iteration, env_steps }| {
            format!("# Forked from {from:?} after {iteration} iterations, {env_steps} env steps.\n\n")
        });
        self.folder.describe(&format!("{fork}{}", self.end.config), &version())
    }

    /// Writes logs, the best policy and the checkpoint, each before what speaks of it.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn save(&mut self, report: &mut Report) -> Result<()> {
        if !self.lock.holds() {
            // The folder was deleted and is made anew; if not by another training.
            self.lock = Arc::new(self.folder.lock()?);
        }
        report.sync();
        self.describe()?;
        self.write()?;
        self.best_is_saved = true;
        Ok(())
    }

    /// Makes sure that the state at the beginning is in the folder: whatever happens then, it can be resumed, and nothing that is
    /// in the logs is newer.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn save_at_first(&self) -> Result<()> {
        if self.begins_saved { Ok(()) } else { self.write() }
    }

    fn write(&self) -> Result<()> {
        let unsaved = !self.best_is_saved || !self.folder.checkpoints().best().exists();
        write(&self.folder, self.best.as_deref().filter(|_| unsaved), &self.end, self.keep)
    }

    /// The same when there is no next time: where it cannot be, it is tried elsewhere. Ends the report.
    ///
    /// # Errors
    /// A folder that cannot be written to; the message says where the state is instead.
    pub fn save_at_last(&mut self, report: &mut Report) -> Result<()> {
        let saved = self.save(report);
        report.finish();
        saved.map_err(|error| elsewhere(error, self.best.as_deref(), &self.end, &self.options))
    }

    /// The command that goes on with this training.
    pub fn how_to_resume(&self) -> String {
        how_to_resume(self.folder.path(), &self.options)
    }

    /// Has the end of the last iteration saved where MuJoCo ends the process by itself.
    fn save_before_fatal_errors(&self) {
        let (end, folder, lock, keep) = (self.end.clone(), self.folder.clone(), self.lock.clone(), self.keep);
        let best = self.best.clone().filter(|_| !self.best_is_saved);
        let options = self.options.clone();
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
}

/// The evaluation that a checkpoint or a policy is the best of; none where the file is not there or damaged.
pub fn best_of(path: &Path) -> Option<[f64; 2]> {
    load::read(path).ok().and_then(|checkpoint| checkpoint.progress.best)
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

/// What a run folder says about the program that made it.
fn version() -> String {
    format!(
        "shadow-repose {}\ncommit {}\nmujoco {}\n{}\ntarget {}\n",
        env!("CARGO_PKG_VERSION"),
        env!("SHADOW_REPOSE_COMMIT"),
        sim::mujoco_version(),
        env!("SHADOW_REPOSE_RUSTC"),
        env!("SHADOW_REPOSE_TARGET"),
    )
}
