//! Pictures of a scene, drawn by OpenGL into memory without a display or a graphics card.

use std::sync::Arc;

use anyhow::{Result, anyhow};
use mujoco_rs::prelude::{MjData, MjModel, MjvCamera};
use mujoco_rs::renderer::MjRenderer;

use super::graphics::{attempt, described};
use super::{Scene, Simulation};

/// The advice printed if there is no renderer.
const HELP: &str = if cfg!(target_os = "macos") {
    "
  macOS draws one picture or film in a process, and only on its main thread: use `play --out FILE.mp4` or `view --out FILE.png`."
} else {
    "
  Pictures are drawn with EGL, which needs neither a display nor a graphics card.
  On Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri"
};

/// A renderer for simulations of one scene. It belongs to the thread that created it.
pub struct Renderer {
    renderer: MjRenderer,
    data: MjData<Arc<MjModel>>,
}

impl Renderer {
    /// Creates a renderer that draws `scene` with its look.
    ///
    /// # Errors
    /// Fails if there is no EGL. The message names the packages that provide it.
    pub fn new(scene: &Scene) -> Result<Self> {
        let build = || {
            MjRenderer::builder()
                .camera(MjvCamera::new_free(&scene.model))
                .build(&scene.model)
        };
        Ok(Self {
            renderer: attempt(build).map_err(|reason| anyhow!("cannot draw: {reason}{HELP}"))?,
            data: MjData::new(scene.model.clone()),
        })
    }

    /// The width and height of pictures in pixels.
    pub fn size(&self) -> [u32; 2] {
        let global = &self.data.model().vis().global;
        [global.offwidth as u32, global.offheight as u32]
    }

    /// Draws the current state and returns the picture `[height, width, 3]`.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    ///
    /// # Panics
    /// Panics if the simulation is of another scene.
    pub fn draw(&mut self, simulation: &Simulation) -> Result<&[u8]> {
        simulation
            .data
            .copy_visual_to(&mut self.data)
            .expect("a simulation of the same scene");
        // A mocap body that was moved after the step (the next goal) is not at its new pose yet.
        self.data.kinematics();
        self.renderer
            .sync_data(&mut self.data)
            .map_err(|error| described(&error))?;
        self.renderer.render().map_err(|error| described(&error))?;
        Ok(self
            .renderer
            .rgb_flat()
            .expect("colour rendering is enabled"))
    }
}
