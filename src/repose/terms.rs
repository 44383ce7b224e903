//! The terms of a reward: their values, summed, averaged and named in one place for whatever terms there are.

use std::fmt;
use std::marker::PhantomData;
use std::ops::{AddAssign, Index};

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// What a reader is told about a term.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Description {
    /// The name in columns, tags and JSON.
    pub name: &'static str,
    /// What it is, in a sentence.
    pub text: &'static str,
}

/// A list of terms.
pub trait TermList {
    /// Returns the description of each term, in order.
    fn descriptions() -> impl Iterator<Item = Description>;
}

/// The values of the N terms in the list `L`.
pub struct Terms<L, const N: usize> {
    values: [f64; N],
    list: PhantomData<L>,
}

impl<L: TermList, const N: usize> Terms<L, N> {
    /// Returns the terms with these values, in order.
    pub fn new(values: [f64; N]) -> Self {
        Self { values, list: PhantomData }
    }

    /// Returns the values, in order.
    pub fn values(&self) -> [f64; N] {
        self.values
    }

    /// Returns the values by name.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, f64)> + use<L, N> {
        L::descriptions().map(|term| term.name).zip(self.values)
    }

    /// Returns the sum of the terms.
    pub fn total(&self) -> f64 {
        self.values.iter().sum()
    }

    /// Applies `f` to each term.
    pub fn map(self, f: impl Fn(f64) -> f64) -> Self {
        Self::new(self.values.map(f))
    }
}

impl<L: TermList, const N: usize> Index<&str> for Terms<L, N> {
    type Output = f64;

    /// # Panics
    /// Panics if there is no term of this name.
    fn index(&self, name: &str) -> &f64 {
        let place = L::descriptions().position(|term| term.name == name);
        &self.values[place.unwrap_or_else(|| panic!("no term is called {name}"))]
    }
}

impl<L, const N: usize> AddAssign for Terms<L, N> {
    fn add_assign(&mut self, other: Self) {
        self.values.iter_mut().zip(other.values).for_each(|(sum, value)| *sum += value);
    }
}

impl<L: TermList, const N: usize> Default for Terms<L, N> {
    fn default() -> Self {
        Self::new([0.0; N])
    }
}

impl<L, const N: usize> Clone for Terms<L, N> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<L, const N: usize> Copy for Terms<L, N> {}

impl<L, const N: usize> PartialEq for Terms<L, N> {
    fn eq(&self, other: &Self) -> bool {
        self.values == other.values
    }
}

impl<L: TermList, const N: usize> fmt::Debug for Terms<L, N> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_map().entries(self.named()).finish()
    }
}

impl<L, const N: usize> Serialize for Terms<L, N> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.values[..].serialize(serializer)
    }
}

impl<'de, L: TermList, const N: usize> Deserialize<'de> for Terms<L, N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let values = Vec::deserialize(deserializer)?;
        values.try_into().map(Self::new).map_err(|_| D::Error::custom("another number of terms"))
    }
}
