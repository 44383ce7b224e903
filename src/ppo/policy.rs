//! The policy: actor and critic MLPs, one standard deviation for all actions, and observation reading.

use anyhow::Result;
use rand::RngExt;

use super::Normalizer;
use super::kernels::{Arithmetic, Net, Workspace};
use super::parameters::{Layer, Layout};
use super::perception::{InputTransform, Perception};
use crate::config::{Activation, NetConfig};
use crate::ranks::Exchange;
use crate::rng;
use crate::spaces::Spaces;

/// The factor on the initial weights of the actor's last layer; it keeps first actions near the middle of their range.
const LAST_ACTOR_LAYER: f32 = 0.1;

/// A Gaussian policy whose actions are independent and have the same standard deviation, and its value function. It reads raw observations.
pub struct Policy {
    /// The location of each parameter.
    pub layout: Layout,
    /// All weights and biases.
    pub parameters: Vec<f32>,
    /// The logarithm of the standard deviation of each action.
    pub log_std: f32,
    /// Statistics of the observations after perception.
    pub normalizer: Normalizer,
    /// The function after each hidden layer.
    pub activation: Activation,
    /// The sizes and the structure of observations and actions.
    pub spaces: Spaces,
    perception: Perception,
}

/// A policy in its current state, for acting. While it lives, the parameters cannot be written to.
pub struct FrozenPolicy<'a> {
    policy: &'a Policy,
    actor: Net<'a>,
    critic: Net<'a>,
    transform: InputTransform,
}

impl Policy {
    /// Creates a policy whose parameters are all zero, for environments with these spaces.
    ///
    /// # Errors
    /// Fails if the observations do not have the symmetry of `net`.
    pub fn new(net: &NetConfig, spaces: Spaces) -> Result<Self> {
        let layout = Layout::new(&net.hidden, &spaces);
        let (parameters, normalizer) = (vec![0.0; layout.count()], Normalizer::new(spaces.observation_size));
        let perception = Perception::new(net.symmetry, &spaces)?;
        Ok(Self { layout, parameters, log_std: 0.0, normalizer, activation: net.activation, spaces, perception })
    }

    /// Creates an untrained policy with weights drawn from `seed` and this standard deviation.
    ///
    /// Weights and biases are uniform in ± 1/√inputs, as in PyTorch's `Linear`.
    ///
    /// # Errors
    /// Fails if the observations do not have the symmetry of `net`.
    pub fn random(net: &NetConfig, spaces: Spaces, std: f64, seed: u64) -> Result<Self> {
        let mut policy = Self { log_std: std.ln() as f32, ..Self::new(net, spaces)? };
        let mut rng = rng::stream(seed, "weights", 0);
        for (i, layer) in policy.layout.layers().enumerate() {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            let is_last_of_actor = i + 1 == policy.layout.actor.len();
            let of_weights = if is_last_of_actor { bound * LAST_ACTOR_LAYER } else { bound };
            for (range, bound) in [(&layer.weight, of_weights), (&layer.bias, bound)] {
                policy.parameters[range.clone()].fill_with(|| bound * (2.0 * rng.random::<f32>() - 1.0));
            }
        }
        Ok(policy)
    }

    /// Returns the standard deviation of each action at noise scale 1; training may scale the noise (see `Acting`).
    pub fn std(&self) -> f32 {
        self.log_std.exp()
    }

    /// Adds the raw rows of these arrays `[B, O]`, and of those that the exchange knows, to the normaliser.
    pub(super) fn see(&mut self, arrays: &[&[f32]], exchange: &Exchange) {
        let perception = self.perception;
        self.normalizer.update(arrays, exchange, |row| perception.canonicalize(row));
    }

    /// Returns the way it currently reads observations.
    pub fn input_transform(&self) -> InputTransform {
        InputTransform::new(self.perception, &self.normalizer)
    }

    /// Returns actor and critic, prepared for workspaces of this arithmetic, for `learning` or for acting.
    pub(super) fn nets(&self, arithmetic: Arithmetic, learning: bool) -> [Net<'_>; 2] {
        let net = |layers: &Vec<Layer>| Net::new(layers, &self.parameters, self.activation);
        [&self.layout.actor, &self.layout.critic].map(|layers| net(layers).prepared(arithmetic, learning))
    }

    /// Returns the policy in its current state.
    pub fn freeze(&self) -> FrozenPolicy<'_> {
        self.freeze_for(Arithmetic::F32)
    }

    /// Returns the policy in its current state, prepared for workspaces of this arithmetic.
    pub(super) fn freeze_for(&self, arithmetic: Arithmetic) -> FrozenPolicy<'_> {
        let [actor, critic] = self.nets(arithmetic, false);
        FrozenPolicy { policy: self, actor, critic, transform: self.input_transform() }
    }
}

impl FrozenPolicy<'_> {
    /// Returns a reusable workspace for [`FrozenPolicy::mean_actions`] and its siblings, which compute `rows` rows at a
    /// time, in f32.
    pub fn workspace(&self, rows: usize) -> Workspace {
        Workspace::new(&self.policy.layout.actor, rows, false, Arithmetic::F32)
    }

    /// Returns the sizes and the structure of observations and actions.
    pub fn spaces(&self) -> &Spaces {
        &self.policy.spaces
    }

    /// Returns the standard deviation of each action (see [`Policy::std`]).
    pub fn std(&self) -> f32 {
        self.policy.std()
    }

    /// Writes the mean actions `[B, A]` for raw observations `[B, O]`.
    pub fn mean_actions(&self, observations: &[f32], means: &mut [f32], work: &mut Workspace) {
        self.forward(observations, &mut [(&self.actor, means)], work);
    }

    /// Writes the values `[B]` of raw observations `[B, O]`.
    pub fn values(&self, observations: &[f32], values: &mut [f32], work: &mut Workspace) {
        self.forward(observations, &mut [(&self.critic, values)], work);
    }

    /// Writes both, mean actions and values, and reads the observations only once.
    pub fn actions_and_values(
        &self,
        observations: &[f32],
        (means, values): (&mut [f32], &mut [f32]),
        work: &mut Workspace,
    ) {
        self.forward(observations, &mut [(&self.actor, means), (&self.critic, values)], work);
    }

    fn forward(&self, observations: &[f32], outputs: &mut [(&Net, &mut [f32])], work: &mut Workspace) {
        let size = self.policy.spaces.observation_size;
        let mut done = 0;
        for raw in observations.chunks(work.rows() * size) {
            let rows = raw.len() / size;
            self.transform.apply(raw, &mut work.inputs[..raw.len()]);
            for (net, out) in &mut *outputs {
                let width = net.outputs();
                out[done * width..][..rows * width].copy_from_slice(net.forward(rows, work));
            }
            done += rows;
        }
    }
}
