//! The randomised episodes of a training: what each draws, and the models that it needs.
//!
//! What a randomised episode draws depends only on the seed and the number of the episode. A resumed run therefore draws the same
//! again, and all that is saved is whether the episode is randomised.

use std::sync::Arc;

use anyhow::{Context, Result};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};

use super::sensing::Spread;
use super::task::Task;
use crate::config::RandomizationConfig;
use crate::rng::{self, Rng};
use crate::sim::{Body, Scene, Simulation, Variants, Variation};

/// The number of sizes of the cube. Each is a compiled scene, because MuJoCo cannot change sizes in a compiled one.
const SIZES: usize = 5;

/// The number of quantities that are varied, or not, independently of one another.
const QUANTITIES: usize = 13;

/// The random physics, noise and delays of a training.
pub struct Randomization {
    config: RandomizationConfig,
    /// The scene of the episodes that are not randomised. Its physics are those of the task.
    nominal: Scene,
    variants: Variants,
    /// The factor on the lengths of the cube in each variant; the last one is the nominal scene.
    sizes: Vec<f64>,
    /// The number of variants, from the first one, of which one is drawn.
    drawn_sizes: usize,
    hand: Body,
    noise: Spread,
    bias: Spread,
}

/// What a randomised episode has drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Draw {
    /// The number of the variant of the scene.
    variant: usize,
    /// The factor on the lengths of the cube.
    pub cube_size: f64,
    /// The factor on the friction of all geoms.
    pub friction: f64,
    /// The factor on the mass and inertia of the cube.
    pub cube_mass: f64,
    /// The factor on the masses and inertias of the hand.
    pub hand_mass: f64,
    /// The shift of the cube's centre of mass, m.
    pub cube_com: [f64; 3],
    /// What is added to gravity, m/s².
    pub gravity: [f64; 3],
    /// The factors on the stiffness of the actuators, in action order.
    pub gains: Vec<f64>,
    /// The factors on the damping of the joints, in observation order.
    pub damping: Vec<f64>,
    /// The factors on the dry friction of the joints, in observation order.
    pub frictionloss: Vec<f64>,
    /// Control steps between an action and its effect, in addition to those of the task.
    pub delay: u32,
    /// Whether there is noise on the observations.
    pub has_noise: bool,
    /// Whether there is an offset of the observations.
    pub has_bias: bool,
    /// Whether there are forces on the cube.
    pub has_pushes: bool,
}

impl Randomization {
    /// Prepares the randomised episodes of a training; `None` if it has none.
    ///
    /// # Errors
    /// Fails if the scene cannot be varied in this way, or if a setting names an unknown group of the observation.
    pub fn new(task: &Task, config: &RandomizationConfig) -> Result<Option<Arc<Self>>> {
        let noise = Spread::of(&config.noise).context("randomization.noise")?;
        let bias = Spread::of(&config.bias).context("randomization.bias")?;
        if !config.happens() {
            return Ok(None);
        }
        let shifts = config.cube_com > 0.0;
        let nominal = if shifts { task.scene_with(1.0, true)? } else { task.scene.clone() };
        let [low, high] = config.cube_size;
        let place = |i: usize| low + (high - low) * i as f64 / (SIZES - 1) as f64;
        let mut sizes: Vec<f64> = if low == high { vec![low] } else { (0..SIZES).map(place).collect() };
        let drawn_sizes = sizes.len();
        sizes.push(1.0);
        let scene = |&size: &f64| if size == 1.0 { Ok(nominal.clone()) } else { task.scene_with(size, shifts) };
        let scenes = sizes.iter().map(scene).collect::<Result<_>>().context("randomization.cube_size")?;
        Ok(Some(Arc::new(Self {
            variants: Variants::new(scenes)?,
            hand: nominal.root(task.hand.fingertips[0]),
            config: config.clone(),
            nominal,
            sizes,
            drawn_sizes,
            noise,
            bias,
        })))
    }

    /// Returns the scene of the episodes that are not randomised.
    pub fn nominal(&self) -> &Scene {
        &self.nominal
    }

    /// Returns the most control steps between an action and its effect, in addition to those of the task.
    pub fn most_delay(&self) -> u32 {
        self.config.delay[1]
    }

