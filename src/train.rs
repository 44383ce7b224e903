//! Training, from top to bottom: collect, learn, evaluate, report, checkpoint.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Result};

use crate::cli::{Settings, TrainArgs};
use crate::collect::{Scratch, collect};
use crate::config::{Config, Override, Source};
use crate::env::{EnvPool, Recent, Repose, Score, Task};
use crate::evaluate::{Actor, Episodes, evaluate};
use crate::ppo::{Checkpoint, Ppo, Progress, Rollout, UpdateStats};
use crate::run::{self, Report, RunFolder, Status};

/// How a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All its steps are made.
    Finished,
    /// It was asked to stop, and has saved.
    Interrupted,
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

/// Trains as asked, until all steps are made or `interrupted` is set.
///
/// # Errors
/// Settings, files or a scene that cannot be used; a run folder that cannot be written to; a loss that is not finite.
pub fn train(args: &TrainArgs, interrupted: &AtomicBool) -> Result<Outcome> {
    let mut session = match &args.resume {
        Some(place) => Session::resume(place, args)?,
        None => Session::begin(args)?,
    };
    if session.finished() {
        run::say(&format!("{} is finished: {}", session.folder.path().display(), session.steps_made()));
        return Ok(Outcome::Finished);
    }
    run::say(&format!("run folder: {}", session.folder.path().display()));
    let mut report = session.open_report()?;
    if session.progress.iteration == 0 {
        // So that a run that dies before its first checkpoint can be resumed like any other.
        session.checkpoint(&session.folder.latest())?;
    }
    session.start_episodes();

    while !session.finished() {
        let started = Instant::now();
        let iteration = session.progress.iteration + 1;
        if !session.collect(iteration, interrupted)? {
            return session.stop(&report);
        }
        let collected = Instant::now();
        let update = session.ppo.update(&mut session.rollout, iteration)?;
        session.rollout.carry_over();
        let updated = Instant::now();
        session.progress.iteration = iteration;
        session.progress.env_steps += session.config.steps_per_iteration();
        session.progress.next_episode = session.pool.next_episode();

        let mut evaluation = None;
        if session.finished() {
            // The last evaluation cannot be made up for by resuming, so it is not broken off.
            evaluation = session.evaluate(&AtomicBool::new(false), &report)?;
        } else if iteration.is_multiple_of(session.config.run.eval_every) {
            evaluation = session.evaluate(interrupted, &report)?;
        }
        let seconds = [collected - started, updated - collected].map(|time| time.as_secs_f64());
        session.report(&mut report, &update, evaluation, seconds);
        if iteration.is_multiple_of(session.config.run.checkpoint_every) || session.finished() {
            session.checkpoint(&session.folder.latest())?;
        }
    }
    report.finish();
    run::say(&format!("finished: {}; {}", session.steps_made(), session.folder.path().display()));
    Ok(Outcome::Finished)
}

/// All that a training owns.
struct Session {
    config: Config,
    folder: RunFolder,
    task: Arc<Task>,
    pool: EnvPool<Repose>,
    ppo: Ppo,
    rollout: Rollout,
    scratch: Scratch,
    progress: Progress,
}

impl Session {
    fn begin(args: &TrainArgs) -> Result<Self> {
        let mut overrides = args.settings.set.clone();
        overrides.extend(asked(args));
        let mut config = Config::resolve(user_file(&args.settings)?.as_ref(), &overrides)?;
        if let Some(model) = config.env.model_file() {
            // The run can be played from any folder.
            let model = model.canonicalize().with_context(|| format!("env.model: cannot find {}", model.display()))?;
            config.env.model = model.display().to_string();
        }
        run::start_threads(config.run.threads)?;
        let task = Task::new(&config.env)?;
        let folder = || RunFolder::create(args.run_dir.as_deref(), args.name.as_deref());
        Self::new(config, folder, task, Progress::default())
    }

    fn resume(place: &Path, args: &TrainArgs) -> Result<Self> {
        let folder = RunFolder::containing(place)?;
        let path = if place.is_dir() { folder.latest() } else { place.to_owned() };
        let context = || format!("cannot resume from {}", path.display());
        let checkpoint = Checkpoint::parse(&run::read_bytes(&path)?).with_context(context)?;
        let config = Config::from_text(&path, &checkpoint.config, &asked(args))?;
        run::start_threads(config.run.threads)?;
        let task = Task::new(&config.env)?;
        let mut session = Self::new(config, || Ok(folder), task, checkpoint.progress)?;
        session.ppo.restore(checkpoint).with_context(context)?;
        session.remember_best();
        Ok(session)
    }

