//! The sliders of a page, which move the actuators of a hand.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::{Value, json};

use crate::os::OnPost;
use crate::repose::Task;

/// The answer to a request that moves none of the actuators.
const MALFORMED: &str = "Send a list of pairs: the number of an actuator, and a finite value.";

/// A slider for each actuator, in action order. An actuator obeys its slider from the first time that this is moved.
#[derive(Clone)]
pub struct Sliders(Arc<Mutex<SliderStates>>);

struct SliderStates {
    sliders: Vec<Slider>,
    /// Whether one has moved since this was last asked.
    moved: bool,
}

struct Slider {
    name: String,
    range: [f64; 2],
    /// In the unit of the range. `None` if it was not moved yet.
    value: Option<f64>,
}

impl Slider {
    fn value(&self) -> f64 {
        let [low, high] = self.range;
        self.value.unwrap_or(f64::midpoint(low, high))
    }
}

impl Sliders {
    /// Creates a slider for each actuator of a task's hand.
    pub fn new(task: &Task) -> Self {
        let hand = &task.hand;
        let actuators = hand.parts.actuators.iter().zip(&hand.actuators);
        let sliders = actuators.map(|(name, actuator)| Slider {
            name: name.clone(),
            range: actuator.range,
            value: None,
        });
        let state = SliderStates {
            sliders: sliders.collect(),
            moved: false,
        };
        Self(Arc::new(state.into()))
    }

    /// Changes an action to what the sliders ask for: -1 and 1 are the ends of the range of an actuator.
    pub fn change(&self, action: &mut [f32]) {
        for (action, slider) in action.iter_mut().zip(&self.state().sliders) {
            let [low, high] = slider.range;
            if let Some(value) = slider.value.filter(|_| low < high) {
                *action = (2.0 * (value - low) / (high - low) - 1.0) as f32;
            }
        }
    }

    /// What happens on a request of the page: `[[actuator, value], …]`.
    pub(super) fn on_post(&self) -> OnPost {
        let own = self.clone();
        Box::new(move |body| {
            let moves: Vec<(usize, f64)> = serde_json::from_slice(body).map_err(|_| MALFORMED)?;
            let mut state = own.state();
            let count = state.sliders.len();
            if moves
                .iter()
                .any(|(actuator, value)| *actuator >= count || !value.is_finite())
            {
                return Err(MALFORMED);
            }
            for (actuator, value) in moves {
                let slider = &mut state.sliders[actuator];
                let [low, high] = slider.range;
                slider.value = Some(value.max(low).min(high));
                state.moved = true;
            }
            Ok(())
        })
    }

    /// Whether one has moved since the last call.
    pub(super) fn take_moved(&self) -> bool {
        std::mem::take(&mut self.state().moved)
    }

    /// The value of each.
    pub(super) fn values(&self) -> Value {
        self.state().sliders.iter().map(Slider::value).collect()
    }

    /// What a page needs to show them.
    pub(super) fn described(&self) -> Value {
        let described = |slider: &Slider| {
            let [low, high] = slider.range;
            json!({ "name": slider.name, "low": low, "high": high, "value": slider.value() })
        };
        self.state().sliders.iter().map(described).collect()
    }

    fn state(&self) -> MutexGuard<'_, SliderStates> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn what_a_page_sends_moves_actuators_within_their_ranges_and_nothing_else_does() {
        let config = Config::default();
        let task = Task::new(&config).unwrap();
        let sliders = Sliders::new(&task);
        let post = sliders.on_post();
        let [low, high] = task.hand.actuators[3].range;
        let acted = || {
            let mut action = [0.25; 20];
            sliders.change(&mut action);
            action
        };
        assert!(acted() == [0.25; 20] && !sliders.take_moved());
        for bad in [
            "",
            "[]x",
            "[[20,0]]",
            "[[-1,0]]",
            "[[0,null]]",
            "[[0]]",
            "[[0,1e999]]",
            "{}",
            "[[3,0],[99,0]]",
        ] {
            assert!(post(bad.as_bytes()).is_err(), "{bad}");
        }
        assert!(
            acted() == [0.25; 20] && !sliders.take_moved(),
            "a request is taken whole or not at all"
        );
        post(format!("[[3,{}]]", low + 0.75 * (high - low)).as_bytes()).unwrap();
        assert!(sliders.take_moved() && !sliders.take_moved());
        assert!((acted()[3] - 0.5).abs() < 1e-6 && acted()[4] == 0.25);
        post(b"[[3,1e300]]").unwrap();
        assert_eq!(acted()[3], 1.0);
        assert_eq!(sliders.values()[3], high);
    }
}