    /// Draws the episode of `rng`, which may be at any position; `None` if the episode is not randomised, which happens with
    /// probability 1 - `share`. All numbers are drawn in any case, so that one setting does not change what is drawn for another.
    pub fn draw(&self, rng: &Rng, share: f64) -> Option<Draw> {
        let of = &self.config;
        let rng = &mut rng::beside(rng, "randomization");
        let randomized = rng::uniform(rng, 0.0, 1.0) < share;
        let mut is_varied = [(); QUANTITIES].map(|()| rng::uniform(rng, 0.0, 1.0) < of.each).into_iter();
        let mut varied = || is_varied.next().expect("one for each quantity");
        let mut between = |[low, high]: [f64; 2], rng: &mut Rng| {
            let drawn = rng::uniform(rng, low, high);
            if varied() { drawn } else { 1.0 }
        };
        let friction = between(of.friction, rng);
        let cube_mass = between(of.cube_mass, rng);
        let hand_mass = between(of.hand_mass, rng);
        let variant = (rng::uniform(rng, 0.0, 1.0) * self.drawn_sizes as f64) as usize;
        let variant = if varied() { variant } else { self.drawn_sizes };
        let delay = rng.random_range(of.delay[0]..=of.delay[1]) * u32::from(varied());
        let mut around_zero = |draw: &dyn Fn(&mut Rng) -> f64, rng: &mut Rng| {
            let drawn = [(); 3].map(|()| draw(rng));
            if varied() { drawn } else { [0.0; 3] }
        };
        let cube_com = around_zero(&|rng| rng::uniform(rng, -of.cube_com, of.cube_com), rng);
        let gravity = around_zero(&|rng| normal(rng, of.gravity), rng);
        // With probability ½ all joints have the same factor. Independent draws alone would leave their mean near the middle, and a
        // policy that has met only such hands fails on one whose joints are all damped little.
        let mut factors = |[low, high]: [f64; 2], count: usize| {
            let together = rng::uniform(rng, 0.0, 1.0) < 0.5;
            let own: Vec<f64> = (0..count).map(|_| rng::uniform(rng, low.ln(), high.ln()).exp()).collect();
            let drawn = if together { vec![own[0]; count] } else { own };
            if varied() { drawn } else { vec![1.0; count] }
        };
        let (gains, damping) = (factors(of.gains, super::ACTION_SIZE), factors(of.damping, super::JOINTS.len()));
        let frictionloss = factors(of.frictionloss, super::JOINTS.len());
        let [has_noise, has_bias, has_pushes] = [(); 3].map(|()| varied());
        let cube_size = self.sizes[variant];
        randomized.then_some(Draw {
            variant,
            cube_size,
            friction,
            cube_mass,
            hand_mass,
            cube_com,
            gravity,
            gains,
            damping,
            frictionloss,
            delay,
            has_noise,
            has_bias,
            has_pushes,
        })
    }

    /// Gives the simulation the physics of a draw; its state must be reset after it.
    pub fn vary(&self, simulation: &mut Simulation, draw: &Draw, task: &Task) {
        self.variants.vary(simulation, draw.variant, &self.variation(draw, task));
    }

    /// Returns a scene with the physics of a draw.
    pub fn scene_of(&self, draw: &Draw, task: &Task) -> Scene {
        self.variants.scene(draw.variant, &self.variation(draw, task))
    }

    fn variation(&self, draw: &Draw, task: &Task) -> Variation {
        let (cube, joints, actuators) = (task.hand.cube.body, task.hand.joints, task.hand.actuators);
        Variation {
            friction: draw.friction,
            masses: vec![(cube, draw.cube_mass), (self.hand, draw.hand_mass)],
            shift: Some((cube, draw.cube_com)),
            gains: actuators.into_iter().zip(draw.gains.iter().copied()).collect(),
            damping: joints.into_iter().zip(draw.damping.iter().copied()).collect(),
            frictionloss: joints.into_iter().zip(draw.frictionloss.iter().copied()).collect(),
            gravity: draw.gravity,
        }
    }

    /// Returns the noise on the observations of an episode, if there is any.
    pub(super) fn noise(&self, draw: &Draw) -> Option<&Spread> {
        Some(&self.noise).filter(|_| draw.has_noise)
    }

    /// Draws the offset of the observations in the episode of `rng`.
    pub(super) fn draw_bias(&self, draw: &Draw, rng: &Rng) -> Vec<(usize, f32)> {
        let drawn = self.bias.draw(&mut rng::beside(rng, "bias of randomization")).collect();
        if draw.has_bias { drawn } else { Vec::new() }
    }

    /// Returns the force on the cube, N, in a step (from 0) of the episode of `rng`; `None` if it has none.
    pub(super) fn push(&self, draw: &Draw, rng: &Rng, step: u32) -> Option<[f64; 3]> {
        let std = self.config.push;
        let rng = &mut rng::beside_at(rng, "push", step / self.config.push_steps);
        (draw.has_pushes && std > 0.0).then(|| [(); 3].map(|()| normal(rng, std)))
    }
}

fn normal(rng: &mut Rng, std: f64) -> f64 {
    std * Distribution::<f64>::sample(&StandardNormal, rng)
}
