//! Training, from top to bottom: collect, learn, evaluate, report, checkpoint.

mod saving;

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Error, Result, anyhow, bail, ensure};

use crate::cli::{Settings, TrainArgs};
use crate::collect::{Scratch, collect};
use crate::config::{Config, Override, Source};
use crate::env::{EnvPool, Recent, Repose, Score, Task, panic_message};
use crate::evaluate::{Actor, Episodes, evaluate};
use crate::load::MODEL;
use crate::ppo::{Checkpoint, Ppo, Progress, Rollout, UpdateStats};
use crate::run::{self, Locked, Report, Requests, RunFolder, Status};

/// How a command ended that was not stopped by an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All that it was to do is done.
    Finished,
    /// It was asked to stop, and has saved; with the exit code that says so.
    Stopped(u8),
}

/// The names under which an iteration is logged, in order.
const TAGS: [&str; 30] = [
    "episode/return",
    "episode/length",
    "episode/goals",
    "episode/in_tolerance",
    "episode/drop_rate",
    "episode/rot_dist",
    "episode/steps_per_goal",
    "reward/rotation",
    "reward/distance",
    "reward/action",
    "reward/bonus",
    "reward/fall",
    "eval/goals",
    "eval/drop_rate",
    "eval/rot_dist",
    "eval/return",
    "loss/policy",
    "loss/value",
    "policy/entropy",
    "policy/kl",
    "policy/first_kl",
    "policy/clip_fraction",
    "policy/std",
    "value/explained_variance",
    "optim/learning_rate",
    "optim/grad_norm",
    "time/collect_s",
    "time/update_s",
    "time/steps_per_s",
    "sim/diverged",
];

/// Trains as asked, until all steps are made or it is requested to stop.
///
/// # Errors
/// Settings, files or a scene that cannot be used; a run folder that cannot be written to at the beginning or in the end; a
/// loss that is not finite; a panic.
pub fn train(args: &TrainArgs, requests: &Requests) -> Result<Outcome> {
    let mut session = match &args.resume {
        Some(place) => Session::resume(place, args)?,
        None => Session::begin(args)?,
    };
    if session.finished() {
        run::say(&format!("{} is finished: {}", session.folder.path().display(), session.steps_made()));
        return Ok(Outcome::Finished);
    }
    if let Some(limit) = args.stop_after {
        requests.stop_after(limit);
    }
    run::say(&format!("run folder: {}", session.folder.path().display()));
    let mut report = session.open_report()?;
    // The end of the last iteration: what is saved if the next one does not come to its own.
    let mut end = session.checkpoint()?;
    if session.progress.iteration == 0 {
        // So that a run that dies before its first checkpoint can be resumed like any other.
        session.save(&end, &mut report)?;
    }
    while !session.finished() {
        match session.iterate(requests.stop(), &report) {
            Ok(Some(iteration)) => session.report(&mut report, &iteration),
            Ok(None) => return session.stop(&end, &mut report, requests),
            Err(error) => return Err(session.give_up(error, &end, &mut report)),
        }
        end = session.checkpoint()?;
        let due = session.progress.iteration.is_multiple_of(session.config.run.checkpoint_every);
        if (requests.take_save() || due)
            && !session.finished()
            && let Err(error) = session.save(&end, &mut report)
        {
            report.warn(&format!("{error:#}; it is tried again at the next checkpoint"));
        }
    }
    session.save_at_last(&end, &mut report)?;
    run::say(&format!("finished: {}; {}", session.steps_made(), session.folder.path().display()));
    Ok(Outcome::Finished)
}

/// What an iteration tells.
struct Iteration {
    update: UpdateStats,
    evaluation: Option<Score>,
    collect_s: f64,
    update_s: f64,
}

/// All that a training owns.
struct Session {
    config: Config,
    folder: RunFolder,
    lock: Locked,
    keep: usize,
    dump_diverged: bool,
    task: Arc<Task>,
    /// The fingerprint of the scene.
    scene: u64,
    pool: EnvPool<Repose>,
    ppo: Ppo,
    rollout: Rollout,
    scratch: Scratch,
    progress: Progress,
    /// The last evaluation was the best one so far, and its policy is not saved yet.
    found_best: bool,
    /// The checkpoint of the best evaluation, until it is saved.
    best: Option<Checkpoint>,
}

impl Session {
    fn begin(args: &TrainArgs) -> Result<Self> {
        let mut overrides = args.settings.set.clone();
        overrides.extend(asked(args));
        let mut config = Config::resolve(user_file(&args.settings)?.as_ref(), &overrides)?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        let folder = || RunFolder::create(args.run_dir.as_deref(), args.name.as_deref());
        let mut session = Self::new(config, folder, args)?;
        session.pool.reset(session.rollout.first_observations_mut());
        Ok(session)
    }

