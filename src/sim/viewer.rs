//! The window: the scene, to be orbited and pulled at with the mouse, and a panel beside it. Its caller owns time.

use std::cell::RefCell;
use std::rc::Rc;

use anyhow::{Result, anyhow};
use mujoco_rs::viewer::MjViewer;

use super::graphics::{attempt, described};
use super::panel::Panel;
use super::{Controls, Readout, Scene, Simulation};

/// What to do about a window that cannot be had.
const HELP: &str = "
  A window needs a display (DISPLAY or WAYLAND_DISPLAY) with OpenGL.
  On Debian and Ubuntu: apt install libgl1 libxcursor1 libxi6 libx11-xcb1 libxkbcommon-x11-0
  Without a window: `play --headless` scores, `play --video film.mp4` films, `view --screenshot picture.png` draws.";

/// An open window.
pub struct Viewer {
    viewer: MjViewer,
    panel: Rc<RefCell<Panel>>,
}

impl Viewer {
    /// Opens a window on `scene` with this title; `choices` are what the user may let move the hand, the one at `first` to
    /// begin with.
    ///
    /// # Errors
    /// No display or a missing library, with the packages that bring them.
    pub fn open(scene: &Scene, title: &str, choices: Vec<&'static str>, first: usize) -> Result<Self> {
        let build = || MjViewer::builder().window_name(title.to_owned()).build_passive(&scene.model);
        let mut viewer = attempt(build).map_err(|reason| anyhow!("cannot open a window: {reason}{HELP}"))?;
        let panel = Rc::new(RefCell::new(Panel::new(choices, first)));
        let shown = panel.clone();
        viewer.add_ui_callback(move |ui, _| shown.borrow_mut().show(ui));
        Ok(Self { viewer, panel })
    }

    /// Whether the user has not closed it.
    pub fn is_open(&self) -> bool {
        self.viewer.running()
    }

    /// Draws the present state and the panel, and returns what the user asks for. Where the user pulls at something, the
    /// simulation feels it in its next steps.
    ///
    /// # Errors
    /// OpenGL's.
    pub fn show(&mut self, simulation: &mut Simulation, readout: Readout) -> Result<Controls> {
        let data = &mut simulation.data;
        // A mocap body that was put elsewhere after the step, the next goal, is not there yet.
        data.step1();
        let (time, goals) = (data.time(), data.mocap_quat().to_vec());
        self.viewer.sync_data(data);
        // The window's own reset goes back to the model's defaults, of which the task knows nothing.
        let was_reset = data.time() < time || data.mocap_quat() != goals;
        // What was moved by hand brings its bodies along.
        data.step1();
        self.panel.borrow_mut().readout = readout;
        self.viewer.render().map_err(|error| described(&error))?;
        let mut panel = self.panel.borrow_mut();
        let mut asked = panel.controls.clone();
        asked.reset |= was_reset;
        let controls = &mut panel.controls;
        (controls.steps, controls.reset, controls.new_goal) = (0, false, false);
        Ok(asked)
    }
}
