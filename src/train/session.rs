//! A training that is set up: its environments and learner, on every rank; its saver, on the first.

use std::sync::Arc;

use anyhow::{Context, Result, ensure};

use super::films::Films;
use super::plan::{Plan, Start};
use super::saver::{Begin, Saver};
use crate::agent::Agent;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::load::MODEL;
use crate::os::{self, Locked};
use crate::ppo::{Array, Checkpoint, Evaluation};
use crate::ranks::{Division, Ranks};
use crate::repose::{Repose, Task};
use crate::run::RunFolder;

/// The name under which a checkpoint stores the fingerprint of its environments' scene.
pub(super) const SCENE: &str = "scene";

/// Everything that a training owns, except its saver.
pub(super) struct Session {
    /// The settings of the run.
    pub config: Config,
    /// The task that is trained.
    pub task: Arc<Task>,
    /// The environments and the learner.
    pub agent: Agent<Repose>,
    /// The best evaluation so far; only the first rank knows it.
    pub best: Option<Evaluation>,
    /// Whether the last iteration had the best evaluation so far.
    pub improved: bool,
    /// The films of evaluation episodes, on the first rank.
    pub films: Films,
    /// The number of steps of this session on which the physics diverged.
    pub diverged: u64,
    /// Whether the warning about them was printed.
    pub warned: bool,
    /// Whether the steps that led to them are written.
    pub dumps: bool,
    /// The fingerprint of the scene.
    pub scene: u64,
}

impl Session {
    /// Sets up the requested training and its saver, on the first rank.
    ///
    /// # Errors
    /// Fails as [`Plan::begin`], [`Plan::resume`], [`Plan::fork`] and [`Session::set_up`] do, or if the run folder cannot be
    /// created.
    pub(super) fn lead(args: &TrainArgs, ranks: &Arc<dyn Ranks>) -> Result<(Self, Saver)> {
        let (plan, existing) = match (&args.resume, &args.fork) {
            (Some(place), _) => Plan::resume(place.as_deref(), args).map(|(plan, existing)| (plan, Some(existing)))?,
            (None, Some(place)) => (Plan::fork(place, args)?, None),
            (None, None) => (Plan::begin(args)?, None),
        };
        plan.expect_ranks(ranks.size())?;
        plan.send(&**ranks)?;
        let mut session = Self::set_up(plan, ranks.clone())?;
        if let Some(warning) = session.expect_alike()? {
            os::say(&format!("warning: {warning}"));
        }
        // A new folder is created last, so that a training that cannot be set up leaves none behind.
        let (folder, lock, begin) = match existing {
            Some(existing) => {
                session.best = existing.best;
                (existing.folder, existing.lock, existing.begin)
            }
            None => {
                let (folder, lock) = RunFolder::create(args.run_dir.as_deref(), args.name.as_deref())?;
                (folder, lock, Begin::New)
            }
        };
        let saver = session.saver(folder, lock, args, begin);
        Ok((session, saver))
    }

    /// Sets up the training that the first rank has planned, on another rank.
    ///
    /// # Errors
    /// Fails as [`Session::set_up`] and [`Session::expect_alike`] do.
    pub(super) fn follow(ranks: &Arc<dyn Ranks>) -> Result<Self> {
        let session = Self::set_up(Plan::receive(&**ranks)?, ranks.clone())?;
        session.expect_alike().map(|_| session)
    }

    fn set_up(plan: Plan, ranks: Arc<dyn Ranks>) -> Result<Self> {
        os::start_threads(plan.config.run.threads)?;
        Self::of(plan, ranks)
    }

    /// Creates a new training of one rank at its beginning.
    ///
    /// # Errors
    /// Fails if the scene or the precision cannot be used.
    #[cfg(test)]
    pub(super) fn new(config: Config) -> Result<Self> {
        Self::of(Plan::new(config, &TrainArgs::default()), Arc::new(crate::ranks::Alone))
    }

    fn of(plan: Plan, ranks: Arc<dyn Ranks>) -> Result<Self> {
        let fork = matches!(plan.start, Start::Fork(..)).then(|| plan.context.clone());
        let session = Self::created(plan, ranks);
        if let Some(context) = fork { session.context(context) } else { session }
    }

    fn created(plan: Plan, ranks: Arc<dyn Ranks>) -> Result<Self> {
        let Plan { mut config, start, context, dumps } = plan;
        // The saved configuration contains the actual number of shards.
        config.run.shards = config.shards();
        let first = ranks.rank() == 0;
        let task = Task::new(&config.env)?;
        let agent = Agent::divided(&task, &config, Division::new(config.run.shards, ranks))?;
        let scene = task.scene().fingerprint()?;
        let films = if first { Films::new(&config) } else { Films::none() };
        let (best, improved, diverged, warned) = (None, false, 0, false);
        let mut session = Self { config, task, agent, best, improved, films, diverged, warned, dumps, scene };
        let forks = matches!(start, Start::Fork(..));
        let started = session.start(start, first);
        if forks {
            started?
        } else {
            started.context(context)?
        }
        Ok(session)
    }

    /// Starts from the policy or the state in a checkpoint.
    fn start(&mut self, start: Start, first: bool) -> Result<()> {
        let agent = &mut self.agent;
        match start {
            Start::Nothing => {}
            Start::Policy(checkpoint) => agent.ppo.begin_with(&checkpoint)?,
            Start::State(mut checkpoint) => {
                let restored = agent.restore(&mut checkpoint).and_then(|()| checkpoint.take_counters(SCENE));
                if restored? != [self.scene] && first {
                    os::say(
                        "warning: the scene is not the one of the checkpoint: the resumed run is a different training",
                    );
                }
                checkpoint.finish()?;
            }
            Start::Fork(mut checkpoint, parent) => {
                agent.restore(&mut checkpoint)?;
                checkpoint.finish()?;
                agent.ppo.settle_learning_rate(&parent.ppo);
            }
        }
        Ok(())
    }

    /// Returns the complete state at the end of the last iteration. All ranks call it together; only the first can use it.
    pub(super) fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = self.agent.checkpoint(&self.config.to_text(), self.best);
        checkpoint.insert(SCENE, Array::U64(vec![1], vec![self.scene]));
        checkpoint
    }

    /// Returns whether all steps are made.
    pub(super) fn finished(&self) -> bool {
        self.agent.env_steps >= self.config.run.total_steps
    }

    /// Returns the saver of this training for `folder`.
    pub(super) fn saver(&self, folder: RunFolder, lock: Locked, args: &TrainArgs, begin: Begin) -> Saver {
        let model = self.config.env.model_file().map(|model| os::quoted(&format!("{MODEL}={}", model.display())));
        let model = model.map_or(String::new(), |set| format!(" --set {set}"));
        let options = format!("{model}{}", if args.dump_diverged { " --dump-diverged" } else { "" });
        Saver::new((folder, lock), args.keep, options, self.checkpoint(), begin)
    }
}

impl Plan {
    /// Checks that the training can be divided among this number of ranks.
    fn expect_ranks(&self, ranks: usize) -> Result<()> {
        let shards = self.config.shards();
        ensure!(ranks.is_power_of_two(), "{ranks} ranks: their number must be a power of two");
        ensure!(
            ranks <= shards,
            "{ranks} ranks, but the training has {shards} shards (run.shards), and a rank computes at least one of them"
        );
        Ok(())
    }
}
