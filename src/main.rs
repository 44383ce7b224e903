//! The program: parses the command line, runs the command, prints what went wrong, exits with a code.

use std::process::ExitCode;

use clap::Parser;
use shadow_repose::cli::{Cli, Command};
use shadow_repose::run::Requests;
use shadow_repose::train::{Outcome, train};
use shadow_repose::{bench, play, plot, run, view};

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Train(args) => Requests::listen().and_then(|requests| train(&args, &requests)),
        Command::Play(args) => play::play(&args),
        Command::View(args) => view::view(&args).map(|()| Outcome::Finished),
        Command::Plot(args) => plot::plot(&args).map(|()| Outcome::Finished),
        Command::Bench(args) => bench::bench(&args).map(|()| Outcome::Finished),
    };
    match result {
        Ok(Outcome::Finished) => ExitCode::SUCCESS,
        Ok(Outcome::Stopped(code)) => ExitCode::from(code),
        Err(error) => {
            run::say(&format!("error: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
