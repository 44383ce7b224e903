//! The program: parses the command line, runs the command, prints errors and sets the exit code.

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
mod processor;

use std::process::ExitCode;

use shadow_repose::cli::{self, Command};
use shadow_repose::os::Requests;
use shadow_repose::train::train;
use shadow_repose::{bench, export, manual, os, play, plot, ranks, runs, view};

fn main() -> ExitCode {
    let _queued = os::Queued::begin();
    let command = match cli::parse_from(std::env::args_os()) {
        Ok(cli) => cli.command,
        Err(answer) => return tell(&answer),
    };
    let trains = matches!(command, Command::Train(_));
    let allowed = if trains { Ok(()) } else { ranks::expect_one() };
    let done = |result: anyhow::Result<()>| result.map(|()| ExitCode::SUCCESS);
    let result =
        allowed
            .and_then(|()| Requests::listen(trains))
            .and_then(|requests| match command {
                Command::Train(args) => train(&args, &requests),
                Command::Play(args) => play::play(&args, &requests),
                Command::View(args) if args.fetch => done(view::fetch()),
                Command::View(args) => done(view::view(&args)),
                Command::Export(args) => done(export::export(&args)),
                Command::Plot(args) => done(plot::plot(&args)),
                Command::Runs(args) => done(runs::runs(&args)),
                Command::Bench(args) => done(bench::bench(&args)),
                Command::Completions { shell } => done(manual::completions(shell)),
                Command::Man => done(manual::man()),
            });
    result.unwrap_or_else(|error| match error.downcast::<clap::Error>() {
        Ok(answer) => tell(&answer),
        Err(error) => {
            if trains || ranks::is_spokesman() {
                os::say_line(&format!("error: {error:#}"));
            }
            ExitCode::FAILURE
        }
    })
}

/// Prints the help, the version or a usage error, and returns the exit code. Among several ranks, only one prints.
fn tell(answer: &clap::Error) -> ExitCode {
    if ranks::is_spokesman() && answer.use_stderr() {
        let _ = answer.print();
    } else if ranks::is_spokesman() {
        let text = answer.render();
        let text = if os::colors_enabled() {
            text.ansi().to_string()
        } else {
            text.to_string()
        };
        if let Err(error) = os::print(&text) {
            os::say_line(&format!("error: {error:#}"));
            return ExitCode::FAILURE;
        }
    }
    ExitCode::from(answer.exit_code() as u8)
}
