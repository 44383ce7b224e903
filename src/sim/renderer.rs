//! Pictures of a scene, drawn by OpenGL into memory: no display is needed, and no graphics card.

use std::sync::Arc;

use anyhow::{Result, anyhow};
use mujoco_rs::prelude::{MjData, MjModel, MjvCamera};
use mujoco_rs::renderer::MjRenderer;

use super::graphics::{attempt, described};
use super::{Scene, Simulation};

/// What to do about a renderer that cannot be had.
const HELP: &str = "
  Pictures are drawn with EGL, which needs no display and no graphics card.
  On Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri
  Without pictures: `play --headless` scores.";

/// Draws simulations of one scene. It belongs to the thread that made it.
pub struct Renderer {
    renderer: MjRenderer,
    data: MjData<Arc<MjModel>>,
}

impl Renderer {
    /// A renderer of pictures as the look of the scene says.
    ///
    /// # Errors
    /// No EGL, with the packages that bring it.
    pub fn new(scene: &Scene) -> Result<Self> {
        let build = || MjRenderer::builder().camera(MjvCamera::new_free(&scene.model)).build(&scene.model);
        let renderer = attempt(build).map_err(|reason| anyhow!("cannot draw: {reason}{HELP}"))?;
        Ok(Self { renderer, data: MjData::new(scene.model.clone()) })
    }

    /// Width and height of its pictures in pixels.
    pub fn size(&self) -> [u32; 2] {
        let global = &self.data.model().vis().global;
        [global.offwidth as u32, global.offheight as u32]
    }

    /// The picture `[height, width, 3]` of the present state.
    ///
    /// # Errors
    /// OpenGL's.
    ///
    /// # Panics
    /// A simulation of another scene.
    pub fn draw(&mut self, simulation: &Simulation) -> Result<&[u8]> {
        simulation.data.copy_visual_to(&mut self.data).expect("a simulation of the same scene");
        // A mocap body that was put elsewhere after the step, the next goal, is not there yet.
        self.data.kinematics();
        self.renderer.sync_data(&mut self.data).map_err(|error| described(&error))?;
        self.renderer.render().map_err(|error| described(&error))?;
        Ok(self.renderer.rgb_flat().expect("colours are switched on"))
    }
}
