//! The randomised episodes of a training run: what each draws, and the models that it needs.
//!
//! What a randomised episode draws depends only on the seed and the number of the episode. A resumed run therefore draws the same
//! again, and all that is saved is whether the episode is randomised.

use std::sync::Arc;

use anyhow::{Context, Result, ensure};

use super::hand::Hand;
use super::physics::{Physics, QUANTITIES, normal, sizes};
use super::sensing::NoiseStd;
use super::task::Task;
use crate::config::RandomizationConfig;
use crate::rng::{self, Rng};
use crate::sim::{Change, Scene, origin};

/// The random physics, noise and delays of a training run.
pub struct Randomization {
    pub(super) config: RandomizationConfig,
    /// The scene of the episodes that are not randomised. It has the physics of the task.
    pub nominal: Scene,
    /// The scenes with another size of the object, each behind the factor on its lengths. The first one is the nominal scene.
    scenes: Vec<(f64, Scene)>,
    pub(super) noise: NoiseStd,
    pub(super) bias: NoiseStd,
}

/// What a randomised episode has drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodePhysics {
    /// What is changed on top of what the task sets.
    pub physics: Physics,
    /// Whether there is noise on the observations.
    pub has_noise: bool,
    /// Whether there is an offset of the observations.
    pub has_bias: bool,
    /// Whether there are forces on the object.
    pub has_pushes: bool,
}

impl EpisodePhysics {
    /// The control steps between an action and its effect, in addition to the delay of the task.
    pub fn delay(&self) -> u32 {
        self.physics["delay"][0] as u32
    }
}

impl Randomization {
    /// Prepares the randomised episodes of a training run, or `None` if it has none.
    ///
    /// # Errors
    /// Fails if the scene cannot be varied in this way, or if a setting names an unknown group of the observation.
    pub fn new(task: &Task, config: &RandomizationConfig) -> Result<Option<Arc<Self>>> {
        let noise =
            NoiseStd::new(&config.noise, &task.hand.layout).context("randomization.noise")?;
        let bias = NoiseStd::new(&config.bias, &task.hand.layout).context("randomization.bias")?;
        if !config.happens() {
            return Ok(None);
        }
        let shifts = config.cube_com > 0.0;
        let nominal = if shifts {
            task.scene_with(1.0, true)?
        } else {
            task.scene.clone()
        };
        let mut scenes = vec![(1.0, nominal.clone())];
        for size in sizes(config.cube_size) {
            if size == 1.0 {
                continue;
            }
            let scene = task
                .scene_with(size, shifts)
                .context("randomization.cube_size")?;
            ensure!(
                scene.has_structure_of(&nominal),
                "{}: its structure changes with the size of the object",
                origin(task.config.model_file())
            );
            scenes.push((size, scene));
        }
        Ok(Some(Arc::new(Self {
            config: config.clone(),
            nominal,
            scenes,
            noise,
            bias,
        })))
    }

    /// Draws the physics of the episode that owns `rng`. The generator's position does not matter. Returns `None` if the episode is
    /// not randomised, which happens with probability 1 - `probability`. All numbers are drawn in any case, so that one setting
    /// does not change what is drawn for another.
    pub fn draw(&self, rng: &Rng, probability: f64, hand: &Hand) -> Option<EpisodePhysics> {
        let shared = &mut rng::beside(rng, "randomization");
        let randomized = rng::uniform(shared, 0.0, 1.0) < probability;
        let is_varied = |rng: &mut Rng| rng::uniform(rng, 0.0, 1.0) < self.config.each;
        let flags = [(); QUANTITIES.len() + 3].map(|()| is_varied(shared));
        let mut physics = Physics::with(hand, &[]);
        for (i, quantity) in QUANTITIES.iter().enumerate() {
            let drawn = quantity.draw(&self.config, hand, shared);
            if flags[i] {
                physics.0[i] = drawn;
            }
        }
        let [.., has_noise, has_bias, has_pushes] = flags;
        randomized.then_some(EpisodePhysics {
            physics,
            has_noise,
            has_bias,
            has_pushes,
        })
    }

    /// The scene of an episode, and what it has drawn changes in it: nothing in the nominal scene.
    pub fn scene_of(&self, draw: Option<&EpisodePhysics>, hand: &Hand) -> (&Scene, Vec<Change>) {
        let Some(EpisodePhysics { physics, .. }) = draw else {
            return (&self.nominal, Vec::new());
        };
        let sized = self
            .scenes
            .iter()
            .find(|(size, _)| physics["cube_size"] == [*size]);
        let (_, scene) = sized.expect("a size that can be drawn, or the nominal one");
        (scene, physics.changes(hand))
    }

    /// The force on the object, N, in a step (from 0) of the episode of `rng`, or `None` if it has none.
    pub(super) fn push(&self, draw: &EpisodePhysics, rng: &Rng, step: u32) -> Option<[f64; 3]> {
        let std = self.config.push;
        let rng = &mut rng::beside_at(rng, "push", step / self.config.push_steps);
        (draw.has_pushes && std > 0.0).then(|| [(); 3].map(|()| normal(rng, std)))
    }
}
