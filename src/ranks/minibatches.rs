//! The samples of each minibatch: equal parts from each shard, so that a rank draws its own without knowing the others'.

use rand::seq::SliceRandom;

use super::exchange::{Exchange, part};
use crate::rng::Rng;

/// The largest number of groups in a minibatch, unless it has more shards. More groups can occupy more threads (there
/// are two jobs per group), but take more memory and more time to add up.
const GROUPS: usize = 16;

/// The fewest samples of a shard that are worth their own group.
const SMALLEST_GROUP: usize = 32;

/// The samples of this rank that one gradient step learns from.
pub struct Minibatch<'a> {
    /// Groups whose gradients are added up as a binary tree. Their number is a power of two.
    pub groups: Vec<&'a [u32]>,
    /// The number of samples of all ranks.
    pub count: usize,
}

/// The minibatches of an update.
pub struct Minibatches {
    exchange: Exchange,
    /// The samples of this rank, shard after shard.
    order: Vec<u32>,
    /// The samples that a minibatch takes from each shard.
    of_shard: usize,
    shuffles: Vec<Rng>,
}

impl Exchange {
    /// Deals the `samples` samples of this rank, shard after shard, into minibatches of `size` samples of all ranks. `rng` returns
    /// the generator that shuffles the samples of a shard.
    pub fn minibatches(&self, samples: usize, size: usize, rng: impl Fn(u64) -> Rng) -> Minibatches {
        let shuffles = self.own_shards().map(|shard| rng(shard as u64)).collect();
        let order = (0..samples as u32).collect();
        Minibatches { exchange: self.clone(), order, of_shard: size / self.shards, shuffles }
    }

    /// The minibatch of these samples of this rank, shard after shard, equally many of each.
    pub fn minibatch<'a>(&self, samples: &'a [u32]) -> Minibatch<'a> {
        let in_shard = samples.len() / self.own_shards().len();
        self.grouped(samples.chunks(in_shard).collect())
    }

    /// Splits the samples of each shard into groups.
    fn grouped<'a>(&self, shards: Vec<&'a [u32]>) -> Minibatch<'a> {
        let in_shard = shards[0].len();
        let groups = groups_of_shard(in_shard, self.shards);
        let split = |shard: &'a [u32]| (0..groups).map(move |group| &shard[part(in_shard, group, groups)]);
        let groups = shards.into_iter().flat_map(split).collect();
        Minibatch { groups, count: in_shard * self.shards }
    }
}

impl Minibatches {
    /// Shuffles the samples of each shard and returns the minibatches of an epoch.
    pub fn shuffled(&mut self) -> impl Iterator<Item = Minibatch<'_>> {
        let in_shard = self.order.len() / self.shuffles.len();
        let shards = self.order.chunks_mut(in_shard);
        shards.zip(&mut self.shuffles).for_each(|(samples, rng)| samples.shuffle(rng));
        let this = &*self;
        (0..in_shard / this.of_shard).map(move |part| {
            let windows = this.order.chunks(in_shard).map(|shard| &shard[part * this.of_shard..][..this.of_shard]);
            this.exchange.grouped(windows.collect())
        })
    }
}

/// The number of groups that the `samples` samples of each shard are split into. It is a power of two, so that all groups
/// can be added as a tree. It depends on nothing but `samples` and `shards`.
fn groups_of_shard(samples: usize, shards: usize) -> usize {
    let mut groups = (GROUPS / shards).max(1);
    while groups > 1 && samples / groups < SMALLEST_GROUP {
        groups /= 2;
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    #[test]
    fn an_epoch_takes_each_sample_once_and_equally_many_from_each_shard() {
        let exchange = Exchange::alone(4);
        let mut minibatches = exchange.minibatches(4 * 96, 4 * 32, |shard| rng::stream(1, "shuffle", shard));
        for _ in 0..2 {
            let mut seen = Vec::new();
            for minibatch in minibatches.shuffled() {
                assert_eq!((minibatch.count, minibatch.groups.len()), (128, 4));
                for (shard, group) in minibatch.groups.iter().enumerate() {
                    assert!(group.len() == 32 && group.iter().all(|&sample| sample as usize / 96 == shard));
                }
                seen.extend(minibatch.groups.concat());
            }
            seen.sort_unstable();
            assert!(seen.into_iter().eq(0..4 * 96));
        }
    }

    #[test]
    fn the_samples_of_few_shards_are_split_into_groups_of_similar_size() {
        let samples: Vec<u32> = (0..1301).collect();
        let sizes = |shards: usize, samples: &[u32]| {
            let minibatch = Exchange::alone(shards).minibatch(samples);
            minibatch.groups.iter().map(|group| group.len()).collect::<Vec<_>>()
        };
        assert_eq!(sizes(1, &samples[..20]), [20]);
        assert_eq!(sizes(1, &samples[..64]), [32; 2]);
        assert_eq!((sizes(1, &samples).len(), sizes(8, &samples[..1024])), (16, vec![64; 16]));
        assert!(sizes(1, &samples).iter().all(|&size| size == 81 || size == 82));
    }
}
