//! Pictures of environments, as films show them.

use std::process;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use anyhow::{Context, Result};
use shadow_repose::repose::Task;
use shadow_repose::see;
use shadow_repose::sim::{Look, Quality, Renderer, Simulation};

/// A thread that draws. OpenGL belongs to one thread, but Python's calls come from any.
pub(crate) struct Painter {
    /// The process that started the thread. A fork of it has no such thread.
    process: u32,
    states: Sender<Box<[f64]>>,
    pictures: Receiver<Result<Vec<u8>>>,
}

impl Painter {
    /// Width and height of a picture in pixels.
    pub(crate) const SIZE: [u32; 2] = [640, 480];

    /// The painter of this process for this task, which is started if need be.
    ///
    /// # Errors
    /// Fails if the scene cannot be shown, or if the system refuses a thread.
    pub(crate) fn of_this_process<'a>(
        painter: &'a mut Option<Self>,
        task: &Task,
    ) -> Result<&'a mut Self> {
        let own = painter
            .take()
            .filter(|painter| painter.process == process::id());
        let own = own.map_or_else(|| Self::new(task), Ok)?;
        Ok(painter.insert(own))
    }

    fn new(task: &Task) -> Result<Self> {
        let look = Look {
            dress: None,
            size: Self::SIZE,
            camera: None,
            quality: Quality::Fast,
            plain: false,
        };
        let shown = see::task_for_display(task, &look)?;
        let (states, asked) = channel();
        let (done, pictures) = channel();
        let draw = move || {
            if let Err(error) = draw_all(&shown, &asked, &done) {
                let _ = done.send(Err(error));
            }
        };
        thread::Builder::new()
            .name("pictures".into())
            .spawn(draw)
            .context("cannot start a thread")?;
        Ok(Self {
            process: process::id(),
            states,
            pictures,
        })
    }

    /// The picture of a state, `[480, 640, 3]`.
    ///
    /// # Errors
    /// Fails if there is no EGL.
    pub(crate) fn draw(&self, state: Box<[f64]>) -> Result<Vec<u8>> {
        let _ = self.states.send(state);
        self.pictures
            .recv()
            .context("the thread that draws has ended")?
    }
}

/// Draws the states for as long as there are any.
fn draw_all(
    shown: &Arc<Task>,
    states: &Receiver<Box<[f64]>>,
    done: &Sender<Result<Vec<u8>>>,
) -> Result<()> {
    let mut renderer = Renderer::new(&shown.scene)?;
    let mut simulation = Simulation::new(&shown.scene);
    for state in states {
        let restored = simulation.restore(&state);
        let picture = restored.and_then(|()| Ok(renderer.draw(&simulation)?.to_vec()));
        done.send(picture)?;
    }
    Ok(())
}
