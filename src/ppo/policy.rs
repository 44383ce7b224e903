//! The policy: actor and critic MLPs, the standard deviations of actions, and observation reading.

use rand::RngExt;
use rayon::prelude::*;

use super::Normalizer;
use super::kernels::{Arithmetic, Net, Workspace};
use super::parameters::ParameterLayout;
use super::perception::Perception;
use crate::config::{Activation, PpoConfig};
use crate::ranks::Exchange;
use crate::rng;
use crate::spaces::Spaces;

/// The factor on the initial weights of the actor's last layer. It keeps first actions near the middle of their range.
const LAST_ACTOR_LAYER: f32 = 0.1;

/// The number of rows that are computed together where results must not depend on their number.
pub const GROUP: usize = 64;

/// A Gaussian policy whose actions are independent, and its value function. It reads raw observations.
pub struct Policy {
    /// The location of each parameter.
    pub layout: ParameterLayout,
    /// All weights and biases.
    pub parameters: Vec<f32>,
    /// `[A]`: the logarithms of the standard deviations of the actions. While it learns here, all are equal.
    pub log_std: Vec<f32>,
    /// Whether it has a value function. A policy that was learnt elsewhere has none.
    pub has_critic: bool,
    /// Statistics of the observations after perception.
    pub normalizer: Normalizer,
    /// The function after each hidden layer.
    pub activation: Activation,
    /// The sizes and the structure of observations and actions.
    pub spaces: Spaces,
}

/// A policy in its current state, for acting. While it lives, the parameters cannot be written to.
pub struct FrozenPolicy<'a> {
    /// The policy.
    pub policy: &'a Policy,
    nets: [Net<'a>; 2],
    perception: Perception,
}

impl Policy {
    /// Creates a policy whose parameters are all zero, for environments with these spaces.
    pub fn new(config: &PpoConfig, spaces: Spaces) -> Self {
        let layout = ParameterLayout::new(&config.hidden, &spaces);
        Self {
            parameters: vec![0.0; layout.count()],
            layout,
            log_std: vec![0.0; spaces.action_size],
            has_critic: true,
            normalizer: Normalizer::new(spaces.observation_size),
            activation: config.activation,
            spaces,
        }
    }

    /// Creates an untrained policy with weights drawn from `seed` and the first standard deviation.
    ///
    /// Weights and biases are uniform in ± 1/√inputs, as in PyTorch's `Linear`.
    pub fn random(config: &PpoConfig, spaces: Spaces, seed: u64) -> Self {
        let mut policy = Self {
            log_std: vec![config.std.at(0).ln() as f32; spaces.action_size],
            ..Self::new(config, spaces)
        };
        let mut rng = rng::stream(seed, "weights", 0);
        for (i, layer) in policy
            .layout
            .actor
            .iter()
            .chain(&policy.layout.critic)
            .enumerate()
        {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            let of_weights = if i + 1 == policy.layout.actor.len() {
                bound * LAST_ACTOR_LAYER
            } else {
                bound
            };
            for (range, bound) in [(&layer.weight, of_weights), (&layer.bias, bound)] {
                policy.parameters[range.clone()]
                    .fill_with(|| bound * (2.0 * rng.random::<f32>() - 1.0));
            }
        }
        policy
    }

    /// The standard deviation of all actions of a policy that learns here, at noise scale 1. Training may scale the noise (see
    /// `Acting`).
    pub fn std(&self) -> f32 {
        self.log_std[0].exp()
    }

    /// Adds the raw rows of these arrays `[B, O]` on all ranks to the normaliser.
    pub(super) fn see(&mut self, arrays: &[&[f32]], exchange: &Exchange) {
        let perception = self.perception();
        self.normalizer
            .update(arrays, exchange, |row| perception.canonicalize(row));
    }

    /// The way it currently reads observations.
    pub fn perception(&self) -> Perception {
        Perception::new(&self.spaces, &self.normalizer)
    }

    /// Actor and critic, not prepared.
    pub(super) fn nets(&self) -> [Net<'_>; 2] {
        let layout = &self.layout;
        [&layout.actor, &layout.critic]
            .map(|layers| Net::new(layers, &self.parameters, self.activation))
    }

