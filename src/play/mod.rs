//! Playing a policy: in a window or a browser, as a film or an HTML file, or for its score over whole episodes (a table or one JSON
//! object), with a trace of the first episodes.

mod actors;
mod browser;
mod figures;
mod files;

use std::process::ExitCode;
use std::sync::Arc;

#[cfg(not(feature = "video"))]
use anyhow::bail;
#[cfg(not(feature = "viewer"))]
use anyhow::ensure;
use anyhow::{Context, Result};

pub use self::figures::json_score;

use self::actors::{actor_of, baseline};
use self::browser::Followed;
use self::figures::table;
use self::files::Files;
use crate::cli::{PlayArgs, Shot, usage_error};
use crate::config::{Settings, expect_used};
use crate::evaluate::{Actor, Episodes, Moment, Trial};
use crate::goal_times::GoalTimes;
use crate::load::Loaded;
use crate::os::{self, Requests};
#[cfg(feature = "video")]
use crate::repose::Score;
use crate::repose::Task;
use crate::robustness::robustness;
use crate::run;
use crate::see;

/// Plays in a window, as a film, or without either, and prints the score unless it was a window. Returns the exit code of the
/// program.
///
/// # Errors
/// Fails if a checkpoint, setting or scene cannot be used, if a window cannot be opened, or if a trace or film cannot be written.
pub fn play(args: &PlayArgs, requests: &Requests) -> Result<ExitCode> {
    expect_used(&args.set, "play")?;
    expect_together(args)?;
    if let Some(trace) = &args.from_trace {
        let html = args.html.as_deref().context("--from-trace needs --html")?;
        return browser::from_trace(trace, html, args).map(|()| ExitCode::SUCCESS);
    }
    let followed = args.follow.then(|| Followed::find(args)).transpose()?;
    let place = followed.as_ref().map(|followed| &*followed.path).or(args.ckpt.as_deref());
    let loaded = match args.policy {
        Some(_) => None,
        None => Some(Loaded::find(place, &args.set)?),
    };
    let task = match &loaded {
        Some(loaded) => loaded.task(&args.set)?,
        None => Settings::new().sets(&args.set).resolve().and_then(|config| Task::new(&config.env, &config.hand))?,
    };
    let config = task.config();
    for output in [&args.trace, &args.video, &args.out, &args.html].into_iter().flatten() {
        let policy = loaded.as_ref().and_then(|loaded| loaded.origin.file());
        run::expect_output(output, policy, config.model_file())?;
    }
    os::start_threads(args.threads)?;
    if args.robustness {
        requests.wait_for_end();
    }
    if let (Some(loaded), false) = (&loaded, args.json) {
        os::say(&format!("playing {}", loaded.name));
    }
    task.warnings().iter().for_each(|warning| os::say(&format!("warning: {warning}")));
    if !args.json {
        task.notes().iter().for_each(|note| os::say(&format!("note: {note}")));
    }
    if let (Some(loaded), true) = (&loaded, args.robustness) {
        return robustness(args, loaded, &actor_of(loaded, args), requests);
    }
    if let Some(port) = args.web {
        return browser::live(port, args, &task, loaded, followed);
    }
    #[cfg(not(feature = "viewer"))]
    ensure!(!wants_window(args), see::NO_WINDOWS);
    #[cfg(feature = "viewer")]
    if wants_window(args) && show(args, &task, loaded.as_ref())? {
        return Ok(ExitCode::SUCCESS);
    }
    if !os::has_display() && leaves_open(args) && os::is_terminal() {
        os::say("note: there is no display; --web shows the hand in a browser, --html writes a file for a browser");
    }
    play_unseen(args, requests, &task, loaded.as_ref())
}

/// Checks that options that are valid alone are valid together.
fn expect_together(args: &PlayArgs) -> Result<()> {
    let is_page = args.html.is_some() || args.web.is_some();
    let is_shown = is_page || args.video.is_some() || wants_window(args);
    let given = args.shot.given().filter(|_| !is_shown);
    let most = see::MOST_EPISODES as u64;
    // clap does not demand a required option if a given option excludes it.
    let needs = [
        ("--hands", args.hands.is_some(), "--web", args.web.is_some()),
        ("--follow", args.follow, "--web", args.web.is_some()),
        ("--fps", args.fps.is_some(), "--video", args.video.is_some()),
        ("--out", args.out.is_some(), "--robustness", args.robustness),
    ];
    let lacking = needs.into_iter().find(|(_, given, _, there)| *given && !there);
    let text = match args {
        _ if let Some((option, _, needed, _)) = lacking => format!("{option} applies only with {needed}"),
        _ if given.is_some() => {
            format!(
                "{} applies only to a film (--video), a page (--html, --web) or a window",
                given.unwrap_or_default()
            )
        }
        PlayArgs { video: None, shot: Shot { size: Some(_), .. }, .. } => {
            "--size applies only to a film (--video)".into()
        }
        PlayArgs { video: None, shot: Shot { quality: Some(_), .. }, .. } if is_page => {
            "--quality applies only to a film (--video) or a window".into()
        }
        PlayArgs { html: Some(_), episodes: Some(episodes), .. } if *episodes > most => {
            format!("--html shows at most {most} episodes: a larger file would be slow to open")
        }
        _ => return Ok(()),
    };
    Err(usage_error("play", &text).into())
}

