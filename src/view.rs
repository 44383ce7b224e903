//! Showing the scene without a policy: in a window, in a browser, or as one picture.

use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

use anyhow::{Context, Result, bail};

use crate::check::Check;
use crate::cli::{Made, ViewArgs, expect_together, usage_error};
use crate::config::{Config, Settings, expect_used};
use crate::evaluate::{Actor, Player};
use crate::os::{self, say};
use crate::repose::Task;
use crate::see;
use crate::sim::Look;

/// What to do where no window can be opened.
const INSTEAD: &str =
    "Without a window, --web shows the hand in a browser, and --out hand.png draws it.";

/// Shows the scene in a window or on a page, writes one picture of it, or checks whether its hand can learn.
///
/// # Errors
/// Fails if a setting or the scene cannot be used, or if the picture cannot be written. Fails with what is missing if no window
/// can be opened.
pub fn view(args: &ViewArgs) -> Result<()> {
    expect_used(&args.settings.set, "view")?;
    let made = match (&args.out, args.shot.web) {
        _ if args.check => Made::Check,
        (Some(_), _) => Made::Picture,
        (None, Some(_)) => Made::Web,
        (None, None) => Made::Window,
    };
    expect_together(&[made], &args.given).map_err(|text| usage_error("view", &text))?;
    let file = args.settings.config.as_deref();
    let config = Settings::new()
        .user_file(file)?
        .sets(&args.settings.set)
        .resolve()?;
    if args.check {
        return check(&config);
    }
    let choice =
        Actor::without_policy(Path::new(&args.actions)).context("an actor for each motion")?;
    let look = args.shot.sized(args.size, args.quality);
    let load = || task_for_display(&config, &look);
    match (&args.out, args.shot.web) {
        #[cfg(not(feature = "video"))]
        (Some(_), _) => bail!(see::NO_FILMS),
        #[cfg(feature = "video")]
        (Some(to), _) => {
            crate::run::expect_output(&to.path, file, config.env.model_file())?;
            let output = os::OutputFile::create(&to.path)?;
            draw(args, output, &load()?, choice)?;
        }
        (None, Some(port)) => show_on_page(args, port, &load()?, choice)?,
        #[cfg(not(feature = "viewer"))]
        (None, None) => bail!("{}. {INSTEAD}", see::NO_WINDOWS),
        #[cfg(feature = "viewer")]
        (None, None) => show(&load()?, choice, args.seed)?,
    }
    Ok(())
}

/// Draws one picture of the hand in motion.
#[cfg(feature = "video")]
fn draw(args: &ViewArgs, to: os::OutputFile, task: &Arc<Task>, choice: usize) -> Result<()> {
    let (_, actor) = &Actor::WITHOUT_POLICY[choice];
    let episodes = crate::evaluate::Episodes::scored(args.seed, 1);
    let path = to.path.clone();
    let [width, height] = see::screenshot(to, task, actor, episodes, args.at)?;
    say!("{}: {width}x{height}", path.display());
    Ok(())
}

/// Prints whether the hand can learn.
fn check(config: &Config) -> Result<()> {
    let task = Task::new(config)?;
    describe(&task);
    os::say_line(Check::of(&task, &Config::default().env).table.trim_end());
    Ok(())
}

/// Fetches the meshes of the hand.
///
/// # Errors
/// Fails if they are not available.
pub fn fetch() -> Result<()> {
    os::hand_meshes(&see::mesh_files(), true).map(drop)
}

#[cfg(feature = "viewer")]
fn show(task: &Arc<Task>, choice: usize, seed: u64) -> Result<()> {
    let episodes = crate::evaluate::Episodes::scored(seed, usize::MAX);
    match see::Window::open(task, Actor::WITHOUT_POLICY.into(), choice) {
        Ok(window) => os::say_line(&window.play(task, episodes)?),
        Err(error) => bail!("{error:#}\n  {INSTEAD}"),
    }
    Ok(())
}

/// Loads the task, and prints what the settings replace in the user's scene.
fn task_for_display(config: &Config, look: &Look) -> Result<Arc<Task>> {
    let task = Task::new(config)?;
    describe(&task);
    see::task_for_display(&task, look)
}

/// Prints what was found in the user's scene, and what the settings replace in it.
fn describe(task: &Task) {
    if task.config.model_file().is_some() {
        os::say_line(task.table().trim_end());
    }
    task.notes().iter().for_each(|note| say!("note: {note}"));
}

/// Shows the scene on a page, with a slider for each actuator, for as long as the program runs.
fn show_on_page(args: &ViewArgs, port: u16, task: &Arc<Task>, choice: usize) -> Result<()> {
    let sliders = see::Sliders::of_actuators(task);
    let about = see::About {
        title: match task.config.model_file() {
            Some(file) => file.display().to_string(),
            None => "The built-in hand".into(),
        },
        policy: None,
        seed: Some(args.seed),
    };
    let own = sliders.clone();
    let acting = see::LiveActor {
        step: Rc::new(move |player: &mut Player| {
            let (_, actor) = &Actor::WITHOUT_POLICY[choice];
            player.step_changed(actor, |action| own.change(action))
        }),
        policy: None,
        task: task.clone(),
    };
    let place = (port, args.shot.web_host.as_deref());
    let look = (&about, args.shot.camera);
    see::Live::open(place, look, 1, &acting, sliders)?.show(&mut || acting.clone())
}
