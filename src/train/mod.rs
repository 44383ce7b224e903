//! Training, from top to bottom: collect, learn, evaluate, report, checkpoint.

mod saving;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Error, Result, anyhow, bail, ensure};

use crate::cli::{Settings, TrainArgs};
use crate::collect::{Scratch, collect};
use crate::config::{Config, Override, Source};
use crate::env::{EnvPool, Lesson, Recent, Repose, Score, Task, panic_message};
use crate::evaluate::{Actor, Episodes, evaluate};
use crate::load::MODEL;
use crate::perception::perception;
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
const TAGS: [&str; 40] = [
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
    "training/progress",
    "training/within",
    "training/goal",
    "training/drop",
    "training/tolerance",
    "training/hold",
    "training/goal_angle",
    "training/task_reward",
    "training/drop_reward",
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
    "policy/excess",
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
        requests.stop_after(limit)?;
    }
    run::say(&format!("run folder: {}", session.folder.path().display()));
    // The end of the last iteration: what is saved if the next one does not come to its own.
    let mut end = Arc::new(session.checkpoint()?);
    session.save_before_fatal_errors(&end);
    if !session.is_newest {
        // Before anything else: whatever happens then, it can be resumed, and nothing that is in the logs is newer.
        session.write_to(&session.folder, &end)?;
    }
    let mut report = session.open_report()?;
    while !session.finished() {
        match session.iterate(requests.stop(), &mut report) {
            Ok(true) => {}
            Ok(false) => return session.stop(&end, &mut report, requests),
            Err(error) => return Err(session.give_up(error, &end, &mut report)),
        }
        let known = end.progress.best;
        end = Arc::new(session.checkpoint()?);
        if end.progress.best != known {
            (session.best, session.best_is_saved) = (Some(end.clone()), false);
        }
        session.save_before_fatal_errors(&end);
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

/// What is reported of an iteration.
struct Iteration {
    lesson: Lesson,
    update: UpdateStats,
    evaluation: Option<Score>,
    collect_s: f64,
    update_s: f64,
}

/// All that a training owns.
struct Session {
    config: Config,
    folder: RunFolder,
    lock: Arc<Locked>,
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
    /// The newest checkpoint of the folder is where the session is.
    is_newest: bool,
    /// The checkpoint of the best evaluation, if this session has found it.
    best: Option<Arc<Checkpoint>>,
    best_is_saved: bool,
}

impl Session {
    fn begin(args: &TrainArgs) -> Result<Self> {
        let mut overrides = args.settings.set.clone();
        overrides.extend(asked(args));
        let mut config = Config::resolve(user_file(&args.settings)?.as_ref(), &overrides)?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        let folder = || RunFolder::create(args.run_dir.as_deref(), args.name.as_deref());
        let init = args.init.as_deref().map(|place| saving::policy_to_begin_with(place, &config)).transpose()?;
        let mut session = Self::new(config, folder, args)?;
        if let Some(policy) = init {
            session.ppo.begin_with(&policy)?;
        }
        let lesson = session.lesson();
        session.pool.envs_mut().for_each(|env| env.set_lesson(lesson));
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
        let checkpoints = folder.checkpoints();
        ensure!(!checkpoints.newest_first().is_empty(), "{} holds no checkpoint", place.display());
        let lock = folder.lock()?;
        let newest = checkpoints.newest_first();
        let mut overrides = args.settings.set.clone();
        overrides.extend(asked(args));
        let places = if place.is_dir() { newest.clone() } else { vec![place.to_owned()] };
        let (path, checkpoint, mut config) =
            saving::first_sound(&places, &overrides).with_context(|| format!("cannot resume {}", place.display()))?;
        let context = || format!("cannot resume from {}", path.display());
        saving::expect_states(&checkpoint, &config).with_context(context)?;
        settle_model(&mut config)?;
        run::start_threads(config.run.threads)?;
        let mut session = Self::new(config, || Ok((folder, lock)), args)?;
        session.restore(checkpoint).with_context(context)?;
        session.is_newest = run::same_file(&path, &newest[0]);
        Ok(session)
    }

    /// The folder comes last: it is not touched by a training that cannot be set up.
    fn new(config: Config, folder: impl FnOnce() -> Result<(RunFolder, Locked)>, args: &TrainArgs) -> Result<Self> {
        let task = Task::new(&config.env)?;
        let envs = (0..config.env.num_envs).map(|_| Repose::new(&task)).collect();
        let mut pool = EnvPool::new(config.run.seed, envs);
        pool.perceive_with(perception(config.ppo.symmetry));
        let ppo = Ppo::new(&config.ppo, pool.observation_size(), pool.action_size(), config.run.seed)?;
        let rollout = ppo.rollout(&pool.block_sizes());
        let scratch = Scratch::new(&pool, &ppo);
        let (folder, lock) = folder()?;
        // The newest, and one in case it is damaged.
        let keep = args.keep.unwrap_or_else(|| folder.checkpoints().count().max(2));
        Ok(Self {
            config,
            folder,
            lock: Arc::new(lock),
            keep,
            dump_diverged: args.dump_diverged,
            scene: task.scene().fingerprint()?,
            task,
            pool,
            ppo,
            rollout,
            scratch,
            progress: Progress::default(),
            is_newest: false,
            best: None,
            best_is_saved: true,
        })
    }

    /// What is trained in the iteration that comes next.
    fn lesson(&self) -> Lesson {
        Lesson::at(self.progress.env_steps, &self.config.training, &self.config.env)
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

    /// One iteration, whatever happens in it; false if `stop` was set meanwhile. Where it does not come to its end, the session
    /// is good for nothing but saving the end of the one before.
    fn iterate(&mut self, stop: &AtomicBool, report: &mut Report) -> Result<bool> {
        let iteration = self.progress.iteration + 1;
        let caught = catch_unwind(AssertUnwindSafe(|| self.collect_learn_evaluate(iteration, stop, report)));
        let result = caught.unwrap_or_else(|panic| Err(anyhow!("panic: {}", panic_message(&*panic))));
        result.with_context(|| format!("iteration {iteration}"))
    }

    fn collect_learn_evaluate(&mut self, iteration: u64, stop: &AtomicBool, report: &mut Report) -> Result<bool> {
        let started = Instant::now();
        let lesson = self.lesson();
        self.pool.envs_mut().for_each(|env| env.set_lesson(lesson));
        self.ppo.limit_std(self.progress.env_steps)?;
        if !collect(&mut self.pool, &self.ppo, &mut self.rollout, iteration, &mut self.scratch, stop)? {
            return Ok(false);
        }
        let collected = Instant::now();
        let Some(update) = self.ppo.update(&mut self.rollout, iteration, stop)? else { return Ok(false) };
        self.rollout.carry_over();
        let [collect_s, update_s] = [collected - started, collected.elapsed()].map(|time| time.as_secs_f64());
        let env_steps = self.progress.env_steps + self.config.steps_per_iteration();
        let mut evaluation = None;
        if iteration.is_multiple_of(self.config.run.eval_every) {
            evaluation = self.evaluate(env_steps, stop, report)?;
            if evaluation.is_none() {
                return Ok(false);
            }
        }
        let known = self.progress.best;
        let found = evaluation.map(|score| [score.goals, score.rot_dist]);
        let best = found.filter(|&found| is_better(found, known)).or(known);
        self.progress = Progress { iteration, env_steps, best };
        self.report(report, &Iteration { lesson, update, evaluation, collect_s, update_s });
        Ok(true)
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
        let Iteration { lesson, update, evaluation, collect_s, update_s } = iteration;
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
        values.extend(recent.shaping.values().map(|sum| sum / recent.steps as f64));
        values.extend([lesson.tolerance, f64::from(lesson.hold), lesson.goal_angle]);
        values.extend([lesson.task_reward, lesson.drop_reward]);
        values.extend([evaluation.goals, evaluation.drop_rate, evaluation.rot_dist, evaluation.episode_return]);
        values.extend([update.policy_loss, update.value_loss]);
        values.extend([update.entropy, update.kl, update.first_kl, update.clip_fraction, update.std, update.excess]);
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
    fn a_panic_on_a_worker_thread_is_an_error_and_the_iteration_before_is_saved() {
        let place = tempfile::tempdir().unwrap();
        let sets = ["env.num_envs=9", "ppo.horizon=4", "ppo.hidden=[8]", "run.eval_every=1000"];
        let sets: Vec<Override> = sets.map(|set| set.parse().unwrap()).into();
        let config = Config::resolve(None, &sets).unwrap();
        let args = TrainArgs::default();
        let mut session = Session::new(config, || RunFolder::create(Some(place.path()), None), &args).unwrap();
        session.pool.reset(session.rollout.first_observations_mut());
        let (mut report, never) = (session.open_report().unwrap(), AtomicBool::new(false));
        assert!(session.iterate(&never, &mut report).unwrap(), "nothing stops it");
        let end = session.checkpoint().unwrap();
        // Room for fewer environments than there are.
        session.rollout = session.ppo.rollout(&[7, 1]);
        let error = session.iterate(&never, &mut report).unwrap_err();
        let error = format!("{:#}", session.give_up(error, &end, &mut report));
        assert!(error.contains("iteration 2: panic: "), "{error}");
        let saved = run::read_bytes(&session.folder.checkpoints().latest()).unwrap();
        assert_eq!(Checkpoint::parse(&saved).unwrap().progress.iteration, 1);
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