    fn resume(place: &Path, args: &TrainArgs) -> Result<Self> {
        let others = args.settings.set.iter().find(|set| set.key != MODEL);
        if let Some(set) = others {
            bail!(
                "--set {}: of a run that is resumed only {MODEL} can be said anew, and --total-steps and --threads",
                set.key
            );
        }
        let folder = RunFolder::containing(place)?;
        let newest = folder.checkpoints().newest_first();
        ensure!(!newest.is_empty(), "{} holds no checkpoint", place.display());
        let lock = folder.lock()?;
        let mut overrides = args.settings.set.clone();
        overrides.extend(asked(args));
        let places = if place.is_dir() { newest } else { vec![place.to_owned()] };
        let (path, checkpoint, mut config) =
            saving::first_sound(&places, &overrides).with_context(|| format!("cannot resume {}", place.display()))?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        let mut session = Self::new(config, || Ok((folder, lock)), args)?;
        session.restore(checkpoint).with_context(|| format!("cannot resume from {}", path.display()))?;
        Ok(session)
    }

    /// The folder comes last: it is not touched by a training that cannot be set up.
    fn new(config: Config, folder: impl FnOnce() -> Result<(RunFolder, Locked)>, args: &TrainArgs) -> Result<Self> {
        let task = Task::new(&config.env)?;
        let envs = (0..config.env.num_envs).map(|_| Repose::new(&task)).collect();
        let pool = EnvPool::new(config.run.seed, envs);
        let ppo = Ppo::new(&config.ppo, pool.observation_size(), pool.action_size(), config.run.seed)?;
        let rollout = ppo.rollout(&pool.block_sizes());
        let scratch = Scratch::new(&pool, &ppo);
        let (folder, lock) = folder()?;
        let (keep, dump_diverged) = (args.keep, args.dump_diverged);
        let (progress, found_best, best) = (Progress::default(), false, None);
        Ok(Self {
            config,
            folder,
            lock,
            keep,
            dump_diverged,
            scene: task.scene().fingerprint()?,
            task,
            pool,
            ppo,
            rollout,
            scratch,
            progress,
            found_best,
            best,
        })
    }

    fn finished(&self) -> bool {
        self.progress.env_steps >= self.config.run.total_steps
    }

    fn steps_made(&self) -> String {
        format!("{} iterations, {} env steps", self.progress.iteration, self.progress.env_steps)
    }

    fn open_report(&self) -> Result<Report> {
        self.folder.describe(&self.config.to_text(), &version())?;
        let Progress { iteration, env_steps, .. } = self.progress;
        Ok(Report::open(self.folder.path(), &TAGS, iteration, env_steps, self.config.run.total_steps))
    }

    /// Collects, learns, and evaluates where that is due; `None` if `stop` was set meanwhile. Where it does not come to its
    /// end, the session is good for nothing but saving the end of the iteration before.
    fn iterate(&mut self, stop: &AtomicBool, report: &Report) -> Result<Option<Iteration>> {
        let iteration = self.progress.iteration + 1;
        let work = AssertUnwindSafe(|| self.iterate_unguarded(iteration, stop, report));
        catch_unwind(work)
            .unwrap_or_else(|panic: Box<dyn Any + Send>| Err(anyhow!("panic: {}", panic_message(&*panic))))
            .with_context(|| format!("iteration {iteration}"))
    }

    fn iterate_unguarded(&mut self, iteration: u64, stop: &AtomicBool, report: &Report) -> Result<Option<Iteration>> {
        let started = Instant::now();
        if !collect(&mut self.pool, &self.ppo, &mut self.rollout, iteration, &mut self.scratch, stop)? {
            return Ok(None);
        }
        let collected = Instant::now();
        let Some(update) = self.ppo.update(&mut self.rollout, iteration, stop)? else { return Ok(None) };
        self.rollout.carry_over();
        let [collect_s, update_s] = [collected - started, collected.elapsed()].map(|time| time.as_secs_f64());
        let env_steps = self.progress.env_steps + self.config.steps_per_iteration();
        let mut evaluation = None;
        if iteration.is_multiple_of(self.config.run.eval_every) {
            evaluation = self.evaluate(env_steps, stop, report)?;
            if evaluation.is_none() {
                return Ok(None);
            }
        }
        (self.progress.iteration, self.progress.env_steps) = (iteration, env_steps);
        if let Some(score) = &evaluation {
            let found = [score.goals, score.rot_dist];
            if is_better(found, self.progress.best) {
                (self.progress.best, self.found_best) = (Some(found), true);
            }
        }
        Ok(Some(Iteration { update, evaluation, collect_s, update_s }))
    }

    /// Saves the end of the last iteration, when it was asked to stop.
    fn stop(&mut self, end: &Checkpoint, report: &mut Report, requests: &Requests) -> Result<Outcome> {
        self.save_at_last(end, report)?;
        run::say(&format!("stopped after {}; go on with", self.steps_made()));
        run::say(&format!("  {}", self.how_to_resume(self.folder.path())));
        Ok(Outcome::Stopped(requests.exit_code()))
    }

