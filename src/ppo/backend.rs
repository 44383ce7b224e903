//! What a way to compute gradients must do. There are two: our own kernels, and candle's tensors, their reference.

use anyhow::Result;

use super::{Policy, Rollout};

/// Figures of one minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// What is minimised.
    pub total: f64,
    /// The clipped surrogate, negated.
    pub policy: f64,
    /// The clipped squared error of the values.
    pub value: f64,
    /// Mean squared distance of the means from [-1, 1], beyond which actions are clipped.
    pub excess: f64,
    /// Mean KL divergence of the present distribution from the one that acted, nats.
    pub kl: f64,
    /// Fraction of the samples whose ratio was clipped.
    pub clip_fraction: f64,
    /// The largest |ratio - 1|.
    pub ratio_error: f64,
}

/// A way to compute gradients.
pub trait Backend: Send {
    /// Prepares for the minibatches of a rollout, before any step on it: this is the policy that has collected it.
    fn begin(&mut self, policy: &Policy, rollout: &Rollout);

    /// Writes the gradient of the losses of these samples, all of which lie in the rollout, with respect to the parameters of the
    /// policy, in their order.
    ///
    /// # Errors
    /// Those of the library that computes.
    fn gradient(&mut self, policy: &Policy, rollout: &Rollout, samples: &[u32], out: &mut [f32]) -> Result<Losses>;
}
