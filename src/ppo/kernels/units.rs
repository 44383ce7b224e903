//! Products of bf16 matrices, with sums in f32, on what the processor has for them: tiles (AMX) or dot products (AVX-512 BF16).

use std::sync::OnceLock;

use anyhow::{Result, anyhow};

use super::amx::Tiles;
use super::avx512::Dots;
use super::bf16::{BLOCK, MultiplyBlock, Order, Packed};
use super::product::Matrix;

/// A unit of this processor that multiplies bf16 matrices.
#[derive(Clone, Copy, Debug)]
pub enum Unit {
    /// The tiles, the faster ones.
    Tiles(Tiles),
    /// The dot products.
    Dots(Dots),
}

impl Unit {
    /// Requests the fastest unit of this processor, once per process.
    ///
    /// # Errors
    /// Fails if no unit is there and may be used and multiplies rightly; the message says why for each of them.
    pub fn request() -> Result<Self> {
        static ANSWER: OnceLock<Result<Unit, String>> = OnceLock::new();
        let answer = ANSWER.get_or_init(|| {
            Self::tiles().or_else(|no_tiles| Self::dots().map_err(|no_dots| format!("{no_tiles}, and {no_dots}")))
        });
        answer.clone().map_err(|reason| anyhow!(reason))
    }

    fn tiles() -> Result<Self, &'static str> {
        let (unit, wrong) = (Self::Tiles(Tiles::request()?), "the tiles (AMX) of this processor are wrong");
        if unit.multiplies_rightly() { Ok(unit) } else { Err(wrong) }
    }

    fn dots() -> Result<Self, &'static str> {
        let (unit, wrong) = (Self::Dots(Dots::request()?), "its dot products (AVX-512 BF16) are wrong");
        if unit.multiplies_rightly() { Ok(unit) } else { Err(wrong) }
    }

    /// Packs a left operand. The right one, which both units read as pairs, is packed by [`pack_right`].
    pub fn pack_left(self, lhs: Matrix, packed: &mut Packed) {
        let [_, along] = lhs.strides();
        // Dot products read either order: what is taken is the one that needs no transposition.
        let pairs = matches!(self, Self::Dots(_)) && along != 1;
        packed.pack(lhs, if pairs { Order::Pairs } else { Order::Lines });
    }

    /// Writes the product of packed matrices to `out` `[rows, columns]`, by rows, or adds it if `add` is set.
    ///
    /// # Panics
    /// Panics if the sizes do not match.
    pub fn product(self, out: &mut [f32], columns: usize, lhs: &Packed, rhs: &Packed, add: bool) {
        match self {
            Self::Tiles(tiles) => multiply(&tiles.begin(), out, columns, lhs, rhs, add),
            Self::Dots(dots) => multiply(&dots.begin(lhs.order()), out, columns, lhs, rhs, add),
        }
    }

    /// Returns whether products of whole numbers, which need no rounding, are exact.
    fn multiplies_rightly(self) -> bool {
        let (rows, depth, columns) = (37, 70, 50);
        let numbers =
            |count: usize, step: usize| (0..count).map(|i| (i * step % 17) as f32 - 8.0).collect::<Vec<f32>>();
        let (a, b) = (numbers(rows * depth, 5), numbers(depth * columns, 3));
        let (by_rows, by_columns) = (Matrix::new(&a, rows, depth), Matrix::new(&a, depth, rows).transposed());
        [by_rows, by_columns].into_iter().all(|a| {
            let (mut lhs, mut rhs) = (Packed::default(), Packed::default());
            self.pack_left(a, &mut lhs);
            pack_right(Matrix::new(&b, depth, columns), &mut rhs);
            let mut out = vec![1.0; rows * columns];
            self.product(&mut out, columns, &lhs, &rhs, true);
            let [down, right] = a.strides().map(|stride| stride as usize);
            (0..rows * columns).all(|i| {
                let (row, column) = (i / columns, i % columns);
                let terms = (0..depth).map(|k| a.data()[row * down + k * right] * b[k * columns + column]);
                out[i] == 1.0 + terms.sum::<f32>()
            })
        })
    }
}

/// Packs a right operand.
pub(super) fn pack_right(rhs: Matrix, packed: &mut Packed) {
    packed.pack(rhs.transposed(), Order::Pairs);
}

