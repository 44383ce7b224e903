//! The training loop: collect, learn, evaluate, report, save.

mod hints;
mod lockstep;
mod log;
mod mobility;
mod outcome;
mod saver;
mod session;
mod start;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, Error, Result, anyhow, ensure};

use crate::cli::TrainArgs;
use crate::config::{Config, EnvConfig};
use crate::evaluate::{Actor, Episodes, Trial};
use crate::load::scene_option;
use crate::os::{self, Requests, Status, StatusLine};
use crate::ppo::{Evaluation, Rise};
use crate::ranks::{self, Exchange};
use crate::repose::{HEADLINE, Repose, Score, StepSums, Task, divergence, measure};
use crate::run::{Histogram, Hparams, Report};
use crate::schedule::panic_message;
use hints::hints;
use lockstep::{STOPPED, follow};
use log::{Ended, described, histograms, row, tags};
use mobility::mobility;
use outcome::Outcome;
use saver::{Lead, Saver};
use session::Session;

/// Trains until all steps are made or a stop is requested, and returns the exit code of the program. If a launcher has started
/// several processes, they train together.
///
/// # Errors
/// Fails if settings, files or the scene cannot be used, if a loss is not finite, or after a panic. Fails if the run folder
/// cannot be written to at the start or at the end. One of several processes then ends all others, and does not return.
pub fn train(args: &TrainArgs, requests: &Requests) -> Result<ExitCode> {
    ranks::together(|exchange| match exchange.is_first() {
        true => lead(args, requests, exchange),
        false => follow(requests, exchange),
    })
}

