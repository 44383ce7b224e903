//! What the first rank does besides computing: it reports and saves.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;

use super::log::{Ended, described, row, tags};
use super::outcome::{Outcome, Stop};
use super::saver::Saver;
use crate::agent::Agent;
use crate::config::{Config, EnvConfig, scene_option};
use crate::os::{self, Requests, Status, StatusLine, say};
use crate::ppo::{Checkpoint, Rise};
use crate::repose::{HEADLINE, Repose, Score, divergence, measure};
use crate::run::Report;

/// The factor by which, and the iterations for which, the KL divergence must lie beyond its target for a warning.
const FAR: f64 = 10.0;
const FAR_FOR: u32 = 20;

/// How many times as many episodes confirm a new best policy as an evaluation has.
pub const CONFIRMED_BY: usize = 4;

/// What the first rank does.
pub struct Lead {
    report: Report,
    /// What saves its state.
    pub saver: Saver,
    quiet: bool,
    /// The number of steps of this session in which the physics diverged.
    diverged: u64,
    /// Whether a warning about them, or about predictions that diverged, was printed.
    warned: bool,
    /// The iterations in a row after which the policy had moved far more than it should.
    far: u32,
}

impl Lead {
    /// Prepares the report of a run. A quiet one shows no progress.
    pub fn new(config: &Config, saver: Saver, quiet: bool) -> Self {
        let progress = &saver.held.last.progress;
        let tags = tags(config.randomization.happens());
        let line = StatusLine::new(progress.env_steps, config.run.total_steps, quiet);
        let mut report = Report::new(saver.held.folder.path(), &tags, line);
        report.descriptions = described(&tags);
        report.settings = config.to_text();
        report.hparams = config.dotted();
        Self {
            report,
            saver,
            quiet,
            diverged: 0,
            warned: false,
            far: 0,
        }
    }

    /// Writes into the folder of a new run for the first time.
    ///
    /// # Errors
    /// Fails if the folder cannot be written to. It is then cleared.
    pub fn open_folder(&mut self) -> Result<()> {
        self.saver
            .open_folder(&mut self.report)
            .inspect_err(|_| self.saver.give_back())
    }

    /// Warns of physics that diverge, once: the total follows at the end. Warns of updates that are too large.
    fn warn(&mut self, desired_kl: f64, outcome: &Outcome) {
        let steps = &outcome.steps;
        self.diverged += steps.diverged;
        let warning = divergence(steps.diverged, steps.unpredicted, steps.steps)
            .or_else(|| outcome.evaluation.divergence());
        if let Some(warning) = warning.filter(|_| !self.warned) {
            self.warned = true;
            self.report.progress.warn(&warning);
        }
        let is_far = desired_kl > 0.0 && outcome.iteration.update.losses.kl > FAR * desired_kl;
        self.far = if is_far {
            self.far.saturating_add(1)
        } else {
            0
        };
        if self.far == FAR_FOR {
            self.report.progress.warn(&format!(
                "policy/kl has been more than {FAR} times ppo.desired_kl = {desired_kl} for {FAR_FOR} iterations: updates are too \
                 large; lower ppo.learning_rate_range or ppo.learning_rate"
            ));
        }
    }

    /// Ends the run: saves for the last time, and says how it ended. `is_flat`: evaluations no longer rise. The exit code is the
    /// program's.
    ///
    /// # Errors
    /// Fails as the run has, or if the run folder cannot be written to.
    pub fn end(
        mut self,
        config: &Config,
        is_flat: bool,
        ended: Result<Option<Stop>>,
    ) -> Result<ExitCode> {
        if !matches!(ended, Ok(Some(_))) {
            self.report.end(ended.is_ok());
        }
        let saved = self.saver.save_at_last(&mut self.report);
        if self.warned && self.diverged > 0 {
            say!("warning: {} steps of this session diverged", self.diverged);
        }
        let held = &self.saver.held;
        let stop = ended.inspect_err(|_| match &saved {
            Ok(()) if held.wrote => say!("saved the state after {}", held.steps_made()),
            Ok(()) => say!("the run folder was not changed"),
            Err(error) => say!("error: {error:#}"),
        })?;
        saved?;
        match stop {
            None => self.finish(config, is_flat),
            Some(stop) => self.stop(stop),
        }
        Ok(os::exit_code(stop.map_or(0, |stop| stop.signal)))
    }

