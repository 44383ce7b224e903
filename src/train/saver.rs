//! Saving a training to disk: checkpoints and the best policy, in its run folder or, if that is not possible, elsewhere.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Error, Result, anyhow};

use crate::load;
use crate::os::{self, Locked};
use crate::ppo::{Checkpoint, Evaluation, Fork, Progress};
use crate::run::{Report, RunFolder};
use crate::sim;

/// The state that a training begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Begin {
    /// The start of a new run, in a new folder.
    New,
    /// The newest checkpoint of its folder.
    FromNewest,
    /// An older checkpoint of its folder.
    FromOlder,
}

/// The saver of a training. It always holds the state at the end of the last complete iteration, which is what remains if the
/// next one does not complete; with several ranks, that at which they last handed over their states.
///
/// Nothing in the folder of a resumed run is changed before the first iteration is done: until then, anyone who named the wrong
/// run or checkpoint can stop.
pub(super) struct Saver {
    folder: RunFolder,
    lock: Option<Locked>,
    keep: usize,
    /// The options with which this training is resumed.
    options: String,
    end: Arc<Checkpoint>,
    begin: Begin,
    /// The state that this session began with.
    start: Arc<Checkpoint>,
    /// Whether this session has written into the folder.
    begun: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Saver {
    /// Creates the saver of a training that is at the state `end`. It keeps the newest `keep` checkpoints in the folder;
    /// `options` are the options for resuming.
    pub(super) fn new(
        (folder, lock): (RunFolder, Locked),
        keep: Option<usize>,
        options: String,
        end: Checkpoint,
        begin: Begin,
    ) -> Self {
        // The newest, and one more in case that is damaged.
        let keep = keep.unwrap_or_else(|| folder.checkpoints().count().max(2));
        let (lock, end) = (Some(lock), Arc::new(end));
        let (start, begun, best) = (end.clone(), false, None);
        let saver = Self { folder, lock, keep, options, end, begin, start, begun, best, best_is_saved: true };
        saver.save_before_fatal_errors();
        saver
    }

    /// Returns the run folder.
    pub(super) fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// Returns whether the training continues in an existing run folder.
    pub(super) fn resumes(&self) -> bool {
        self.begin != Begin::New
    }

    /// Returns whether this session has written into the folder.
    pub(super) fn has_begun(&self) -> bool {
        self.begun
    }

    /// Returns the progress of the training as text.
    pub(super) fn steps_made(&self) -> String {
        format!("{} iterations, {} env steps", self.end.progress.iteration, self.end.progress.env_steps)
    }

    /// Takes the state at the end of another iteration. If its best evaluation has changed, it is itself the best checkpoint.
    pub(super) fn take(&mut self, end: Checkpoint) {
        let is_best = end.progress.best != self.end.progress.best;
        self.end = Arc::new(end);
        if is_best {
            (self.best, self.best_is_saved) = (Some(self.end.clone()), false);
        }
        self.save_before_fatal_errors();
    }

    /// Writes into the folder for the first time, unless that is done: the checkpoint that the training starts from, as the
    /// newest; the logs, cut off after it; the settings. In this order, a run that is killed in between can be resumed.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub(super) fn begin(&mut self, report: &mut Report) -> Result<()> {
        if self.begun {
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
        if self.begin != Begin::FromNewest || self.folder.checkpoints().newest_first().is_empty() {
            write(&self.folder, None, &self.start, self.keep)?;
        }
        let Progress { iteration, env_steps, fork, .. } = &self.start.progress;
        report.open_logs(fork.as_ref().map_or(0, |fork| fork.iteration)..*iteration, *env_steps);
        self.describe()?;
        self.begun = true;
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
        let fork = self.end.progress.fork.as_ref().map_or(String::new(), |Fork { from, iteration, env_steps }| {
            format!("# Forked from {from:?} after {iteration} iterations, {env_steps} env steps.\n\n")
        });
        self.folder.describe(&format!("{fork}{}", self.end.config), &version())
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
        write(&self.folder, self.best.as_deref().filter(|_| unsaved), &self.end, self.keep)
    }

    /// Saves for the last time and ends the report. If the folder cannot be written to, the state is saved elsewhere. Before the
    /// first iteration of a resumed run there is nothing to save.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to; the message states where the state is instead.
    pub(super) fn save_at_last(&mut self, report: &mut Report) -> Result<()> {
        let saved = if self.begun { self.save(report) } else { Ok(()) };
        report.finish();
        saved.map_err(|error| self.elsewhere(error))
    }

    /// Saves the state elsewhere after it could not be saved in its folder for this `reason`; returns an error for both.
    pub(super) fn elsewhere(&self, reason: Error) -> Error {
        elsewhere(reason, self.best.as_deref(), &self.end, &self.options)
    }

    /// Returns the command that resumes this training.
    pub(super) fn how_to_resume(&self) -> String {
        how_to_resume(self.folder.path(), &self.options)
    }

    /// Arranges for the state at the end of the last iteration to be saved if MuJoCo is about to end the process.
    fn save_before_fatal_errors(&self) {
        let (end, folder, keep, begun) = (self.end.clone(), self.folder.clone(), self.keep, self.begun);
        let holds = self.lock.as_ref().map(Locked::watch);
        let best = self.best.clone().filter(|_| !self.best_is_saved);
        let options = self.options.clone();
        sim::before_fatal_error(move |said| {
            os::say(&format!("error: {said}"));
            let replaced = || anyhow!("{} has been replaced", folder.path().display());
            let held = holds.as_ref().is_some_and(|holds| holds()).then_some(()).ok_or_else(replaced);
            if !begun {
                return os::say("the run folder was not changed");
            }
            match held.and_then(|()| write(&folder, best.as_deref(), &end, keep)) {
                Ok(()) => {
                    let iteration = end.progress.iteration;
                    let command = how_to_resume(folder.path(), &options);
                    os::say(&format!("saved the state after {iteration} iterations; resume with\n  {command}"));
                }
                Err(error) => os::say(&format!("error: {:#}", elsewhere(error, best.as_deref(), &end, &options))),
            }
        });
    }
}

/// Returns the score (goals per episode, rotation error in rad) that an evaluation must beat in a resumed run: that of the best
/// checkpoint in the folder; if that is lost, of the policy that was made from it; if that is lost too, the one stored in the
/// resumed checkpoint.
pub(super) fn best_so_far(folder: &RunFolder, of_checkpoint: Option<Evaluation>) -> Option<Evaluation> {
    let score = |path: &Path| load::read(path).ok().and_then(|checkpoint| checkpoint.progress.best);
    score(&folder.checkpoints().best()).or_else(|| score(&folder.policy())).or(of_checkpoint)
}

/// Writes the best checkpoint, if there is one to write, and the checkpoint `end` into a run folder.
fn write(folder: &RunFolder, best: Option<&Checkpoint>, end: &Checkpoint, keep: usize) -> Result<()> {
    let checkpoints = folder.checkpoints();
    match best {
        Some(best) => {
            os::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
            checkpoints.write_best(&best.to_bytes()?)?;
        }
        None => keep_policy(folder, end)?,
    }
    checkpoints.write(end.progress.iteration, &end.to_bytes()?, keep)
}

/// Ensures that the policy file is that of the best checkpoint or, if nothing was scored yet, that of `end`.
fn keep_policy(folder: &RunFolder, end: &Checkpoint) -> Result<()> {
    let score = |checkpoint: &Checkpoint| checkpoint.progress.best;
    let shared = load::read(&folder.policy()).ok().as_ref().and_then(score);
    let policy = match load::read(&folder.checkpoints().best()) {
        Ok(best) if score(&best) == shared => return Ok(()),
        Ok(best) => best.policy_alone(),
        // The policy file is all that is left of the best checkpoint.
        Err(_) if shared.is_some() => return Ok(()),
        Err(_) => {
            let mut latest = end.policy_alone();
            // Any known score belongs to another policy.
            latest.progress.best = None;
            latest
        }
    };
    os::write_whole(&folder.policy(), &policy.to_bytes()?)
}

/// Saves the state elsewhere after it could not be saved in its folder for this `reason`; returns an error for both.
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
            "{reason:#}\nThe state after {} iterations is in {} instead; resume with\n  {}",
            end.progress.iteration,
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
