//! Pictures of environments, as films show them.

use std::process;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::thread;

use anyhow::{Context, Result, ensure};
use shadow_repose::repose::Task;
use shadow_repose::see;
use shadow_repose::sim::{Look, Quality, Renderer, Simulation};

/// Width and height of a picture in pixels.
pub(crate) const SIZE: [u32; 2] = [640, 480];

/// A task on display, a state of it, and where its picture is awaited.
type Request = (Arc<Task>, Box<[f64]>, Sender<Result<Vec<u8>>>);

/// The process that has begun to draw, and the way to its thread that does. OpenGL belongs to one thread, but Python's calls come from
/// any. There is a single one, because what a thread has drawn with is only freed when it draws with something else.
static DRAWING: Mutex<Option<(u32, Sender<Request>)>> = Mutex::new(None);

/// A task as pictures show it.
///
/// # Errors
/// Fails if the scene cannot be shown.
pub(crate) fn shown(task: &Task) -> Result<Arc<Task>> {
    let look = Look {
        dress: None,
        size: SIZE,
        camera: None,
        quality: Quality::Fast,
        plain: false,
    };
    see::task_for_display(task, &look)
}

/// The picture of a state of a task on display, `[480, 640, 3]`.
///
/// # Errors
/// Fails if there is no EGL, if the system refuses a thread, or in a fork of a process that has drawn: OpenGL does not survive that.
pub(crate) fn picture(shown: &Arc<Task>, state: Box<[f64]>) -> Result<Vec<u8>> {
    let (answer, picture) = channel();
    let asked = (shown.clone(), state, answer);
    let sent = way_to_thread()?.send(asked).ok();
    let picture = sent.and_then(|()| picture.recv().ok());
    picture.context("the thread that draws has ended")?
}

/// The way to the thread that draws, which is started if need be.
fn way_to_thread() -> Result<Sender<Request>> {
    let mut drawing = DRAWING.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((process, sender)) = &*drawing {
        ensure!(
            *process == process::id(),
            "a fork of a process that has drawn pictures cannot draw; use the start method \"spawn\" or \"forkserver\""
        );
        return Ok(sender.clone());
    }
    let (sender, asked) = channel();
    thread::Builder::new()
        .name("pictures".into())
        .spawn(move || draw_all(&asked))
        .context("cannot start a thread")?;
    *drawing = Some((process::id(), sender.clone()));
    Ok(sender)
}

/// Draws for as long as the process lives. A renderer is kept as long as its task is on display.
fn draw_all(asked: &Receiver<Request>) {
    let mut kept: Vec<(Weak<Task>, Renderer, Simulation)> = Vec::new();
    for (task, state, answer) in asked {
        kept.retain(|(task, ..)| task.strong_count() > 0);
        let mut draw = || {
            let own = |(kept, ..): &(Weak<Task>, _, _)| kept.as_ptr() == Arc::as_ptr(&task);
            let place = match kept.iter().position(own) {
                Some(place) => place,
                None => {
                    let renderer = Renderer::new(&task.scene)?;
                    let simulation = Simulation::new(&task.scene);
                    kept.push((Arc::downgrade(&task), renderer, simulation));
                    kept.len() - 1
                }
            };
            let (_, renderer, simulation) = &mut kept[place];
            simulation.restore(&state)?;
            Ok(renderer.draw(simulation)?.to_vec())
        };
        // Whoever has asked may be gone.
        let _ = answer.send(draw());
    }
}
