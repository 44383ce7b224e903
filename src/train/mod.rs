//! The training loop: collect, learn, evaluate, report, save.

mod films;
mod fork;
mod hints;
mod log;
mod plan;
mod saver;
mod session;
mod together;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Error, Result};

use crate::agent::Iteration;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::evaluate::{Actor, Episodes, evaluate_together};
use crate::os::{self, Requests, Status, StatusLine};
use crate::ppo::Evaluation;
use crate::ranks::{self, Ranks, Traffic};
use crate::repose::{EpisodeStats, Lesson, Recent, Repose, Score, divergence};
use crate::run::{Figures, Report};
use hints::hints;
use log::{Ended, FILM, described, histograms, row, tags};
use saver::Saver;
use session::Session;
use together::{Next, follow, panicked};

/// The time that the first rank has to save what it can and to tell of an error before another one does, and ends it.
const PATIENCE: Duration = Duration::from_secs(5);

/// Trains until all steps are made or a stop is requested, and returns the exit code of the program. If a launcher has started
/// several processes, they train together.
///
/// # Errors
/// Fails if settings, files or the scene cannot be used, if the run folder cannot be written to at the start or at the end, if a
/// loss is not finite, or after a panic. One of several ranks ends all others then, and does not return.
pub fn train(args: &TrainArgs, requests: &Requests) -> Result<ExitCode> {
    let membership = match ranks::join() {
        // All meet the same error; one of them tells.
        Err(_) if ranks::launched().is_some_and(|launched| launched.rank > 0) => return Ok(ExitCode::FAILURE),
        joined => joined?,
    };
    let ranks = &membership.ranks;
    if ranks.size() == 1 {
        return lead(args, requests, ranks);
    }
    if ranks.rank() > 0 {
        os::speak_as(&format!("rank {}", ranks.rank()));
    }
    let work = || if ranks.rank() == 0 { lead(args, requests, ranks) } else { follow(requests, ranks) };
    // To leave the ranks means to wait for the others, who may be waiting for this one.
    let result = catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| Err(panicked(&*panic)));
    result.or_else(|error| {
        if ranks.rank() > 0 {
            // What all ranks meet at once, such as a loss that is not finite, is told by the first.
            std::thread::sleep(PATIENCE);
        }
        os::say(&format!("error: {error:#}"));
        ranks.abort()
    })
}

