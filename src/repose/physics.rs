//! The physical quantities that may differ from the scene, as one table. `[env]` sets them for the whole task, randomised
//! episodes draw them, and traces and dumps report them.

use std::ops::Index;

use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};
use toml::Table;

use super::hand::Hand;
use crate::config::{EnvConfig, RandomizationConfig};
use crate::rng::{self, Rng};
use crate::sim::Change;

/// A quantity. What it changes is applied to the scene of the task, so a draw comes on top of what the task sets.
pub struct Quantity {
    /// Its name in `[randomization]` and in dumps.
    pub name: &'static str,
    /// Its name in `[env]`, in traces and in dumps.
    pub setting: &'static str,
    /// Its unit, or 1 for a factor.
    pub unit: &'static str,
    /// The value for the whole task.
    task: fn(&EnvConfig) -> Vec<f64>,
    law: Law,
    /// What its values change in a scene. There is one value, or one for each axis, each actuator in action order, or each
    /// joint in observation order. A single value is valid for all actuators or joints.
    change: fn(&Hand, &[f64]) -> Vec<Change>,
}

/// How a quantity is drawn.
enum Law {
    /// Uniformly between two factors.
    Uniform(fn(&RandomizationConfig) -> [f64; 2]),
    /// One of [`SIZES`] factors. Each is a compiled scene, because MuJoCo cannot change sizes in a compiled one.
    Size(fn(&RandomizationConfig) -> [f64; 2]),
    /// A whole number from one to another.
    Whole(fn(&RandomizationConfig) -> [u32; 2]),
    /// For each axis, uniformly within this distance of zero.
    Within(fn(&RandomizationConfig) -> f64),
    /// For each axis, normally with this standard deviation.
    Normal(fn(&RandomizationConfig) -> f64),
    /// As many factors as the hand has of these, each uniformly in its logarithm.
    Each(fn(&Hand) -> usize, fn(&RandomizationConfig) -> [f64; 2]),
}

/// The number of sizes of the object.
const SIZES: usize = 5;

/// The changes of each of these parts, given one value for all of them or one for each.
fn each<T: Copy>(parts: &[T], values: &[f64], change: fn(T, f64) -> Change) -> Vec<Change> {
    parts
        .iter()
        .zip(values.iter().cycle())
        .map(|(&part, &value)| change(part, value))
        .collect()
}

fn vector(values: &[f64]) -> [f64; 3] {
    values.try_into().expect("three axes")
}

/// All quantities, in the order in which they are drawn.
#[rustfmt::skip]
pub const QUANTITIES: [Quantity; 10] = [
    Quantity { name: "friction", setting: "friction_scale", unit: "1",
        task: |env| vec![env.friction_scale], law: Law::Uniform(|drawn| drawn.friction),
        change: |_, x| vec![Change::Friction(x[0])] },
    Quantity { name: "cube_mass", setting: "cube_mass_scale", unit: "1",
        task: |env| vec![env.cube_mass_scale], law: Law::Uniform(|drawn| drawn.cube_mass),
        change: |hand, x| vec![Change::Mass(hand.object.body, x[0])] },
    Quantity { name: "hand_mass", setting: "hand_mass_scale", unit: "1",
        task: |env| vec![env.hand_mass_scale], law: Law::Uniform(|drawn| drawn.hand_mass),
        change: |hand, x| each(&hand.roots, x, Change::Mass) },
    Quantity { name: "cube_size", setting: "cube_size_scale", unit: "1",
        task: |env| vec![env.cube_size_scale], law: Law::Size(|drawn| drawn.cube_size), change: |_, _| vec![] },
    Quantity { name: "delay", setting: "action_delay", unit: "control steps",
        task: |env| vec![f64::from(env.action_delay)], law: Law::Whole(|drawn| drawn.delay), change: |_, _| vec![] },
    Quantity { name: "cube_com", setting: "cube_com", unit: "m",
        task: |env| env.cube_com.into(), law: Law::Within(|drawn| drawn.cube_com),
        change: |hand, x| vec![Change::CentreOfMass(hand.object.body, vector(x))] },
    Quantity { name: "gravity", setting: "gravity", unit: "m/s^2",
        task: |env| env.gravity.into(), law: Law::Normal(|drawn| drawn.gravity),
        change: |_, x| vec![Change::Gravity(vector(x))] },
    Quantity { name: "gains", setting: "gains_scale", unit: "1",
        task: |env| vec![env.gains_scale], law: Law::Each(|hand| hand.actuators.len(), |drawn| drawn.gains),
        change: |hand, x| each(&hand.actuators, x, Change::Gain) },
    Quantity { name: "damping", setting: "damping_scale", unit: "1",
        task: |env| vec![env.damping_scale], law: Law::Each(|hand| hand.joints.len(), |drawn| drawn.damping),
        change: |hand, x| each(&hand.joints, x, Change::Damping) },
    Quantity { name: "frictionloss", setting: "frictionloss_scale", unit: "1",
        task: |env| vec![env.frictionloss_scale], law: Law::Each(|hand| hand.joints.len(), |drawn| drawn.frictionloss),
        change: |hand, x| each(&hand.joints, x, Change::FrictionLoss) },
];

/// Settings of `[env]` that vary what is simulated or observed and are no quantities.
const OTHERS: [&str; 3] = ["cone", "noise", "bias"];

impl Quantity {
    /// The value that changes nothing.
    fn neutral(&self) -> f64 {
        if self.unit == "1" { 1.0 } else { 0.0 }
    }

    /// The number of values in an episode of this hand.
    fn count(&self, hand: &Hand) -> usize {
        match self.law {
            Law::Within(_) | Law::Normal(_) => 3,
            Law::Each(count, _) => count(hand),
            _ => 1,
        }
    }

