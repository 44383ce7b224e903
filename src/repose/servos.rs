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
    /// The targets that have not taken effect yet, the oldest first: as many sets as there are control steps of delay.
    under_way: VecDeque<f64>,
}

impl Servos {
    pub fn new(actuators: usize) -> Self {
        Self {
            targets: vec![0.0; actuators],
            due: vec![0.0; actuators],
            under_way: VecDeque::new(),
        }
    }

    /// Starts with `targets`, which stay in effect during the delay.
    pub fn reset(&mut self, targets: impl IntoIterator<Item = f64>, delay: usize) {
        self.targets
            .iter_mut()
            .zip(targets)
            .for_each(|(own, target)| *own = target);
        self.under_way.clear();
        for _ in 0..delay {
            self.under_way.extend(&self.targets);
        }
        self.due.copy_from_slice(&self.targets);
    }

    /// Turns an action, clipped to [-1, 1], into targets. Targets that are due take effect.
    pub fn apply(&mut self, action: &[f32], actuators: &[Actuator], lesson: &Lesson) {
        let alpha = lesson.act_moving_average;
        for ((target, action), actuator) in self.targets.iter_mut().zip(action).zip(actuators) {
            let [low, high] = actuator.range;
            let asked = low + (f64::from(*action) + 1.0) / 2.0 * (high - low);
            *target = (alpha * asked + (1.0 - alpha) * *target).clamp(low, high);
        }
        self.under_way.extend(&self.targets);
        self.due
            .iter_mut()
            .zip(self.under_way.drain(..self.targets.len()))
            .for_each(|(due, target)| *due = target);
    }

    /// `count` sets of targets: those under way and, in front of them, the oldest one again.
    pub fn under_way(&self, count: usize) -> impl Iterator<Item = f64> {
        let actuators = self.targets.len();
        let missing = (count * actuators).saturating_sub(self.under_way.len());
        let oldest = (0..missing).map(move |i| i % actuators);
        let oldest = oldest.map(|i| *self.under_way.get(i).unwrap_or(&self.targets[i]));
        oldest.chain(self.under_way.iter().copied())
    }

    /// Resumes with these last targets and the newest `delay` sets that [`Self::under_way`] returned. If there are fewer, because
    /// a fork has a longer delay than its parent, the oldest one is repeated.
    pub fn restore(&mut self, last: &[f64], under_way: &[f64], delay: usize) {
        let oldest = if under_way.is_empty() {
            last
        } else {
            &under_way[..last.len()]
        };
        self.reset(last.iter().copied(), 0);
        let wanted = delay * last.len();
        for _ in 0..wanted.saturating_sub(under_way.len()) / last.len() {
            self.under_way.extend(oldest);
        }
        self.under_way
            .extend(&under_way[under_way.len().saturating_sub(wanted)..]);
    }
}
