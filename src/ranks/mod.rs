//! The division of a training run among ranks, which does not affect what it computes.
//!
//! A rank is a process. One trait hides how ranks talk to each other. The environments are dealt to shards, whose
//! number is a setting and a power of two. Everything that is computed from many samples is computed shard by shard and
//! combined in the order of the shards, gradients as a binary tree. A rank computes consecutive shards, which form a
//! subtree. So one, two or four ranks give the same bits.
//!
//! The rest of the program knows only [`Exchange`], which sums over all shards and gathers what the ranks have. In a gradient
//! step the gradient is reduced and scattered. Each rank adds up its slice, updates its slice of the parameters, and gathers
//! the slices of all. Sums of losses, norms and statistics, the episodes that ended and the states of environments are
//! gathered as bytes.

mod alike;
mod exchange;
mod launch;
mod minibatches;
#[cfg(feature = "mpi")]
mod mpi;
mod slices;

use std::ops::Range;

use pulp::Arch;

pub use exchange::Exchange;
pub use launch::{expect_one, is_spokesman, launched_by_mpirun, together};
pub use slices::Slices;

/// The ranks of a training run, as one of them sees them. All ranks make the same calls in the same order.
pub trait Ranks: Send + Sync {
    /// Sends `numbers[slices[i]]` to rank i, for every i. Returns what the ranks have sent to this one, in their order.
    fn all_to_all(&self, numbers: &[f32], slices: &[Range<usize>]) -> Vec<f32>;

    /// Replaces `numbers[slices[i]]` by the values that rank i has there, for every i.
    fn all_gather_slices(&self, numbers: &mut [f32], slices: &[Range<usize>]);

    /// The bytes of all ranks, in their order.
    fn all_gather(&self, bytes: Vec<u8>) -> Vec<Vec<u8>>;

    /// Ends all ranks at once.
    fn abort(&self) -> !;
}

/// Writes the sum of this range of `parts`, whose number is a power of two. They are added as a binary
/// tree: first and second, third and fourth, and so on, then these sums in the same way.
pub fn tree_sum(out: &mut [f32], parts: &[impl AsRef<[f32]>], range: Range<usize>) {
    match parts {
        [part] => out.copy_from_slice(&part.as_ref()[range]),
        [first, second] => {
            out.copy_from_slice(&first.as_ref()[range.clone()]);
            add(out, &second.as_ref()[range]);
        }
        _ => {
            let (first, second) = parts.split_at(parts.len() / 2);
            let mut of_second = vec![0.0; out.len()];
            tree_sum(out, first, range.clone());
            tree_sum(&mut of_second, second, range);
            add(out, &of_second);
        }
    }
}

fn add(sums: &mut [f32], x: &[f32]) {
    Arch::new().dispatch(
        #[inline(always)]
        || sums.iter_mut().zip(x).for_each(|(sum, x)| *sum += x),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_added_as_a_tree() {
        // A one is lost when added to 1e8. Only ones that are added to each other first count.
        let parts = [1e8f32, 1.0, 1.0, 1.0, -1e8, 3.0, 1.0, 2.0].map(|x| [x, 1.0]);
        let mut out = [0.0; 2];
        tree_sum(&mut out, &parts, 0..2);
        let expected = ((1e8f32 + 1.0) + (1.0 + 1.0)) + ((-1e8f32 + 3.0) + (1.0 + 2.0));
        assert_eq!(out, [expected, 8.0]);
        // Two ranks with half of the parts each give the same result.
        let [mut first, mut second] = [[0.0; 2]; 2];
        tree_sum(&mut first, &parts[..4], 0..2);
        tree_sum(&mut second, &parts[4..], 0..2);
        tree_sum(&mut out, &[first, second], 0..2);
        assert_eq!(out, [expected, 8.0]);
    }
}