/// Trains as the rank that reports and saves.
fn lead(args: &TrainArgs, requests: &Requests, ranks: &Arc<dyn Ranks>) -> Result<ExitCode> {
    let (mut session, mut saver) = Session::lead(args, ranks)?;
    let place = saver.folder().path().display().to_string();
    if session.finished() {
        os::say(&format!("{place} is finished: {}; a larger --total-steps continues it", saver.steps_made()));
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(limit) = args.stop_after {
        requests.stop_after(limit)?;
    }
    requests.wait_for_end();
    os::say(&format!("run folder: {place}"));
    if !args.quiet {
        say_hints(&session)?;
    }
    let mut report = new_report(&session, &saver, args.quiet);
    if !saver.resumes()
        && let Err(error) = saver.begin(&mut report)
    {
        saver.give_back();
        return Err(error);
    }
    let code = run_to_end(&mut session, saver, &mut report, requests)?;
    if session.finished() && !args.quiet {
        say_what_next(Path::new(&place));
    }
    Ok(code)
}

/// Iterates until all steps are made or a stop is requested, and returns the exit code.
fn run_to_end(session: &mut Session, mut saver: Saver, report: &mut Report, requests: &Requests) -> Result<ExitCode> {
    while !session.finished() {
        let (made, next) = match session.iterate_and_agree(requests, &saver, report) {
            Ok(Some(result)) => result,
            Ok(None) => {
                session.count_divergence();
                return stop(saver, report, requests.exit_code(), "stopped");
            }
            Err(error) => {
                session.count_divergence();
                return Err(give_up(error, saver, report));
            }
        };
        if session.hands_over(&next) {
            saver.take(session.checkpoint());
        }
        if let Err(error) = saver.begin(report) {
            report.finish();
            return Err(saver.elsewhere(error));
        }
        session.write_dumps(saver.folder(), report);
        session.report(report, &made);
        if session.finished() {
            break;
        }
        if let Some(code) = next.stop {
            session.count_divergence();
            return stop(saver, report, code, if next.by_file { "stopped by the file `stop`" } else { "stopped" });
        }
        if session.saves(&next)
            && let Err(error) = saver.save(report)
        {
            report.warn(&format!("{error:#}; saving will be tried again at the next checkpoint"));
        }
    }
    saver.save_at_last(report)?;
    session.count_divergence();
    os::say(&format!("finished: {}; {}", saver.steps_made(), saver.folder().path().display()));
    Ok(ExitCode::SUCCESS)
}

/// Prints notes about settings that are rarely intended.
fn say_hints(session: &Session) -> Result<()> {
    let hints = hints(&session.config, &Config::resolve(None, &[])?, session.task.scene().size());
    hints.iter().for_each(|hint| os::say(&format!("note: {hint}")));
    Ok(())
}

/// Prints how to look at a run that has finished.
fn say_what_next(run: &Path) {
    let (program, run_word) = (os::called_as(), os::quoted_path(run));
    let all = os::quoted_path(run.parent().filter(|all| !all.as_os_str().is_empty()).unwrap_or(Path::new(".")));
    os::say(&format!("  {program} play --ckpt {run_word}\n  {program} plot {run_word}\n  tensorboard --logdir {all}"));
}

/// What an iteration has made, on all ranks together where it says nothing else. It is whole on the first rank only.
#[derive(Debug)]
struct Made {
    /// The record of the iteration on this rank.
    iteration: Iteration<Lesson>,
    /// The episodes that ended.
    ended: Vec<EpisodeStats>,
    /// The sums over the steps.
    recent: Recent,
    /// The score of its evaluation, which has no episodes if there was none.
    evaluation: Score,
    /// What talking to the other ranks has cost this one while collecting and learning.
    traffic: Traffic,
    /// Those of this rank's environments.
    figures: Figures,
}

impl Session {
    /// Runs one iteration and agrees with the other ranks on what follows. Returns `None` if a stop was requested meanwhile.
    fn iterate_and_agree(
        &mut self,
        requests: &Requests,
        saver: &Saver,
        report: &Report,
    ) -> Result<Option<(Made, Next)>> {
        let Some(made) = self.iterate(requests, Some(report))? else { return Ok(None) };
        let next = self.agree(requests, saver.folder().take_stop())?;
        Ok(Some((made, next)))
    }

    /// Runs one iteration and turns a panic into an error. Returns `None` if a stop was requested meanwhile. If the iteration does
    /// not complete, only the state at the end of the previous one can be used.
    fn iterate(&mut self, requests: &Requests, report: Option<&Report>) -> Result<Option<Made>> {
        let number = self.agent.iteration + 1;
        // One of several ranks cannot stop alone in the middle of an iteration: the others wait for what it computes.
        let never = AtomicBool::new(false);
        let stop = if self.agent.division.is_alone() { requests.stop() } else { &never };
        let caught = catch_unwind(AssertUnwindSafe(|| self.collect_learn_evaluate(stop, report)));
        let result = caught.unwrap_or_else(|panic| Err(panicked(&*panic)));
        result.with_context(|| format!("iteration {number}"))
    }

    fn collect_learn_evaluate(&mut self, stop: &AtomicBool, report: Option<&Report>) -> Result<Option<Made>> {
        // What was talked about since the last iteration is not counted.
        self.agent.division.take_traffic();
        let Some(iteration) = self.agent.iterate(stop)? else { return Ok(None) };
        let traffic = self.agent.division.take_traffic();
        let mut evaluation = Score::of(&[]);
        if evaluates(self.agent.iteration, self.config.run.eval_every) {
            let Some(score) = self.evaluate(stop)? else { return Ok(None) };
            evaluation = score;
            if let Some(report) = report {
                report.say(&format!(
                    "{} steps: evaluation of {} episodes: {:.3} goals/episode, rotation error {:.2} rad, drops {:.0} %",
                    self.agent.env_steps,
                    evaluation.episodes,
                    evaluation.goals,
                    evaluation.rot_dist,
                    100.0 * evaluation.drop_rate
                ));
            }
        }
        let Some(figures) = self.figures(stop, report) else { return Ok(None) };
        let found = Evaluation { goals: evaluation.goals, rot_dist: evaluation.rot_dist };
        self.improved = found.beats(self.best);
        self.best = if self.improved { Some(found) } else { self.best };
        let (pool, division) = (&mut self.agent.pool, &self.agent.division);
        let ended = EpisodeStats::gathered(pool.take_finished(), division);
        let shards: Vec<Recent> = pool.shards_mut().map(recent).collect();
        let recent = Recent::total(shards.into_iter(), division);
        Ok(Some(Made { iteration, ended, recent, evaluation, traffic, figures }))
    }

    /// Returns what this iteration has in the event file besides numbers; `None` if `stop` was set meanwhile. Without a report
    /// there is none.
    fn figures(&mut self, stop: &AtomicBool, report: Option<&Report>) -> Option<Figures> {
        let mut figures = Figures::default();
        let Some(report) = report else { return Some(figures) };
        if self.agent.iteration.is_multiple_of(HISTOGRAMS_EVERY) {
            figures.histograms = histograms(self.agent.ppo.policy(), &self.agent.rollout);
        }
        if self.films.due(self.agent.iteration) {
            let episodes = self.evaluation_episodes();
            let film = self.films.film(self.agent.ppo.policy(), episodes, stop, report);
            if stop.load(Ordering::Relaxed) {
                return None;
            }
            figures.film = film.map(|film| (FILM, film));
        }
        Some(figures)
    }

    fn evaluation_episodes(&self) -> Episodes {
        let (seed, count) = (self.config.run.seed, self.config.run.eval_episodes);
        Episodes { seed, purpose: "evaluation", first: 0, count }
    }

    /// Plays the evaluation episodes; returns `None` if `stop` was set meanwhile.
    fn evaluate(&self, stop: &AtomicBool) -> Result<Option<Score>> {
        let actor = Actor::Mean(self.agent.ppo.policy().freeze());
        let played = evaluate_together(&self.task, &actor, self.evaluation_episodes(), &self.agent.division, stop)?;
        Ok(played.map(|played| Score::of(&played)))
    }

    fn report(&mut self, report: &mut Report, made: &Made) {
        let Made { iteration, ended, recent, evaluation, traffic, figures } = made;
        let ended = Ended::of(ended, self.config.randomization.happens());
        let (env_steps, steps_per_s) = (self.agent.env_steps, iteration.steps_per_s());
        let (goals, drop_rate) = (ended.shown().goals, ended.shown().drop_rate);
        let status = Status { env_steps, steps_per_s, goals, drop_rate, evaluation: evaluation.goals };
        self.diverged += recent.diverged;
        let warning = divergence(recent.diverged, recent.steps).or_else(|| evaluation.divergence());
        if let Some(warning) = warning.filter(|_| !self.warned) {
            // Warn once; the total is printed at the end.
            self.warned = true;
            report.warn(&warning);
        }
        let traffic = (!self.agent.division.is_alone()).then_some(traffic);
        let values = row(iteration, &ended, recent, evaluation, traffic);
        report.iteration(self.agent.iteration, &values, figures, &status);
    }

    /// Prints the total number of diverged steps at the end, if there was a warning.
    fn count_divergence(&self) {
        if self.warned {
            os::say(&format!("warning: {} steps of this session diverged", self.diverged));
        }
    }
}

fn recent<'a>(envs: impl Iterator<Item = &'a mut Repose>) -> Recent {
    envs.fold(Recent::default(), |mut sum, env| {
        sum += env.take_recent();
        sum
    })
}

