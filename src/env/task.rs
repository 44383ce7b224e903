//! The task that all environments of a run share.

use std::sync::Arc;

use anyhow::Result;

use super::Hand;
use super::hand::CUBE;
use crate::config::EnvConfig;
use crate::sim::{Look, Scene, Variation};

/// A scene, the hand in it, and the settings.
pub struct Task {
    pub(super) scene: Scene,
    pub(super) hand: Hand,
    pub(super) config: EnvConfig,
}

impl Task {
    /// Loads the scene that `config` names and binds the hand in it.
    ///
    /// # Errors
    /// Fails with the scene's file if the scene cannot be loaded or lacks a name.
    pub fn new(config: &EnvConfig) -> Result<Arc<Self>> {
        Self::of(Scene::load(config.model_file(), variation(config))?, config)
    }

    /// Loads the same task in a scene for display.
    ///
    /// # Errors
    /// Fails like [`Task::new`], or if meshes cannot be read.
    pub fn new_to_see(config: &EnvConfig, look: &Look) -> Result<Arc<Self>> {
        Self::of(Scene::load_to_see(config.model_file(), variation(config), look)?, config)
    }

    fn of(scene: Scene, config: &EnvConfig) -> Result<Arc<Self>> {
        let hand = Hand::bind(&scene)?;
        Ok(Arc::new(Self { scene, hand, config: config.clone() }))
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
}

fn variation(config: &EnvConfig) -> Variation {
    Variation { timestep: config.sim_dt, friction: config.friction_scale, load: (CUBE, config.cube_mass_scale) }
}