/// Trains, reports and saves.
fn lead(args: &TrainArgs, requests: &Requests, exchange: &Exchange) -> Result<ExitCode> {
    let (mut session, mut saver) = Session::lead(args, exchange)?;
    let place = saver.held.folder.path().display().to_string();
    if session.finished() {
        let advice = match session.is_flat() {
            true => "its evaluations no longer rise; use --fork to continue",
            false => "use a larger --total-steps to continue",
        };
        // It may have been killed before it could write the mark. A total that is given may be a mistake.
        if args.total_steps.is_none() {
            saver.held.folder.mark_finished(true);
        }
        os::say(&format!("{place} is finished: {}; {advice}", saver.held.steps_made()));
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(limit) = args.stop_after {
        requests.stop_after(limit)?;
    }
    requests.wait_for_end();
    os::say(&format!("run folder: {place}"));
    session.task.warnings().iter().for_each(|warning| os::say(&format!("warning: {warning}")));
    if !args.quiet {
        let default = Config::resolve(None, &[])?;
        let hints = hints(&session.config, &default, session.task.scene().size());
        let own_scene = session.config.env.model_file().is_some() && args.resume.is_none();
        let mobility = own_scene.then(|| mobility(&session.task, &default.env));
        session.task.notes().iter().chain(&mobility).chain(&hints).for_each(|hint| os::say(&format!("note: {hint}")));
    }
    let mut report = new_report(&session, &saver, args.quiet);
    if args.resume.is_none()
        && let Err(error) = saver.open_folder(&mut report)
    {
        saver.give_back();
        return Err(error);
    }
    let code = run(&mut session, saver, &mut report, requests);
    if session.warned {
        os::say(&format!("warning: {} steps of this session diverged", session.diverged));
    }
    let code = code?;
    if session.finished() && !args.quiet {
        say_what_next(Path::new(&place), &session.config.env);
    }
    Ok(code)
}

/// Iterates until all steps are made or a stop is requested, and returns the exit code.
fn run(session: &mut Session, mut saver: Saver, report: &mut Report, requests: &Requests) -> Result<ExitCode> {
    match session.begin(requests, Some(Lead { report, saver: &mut saver })) {
        Ok(true) => saver.keep(session.checkpoint()),
        Ok(false) => return stop(saver, report, os::exit_code(requests.signal()), STOPPED),
        Err(error) => return Err(give_up(error, saver, report)),
    }
    while !session.finished() {
        let outcome = match session.iterate(requests, Some(Lead { report, saver: &mut saver })) {
            Ok(Some(outcome)) => outcome,
            Ok(None) => return stop(saver, report, os::exit_code(requests.signal()), STOPPED),
            Err(error) => return Err(give_up(error, saver, report)),
        };
        if outcome.decision.hand_over {
            saver.keep(session.checkpoint());
        }
        if let Err(error) = saver.open_folder(report) {
            report.finish();
            return Err(saver.held.elsewhere(error));
        }
        for (name, text) in session.dumps() {
            saver.held.folder.dump(&name, &text).unwrap_or_else(|error| report.warn(&format!("{error:#}")));
        }
        session.report(report, &outcome);
        if session.finished() {
            break;
        }
        if let Some((code, reason)) = outcome.decision.stop {
            return stop(saver, report, code, reason);
        }
        if outcome.decision.save {
            saver.save_or_warn(report);
        }
    }
    report.end(true);
    saver.save_at_last(report)?;
    saver.held.folder.mark_finished(true);
    saver.release();
    let why = if session.is_flat() { "evaluations no longer rise" } else { "finished" };
    os::say(&format!("{why}: {}; {}", saver.held.steps_made(), saver.held.folder.path().display()));
    session.rise.iter().for_each(|rise| os::say(&before_and_after(rise, session.config.run.eval_episodes)));
    Ok(ExitCode::SUCCESS)
}

impl Session {
    /// Runs one iteration: collects, learns, evaluates when that is due, and decides what follows. The first rank passes what
    /// reports and saves. Returns `None` if a stop was requested meanwhile. If the iteration does not complete, only the state
    /// at the end of the previous one can be used.
    ///
    /// # Errors
    /// Fails if a loss is not finite, after a panic, or if others do not have the same weights.
    fn iterate(&mut self, requests: &Requests, mut lead: Option<Lead>) -> Result<Option<Outcome>> {
        let number = self.agent.iteration + 1;
        // With other ranks, none can stop or save in the middle of an iteration: they wait for what is computed here.
        let never = Requests::none();
        let now = if self.agent.exchange.is_alone() { requests } else { &never };
        let iterate = || {
            // What was exchanged since the last iteration is not counted.
            self.agent.exchange.take_traffic();
            let Some(iteration) = self.agent.iterate(now.stop())? else { return Ok(None) };
            let traffic = self.agent.exchange.take_traffic();
            let due = evaluates(self.agent.iteration, self.config.run.eval_every);
            let Some(evaluation) = self.evaluate(due, now, lead.as_mut())? else { return Ok(None) };
            let histograms = self.histograms(lead.is_some());
            let improved = self.take_down(&evaluation);
            let (pool, exchange) = (&mut self.agent.pool, &self.agent.exchange);
            let ended = exchange.all_gather(pool.take_finished()).concat();
            let sums: Vec<StepSums> = pool.envs_mut().map(Repose::take_sums).collect();
            let total = |sums: &[StepSums]| {
                let mut total = StepSums::default();
                sums.iter().for_each(|sums| total += *sums);
                total
            };
            let steps = exchange.sum(&sums, total, |sum, more| *sum += more);
            let decision =
                self.decide(requests, lead.is_some_and(|lead| lead.saver.held.folder.take_stop()), improved)?;
            Ok(Some(Outcome { iteration, ended, steps, evaluation, traffic, histograms, decision }))
        };
        caught(iterate).with_context(|| format!("iteration {number}"))
    }

    /// The histograms that are due after this iteration. Only the first rank has some.
    fn histograms(&self, is_first: bool) -> Vec<(&'static str, Histogram)> {
        let due = is_first && self.agent.iteration.is_multiple_of(HISTOGRAMS_EVERY);
        if due { histograms(&self.agent.rollout) } else { Vec::new() }
    }

    /// The task as far as training has come.
    fn task_now(&self) -> Arc<Task> {
        self.task.smoothed_as_in(&self.config.env.at(self.agent.env_steps))
    }

    fn evaluation_episodes(&self) -> Episodes {
        let (seed, count) = (self.config.run.seed, self.config.run.eval_episodes);
        Episodes { seed, purpose: "evaluation", first: 0, count }
    }

    /// Evaluates before the first iteration, if the run ends when evaluations no longer rise. Returns whether it can go on: no stop
    /// was requested meanwhile.
    ///
    /// # Errors
    /// Fails as an evaluation does.
    fn begin(&mut self, requests: &Requests, mut lead: Option<Lead>) -> Result<bool> {
        if self.config.run.patience == 0 || self.rise.is_some() {
            return Ok(true);
        }
        let never = Requests::none();
        let now = if self.agent.exchange.is_alone() { requests } else { &never };
        let Some(before) = caught(|| self.evaluate(true, now, lead.as_mut()))? else { return Ok(false) };
        let known = figures(&before);
        ensure!(
            known.iter().all(|x| x.is_finite()),
            "run.patience: the physics of every evaluation episode diverges at once"
        );
        self.take_down(&before);
        self.rise = Some(Rise::new(known));
        Ok(true)
    }

    /// Records an evaluation, if the score is one, and returns whether it is the best so far.
    fn take_down(&mut self, evaluation: &Score) -> bool {
        let found = Evaluation { goals: evaluation["goals"], rot_dist: evaluation["rot_dist"] };
        let improved = found.beats(self.best);
        self.best = if improved { Some(found) } else { self.best };
        // While the critic learns alone, an evaluation cannot rise.
        if evaluation.episodes > 0 && !self.agent.ppo.is_critic_alone(self.agent.iteration) {
            self.rise.iter_mut().for_each(|rise| rise.add(figures(evaluation)));
        }
        improved
    }

    /// Plays the evaluation episodes, if they are `due`, and reports their score. Returns `None` if a stop was requested meanwhile.
    fn evaluate(&self, due: bool, requests: &Requests, mut lead: Option<&mut Lead>) -> Result<Option<Score>> {
        let ctrl_dt = self.task.config().ctrl_dt;
        if !due {
            return Ok(Some(Score::of(&[], ctrl_dt)));
        }
        let (task, actor) = (self.task_now(), Actor::Mean(self.agent.ppo.policy().freeze()));
        let trial = Trial { task: &task, actor: &actor, episodes: self.evaluation_episodes(), stop: requests.stop() };
        let played = trial.play_together(&self.agent.exchange, &mut |_| {
            lead.iter_mut().for_each(|lead| lead.save_if_asked(requests));
            Ok(())
        })?;
        let Some(score) = played.map(|played| Score::of(&played, ctrl_dt)) else { return Ok(None) };
        if let Some(Lead { report, .. }) = lead {
            let found =
                HEADLINE.map(|column| format!("{} {}", measure(column).label(), measure(column).text(score[column])));
            let (steps, episodes) = (self.agent.env_steps, score.episodes);
            report.say(&format!("{steps} steps: evaluation of {episodes} episodes: {}", found.join("; ")));
        }
        Ok(Some(score))
    }

    fn report(&mut self, report: &mut Report, outcome: &Outcome) {
        let Outcome { iteration, steps, evaluation, histograms, .. } = outcome;
        let ended = Ended::new(&outcome.ended, self.config.env.ctrl_dt, self.config.randomization.happens());
        let (env_steps, steps_per_s) = (self.agent.env_steps, iteration.steps_per_s());
        let goals = ended.shown()["goals"];
        let drop_rate = ended.shown()["drop_rate"];
        let status = Status { env_steps, steps_per_s, goals, drop_rate, evaluation: evaluation["goals"] };
        self.diverged += steps.diverged;
        let warning = divergence(steps.diverged, steps.steps).or_else(|| evaluation.divergence());
        if let Some(warning) = warning.filter(|_| !self.warned) {
            // Warn once. The total is printed at the end.
            self.warned = true;
            report.warn(&warning);
        }
        let desired_kl = self.config.ppo.desired_kl.at(env_steps);
        let is_far = desired_kl > 0.0 && iteration.update.losses.kl > FAR * desired_kl;
        self.far = if is_far { self.far.saturating_add(1) } else { 0 };
        if self.far == FAR_FOR {
            report.warn(&format!(
                "policy/kl has been more than {FAR} times ppo.desired_kl = {desired_kl} for {FAR_FOR} iterations: updates are too \
                 large; lower ppo.learning_rate_range or ppo.learning_rate"
            ));
        }
        report.iteration(self.agent.iteration, &row(outcome, &ended), histograms, &status);
    }
}

/// Prints how to look at a run that has finished.
fn say_what_next(run: &Path, env: &EnvConfig) {
    let (program, run_word) = (os::called_as(), os::quoted_path(run));
    let all = os::quoted_path(run.parent().filter(|all| !all.as_os_str().is_empty()).unwrap_or(Path::new(".")));
    let play = format!("{program} play --ckpt {run_word}{}", scene_option(env));
    os::say(&format!("  {play}\n  {program} plot {run_word}\n  tensorboard --logdir {all}"));
}

/// Runs what may panic. A panic becomes an error.
fn caught<T>(run: impl FnOnce() -> Result<T>) -> Result<T> {
    let caught = catch_unwind(AssertUnwindSafe(run));
    caught.unwrap_or_else(|panic| Err(anyhow!("panic: {}", panic_message(&*panic))))
}

/// Returns the figures by which a run that ends when evaluations no longer rise is compared with its start.
fn figures(score: &Score) -> [f64; 3] {
    HEADLINE.map(|column| score[column])
}

/// Returns a table of the first evaluation and the best one.
fn before_and_after(rise: &Rise, episodes: usize) -> String {
    let mut table = format!("  {:<20} {:>8} {:>8}", format!("{episodes} episodes"), "before", "best");
    for (column, (before, best)) in HEADLINE.into_iter().zip(rise.before.into_iter().zip(rise.best)) {
        let measure = measure(column);
        table += &format!("\n  {:<20} {:>8} {:>8}", measure.label(), measure.text(before), measure.text(best));
    }
    table
}

/// The iteration after which there is an early evaluation where the next one would come much later.
const EARLY: u64 = 50;

/// The factor by which, and the iterations for which, the KL divergence must lie beyond its target for a warning.
const FAR: f64 = 10.0;
const FAR_FOR: u32 = 20;

/// The iterations between two sets of histograms.
const HISTOGRAMS_EVERY: u64 = 50;

/// Returns whether there is an evaluation after this iteration. It depends on nothing else, so that a stop leaves no trace.
fn evaluates(iteration: u64, every: u64) -> bool {
    iteration.is_multiple_of(every) || iteration == EARLY && every > EARLY
}

fn new_report(session: &Session, saver: &Saver, quiet: bool) -> Report {
    let tags = tags(session.config.randomization.happens());
    let progress = StatusLine::new(session.agent.env_steps, session.config.run.total_steps, quiet);
    let config = &session.config;
    let hparams = Hparams { settings: config.dotted(), goals: session.best.map(|best| best.goals) };
    Report::new(saver.held.folder.path(), &tags, progress).described(described(&tags), config.to_text(), hparams)
}

/// Saves the state at the end of the last complete iteration after a request to stop, and returns the exit code.
fn stop(mut saver: Saver, report: &mut Report, code: ExitCode, reason: &str) -> Result<ExitCode> {
    saver.save_at_last(report)?;
    if saver.held.wrote {
        saver.held.folder.mark_finished(reason != STOPPED);
        saver.release();
        os::say(&format!("{reason} after {}; resume with", saver.held.steps_made()));
        os::say(&format!("  {}", saver.held.how_to_resume(&saver.held.folder)));
    } else {
        os::say("stopped before the first iteration: the run is unchanged; repeat the same command to continue");
    }
    Ok(code)
}

/// Saves the state at the end of the last complete iteration after a failure, and returns the error.
fn give_up(error: Error, mut saver: Saver, report: &mut Report) -> Error {
    report.end(false);
    match saver.save_at_last(report) {
        Ok(()) if saver.held.wrote => os::say(&format!("saved the state after {}", saver.held.steps_made())),
        Ok(()) => os::say("the run folder was not changed"),
        Err(error) => os::say(&format!("error: {error:#}")),
    }
    error
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Override;
    use crate::os::Locked;
    use crate::ppo::Checkpoint;
    use crate::run::RunFolder;
    use crate::train::start::Plan;

    fn from_scratch(sets: &[Override]) -> Session {
        let mut plan = Plan::new(Config::resolve(None, sets).unwrap(), &TrainArgs::default()).unwrap();
        let loaded = plan.load_task().unwrap();
        Session::new(plan, loaded, Exchange::alone(1)).unwrap()
    }

    fn saver_of(session: &Session, place: (RunFolder, Locked)) -> Saver {
        Saver::new(place, &TrainArgs::default(), &session.config, session.checkpoint(), false)
    }

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
        let mut session = from_scratch(&sets);
        let mut saver = saver_of(&session, RunFolder::create(Some(place.path()), None).unwrap());
        let (mut report, never) = (new_report(&session, &saver, true), Requests::none());
        saver.open_folder(&mut report).unwrap();
        assert!(
            session.iterate(&never, Some(Lead { report: &mut report, saver: &mut saver })).unwrap().is_some(),
            "nothing stops it"
        );
        saver.keep(session.checkpoint());
        // A rollout with room for fewer environments than there are.
        session.agent.rollout = session.agent.ppo.rollout(&[7, 1]);
        let error = session.iterate(&never, Some(Lead { report: &mut report, saver: &mut saver })).unwrap_err();
        let latest = saver.held.folder.checkpoints().latest();
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
        let session = from_scratch(&sets);
        let begin = || {
            let mut saver = saver_of(&session, RunFolder::create(Some(&path), None).unwrap());
            saver.open_folder(&mut new_report(&session, &saver, true)).unwrap();
            saver
        };
        begin().give_back();
        assert!(!path.exists());
        let lost = begin();
        std::process::Command::new("rm").arg("-r").arg(&path).status().unwrap();
        let other = begin();
        lost.give_back();
        assert!(other.held.folder.checkpoints().latest().exists());
    }
}
