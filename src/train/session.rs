//! A training that is set up: its environments, learner and saver.

use std::sync::Arc;

use anyhow::{Context, Result};

#[cfg(feature = "video")]
use super::films::Films;
use super::saver::Saver;
use super::start::{Existing, Plan, StartFrom};
use crate::agent::Agent;
use crate::cli::TrainArgs;
use crate::config::Config;
use crate::load::MODEL;
use crate::os::{self, Locked};
use crate::ppo::{Checkpoint, Evaluation};
use crate::ranks::Exchange;
use crate::repose::{Repose, Task};
use crate::run::RunFolder;

/// Everything that a training owns, except its saver.
pub(super) struct Session {
    /// The settings of the run.
    pub config: Config,
    /// The task that is trained.
    pub task: Arc<Task>,
    /// The environments and the learner.
    pub agent: Agent<Repose>,
    /// The best evaluation so far.
    pub best: Option<Evaluation>,
    /// The films of evaluation episodes.
    #[cfg(feature = "video")]
    pub films: Films,
    /// The number of steps of this session on which the physics diverged.
    pub diverged: u64,
    /// Whether the warning about them was printed.
    pub warned: bool,
    /// Whether the steps that led to them are written.
    pub dumps: bool,
    /// The fingerprint of the scene.
    pub scene: String,
}

impl Session {
    /// Sets up the requested training and its saver.
    ///
    /// # Errors
    /// Fails as [`Plan::new_run`], [`Plan::resume`], [`Plan::fork`] and [`Session::new`] do, or if the run folder cannot be
    /// created.
    pub(super) fn lead(args: &TrainArgs, exchange: &Exchange) -> Result<(Self, Saver)> {
        let (plan, existing) = match (&args.resume, &args.fork) {
            (Some(place), _) => Plan::resume(place.as_deref(), args).map(|(plan, existing)| (plan, Some(existing)))?,
            (None, Some(place)) => (Plan::fork(place, args)?, None),
            (None, None) => (Plan::new_run(args)?, None),
        };
        let exchange = exchange.clone().over(plan.config.shards())?;
        Plan::broadcast(Some(&plan), &exchange)?;
        let threads = plan.config.run.threads;
        os::start_threads(threads)?;
        let mut session = Self::new(plan, exchange)?;
        if let Some(warning) = session.agent.exchange.expect_alike(&session.scene)?.filter(|_| threads == 0) {
            os::say(&format!("warning: {warning}"));
        }
        // A new folder is created last, so that a training that cannot be set up leaves none behind.
        let (place, from_newest) = match existing {
            Some(Existing { folder, lock, from_newest, best }) => {
                session.best = best;
                ((folder, lock), from_newest)
            }
            None => (RunFolder::create(args.run_dir.as_deref(), args.name.as_deref())?, false),
        };
        let saver = session.saver(place, args, from_newest);
        Ok((session, saver))
    }

    /// Sets up the planned training.
    ///
    /// # Errors
    /// Fails if the scene or the precision cannot be used, or if it cannot start from what is planned.
    pub(super) fn new(plan: Plan, exchange: Exchange) -> Result<Self> {
        let Plan { mut config, from, context, dumps } = plan;
        let set_up = || {
            // As it is saved.
            config.run.shards = config.shards();
            let task = Task::new(&config.env)?;
            #[cfg(feature = "video")]
            let films = if exchange.is_first() { Films::new(&config) } else { Films::none() };
            #[cfg(not(feature = "video"))]
            if config.run.film_every > 0 {
                os::say(&format!("warning: run.film_every: no films in this session: {}", crate::see::NO_FILMS));
            }
            let agent = Agent::for_task(&task, &config, exchange)?;
            let mut session = Self {
                scene: task.scene().fingerprint(),
                config,
                task,
                agent,
                best: None,
                #[cfg(feature = "video")]
                films,
                diverged: 0,
                warned: false,
                dumps,
            };
            session.start(from)?;
            Ok(session)
        };
        let session = set_up();
        if let Some(context) = context { session.context(context) } else { session }
    }

    /// Starts from the policy or the state in a checkpoint.
    fn start(&mut self, from: StartFrom) -> Result<()> {
        let agent = &mut self.agent;
        match from {
            StartFrom::Scratch => {}
            StartFrom::Policy(checkpoint) => agent.ppo.begin_with(&checkpoint)?,
            StartFrom::State(mut checkpoint) => {
                agent.restore(&mut checkpoint)?;
                if !checkpoint.is_of_scene(&self.scene) && agent.exchange.is_first() {
                    os::say(
                        "warning: the scene is not the one of the checkpoint: the resumed run is a different training",
                    );
                }
                checkpoint.finish()?;
            }
            StartFrom::Fork(mut checkpoint, parent) => {
                agent.restore(&mut checkpoint)?;
                checkpoint.finish()?;
                agent.ppo.reconcile_learning_rate(&parent.ppo);
            }
        }
        Ok(())
    }

    /// Returns the complete state at the end of the last iteration.
    pub(super) fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = self.agent.checkpoint(&self.config.to_text(), self.best);
        checkpoint.scene = Some(self.scene.clone());
        checkpoint
    }

    /// Returns whether all steps are made.
    pub(super) fn finished(&self) -> bool {
        self.agent.env_steps >= self.config.run.total_steps
    }

    /// Returns the saver of this training for a folder, whose newest checkpoint it may start from.
    pub(super) fn saver(&self, place: (RunFolder, Locked), args: &TrainArgs, from_newest: bool) -> Saver {
        let model = self.config.env.model_file().map(|model| os::quoted(&format!("{MODEL}={}", model.display())));
        let model = model.map_or(String::new(), |set| format!(" --set {set}"));
        let options = format!("{model}{}", if args.dump_diverged { " --dump-diverged" } else { "" });
        Saver::new(place, args.keep, options, self.checkpoint(), from_newest)
    }
}
