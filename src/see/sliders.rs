//! The sliders and buttons of a page, by which its readers move a hand or change its world.

use std::mem::take;
use std::sync::{Arc, Mutex};

use serde::Deserialize;
use serde_json::{Value, json};

use crate::os::{OnPost, locked};
use crate::repose::Task;

/// The answer to a request that asks for nothing.
const MALFORMED: &str = "Send a list of pairs: the number of a slider, and a finite value; or a push, or the name of a button.";

/// The most orders that wait.
const MOST_ORDERS: usize = 64;

/// The sliders of a page, and the orders that came from it.
#[derive(Clone)]
pub struct Sliders(Arc<Mutex<State>>);

struct State {
    sliders: Vec<Slider>,
    /// Whether the page may also push the object and press buttons.
    takes_orders: bool,
    orders: Vec<Order>,
    /// Whether a slider has moved since this was last asked.
    moved: bool,
}

/// A slider.
pub struct Slider {
    /// What the page calls it.
    pub name: String,
    /// Its ends.
    pub range: [f64; 2],
    /// The distance between values, or 0 for any value.
    pub step: f64,
    /// Where it is until it is moved, and again after a reset.
    pub start: f64,
    /// The quantity of the physics on which it is a factor, at once.
    pub quantity: Option<&'static str>,
    value: Option<f64>,
}

/// What a page asks for besides values.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// Pushes the object of a hand with this force in the world frame, N, for a moment.
    Push(usize, [f64; 3]),
    /// Stops all hands, or lets them go on.
    Pause,
    /// Stops all hands after one more control step.
    Step,
    /// Draws another goal for each hand.
    Goal,
    /// Begins another episode with each hand.
    Episode,
    /// Puts all sliders back.
    Reset,
}

/// The body of a request.
#[derive(Deserialize)]
#[serde(untagged)]
enum Said {
    Moves(Vec<(usize, f64)>),
    Order(Order),
}

impl Slider {
    /// Creates a slider that has not moved.
    pub fn new(
        name: &str,
        range: [f64; 2],
        step: f64,
        start: f64,
        quantity: Option<&'static str>,
    ) -> Self {
        Self {
            name: name.into(),
            range,
            step,
            start,
            quantity,
            value: None,
        }
    }

    fn value(&self) -> f64 {
        self.value.unwrap_or(self.start)
    }
}

impl Sliders {
    /// Creates these sliders. The page may push the object and press buttons as well, if it `takes_orders`.
    pub fn new(sliders: Vec<Slider>, takes_orders: bool) -> Self {
        let state = State {
            sliders,
            takes_orders,
            orders: Vec::new(),
            moved: false,
        };
        Self(Arc::new(state.into()))
    }

    /// A slider for each actuator of a task's hand, in action order. An actuator obeys its slider from the first time that this is moved.
    pub fn of_actuators(task: &Task) -> Self {
        let hand = &task.hand;
        let actuators = hand.parts.actuators.iter().zip(&hand.actuators);
        let sliders = actuators.map(|(name, actuator)| {
            let [low, high] = actuator.range;
            Slider::new(name, actuator.range, 0.0, f64::midpoint(low, high), None)
        });
        Self::new(sliders.collect(), false)
    }

    /// Changes an action to what the sliders of actuators ask for: -1 and 1 are the ends of the range of an actuator.
    pub fn change(&self, action: &mut [f32]) {
        for (action, slider) in action.iter_mut().zip(&locked(&self.0).sliders) {
            let [low, high] = slider.range;
            if let Some(value) = slider.value.filter(|_| low < high) {
                *action = (2.0 * (value - low) / (high - low) - 1.0) as f32;
            }
        }
    }

    /// What happens on a request of the page: `[[slider, value], …]`, `{"push": [hand, [x, y, z]]}`, or the name of a button.
    pub(super) fn on_post(&self) -> OnPost {
        let own = self.clone();
        Box::new(move |body| {
            let said = serde_json::from_slice(body).map_err(|_| MALFORMED)?;
            let mut state = locked(&own.0);
            let count = state.sliders.len();
            // All numbers of JSON are finite.
            match said {
                Said::Moves(moves) if moves.iter().all(|(slider, _)| *slider < count) => {
                    for (slider, value) in moves {
                        let slider = &mut state.sliders[slider];
                        let [low, high] = slider.range;
                        slider.value = Some(value.max(low).min(high));
                        state.moved = true;
                    }
                }
                Said::Order(order) if state.takes_orders => {
                    if order == Order::Reset {
                        state
                            .sliders
                            .iter_mut()
                            .for_each(|slider| slider.value = None);
                        state.moved = true;
                    }
                    if state.orders.len() < MOST_ORDERS {
                        state.orders.push(order);
                    }
                }
                _ => return Err(MALFORMED),
            }
            Ok(())
        })
    }

    /// Whether one has moved since the last call.
    pub(super) fn take_moved(&self) -> bool {
        take(&mut locked(&self.0).moved)
    }

    /// The orders since the last call.
    pub(super) fn take_orders(&self) -> Vec<Order> {
        take(&mut locked(&self.0).orders)
    }

    /// The value of each.
    pub fn values(&self) -> Vec<f64> {
        locked(&self.0).sliders.iter().map(Slider::value).collect()
    }

    /// The factors on quantities of the physics.
    pub(super) fn factors(&self) -> Vec<(&'static str, f64)> {
        let factor = |slider: &Slider| Some((slider.quantity?, slider.value()));
        locked(&self.0).sliders.iter().filter_map(factor).collect()
    }

    /// What a page needs to show them.
    pub(super) fn described(&self) -> Value {
        let described = |slider: &Slider| {
            let [low, high] = slider.range;
            json!({ "name": slider.name, "low": low, "high": high, "step": slider.step, "value": slider.start })
        };
        locked(&self.0).sliders.iter().map(described).collect()
    }

    /// Whether the page may also push the object and press buttons.
    pub(super) fn takes_orders(&self) -> bool {
        locked(&self.0).takes_orders
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
        let sliders = Sliders::of_actuators(&task);
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
    #[test]
    fn a_page_pushes_and_presses_only_where_it_may() {
        let forbidden = Sliders::new(Vec::new(), false).on_post();
        let sliders = Sliders::new(
            vec![Slider::new("friction", [0.5, 2.0], 0.0, 1.0, None)],
            true,
        );
        let post = sliders.on_post();
        let bodies = ["\"goal\"", "{\"push\":[1,[0.5,0,-1]]}"];
        for body in bodies {
            assert!(forbidden(body.as_bytes()).is_err(), "{body}");
            post(body.as_bytes()).unwrap();
        }
        assert_eq!(
            sliders.take_orders(),
            [Order::Goal, Order::Push(1, [0.5, 0.0, -1.0])]
        );
        for bad in [
            "\"fly\"",
            "{\"push\":[1,[1e999,0,0]]}",
            "{\"push\":[-1,[0,0,0]]}",
            "{\"push\":1}",
        ] {
            assert!(post(bad.as_bytes()).is_err(), "{bad}");
        }
        (0..100).for_each(|_| post(b"\"step\"").unwrap());
        assert_eq!(sliders.take_orders().len(), MOST_ORDERS);
        post(b"[[0,9]]").unwrap();
        assert_eq!(sliders.values(), [2.0]);
        post(b"\"reset\"").unwrap();
        assert!(sliders.values() == [1.0] && sliders.take_moved());
    }
}
