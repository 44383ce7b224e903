//! What a way to compute gradients must do. There are two: our own kernels, and candle's tensors, their reference.

use anyhow::Result;

use super::{Policy, Rollout};

/// Sums over the samples of one shard in a minibatch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ShardSums {
    /// The clipped surrogate.
    pub surrogate: f64,
    /// The clipped squared error of the values.
    pub value_error: f64,
    /// Squared distances of the means from [-1, 1], beyond which actions are clipped.
    pub excess: f64,
    /// KL divergences of the present distribution from the one that acted, nats.
    pub kl: f64,
    /// Samples whose ratio was clipped.
    pub clipped: f64,
    /// The largest |ratio - 1|.
    pub ratio_error: f64,
}

/// Samples that are learnt from in one step.
#[derive(Clone, Copy, Debug)]
pub struct Minibatch<'a> {
    /// Those of this rank, shard after shard, of each as many.
    pub samples: &'a [u32],
    /// The shards of this rank.
    pub own_shards: usize,
    /// The shards of all ranks.
    pub shards: usize,
}

impl Minibatch<'_> {
    /// Samples of each shard.
    pub fn in_shard(&self) -> usize {
        self.samples.len() / self.own_shards
    }

    /// Samples of all ranks.
    pub fn count(&self) -> usize {
        self.in_shard() * self.shards
    }
}

/// A way to compute gradients.
pub trait Backend: Send {
    /// Prepares for the minibatches of a rollout, before any step on it: this is the policy that has collected it.
    fn begin(&mut self, policy: &Policy, rollout: &Rollout);

    /// Writes the gradient of the losses of this minibatch with respect to the parameters of the policy, in their order: the part of
    /// it that this rank's samples make, added over its shards as a tree. The sums of each of its shards.
    ///
    /// # Errors
    /// Those of the library that computes.
    fn gradient(
        &mut self,
        policy: &Policy,
        rollout: &Rollout,
        minibatch: Minibatch,
        out: &mut [f32],
    ) -> Result<Vec<ShardSums>>;
}
