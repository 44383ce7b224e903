//! A training on several ranks: they agree on what follows an iteration, and the others follow the first one.

use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};

use super::session::Session;
use super::start::Plan;
use crate::os::{self, Requests};
use crate::ranks::Exchange;
use crate::sim;

/// The reason for the end of a training that was asked to stop, other than by a file.
pub(super) const STOPPED: &str = "stopped";

/// What follows an iteration.
#[derive(Debug, Default)]
pub(super) struct Decision {
    /// Whether to save.
    pub save: bool,
    /// Whether the state is handed to the saver. If nobody else waits, it always is: the next iteration may be cut short.
    pub hand_over: bool,
    /// The exit code and the reason if the training is to stop here.
    pub stop: Option<(ExitCode, &'static str)>,
}

/// What all ranks must know to decide.
#[derive(Serialize, Deserialize)]
struct Vote {
    stop: bool,
    save: bool,
    improved: bool,
    signal: i32,
    weights: u32,
}

/// Computes, and leaves reporting and saving to the first rank.
pub(super) fn follow(requests: &Requests, exchange: &Exchange) -> Result<ExitCode> {
    sim::before_fatal_error(|said| os::say(&format!("error: {said}")));
    let mut plan = Plan::receive(exchange)?;
    let loaded = plan.load_task()?;
    os::start_threads(plan.config.run.threads)?;
    let exchange = exchange.clone().over(plan.config.shards())?;
    let mut session = Session::new(plan, loaded, exchange)?;
    session.agent.exchange.expect_alike(&session.scene)?;
    requests.wait_for_end();
    // The state that the saver begins with.
    session.checkpoint();
    if session.finished() {
        return Ok(ExitCode::SUCCESS);
    }
    session.begin(requests, None)?;
    session.checkpoint();
    while !session.finished() {
        let done = session.iterate(requests, None)?.context("a stop comes between iterations")?;
        if done.decision.hand_over {
            session.checkpoint();
        }
        session.dumps();
        if let Some((code, _)) = done.decision.stop.filter(|_| !session.finished()) {
            return Ok(code);
        }
    }
    Ok(ExitCode::SUCCESS)
}

impl Session {
    /// Agrees with the other ranks on what follows this iteration, and checks that all have the same weights. `by_file`: the
    /// user has asked for a stop by a file. `improved`: this iteration had the best evaluation so far.
    ///
    /// # Errors
    /// Fails if the weights differ.
    pub(super) fn decide(&self, requests: &Requests, by_file: bool, improved: bool) -> Result<Decision> {
        let exchange = &self.agent.exchange;
        // With a single rank, the next iteration stops at once.
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
        let reason = if by_file { "stopped by the file `stop`" } else { STOPPED };
        let stop = any(|vote| vote.stop).then(|| (os::exit_code(signal), reason));
        let save = any(|vote| vote.save) || self.agent.iteration.is_multiple_of(self.config.run.checkpoint_every);
        let last = self.finished() || stop.is_some();
        let hand_over = exchange.is_alone() || last || save || any(|vote| vote.improved);
        Ok(Decision { save, hand_over, stop })
    }

    /// Returns the steps that led to each divergence, as files with these names and texts.
    pub(super) fn dumps(&mut self) -> Vec<(String, String)> {
        if !self.dumps {
            return Vec::new();
        }
        let (iteration, first) = (self.agent.iteration, self.agent.pool.blocks[0].first);
        let mut own: Vec<(String, String)> = Vec::new();
        for (env, hand) in (first..).zip(self.agent.pool.envs_mut()) {
            let Some(diverged) = hand.take_diverged() else { continue };
            let text = diverged.as_json(&self.config.env, iteration, env);
            own.push((format!("iteration-{iteration:08}-env-{env}.json"), text));
        }
        self.agent.exchange.all_gather(own).concat()
    }
}
