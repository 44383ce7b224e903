//! What the ranks of a training run compute together, and how they exchange it.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use anyhow::{Result, ensure};
use rayon::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::Ranks;

/// The shards of a training run, the shards that this rank computes, and the exchange with the other ranks. All ranks make the same
/// calls in the same order. Copies share the count of their traffic.
#[derive(Clone)]
pub struct Exchange {
    /// The number of all shards.
    pub shards: usize,
    /// The number of this rank.
    pub(super) rank: usize,
    /// The number of all ranks.
    pub(super) size: usize,
    /// All ranks, if they can talk to each other.
    ranks: Option<Arc<dyn Ranks>>,
    /// The nanoseconds spent, and the bytes sent.
    sent: Arc<[AtomicU64; 2]>,
}

impl Exchange {
    /// Creates the exchange of rank `rank` of `size`, with a single shard.
    pub fn new(rank: usize, size: usize, ranks: Arc<dyn Ranks>) -> Self {
        Self {
            rank,
            size,
            ranks: Some(ranks),
            ..Self::alone(1)
        }
    }

    /// Creates the exchange of one rank that computes all shards.
    pub fn alone(shards: usize) -> Self {
        Self {
            shards,
            rank: 0,
            size: 1,
            ranks: None,
            sent: Arc::default(),
        }
    }

    /// Deals this number of shards, a power of two, to the ranks.
    ///
    /// # Errors
    /// Fails if the number of ranks is not a power of two, or if there are fewer shards.
    pub fn over(self, shards: usize) -> Result<Self> {
        let ranks = self.size;
        ensure!(
            ranks.is_power_of_two(),
            "{ranks} ranks: their number must be a power of two"
        );
        ensure!(
            ranks <= shards,
            "{ranks} ranks, but the training run has only {shards} shards (run.shards), and each rank needs at least one"
        );
        Ok(Self { shards, ..self })
    }

    /// The shards of this rank.
    pub fn own_shards(&self) -> Range<usize> {
        self.own(self.shards)
    }

    /// This rank's part of `count` things in a row: parts differ by one thing at most.
    pub fn own(&self, count: usize) -> Range<usize> {
        part(count, self.rank, self.size)
    }

    /// The number of things of all ranks, if each has `own` of them.
    pub fn of_all(&self, own: usize) -> usize {
        own * self.size
    }

    /// Whether there is no other rank.
    pub fn is_alone(&self) -> bool {
        self.size == 1
    }

    /// Whether this is the rank that reports and saves.
    pub fn is_first(&self) -> bool {
        self.rank == 0
    }

    /// Ends all ranks at once, of which there are several.
    pub(super) fn abort(&self) -> ! {
        self.ranks.as_ref().expect("there are several").abort()
    }

    /// Computes `of` from the parts of each shard, and adds the results of all shards in their order. The parts belong to this
    /// rank, shard after shard, equally many for each.
    pub fn sum<P: Sync, T: Serialize + DeserializeOwned + Send>(
        &self,
        parts: &[P],
        of: impl Fn(&[P]) -> T + Send + Sync,
        add: impl Fn(T, T) -> T,
    ) -> T {
        self.in_order(
            parts
                .par_chunks(parts.len() / self.own_shards().len())
                .map(of)
                .collect(),
            add,
        )
    }

    /// Adds the results of all shards, of which this rank has its `own`, in the order of the shards.
    pub fn in_order<T: Serialize + DeserializeOwned>(
        &self,
        own: Vec<T>,
        add: impl Fn(T, T) -> T,
    ) -> T {
        self.all_gather(own)
            .into_iter()
            .flatten()
            .reduce(add)
            .expect("there is a shard")
    }

    /// The values of all ranks, in their order.
    pub fn all_gather<T: Serialize + DeserializeOwned>(&self, own: T) -> Vec<T> {
        let Some(ranks) = &self.ranks else {
            return vec![own];
        };
        let own = postcard::to_stdvec(&own).expect("values of known size");
        let all = self.timed(own.len() * (self.size - 1), || ranks.all_gather(own));
        all.iter()
            .map(|bytes| postcard::from_bytes(bytes).expect("the ranks run the same program"))
            .collect()
    }

    /// The value of the first rank. The others pass `None`.
    pub fn broadcast<T: Serialize + DeserializeOwned>(&self, first: Option<T>) -> T {
        self.all_gather(first)
            .swap_remove(0)
            .expect("the first rank has it")
    }

    /// Sends each rank its slice, and returns the slices that all have sent, this rank's among them.
    pub(super) fn all_to_all(&self, numbers: &[f32], slices: &[Range<usize>]) -> Vec<f32> {
        let ranks = self.ranks.as_ref().expect("there are several");
        self.timed(4 * (numbers.len() - slices[self.rank].len()), || {
            ranks.all_to_all(numbers, slices)
        })
    }

    /// Replaces the slices of the other ranks by what these have computed.
    pub(super) fn all_gather_slices(&self, numbers: &mut [f32], slices: &[Range<usize>]) {
        if let Some(ranks) = &self.ranks {
            self.timed(4 * slices[self.rank].len() * (self.size - 1), || {
                ranks.all_gather_slices(numbers, slices)
            });
        }
    }

    /// The traffic since the last call, by name: the time spent (s, including the wait for others) and the bytes sent
    /// by this rank. Both are `NaN` for a single rank.
    pub fn take_traffic(&self) -> [(&'static str, f64); 2] {
        let [nanoseconds, bytes] = self
            .sent
            .each_ref()
            .map(|sum| sum.swap(0, Ordering::Relaxed));
        let known = |value: f64| if self.is_alone() { f64::NAN } else { value };
        [
            ("exchange_s", known(nanoseconds as f64 * 1e-9)),
            ("exchange_bytes", known(bytes as f64)),
        ]
    }

    fn timed<T>(&self, bytes: usize, talk: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let result = talk();
        self.sent[0].fetch_add(started.elapsed().as_nanos() as u64, Ordering::Relaxed);
        self.sent[1].fetch_add(bytes as u64, Ordering::Relaxed);
        result
    }
}

pub fn part(count: usize, rank: usize, ranks: usize) -> Range<usize> {
    count * rank / ranks..count * (rank + 1) / ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_added_in_the_order_of_the_shards() {
        let exchange = Exchange::alone(4);
        // 1 is lost when added to 1e16: once in this order, never or twice in others.
        let of_shard = |parts: &[f64]| parts.iter().sum::<f64>();
        assert_eq!(
            exchange.sum(&[1e16, 1.0, -1e16, 1.0], of_shard, |sum, next| sum + next),
            1.0
        );
        assert_eq!(
            exchange.sum(
                &[1e16, 1.0, 0.0, 0.0, -1e16, 1.0, 0.0, 1.0],
                of_shard,
                |sum, next| sum + next
            ),
            1.0
        );
    }

    #[test]
    fn trainings_that_cannot_be_dealt_to_the_ranks_are_refused() {
        let three = Exchange {
            size: 3,
            ..Exchange::alone(1)
        };
        let refused = three.over(16).err().unwrap().to_string();
        assert!(
            refused.contains("3 ranks") && refused.contains("power of two"),
            "{refused}"
        );
    }
}
