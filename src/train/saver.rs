//! Saving a training to disk: checkpoints and the best policy, in its run folder or, if that is not possible, elsewhere.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Error, Result, anyhow};

use crate::load;
use crate::os::{self, Locked};
use crate::ppo::{Checkpoint, Evaluation, Fork, Progress};
use crate::run::{Report, RunFolder};
use crate::sim;

/// The saver of a training. It always holds the state at the end of the last complete iteration, which is what remains if the
/// next one does not complete; or the state that was last handed over.
///
/// Nothing in the folder of a resumed run is changed before the first iteration is done: until then, anyone who named the wrong
/// run or checkpoint can stop.
pub(super) struct Saver {
    folder: RunFolder,
    lock: Option<Locked>,
    keep: usize,
    /// The options with which this training is resumed.
    options: String,
    /// The state at the end of the last complete iteration.
    last: Arc<Checkpoint>,
    /// The state that this session started from.
    initial: Arc<Checkpoint>,
    /// Whether that is the newest checkpoint in the folder.
    from_newest: bool,
    /// Whether this session has written into the folder.
    wrote: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Saver {
    /// Creates the saver of a training at its `initial` state, which may be the newest checkpoint in the folder. It keeps the newest
    /// `keep` checkpoints there; `options` are the options for resuming.
    pub(super) fn new(
        (folder, lock): (RunFolder, Locked),
        keep: Option<usize>,
        options: String,
        initial: Checkpoint,
        from_newest: bool,
    ) -> Self {
        // The newest, and one more in case that is damaged.
        let keep = keep.unwrap_or_else(|| folder.checkpoints().count().max(2));
        let (lock, initial) = (Some(lock), Arc::new(initial));
        let (last, wrote, best, best_is_saved) = (initial.clone(), false, None, true);
        let saver = Self { folder, lock, keep, options, last, initial, from_newest, wrote, best, best_is_saved };
        saver.save_before_fatal_errors();
        saver
    }

    /// Returns the run folder.
    pub(super) fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// Returns whether this session has written into the folder.
    pub(super) fn wrote(&self) -> bool {
        self.wrote
    }

    /// Returns the progress of the training as text.
    pub(super) fn steps_made(&self) -> String {
        format!("{} iterations, {} env steps", self.last.progress.iteration, self.last.progress.env_steps)
    }

    /// Keeps the state at the end of another iteration, to save it. If its best evaluation has changed, it is itself the best checkpoint.
    pub(super) fn keep(&mut self, last: Checkpoint) {
        let is_best = last.progress.best != self.last.progress.best;
        self.last = Arc::new(last);
        if is_best {
            (self.best, self.best_is_saved) = (Some(self.last.clone()), false);
        }
        self.save_before_fatal_errors();
    }

    /// Writes into the folder for the first time, unless that is done: the checkpoint that the training starts from, as the
    /// newest; the logs, cut off after it; the settings. In this order, a run that is killed in between can be resumed.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub(super) fn open_folder(&mut self, report: &mut Report) -> Result<()> {
        if self.wrote {
            return Ok(());
        }
        let lock = match self.lock.take().filter(Locked::holds) {
            Some(lock) => lock,
            // The folder was deleted during the first iteration.
            None => self.folder.lock()?,
        };
        self.lock = Some(self.folder.claim(lock)?);
        let best = self.folder.checkpoints().best();
        if load::read(&best).is_err_and(|error| load::is_damage(&error)) {
            let aside = self.folder.checkpoints().put_best_aside()?;
            report.warn(&format!("{} is damaged; renamed to {}", best.display(), aside.display()));
        }
        if !self.from_newest || self.folder.checkpoints().newest_first().is_empty() {
            write(&self.folder, None, &self.initial, self.keep)?;
        }
        let Progress { iteration, env_steps, fork, .. } = &self.initial.progress;
        report.open_logs(fork.as_ref().map_or(0, |fork| fork.iteration)..*iteration, *env_steps);
        self.describe()?;
        self.wrote = true;
        self.save_before_fatal_errors();
        Ok(())
    }

    /// Clears the folder of a run that could not begin, unless it belongs to another training by now.
    pub(super) fn give_back(&self) {
        if self.lock.as_ref().is_some_and(Locked::holds) {
            self.folder.clear();
        }
    }

    /// Writes the configuration and the versions into the folder.
    fn describe(&self) -> Result<()> {
        let fork = self.last.progress.fork.as_ref().map_or(String::new(), |Fork { from, iteration, env_steps }| {
            format!("# Forked from {from:?} after {iteration} iterations, {env_steps} env steps.\n\n")
        });
        self.folder.describe(&format!("{fork}{}", self.last.config), &version())
    }

