//! The program: parses the command line, runs the command, prints what went wrong, exits with a code.

use std::io::ErrorKind;
use std::process::ExitCode;

use clap::Parser;
use shadow_repose::cli::{Cli, Command};
use shadow_repose::run::Requests;
use shadow_repose::train::{Outcome, train};
use shadow_repose::{bench, play, plot, run, view};

fn main() -> ExitCode {
    let command = match Cli::try_parse() {
        Ok(cli) => cli.command,
        Err(answer) => return tell(&answer),
    };
    let result = Requests::listen(matches!(command, Command::Train(_))).and_then(|requests| match command {
        Command::Train(args) => train(&args, &requests),
        Command::Play(args) => play::play(&args, &requests),
        Command::View(args) => view::view(&args).map(|()| Outcome::Finished),
        Command::Plot(args) => plot::plot(&args).map(|()| Outcome::Finished),
        Command::Bench(args) => bench::bench(&args).map(|()| Outcome::Finished),
    });
    match result {
        Ok(Outcome::Finished) => ExitCode::SUCCESS,
        Ok(Outcome::Stopped(code)) => ExitCode::from(code),
        Err(error) => match error.downcast::<clap::Error>() {
            Ok(answer) => tell(&answer),
            Err(error) => {
                run::say(&format!("error: {error:#}"));
                ExitCode::FAILURE
            }
        },
    }
}

/// Prints help, version, or what is wrong with the command line.
fn tell(answer: &clap::Error) -> ExitCode {
    match answer.print() {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            run::say(&format!("error: cannot write to stdout: {error}"));
            ExitCode::FAILURE
        }
        _ => ExitCode::from(answer.exit_code() as u8),
    }
}
