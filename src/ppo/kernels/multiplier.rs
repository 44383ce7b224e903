//! The choice of what multiplies matrices.

use anyhow::{Context, Result};

use super::amx::Tiles;
use super::bf16::{Packed, Side, rounded};
use super::product::{Matrix, product};
use crate::config::Precision;

/// An arithmetic that this machine has.
#[derive(Clone, Copy, Debug)]
pub enum Arithmetic {
    /// Floats.
    F32,
    /// Operands rounded to bf16, then floats.
    Rounded,
    /// Operands rounded to bf16, sums in floats, on tiles.
    Tiles(Tiles),
}

impl Arithmetic {
    /// What a precision asks for.
    ///
    /// # Errors
    /// Tiles that this machine lacks.
    pub fn new(precision: Precision) -> Result<Self> {
        Ok(match precision {
            Precision::F32 => Self::F32,
            Precision::Bf16Rounded => Self::Rounded,
            Precision::Bf16 => Self::Tiles(
                Tiles::request().context("ppo.precision = \"bf16\" cannot be had here; begin the run with \"f32\"")?,
            ),
        })
    }
}

/// Multiplies matrices, one product after the other, with the room that this takes.
pub struct Multiplier {
    arithmetic: Arithmetic,
    rounded: [Vec<f32>; 2],
    packed: [Packed; 2],
}

impl Multiplier {
    /// Has no room yet: it takes what the largest product so far has needed.
    pub fn new(arithmetic: Arithmetic) -> Self {
        Self { arithmetic, rounded: Default::default(), packed: Default::default() }
    }

    /// Writes the product into `out`, row after row, or adds it to what is there.
    ///
    /// # Panics
    /// Sizes that do not fit.
    pub fn product(&mut self, out: &mut [f32], lhs: Matrix, rhs: Matrix, add: bool) {
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
