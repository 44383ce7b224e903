//! What the ranks of a training do together, besides computing: they agree on what follows an iteration, and the others follow
//! the first one.

use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use super::session::Session;
use super::start::Plan;
use crate::os::{self, Machine, Requests};
use crate::ranks::{self, Exchange};
use crate::sim;

/// What follows an iteration, the same on all ranks.
#[derive(Debug, Default)]
pub(super) struct Decision {
    /// Whether to save.
    pub save: bool,
    /// Whether all hand over their state. A single rank always does: it may be asked to stop in the middle of the next iteration.
    pub hand_over: bool,
    /// The exit code if the training is to stop here.
    pub stop: Option<ExitCode>,
    /// Whether the user has asked for that by a file.
    pub by_file: bool,
}

/// What a rank knows that the others must know to decide.
#[derive(Serialize, Deserialize)]
struct Vote {
    stop: bool,
    save: bool,
    improved: bool,
    signal: i32,
    weights: u32,
}

/// What must be the same on all ranks, and what one of them may be bound to.
#[derive(Serialize, Deserialize)]
struct Member {
    program: u32,
    scene: String,
    machine: Machine,
}

/// Trains as a rank that computes, and leaves reporting and saving to the first.
pub(super) fn follow(requests: &Requests, exchange: &Exchange) -> Result<ExitCode> {
    sim::before_fatal_error(|said| os::say(&format!("error: {said}")));
    let plan = Plan::broadcast(None, exchange)?.context("the first rank sends a plan")?;
    os::start_threads(plan.config.run.threads)?;
    let exchange = exchange.clone().over(plan.config.shards())?;
    let mut session = Session::new(plan, exchange)?;
    session.expect_alike()?;
    requests.wait_for_end();
    // The state that the first rank's saver begins with.
    session.checkpoint();
    while !session.finished() {
        let done = session.iterate(requests, None)?.context("the first rank stops between iterations")?;
        if done.decision.hand_over {
            session.checkpoint();
        }
        session.dumps();
        if let Some(code) = done.decision.stop.filter(|_| !session.finished()) {
            return Ok(code);
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// The most processors that a rank which is bound to one core may use: two, where a core runs two threads.
const ONE_CORE: usize = 2;

impl Session {
    /// Checks that this rank runs the same program on the same scene as the first one. Returns a warning, on all ranks, if a
    /// launcher has bound one to a single core of a machine with more.
    ///
    /// # Errors
    /// Fails if the program or the scene differs.
    pub(super) fn expect_alike(&self) -> Result<Option<String>> {
        let exchange = &self.agent.exchange;
        if exchange.is_alone() && !ranks::launched_by_mpirun() {
            return Ok(None);
        }
        let program = if exchange.is_alone() { 0 } else { os::program_checksum() };
        let all = exchange.all_gather(Member { program, scene: self.scene.clone(), machine: Machine::this() });
        for (rank, member) in all.iter().enumerate() {
            ensure!(member.program == all[0].program, "rank {rank} runs another program than rank 0");
            ensure!(member.scene == all[0].scene, "rank {rank} has another scene than rank 0");
        }
        let is_bound = |Machine { name, allowed, processors }: &Machine| {
            let here = all.iter().filter(|other| other.machine.name == *name).count();
            *allowed <= ONE_CORE && allowed * here < *processors
        };
        let bound = all.iter().position(|member| is_bound(&member.machine)).filter(|_| self.config.run.threads == 0);
        Ok(bound.map(|rank| {
            let Machine { allowed, processors, .. } = all[rank].machine;
            format!(
                "rank {rank} may use only {allowed} of the {processors} processors of its machine: start with mpirun --bind-to none, \
                 or --map-by ppr:1:node:PE={processors}, or srun --cpus-per-task"
            )
        }))
    }

    /// Agrees with the other ranks on what follows this iteration, and checks that all have the same weights. `by_file` says
    /// that the user has asked for a stop by a file; `improved`, that this iteration had the best evaluation so far.
    ///
    /// # Errors
    /// Fails if the weights differ.
    pub(super) fn decide(&self, requests: &Requests, by_file: bool, improved: bool) -> Result<Decision> {
        let exchange = &self.agent.exchange;
        // A single rank that is asked to stop does so at once, in the next iteration.
        let asked = !exchange.is_alone() && requests.stop().load(Ordering::Relaxed);
        let weights = if exchange.is_alone() { 0 } else { self.agent.ppo.checksum() };
        let signal = if asked { requests.signal() } else { 0 };
        let vote = Vote { stop: by_file || asked, save: requests.take_save(), improved, signal, weights };
        let votes = exchange.all_gather(vote);
        if let Some(rank) = votes.iter().position(|vote| vote.weights != votes[0].weights) {
            bail!(
                "the weights of rank {rank} differ from those of rank 0: one of the machines does not compute as it should"
            );
        }
        let any = |of: fn(&Vote) -> bool| votes.iter().any(of);
        let signal = votes.iter().map(|vote| vote.signal).max().unwrap_or(0);
        let stop = any(|vote| vote.stop).then(|| os::exit_code(signal));
        let save = any(|vote| vote.save) || self.agent.iteration.is_multiple_of(self.config.run.checkpoint_every);
        let last = self.finished() || stop.is_some();
        let hand_over = exchange.is_alone() || last || save || any(|vote| vote.improved);
        Ok(Decision { save, hand_over, stop, by_file })
    }

    /// Returns the steps that led to each divergence on any rank, as files with these names and texts.
    pub(super) fn dumps(&mut self) -> Vec<(String, String)> {
        if !self.dumps {
            return Vec::new();
        }
        let (iteration, first) = (self.agent.iteration, self.agent.pool.first());
        let mut own: Vec<(String, String)> = Vec::new();
        for (env, hand) in (first..).zip(self.agent.pool.envs_mut()) {
            let Some(diverged) = hand.take_diverged() else { continue };
            let text = diverged.as_json(&self.config.env, iteration, env);
            own.push((format!("iteration-{iteration:08}-env-{env}.json"), text));
        }
        self.agent.exchange.all_gather(own).concat()
    }
}
