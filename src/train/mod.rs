//! Training, from top to bottom: collect, learn, evaluate, report, save.

mod fork;
mod hints;
mod log;
mod saver;
mod session;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::AtomicBool;

use anyhow::{Context, Error, Result, anyhow};

use crate::agent::Iteration;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::dump;
use crate::env::{Lesson, Recent, Score, divergence};
use crate::evaluate::{Actor, Episodes, evaluate};
use crate::run::{self, Progress, Report, Requests, RunFolder, Status};
use crate::schedule::panic_message;
use hints::hints;
use log::{row, tags};
use saver::Saver;
use session::Session;

pub use session::user_file;

/// How a command ended that was not stopped by an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All that it was to do is done.
    Finished,
    /// It was asked to stop, and has saved; with the exit code that says so.
    Stopped(u8),
}

/// Trains as asked, until all steps are made or it is requested to stop.
///
/// # Errors
/// Settings, files or a scene that cannot be used; a run folder that cannot be written to at the beginning or in the end; a
/// loss that is not finite; a panic.
pub fn train(args: &TrainArgs, requests: &Requests) -> Result<Outcome> {
    let (mut session, mut saver) = match (&args.resume, &args.fork) {
        (Some(place), _) => Session::resume(place, args)?,
        (None, Some(place)) => Session::fork(place, args)?,
        (None, None) => Session::begin(args)?,
    };
    let place = saver.folder().path().display().to_string();
    if session.finished() {
        run::say(&format!("{place} is finished: {}", saver.steps_made()));
        return Ok(Outcome::Finished);
    }
    if let Some(limit) = args.stop_after {
        requests.stop_after(limit)?;
    }
    requests.wait_for_end();
    run::say(&format!("run folder: {place}"));
    if !args.quiet {
        hints(&session.config, &Config::resolve(None, &[])?).iter().for_each(|hint| run::say(&format!("note: {hint}")));
    }
    let mut report = new_report(&session, &saver, args.quiet);
    if !saver.resumes()
        && let Err(error) = saver.begin(&mut report)
    {
        saver.give_back();
        return Err(error);
    }
    while !session.finished() {
        match session.iterate(requests.stop(), &report) {
            Ok(Some(made)) => {
                saver.take(session.checkpoint());
                if let Err(error) = saver.begin(&mut report) {
                    report.finish();
                    return Err(saver.elsewhere(error));
                }
                if args.dump_diverged {
                    session.dump_diverged(saver.folder(), &report);
                }
                session.report(&mut report, &made);
            }
            Ok(None) => {
                session.count_divergence();
                return stop(saver, &mut report, requests);
            }
            Err(error) => {
                session.count_divergence();
                return Err(give_up(error, saver, &mut report));
            }
        }
        let due = session.agent.iteration.is_multiple_of(session.config.run.checkpoint_every);
        if (requests.take_save() || due)
            && !session.finished()
            && let Err(error) = saver.save(&mut report)
        {
            report.warn(&format!("{error:#}; it is tried again at the next checkpoint"));
        }
    }
    saver.save_at_last(&mut report)?;
    session.count_divergence();
    run::say(&format!("finished: {}; {place}", saver.steps_made()));
    Ok(Outcome::Finished)
}

/// An iteration, and the score of its evaluation: of no episodes where there was none.
type Made = (Iteration<Lesson>, Score);

impl Session {
    /// One iteration, whatever happens in it; `None` if `stop` was set meanwhile. Where it does not come to its end, only the end of
    /// the one before can be used.
    fn iterate(&mut self, stop: &AtomicBool, report: &Report) -> Result<Option<Made>> {
        let number = self.agent.iteration + 1;
        let caught = catch_unwind(AssertUnwindSafe(|| self.collect_learn_evaluate(stop, report)));
        let result = caught.unwrap_or_else(|panic| Err(anyhow!("panic: {}", panic_message(&*panic))));
        result.with_context(|| format!("iteration {number}"))
    }

    fn collect_learn_evaluate(&mut self, stop: &AtomicBool, report: &Report) -> Result<Option<Made>> {
        let Some(iteration) = self.agent.iterate(stop)? else { return Ok(None) };
        let mut evaluation = Score::of(&[]);
        if self.agent.iteration.is_multiple_of(self.config.run.eval_every) {
            let Some(score) = self.evaluate(stop, report)? else { return Ok(None) };
            let found = [score.goals, score.rot_dist];
            self.best = if is_better(found, self.best) { Some(found) } else { self.best };
            evaluation = score;
        }
        Ok(Some((iteration, evaluation)))
    }

    /// Plays the evaluation episodes.
    fn evaluate(&self, stop: &AtomicBool, report: &Report) -> Result<Option<Score>> {
        let (seed, count) = (self.config.run.seed, self.config.run.eval_episodes);
        let episodes = Episodes { seed, purpose: "evaluation", first: 0, count };
        let actor = Actor::Mean(self.agent.ppo.policy().freeze());
        let Some(played) = evaluate(&self.task, &actor, episodes, stop, &mut |_| Ok(()))? else {
            return Ok(None);
        };
        let score = Score::of(&played);
        report.say(&format!(
            "{} steps: evaluation of {} episodes: {:.3} goals/episode, rotation error {:.2} rad, drops {:.0} %",
            self.agent.env_steps,
            score.episodes,
            score.goals,
            score.rot_dist,
            100.0 * score.drop_rate
        ));
        Ok(Some(score))
    }

