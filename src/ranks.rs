//! How a training is divided, so that what it computes does not depend on that.
//!
//! The environments are dealt to shards, whose number is a setting: a power of two. Whatever is computed of many samples is
//! computed shard by shard and put together in the order of the shards, gradients as a binary tree. A rank computes some shards that
//! follow one another: a subtree. So one rank, or two, or four come to the same bits.

use std::ops::Range;

use pulp::Arch;

/// The ranks of a training as one of them sees them. All of them make the same calls in the same order.
pub trait Ranks: Send + Sync {
    /// How many there are: a power of two.
    fn size(&self) -> usize;

    /// The number of this one.
    fn rank(&self) -> usize;

    /// Puts the sum of what all ranks give in the place of it, added as a binary tree in the order of the ranks.
    fn add_up(&self, numbers: &mut [f32]);

    /// What all ranks give, in their order; all give as many.
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

/// The shards of a training, and which of them are computed here.
pub struct Division {
    shards: usize,
    ranks: Box<dyn Ranks>,
}

impl Division {
    /// So many shards on these ranks.
    ///
    /// # Panics
    /// A number of shards that is no power of two, or less than the ranks.
    pub fn new(shards: usize, ranks: Box<dyn Ranks>) -> Self {
        let fits = shards.is_power_of_two() && ranks.size().is_power_of_two() && ranks.size() <= shards;
        assert!(fits, "{shards} shards on {} ranks", ranks.size());
        Self { shards, ranks }
    }

    /// So many shards on one rank.
    pub fn alone(shards: usize) -> Self {
        Self::new(shards, Box::new(Alone))
    }

    /// All shards.
    pub fn shards(&self) -> usize {
        self.shards
    }

    /// Those that are computed here.
    pub fn own(&self) -> Range<usize> {
        let each = self.shards / self.ranks.size();
        each * self.ranks.rank()..each * (self.ranks.rank() + 1)
    }

    /// Puts the sum over all ranks in the place of the sum over the shards of this one.
    pub fn add_up(&self, numbers: &mut [f32]) {
        self.ranks.add_up(numbers);
    }

    /// The sums over all shards, added in their order, of what each of the own ones gives: rows of equal length.
    pub fn total(&self, of_own: impl Iterator<Item = Vec<f64>>) -> Vec<f64> {
        let all = self.ranks.gather(of_own.flatten().collect());
        let width = all.len() / self.shards;
        (0..width).map(|i| all.iter().skip(i).step_by(width).sum()).collect()
    }

    /// The largest of what the ranks give.
    pub fn largest(&self, own: f64) -> f64 {
        self.ranks.gather(vec![own]).into_iter().fold(f64::NEG_INFINITY, f64::max)
    }
}

/// Writes the sum of parts of equal length, a power of two of them, added as a binary tree: the first and the second, the third and the
/// fourth, and so on, then these sums likewise.
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
        // What is far below 1e8 is lost beside it: only among themselves do the ones count.
        let parts = [1e8f32, 1.0, 1.0, 1.0, -1e8, 3.0, 1.0, 2.0].map(|x| [x, 1.0]);
        let parts: Vec<&[f32]> = parts.iter().map(|part| &part[..]).collect();
        let mut out = [0.0; 2];
        tree_sum(&mut out, &parts);
        let expected = ((1e8f32 + 1.0) + (1.0 + 1.0)) + ((-1e8f32 + 3.0) + (1.0 + 2.0));
        assert_eq!(out, [expected, 8.0]);
        // Two ranks with half of the parts each come to the same.
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
        // 1 is lost in 1e16: in this order once, in others not or twice.
        let rows = [1e16, 1.0, -1e16, 1.0].map(|x| vec![x, 1.0]).into_iter();
        assert_eq!(division.total(rows), [1.0, 4.0]);
    }
}
