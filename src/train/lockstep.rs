//! A training run on several ranks: they agree on what follows an iteration.

use std::sync::atomic::Ordering;

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};

use super::duties::Lead;
use super::outcome::{Decision, Stop};
use super::session::Session;
use crate::os::Requests;

/// What all ranks must know to decide.
#[derive(Serialize, Deserialize)]
struct Vote {
    stop: bool,
    save: bool,
    improved: bool,
    signal: i32,
    weights: u32,
}

impl Session {
    /// Agrees with the other ranks on what follows this iteration, and checks that all have the same weights. `improved`:
    /// this iteration had the best evaluation so far.
    ///
    /// # Errors
    /// Fails if the weights differ.
    pub fn decide(&self, requests: &Requests, improved: bool) -> Result<Decision> {
        let exchange = &self.agent.exchange;
        let by_file = self.lead.as_ref().is_some_and(Lead::is_stopped_by_file);
        // With a single rank, the next iteration stops at once.
        let asked = !exchange.is_alone() && requests.stop.load(Ordering::Relaxed);
        let votes = exchange.all_gather(Vote {
            stop: by_file || asked,
            save: requests.take_save(),
            improved,
            signal: if asked { requests.signal() } else { 0 },
            weights: if exchange.is_alone() {
                0
            } else {
                self.agent.ppo.checksum()
            },
        });
        if let Some(rank) = votes
            .iter()
            .position(|vote| vote.weights != votes[0].weights)
        {
            bail!(
                "the weights of rank {rank} differ from those of rank 0: one of the machines does not compute as it should"
            );
        }
        let any = |of: fn(&Vote) -> bool| votes.iter().any(of);
        let signal = votes.iter().map(|vote| vote.signal).max().unwrap_or(0);
        let finished = self.finished();
        let stop = (!finished && any(|vote| vote.stop)).then_some(Stop { by_file, signal });
        let save = any(|vote| vote.save)
            || self
                .agent
                .iteration
                .is_multiple_of(self.config.run.checkpoint_every);
        let is_last = finished || stop.is_some();
        Ok(Decision {
            save: save && !is_last,
            hand_over: exchange.is_alone() || is_last || save || any(|vote| vote.improved),
            stop,
        })
    }

    /// The steps that led to each divergence, as files with these names and texts.
    pub fn dumps(&mut self) -> Vec<(String, String)> {
        if !self.dumps {
            return Vec::new();
        }
        let iteration = self.agent.iteration;
        let mut own = Vec::new();
        for member in self.agent.pool.members_mut() {
            if let Some(diverged) = member.env.diverged.take() {
                let text = diverged.as_json(&self.config.env, iteration, member.number);
                let name = format!("iteration-{iteration:08}-env-{}.json", member.number);
                own.push((name, text));
            }
        }
        self.agent.exchange.all_gather(own).concat()
    }
}
