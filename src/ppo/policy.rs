//! What acts: two MLPs, actor and critic, a standard deviation that does not depend on the state, and the normaliser.

use anyhow::Result;
use candle_core::{Device, Tensor, Var};
use rand::RngExt;

use super::Normalizer;
use super::fused::{Arithmetic, Net, Workspace};
use super::normalizer::Scaling;
use super::reference::Mlp;
use crate::config::{Activation, Backend, PpoConfig, Symmetry};
use crate::rng::{self, Rng};

/// The last layer of the actor starts this much smaller, so that the first actions are near the middle of their range.
const LAST_ACTOR_LAYER: f32 = 0.1;

/// A Gaussian policy with diagonal covariance, and the value of states under it.
pub struct Policy {
    parameters: Vec<(String, Var)>,
    /// Reads observations as the environments' pool gives them.
    pub normalizer: Normalizer,
    hidden: Vec<usize>,
    activation: Activation,
    backend: Backend,
    symmetry: Symmetry,
    sizes: [usize; 2],
}

/// A policy to act with, as it is at one moment: no graph, and no array allocated with our own kernels. While it lives,
/// the parameters cannot be written to.
pub struct FrozenPolicy<'a> {
    policy: &'a Policy,
    nets: Nets<'a>,
    scaling: Scaling,
    /// `[A]`
    std: Vec<f32>,
}

/// Actor and critic.
enum Nets<'a> {
    Fused([Net<'a>; 2]),
    Candle([Mlp; 2]),
}

impl Policy {
    /// A new policy for observations and actions of these sizes, its weights drawn from `seed`.
    ///
    /// Weights and biases are uniform in ± 1/√inputs, as in PyTorch's `Linear`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn new(config: &PpoConfig, observation_size: usize, action_size: usize, seed: u64) -> Result<Self> {
        let mut rng = rng::stream(seed, "weights", 0);
        let mut parameters = Vec::new();
        let mut bound = 0.0;
        for (name, shape) in parameter_shapes(config, observation_size, action_size) {
            let var = match shape[..] {
                [_, inputs] => {
                    bound = 1.0 / (inputs as f32).sqrt();
                    let last = name == format!("actor.{}.weight", config.hidden.len());
                    uniform(&mut rng, if last { bound * LAST_ACTOR_LAYER } else { bound }, &shape)?
                }
                // The bias of the weights before it.
                _ if name != LOG_STD => uniform(&mut rng, bound, &shape)?,
                _ => Var::from_tensor(&Tensor::full(config.init_std.ln() as f32, shape, &Device::Cpu)?)?,
            };
            parameters.push((name, var));
        }
        Ok(Self {
            parameters,
            normalizer: Normalizer::new(observation_size),
            hidden: config.hidden.clone(),
            activation: config.activation,
            backend: config.backend,
            symmetry: config.symmetry,
            sizes: [observation_size, action_size],
        })
    }

    /// The parameters by name, always in the same order.
    pub fn parameters(&self) -> &[(String, Var)] {
        &self.parameters
    }

    /// Whether the parameter of this name belongs to the critic.
    pub(super) fn is_of_critic(name: &str) -> bool {
        name.starts_with("critic.")
    }

    /// The number of weights, biases and standard deviations.
    pub fn parameter_count(&self) -> usize {
        self.parameters.iter().map(|(_, var)| var.elem_count()).sum()
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.sizes[0]
    }

    /// Numbers in an action.
    pub fn action_size(&self) -> usize {
        self.sizes[1]
    }

    /// The parameters of actor and critic.
    fn net_parameters(&self) -> [&[(String, Var)]; 2] {
        let depth = 2 * (self.hidden.len() + 1);
        [&self.parameters[..depth], &self.parameters[depth..2 * depth]]
    }

    /// Actor and critic for our own kernels.
    pub(super) fn fused_nets(&self) -> [Net<'_>; 2] {
        self.net_parameters().map(|parameters| Net::new(parameters, self.activation))
    }

    /// Actor and critic for candle.
    pub(super) fn candle_nets(&self, frozen: bool) -> [Mlp; 2] {
        self.net_parameters().map(|parameters| Mlp::new(parameters, self.activation, frozen))
    }

    /// What both nets need for blocks of up to `rows` rows.
    pub(super) fn workspace(&self, rows: usize, learning: bool, arithmetic: Arithmetic) -> Workspace {
        let [observation, action] = self.sizes;
        let sizes: Vec<usize> = [observation].iter().chain(&self.hidden).chain([&action]).copied().collect();
        Workspace::new(&sizes, self.activation, rows, learning, arithmetic)
    }

    /// The policy of this moment.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn freeze(&self) -> Result<FrozenPolicy<'_>> {
        let nets = match self.backend {
            Backend::Fused => Nets::Fused(self.fused_nets()),
            Backend::Candle => Nets::Candle(self.candle_nets(true)),
        };
        Ok(FrozenPolicy { policy: self, nets, scaling: self.normalizer.scaling(), std: self.std()? })
    }

    /// The logarithm of the standard deviations, `[A]`.
    pub fn log_std(&self) -> &Var {
        &self.parameters.last().expect("log_std is the last parameter").1
    }

    /// The standard deviations, `[A]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn std(&self) -> Result<Vec<f32>> {
        Ok(self.log_std().as_detached_tensor().exp()?.to_vec1()?)
    }

    /// Moves each standard deviation that is out of the bounds to the nearer one.
    pub(super) fn limit_std(&self, [least, most]: [f64; 2]) -> Result<()> {
        let within = self.log_std().as_detached_tensor().maximum(least.ln())?.minimum(most.ln())?;
        Ok(self.log_std().set(&within)?)
    }
}

