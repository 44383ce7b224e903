//! The samples of each minibatch: equal parts from each shard, so that a rank draws its own without knowing the others'.

use rand::seq::SliceRandom;

use super::exchange::{Exchange, part};
use crate::rng::Rng;

/// The largest number of groups in a minibatch, unless it has more shards. More groups can occupy more threads (there
/// are two jobs per group), but take more memory and more time to add up.
const GROUPS: usize = 16;

/// The fewest samples of a shard that are worth their own group.
const SMALLEST_GROUP: usize = 32;

impl Exchange {
    /// Deals the `samples` samples of this rank, shard after shard, into minibatches of `size` samples of all ranks. Each call of
    /// the result gives those of another epoch, as [`Exchange::groups`] takes them. `shuffles` has a generator for each shard
    /// of this rank.
    pub fn epochs(
        &self,
        samples: usize,
        size: usize,
        mut shuffles: Vec<Rng>,
    ) -> impl FnMut() -> Vec<Vec<u32>> + use<> {
        let mut order: Vec<u32> = (0..samples as u32).collect();
        let in_shard = samples / shuffles.len();
        let of_shard = size / self.shards;
        move || {
            order
                .chunks_mut(in_shard)
                .zip(&mut shuffles)
                .for_each(|(samples, rng)| samples.shuffle(rng));
            (0..in_shard / of_shard)
                .map(|part| {
                    order
                        .chunks(in_shard)
                        .flat_map(|shard| &shard[part * of_shard..][..of_shard])
                        .copied()
                        .collect()
                })
                .collect()
        }
    }

    /// The groups of these samples of this rank, shard after shard, equally many of each. Their gradients are added up as a
    /// binary tree.
    pub fn groups<'a>(&self, samples: &'a [u32]) -> Vec<&'a [u32]> {
        let in_shard = samples.len() / self.own_shards().len();
        // A power of two, so that all groups can be added as a tree. It depends on nothing but the samples and the shards.
        let mut groups = (GROUPS / self.shards).max(1);
        while groups > 1 && in_shard / groups < SMALLEST_GROUP {
            groups /= 2;
        }
        samples
            .chunks(in_shard)
            .flat_map(|shard| (0..groups).map(move |group| &shard[part(in_shard, group, groups)]))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    #[test]
    fn an_epoch_takes_each_sample_once_and_equally_many_from_each_shard() {
        let exchange = Exchange::alone(4);
        let mut epoch = exchange.epochs(
            4 * 96,
            4 * 32,
            (0..4)
                .map(|shard| rng::stream(1, "shuffle", shard))
                .collect(),
        );
        for _ in 0..2 {
            let mut seen = Vec::new();
            for samples in epoch() {
                let groups = exchange.groups(&samples);
                assert_eq!((samples.len(), groups.len()), (128, 4));
                for (shard, group) in groups.iter().enumerate() {
                    assert!(
                        group.len() == 32
                            && group.iter().all(|&sample| sample as usize / 96 == shard)
                    );
                }
                seen.extend(groups.concat());
            }
            seen.sort_unstable();
            assert!(seen.into_iter().eq(0..4 * 96));
        }
    }

    #[test]
    fn the_samples_of_few_shards_are_split_into_groups_of_similar_size() {
        let samples: Vec<u32> = (0..1301).collect();
        let sizes = |shards: usize, samples: &[u32]| {
            Exchange::alone(shards)
                .groups(samples)
                .iter()
                .map(|group| group.len())
                .collect::<Vec<_>>()
        };
        assert_eq!(sizes(1, &samples[..20]), [20]);
        assert_eq!(sizes(1, &samples[..64]), [32; 2]);
        assert_eq!(
            (sizes(1, &samples).len(), sizes(8, &samples[..1024])),
            (16, vec![64; 16])
        );
        assert!(
            sizes(1, &samples)
                .iter()
                .all(|&size| size == 81 || size == 82)
        );
    }
}
