//! The blocks in which the environments of a rank step.

use super::Exchange;
use crate::schedule::block_sizes;

/// The blocks in which the environments of a rank step. No block spans two shards.
#[derive(Clone, Debug)]
pub struct Blocks {
    /// The number of environments in each block.
    pub sizes: Vec<usize>,
    /// The number of the first block among those of all ranks.
    pub first_block: usize,
    /// The number of the first environment among those of all ranks.
    pub first_env: usize,
    /// The number of environments of all ranks.
    pub envs: usize,
}

impl Exchange {
    /// Deals `own` environments, those of this rank, into blocks.
    ///
    /// # Panics
    /// Panics if they do not divide evenly into this rank's shards.
    pub fn blocks(&self, own: usize) -> Blocks {
        let shards = self.own_shards();
        let in_shard = own / shards.len();
        assert_eq!(in_shard * shards.len(), own, "environments do not divide evenly into {} shards", shards.len());
        let sizes = block_sizes(in_shard, in_shard * self.shards());
        let (first_block, first_env) = (shards.start * sizes.len(), shards.start * in_shard);
        Blocks { sizes: sizes.repeat(shards.len()), first_block, first_env, envs: in_shard * self.shards() }
    }
}