    fn report(&mut self, report: &mut Report, (iteration, evaluation): &Made) {
        let episodes = Score::of(&self.agent.pool.take_finished());
        let mut recent = Recent::default();
        for env in self.agent.pool.envs_mut() {
            recent += env.take_recent();
        }
        let (env_steps, steps_per_s) = (self.agent.env_steps, iteration.steps_per_s());
        let (goals, drop_rate) = (episodes.goals, episodes.drop_rate);
        let status = Status { env_steps, steps_per_s, goals, drop_rate, evaluation: evaluation.goals };
        self.diverged += recent.diverged;
        let warning = divergence(recent.diverged, recent.steps).or_else(|| evaluation.divergence());
        if let Some(warning) = warning.filter(|_| !self.warned) {
            // Once; how often it came to it stands at the end.
            self.warned = true;
            report.warn(&warning);
        }
        report.iteration(self.agent.iteration, &row(iteration, &episodes, &recent, evaluation), &status);
    }

    /// Says at the end how many steps diverged, if they were warned of.
    fn count_divergence(&self) {
        if self.warned {
            run::say(&format!("warning: {} steps of this session diverged", self.diverged));
        }
    }

    /// Writes what led to each episode that diverged.
    fn dump_diverged(&mut self, folder: &RunFolder, report: &Report) {
        let iteration = self.agent.iteration;
        for (env, repose) in self.agent.pool.envs_mut().enumerate() {
            let Some(diverged) = repose.take_diverged() else { continue };
            let text = dump::of(&diverged, &self.config.env, iteration, env);
            if let Err(error) = folder.dump(&format!("iteration-{iteration:08}-env-{env}.json"), &text) {
                report.warn(&format!("{error:#}"));
            }
        }
    }
}

fn new_report(session: &Session, saver: &Saver, quiet: bool) -> Report {
    let tags = tags(Lesson::task(&session.config.env));
    let progress = Progress::new(session.agent.env_steps, session.config.run.total_steps, quiet);
    Report::new(saver.folder().path(), &tags, progress)
}

/// Saves the end of the last iteration, when it was asked to stop.
fn stop(mut saver: Saver, report: &mut Report, requests: &Requests) -> Result<Outcome> {
    saver.save_at_last(report)?;
    if saver.has_begun() {
        run::say(&format!("stopped after {}; go on with", saver.steps_made()));
        run::say(&format!("  {}", saver.how_to_resume()));
    } else {
        run::say("stopped before its first iteration: the run is as it was; the same command goes on");
    }
    Ok(Outcome::Stopped(requests.exit_code()))
}

/// Saves the end of the last iteration before the one that failed.
fn give_up(error: Error, mut saver: Saver, report: &mut Report) -> Error {
    match saver.save_at_last(report) {
        Ok(()) if saver.has_begun() => run::say(&format!("saved the state after {}", saver.steps_made())),
        Ok(()) => run::say("nothing was changed in the folder of the run"),
        Err(error) => run::say(&format!("error: {error:#}")),
    }
    error
}

/// Whether an evaluation (goals per episode, rotation error in rad) is the best so far: more goals, then less error.
fn is_better(found: [f64; 2], best: Option<[f64; 2]>) -> bool {
    let rank = |[goals, rot_dist]: [f64; 2]| (goals, -rot_dist);
    // Where every episode diverged at once there is no rotation error to speak of.
    found.iter().all(|x| x.is_finite()) && best.is_none_or(|best| rank(found) > rank(best))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use crate::ppo::Checkpoint;
    use crate::train::saver::Begin;

    #[test]
    fn a_panic_on_a_worker_thread_is_an_error_and_the_iteration_before_is_saved() {
        let place = tempfile::tempdir().unwrap();
        let sets = ["env.num_envs=9", "ppo.horizon=4", "ppo.hidden=[8]", "run.eval_every=1000"];
        let sets: Vec<Override> = sets.map(|set| set.parse().unwrap()).into();
        let mut session = Session::new(Config::resolve(None, &sets).unwrap()).unwrap();
        let (folder, lock) = RunFolder::create(Some(place.path()), None).unwrap();
        let mut saver = session.saver(folder, lock, &TrainArgs::default(), Begin::New);
        let (mut report, never) = (new_report(&session, &saver, true), AtomicBool::new(false));
        saver.begin(&mut report).unwrap();
        assert!(session.iterate(&never, &report).unwrap().is_some(), "nothing stops it");
        saver.take(session.checkpoint());
        // Room for fewer environments than there are.
        session.agent.rollout = session.agent.ppo.rollout(&[7, 1]);
        let error = session.iterate(&never, &report).unwrap_err();
        let latest = saver.folder().checkpoints().latest();
        let error = format!("{:#}", give_up(error, saver, &mut report));
        assert!(error.contains("iteration 2: panic: "), "{error}");
        let saved = run::read_bytes(&latest).unwrap();
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

    #[test]
    fn the_best_evaluation_has_most_goals_and_then_the_least_rotation_error() {
        assert!(is_better([0.0, 2.0], None));
        assert!(is_better([1.0, 2.0], Some([0.5, 0.1])));
        assert!(!is_better([0.5, 0.1], Some([1.0, 2.0])));
        assert!(is_better([1.0, 1.9], Some([1.0, 2.0])));
        assert!(!is_better([1.0, 2.0], Some([1.0, 2.0])));
        assert!(!is_better([0.0, f64::NAN], None));
    }
}
