//! Saving a training run to disk: checkpoints and the best policy, in its run folder or, if that is not possible, elsewhere.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Error, Result, anyhow};

use crate::cli::TrainArgs;
use crate::config::{Config, scene_option};
use crate::load;
use crate::os::{self, Cannot, Locked, say, shown};
use crate::ppo::{Checkpoint, Fork, Progress};
use crate::run::{Report, RunFolder};
use crate::sim;

/// The saver of a training run. It always holds the state at the end of the last complete iteration, or the state that was last
/// handed over. This state remains if the next iteration does not complete.
///
/// Nothing in the folder of a resumed run is changed before the first iteration is done. Until then, a user who named the wrong
/// run or checkpoint can stop.
pub struct Saver {
    /// What is to be saved, and where.
    pub held: Held,
    lock: Option<Locked>,
    /// Where the folder lies, as the user was last told.
    told: String,
    /// The state that this session started from.
    initial: Arc<Checkpoint>,
}

/// What is to be saved, and where.
#[derive(Clone)]
pub struct Held {
    /// The run folder.
    pub folder: RunFolder,
    keep: usize,
    /// The settings of the run, as at its beginning (TOML).
    settings: String,
    /// The options with which this training run is resumed.
    options: String,
    /// The state that is saved: at the end of the last complete iteration.
    pub last: Arc<Checkpoint>,
    /// Whether this session has written into the folder.
    pub wrote: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Saver {
    /// Creates the saver of a training run with these options and settings at its `initial` state.
    pub fn new(
        (folder, lock): (RunFolder, Locked),
        args: &TrainArgs,
        config: &Config,
        initial: Checkpoint,
    ) -> Self {
        let keep = args.keep.map(|keep| format!(" --keep {keep}"));
        let options = format!(
            "{}{}{}",
            scene_option(&config.env),
            keep.unwrap_or_default(),
            if args.dump_diverged {
                " --dump-diverged"
            } else {
                ""
            }
        );
        // The newest, and one more in case that is damaged.
        let keep = args
            .keep
            .unwrap_or_else(|| folder.checkpoints.count().max(2));
        let initial = Arc::new(initial);
        let last = initial.clone();
        let settings = config.to_text();
        let held = Held {
            folder,
            keep,
            settings,
            options,
            last,
            wrote: false,
            best: None,
            best_is_saved: true,
        };
        let saver = Self {
            told: held.folder.whereabouts(),
            held,
            lock: Some(lock),
            initial,
        };
        saver.save_before_fatal_errors();
        saver
    }

    /// Keeps the state at the end of another iteration, to save it. If its best evaluation has changed, it is itself the best checkpoint.
    pub fn keep(&mut self, last: Checkpoint) {
        let is_best = last.progress.best != self.held.last.progress.best;
        self.held.last = Arc::new(last);
        if is_best {
            self.held.best = Some(self.held.last.clone());
            self.held.best_is_saved = false;
        }
        self.save_before_fatal_errors();
    }

    /// Writes into the folder for the first time, unless that is done. If that fails, there is nothing to save but the state that the
    /// training run starts from, which leaves a resumed run as it was.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn open_folder(&mut self, report: &mut Report) -> Result<()> {
        if self.held.wrote {
            return Ok(());
        }
        let begun = self.begin(report);
        if begun.is_err() {
            self.held.last = self.initial.clone();
            self.held.best = None;
            self.held.best_is_saved = true;
        }
        self.save_before_fatal_errors();
        begun
    }

