//! The slices of an array that the ranks work on.

use std::ops::Range;

use rayon::prelude::*;

use super::exchange::{Exchange, part};
use super::tree_sum;

/// The slices of an array that the ranks work on. They are whole chunks, so results computed chunk by chunk do not depend
/// on the number of ranks.
pub struct Slices {
    exchange: Exchange,
    /// The chunks of all ranks.
    chunks: Vec<Range<usize>>,
    /// The numbers of this rank's chunks.
    dealt: Range<usize>,
    /// For each rank: its values.
    all: Vec<Range<usize>>,
    /// The values of this rank.
    pub own: Range<usize>,
}

impl Exchange {
    /// Deals these chunks of an array, which follow one another, to the ranks.
    pub fn slices(&self, chunks: Vec<Range<usize>>) -> Slices {
        let end = |count: usize| chunks[..count].last().map_or(0, |chunk| chunk.end);
        let of_rank = |rank| part(chunks.len(), rank, self.size);
        let all: Vec<_> = (0..self.size)
            .map(|rank| end(of_rank(rank).start)..end(of_rank(rank).end))
            .collect();
        Slices {
            exchange: self.clone(),
            dealt: of_rank(self.rank),
            own: all[self.rank].clone(),
            chunks,
            all,
        }
    }
}

impl Slices {
    /// Writes to `numbers` the sum over all ranks. `sum` adds up a chunk over the shards of this rank, and the sums of the ranks
    /// are added as a tree. Afterwards `numbers` hold this rank's slice. Returns what `of` computes from each chunk, in the order
    /// of the chunks.
    pub fn reduce_scatter(
        &self,
        numbers: &mut [f32],
        sum: impl Fn(Range<usize>, &mut [f32]) + Sync,
        of: impl Fn(&[f32]) -> f64 + Sync,
    ) -> Vec<f64> {
        let parts = split(numbers, &self.chunks).into_par_iter();
        if self.exchange.is_alone() {
            return parts
                .map(|(chunk, out)| {
                    sum(chunk, out);
                    of(out)
                })
                .collect();
        }
        parts.for_each(|(chunk, out)| sum(chunk, out));
        let parts = self.exchange.all_to_all(numbers, &self.all);
        // A rank without values has no chunks either, so the length does not matter.
        let parts: Vec<_> = parts.chunks(self.own.len().max(1)).collect();
        let add_and_of = |(chunk, out): (Range<usize>, &mut [f32])| {
            tree_sum(
                out,
                &parts,
                chunk.start - self.own.start..chunk.end - self.own.start,
            );
            of(out)
        };
        let own = split(
            &mut numbers[self.own.clone()],
            &self.chunks[self.dealt.clone()],
        );
        self.exchange
            .all_gather(own.into_par_iter().map(add_and_of).collect::<Vec<f64>>())
            .concat()
    }

    /// Replaces the slices of the other ranks by what these have computed.
    pub fn all_gather(&self, numbers: &mut [f32]) {
        self.exchange.all_gather_slices(numbers, &self.all);
    }
}

/// Splits numbers into the chunks, which follow one another.
fn split<'a>(
    mut numbers: &'a mut [f32],
    chunks: &[Range<usize>],
) -> Vec<(Range<usize>, &'a mut [f32])> {
    chunks
        .iter()
        .map(|chunk| {
            let own = numbers.split_off_mut(..chunk.len());
            (chunk.clone(), own.expect("room for all"))
        })
        .collect()
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
            (
                8,
                vec![0..0, 0..5, 5..5, 5..10, 10..12, 12..12, 12..17, 17..20],
            ),
        ] {
            let of_rank = |rank| {
                let mut exchange = Exchange::alone(1);
                (exchange.rank, exchange.size) = (rank, ranks);
                exchange.slices(chunks.to_vec())
            };
            let slices: Vec<Slices> = (0..ranks).map(of_rank).collect();
            assert_eq!(slices[0].all, expected, "{ranks} ranks");
            let dealt: Vec<Range<usize>> = slices
                .into_iter()
                .flat_map(|slices| slices.chunks[slices.dealt].to_vec())
                .collect();
            assert_eq!(dealt, chunks);
        }
    }
}
