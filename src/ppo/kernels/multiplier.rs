//! Matrix products in the arithmetic of the configured precision.

use anyhow::{Context, Result};

use super::bf16::{Order, Packed, Unit, rounded};
use super::product::{Matrix, product};
use super::units;
use crate::config::Precision;

/// An arithmetic that this machine supports.
#[derive(Clone, Copy)]
pub enum Arithmetic {
    /// f32 throughout.
    F32,
    /// Operands rounded to bf16, products and sums in f32.
    Rounded,
    /// Operands rounded to bf16, products on a unit of the processor, sums in f32.
    Bf16(&'static dyn Unit),
}

impl Arithmetic {
    /// The arithmetic for a precision.
    ///
    /// # Errors
    /// Fails if the precision requires a unit that this machine lacks.
    pub fn new(precision: Precision) -> Result<Self> {
        Ok(match precision {
            Precision::F32 => Self::F32,
            Precision::Bf16Rounded => Self::Rounded,
            Precision::Bf16 => Self::Bf16(units::request().context(
                "ppo.precision = \"bf16\" is unavailable here; start the run with \"f32\"",
            )?),
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
        Self {
            arithmetic,
            rounded: Default::default(),
            packed: Default::default(),
        }
    }

    /// Writes the product to `out`, by rows, or adds it if `add` is set. `ready` is the right operand
    /// as it is packed, if it is.
    ///
    /// # Panics
    /// Panics if the sizes do not match.
    pub(crate) fn product(
        &mut self,
        out: &mut [f32],
        lhs: Matrix,
        rhs: Matrix,
        ready: Option<&Packed>,
        add: bool,
    ) {
        match self.arithmetic {
            Arithmetic::F32 => product(out, lhs, rhs, add),
            Arithmetic::Rounded => {
                let [left, right] = &mut self.rounded;
                product(
                    out,
                    lhs.mapped(left, rounded),
                    rhs.mapped(right, rounded),
                    add,
                );
            }
            Arithmetic::Bf16(unit) => {
                let [left, right] = &mut self.packed;
                left.pack(lhs, unit.order_of_left(lhs));
                let right = ready.unwrap_or_else(|| {
                    right.pack(rhs.transposed(), Order::Pairs);
                    right
                });
                unit.product(out, rhs.size()[1], [left, right], add);
            }
        }
    }
}