    /// Writes the logs, the best policy and the checkpoint, each before anything that refers to it.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub(super) fn save(&mut self, report: &mut Report) -> Result<()> {
        if !self.lock.as_ref().is_some_and(Locked::holds) {
            // The folder was deleted: create it again, unless another training has done so.
            self.lock = Some(self.folder.claim(self.folder.lock()?)?);
        }
        report.sync();
        self.describe()?;
        self.write()?;
        self.best_is_saved = true;
        Ok(())
    }

    fn write(&self) -> Result<()> {
        let unsaved = !self.best_is_saved || !self.folder.checkpoints().best().exists();
        write(&self.folder, self.best.as_deref().filter(|_| unsaved), &self.last, self.keep)
    }

    /// Saves for the last time and ends the report. If the folder cannot be written to, the state is saved elsewhere. Before the
    /// first iteration of a resumed run there is nothing to save.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to; the message states where the state is instead.
    pub(super) fn save_at_last(&mut self, report: &mut Report) -> Result<()> {
        let saved = if self.wrote { self.save(report) } else { Ok(()) };
        report.finish();
        saved.map_err(|error| self.elsewhere(error))
    }

    /// Saves the state elsewhere after it could not be saved in its folder for this `reason`; returns an error for both.
    pub(super) fn elsewhere(&self, reason: Error) -> Error {
        elsewhere(reason, self.best.as_deref(), &self.last, &self.options)
    }

    /// Returns the command that resumes this training.
    pub(super) fn how_to_resume(&self) -> String {
        how_to_resume(self.folder.path(), &self.options)
    }

    /// Arranges for the state at the end of the last iteration to be saved if MuJoCo is about to end the process.
    fn save_before_fatal_errors(&self) {
        let (last, folder, keep, wrote) = (self.last.clone(), self.folder.clone(), self.keep, self.wrote);
        let holds = self.lock.as_ref().map(Locked::watch);
        let best = self.best.clone().filter(|_| !self.best_is_saved);
        let options = self.options.clone();
        sim::before_fatal_error(move |said| {
            os::say(&format!("error: {said}"));
            let replaced = || anyhow!("{} has been replaced", folder.path().display());
            let held = holds.as_ref().is_some_and(|holds| holds()).then_some(()).ok_or_else(replaced);
            if !wrote {
                return os::say("the run folder was not changed");
            }
            match held.and_then(|()| write(&folder, best.as_deref(), &last, keep)) {
                Ok(()) => {
                    let iteration = last.progress.iteration;
                    let command = how_to_resume(folder.path(), &options);
                    os::say(&format!("saved the state after {iteration} iterations; resume with\n  {command}"));
                }
                Err(error) => os::say(&format!("error: {:#}", elsewhere(error, best.as_deref(), &last, &options))),
            }
        });
    }
}

/// Returns the score (goals per episode, rotation error in rad) that an evaluation must beat in a resumed run: that of the best
/// checkpoint in the folder; if that is lost, of the policy that was made from it; if that is lost too, the one stored in the
/// resumed checkpoint.
pub(super) fn best_so_far(folder: &RunFolder, resumed: Option<Evaluation>) -> Option<Evaluation> {
    let score = |path: &Path| load::read(path).ok().and_then(|checkpoint| checkpoint.progress.best);
    score(&folder.checkpoints().best()).or_else(|| score(&folder.policy())).or(resumed)
}

/// Writes the best checkpoint, if there is one to write, and the checkpoint `last` into a run folder.
fn write(folder: &RunFolder, best: Option<&Checkpoint>, last: &Checkpoint, keep: usize) -> Result<()> {
    let checkpoints = folder.checkpoints();
    match best {
        Some(best) => {
            os::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
            checkpoints.write_best(&best.to_bytes()?)?;
        }
        None => keep_policy(folder, last)?,
    }
    checkpoints.write(last.progress.iteration, &last.to_bytes()?, keep)
}

/// Ensures that the policy file is that of the best checkpoint or, if nothing was scored yet, that of `last`.
fn keep_policy(folder: &RunFolder, last: &Checkpoint) -> Result<()> {
    let score = |checkpoint: &Checkpoint| checkpoint.progress.best;
    let shared = load::read(&folder.policy()).ok().as_ref().and_then(score);
    let policy = match load::read(&folder.checkpoints().best()) {
        Ok(best) if score(&best) == shared => return Ok(()),
        Ok(best) => best.policy_alone(),
        // The policy file is all that is left of the best checkpoint.
        Err(_) if shared.is_some() => return Ok(()),
        Err(_) => {
            let mut latest = last.policy_alone();
            // Any known score belongs to another policy.
            latest.progress.best = None;
            latest
        }
    };
    os::write_whole(&folder.policy(), &policy.to_bytes()?)
}

/// Saves the state elsewhere after it could not be saved in its folder for this `reason`; returns an error for both.
fn elsewhere(reason: Error, best: Option<&Checkpoint>, last: &Checkpoint, options: &str) -> Error {
    let saved = RunFolder::for_now().and_then(|run| match write(&run, best, last, 1) {
        Ok(()) => Ok(run),
        Err(error) => {
            run.remove();
            Err(error)
        }
    });
    match saved {
        Ok(run) => anyhow!(
            "{reason:#}\nThe state after {} iterations is in {} instead; resume with\n  {}",
            last.progress.iteration,
            run.path().display(),
            how_to_resume(run.path(), options)
        ),
        Err(error) => anyhow!(
            "{reason:#}\nIt could not be saved elsewhere either: {error:#}\nSet TMPDIR=PATH to try another location; only the \
             previous checkpoint is left"
        ),
    }
}

/// Returns the command that resumes the run in this folder with the same options.
fn how_to_resume(run: &Path, options: &str) -> String {
    format!("{} train --resume {}{options}", os::called_as(), os::quoted_path(run))
}

/// Returns the versions of the program and its parts, as written into a run folder.
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