    /// The policy in its current state.
    pub fn freeze(&self) -> FrozenPolicy<'_> {
        self.freeze_for(Arithmetic::F32)
    }

    /// The policy in its current state, for a few calls. It costs nothing, but each product rearranges the weights anew.
    pub fn freeze_briefly(&self) -> FrozenPolicy<'_> {
        FrozenPolicy {
            policy: self,
            nets: self.nets(),
            perception: self.perception(),
        }
    }

    /// The policy in its current state, prepared for workspaces of this arithmetic.
    pub(super) fn freeze_for(&self, arithmetic: Arithmetic) -> FrozenPolicy<'_> {
        let mut frozen = self.freeze_briefly();
        Net::prepare(&mut frozen.nets, arithmetic, false);
        frozen
    }

    /// The mean actions `[B, A]` for raw observations `[B, O]`. The results for a row are bit for bit the same whatever the other
    /// rows are, because [`GROUP`] rows are always computed together. More than one group is shared among the threads of rayon's
    /// current pool.
    pub fn mean_actions(&self, observations: &[f32]) -> Vec<f32> {
        self.in_groups(observations, 0)
    }

    /// The values `[B]` of raw observations `[B, O]`, computed in the same way.
    pub fn values(&self, observations: &[f32]) -> Vec<f32> {
        self.in_groups(observations, 1)
    }

    /// The outputs of this net.
    fn in_groups(&self, observations: &[f32], net: usize) -> Vec<f32> {
        let frozen = self.freeze_briefly();
        let size = self.spaces.observation_size;
        let width = frozen.nets[net].outputs();
        let rows = observations.len() / size;
        let mut results = vec![0.0; rows.next_multiple_of(GROUP) * width];
        observations
            .par_chunks(GROUP * size)
            .zip(results.par_chunks_mut(GROUP * width))
            .for_each(|(seen, results)| {
                let mut padded = seen.to_vec();
                padded.resize(GROUP * size, 0.0);
                let mut outputs = [Default::default(), Default::default()];
                outputs[net] = results;
                frozen.compute(&padded, outputs, &mut frozen.workspace(GROUP));
            });
        results.truncate(rows * width);
        results
    }
}

impl FrozenPolicy<'_> {
    /// A reusable workspace for [`FrozenPolicy::compute`], which computes `rows` rows at a time, in f32.
    pub fn workspace(&self, rows: usize) -> Workspace {
        Workspace::new(&self.policy.layout.actor, rows, Arithmetic::F32)
    }

    /// Writes the mean actions `[B, A]` and the values `[B]` for raw observations `[B, O]`. An empty slice is left out.
    pub fn compute(
        &self,
        observations: &[f32],
        mut outputs: [&mut [f32]; 2],
        work: &mut Workspace,
    ) {
        let size = self.policy.spaces.observation_size;
        let mut done = 0;
        for raw in observations.chunks(work.rows * size) {
            let rows = raw.len() / size;
            self.perception.apply(raw, &mut work.inputs[..raw.len()]);
            for (net, out) in self
                .nets
                .iter()
                .zip(&mut outputs)
                .filter(|(_, out)| !out.is_empty())
            {
                let width = net.outputs();
                out[done * width..][..rows * width].copy_from_slice(net.forward(rows, work));
            }
            done += rows;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn what_a_fixed_policy_computes_of_a_row_does_not_depend_on_the_other_rows() {
        const SIZE: usize = 75;
        let spaces = Spaces {
            observation_size: SIZE,
            action_size: 20,
            object_and_goal: None,
            distance: |_, _| 0.0,
        };
        let policy = Policy::random(&Config::default().ppo, spaces, 7);
        let observations: Vec<f32> = (0..150 * SIZE)
            .map(|i| ((i * 61 % 97) as f32 - 48.0) / 20.0)
            .collect();
        let actions = policy.mean_actions(&observations);
        let values = policy.values(&observations);
        assert_eq!([actions.len(), values.len()], [150 * 20, 150]);
        for rows in [0, 1, 2, 63, 64, 65, 150] {
            let first = &observations[..rows * SIZE];
            assert_eq!(
                policy.mean_actions(first),
                actions[..rows * 20],
                "{rows} rows"
            );
            assert_eq!(policy.values(first), values[..rows], "{rows} rows");
        }
        let frozen = policy.freeze();
        let mut means = vec![0.0; 64 * 20];
        frozen.compute(
            &observations[..64 * SIZE],
            [&mut means, &mut []],
            &mut frozen.workspace(64),
        );
        assert_eq!(means, actions[..64 * 20], "as a score computes them");
    }
}
