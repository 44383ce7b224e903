//! The task that all environments of a run share.

use std::sync::Arc;

use anyhow::{Context, Result};

use super::Hand;
use super::hand::CUBE;
use super::physics::Physics;
use super::sensing::NoiseStd;
use crate::config::{EnvConfig, Symmetry};
use crate::os;
use crate::quat::CUBE_ROTATIONS;
use crate::sim::{Compilation, Look, Scene, origin};

/// A scene, the hand in it, and the settings.
pub struct Task {
    pub(super) scene: Scene,
    pub(super) hand: Hand,
    pub(super) config: EnvConfig,
    /// The standard deviation of white noise on an observation.
    pub(super) noise: NoiseStd,
    /// The standard deviation of the offset of an observation that lasts an episode.
    pub(super) bias: NoiseStd,
}

impl Task {
    /// Loads the scene that `config` names and binds the hand in it.
    ///
    /// # Errors
    /// Fails with the scene's file if the scene cannot be loaded or lacks a name, or if a setting names an unknown group of the
    /// observation.
    pub fn new(config: &EnvConfig) -> Result<Arc<Self>> {
        Self::in_scene(Scene::load(config.model_file(), &compilation(config))?, config, None)
    }

    /// Loads the same task in a scene for display.
    ///
    /// # Errors
    /// Fails like [`Task::new`], or if meshes cannot be read.
    pub fn for_display(config: &EnvConfig, look: &Look) -> Result<Arc<Self>> {
        Self::in_scene(Scene::load_for_display(config.model_file(), &compilation(config), look)?, config, Some(look))
    }

    fn in_scene(scene: Scene, config: &EnvConfig, look: Option<&Look>) -> Result<Arc<Self>> {
        let hand = Hand::bind(&scene).with_context(|| origin(config.model_file()))?;
        let nominal = scene;
        let mut scene = nominal.varied(&Physics::of_task(config).changes(&hand));
        if let Some(look) = look {
            scene.set_look(look, &nominal);
        }
        let mut config = config.clone();
        config.goal_position.settle(nominal.start(hand.cube));
        let noise = NoiseStd::new(&config.noise).context("env.noise")?;
        let bias = NoiseStd::new(&config.bias).context("env.bias")?;
        Ok(Arc::new(Self { scene, hand, config, noise, bias }))
    }

    /// Returns the settings.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// Returns the hand in the scene.
    pub fn hand(&self) -> &Hand {
        &self.hand
    }

    /// Returns the scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Tells what of a user's scene the settings replace, and that the goal and the start of its cube are those of the scene.
    pub fn notes(&self) -> Vec<String> {
        let Some(file) = self.config.model_file() else { return Vec::new() };
        let (scene, place, own) = (file.display(), self.config.goal_position.value, self.scene.start(self.hand.cube));
        let (timestep, sim_dt) = (self.scene.own_timestep(), self.config.sim_dt);
        let mut notes = Vec::new();
        if timestep != sim_dt {
            notes.push(format!("env.sim_dt = {sim_dt} s replaces the timestep of {scene}, {timestep} s"));
        }
        if let keyframes @ [_, ..] = &self.scene.keyframes()[..] {
            let names: Vec<String> = keyframes.iter().map(|name| format!("`{name}`")).collect();
            notes.push(format!("keyframes of {scene} are not used: {}", os::shortened(&names.join(", "))));
        }
        notes.push(match place == own {
            true => format!("the cube starts where {scene} has it: env.goal_position = {place:?}"),
            false => format!("env.goal_position = {place:?} replaces the place of the cube in {scene}, {own:?}"),
        });
        notes
    }

    /// Returns a warning if a policy takes orientations of this cube for the same that are not.
    pub fn symmetry_warning(&self, symmetry: Symmetry) -> Option<String> {
        let rotations = self.scene.symmetry(self.hand.cube.body).len();
        (symmetry == Symmetry::Cube && rotations < CUBE_ROTATIONS.len()).then(|| {
            format!(
                "ppo.symmetry = \"cube\": a policy takes 24 orientations of a cube for the same, but the body `{CUBE}` of {} \
                 has only {rotations} that are alike",
                origin(self.config.model_file())
            )
        })
    }

    /// Loads this task's scene with its physics, but with another size of the cube (a factor on the task's), and with a centre
    /// of mass that can be shifted.
    ///
    /// # Errors
    /// Fails like [`Task::new`].
    pub(super) fn scene_with(&self, size: f64, shifts: bool) -> Result<Scene> {
        let config = &self.config;
        let mut compilation = compilation(config);
        compilation.size *= size;
        compilation.shifts |= shifts;
        let scene = Scene::load(config.model_file(), &compilation)?;
        Ok(scene.varied(&Physics::of_task(config).changes(&self.hand)))
    }
}

/// Returns how the scene is compiled for a task.
fn compilation(config: &EnvConfig) -> Compilation {
    let shifts = config.cube_com != [0.0; 3];
    Compilation { timestep: config.sim_dt, cone: config.cone, object: CUBE, size: config.cube_size_scale, shifts }
}
