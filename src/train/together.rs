//! What the ranks of a training do together, besides computing: they agree on what follows an iteration, and the others follow
//! the first one.

use std::any::Any;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Error, Result, anyhow, bail, ensure};

use super::session::Session;
use crate::dump;
use crate::os::{self, Machine, Requests};
use crate::ranks::{self, Ranks};
use crate::run::{Report, RunFolder};
use crate::schedule::panic_message;
use crate::sim;

/// What follows an iteration, the same on all ranks.
pub(super) struct Next {
    /// Whether to save, besides the checkpoints that are due.
    save: bool,
    /// The exit code if the training is to stop here.
    pub stop: Option<ExitCode>,
    /// Whether the user has asked for that by a file.
    pub by_file: bool,
    /// Whether this iteration had the best evaluation so far.
    improved: bool,
}

/// Trains as a rank that computes, and leaves reporting and saving to the first.
pub(super) fn follow(requests: &Requests, ranks: &Arc<dyn Ranks>) -> Result<ExitCode> {
    sim::before_fatal_error(|said| os::say(&format!("error: {said}")));
    let mut session = Session::follow(ranks)?;
    requests.wait_for_end();
    // The state that the first rank's saver begins with.
    session.checkpoint();
    while !session.finished() {
        session.iterate(requests, None)?;
        let next = session.agree(requests, false)?;
        if session.hands_over(&next) {
            session.checkpoint();
        }
        session.dumps();
        if let Some(code) = next.stop.filter(|_| !session.finished()) {
            return Ok(code);
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// The most processors that a rank which is bound to one core may use: two, where a core runs two threads.
const ONE_CORE: f64 = 2.0;

impl Session {
    /// Checks that this rank runs the same program on the same scene as the first one. Returns a warning, on all ranks, if a
    /// launcher has bound one to a single core of a machine with more.
    ///
    /// # Errors
    /// Fails if the program or the scene differs.
    pub(super) fn expect_alike(&self) -> Result<Option<String>> {
        let alone = self.agent.division.is_alone();
        if alone && !ranks::launched_by_mpirun() {
            return Ok(None);
        }
        let machine = Machine::this();
        let [low, high] = [self.scene & u64::from(u32::MAX), self.scene >> 32].map(|half| half as f64);
        let name = f64::from(crc32fast::hash(machine.name.as_bytes()));
        let [allowed, processors] = [machine.allowed, machine.processors].map(|count| count as f64);
        let program = if alone { 0.0 } else { f64::from(os::program_checksum()) };
        let own = [program, low, high, name, allowed, processors];
        let all = self.agent.division.gather(own.to_vec());
        let rows: Vec<&[f64]> = all.chunks(own.len()).collect();
        for (rank, row) in rows.iter().enumerate() {
            ensure!(row[0] == rows[0][0], "rank {rank} runs another program than rank 0");
            ensure!(row[1..3] == rows[0][1..3], "rank {rank} has another scene than rank 0");
        }
        let bound = |row: &[f64]| {
            let ranks_there = rows.iter().filter(|other| other[3] == row[3]).count() as f64;
            row[4] <= ONE_CORE && row[4] * ranks_there < row[5]
        };
        let bound = rows.iter().position(|row| bound(row)).filter(|_| self.config.run.threads == 0);
        Ok(bound.map(|rank| {
            let [_, _, _, _, allowed, processors] = rows[rank] else { unreachable!("one row for each rank") };
            format!(
                "rank {rank} may use only {allowed} of the {processors} processors of its machine: start with mpirun --bind-to none, \
                 or --map-by ppr:1:node:PE={processors}, or srun --cpus-per-task"
            )
        }))
    }

    /// Agrees with the other ranks on what follows this iteration, and checks that all have the same weights. `asked_to_stop` tells
    /// that the user did so by a file.
    ///
    /// # Errors
    /// Fails if the weights differ.
    pub(super) fn agree(&self, requests: &Requests, asked_to_stop: bool) -> Result<Next> {
        let save = requests.take_save();
        if self.agent.division.is_alone() {
            let stop = asked_to_stop.then_some(ExitCode::SUCCESS);
            return Ok(Next { save, stop, by_file: asked_to_stop, improved: self.improved });
        }
        let stop = asked_to_stop || requests.stop().load(Ordering::Relaxed);
        let flags = [stop, save, self.improved].map(|flag| f64::from(u8::from(flag)));
        let own = [flags[0], flags[1], flags[2], f64::from(requests.signal()), f64::from(self.agent.ppo.checksum())];
        let all = self.agent.division.gather(own.to_vec());
        let rows: Vec<&[f64]> = all.chunks(own.len()).collect();
        if let Some(rank) = rows.iter().position(|row| row[4] != rows[0][4]) {
            bail!(
                "the weights of rank {rank} differ from those of rank 0: one of the machines does not compute as it should"
            );
        }
        let most = |i: usize| rows.iter().map(|row| row[i]).fold(0.0, f64::max);
        let stop = (most(0) > 0.0).then(|| os::exit_code(most(3) as i32));
        Ok(Next { save: most(1) > 0.0, stop, by_file: asked_to_stop, improved: most(2) > 0.0 })
    }

    /// Returns whether the state is saved after this iteration.
    pub(super) fn saves(&self, next: &Next) -> bool {
        next.save || self.agent.iteration.is_multiple_of(self.config.run.checkpoint_every)
    }

    /// Returns whether all ranks hand over their state after this iteration. A single rank always does: it may be asked to stop in
    /// the middle of the next one.
    pub(super) fn hands_over(&self, next: &Next) -> bool {
        let last = self.finished() || next.stop.is_some();
        self.agent.division.is_alone() || last || next.improved || self.saves(next)
    }

    /// Returns the steps that led to each divergence, as files with these names and texts, to the first rank.
    pub(super) fn dumps(&mut self) -> Vec<(String, String)> {
        if !self.dumps {
            return Vec::new();
        }
        let (iteration, first) = (self.agent.iteration, self.agent.pool.first());
        let mut own: Vec<(String, String)> = Vec::new();
        for (env, repose) in (first..).zip(self.agent.pool.envs_mut()) {
            let Some(diverged) = repose.take_diverged() else { continue };
            let text = dump::of(&diverged, &self.config.env, iteration, env);
            own.push((format!("iteration-{iteration:08}-env-{env}.json"), text));
        }
        let own = serde_json::to_vec(&own).expect("texts");
        let all = self.agent.division.gather_at_first(own);
        let read = |bytes: Vec<u8>| -> Vec<(String, String)> { serde_json::from_slice(&bytes).expect("written above") };
        all.into_iter().flat_map(read).collect()
    }

    /// Writes the steps that led to each divergence, on the first rank.
    pub(super) fn write_dumps(&mut self, folder: &RunFolder, report: &Report) {
        for (name, text) in self.dumps() {
            if let Err(error) = folder.dump(&name, &text) {
                report.warn(&format!("{error:#}"));
            }
        }
    }
}

/// Returns a panic as an error.
pub(super) fn panicked(panic: &(dyn Any + Send)) -> Error {
    anyhow!("panic: {}", panic_message(panic))
}