    /// Saves the end of the last iteration before the one that failed.
    fn give_up(&mut self, error: Error, end: &Checkpoint, report: &mut Report) -> Error {
        match self.save_at_last(end, report) {
            Ok(()) => run::say(&format!("saved the state after {}", self.steps_made())),
            Err(error) => run::say(&format!("error: {error:#}")),
        }
        error
    }

    /// Plays the evaluation episodes.
    fn evaluate(&self, env_steps: u64, stop: &AtomicBool, report: &Report) -> Result<Option<Score>> {
        let (seed, count) = (self.config.run.seed, self.config.run.eval_episodes);
        let episodes = Episodes { seed, purpose: "evaluation", first: 0, count };
        let actor = Actor::Mean(self.ppo.policy().freeze()?);
        let Some(played) = evaluate(&self.task, &actor, episodes, stop, &mut |_| Ok(()))? else {
            return Ok(None);
        };
        let score = Score::of(&played);
        report.say(&format!(
            "{env_steps} steps: evaluation of {} episodes: {:.3} goals/episode, rotation error {:.2} rad, drops {:.0} %",
            score.episodes,
            score.goals,
            score.rot_dist,
            100.0 * score.drop_rate
        ));
        Ok(Some(score))
    }

    fn report(&mut self, report: &mut Report, iteration: &Iteration) {
        if self.dump_diverged {
            self.dump_diverged(report);
        }
        let Iteration { update, evaluation, collect_s, update_s } = iteration;
        let episodes = Score::of(&self.pool.take_finished());
        let mut recent = Recent::default();
        for env in self.pool.envs_mut() {
            recent += env.take_recent();
        }
        let evaluation = evaluation.unwrap_or_else(|| Score::of(&[]));
        let steps_per_s = self.config.steps_per_iteration() as f64 / (collect_s + update_s);
        let mut values = vec![
            episodes.episode_return,
            episodes.length,
            episodes.goals,
            episodes.in_tolerance,
            episodes.drop_rate,
            episodes.rot_dist,
            episodes.steps_per_goal,
        ];
        values.extend(recent.reward.values().map(|sum| sum / recent.steps as f64));
        values.extend([evaluation.goals, evaluation.drop_rate, evaluation.rot_dist, evaluation.episode_return]);
        values.extend([update.policy_loss, update.value_loss]);
        values.extend([update.entropy, update.kl, update.first_kl, update.clip_fraction, update.std]);
        values.extend([update.explained_variance, update.learning_rate, update.grad_norm]);
        values.extend([*collect_s, *update_s, steps_per_s, recent.diverged as f64]);
        assert_eq!(values.len(), TAGS.len(), "one value for each tag");
        let tagged: Vec<(&str, f64)> = TAGS.into_iter().zip(values).collect();
        let Progress { iteration, env_steps, .. } = self.progress;
        let status = Status { env_steps, steps_per_s, goals: episodes.goals, drop_rate: episodes.drop_rate };
        report.iteration(iteration, &tagged, &status);
    }
}

/// Makes the run independent of the folder that it was begun in.
fn settle_model(config: &mut Config) -> Result<()> {
    if let Some(model) = config.env.model_file() {
        let model = model.canonicalize().with_context(|| format!("{MODEL}: cannot find {}", model.display()))?;
        config.env.model = model.display().to_string();
    }
    Ok(())
}

/// Whether an evaluation (goals per episode, rotation error in rad) is the best so far: more goals, then less error.
fn is_better(found: [f64; 2], best: Option<[f64; 2]>) -> bool {
    let rank = |[goals, rot_dist]: [f64; 2]| (goals, -rot_dist);
    // Where every episode diverged at once there is no rotation error to speak of.
    found.iter().all(|x| x.is_finite()) && best.is_none_or(|best| rank(found) > rank(best))
}

/// The user's file of settings, if one was named.
///
/// # Errors
/// A file that cannot be read.
pub fn user_file(settings: &Settings) -> Result<Option<Source>> {
    let read = |path: &PathBuf| Ok(Source { path: path.clone(), text: run::read_text(path)? });
    settings.config.as_ref().map(read).transpose()
}

/// The settings that have options of their own.
fn asked(args: &TrainArgs) -> Vec<Override> {
    let options = [
        ("run.seed", args.seed),
        ("run.threads", args.threads.map(|n| n as u64)),
        ("run.total_steps", args.total_steps),
    ];
    let given = options.into_iter().filter_map(|(key, value)| Some((key, value?)));
    given.map(|(key, value)| Override { key: key.into(), value: value.to_string() }).collect()
}

/// What a run folder says about the program that made it.
fn version() -> String {
    format!(
        "shadow-repose {}\ncommit {}\nmujoco {}\n{}\ntarget {}\n",
        env!("CARGO_PKG_VERSION"),
        env!("SHADOW_REPOSE_COMMIT"),
        crate::sim::mujoco_version(),
        env!("SHADOW_REPOSE_RUSTC"),
        env!("SHADOW_REPOSE_TARGET"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

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
