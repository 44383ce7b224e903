//! The program: parses the command line, runs the command, prints what went wrong, exits with a code.

use std::process::ExitCode;

use clap::Parser;
use shadow_repose::cli::{Cli, Command};
use shadow_repose::train::{Outcome, train};
use shadow_repose::{bench, play, run, view};

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Train(args) => run::on_interrupt().and_then(|interrupted| train(&args, &interrupted)),
        Command::Play(args) => play::play(&args),
        Command::View(args) => view::view(&args).map(|()| Outcome::Finished),
        Command::Bench(args) => bench::bench(&args).map(|()| Outcome::Finished),
    };
    match result {
        Ok(Outcome::Finished) => ExitCode::SUCCESS,
        Ok(Outcome::Interrupted) => ExitCode::from(run::INTERRUPTED),
        Err(error) => {
            run::say(&format!("error: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