/// Multiplies packed matrices block by block.
fn multiply(unit: &impl MultiplyBlock, out: &mut [f32], columns: usize, lhs: &Packed, rhs: &Packed, add: bool) {
    let (rows, depth) = (out.len() / columns, lhs.depth());
    assert_eq!(out.len(), rows * columns, "elements of the product");
    assert_eq!(depth, rhs.depth(), "tiles along the lines of both matrices");
    assert_eq!(rhs.order(), Order::Pairs, "order of the right matrix");
    let pair = 2 * depth;
    assert_eq!(lhs.tiles().len(), rows.div_ceil(BLOCK) * pair, "tiles of the left matrix");
    assert_eq!(rhs.tiles().len(), columns.div_ceil(BLOCK) * pair, "tiles of the right matrix");
    // The tiles of the right matrix in use stay in the cache while those of the left one stream past.
    for (j, rhs) in rhs.tiles().chunks_exact(pair).enumerate() {
        for (i, lhs) in lhs.tiles().chunks_exact(pair).enumerate() {
            let (height, width) = ((rows - i * BLOCK).min(BLOCK), (columns - j * BLOCK).min(BLOCK));
            let first = i * BLOCK * columns + j * BLOCK;
            if (height, width) == (BLOCK, BLOCK) {
                unit.multiply(&mut out[first..], columns, lhs, rhs, add);
                continue;
            }
            // A block that extends beyond the edge is computed in a separate buffer.
            let mut whole = [0.0; BLOCK * BLOCK];
            unit.multiply(&mut whole, BLOCK, lhs, rhs, false);
            for (row, whole) in whole.chunks_exact(BLOCK).take(height).enumerate() {
                let out = &mut out[first + row * columns..][..width];
                for (out, x) in out.iter_mut().zip(whole) {
                    *out = if add { *out + x } else { *x };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ppo::kernels::bf16::rounded;
    use crate::rng;

    /// On a machine that lacks a unit, only the error message is tested.
    #[test]
    fn products_of_rounded_numbers_on_amx_tiles_agree_with_doubles() {
        match Unit::tiles() {
            Ok(unit) => products_agree_with_doubles(unit),
            Err(error) => assert!(error.contains("AMX"), "{error}"),
        }
    }

    /// See above.
    #[test]
    fn products_of_rounded_numbers_by_avx512_agree_with_doubles() {
        match Unit::dots() {
            Ok(unit) => products_agree_with_doubles(unit),
            Err(error) => assert!(error.contains("AVX-512"), "{error}"),
        }
    }

    fn products_agree_with_doubles(unit: Unit) {
        let mut rng = rng::stream(0, "test", 0);
        for (rows, depth, columns) in
            [(32, 32, 32), (1, 1, 1), (256, 157, 256), (20, 256, 64), (100, 33, 17), (3, 70, 500)]
        {
            let mut random =
                |count: usize| -> Vec<f32> { (0..count).map(|_| rng::uniform(&mut rng, -2.0, 2.0) as f32).collect() };
            let (a, b, before) = (random(rows * depth), random(depth * columns), random(rows * columns));
            for add in [false, true] {
                // Both operands, once stored by rows and once by columns.
                for (lhs, rhs) in [
                    (Matrix::new(&a, rows, depth), Matrix::new(&b, depth, columns)),
                    (Matrix::new(&a, depth, rows).transposed(), Matrix::new(&b, columns, depth).transposed()),
                ] {
                    let (mut left, mut right) = (Packed::default(), Packed::default());
                    unit.pack_left(lhs, &mut left);
                    pack_right(rhs, &mut right);
                    let mut out = before.clone();
                    unit.product(&mut out, columns, &left, &right, add);
                    let at = |m: Matrix, i: usize, j: usize| {
                        f64::from(rounded(m.data()[i * m.strides()[0] as usize + j * m.strides()[1] as usize]))
                    };
                    for (i, &found) in out.iter().enumerate() {
                        let terms = (0..depth).map(|k| at(lhs, i / columns, k) * at(rhs, k, i % columns));
                        let start = if add { f64::from(before[i]) } else { 0.0 };
                        let (sum, size) = terms.fold((start, start.abs()), |(s, z), x| (s + x, z + x.abs()));
                        let error = (f64::from(found) - sum).abs();
                        assert!(error <= 1e-6 * size.max(1.0), "{rows}×{depth}×{columns}: {found} not {sum}");
                    }
                }
            }
        }
    }
}
