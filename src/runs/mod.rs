//! A table of run folders, newest first, and the comparison of two runs. Everything comes from their files, which are only read.

mod comparison;
mod found;

use std::path::PathBuf;
use std::thread;
use std::time::{Duration, SystemTime};

use anyhow::{Result, ensure};
use rayon::prelude::*;
use serde_json::Value;

use crate::cli::RunsArgs;
use crate::config::Config;
use crate::os::{self, Screen, aligned, text_of};
use crate::run::{self, Glance};
use comparison::Comparison;
use found::Run;

/// The time between two tables of `--watch`.
const EVERY: Duration = Duration::from_secs(5);

/// The heads of the columns. The first [`WORDS`] columns hold words.
const HEADS: [&str; 8] = [
    "run",
    "state",
    "left",
    "steps",
    "steps/s",
    "goals",
    "best",
    "differs from the default in",
];
const WORDS: usize = 2;

/// Prints the runs in a folder, or the comparison of two runs. With `--watch`, prints again and again.
///
/// # Errors
/// Fails if the folder cannot be read, if a folder that is named holds no run, or if stdout cannot be written to.
pub fn runs(args: &RunsArgs) -> Result<()> {
    os::start_threads(0)?;
    let default = Config::default();
    let mut screen = Screen::default();
    let mut before = Vec::new();
    loop {
        let runs = read(args, &default, &before)?;
        let compared = match &runs[..] {
            [a, b] if args.places.len() == 2 => Some(Comparison::of(a, b)?),
            _ => None,
        };
        if args.json {
            let all: Value = runs.iter().map(Run::as_json).collect();
            let shown = match compared {
                Some(compared) => compared.as_json(all),
                None => all,
            };
            return os::print(&(os::harmless(&shown.to_string()) + "\n"));
        }
        if runs.is_empty() && !args.watch {
            os::say!("there are no runs in this folder");
        }
        let mut lines = table(&runs, compared.is_some());
        lines.extend(compared.iter().flat_map(Comparison::lines));
        if !args.watch {
            return os::print(&text_of(&lines));
        }
        if !screen.show(lines)? {
            return Ok(());
        }
        before = runs;
        thread::sleep(EVERY);
    }
}

/// Reads the runs at the places of `args`: one folder of runs, or runs themselves. Runs of a folder come newest first. A table that
/// has not changed since it was read `before` is not read again.
fn read(args: &RunsArgs, default: &Config, before: &[Run]) -> Result<Vec<Run>> {
    let places = &args.places;
    let (paths, are_runs) = match &places[..] {
        [] => (run::folders_of_runs(None, args.watch)?, false),
        [place] if Glance::of(place).is_none() => {
            (run::folders_of_runs(Some(place), args.watch)?, false)
        }
        places => (places.to_vec(), !args.watch),
    };
    let mut found = Vec::new();
    for path in paths {
        let glance = Glance::of(&path);
        if are_runs {
            ensure!(path.exists(), "{}: no such folder", path.display());
            ensure!(
                glance.is_some(),
                "{} holds no run; to list a folder of runs, name it alone",
                path.display()
            );
        }
        found.extend(glance.map(|glance| (path, glance)));
    }
    if places.len() < 2 {
        found.sort_by(|(a, of_a), (b, of_b)| (of_b.begun, b).cmp(&(of_a.begun, a)));
    }
    let now = SystemTime::now();
    let of = |(path, glance): (PathBuf, Glance)| {
        let known = before.iter().find(|run| run.path == path);
        Run::of(&path, &glance, default, known.map(|run| &run.figures), now)
    };
    Ok(found.into_par_iter().map(of).collect())
}

/// The runs as lines. Two that are compared have letters.
fn table(runs: &[Run], compared: bool) -> Vec<String> {
    let mut rows = vec![HEADS.map(String::from).to_vec()];
    rows.extend(runs.iter().map(Run::cells));
    if compared {
        for (row, letter) in rows.iter_mut().zip(["", "A", "B"]) {
            row.insert(0, letter.into());
        }
    }
    aligned(&rows, WORDS + usize::from(compared))
}
