//! Saved environments: two tables with one row per environment, one of doubles and one of integers.
//!
//! They are tables and not bytes, so that any reader of the checkpoint format can inspect them. Everything in them has a
//! type that can be checked.

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

/// The states of N environments, in order.
#[derive(Default, PartialEq, Serialize, Deserialize)]
pub struct EnvState {
    /// The doubles, `[N, K]`.
    pub numbers: Vec<f64>,
    /// The integers, `[N, C]`.
    pub counters: Vec<u64>,
}

/// The part of a saved environment that is still to be read.
pub struct SavedEnv<'a> {
    numbers: &'a [f64],
    counters: &'a [u64],
}

impl EnvState {
    /// The states of these environments, one part after another.
    pub fn joined(parts: Vec<Self>) -> Self {
        let mut all = Self::default();
        for part in parts {
            all.numbers.extend(part.numbers);
            all.counters.extend(part.counters);
        }
        all
    }

    /// Adds a list that may be longer or shorter elsewhere, with its length.
    pub fn put_list(&mut self, values: impl IntoIterator<Item = f64>) {
        let before = self.numbers.len();
        self.numbers.extend(values);
        self.counters.push((self.numbers.len() - before) as u64);
    }

    /// The rows of each of `count` environments.
    ///
    /// # Errors
    /// Fails if the tables do not divide into `count` rows.
    pub fn rows(&self, count: usize) -> Result<impl Iterator<Item = SavedEnv<'_>>> {
        let numbers = self.numbers.len();
        let counters = self.counters.len();
        let mut found = [numbers, counters].into_iter();
        ensure!(
            found.all(|found| found >= count && found.is_multiple_of(count)),
            "{numbers} numbers and {counters} counters are not the states of {count} environments"
        );
        let rows = self
            .numbers
            .chunks_exact(numbers / count)
            .zip(self.counters.chunks_exact(counters / count));
        Ok(rows.map(|(numbers, counters)| SavedEnv { numbers, counters }))
    }
}

impl<'a> SavedEnv<'a> {
    /// Reads the next `N` numbers.
    ///
    /// # Errors
    /// Fails if fewer are left.
    pub fn numbers<const N: usize>(&mut self) -> Result<[f64; N]> {
        Ok(self.next(N)?.try_into()?)
    }

    /// Reads the next `count` numbers.
    ///
    /// # Errors
    /// Fails if fewer are left.
    pub fn next(&mut self, count: usize) -> Result<&'a [f64]> {
        self.numbers
            .split_off(..count)
            .context("the state has too few numbers")
    }

    /// Reads the next list that [`EnvState::put_list`] has added.
    ///
    /// # Errors
    /// Fails if fewer numbers are left.
    pub fn list(&mut self) -> Result<&'a [f64]> {
        let [length] = self.counters()?;
        self.next(length as usize)
    }

    /// Reads the next `N` counters.
    ///
    /// # Errors
    /// Fails if fewer are left.
    pub fn counters<const N: usize>(&mut self) -> Result<[u64; N]> {
        let next = self.counters.split_off(..N);
        Ok(next.context("the state has too few counters")?.try_into()?)
    }

    /// Checks that everything has been read.
    ///
    /// # Errors
    /// Fails if anything is left.
    pub fn finish(self) -> Result<()> {
        let left = self.numbers.len() + self.counters.len();
        ensure!(left == 0, "the state has {left} numbers too many");
        Ok(())
    }
}
