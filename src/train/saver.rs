//! What a training leaves on the disk: checkpoints and the best policy, in its run folder or, where that cannot be, elsewhere.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Error, Result, anyhow};

use crate::load;
use crate::ppo::{Checkpoint, Fork, Progress};
use crate::run::{self, Locked, Report, RunFolder};
use crate::{env, sim};

/// What a training begins with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Begin {
    /// A folder of its own.
    New,
    /// The newest checkpoint of its folder.
    FromNewest,
    /// An older one.
    FromOlder,
}

/// What saves. It always holds the end of the last whole iteration: that is what is left if the next one does not come to its own.
///
/// Nothing in the folder of a run that is resumed is changed before the first iteration is done: until then whoever has named the
/// wrong one, or the wrong checkpoint, can stop.
pub struct Saver {
    folder: RunFolder,
    lock: Option<Locked>,
    keep: usize,
    /// The options with which this training is resumed.
    options: String,
    end: Arc<Checkpoint>,
    begin: Begin,
    /// What it was taken up with.
    start: Arc<Checkpoint>,
    /// The folder is this training's to write into.
    begun: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Saver {
    /// Of a training at this `end`, in a folder in which it keeps so many checkpoints; it is resumed with these `options`.
    pub fn new(
        (folder, lock): (RunFolder, Locked),
        keep: Option<usize>,
        options: String,
        end: Checkpoint,
        begin: Begin,
    ) -> Self {
        // The newest, and one in case it is damaged.
        let keep = keep.unwrap_or_else(|| folder.checkpoints().count().max(2));
        let (lock, end) = (Some(lock), Arc::new(end));
        let (start, begun, best) = (end.clone(), false, None);
        let saver = Self { folder, lock, keep, options, end, begin, start, begun, best, best_is_saved: true };
        saver.save_before_fatal_errors();
        saver
    }

    /// The run folder.
    pub fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// Whether it goes on in the folder of a run.
    pub fn resumes(&self) -> bool {
        self.begin != Begin::New
    }

    /// Whether it has written into the folder.
    pub fn has_begun(&self) -> bool {
        self.begun
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

    /// Writes into the folder for the first time, if it was not done yet: the checkpoint that the training starts from, as the newest;
    /// logs that hold nothing after it; the settings. In this order, so that a run that is killed between them can be resumed.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub fn begin(&mut self, report: &mut Report) -> Result<()> {
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
            report.warn(&format!("{} is damaged; it is now {}", best.display(), aside.display()));
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

    /// Leaves the folder of a run that could not begin as it was; unless it is another training's by now.
    pub fn give_back(&self) {
        if self.lock.as_ref().is_some_and(Locked::holds) {
            self.folder.clear();
        }
    }

    /// Writes what says with what the folder was made.
    fn describe(&self) -> Result<()> {
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
        if !self.lock.as_ref().is_some_and(Locked::holds) {
            // The folder was deleted and is made anew; if not by another training.
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

    /// The same when there is no next time: where it cannot be, it is tried elsewhere. Ends the report. Before the first iteration
    /// of a run that is resumed there is nothing to save.
    ///
    /// # Errors
    /// A folder that cannot be written to; the message says where the state is instead.
    pub fn save_at_last(&mut self, report: &mut Report) -> Result<()> {
        let saved = if self.begun { self.save(report) } else { Ok(()) };
        report.finish();
        saved.map_err(|error| self.elsewhere(error))
    }

    /// Saves a state that could not be saved in its place for this reason elsewhere; what there is to say of both.
    pub fn elsewhere(&self, reason: Error) -> Error {
        elsewhere(reason, self.best.as_deref(), &self.end, &self.options)
    }

    /// The command that goes on with this training.
    pub fn how_to_resume(&self) -> String {
        how_to_resume(self.folder.path(), &self.options)
    }

    /// Has the end of the last iteration saved where MuJoCo ends the process by itself.
    fn save_before_fatal_errors(&self) {
        let (end, folder, keep, begun) = (self.end.clone(), self.folder.clone(), self.keep, self.begun);
        let holds = self.lock.as_ref().map(Locked::watch);
        let best = self.best.clone().filter(|_| !self.best_is_saved);
        let options = self.options.clone();
        sim::before_fatal_error(move |said| {
            let whose = env::stepping().map_or(String::new(), |number| format!("environment {number}: "));
            run::say(&format!("error: {whose}MuJoCo cannot go on: {said}"));
            let replaced = || anyhow!("{} has been replaced", folder.path().display());
            let held = holds.as_ref().is_some_and(|holds| holds()).then_some(()).ok_or_else(replaced);
            if !begun {
                return run::say("nothing was changed in the folder of the run");
            }
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

/// The score that an evaluation must beat in a folder that is resumed (goals per episode, rotation error in rad): that of its best
/// checkpoint; if that is lost, of the policy that was made from it; if that is lost too, the one that the checkpoint remembers.
pub fn best_so_far(folder: &RunFolder, of_checkpoint: Option<[f64; 2]>) -> Option<[f64; 2]> {
    let score = |path: &Path| load::read(path).ok().and_then(|checkpoint| checkpoint.progress.best);
    score(&folder.checkpoints().best()).or_else(|| score(&folder.policy())).or(of_checkpoint)
}

/// Writes the best, if there is one to be written, and the checkpoint into a run folder.
fn write(folder: &RunFolder, best: Option<&Checkpoint>, end: &Checkpoint, keep: usize) -> Result<()> {
    let checkpoints = folder.checkpoints();
    match best {
        Some(best) => {
            run::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
            checkpoints.write_best(&best.to_bytes()?)?;
        }
        None => keep_policy(folder, end)?,
    }
    checkpoints.write(end.progress.iteration, &end.to_bytes()?, keep)
}

/// Makes sure that the policy to share is that of the best checkpoint, or where nothing was scored yet, that of this one.
fn keep_policy(folder: &RunFolder, end: &Checkpoint) -> Result<()> {
    let score = |checkpoint: &Checkpoint| checkpoint.progress.best;
    let shared = load::read(&folder.policy()).ok().as_ref().and_then(score);
    let policy = match load::read(&folder.checkpoints().best()) {
        Ok(best) if score(&best) == shared => return Ok(()),
        Ok(best) => best.policy_alone(),
        // It is all that is left of the best one.
        Err(_) if shared.is_some() => return Ok(()),
        Err(_) => {
            let mut latest = end.policy_alone();
            // A score that is known is another policy's.
            latest.progress.best = None;
            latest
        }
    };
    run::write_whole(&folder.policy(), &policy.to_bytes()?)
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
    format!("shadow-repose train --resume {}{options}", run::quoted_path(run))
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