/// The name of the logarithm of the standard deviations.
const LOG_STD: &str = "log_std";

/// Names and shapes of a policy's parameters, in order: actor, critic, each layer by layer, weights `[outputs, inputs]`
/// before biases; the logarithm of the standard deviations.
pub fn parameter_shapes(config: &PpoConfig, observation_size: usize, action_size: usize) -> Vec<(String, Vec<usize>)> {
    let mut shapes = Vec::new();
    for (net, outputs) in [("actor", action_size), ("critic", 1)] {
        let mut inputs = observation_size;
        for (layer, &size) in config.hidden.iter().chain([&outputs]).enumerate() {
            shapes.push((format!("{net}.{layer}.weight"), vec![size, inputs]));
            shapes.push((format!("{net}.{layer}.bias"), vec![size]));
            inputs = size;
        }
    }
    shapes.push((LOG_STD.into(), vec![action_size]));
    shapes
}

impl FrozenPolicy<'_> {
    /// What [`FrozenPolicy::forward`] needs, to be used again and again; `rows` rows are computed at a time, in floats.
    pub fn workspace(&self, rows: usize) -> Workspace {
        self.policy.workspace(rows, false, Arithmetic::F32)
    }

    /// What it takes to be the same; whoever gives it observations sees to that.
    pub fn symmetry(&self) -> Symmetry {
        self.policy.symmetry
    }

    /// The policy's own standard deviations `[A]`; training may scale its noise (see `Acting`).
    pub fn std(&self) -> &[f32] {
        &self.std
    }

    /// Writes the mean actions `[B, A]` and the values `[B]`, each if asked for, of raw observations `[B, O]`.
    ///
    /// # Errors
    /// Only if candle cannot allocate.
    pub fn forward(
        &self,
        observations: &[f32],
        [mut means, mut values]: [Option<&mut [f32]>; 2],
        work: &mut Workspace,
    ) -> Result<()> {
        let [size, actions] = self.policy.sizes;
        let mut done = 0;
        for raw in observations.chunks(work.rows() * size) {
            let rows = raw.len() / size;
            self.scaling.apply(raw, &mut work.inputs[..raw.len()]);
            for (net, (width, out)) in [(actions, &mut means), (1, &mut values)].into_iter().enumerate() {
                let Some(out) = out.as_deref_mut() else { continue };
                let out = &mut out[done * width..][..rows * width];
                match &self.nets {
                    Nets::Fused(nets) => out.copy_from_slice(nets[net].forward(rows, work)),
                    Nets::Candle(nets) => {
                        let inputs = Tensor::from_slice(&work.inputs[..raw.len()], (rows, size), &Device::Cpu)?;
                        out.copy_from_slice(&nets[net].forward(&inputs)?.flatten_all()?.to_vec1::<f32>()?);
                    }
                }
            }
            done += rows;
        }
        Ok(())
    }
}

fn uniform(rng: &mut Rng, bound: f32, shape: &[usize]) -> Result<Var> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| bound * (2.0 * rng.random::<f32>() - 1.0)).collect();
    Ok(Var::from_vec(values, shape, &Device::Cpu)?)
}