    /// Writes what a run begins with. The order is the checkpoint that the training run starts from (as the newest), the settings,
    /// and the logs (cut off after it). So a run that is killed in between can be resumed, and no row is cut off where nothing can be
    /// written.
    fn begin(&mut self, report: &mut Report) -> Result<()> {
        self.own_folder(report)?;
        let lock = self.lock.take().map(|lock| self.held.folder.claim(lock));
        self.lock = lock.transpose()?;
        let best = self.held.folder.checkpoints.best();
        if load::read(&best).is_err_and(|error| load::is_damage(&error)) {
            let aside = os::put_aside(&best, "damaged").cannot("rename", &best)?;
            report.progress.warn(&format!(
                "{} is damaged; renamed to {}",
                shown(&best).display(),
                shown(&aside).display()
            ));
        }
        write(&self.held.folder, None, &self.initial, self.held.keep)?;
        self.describe()?;
        let Progress {
            iteration,
            env_steps,
            fork,
            ..
        } = &self.initial.progress;
        report.open_logs(
            fork.as_ref().map_or(0, |fork| fork.iteration)..*iteration,
            *env_steps,
        );
        self.held.folder.mark_finished(false);
        self.held.wrote = true;
        Ok(())
    }

    /// Checks that no other training run has taken the folder where there are no locks.
    ///
    /// # Errors
    /// Fails as [`Locked::expect_own`] does.
    pub fn expect_own(&self) -> Result<()> {
        self.lock.as_ref().map_or(Ok(()), Locked::expect_own)
    }

    /// Ensures that the folder is still the one that was opened, and locked. One that was deleted is created again. Says so if it was
    /// moved.
    ///
    /// # Errors
    /// Fails if another training run uses it, or if something else lies where it was deleted.
    fn own_folder(&mut self, report: &mut Report) -> Result<()> {
        self.expect_own()?;
        let folder = &mut self.held.folder;
        if !self.lock.as_ref().is_some_and(Locked::holds) {
            let lock = folder.lock()?;
            self.lock = Some(folder.claim(lock)?);
        }
        folder.checkpoints.hold()?;
        report.folder = folder.path().to_owned();
        let place = folder.whereabouts();
        if self.told != place {
            report
                .progress
                .say(&format!("note: the run folder was moved: {place}"));
            self.told = place;
        }
        Ok(())
    }

    /// Releases the folder after a training run that has ended normally. After any other end, the name stays in the lock file.
    pub fn release(&mut self) {
        self.lock.take().into_iter().for_each(Locked::release);
    }

    /// Clears the folder of a run that could not begin, unless it belongs to another training run by now.
    pub fn give_back(&self) {
        if self.lock.as_ref().is_some_and(Locked::holds) {
            self.held.folder.clear();
        }
    }

    /// Writes the configuration and the versions into the folder.
    fn describe(&self) -> Result<()> {
        let fork = self.held.last.progress.fork.as_ref().map_or(
            String::new(),
            |Fork {
                 from,
                 iteration,
                 env_steps,
             }| {
                format!(
                    "# Forked from {from:?} after {iteration} iterations, {env_steps} steps.\n\n"
                )
            },
        );
        self.held
            .folder
            .describe(&format!("{fork}{}", self.held.settings), &version())
    }

    /// Writes the logs, the best policy and the checkpoint, each before anything that refers to it.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to.
    pub fn save(&mut self, report: &mut Report) -> Result<()> {
        self.own_folder(report)?;
        report.sync();
        self.describe()?;
        self.held.write(&self.held.folder)?;
        self.held.best_is_saved = true;
        self.held.wrote = true;
        Ok(())
    }

    /// Saves for the last time and ends the report. If the folder cannot be written to, the state is saved elsewhere. Before the
    /// first iteration of a resumed run there is nothing to save.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to. The message states where the state is instead.
    pub fn save_at_last(&mut self, report: &mut Report) -> Result<()> {
        let iteration = |state: &Checkpoint| state.progress.iteration;
        let is_new = self.held.wrote || iteration(&self.held.last) > iteration(&self.initial);
        let saved = if is_new { self.save(report) } else { Ok(()) };
        report.finish();
        saved.map_err(|error| self.held.elsewhere(error))
    }