/// The iteration after which there is an early evaluation where the next one would come much later.
const EARLY: u64 = 50;

/// The iterations between two sets of histograms.
const HISTOGRAMS_EVERY: u64 = 50;

/// Returns whether there is an evaluation after this iteration. It depends on nothing else, so that a stop leaves no trace.
fn evaluates(iteration: u64, every: u64) -> bool {
    iteration.is_multiple_of(every) || iteration == EARLY && every > EARLY
}

fn new_report(session: &Session, saver: &Saver, quiet: bool) -> Report {
    let tags = tags(Lesson::task(&session.config.env), session.config.randomization.happens());
    let progress = StatusLine::new(session.agent.env_steps, session.config.run.total_steps, quiet);
    Report::new(saver.folder().path(), &tags, progress).described(described(&tags), session.config.to_text())
}

/// Saves the state at the end of the last complete iteration after a request to stop, and returns the exit code.
fn stop(mut saver: Saver, report: &mut Report, code: ExitCode, stopped: &str) -> Result<ExitCode> {
    saver.save_at_last(report)?;
    if saver.has_begun() {
        os::say(&format!("{stopped} after {}; resume with", saver.steps_made()));
        os::say(&format!("  {}", saver.how_to_resume()));
    } else {
        os::say("stopped before the first iteration: the run is unchanged; repeat the same command to continue");
    }
    Ok(code)
}

