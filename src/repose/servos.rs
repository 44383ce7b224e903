//! The targets of the actuators: actions become targets, which take effect after the delay of the episode.

use std::collections::VecDeque;

use super::Lesson;
use crate::sim::Actuator;

/// The targets of the servos of one hand: for each actuator in action order, in the unit of its control range.
pub struct Servos {
    /// The last targets.
    pub targets: Vec<f64>,
    /// The targets that take effect now.
    pub due: Vec<f64>,
    /// The targets of the last `memory` control steps, the oldest first.
    pub sent: VecDeque<f64>,
    memory: usize,
    /// The control steps after which targets take effect.
    delay: usize,
}

impl Servos {
    /// Servos that remember so many control steps. No delay may be longer.
    pub fn new(actuators: usize, memory: usize) -> Self {
        Self {
            targets: vec![0.0; actuators],
            due: vec![0.0; actuators],
            sent: VecDeque::new(),
            memory,
            delay: 0,
        }
    }

    /// Starts with `targets`, as if they had been sent all the time before.
    pub fn reset(&mut self, targets: impl IntoIterator<Item = f64>, delay: usize) {
        self.targets.clear();
        self.targets.extend(targets);
        self.due.copy_from_slice(&self.targets);
        self.delay = delay;
        self.sent.clear();
        for _ in 0..self.memory {
            self.sent.extend(&self.targets);
        }
    }

    /// Turns an action, clipped to [-1, 1], into targets. Targets that are due take effect.
    pub fn apply(&mut self, action: &[f32], actuators: &[Actuator], lesson: &Lesson) {
        let alpha = lesson.act_moving_average;
        for ((target, action), actuator) in self.targets.iter_mut().zip(action).zip(actuators) {
            let [low, high] = actuator.range;
            let asked = low + (f64::from(*action) + 1.0) / 2.0 * (high - low);
            *target = (alpha * asked + (1.0 - alpha) * *target).clamp(low, high);
        }
        self.sent.extend(&self.targets);
        let due = (self.memory - self.delay) * self.targets.len();
        self.due
            .iter_mut()
            .zip(self.sent.range(due..))
            .for_each(|(due, target)| *due = *target);
        self.sent.drain(..self.targets.len());
    }

    /// The targets of the last `count` control steps, the oldest first.
    pub fn last(&self, count: usize) -> Vec<f64> {
        self.sent
            .range(self.sent.len() - count * self.targets.len()..)
            .copied()
            .collect()
    }

    /// Resumes with these last targets, and with what was remembered. If that is less, because a fork has a longer memory than its
    /// parent, the oldest targets are repeated.
    pub fn restore(&mut self, last: &[f64], sent: &[f64], delay: usize) {
        self.reset(last.iter().copied(), delay);
        let oldest = sent.get(..last.len()).unwrap_or(last);
        self.sent.clear();
        for _ in sent.len() / last.len()..self.memory {
            self.sent.extend(oldest);
        }
        self.sent
            .extend(&sent[sent.len().saturating_sub(self.memory * last.len())..]);
    }
}
