//! The slices of an array that the ranks work on.

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::exchange::{Exchange, part};
use super::tree_sum;

/// Sums that one task computes.
const CHUNK: usize = 4096;

/// The slices of an array that the ranks work on: whole chunks, so that what is computed chunk by chunk does not depend on
/// the number of ranks.
pub struct Slices {
    exchange: Exchange,
    /// The chunks of this rank.
    chunks: Vec<Range<usize>>,
    /// For each rank: its values.
    all: Vec<Range<usize>>,
    /// The values of this rank.
    own: Range<usize>,
}

impl Exchange {
    /// Deals the chunks of an array, which follow one another, to the ranks.
    pub fn slices(&self, chunks: &[Range<usize>]) -> Slices {
        Slices::new(self.clone(), chunks, (self.rank(), self.ranks()))
    }
}

impl Slices {
    fn new(exchange: Exchange, chunks: &[Range<usize>], (rank, ranks): (usize, usize)) -> Self {
        let begin =
            |chunk: usize| chunks.get(chunk).map_or_else(|| chunks.last().map_or(0, |last| last.end), |it| it.start);
        let dealt = (0..ranks).map(|rank| part(chunks.len(), rank, ranks));
        let all: Vec<Range<usize>> = dealt.map(|dealt| begin(dealt.start)..begin(dealt.end)).collect();
        let own = all[rank].clone();
        Self { exchange, chunks: chunks[part(chunks.len(), rank, ranks)].to_vec(), all, own }
    }

    /// Returns the range of this rank's values.
    pub fn own(&self) -> Range<usize> {
        self.own.clone()
    }

    /// Computes `of` for each chunk of the array, this rank for its own, and returns the results in the order of the chunks.
    pub fn of_chunks(&self, of: impl Fn(&Range<usize>) -> f64 + Send + Sync) -> Vec<f64> {
        self.exchange.all_gather(self.chunks.par_iter().map(of).collect::<Vec<f64>>()).concat()
    }

    /// Replaces this rank's slice of a sum over its shards by the slice of the sum over all ranks, added as a tree.
    pub fn reduce_scatter(&self, numbers: &mut [f32]) {
        let Some(parts) = self.exchange.all_to_all(numbers, &self.all, self.own.len()) else { return };
        let parts: Vec<&[f32]> = if self.own.is_empty() { Vec::new() } else { parts.chunks(self.own.len()).collect() };
        numbers[self.own()].par_chunks_mut(CHUNK).enumerate().for_each(|(i, out)| {
            let range = i * CHUNK..i * CHUNK + out.len();
            let of_ranks: Vec<&[f32]> = parts.iter().map(|part| &part[range.clone()]).collect();
            tree_sum(out, &of_ranks);
        });
    }

    /// Replaces the slices of the other ranks by what these have computed.
    pub fn all_gather(&self, numbers: &mut [f32]) {
        self.exchange.all_gather_slices(numbers, &self.all, self.own.len());
    }

    /// Returns the values with the slices of all ranks.
    pub fn all_gathered<'a>(&self, numbers: &'a [f32]) -> Cow<'a, [f32]> {
        let mut numbers = Cow::from(numbers);
        if !self.exchange.is_alone() {
            self.all_gather(numbers.to_mut());
        }
        numbers
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slices_of_the_ranks_are_whole_chunks_and_cover_the_array() {
        let chunks = [0..5, 5..10, 10..12, 12..17, 17..20];
        for (ranks, expected) in [
            (1, vec![Range { start: 0, end: 20 }]),
            (2, vec![0..10, 10..20]),
            (4, vec![0..5, 5..10, 10..12, 12..20]),
            (8, vec![0..0, 0..5, 5..5, 5..10, 10..12, 12..12, 12..17, 17..20]),
        ] {
            let slices: Vec<Slices> =
                (0..ranks).map(|rank| Slices::new(Exchange::alone(1), &chunks, (rank, ranks))).collect();
            assert_eq!(slices[0].all, expected, "{ranks} ranks");
            let dealt: Vec<Range<usize>> = slices.into_iter().flat_map(|slices| slices.chunks).collect();
            assert_eq!(dealt, chunks);
        }
    }
}
