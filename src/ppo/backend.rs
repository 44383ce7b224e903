//! The interface for computing gradients, implemented by our own kernels and by candle's tensors, their reference.

use std::ops::Add;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use super::policy::Policy;
use super::rollout::Rollout;
use crate::config::PpoConfig;

/// The losses of samples, and measures of how far the policy has moved. They are sums over the samples, or means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Losses {
    /// The clipped surrogate.
    pub surrogate: f64,
    /// The clipped squared error of the values.
    pub value_error: f64,
    /// Squared distance of the mean actions from [-1, 1], beyond which they are clipped.
    pub excess: f64,
    /// KL divergence from the distribution that acted, nats.
    pub kl: f64,
    /// Samples whose ratio was clipped.
    pub clipped: f64,
    /// The largest |ratio - 1|, in sums and means alike.
    pub ratio_error: f64,
}

impl Add for Losses {
    type Output = Self;

    fn add(mut self, mut other: Self) -> Self {
        self.summed()
            .into_iter()
            .zip(other.summed())
            .for_each(|(sum, more)| *sum += *more);
        Self {
            ratio_error: self.ratio_error.max(other.ratio_error),
            ..self
        }
    }
}

impl Losses {
    fn summed(&mut self) -> [&mut f64; 5] {
        let Self {
            surrogate,
            value_error,
            excess,
            kl,
            clipped,
            ratio_error: _,
        } = self;
        [surrogate, value_error, excess, kl, clipped]
    }

    /// The means, given sums over `count` things.
    pub(super) fn means(mut self, count: usize) -> Self {
        self.summed()
            .into_iter()
            .for_each(|sum| *sum /= count as f64);
        self
    }

    /// The loss that is minimised.
    pub(super) fn total(&self, config: &PpoConfig) -> f64 {
        -self.surrogate + config.value_coef * self.value_error + config.bounds_coef * self.excess
    }
}

/// A way to compute gradients.
pub trait GradientBackend: Send + Sync {
    /// Prepares for the minibatches of a rollout, before any step on it. `policy` is the policy that collected it.
    fn begin(&mut self, _policy: &Policy, _rollout: &Rollout) {}

    /// Computes the gradients of the losses of each of these groups of samples with respect to the parameters of the policy. The
    /// losses are means over the `count` samples of the minibatch on all ranks. Writes the gradients to `gradients`, whose memory
    /// is used again. The result is the sums of each group.
    ///
    /// # Errors
    /// Fails if the underlying library fails.
    fn gradients(
        &mut self,
        policy: &Policy,
        config: &PpoConfig,
        rollout: &Rollout,
        groups: &[&[u32]],
        count: usize,
        gradients: &mut Vec<Vec<f32>>,
    ) -> Result<Vec<Losses>>;
}
