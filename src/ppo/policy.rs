//! What acts: two MLPs, actor and critic, a standard deviation that does not depend on the state, and how observations are read.

use anyhow::Result;
use rand::RngExt;

use super::Normalizer;
use super::kernels::{Arithmetic, Net, Workspace};
use super::parameters::{Layer, Layout};
use super::perception::{Perception, Reader};
use crate::config::{Activation, NetConfig};
use crate::ranks::Division;
use crate::rng::{self, Rng};
use crate::spaces::Spaces;

/// The last layer of the actor starts this much smaller, so that the first actions are near the middle of their range.
const LAST_ACTOR_LAYER: f32 = 0.1;

/// A Gaussian policy with diagonal covariance, and the value of states under it. It reads raw observations.
pub struct Policy {
    /// Where which of the parameters lies.
    pub layout: Layout,
    /// All weights, biases and logarithms of standard deviations.
    pub parameters: Vec<f32>,
    /// Statistics of the observations, as they are perceived.
    pub normalizer: Normalizer,
    /// The function after each hidden layer.
    pub activation: Activation,
    /// What it knows of observations and actions.
    pub spaces: Spaces,
    perception: Perception,
}

/// A policy to act with, as it is at one moment. While it lives, the parameters cannot be written to.
pub struct FrozenPolicy<'a> {
    policy: &'a Policy,
    actor: Net<'a>,
    critic: Net<'a>,
    reader: Reader,
    /// `[A]`
    std: Vec<f32>,
}

impl Policy {
    /// A policy with these parameters for environments with these spaces.
    ///
    /// # Errors
    /// A symmetry that the observations do not have.
    pub fn new(net: &NetConfig, spaces: Spaces, parameters: Vec<f32>, normalizer: Normalizer) -> Result<Self> {
        let layout = Layout::new(&net.hidden, spaces.observation_size, spaces.action_size);
        assert_eq!(parameters.len(), layout.count(), "numbers in the parameters");
        let perception = Perception::new(net.symmetry, &spaces)?;
        Ok(Self { layout, parameters, normalizer, activation: net.activation, spaces, perception })
    }

    /// A policy that has learnt nothing, its weights drawn from `seed`, with this standard deviation.
    ///
    /// Weights and biases are uniform in ± 1/√inputs, as in PyTorch's `Linear`.
    ///
    /// # Errors
    /// A symmetry that the observations do not have.
    pub fn random(net: &NetConfig, spaces: Spaces, std: f64, seed: u64) -> Result<Self> {
        let layout = Layout::new(&net.hidden, spaces.observation_size, spaces.action_size);
        let mut rng = rng::stream(seed, "weights", 0);
        let mut parameters = vec![std.ln() as f32; layout.count()];
        let mut fill = |layer: &Layer, shrink: f32| {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            uniform(&mut rng, bound * shrink, &mut parameters[layer.weight.clone()]);
            uniform(&mut rng, bound, &mut parameters[layer.bias.clone()]);
        };
        let (last, hidden) = layout.actor.split_last().expect("a net has layers");
        hidden.iter().for_each(|layer| fill(layer, 1.0));
        fill(last, LAST_ACTOR_LAYER);
        layout.critic.iter().for_each(|layer| fill(layer, 1.0));
        Self::new(net, spaces, parameters, Normalizer::new(spaces.observation_size))
    }

    /// The logarithm of the standard deviations, `[A]`.
    pub fn log_std(&self) -> &[f32] {
        &self.parameters[self.layout.log_std.clone()]
    }

    /// The standard deviations, `[A]`.
    pub fn std(&self) -> Vec<f32> {
        self.log_std().iter().map(|log_std| log_std.exp()).collect()
    }

    /// Takes the raw rows `[B, O]` of these shards and of those of the other ranks into the normaliser.
    pub(super) fn see(&mut self, shards: &[Vec<&[f32]>], division: &Division) {
        let perception = self.perception;
        self.normalizer.update(shards, division, |row| perception.turn(row));
    }

    /// How it reads observations at this moment.
    pub(super) fn reader(&self) -> Reader {
        Reader { perception: self.perception, scaling: self.normalizer.scaling() }
    }

    /// The net of these of its layers.
    pub(super) fn net(&self, layers: &[Layer]) -> Net<'_> {
        Net::new(layers, &self.parameters, self.activation)
    }

    /// What both nets need for blocks of up to `rows` rows.
    pub(super) fn workspace(&self, rows: usize, learning: bool, arithmetic: Arithmetic) -> Workspace {
        Workspace::new(&self.layout.actor, rows, learning, arithmetic)
    }

    /// The policy of this moment.
    pub fn freeze(&self) -> FrozenPolicy<'_> {
        let [actor, critic] = [&self.layout.actor, &self.layout.critic].map(|layers| self.net(layers));
        FrozenPolicy { policy: self, actor, critic, reader: self.reader(), std: self.std() }
    }
}

impl FrozenPolicy<'_> {
    /// What [`FrozenPolicy::forward`] needs, to be used again and again; `rows` rows are computed at a time, in floats.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.policy.workspace(rows, false, Arithmetic::F32)
    }

    /// What it knows of observations and actions.
    pub fn spaces(&self) -> &Spaces {
        &self.policy.spaces
    }

    /// The policy's own standard deviations `[A]`; training may scale its noise (see `Acting`).
    pub fn std(&self) -> &[f32] {
        &self.std
    }

    /// Writes the mean actions `[B, A]` and the values `[B]`, each if asked for, of raw observations `[B, O]`.
    pub fn forward(
        &self,
        observations: &[f32],
        mut means: Option<&mut [f32]>,
        mut values: Option<&mut [f32]>,
        work: &mut Workspace,
    ) {
        let size = self.policy.spaces.observation_size;
        let mut done = 0;
        for raw in observations.chunks(work.rows() * size) {
            let rows = raw.len() / size;
            self.reader.read(raw, &mut work.inputs[..raw.len()]);
            for (net, out) in [(&self.actor, means.as_deref_mut()), (&self.critic, values.as_deref_mut())] {
                let width = net.outputs();
                if let Some(out) = out {
                    out[done * width..][..rows * width].copy_from_slice(net.forward(rows, work));
                }
            }
            done += rows;
        }
    }
}

fn uniform(rng: &mut Rng, bound: f32, numbers: &mut [f32]) {
    numbers.fill_with(|| bound * (2.0 * rng.random::<f32>() - 1.0));
}
