//! Showing the scene without a policy: in a window, or as one picture.

use anyhow::Result;

use crate::cli::{Motion, ViewArgs, usage_error};
use crate::config::{Config, expect_used, user_file};
use crate::evaluate::{Actor, Episodes};
use crate::os;
use crate::see::{Window, screenshot, task_for_display};
use crate::sim::Quality;

/// Shows the scene in a window, or writes one picture of it.
///
/// # Errors
/// Fails if a setting or the scene cannot be used, if no window can be opened (with what is missing), or if the picture cannot be
/// written.
pub fn view(args: &ViewArgs) -> Result<()> {
    expect_used(&args.settings.set, "view")?;
    if args.shot.size.is_some() && args.screenshot.is_none() {
        return Err(usage_error("view", "--size applies only to a picture (--screenshot)").into());
    }
    args.screenshot.as_deref().map_or(Ok(()), os::expect_folder)?;
    let config = Config::resolve(user_file(args.settings.config.as_deref())?.as_ref(), &args.settings.set)?;
    let task = task_for_display(&config.env, &args.shot, [1280, 720], Quality::High)?;
    let actors = [Actor::Zero, Actor::Random, Actor::Wave];
    let first = match args.actions {
        Motion::Zero => 0,
        Motion::Random => 1,
        Motion::Wave => 2,
    };
    let episodes = Episodes { seed: args.seed, purpose: "score", first: 0, count: usize::MAX };
    if let Some(path) = &args.screenshot {
        let [width, height] = screenshot(path, &task, &actors[first], episodes, args.at)?;
        os::say(&format!("{}: {width}x{height}", path.display()));
        return Ok(());
    }
    let window = Window::open(&task, vec!["zero", "random", "wave"], first)?;
    os::say(&window.play(&task, &actors, episodes)?);
    Ok(())
}
