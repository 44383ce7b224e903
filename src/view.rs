//! The scene without a policy: in a window, or as one picture.

use anyhow::Result;

use crate::cli::{Motion, ViewArgs};
use crate::config::{Config, expect_used};
use crate::evaluate::{Actor, Episodes};
use crate::film;
use crate::run;
use crate::scenery::task_to_see;
use crate::sim::Quality;
use crate::train::user_file;
use crate::window::Window;

/// Shows the scene as asked.
///
/// # Errors
/// A setting or scene that cannot be used; no window, with what is missing; a picture that cannot be written.
pub fn view(args: &ViewArgs) -> Result<()> {
    expect_used(&args.settings.set, "view")?;
    args.screenshot.as_deref().map_or(Ok(()), run::expect_folder)?;
    let config = Config::resolve(user_file(&args.settings)?.as_ref(), &args.settings.set)?;
    let task = task_to_see(&config.env, &args.shot, [1280, 720], Quality::High)?;
    let actors = [Actor::Zero, Actor::Random, Actor::Wave];
    let first = match args.actions {
        Motion::Zero => 0,
        Motion::Random => 1,
        Motion::Wave => 2,
    };
    let episodes = Episodes { seed: args.seed, purpose: "score", first: 0, count: usize::MAX };
    if let Some(path) = &args.screenshot {
        return film::screenshot(path, &task, &actors[first], episodes, args.at);
    }
    let window = Window::open(&task, vec!["zero", "random", "wave"], first)?;
    run::say(&window.play(&task, &actors, episodes)?);
    Ok(())
}
