//! The division of a training run among ranks, which does not affect what it computes.
//!
//! The environments are dealt to shards; their number is a setting and a power of two. Everything that is computed from
//! many samples is computed shard by shard and combined in the order of the shards, gradients as a binary tree. A rank
//! computes consecutive shards, which form a subtree. So one, two or four ranks give the same bits.

use std::ops::Range;

use pulp::Arch;

/// The ranks of a training run, as one of them sees them. All ranks make the same calls in the same order.
pub trait Ranks: Send + Sync {
    /// Returns the number of ranks: a power of two.
    fn size(&self) -> usize;

    /// Returns the index of this rank.
    fn rank(&self) -> usize;

    /// Replaces the values by their sum over all ranks, added as a binary tree in the order of the ranks.
    fn add_up(&self, numbers: &mut [f32]);

    /// Returns the values of all ranks, in their order; all ranks pass the same number of values.
    fn gather(&self, numbers: Vec<f64>) -> Vec<f64>;
}

/// One rank that computes all shards.
pub struct Alone;

impl Ranks for Alone {
    fn size(&self) -> usize {
        1
    }

    fn rank(&self) -> usize {
        0
    }

    fn add_up(&self, _: &mut [f32]) {}

    fn gather(&self, numbers: Vec<f64>) -> Vec<f64> {
        numbers
    }
}

/// The shards of a training run, and which of them this rank computes.
pub struct Division {
    shards: usize,
    ranks: Box<dyn Ranks>,
}

impl Division {
    /// Divides this number of shards among these ranks.
    ///
    /// # Panics
    /// Panics if either number is not a power of two, or if there are fewer shards than ranks.
    pub fn new(shards: usize, ranks: Box<dyn Ranks>) -> Self {
        let fits = shards.is_power_of_two() && ranks.size().is_power_of_two() && ranks.size() <= shards;
        assert!(fits, "{shards} shards on {} ranks", ranks.size());
        Self { shards, ranks }
    }

    /// Assigns this number of shards to one rank.
    pub fn alone(shards: usize) -> Self {
        Self::new(shards, Box::new(Alone))
    }

    /// Returns the number of all shards.
    pub fn shards(&self) -> usize {
        self.shards
    }

    /// Returns the shards of this rank.
    pub fn own(&self) -> Range<usize> {
        let each = self.shards / self.ranks.size();
        each * self.ranks.rank()..each * (self.ranks.rank() + 1)
    }

    /// Replaces the sum over the shards of this rank by the sum over all ranks.
    pub fn add_up(&self, numbers: &mut [f32]) {
        self.ranks.add_up(numbers);
    }

    /// Returns the sums over all shards, added in their order. `of_own` yields one row for each shard of this rank, all
    /// of equal length.
    pub fn total(&self, of_own: impl Iterator<Item = Vec<f64>>) -> Vec<f64> {
        let all = self.ranks.gather(of_own.flatten().collect());
        let width = all.len() / self.shards;
        (0..width).map(|i| all.iter().skip(i).step_by(width).sum()).collect()
    }

    /// Returns the largest of the values of all ranks.
    pub fn largest(&self, own: f64) -> f64 {
        self.ranks.gather(vec![own]).into_iter().fold(f64::NEG_INFINITY, f64::max)
    }
}

/// Writes the sum of `parts`, which have equal length and whose number is a power of two. They are added as a binary
/// tree: the first and the second, the third and the fourth, and so on, then these sums likewise.
pub fn tree_sum(out: &mut [f32], parts: &[&[f32]]) {
    match parts {
        [part] => out.copy_from_slice(part),
        [first, second] => {
            out.copy_from_slice(first);
            add(out, second);
        }
        _ => {
            let (first, second) = parts.split_at(parts.len() / 2);
            let mut of_second = vec![0.0; out.len()];
            tree_sum(out, first);
            tree_sum(&mut of_second, second);
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
        // A one is lost when added to 1e8; only ones that are added to each other first count.
        let parts = [1e8f32, 1.0, 1.0, 1.0, -1e8, 3.0, 1.0, 2.0].map(|x| [x, 1.0]);
        let parts: Vec<&[f32]> = parts.iter().map(|part| &part[..]).collect();
        let mut out = [0.0; 2];
        tree_sum(&mut out, &parts);
        let expected = ((1e8f32 + 1.0) + (1.0 + 1.0)) + ((-1e8f32 + 3.0) + (1.0 + 2.0));
        assert_eq!(out, [expected, 8.0]);
        // Two ranks with half of the parts each give the same result.
        let [mut first, mut second] = [[0.0; 2]; 2];
        tree_sum(&mut first, &parts[..4]);
        tree_sum(&mut second, &parts[4..]);
        tree_sum(&mut out, &[&first, &second]);
        assert_eq!(out, [expected, 8.0]);
    }

    #[test]
    fn totals_are_added_in_the_order_of_the_shards() {
        let division = Division::alone(4);
        assert_eq!((division.shards(), division.own()), (4, 0..4));
        // 1 is lost when added to 1e16: once in this order, never or twice in others.
        let rows = [1e16, 1.0, -1e16, 1.0].map(|x| vec![x, 1.0]).into_iter();
        assert_eq!(division.total(rows), [1.0, 4.0]);
    }
}