/// Plays without a window and prints the score.
fn play_unseen(args: &PlayArgs, requests: &Requests, task: &Arc<Task>, loaded: Option<&Loaded>) -> Result<ExitCode> {
    let config = task.config();
    let actor = loaded.map_or_else(|| baseline(args), |loaded| actor_of(loaded, args));
    let checkpoint = loaded.map(|loaded| loaded.origin.to_string());
    let mut files = Files::begin(task, actor.name(), checkpoint.as_deref(), args)?;
    let mut goal_times = GoalTimes::new(config);
    let mut observe = |moment: &Moment| {
        goal_times.observe(moment);
        files.observe(moment);
    };
    let score = |actor: &Actor, observe: &mut dyn FnMut(&Moment)| {
        let episodes = episodes(args, if args.html.is_some() { 1 } else { 256 });
        let bar = os::progress_bar(episodes.count as u64, "episodes", actor.name());
        Trial { task, actor, episodes, stop: requests.stop() }.score(&bar, observe)
    };
    let played = match &args.video {
        #[cfg(not(feature = "video"))]
        Some(_) => bail!(see::NO_FILMS),
        #[cfg(feature = "video")]
        Some(path) => film(path, task, &actor, args, requests, &mut observe)?,
        None => score(&actor, &mut observe)?,
    };
    let Some(played) = played else {
        for path in [&args.trace, &args.html].into_iter().flatten() {
            os::say(&format!("{}: interrupted, not written", path.display()));
        }
        return Ok(os::exit_code(requests.signal()));
    };
    let policy = checkpoint.as_deref().zip(loaded.map(|loaded| &*loaded.name));
    files.finish(&browser::about(actor.name(), policy, Some(args.seed)))?;
    played.divergence().into_iter().for_each(|warning| os::say(&format!("warning: {warning}")));
    if args.json {
        os::print(&format!("{}\n", json_score(&played, &goal_times, checkpoint.as_deref(), args.seed)))?;
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(checkpoint) = &checkpoint {
        os::print(&format!("checkpoint {checkpoint}\n"))?;
    }
    let mut columns = vec![(actor.name(), played)];
    if loaded.is_some() && args.video.is_none() && args.html.is_none() {
        let zero = score(&Actor::Zero, &mut |_| {})?.context("these episodes cannot be interrupted")?;
        columns.push((Actor::Zero.name(), zero));
    }
    os::print(&table(&columns))?;
    Ok(ExitCode::SUCCESS)
}

fn wants_window(args: &PlayArgs) -> bool {
    args.window || leaves_open(args) && cfg!(feature = "viewer") && os::has_display()
}

/// Whether no option says how to play.
fn leaves_open(args: &PlayArgs) -> bool {
    let outputs = [&args.trace, &args.video, &args.html];
    let said = args.window || args.robustness || args.headless || args.json || args.web.is_some();
    !said && outputs.into_iter().all(Option::is_none)
}

/// Plays in a window. Returns false if none can be opened and none was requested explicitly.
#[cfg(feature = "viewer")]
fn show(args: &PlayArgs, task: &Task, loaded: Option<&Loaded>) -> Result<bool> {
    let task = see::task_for_display(task, &args.shot, [1280, 720], crate::sim::Quality::High)?;
    let (names, actors, first) = match loaded {
        Some(loaded) => {
            let policy = &loaded.policy;
            let actors = vec![Actor::Mean(policy.freeze()), Actor::Stochastic(policy.freeze())];
            (vec!["deterministic", "stochastic"], actors, usize::from(args.stochastic))
        }
        None => {
            let first = usize::from(matches!(baseline(args), Actor::Random));
            (vec!["zero", "random"], vec![Actor::Zero, Actor::Random], first)
        }
    };
    let window = match see::Window::open(&task, names, first) {
        Err(error) if !args.window => {
            os::say(&format!("note: {error:#}\n  Continuing as with --headless; --web shows the hand in a browser."));
            return Ok(false);
        }
        window => window?,
    };
    os::say(&window.play(&task, &actors, episodes(args, u64::MAX))?);
    Ok(true)
}

/// Plays the episodes one after another and films them. If interrupted, it leaves a film of what was played.
#[cfg(feature = "video")]
fn film(
    path: &std::path::Path,
    task: &Task,
    actor: &Actor,
    args: &PlayArgs,
    requests: &Requests,
    observe: &mut dyn FnMut(&Moment),
) -> Result<Option<Score>> {
    let task = see::task_for_display(task, &args.shot, [640, 480], crate::sim::Quality::Fast)?;
    let all = episodes(args, 1);
    let mut film = see::Film::create(path, &task, args.fps.unwrap_or(50), all.count as u64)?;
    // Unlike the other outputs, a film is worth keeping if it is interrupted.
    requests.wait_for_end();
    let mut played = Vec::new();
    for first in all.first..all.first + all.count {
        let one = Trial { task: &task, actor, episodes: Episodes { first, count: 1, ..all }, stop: requests.stop() };
        let result = one.play(&mut |moment| {
            observe(&moment);
            film.observe(&moment)
        });
        match result {
            Ok(Some(stats)) => played.extend(stats),
            Ok(None) => break,
            Err(error) => return Err(film.abandon().unwrap_or(error)),
        }
    }
    os::say(&format!("{}: {}", path.display(), film.finish()?));
    Ok((played.len() == all.count).then(|| Score::of(&played, task.config().ctrl_dt)))
}

/// Returns the requested episodes, or `otherwise` of them if no number was given.
fn episodes(args: &PlayArgs, otherwise: u64) -> Episodes {
    let count = args.episodes.unwrap_or(otherwise) as usize;
    Episodes::scored(args.seed, count)
}
