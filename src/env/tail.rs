//! The last steps of an episode, as far back as is needed to see how the physics diverged: a state, and the controls that were
//! sent from there on.

use super::ACTION_SIZE;
use crate::sim::{Simulation, SimulationState};

/// Steps from one kept state to the next.
const STEPS: usize = 16;

/// Enough to replay the end of an episode in any MuJoCo.
#[derive(Clone, Debug)]
pub struct Tail {
    /// The state before the first of these steps.
    pub start: SimulationState,
    /// What the actuators were told in each step, in the model's order.
    pub controls: Vec<[f64; ACTION_SIZE]>,
    /// What the policy asked for in each step.
    pub actions: Vec<[f32; ACTION_SIZE]>,
}

/// Keeps the steps since the last two kept states: at least the last 16, where the episode has so many.
#[derive(Debug, Default)]
pub struct Recorder {
    before: Option<Tail>,
    now: Option<Tail>,
}

impl Recorder {
    /// Forgets the episode.
    pub fn clear(&mut self) {
        (self.before, self.now) = (None, None);
    }

    /// Takes a step that is about to be made; its controls are in place.
    pub fn record(&mut self, sim: &Simulation, action: &[f32]) {
        if self.now.as_ref().is_none_or(|tail| tail.controls.len() == STEPS) {
            let (controls, actions) = (Vec::with_capacity(STEPS), Vec::with_capacity(STEPS));
            self.before = self.now.replace(Tail { start: sim.state(), controls, actions });
        }
        let tail = self.now.as_mut().expect("it was just begun");
        tail.controls.push(*sim.ctrl().first_chunk().expect("a control for each actuator"));
        tail.actions.push(*action.first_chunk().expect("a whole action"));
    }

    /// The steps so far; none before the first.
    pub fn tail(&self) -> Option<Tail> {
        let now = self.now.clone()?;
        Some(match self.before.clone() {
            Some(mut tail) => {
                tail.controls.extend(now.controls);
                tail.actions.extend(now.actions);
                tail
            }
            None => now,
        })
    }
}