    /// The folder comes last: it is not touched by a training that cannot be set up.
    fn new(
        config: Config,
        folder: impl FnOnce() -> Result<RunFolder>,
        task: Arc<Task>,
        progress: Progress,
    ) -> Result<Self> {
        let envs = (0..config.env.num_envs).map(|_| Repose::new(&task)).collect();
        let pool = EnvPool::new(config.run.seed, envs);
        let ppo = Ppo::new(&config.ppo, pool.observation_size(), pool.action_size(), config.run.seed)?;
        let rollout = ppo.rollout(&pool.block_sizes());
        let scratch = Scratch::new(&pool, &ppo);
        Ok(Self { config, folder: folder()?, task, pool, ppo, rollout, scratch, progress })
    }

    /// The best policy of the folder may have been saved after the checkpoint that is resumed from; it is not given up for a
    /// worse one.
    fn remember_best(&mut self) {
        let saved = run::read_bytes(&self.folder.best()).and_then(|bytes| Checkpoint::parse(&bytes));
        if let Some(best) = saved.ok().and_then(|checkpoint| checkpoint.progress.best)
            && is_better(best, self.progress.best)
        {
            self.progress.best = Some(best);
        }
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

    fn start_episodes(&mut self) {
        self.pool.reset(self.progress.next_episode, self.rollout.first_observations_mut());
    }

    fn collect(&mut self, iteration: u64, interrupted: &AtomicBool) -> Result<bool> {
        collect(&mut self.pool, &self.ppo, &mut self.rollout, iteration, &mut self.scratch, interrupted)
    }

    /// Saves the state at the end of the last iteration.
    fn stop(&self, report: &Report) -> Result<Outcome> {
        report.finish();
        let path = self.folder.latest();
        self.checkpoint(&path)?;
        run::say(&format!("interrupted after {}; go on with", self.steps_made()));
        run::say(&format!("  shadow-repose train --resume {}", self.folder.path().display()));
        Ok(Outcome::Interrupted)
    }

    fn checkpoint(&self, path: &Path) -> Result<()> {
        run::write_whole(path, &self.ppo.save(&self.config.to_text(), &self.progress)?)
    }

    /// Plays the evaluation episodes, and saves the policy if it is the best so far.
    fn evaluate(&mut self, interrupted: &AtomicBool, report: &Report) -> Result<Option<Score>> {
        let (seed, count) = (self.config.run.seed, self.config.run.eval_episodes);
        let episodes = Episodes { seed, purpose: "evaluation", first: 0, count };
        let actor = Actor::Mean(self.ppo.policy().freeze()?);
        let Some(played) = evaluate(&self.task, &actor, episodes, interrupted, &mut |_| Ok(()))? else {
            return Ok(None);
        };
        let score = Score::of(&played);
        report.say(&format!(
            "{} steps: evaluation of {} episodes: {:.3} goals/episode, rotation error {:.2} rad, drops {:.0} %",
            self.progress.env_steps,
            score.episodes,
            score.goals,
            score.rot_dist,
            100.0 * score.drop_rate
        ));
        let found = [score.goals, score.rot_dist];
        if is_better(found, self.progress.best) {
            self.progress.best = Some(found);
            self.checkpoint(&self.folder.best())?;
        }
        Ok(Some(score))
    }

    fn report(&mut self, report: &mut Report, update: &UpdateStats, evaluation: Option<Score>, seconds: [f64; 2]) {
        let episodes = Score::of(&self.pool.take_finished());
        let mut recent = Recent::default();
        for env in self.pool.envs_mut() {
            recent += env.take_recent();
        }
        let evaluation = evaluation.unwrap_or_else(|| Score::of(&[]));
        let [collect_s, update_s] = seconds;
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
        values.extend([collect_s, update_s, steps_per_s, recent.diverged as f64]);
        assert_eq!(values.len(), TAGS.len(), "one value for each tag");
        let tagged: Vec<(&str, f64)> = TAGS.into_iter().zip(values).collect();
        let Progress { iteration, env_steps, .. } = self.progress;
        let status = Status { env_steps, steps_per_s, goals: episodes.goals, drop_rate: episodes.drop_rate };
        report.iteration(iteration, &tagged, &status);
    }
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
