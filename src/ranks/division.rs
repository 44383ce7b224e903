//! The shards of a training run, and which of them a rank computes.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use rayon::prelude::*;

use super::{Alone, Ranks, tree_sum};

/// Sums that one task computes.
const CHUNK: usize = 4096;

/// The shards of a training run, and which of them this rank computes. Copies of it share the count of their traffic.
#[derive(Clone)]
pub struct Division {
    shards: usize,
    ranks: Arc<dyn Ranks>,
    sent: Arc<Counters>,
}

#[derive(Default)]
struct Counters {
    nanoseconds: AtomicU64,
    bytes: AtomicU64,
}

/// What talking to the other ranks has cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Traffic {
    /// The time spent, waiting for others included, s.
    pub seconds: f64,
    /// The bytes that this rank has sent to others.
    pub bytes: u64,
}

impl Traffic {
    /// Returns the traffic by name; `NaN` where there is none.
    pub fn named(traffic: Option<&Self>) -> [(&'static str, f64); 2] {
        let [seconds, bytes] = traffic.map_or([f64::NAN; 2], |traffic| [traffic.seconds, traffic.bytes as f64]);
        [("exchange_s", seconds), ("exchange_bytes", bytes)]
    }
}

impl Division {
    /// Divides this number of shards among these ranks.
    ///
    /// # Panics
    /// Panics if either number is not a power of two, or if there are fewer shards than ranks.
    pub fn new(shards: usize, ranks: Arc<dyn Ranks>) -> Self {
        let fits = shards.is_power_of_two() && ranks.size().is_power_of_two() && ranks.size() <= shards;
        assert!(fits, "{shards} shards on {} ranks", ranks.size());
        Self { shards, ranks, sent: Arc::default() }
    }

    /// Assigns this number of shards to one rank.
    pub fn alone(shards: usize) -> Self {
        Self::new(shards, Arc::new(Alone))
    }

    /// Returns the number of all shards.
    pub fn shards(&self) -> usize {
        self.shards
    }

    /// Returns the shards of this rank.
    pub fn own(&self) -> Range<usize> {
        self.part_of(self.shards)
    }

    /// Returns this rank's part of `count` things in a row: parts differ by one thing at most.
    pub fn part_of(&self, count: usize) -> Range<usize> {
        part(count, self.ranks.rank(), self.ranks.size())
    }

    /// Returns the part of each rank of `count` things in a row.
    pub fn parts_of(&self, count: usize) -> Vec<Range<usize>> {
        let ranks = self.ranks.size();
        (0..ranks).map(|rank| part(count, rank, ranks)).collect()
    }

    /// Returns whether there is no other rank.
    pub fn is_alone(&self) -> bool {
        self.ranks.size() == 1
    }

    /// Returns whether this is the rank that reports and saves.
    pub fn is_first(&self) -> bool {
        self.ranks.rank() == 0
    }

    /// Deals these chunks of an array, which follow one another, to the ranks.
    pub fn slices(&self, chunks: &[Range<usize>]) -> Slices {
        Slices::of(chunks, self.ranks.rank(), self.ranks.size())
    }

    /// Returns one number for each chunk of the slices, of which `own` holds those of this rank's chunks.
    pub fn gather_chunks(&self, mut own: Vec<f64>, slices: &Slices) -> Vec<f64> {
        let most = slices.dealt.iter().map(Range::len).max().unwrap_or(0);
        own.resize(most, 0.0);
        let all = self.gather(own);
        let of_ranks = all.chunks(most).zip(&slices.dealt);
        of_ranks.flat_map(|(numbers, dealt)| &numbers[..dealt.len()]).copied().collect()
    }

    /// Replaces this rank's slice of the sum over its shards by that of the sum over all ranks, added as a tree.
    pub fn reduce(&self, numbers: &mut [f32], slices: &Slices) {
        if self.is_alone() {
            return;
        }
        let own = slices.own();
        let elsewhere = 4 * (numbers.len() - own.len());
        let parts = self.timed(elsewhere, || self.ranks.exchange(numbers, &slices.all));
        let parts: Vec<&[f32]> = if own.is_empty() { Vec::new() } else { parts.chunks(own.len()).collect() };
        numbers[own].par_chunks_mut(CHUNK).enumerate().for_each(|(i, out)| {
            let range = i * CHUNK..i * CHUNK + out.len();
            let of_ranks: Vec<&[f32]> = parts.iter().map(|part| &part[range.clone()]).collect();
            tree_sum(out, &of_ranks);
        });
    }

    /// Replaces the slices of the other ranks by what these have computed.
    pub fn share(&self, numbers: &mut [f32], slices: &Slices) {
        if !self.is_alone() {
            self.timed(4 * slices.own().len() * (self.ranks.size() - 1), || self.ranks.share(numbers, &slices.all));
        }
    }

