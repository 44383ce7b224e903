//! A training run that is set up: its environments, learner and saver.

use std::sync::Arc;

use anyhow::{Context, Result};

use super::duties::Lead;
use super::saver::Saver;
use super::start::{Plan, Takes};
use crate::agent::Agent;
use crate::cli::TrainArgs;
use crate::config::{Config, Source};
use crate::evaluate::expect_finite;
use crate::os::{self, say};
use crate::ppo::{Checkpoint, Rise};
use crate::ranks::Exchange;
use crate::repose::{Record, Repose, Task};
use crate::run::{self, RunFolder};
use crate::sim;

/// Everything that a training run owns, except its saver.
pub struct Session {
    /// The settings of the run.
    pub config: Config,
    /// The task that is trained.
    pub task: Arc<Task>,
    /// The environments and the learner.
    pub agent: Agent<Repose>,
    /// The best evaluation so far.
    pub best: Option<[f64; 2]>,
    /// How far evaluations have risen, if the run ends when they no longer do.
    pub rise: Option<Rise>,
    /// Whether the steps that led to them are written.
    pub dumps: bool,
    /// The fingerprint of the scene.
    pub scene: String,
    /// The hand and the object of the policy.
    pub hand: Record,
    /// What the first rank does besides computing.
    pub lead: Option<Lead>,
}

impl Session {
    /// Sets up the requested training and its saver.
    ///
    /// # Errors
    /// Fails as [`Plan::of`] and [`Session::new`] do, or if the run folder cannot be created.
    pub fn lead(args: &TrainArgs, exchange: &Exchange) -> Result<(Self, Saver)> {
        if let (Some(folder), Some(init)) = (&args.run_dir, &args.init) {
            run::expect_other_policy(folder, init)?;
        }
        let mut plan = Plan::of(args)?;
        let existing = plan.existing.take();
        let session = Self::set_up(plan, exchange)?;
        // A new folder is created last, so that a training run that cannot be set up leaves none behind.
        let place = match existing {
            Some(existing) => existing,
            None => RunFolder::create(args.run_dir.as_deref(), args.name.as_deref())?,
        };
        let saver = Saver::new(place, args, &session.config, session.checkpoint());
        Ok((session, saver))
    }

    /// Sets up the training run that the first rank has planned.
    ///
    /// # Errors
    /// Fails as [`Plan::receive`] and [`Session::new`] do.
    pub fn follow(exchange: &Exchange) -> Result<Self> {
        sim::before_fatal_error(|said| say!("error: {said}"));
        let session = Self::set_up(Plan::receive(exchange)?, exchange)?;
        // Together with the state that the saver begins with.
        session.checkpoint();
        Ok(session)
    }

    /// Sets up what is planned, on all ranks together.
    fn set_up(mut plan: Plan, exchange: &Exchange) -> Result<Self> {
        let exchange = exchange.clone().over(plan.config.shards())?;
        let threads = plan.config.run.threads;
        os::start_threads(threads)?;
        let context = plan.context.clone();
        let set_up = || {
            let loaded = plan.load_task()?;
            if exchange.is_first() {
                plan.send(&exchange)?;
            }
            Self::new(plan, loaded, exchange)
        };
        let session = match context {
            Some(context) => set_up().context(context),
            None => set_up(),
        }?;
        let exchange = &session.agent.exchange;
        if let Some(warning) = exchange.expect_alike(&session.scene)?
            && exchange.is_first()
            && threads == 0
        {
            say!("warning: {warning}");
        }
        Ok(session)
    }

    /// Sets up the planned training of a task by a policy with this record.
    ///
    /// # Errors
    /// Fails if the precision cannot be used, or if it cannot start from what is planned.
    pub fn new(plan: Plan, (task, hand): (Arc<Task>, Record), exchange: Exchange) -> Result<Self> {
        let Plan {
            mut config,
            from,
            best,
            dumps,
            ..
        } = plan;
        // As it is saved.
        config.run.shards = config.shards();
        let agent = Agent::for_task(&task, &config, exchange)?;
        let mut session = Self {
            scene: task.scene.fingerprint(),
            hand,
            config,
            task,
            agent,
            best,
            rise: None,
            dumps,
            lead: None,
        };
        if let Some((takes, checkpoint)) = from {
            session.start(takes, checkpoint)?;
        }
        Ok(session)
    }

    /// Starts from the policy or the state in a checkpoint.
    fn start(&mut self, takes: Takes, mut checkpoint: Checkpoint) -> Result<()> {
        let agent = &mut self.agent;
        if let Takes::Policy = takes {
            agent.ppo.begin_with(&checkpoint)?;
            return expect_finite(&self.task, &agent.ppo.policy, true);
        }
        agent.restore(&mut checkpoint)?;
        if let Takes::Fork = takes {
            let parent = Source::new("the checkpoint", &*checkpoint.config).resolve()?;
            agent.ppo.reconcile_learning_rate(&parent.ppo);
            return checkpoint.finish();
        }
        self.rise = checkpoint.progress.rise;
        if checkpoint.scene != self.scene && agent.exchange.is_first() {
            say!(
                "warning: the scene differs from the checkpoint's scene: the resumed run is a different training"
            );
        }
        checkpoint.finish()
    }

    /// The complete state at the end of the last iteration.
    pub fn checkpoint(&self) -> Checkpoint {
        let mut checkpoint = Checkpoint::default();
        self.agent.save(&mut checkpoint);
        checkpoint.progress.best = self.best;
        checkpoint.progress.rise = self.rise;
        checkpoint.config = self.config.to_text();
        checkpoint.scene = self.scene.clone();
        checkpoint.hand = self.hand.to_text();
        checkpoint
    }

    /// Whether all steps are made, or evaluations no longer rise.
    pub fn finished(&self) -> bool {
        self.agent.env_steps >= self.config.run.total_steps || self.is_flat()
    }

    /// Whether the run ends because evaluations no longer rise.
    pub fn is_flat(&self) -> bool {
        self.rise
            .is_some_and(|rise| rise.since >= self.config.run.patience)
    }
}
