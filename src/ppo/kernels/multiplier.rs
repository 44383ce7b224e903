//! Matrix products in the arithmetic of the configured precision.

use anyhow::{Context, Result};

use super::amx::Tiles;
use super::bf16::{Packed, Side, rounded};
use super::product::{Matrix, product};
use crate::config::Precision;

/// An arithmetic that this machine supports.
#[derive(Clone, Copy, Debug)]
pub enum Arithmetic {
    /// f32 throughout.
    F32,
    /// Operands rounded to bf16, products and sums in f32.
    Rounded,
    /// Operands rounded to bf16, products on tiles, sums in f32.
    Tiles(Tiles),
}

impl Arithmetic {
    /// Returns the arithmetic for a precision.
    ///
    /// # Errors
    /// Fails if the precision requires tiles and this machine lacks them.
    pub fn new(precision: Precision) -> Result<Self> {
        Ok(match precision {
            Precision::F32 => Self::F32,
            Precision::Bf16Rounded => Self::Rounded,
            Precision::Bf16 => Self::Tiles(
                Tiles::request().context("ppo.precision = \"bf16\" is unavailable here; start the run with \"f32\"")?,
            ),
        })
    }
}

/// A matrix multiplier with reusable buffers for its operands.
pub(crate) struct Multiplier {
    arithmetic: Arithmetic,
    rounded: [Vec<f32>; 2],
    packed: [Packed; 2],
}

impl Multiplier {
    /// Creates a multiplier with empty buffers. They grow to the size that the largest product needs.
    pub(crate) fn new(arithmetic: Arithmetic) -> Self {
        Self { arithmetic, rounded: Default::default(), packed: Default::default() }
    }

    /// Writes the product to `out`, by rows, or adds it if `add` is set.
    ///
    /// # Panics
    /// Panics if the sizes do not match.
    pub(crate) fn product(&mut self, out: &mut [f32], lhs: Matrix, rhs: Matrix, add: bool) {
        assert_eq!(lhs.size()[1], rhs.size()[0], "columns of the first and rows of the second matrix");
        assert_eq!(out.len(), lhs.size()[0] * rhs.size()[1], "elements of the product");
        match self.arithmetic {
            Arithmetic::F32 => product(out, lhs, rhs, add),
            Arithmetic::Rounded => {
                let [left, right] = &mut self.rounded;
                product(out, round_into(left, lhs), round_into(right, rhs), add);
            }
            Arithmetic::Tiles(tiles) => {
                let [left, right] = &mut self.packed;
                left.pack(lhs, Side::Left);
                right.pack(rhs, Side::Right);
                let [_, columns] = rhs.size();
                tiles.product(out, columns, left, right, add);
            }
        }
    }
}

fn round_into<'a>(room: &'a mut Vec<f32>, matrix: Matrix) -> Matrix<'a> {
    room.clear();
    room.extend(matrix.data().iter().map(|&x| rounded(x)));
    matrix.of(room)
}
