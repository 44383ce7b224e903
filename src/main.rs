//! The program: parses the command line, runs the command, prints errors and sets the exit code.

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
mod processor;

use std::io::ErrorKind;
use std::process::ExitCode;

use shadow_repose::cli::{self, Command};
use shadow_repose::os::Requests;
use shadow_repose::train::train;
use shadow_repose::{bench, export, manual, os, play, plot, ranks, runs, view};

fn main() -> ExitCode {
    let command = match cli::parse() {
        Ok(cli) => cli.command,
        Err(answer) => return tell(&answer),
    };
    let trains = matches!(command, Command::Train(_));
    let allowed = if trains { Ok(()) } else { ranks::expect_one() };
    let result = allowed.and_then(|()| Requests::listen(trains)).and_then(|requests| match command {
        Command::Train(args) => train(&args, &requests),
        Command::Play(args) => play::play(&args, &requests),
        Command::View(args) => view::view(&args).map(|()| ExitCode::SUCCESS),
        Command::Export(args) => export::export(&args).map(|()| ExitCode::SUCCESS),
        Command::Plot(args) => plot::plot(&args).map(|()| ExitCode::SUCCESS),
        Command::Runs(args) => runs::runs(&args).map(|()| ExitCode::SUCCESS),
        Command::Bench(args) => bench::bench(&args).map(|()| ExitCode::SUCCESS),
        Command::Completions { shell } => manual::completions(shell).map(|()| ExitCode::SUCCESS),
        Command::Man => manual::man().map(|()| ExitCode::SUCCESS),
    });
    result.unwrap_or_else(|error| match error.downcast::<clap::Error>() {
        Ok(answer) => tell(&answer),
        Err(error) => {
            if trains || ranks::is_spokesman() {
                os::say(&format!("error: {error:#}"));
            }
            ExitCode::FAILURE
        }
    })
}

/// Prints the help, the version or a usage error, and returns the exit code. Among several ranks, only one prints.
fn tell(answer: &clap::Error) -> ExitCode {
    if ranks::is_spokesman()
        && let Err(error) = answer.print()
        && error.kind() != ErrorKind::BrokenPipe
    {
        os::say(&format!("error: cannot write to stdout: {error}"));
        return ExitCode::FAILURE;
    }
    ExitCode::from(answer.exit_code() as u8)
}
