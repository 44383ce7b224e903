//! Showing the scene without a policy: in a window, in a browser, or as one picture.

use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

#[cfg(not(all(feature = "video", feature = "viewer")))]
use anyhow::bail;
use anyhow::{Context, Result};

use crate::cli::{Motion, ViewArgs, usage_error};
use crate::config::{Config, Settings, expect_used};
use crate::evaluate::{Actor, Episodes, Player};
use crate::os;
use crate::repose::Task;
use crate::run;
use crate::see;

/// The actors, and their names in a window.
const ACTORS: [(Motion, &str, Actor); 3] = [
    (Motion::Zero, "zero", Actor::Zero),
    (Motion::Random, "random", Actor::Random),
    (Motion::Wave, "wave", Actor::Wave),
];

/// Shows the scene in a window or on a page, or writes one picture of it.
///
/// # Errors
/// Fails if a setting or the scene cannot be used, or if the picture cannot be written. Fails with what is missing if no window
/// can be opened.
pub fn view(args: &ViewArgs) -> Result<()> {
    expect_used(&args.settings.set, "view")?;
    if args.shot.size.is_some() && args.screenshot.is_none() {
        return Err(usage_error("view", "--size applies only to a picture (--screenshot)").into());
    }
    if args.at.is_some() && args.web.is_some() {
        return Err(usage_error("view", "--at applies only to a picture (--screenshot)").into());
    }
    if args.shot.quality.is_some() && args.web.is_some() {
        return Err(usage_error("view", "--quality applies only to a picture (--screenshot) or a window").into());
    }
    args.screenshot.as_deref().map_or(Ok(()), os::expect_folder)?;
    let config = Settings::new().user_file(args.settings.config.as_deref())?.sets(&args.settings.set).resolve()?;
    if let Some(path) = &args.screenshot {
        run::expect_output(path, args.settings.config.as_deref(), config.env.model_file())?;
    }
    let first = ACTORS.iter().position(|(motion, ..)| *motion == args.actions).context("an actor for each motion")?;
    let episodes = Episodes::scored(args.seed, usize::MAX);
    if let Some(port) = args.web {
        return show_on_page(port, args, &config, first);
    }
    match &args.screenshot {
        Some(path) => draw(path, args, &config, &ACTORS[first].2, episodes),
        None => show(args, &config, first, episodes),
    }
}

/// Shows the scene on a page, with a slider for each actuator, for as long as the program runs.
fn show_on_page(port: u16, args: &ViewArgs, config: &Config, actor: usize) -> Result<()> {
    let task = task_for_display(config, args)?;
    let sliders = see::Sliders::new(&task);
    let scene = config.env.model_file().map_or("The built-in hand".into(), |file| file.display().to_string());
    let about = see::About { title: scene, policy: None, seed: Some(args.seed) };
    let own = sliders.clone();
    let step = move |player: &mut Player| player.step_changed(&ACTORS[actor].2, |action| own.change(action));
    let acting = see::LiveActor { step: Rc::new(step), policy: None, task: task.clone() };
    see::Live::open(port, (&about, args.shot.camera), 1, &acting, Some(sliders))?.show(&mut || acting.clone())
}

/// Loads the task, and prints what the settings replace in the user's scene.
fn task_for_display(config: &Config, args: &ViewArgs) -> Result<Arc<Task>> {
    let task = Task::new(&config.env, &config.hand)?;
    let task = see::task_for_display(&task, &args.shot, [1280, 720], crate::sim::Quality::High)?;
    if config.env.model_file().is_some() {
        os::say(task.table().trim_end());
    }
    task.notes().iter().for_each(|note| os::say(&format!("note: {note}")));
    Ok(task)
}

#[cfg(feature = "video")]
fn draw(path: &Path, args: &ViewArgs, config: &Config, actor: &Actor, episodes: Episodes) -> Result<()> {
    let task = task_for_display(config, args)?;
    let [width, height] = see::screenshot(path, &task, actor, episodes, args.at.unwrap_or(0.5))?;
    os::say(&format!("{}: {width}x{height}", path.display()));
    Ok(())
}

#[cfg(not(feature = "video"))]
fn draw(_: &Path, _: &ViewArgs, _: &Config, _: &Actor, _: Episodes) -> Result<()> {
    bail!(see::NO_FILMS)
}

#[cfg(feature = "viewer")]
fn show(args: &ViewArgs, config: &Config, first: usize, episodes: Episodes) -> Result<()> {
    let task = task_for_display(config, args)?;
    let window = see::Window::open(&task, ACTORS.iter().map(|(_, name, _)| *name).collect(), first)?;
    os::say(&window.play(&task, &ACTORS.map(|(.., actor)| actor), episodes)?);
    Ok(())
}

#[cfg(not(feature = "viewer"))]
fn show(_: &ViewArgs, _: &Config, _: usize, _: Episodes) -> Result<()> {
    bail!(see::NO_WINDOWS)
}