/// Saves the state at the end of the last complete iteration after a failure, and returns the error.
fn give_up(error: Error, mut saver: Saver, report: &mut Report) -> Error {
    match saver.save_at_last(report) {
        Ok(()) if saver.has_begun() => os::say(&format!("saved the state after {}", saver.steps_made())),
        Ok(()) => os::say("the run folder was not changed"),
        Err(error) => os::say(&format!("error: {error:#}")),
    }
    error
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use crate::ppo::Checkpoint;
    use crate::run::RunFolder;
    use crate::train::saver::Begin;

    #[test]
    fn evaluations_come_at_the_multiples_and_once_early_where_they_are_rare() {
        let after = |every| (1..=310).filter(|&iteration| evaluates(iteration, every)).collect::<Vec<u64>>();
        assert_eq!(after(150), [50, 150, 300]);
        assert_eq!(after(50), [50, 100, 150, 200, 250, 300]);
        assert_eq!(after(100), [50, 100, 200, 300]);
        assert_eq!(after(20)[..4], [20, 40, 60, 80]);
    }

    #[test]
    fn a_panic_on_a_worker_thread_is_an_error_and_the_iteration_before_is_saved() {
        let place = tempfile::tempdir().unwrap();
        let sets = ["env.num_envs=9", "ppo.horizon=4", "ppo.hidden=[8]", "run.eval_every=1000"];
        let sets: Vec<Override> = sets.map(|set| set.parse().unwrap()).into();
        let mut session = Session::new(Config::resolve(None, &sets).unwrap()).unwrap();
        let (folder, lock) = RunFolder::create(Some(place.path()), None).unwrap();
        let mut saver = session.saver(folder, lock, &TrainArgs::default(), Begin::New);
        let (mut report, never) = (new_report(&session, &saver, true), Requests::none());
        saver.begin(&mut report).unwrap();
        assert!(session.iterate(&never, Some(&report)).unwrap().is_some(), "nothing stops it");
        saver.take(session.checkpoint());
        // A rollout with room for fewer environments than there are.
        session.agent.rollout = session.agent.ppo.rollout(&[7, 1]);
        let error = session.iterate(&never, Some(&report)).unwrap_err();
        let latest = saver.folder().checkpoints().latest();
        let error = format!("{:#}", give_up(error, saver, &mut report));
        assert!(error.contains("iteration 2: panic: "), "{error}");
        let saved = os::read_bytes(&latest).unwrap();
        assert_eq!(Checkpoint::parse(&saved).unwrap().progress.iteration, 1);
    }

    #[test]
    fn a_run_that_cannot_begin_leaves_nothing_but_what_is_anothers() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("run");
        let sets = ["env.num_envs=9", "ppo.horizon=4", "ppo.hidden=[8]"].map(|set| set.parse().unwrap());
        let session = Session::new(Config::resolve(None, &sets).unwrap()).unwrap();
        let begin = || {
            let (folder, lock) = RunFolder::create(Some(&path), None).unwrap();
            let mut saver = session.saver(folder, lock, &TrainArgs::default(), Begin::New);
            saver.begin(&mut new_report(&session, &saver, true)).unwrap();
            saver
        };
        begin().give_back();
        assert!(!path.exists());
        let lost = begin();
        std::process::Command::new("rm").arg("-r").arg(&path).status().unwrap();
        let other = begin();
        lost.give_back();
        assert!(other.folder().checkpoints().latest().exists());
    }
}
