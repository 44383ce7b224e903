//! Showing the scene without a policy: in a window, in a browser, or as one picture.

use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

use anyhow::{Context, Result, bail};

use crate::cli::{Made, ViewArgs, expect_together, usage_error};
use crate::config::{Config, Settings, expect_used};
use crate::evaluate::{Actor, Episodes, Player};
use crate::os::{self, OutputFile, say};
use crate::repose::Task;
use crate::run;
use crate::see;
use crate::sim::Camera;

/// What to do where no window can be opened.
const INSTEAD: &str = "Without a window, --web shows the hand in a browser, and --out hand.png draws it.";

/// Shows the scene in a window or on a page, or writes one picture of it.
///
/// # Errors
/// Fails if a setting or the scene cannot be used, or if the picture cannot be written. Fails with what is missing if no window
/// can be opened.
pub fn view(args: &ViewArgs) -> Result<()> {
    expect_used(&args.settings.set, "view")?;
    let made = match (&args.out, args.web) {
        (Some(_), _) => Made::Picture,
        (None, Some(_)) => Made::Web,
        (None, None) => Made::Window,
    };
    expect_together(&[made], &args.given).map_err(|text| usage_error("view", &text))?;
    let file = args.settings.config.as_deref();
    let config = Settings::new().user_file(file)?.sets(&args.settings.set).resolve()?;
    let choice = Actor::without_policy(Path::new(&args.actions)).context("an actor for each motion")?;
    let shot = args.shot.sized(args.size, args.quality);
    let load = || task_for_display(&config, &shot);
    match (&args.out, args.web) {
        (Some(to), _) => {
            run::expect_output(&to.path, file, config.env.model_file())?;
            let output = OutputFile::create(&to.path)?;
            draw(output, &load()?, choice, Episodes::scored(args.seed, 1), args.at)
        }
        (None, Some(port)) => show_on_page(port, &load()?, choice, args.seed, shot.camera),
        (None, None) => show(&load()?, choice, Episodes::scored(args.seed, usize::MAX)),
    }
}

/// Loads the task, and prints what the settings replace in the user's scene.
fn task_for_display(config: &Config, shot: &see::Shot) -> Result<Arc<Task>> {
    let task = Task::new(config)?;
    let task = see::task_for_display(&task, shot)?;
    if config.env.model_file().is_some() {
        os::say_line(task.table().trim_end());
    }
    task.notes().iter().for_each(|note| say!("note: {note}"));
    Ok(task)
}

/// Shows the scene on a page, with a slider for each actuator, for as long as the program runs.
fn show_on_page(port: u16, task: &Arc<Task>, choice: usize, seed: u64, camera: Option<Camera>) -> Result<()> {
    let sliders = see::Sliders::new(task);
    let title = task.config.model_file().map_or("The built-in hand".into(), |file| file.display().to_string());
    let about = see::About { title, policy: None, seed: Some(seed) };
    let own = sliders.clone();
    let step = move |player: &mut Player| {
        let (_, actor) = &Actor::WITHOUT_POLICY[choice];
        player.step_changed(actor, |action| own.change(action))
    };
    let acting = see::LiveActor { step: Rc::new(step), policy: None, task: task.clone() };
    see::Live::open(port, (&about, camera), 1, &acting, Some(sliders))?.show(&mut || acting.clone())
}

#[cfg(feature = "video")]
fn draw(output: OutputFile, task: &Arc<Task>, choice: usize, episodes: Episodes, seconds: f64) -> Result<()> {
    let path = output.path.clone();
    let (_, actor) = &Actor::WITHOUT_POLICY[choice];
    let [width, height] = see::screenshot(output, task, actor, episodes, seconds)?;
    say!("{}: {width}x{height}", path.display());
    Ok(())
}

#[cfg(not(feature = "video"))]
fn draw(_: OutputFile, _: &Arc<Task>, _: usize, _: Episodes, _: f64) -> Result<()> {
    bail!(see::NO_FILMS)
}

#[cfg(feature = "viewer")]
fn show(task: &Arc<Task>, choice: usize, episodes: Episodes) -> Result<()> {
    match see::Window::open(task, Actor::WITHOUT_POLICY.into(), choice) {
        Ok(window) => os::say_line(&window.play(task, episodes)?),
        Err(error) => bail!("{error:#}\n  {INSTEAD}"),
    }
    Ok(())
}

#[cfg(not(feature = "viewer"))]
fn show(_: &Arc<Task>, _: usize, _: Episodes) -> Result<()> {
    bail!("{}. {INSTEAD}", see::NO_WINDOWS)
}
