//! What all environments of a run share.

use std::sync::Arc;

use anyhow::Result;

use super::Hand;
use super::hand::CUBE;
use crate::config::EnvConfig;
use crate::sim::{Look, Scene, Variation};

/// The scene, the hand in it, and the settings.
pub struct Task {
    pub(super) scene: Scene,
    pub(super) hand: Hand,
    pub(super) config: EnvConfig,
}

impl Task {
    /// Loads the scene that `config` names and binds the hand in it.
    ///
    /// # Errors
    /// A scene that cannot be loaded or lacks a name, with its file.
    pub fn new(config: &EnvConfig) -> Result<Arc<Self>> {
        Self::of(Scene::load(config.model_file(), variation(config))?, config)
    }

    /// The same task in a scene to be looked at.
    ///
    /// # Errors
    /// As [`Task::new`], and meshes that cannot be read.
    pub fn new_to_see(config: &EnvConfig, look: &Look) -> Result<Arc<Self>> {
        Self::of(Scene::load_to_see(config.model_file(), variation(config), look)?, config)
    }

    fn of(scene: Scene, config: &EnvConfig) -> Result<Arc<Self>> {
        let hand = Hand::bind(&scene)?;
        Ok(Arc::new(Self { scene, hand, config: config.clone() }))
    }

    /// The settings.
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }
}

fn variation(config: &EnvConfig) -> Variation {
    Variation { timestep: config.sim_dt, friction: config.friction_scale, load: (CUBE, config.cube_mass_scale) }
}
