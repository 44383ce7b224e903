//! What environments save of themselves: two tables with a row for each, one of doubles, one of whole numbers.
//!
//! Tables and not bytes, so that a checkpoint can be looked into with any reader of its format, and so that everything in it
//! has a type that can be checked.

use anyhow::{Context, Result, ensure};

/// The states of N environments, one after the other.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EnvState {
    /// `[N, K]`
    pub numbers: Vec<f64>,
    /// `[N, C]`
    pub counters: Vec<u64>,
}

/// What is still to be read of a saved environment.
pub struct SavedEnv<'a> {
    numbers: &'a [f64],
    counters: &'a [u64],
}

impl EnvState {
    /// The rows of each of `count` environments.
    ///
    /// # Errors
    /// Tables that do not hold so many rows.
    pub fn rows(&self, count: usize) -> Result<impl Iterator<Item = SavedEnv<'_>>> {
        let [numbers, counters] = [self.numbers.len(), self.counters.len()];
        let even =
            numbers.is_multiple_of(count) && counters.is_multiple_of(count) && numbers >= count && counters >= count;
        ensure!(even, "{numbers} numbers and {counters} counters are no states of {count} environments");
        let rows = self.numbers.chunks_exact(numbers / count).zip(self.counters.chunks_exact(counters / count));
        Ok(rows.map(|(numbers, counters)| SavedEnv { numbers, counters }))
    }
}

impl<'a> SavedEnv<'a> {
    /// The next `N` numbers.
    ///
    /// # Errors
    /// There are not so many.
    pub fn numbers<const N: usize>(&mut self) -> Result<[f64; N]> {
        let (first, rest) = self.numbers.split_first_chunk().context("a state with too few numbers")?;
        self.numbers = rest;
        Ok(*first)
    }

    /// All numbers but the last `N`.
    ///
    /// # Errors
    /// There are not so many.
    pub fn numbers_but<const N: usize>(&mut self) -> Result<&'a [f64]> {
        let count = self.numbers.len().checked_sub(N).context("a state with too few numbers")?;
        let (first, rest) = self.numbers.split_at(count);
        self.numbers = rest;
        Ok(first)
    }

    /// The next `N` counters.
    ///
    /// # Errors
    /// There are not so many.
    pub fn counters<const N: usize>(&mut self) -> Result<[u64; N]> {
        let (first, rest) = self.counters.split_first_chunk().context("a state with too few counters")?;
        self.counters = rest;
        Ok(*first)
    }

    /// Makes sure that all was read.
    ///
    /// # Errors
    /// Something is left.
    pub fn finish(self) -> Result<()> {
        let left = self.numbers.len() + self.counters.len();
        ensure!(left == 0, "a state with {left} numbers too many");
        Ok(())
    }
}
