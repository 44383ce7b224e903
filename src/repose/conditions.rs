//! The conditions of an episode besides the task itself: the physics that it has drawn, forces and assistance on the object, delay
//! and noise.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::observation::KNOWN;
use super::randomization::{EpisodePhysics, Randomization};
use super::sensing;
use super::task::Task;
use crate::quat::{self, Quat};
use crate::rng::{self, Rng};
use crate::sim::Simulation;
use crate::statistics::mean;

/// The conditions of the current episode of one environment.
#[derive(Default)]
pub struct Conditions {
    randomization: Option<Arc<Randomization>>,
    /// What the episode has drawn, if it is randomised.
    pub draw: Option<EpisodePhysics>,
    /// The fraction of the largest assistance that the episode gets. It is 0 in half of the episodes.
    assisted: f64,
    /// Whether the last torque was not zero.
    twisted: bool,
    /// What is added to the values of every observation of the episode, by the number of the value.
    bias: BTreeMap<usize, f32>,
}

impl Conditions {
    pub fn new(randomization: Option<&Arc<Randomization>>) -> Self {
        Self {
            randomization: randomization.cloned(),
            ..Self::default()
        }
    }

    /// Draws the conditions of the episode of `rng`, which is randomised with this `probability`. Gives the simulation its
    /// physics, after which the state must be reset.
    pub fn begin(&mut self, rng: &Rng, probability: f64, sim: &mut Simulation, task: &Task) {
        self.draw = self
            .randomization
            .as_ref()
            .and_then(|randomization| randomization.draw(rng, probability, &task.hand));
        self.assisted =
            (2.0 * rng::uniform(&mut rng::beside(rng, "assist"), 0.0, 1.0) - 1.0).max(0.0);
        self.twisted = false;
        self.bias = task.bias.draw(&mut rng::beside(rng, "bias")).collect();
        let Some(randomization) = &self.randomization else {
            return;
        };
        let (scene, changes) = randomization.scene_of(self.draw.as_ref(), &task.hand);
        sim.change_scene(scene, &changes);
        if self.draw.as_ref().is_some_and(|draw| draw.has_bias) {
            let rng = &mut rng::beside(rng, "bias of randomization");
            for (i, added) in randomization.bias.draw(rng) {
                *self.bias.entry(i).or_default() += added;
            }
        }
    }

    /// The control steps between an action and its effect.
    pub fn delay(&self, task: &Task) -> usize {
        (task.config.action_delay + self.draw.as_ref().map_or(0, EpisodePhysics::delay)) as usize
    }

    /// The logarithms of the factors of [`KNOWN`]: what the user states, times the mean of what the episode has drawn.
    pub fn known(&self, task: &Task) -> [f64; 4] {
        KNOWN.map(|name| {
            let stated = task.config.known.get(name).unwrap_or(&1.0);
            let drawn = self.draw.as_ref();
            (stated * drawn.map_or(1.0, |draw| mean(&draw.physics[name]))).ln()
        })
    }

    /// Applies the random force on the object that belongs to a step (from 0) of the episode of `rng`, and returns it, N.
    pub fn push(
        &self,
        rng: &Rng,
        step: u32,
        sim: &mut Simulation,
        task: &Task,
    ) -> Option<[f64; 3]> {
        let force = self
            .randomization
            .as_ref()?
            .push(self.draw.as_ref()?, rng, step)?;
        sim.push(task.hand.object.body, force);
        Some(force)
    }

    /// Applies the torque that helps to turn the object by the rotation `left`, and returns it, N m, if there is one. With full
    /// assistance, the task's object gets an angular acceleration of `most` for each rad.
    pub fn assist(
        &mut self,
        most: f64,
        left: Quat,
        sim: &mut Simulation,
        task: &Task,
    ) -> Option<[f64; 3]> {
        let factor = self.assisted * most * task.hand.object.inertia;
        if factor == 0.0 && !self.twisted {
            return None;
        }
        self.twisted = factor != 0.0;
        let torque = quat::rotation_vector(left).map(|angle| factor * angle);
        sim.twist(task.hand.object.body, torque);
        Some(torque)
    }

    /// Adds sensor noise for step `steps` and the constant offset of the episode that owns `rng`.
    pub fn disturb(&self, rng: &Rng, steps: u32, task: &Task, observation: &mut [f32]) {
        let drawn = self.randomization.as_ref().zip(self.draw.as_ref());
        let of_draw = drawn
            .filter(|(_, draw)| draw.has_noise)
            .map(|(randomization, _)| &randomization.noise);
        let noises = [Some(&task.noise), of_draw]
            .into_iter()
            .flatten()
            .filter(|spread| !spread.0.is_empty());
        let mut noise_rng = None;
        for noise in noises {
            let rng = noise_rng.get_or_insert_with(|| rng::beside_at(rng, "noise", steps));
            noise
                .draw(rng)
                .for_each(|(i, added)| observation[i] += added);
        }
        if noise_rng.is_some() || !self.bias.is_empty() {
            sensing::offset(observation, &self.bias, &task.hand.layout);
            sensing::make_consistent(observation, &task.hand.layout);
        }
    }
}
