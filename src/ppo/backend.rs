//! The interface for computing gradients, implemented by our own kernels and by candle's tensors, their reference.

use std::ops::AddAssign;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use super::{Policy, Rollout};
use crate::config::PpoConfig;
use crate::ranks::Minibatch;

/// Sums over samples of the losses and of what tells how far the policy has moved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct LossSums {
    /// The clipped surrogate.
    pub surrogate: f64,
    /// The clipped squared error of the values.
    pub value_error: f64,
    /// Squared distances of the means from [-1, 1], beyond which actions are clipped.
    pub excess: f64,
    /// KL divergences of the current distribution from the one that acted, nats.
    pub kl: f64,
    /// Samples whose ratio was clipped.
    pub clipped: f64,
    /// The largest |ratio - 1|, which is not a sum.
    pub ratio_error: f64,
}

impl AddAssign for LossSums {
    fn add_assign(&mut self, other: Self) {
        let Self { surrogate, value_error, excess, kl, clipped, ratio_error } = other;
        self.surrogate += surrogate;
        self.value_error += value_error;
        self.excess += excess;
        self.kl += kl;
        self.clipped += clipped;
        self.ratio_error = self.ratio_error.max(ratio_error);
    }
}

impl LossSums {
    /// Returns the means, given sums over `count` samples.
    pub(super) fn means(self, count: usize) -> Self {
        let n = count as f64;
        let Self { surrogate, value_error, excess, kl, clipped, ratio_error } = self;
        Self {
            surrogate: surrogate / n,
            value_error: value_error / n,
            excess: excess / n,
            kl: kl / n,
            clipped: clipped / n,
            ratio_error,
        }
    }

    /// Returns the loss that is minimised.
    pub(super) fn total(&self, config: &PpoConfig) -> f64 {
        -self.surrogate + config.value_coef * self.value_error + config.bounds_coef * self.excess
    }
}

/// A way to compute gradients.
pub(super) trait GradientBackend: Send {
    /// Prepares for the minibatches of a rollout, before any step on it: `policy` is the one that collected it.
    fn begin(&mut self, policy: &Policy, rollout: &Rollout);

    /// Writes the gradient of the losses of this minibatch with respect to the parameters of the policy, in their
    /// order, added over the groups as a tree. Returns the sums of each group.
    ///
    /// # Errors
    /// Fails if the underlying library fails.
    fn gradient(
        &mut self,
        policy: &Policy,
        rollout: &Rollout,
        minibatch: &Minibatch,
        out: &mut [f32],
    ) -> Result<Vec<LossSums>>;
}
