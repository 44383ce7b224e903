//! Playing a policy: in a window or a browser, as a film or an HTML file, or for its score over whole episodes (a table or one JSON
//! object), with a trace of the first episodes.

mod browser;
mod figures;
mod plan;
mod score;
mod stage;

use std::process::ExitCode;

use anyhow::{Result, bail};

pub use self::figures::json_score;

use self::browser::Followed;
use self::plan::Plan;
use self::score::score;
use self::stage::{Stage, task};
use crate::cli::PlayArgs;
use crate::config::{Override, expect_used};
use crate::evaluate::Episodes;
use crate::os::{self, Requests, say};
use crate::robustness::robustness;
use crate::see;

/// What to do where no window can be opened.
const INSTEAD: &str = "Without a window, --web shows the hand in a browser, --out hand.html writes a file for one, and --headless scores.";

/// Plays in a window, as a film, or without either, and prints the score unless it was a window. Returns the exit code of the
/// program.
///
/// # Errors
/// Fails if a checkpoint, setting or scene cannot be used, if a window cannot be opened, or if a file cannot be written.
pub fn play(args: &PlayArgs, requests: &Requests) -> Result<ExitCode> {
    expect_used(&args.set, "play")?;
    let place = args.ckpt.as_deref();
    match Plan::of(args, cfg!(feature = "viewer") && os::has_display())? {
        Plan::Replay(trace, to, shot) => browser::from_trace(&trace, &to, &shot, &args.set),
        Plan::Web(port, shot) => {
            let followed = args.follow.then(|| Followed::find(place)).transpose()?;
            let newest = followed.as_ref().map(|followed| &*followed.path);
            let stage = Stage::set(newest.or(place), args)?;
            browser::live(args, port, &shot, stage, followed)
        }
        Plan::Robustness(report) => {
            requests.wait_for_end();
            let stage = Stage::set(place, args)?;
            let load = |changes: &[Override]| {
                task(stage.policy.as_ref(), &[&args.set[..], changes].concat())
            };
            robustness(
                &load,
                &stage.actor(),
                &stage.place(),
                episodes(args, 256),
                &report,
                requests,
            )
        }
        #[cfg(not(feature = "viewer"))]
        Plan::Window(_) => bail!("{}. {INSTEAD}", see::NO_WINDOWS),
        #[cfg(feature = "viewer")]
        Plan::Window(shot) => show(&Stage::set(place, args)?, &shot, args, requests),
        Plan::Score(outputs) => {
            let stage = Stage::set(place, args)?;
            if !args.wants_result() && os::is_terminal() {
                say!("note: there is no display. {INSTEAD}");
            }
            let is_seen = outputs.film.is_some() || outputs.page.is_some();
            score(
                &stage,
                episodes(args, if is_seen { 1 } else { 256 }),
                &outputs,
                requests,
            )
        }
    }
}

/// Plays in a window. If none can be opened and none was asked for, plays for the score.
#[cfg(feature = "viewer")]
fn show(
    stage: &Stage,
    shot: &crate::sim::Look,
    args: &PlayArgs,
    requests: &Requests,
) -> Result<ExitCode> {
    let task = see::task_for_display(&stage.task, shot)?;
    match see::Window::open(&task, stage.actors(), stage.choice) {
        Ok(window) => os::say_line(&window.play(&task, episodes(args, u64::MAX))?),
        Err(error) if args.window => bail!("{error:#}\n  {INSTEAD}"),
        Err(error) => {
            say!("note: {error:#}\n  {INSTEAD} The score follows.");
            return score(
                stage,
                episodes(args, 256),
                &plan::Outputs::of(args)?,
                requests,
            );
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// As many episodes as the user asks for, or as are usual.
fn episodes(args: &PlayArgs, usual: u64) -> Episodes {
    Episodes::scored(args.seed, args.episodes.unwrap_or(usual) as usize)
}
