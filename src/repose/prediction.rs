//! Where the hand will be when an action takes effect: a model of it runs forward through the targets that are still on their way.

use std::sync::{Arc, Mutex};

use anyhow::{Result, ensure};

use super::hand::Hand;
use crate::config::EnvConfig;
use crate::os::{locked, shortened};
use crate::quat;
use crate::sim::{Pose, Scene, Simulation, origin};

/// A model of the hand that predicts what will be observed.
pub struct Predictor {
    /// The scene that moves. Its physics is the physics that a controller assumes.
    scene: Scene,
    /// Its settings.
    pub config: EnvConfig,
    /// Simulations that nobody uses at the moment: in the end as many as there are threads.
    idle: Mutex<Vec<Simulation>>,
}

impl Predictor {
    /// Prepares the prediction of what happens in this scene, or nothing if nothing is predicted.
    ///
    /// # Errors
    /// Fails if the observation does not hold the whole state of the scene.
    pub fn new(scene: &Scene, hand: &Hand, config: &EnvConfig) -> Result<Option<Arc<Self>>> {
        if config.prediction == 0 {
            return Ok(None);
        }
        let unseen = scene.joints_besides(&hand.joints, &hand.object);
        ensure!(
            unseen.is_empty(),
            "{}: env.prediction = {}: a policy does not observe {}, so their movement cannot be predicted",
            origin(config.model_file()),
            config.prediction,
            shortened(&unseen.join(", "))
        );
        Ok(Some(Arc::new(Self {
            scene: scene.clone(),
            config: config.clone(),
            idle: Mutex::default(),
        })))
    }

    /// Runs from a measured observation `[O]` of `hand` through `targets`: one for each actuator, one control step after another.
    /// Returns the simulation, whose bodies can be observed, for [`Self::give_back`], or `None` if it diverges.
    pub fn run(
        &self,
        hand: &Hand,
        vel_obs_scale: f64,
        observation: &[f32],
        goal: Pose,
        targets: &[f64],
    ) -> Option<Simulation> {
        let mut sim = locked(&self.idle)
            .pop()
            .unwrap_or_else(|| Simulation::new(&self.scene));
        sim.reset();
        put_as_observed(&mut sim, hand, vel_obs_scale, observation);
        sim.place(hand.goal, goal);
        sim.refresh();
        let sets = targets.chunks_exact(hand.actuators.len());
        let last = sets.len() - 1;
        let substeps = self.config.substeps();
        let diverged = sets.enumerate().any(|(i, set)| {
            for (actuator, target) in hand.actuators.iter().zip(set) {
                sim.ctrl_mut()[actuator.ctrl] = *target;
            }
            if i < last {
                sim.step(substeps)
            } else {
                sim.step_to_observe(substeps)
            }
        });
        let finite = |values: &[f64]| values.iter().all(|x| (*x as f32).is_finite());
        if !diverged && finite(sim.qpos()) && finite(sim.qvel()) {
            return Some(sim);
        }
        self.give_back(sim);
        None
    }

    /// Keeps a simulation for the next prediction.
    pub fn give_back(&self, sim: Simulation) {
        locked(&self.idle).push(sim);
    }
}

/// Puts the joints and the object of `hand` where they were observed. The inverse of what [`super::Repose::observe`] writes.
fn put_as_observed(sim: &mut Simulation, hand: &Hand, vel_obs_scale: f64, observation: &[f32]) {
    let mut values = observation.iter().map(|&x| f64::from(x));
    for (joint, angle) in hand.joints.iter().zip(&mut values) {
        sim.qpos_mut()[joint.qpos] = angle;
    }
    for (joint, speed) in hand.joints.iter().zip(&mut values) {
        sim.qvel_mut()[joint.dof] = speed / vel_obs_scale;
    }
    let object = &hand.object;
    let pose: Vec<f64> = values.by_ref().take(7).collect();
    sim.qpos_mut()[object.qpos..][..7].copy_from_slice(&pose);
    for (cell, speed) in sim.qvel_mut()[object.dof..][..3]
        .iter_mut()
        .zip(&mut values)
    {
        *cell = speed;
    }
    let orientation = *pose.last_chunk().expect("an orientation");
    let spin = [(); 3].map(|()| values.next().expect("an angular velocity") / vel_obs_scale);
    // MuJoCo stores the angular velocity of a free joint in the body's frame.
    sim.qvel_mut()[object.dof + 3..][..3]
        .copy_from_slice(&quat::rotate(quat::conj(orientation), spin));
}
