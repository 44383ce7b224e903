//! The targets of the actuators: actions become smoothed targets, which take effect after the delay of the episode.

use std::collections::VecDeque;
use std::iter::repeat_n;

use super::ACTION_SIZE;
use crate::sim::Actuator;

/// Targets of all actuators, rad, in action order.
pub(super) type Targets = [f64; ACTION_SIZE];

/// The targets of the servos of one hand.
pub(super) struct Servos {
    /// The last targets.
    targets: Targets,
    /// The targets that have not taken effect yet, the oldest first: as many as there are control steps of delay.
    under_way: VecDeque<Targets>,
}

impl Servos {
    pub(super) fn new() -> Self {
        Self { targets: [0.0; ACTION_SIZE], under_way: VecDeque::new() }
    }

    /// Starts with `targets`, which stay in effect during the delay.
    pub(super) fn reset(&mut self, targets: Targets, delay: usize) {
        self.targets = targets;
        self.under_way.clear();
        self.under_way.extend(repeat_n(targets, delay));
    }

    /// Turns an action, clipped to [-1, 1], into targets, and returns those that take effect now. `alpha` is the weight of an
    /// action in the smoothed targets.
    pub(super) fn apply(
        &mut self,
        action: &[f32; ACTION_SIZE],
        actuators: &[Actuator; ACTION_SIZE],
        alpha: f64,
    ) -> Targets {
        for ((target, action), actuator) in self.targets.iter_mut().zip(action).zip(actuators) {
            let [low, high] = actuator.range;
            let asked = low + (f64::from(*action) + 1.0) / 2.0 * (high - low);
            *target = (alpha * asked + (1.0 - alpha) * *target).clamp(low, high);
        }
        self.under_way.push_back(self.targets);
        self.under_way.pop_front().expect("it has just got one")
    }

    /// Returns the last targets.
    pub(super) fn last(&self) -> Targets {
        self.targets
    }

    /// Returns `count` targets: those under way and, in front of them, the oldest one again.
    pub(super) fn under_way(&self, count: usize) -> impl Iterator<Item = Targets> {
        let oldest = *self.under_way.front().unwrap_or(&self.targets);
        repeat_n(oldest, count - self.under_way.len()).chain(self.under_way.iter().copied())
    }

    /// Resumes with these last targets and the newest `delay` of those that [`Self::under_way`] returned. If there are fewer,
    /// because a fork has a longer delay than its parent, the oldest one is repeated.
    pub(super) fn restore(&mut self, last: Targets, under_way: &[Targets], delay: usize) {
        let oldest = *under_way.first().unwrap_or(&last);
        self.reset(last, 0);
        self.under_way.extend(repeat_n(oldest, delay.saturating_sub(under_way.len())));
        self.under_way.extend(&under_way[under_way.len().saturating_sub(delay)..]);
    }
}
