//! The window: the scene, which the mouse can orbit and pull at, and a panel beside it. The caller controls time.

use std::cell::RefCell;
use std::rc::Rc;

use anyhow::{Result, anyhow};
use mujoco_rs::viewer::MjViewer;

use super::graphics::{attempt, described};
use super::panel::{CloseLeftPanel, Panel};
use super::{Controls, Readout, Scene, Simulation};

/// The advice printed if no window can be opened.
const HELP: &str = if cfg!(target_os = "macos") {
    "
  A window needs a desktop with OpenGL. Over ssh, use `play --web`."
} else {
    "
  A window needs a display (DISPLAY or WAYLAND_DISPLAY) with OpenGL.
  On Debian and Ubuntu: apt install libgl1 libxcursor1 libxi6 libx11-xcb1 libxkbcommon-x11-0"
};

/// An open window.
pub struct Viewer {
    viewer: MjViewer,
    panel: Rc<RefCell<Panel>>,
}

impl Viewer {
    /// Opens a window on `scene`. The user chooses which of `choices` moves the hand, initially
    /// `choices[first]`.
    ///
    /// # Errors
    /// Fails if there is no display or a library is missing. The message names the packages that provide it.
    pub fn open(scene: &Scene, choices: Vec<&'static str>, first: usize) -> Result<Self> {
        let build = || {
            MjViewer::builder()
                .window_name("shadow-repose".to_owned())
                .build_passive(&scene.model)
        };
        let mut viewer =
            attempt(build).map_err(|reason| anyhow!("cannot open a window: {reason}{HELP}"))?;
        let panel = Rc::new(RefCell::new(Panel {
            choices,
            readout: Readout::default(),
            controls: Controls {
                speed: 1.0,
                choice: first,
                ..Controls::default()
            },
        }));
        let shown = panel.clone();
        viewer.add_ui_callback(move |ui, _| shown.borrow_mut().show(ui));
        viewer.with_ui_egui_ctx(|context| context.add_plugin(CloseLeftPanel::default()));
        Ok(Self { viewer, panel })
    }

    /// Whether the window is still open.
    pub fn is_open(&self) -> bool {
        self.viewer.running()
    }

    /// Draws the current state and the panel, and returns the user's input. If the user pulls at something, the force acts in
    /// the next steps of the simulation.
    ///
    /// # Errors
    /// Fails if OpenGL does.
    pub fn show(&mut self, simulation: &mut Simulation, readout: Readout) -> Result<Controls> {
        let data = &mut simulation.data;
        // A mocap body that was moved after the step (the next goal) is not at its new pose yet.
        data.step1();
        let time = data.time();
        let goals = data.mocap_quat().to_vec();
        self.viewer.sync_data(data);
        // The window's own reset restores the model's defaults without the task's knowledge.
        let was_reset = data.time() < time || data.mocap_quat() != goals;
        // Update the bodies to what the user has moved.
        data.step1();
        self.panel.borrow_mut().readout = readout;
        self.viewer.render().map_err(|error| described(&error))?;
        let controls = &mut self.panel.borrow_mut().controls;
        controls.reset |= was_reset;
        let asked = *controls;
        *controls = Controls {
            steps: 0,
            reset: false,
            new_goal: false,
            ..asked
        };
        Ok(asked)
    }
}