    /// Returns the values with the slices of all ranks.
    pub fn shared<'a>(&self, numbers: &'a [f32], slices: &Slices) -> Cow<'a, [f32]> {
        let mut numbers = Cow::from(numbers);
        if !self.is_alone() {
            self.share(numbers.to_mut(), slices);
        }
        numbers
    }

    /// Returns the values of all ranks, in their order; all ranks pass the same number of values.
    pub fn gather(&self, own: Vec<f64>) -> Vec<f64> {
        self.timed(8 * own.len() * (self.ranks.size() - 1), || self.ranks.gather(own))
    }

    /// Returns the bytes of each rank, in their order, on the first rank, and nothing on the others.
    pub fn gather_at_first(&self, own: Vec<u8>) -> Vec<Vec<u8>> {
        self.timed(if self.is_first() { 0 } else { own.len() }, || self.ranks.gather_at_first(own))
    }

    /// Returns the sums over all shards, added in their order. `of_own` yields one row for each shard of this rank, all
    /// of equal length.
    pub fn total(&self, of_own: impl Iterator<Item = Vec<f64>>) -> Vec<f64> {
        let all = self.gather(of_own.flatten().collect());
        totals(&all, self.shards)
    }

    /// Returns the traffic since the last call.
    pub fn take_traffic(&self) -> Traffic {
        let [nanoseconds, bytes] = [&self.sent.nanoseconds, &self.sent.bytes].map(|of| of.swap(0, Ordering::Relaxed));
        Traffic { seconds: nanoseconds as f64 * 1e-9, bytes }
    }

    fn timed<T>(&self, bytes: usize, talk: impl FnOnce() -> T) -> T {
        if self.is_alone() {
            return talk();
        }
        let started = Instant::now();
        let result = talk();
        self.sent.nanoseconds.fetch_add(started.elapsed().as_nanos() as u64, Ordering::Relaxed);
        self.sent.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
        result
    }
}

/// Returns the sums of each column of rows that follow one another, added in their order.
pub fn totals(all: &[f64], rows: usize) -> Vec<f64> {
    let width = all.len() / rows;
    (0..width).map(|i| all.iter().skip(i).step_by(width).sum()).collect()
}

fn part(count: usize, rank: usize, ranks: usize) -> Range<usize> {
    count * rank / ranks..count * (rank + 1) / ranks
}

/// The slices of an array that the ranks work on: whole chunks, so that what is computed chunk by chunk does not depend on
/// the number of ranks.
pub struct Slices {
    /// The chunks of the array, one after another.
    chunks: Vec<Range<usize>>,
    /// For each rank: its chunks.
    dealt: Vec<Range<usize>>,
    /// For each rank: its values.
    all: Vec<Range<usize>>,
    rank: usize,
}

impl Slices {
    fn of(chunks: &[Range<usize>], rank: usize, ranks: usize) -> Self {
        let dealt: Vec<Range<usize>> = (0..ranks).map(|rank| part(chunks.len(), rank, ranks)).collect();
        let begin =
            |chunk: usize| chunks.get(chunk).map_or_else(|| chunks.last().map_or(0, |last| last.end), |it| it.start);
        let all = dealt.iter().map(|dealt| begin(dealt.start)..begin(dealt.end)).collect();
        Self { chunks: chunks.to_vec(), dealt, all, rank }
    }

    /// Returns the values of this rank.
    pub fn own(&self) -> Range<usize> {
        self.all[self.rank].clone()
    }

    /// Returns the chunks of this rank.
    pub fn own_chunks(&self) -> &[Range<usize>] {
        &self.chunks[self.dealt[self.rank].clone()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn totals_are_added_in_the_order_of_the_shards() {
        let division = Division::alone(4);
        assert_eq!((division.shards(), division.own()), (4, 0..4));
        // 1 is lost when added to 1e16: once in this order, never or twice in others.
        let rows = [1e16, 1.0, -1e16, 1.0].map(|x| vec![x, 1.0]).into_iter();
        assert_eq!(division.total(rows), [1.0, 4.0]);
    }

    #[test]
    fn the_slices_of_the_ranks_are_whole_chunks_and_cover_the_array() {
        let chunks = [0..5, 5..10, 10..12, 12..17, 17..20];
        for (ranks, expected) in [
            (1, vec![Range { start: 0, end: 20 }]),
            (2, vec![0..10, 10..20]),
            (4, vec![0..5, 5..10, 10..12, 12..20]),
            (8, vec![0..0, 0..5, 5..5, 5..10, 10..12, 12..12, 12..17, 17..20]),
        ] {
            let slices = Slices::of(&chunks, 0, ranks);
            assert_eq!(slices.all, expected, "{ranks} ranks");
            let dealt: Vec<usize> = slices.dealt.into_iter().flatten().collect();
            assert_eq!(dealt, [0, 1, 2, 3, 4]);
        }
    }
}