    /// Draws the values of an episode.
    pub(super) fn draw(
        &self,
        config: &RandomizationConfig,
        hand: &Hand,
        rng: &mut Rng,
    ) -> Vec<f64> {
        let axes = 0..3;
        match &self.law {
            Law::Uniform(range) => {
                let [low, high] = range(config);
                vec![rng::uniform(rng, low, high)]
            }
            Law::Size(range) => {
                let sizes = sizes(range(config));
                vec![sizes[(rng::uniform(rng, 0.0, 1.0) * sizes.len() as f64) as usize]]
            }
            Law::Whole(range) => {
                let [low, high] = range(config);
                vec![f64::from(rng.random_range(low..=high))]
            }
            Law::Within(limit) => axes
                .map(|_| rng::uniform(rng, -limit(config), limit(config)))
                .collect(),
            Law::Normal(std) => axes.map(|_| normal(rng, std(config))).collect(),
            // With probability ½ all joints have the same factor. Independent draws alone would leave their mean near the middle.
            // A policy that has seen only such hands fails on one whose joints all have little damping.
            Law::Each(count, range) => {
                let [low, high] = range(config);
                let together = rng::uniform(rng, 0.0, 1.0) < 0.5;
                let own: Vec<f64> = (0..count(hand))
                    .map(|_| rng::uniform(rng, low.ln(), high.ln()).exp())
                    .collect();
                if together {
                    vec![own[0]; own.len()]
                } else {
                    own
                }
            }
        }
    }
}

/// The factors on the lengths of the object that are drawn.
pub fn sizes([low, high]: [f64; 2]) -> Vec<f64> {
    if low == high {
        return vec![low];
    }
    (0..SIZES)
        .map(|i| low + (high - low) * i as f64 / (SIZES - 1) as f64)
        .collect()
}

pub fn normal(rng: &mut Rng, std: f64) -> f64 {
    std * Distribution::<f64>::sample(&StandardNormal, rng)
}

/// The values of all quantities, in the order of [`QUANTITIES`].
#[derive(Clone, Debug, PartialEq)]
pub struct Physics(pub(super) Vec<Vec<f64>>);

impl Physics {
    /// The physics of the scene, with these factors by the names of quantities.
    pub(super) fn with(hand: &Hand, factors: &[(&str, f64)]) -> Self {
        let values = |quantity: &Quantity| {
            let known = factors.iter().find(|(name, _)| *name == quantity.name);
            let value = known.map_or(quantity.neutral(), |(_, factor)| *factor);
            vec![value; quantity.count(hand)]
        };
        Self(QUANTITIES.iter().map(values).collect())
    }

    /// The physics that a task sets.
    pub(super) fn of_task(config: &EnvConfig) -> Self {
        Self(
            QUANTITIES
                .iter()
                .map(|quantity| (quantity.task)(config))
                .collect(),
        )
    }

    /// What it changes in a scene.
    pub(super) fn changes(&self, hand: &Hand) -> Vec<Change> {
        QUANTITIES
            .iter()
            .zip(&self.0)
            .filter(|(of, values)| values.iter().any(|x| *x != of.neutral()))
            .flat_map(|(quantity, values)| (quantity.change)(hand, values))
            .collect()
    }

    /// The values by name, as a dump reports them.
    pub(super) fn as_json(&self) -> Value {
        let mut object = json!({});
        for (quantity, values) in QUANTITIES.iter().zip(&self.0) {
            object[quantity.name] = match quantity.law {
                Law::Whole(_) => json!(values[0] as u64),
                Law::Uniform(_) | Law::Size(_) => json!(values[0]),
                _ => json!(values),
            };
        }
        object
    }
}

impl Index<&str> for Physics {
    type Output = [f64];

    /// # Panics
    /// Panics if there is no quantity of this name.
    fn index(&self, name: &str) -> &[f64] {
        let place = QUANTITIES.iter().position(|quantity| quantity.name == name);
        &self.0[place.unwrap_or_else(|| panic!("no quantity is called {name}"))]
    }
}

/// The settings of `[env]` that say how the world moves, and not when actions take effect or what is seen.
pub fn physical(config: &EnvConfig) -> Table {
    let mut table = Table::try_from(config).expect("settings are a table");
    let mut names = Vec::from(QUANTITIES.map(|quantity| quantity.setting));
    names.extend(["cone", "sim_dt"]);
    table.retain(|name, _| name != "action_delay" && names.contains(&name));
    table
}

/// Adds to a JSON object the settings of a task that vary its physics, what is observed, and when actions take effect.
pub fn add_settings(config: &EnvConfig, object: &mut Value) {
    let table = Table::try_from(config).expect("settings are a table");
    let settings = QUANTITIES.iter().map(|quantity| quantity.setting);
    for name in settings.chain(OTHERS) {
        object[name] = json!(table[name]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn the_physics_of_the_default_task_are_those_of_the_scene() {
        let config = Config::default();
        for (quantity, values) in QUANTITIES.iter().zip(Physics::of_task(&config.env).0) {
            assert!(
                values.iter().all(|x| *x == quantity.neutral()),
                "{}",
                quantity.name
            );
        }
    }

    #[test]
    fn every_quantity_has_its_two_settings() {
        let config = Config::default();
        let [env, drawn] = [
            Table::try_from(&config.env).unwrap(),
            Table::try_from(&config.randomization).unwrap(),
        ];
        for Quantity {
            name,
            setting,
            unit,
            ..
        } in &QUANTITIES
        {
            assert!(
                env.contains_key(*setting) && drawn.contains_key(*name) && !unit.is_empty(),
                "{name}, {setting}"
            );
        }
    }
}
