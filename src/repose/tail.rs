//! The last steps of an episode, far enough back to show how the physics diverged: a state and the controls sent after it.

use super::ACTION_SIZE;
use crate::sim::{Simulation, SimulationState};

/// The number of steps between two kept states.
const STEPS: usize = 16;

/// The data needed to replay the end of an episode in any MuJoCo.
#[derive(Clone, Debug)]
pub struct Tail {
    /// The state before the first of these steps.
    pub start: SimulationState,
    /// The controls sent in each step, in the model's order.
    pub controls: Vec<[f64; ACTION_SIZE]>,
    /// The policy's action in each step.
    pub actions: Vec<[f32; ACTION_SIZE]>,
    /// The random force on the cube in each step, N; empty where there is none.
    pub pushes: Vec<[f64; 3]>,
}

/// The steps since the second-to-last kept state: at least the last 16 if the episode has that many.
#[derive(Debug, Default)]
pub(super) struct Recorder {
    before: Option<Tail>,
    now: Option<Tail>,
}

impl Recorder {
    /// Forgets the episode.
    pub(super) fn clear(&mut self) {
        (self.before, self.now) = (None, None);
    }

    /// Records a step that is about to be taken, after its controls have been set.
    pub(super) fn record(&mut self, sim: &Simulation, action: &[f32], push: Option<[f64; 3]>) {
        if self.now.as_ref().is_none_or(|tail| tail.controls.len() == STEPS) {
            let (controls, actions) = (Vec::with_capacity(STEPS), Vec::with_capacity(STEPS));
            self.before = self.now.replace(Tail { start: sim.state(), controls, actions, pushes: Vec::new() });
        }
        let tail = self.now.as_mut().expect("just begun");
        tail.controls.push(*sim.ctrl().first_chunk().expect("one control per actuator"));
        tail.actions.push(*action.first_chunk().expect("a complete action"));
        tail.pushes.extend(push);
    }

    /// Returns the recorded steps; `None` before the first step.
    pub(super) fn tail(&self) -> Option<Tail> {
        let now = self.now.clone()?;
        Some(match self.before.clone() {
            Some(mut tail) => {
                tail.controls.extend(now.controls);
                tail.actions.extend(now.actions);
                tail.pushes.extend(now.pushes);
                tail
            }
            None => now,
        })
    }
}
