//! Products of bf16 matrices by the dot products of x86-64 processors (AVX-512 BF16), with sums in f32.
//!
//! `vdpbf16ps` adds two products to each of sixteen sums: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2.

#![expect(
    unsafe_code,
    reason = "instructions that not every processor has, on pointers"
)]

use std::arch::x86_64::{
    __m512bh, __m512i, _mm512_dpbf16_ps, _mm512_loadu_ps, _mm512_loadu_si512, _mm512_set1_epi32,
    _mm512_setzero_ps, _mm512_storeu_ps,
};
use std::mem::transmute;

use super::bf16::{BLOCK, DEPTH, LINES, Order, Packed, Tile, Unit, in_blocks};
use super::product::Matrix;

/// Rows of a block that are computed together. With the two columns of tiles of a block, sums take 16 of the 32 registers.
/// This is enough to hide the delay of the instruction.
const ROWS: usize = 8;

/// The permission to use the dot products.
struct Dots(());

/// Asks the processor for the dot products.
///
/// # Errors
/// Fails if it does not have them.
pub fn request() -> Result<&'static dyn Unit, &'static str> {
    if std::arch::is_x86_feature_detected!("avx512f")
        && std::arch::is_x86_feature_detected!("avx512bf16")
    {
        Ok(&Dots(()))
    } else {
        Err("it has no bf16 dot products (AVX-512 BF16)")
    }
}

impl Unit for Dots {
    /// Dot products read either order. The result is the order that needs no transposition.
    fn order_of_left(&self, lhs: Matrix) -> Order {
        let [_, along] = lhs.strides();
        if along == 1 {
            Order::Lines
        } else {
            Order::Pairs
        }
    }

    fn product(&self, out: &mut [f32], columns: usize, operands: [&Packed; 2], add: bool) {
        let left = operands[0].order;
        in_blocks(
            out,
            columns,
            operands,
            add,
            |out, columns, [lhs, rhs], add| {
                let depth = lhs.len() / 2;
                for first in (0..BLOCK).step_by(ROWS) {
                    let lhs = &lhs[first / LINES * depth..][..depth];
                    let out = &mut out[first * columns..];
                    // SAFETY: `request` alone creates `Dots`, and only where the processor has these instructions. `in_blocks`
                    // ensures that `out` has eight more rows of 32 values at that distance, and `rhs` twice as many tiles as `lhs`.
                    unsafe {
                        match left {
                            Order::Lines => {
                                rows::<DEPTH, 2>(out, columns, lhs, first % LINES, rhs, add)
                            }
                            Order::Pairs => {
                                rows::<2, DEPTH>(out, columns, lhs, first % LINES, rhs, add)
                            }
                        }
                    }
                }
            },
        );
    }
}

/// Computes eight rows of a block, from row `first` of the tiles `lhs` on. Their values are `LINE` apart from line to line
/// and `PAIR` from pair to pair.
///
/// # Safety
/// The processor must have AVX-512F and AVX-512 BF16. `out` must have eight rows of 32 values, `columns` apart, `rhs` twice as many tiles
/// as `lhs`, and a tile the eight lines from `first` on.
#[target_feature(enable = "avx512f,avx512bf16")]
unsafe fn rows<const LINE: usize, const PAIR: usize>(
    out: &mut [f32],
    columns: usize,
    lhs: &[Tile],
    first: usize,
    rhs: &[Tile],
    add: bool,
) {
    let mut sums = [[_mm512_setzero_ps(); 2]; ROWS];
    let at = |row: usize, half: usize| row * columns + half * LINES;
    if add {
        for (row, sums) in sums.iter_mut().enumerate() {
            for (half, sum) in sums.iter_mut().enumerate() {
                // SAFETY: the caller promises that `out` has these values.
                *sum = unsafe { _mm512_loadu_ps(out.as_ptr().add(at(row, half))) };
            }
        }
    }
    let (left, right) = rhs.split_at(lhs.len());
    for ((Tile(lhs), Tile(left)), Tile(right)) in lhs.iter().zip(left).zip(right) {
        for pair in 0..DEPTH / 2 {
            // SAFETY: a tile has `DEPTH / 2` rows of sixteen pairs, and as many pairs for each of sixteen lines.
            let [left, right] =
                [left, right].map(|tile| unsafe { tile.as_ptr().add(pair * DEPTH).cast() });
            let [left, right] = [left, right].map(|row| bf16(unsafe { _mm512_loadu_si512(row) }));
            for (row, [a, b]) in sums.iter_mut().enumerate() {
                // SAFETY: as above.
                let one = unsafe {
                    lhs.as_ptr()
                        .add((first + row) * LINE + pair * PAIR)
                        .cast::<i32>()
                        .read()
                };
                let all = bf16(_mm512_set1_epi32(one));
                *a = _mm512_dpbf16_ps(*a, all, left);
                *b = _mm512_dpbf16_ps(*b, all, right);
            }
        }
    }
    for (row, sums) in sums.into_iter().enumerate() {
        for (half, sum) in sums.into_iter().enumerate() {
            // SAFETY: as above.
            unsafe { _mm512_storeu_ps(out.as_mut_ptr().add(at(row, half)), sum) };
        }
    }
}

/// The same bits as pairs of bf16.
#[target_feature(enable = "avx512f")]
fn bf16(bits: __m512i) -> __m512bh {
    // SAFETY: both are 512 bits of which every value is valid.
    unsafe { transmute(bits) }
}
