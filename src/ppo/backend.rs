//! The interface for computing gradients, implemented by our own kernels and by candle's tensors, their reference.

use anyhow::Result;

use super::{Policy, Rollout};

/// Sums over the samples of one shard in a minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ShardSums {
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
    /// The largest |ratio - 1|.
    pub ratio_error: f64,
}

/// The samples that one step learns from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Minibatch<'a> {
    /// The samples of this rank, shard after shard, the same number from each.
    pub samples: &'a [u32],
    /// The number of shards of this rank.
    pub own_shards: usize,
    /// The number of shards of all ranks.
    pub shards: usize,
}

impl Minibatch<'_> {
    /// Returns the number of samples of each shard.
    pub(super) fn in_shard(&self) -> usize {
        self.samples.len() / self.own_shards
    }

    /// Returns the number of samples of all ranks.
    pub(super) fn count(&self) -> usize {
        self.in_shard() * self.shards
    }
}

/// A way to compute gradients.
pub(super) trait GradientBackend: Send {
    /// Prepares for the minibatches of a rollout, before any step on it: `policy` is the one that collected it.
    fn begin(&mut self, policy: &Policy, rollout: &Rollout);

    /// Writes the gradient of the losses of this minibatch with respect to the parameters of the policy, in their
    /// order: this rank's contribution, added over its shards as a tree. Returns the sums of each of its shards.
    ///
    /// # Errors
    /// Fails if the underlying library fails.
    fn gradient(
        &mut self,
        policy: &Policy,
        rollout: &Rollout,
        minibatch: Minibatch,
        out: &mut [f32],
    ) -> Result<Vec<ShardSums>>;
}