    fn finish(&mut self, config: &Config, is_flat: bool) {
        let held = &self.saver.held;
        held.folder.mark_finished(true);
        let why = if is_flat {
            "evaluations no longer rise"
        } else {
            "finished"
        };
        say!(
            "{why}: {}; {}",
            held.steps_made(),
            held.folder.place().display()
        );
        if let Some(rise) = &held.last.progress.rise {
            let episodes = CONFIRMED_BY * config.run.eval_episodes;
            os::say_line(&before_and_after(rise, episodes));
        }
        if !self.quiet {
            say_what_next(&held.folder.place(), &config.env);
        }
        self.saver.release();
    }

    fn stop(&mut self, stop: Stop) {
        let held = &self.saver.held;
        if !held.wrote {
            return os::say_line(
                "stopped before the first iteration: the run is unchanged; repeat the same command to continue",
            );
        }
        held.folder.mark_finished(stop.by_file);
        let reason = if stop.by_file {
            "stopped by the file `stop`"
        } else {
            "stopped"
        };
        say!("{reason} after {}; resume with", held.steps_made());
        say!("  {}", held.how_to_resume(&held.folder));
        self.saver.release();
    }

    /// Whether the user asks by a file to stop.
    pub fn is_stopped_by_file(&self) -> bool {
        self.saver.held.folder.take_stop()
    }

    /// Answers requests. Work that takes long calls this meanwhile.
    pub fn attend(&mut self, requests: &Requests) {
        if self.saver.held.wrote && requests.take_save() {
            self.save();
        }
    }

    /// Shows the score of an evaluation.
    pub fn evaluated(&self, env_steps: u64, score: &Score) {
        let found = HEADLINE.map(|column| {
            format!(
                "{} {}",
                measure(column).label(),
                measure(column).text(score[column])
            )
        });
        let episodes = score.episodes;
        self.report.progress.say(&format!(
            "{env_steps} steps: evaluation of {episodes} episodes: {}",
            found.join("; ")
        ));
    }

    /// Keeps the `state` after an iteration, reports the iteration, and saves if that is due.
    ///
    /// # Errors
    /// Fails if the run folder cannot be written to for the first time, or if another training run has taken it.
    pub fn report(
        &mut self,
        config: &Config,
        agent: &Agent<Repose>,
        outcome: &Outcome,
        state: Option<Checkpoint>,
    ) -> Result<()> {
        state.into_iter().for_each(|state| self.saver.keep(state));
        self.saver.expect_own()?;
        self.saver.open_folder(&mut self.report)?;
        for (name, text) in &outcome.dumps {
            let dumped = self.saver.held.folder.dump(name, text);
            dumped.unwrap_or_else(|error| self.report.progress.warn(&format!("{error:#}")));
        }
        self.warn(config.ppo.desired_kl.at(agent.env_steps), outcome);
        let ended = Ended::new(
            &outcome.ended,
            config.env.ctrl_dt,
            config.randomization.happens(),
        );
        let shown = ended.shown();
        let status = Status {
            env_steps: agent.env_steps,
            steps_per_s: outcome.iteration.steps_per_s(),
            goals: shown["goals"],
            drop_rate: shown["drop_rate"],
            evaluation: outcome.evaluation["goals"],
            assisted: outcome.iteration.lesson.assist > 0.0,
            shared: false,
        };
        self.report.best = self.saver.held.last.progress.best.unwrap_or_default()[0];
        self.report.iteration(
            agent.iteration,
            &row(outcome, &ended),
            &outcome.histograms,
            &status,
        );
        if outcome.decision.save {
            self.save();
        }
        Ok(())
    }

    fn save(&mut self) {
        if let Err(error) = self.saver.save(&mut self.report) {
            self.report.progress.warn(&format!(
                "{error:#}; saving will be tried again at the next checkpoint"
            ));
        }
    }
}

/// The first evaluation and the best one as a table.
fn before_and_after(rise: &Rise, episodes: usize) -> String {
    let mut table = format!(
        "  {:<20} {:>8} {:>8}",
        format!("{episodes} episodes"),
        "before",
        "best"
    );
    for (column, (before, best)) in HEADLINE
        .into_iter()
        .zip(rise.before.into_iter().zip(rise.best))
    {
        let measure = measure(column);
        table += &format!(
            "\n  {:<20} {:>8} {:>8}",
            measure.label(),
            measure.text(before),
            measure.text(best)
        );
    }
    table
}

/// Prints how to look at a run that has finished.
fn say_what_next(run: &Path, env: &EnvConfig) {
    let program = os::called_as();
    let word = os::quoted_path(run);
    say!(
        "  {program} play --ckpt {word}{}\n  {program} plot {word}\n  tensorboard --logdir {}",
        scene_option(env),
        os::quoted_path(os::folder_of(run))
    );
}