    /// Arranges for the state at the end of the last iteration to be saved if MuJoCo is about to end the process.
    fn save_before_fatal_errors(&self) {
        let held = self.held.clone();
        let holds = self.lock.as_ref().map(Locked::watch);
        sim::before_fatal_error(move |said| {
            say!("error: {said}");
            if !held.wrote {
                return say!("the run folder was not changed");
            }
            let replaced = || anyhow!("{} has been replaced", held.folder.place().display());
            let ours = holds
                .is_some_and(|holds| holds())
                .then_some(())
                .ok_or_else(replaced);
            match ours.and_then(|()| held.write(&held.folder)) {
                Ok(()) => {
                    let iteration = held.last.progress.iteration;
                    let command = held.how_to_resume(&held.folder);
                    say!("saved the state after {iteration} iterations; resume with\n  {command}");
                }
                Err(error) => say!("error: {:#}", held.elsewhere(error)),
            }
        });
    }
}

impl Held {
    /// The progress of the training run as text.
    pub fn steps_made(&self) -> String {
        format!(
            "{} iterations, {} steps",
            self.last.progress.iteration, self.last.progress.env_steps
        )
    }

    /// Writes the best policy, unless that is done, and the checkpoint into a run folder, in which the newest `keep` are kept.
    fn write(&self, folder: &RunFolder) -> Result<()> {
        let unsaved = !self.best_is_saved || !folder.checkpoints.best().exists();
        write(
            folder,
            self.best.as_deref().filter(|_| unsaved),
            &self.last,
            self.keep,
        )
    }

    /// Saves the state elsewhere after it could not be saved in its folder for this `reason`. Returns an error for both.
    pub fn elsewhere(&self, reason: Error) -> Error {
        let saved = RunFolder::for_now().and_then(|run| match self.write(&run) {
            Ok(()) => Ok(run),
            Err(error) => {
                run.remove();
                Err(error)
            }
        });
        match saved {
            Ok(run) => anyhow!(
                "{reason:#}\nThe state after {} iterations is in {} instead; resume with\n  {}",
                self.last.progress.iteration,
                run.place().display(),
                self.how_to_resume(&run)
            ),
            Err(error) => anyhow!(
                "{reason:#}\nIt could not be saved elsewhere either: {error:#}\nSet TMPDIR=PATH to try another location; only the \
                 previous checkpoint is left"
            ),
        }
    }

    /// The command that resumes the run in this folder with the same options.
    pub fn how_to_resume(&self, run: &RunFolder) -> String {
        format!(
            "{} train --resume {}{}",
            os::called_as(),
            os::quoted_path(&run.place()),
            self.options
        )
    }
}

/// The score (goals per episode, rotation error in rad) that an evaluation must beat in a resumed run. It is the score
/// of the best checkpoint in the folder. If that is lost, the score of the policy that was made from it counts, else the score
/// in the resumed checkpoint.
pub fn best_so_far(folder: &RunFolder, resumed: Option<[f64; 2]>) -> Option<[f64; 2]> {
    let score = |path: &Path| {
        load::read(path)
            .ok()
            .and_then(|checkpoint| checkpoint.progress.best)
    };
    score(&folder.checkpoints.best())
        .or_else(|| score(&folder.policy()))
        .or(resumed)
}

/// Writes the best checkpoint, if there is one to write, and the checkpoint `last` into a run folder.
fn write(
    folder: &RunFolder,
    best: Option<&Checkpoint>,
    last: &Checkpoint,
    keep: usize,
) -> Result<()> {
    let checkpoints = &folder.checkpoints;
    match best {
        Some(best) => {
            os::write_whole(&folder.policy(), &best.policy_alone().to_bytes()?)?;
            os::write_whole(&checkpoints.best(), &best.to_bytes()?)?;
        }
        None => keep_policy(folder, last)?,
    }
    checkpoints.write(last.progress.iteration, &last.to_bytes()?, keep)
}

/// Ensures that the policy file belongs to the best checkpoint or, if nothing was scored yet, to `last`.
fn keep_policy(folder: &RunFolder, last: &Checkpoint) -> Result<()> {
    let score = |checkpoint: &Checkpoint| checkpoint.progress.best;
    let shared = load::read(&folder.policy()).ok().as_ref().and_then(score);
    let policy = match load::read(&folder.checkpoints.best()) {
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

/// The versions of the program and its parts, as written into a run folder.
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
