//! The choice of what multiplies bf16 matrices: the tiles of the processor (AMX) or its dot products (AVX-512 BF16).

use std::sync::OnceLock;

use anyhow::{Result, anyhow};

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
use super::amx::request as tiles;
#[cfg(target_arch = "x86_64")]
use super::avx512::request as dots;
use super::bf16::{Order, Packed, Unit};
use super::product::{Matrix, product};

/// A unit, or why there is none.
type Answer<E> = Result<&'static dyn Unit, E>;

#[cfg(not(all(target_arch = "x86_64", target_os = "linux")))]
fn tiles() -> Answer<&'static str> {
    Err("bf16 tiles (AMX) are used only on x86-64 Linux")
}

#[cfg(not(target_arch = "x86_64"))]
fn dots() -> Answer<&'static str> {
    Err("bf16 dot products (AVX-512 BF16) are used only on x86-64")
}

/// Requests the fastest unit of this processor, once per process.
///
/// # Errors
/// Fails if no unit is present, permitted and correct. The message gives the reason for each unit.
pub fn request() -> Result<&'static dyn Unit> {
    static ANSWER: OnceLock<Answer<String>> = OnceLock::new();
    let answer = ANSWER.get_or_init(|| {
        let mut reasons = Vec::new();
        for (unit, wrong) in [
            (
                tiles(),
                "the tiles (AMX) of this processor multiply wrongly",
            ),
            (
                dots(),
                "its dot products (AVX-512 BF16) are computed wrongly",
            ),
        ] {
            match unit {
                Ok(unit) if multiplies_rightly(unit) => return Ok(unit),
                unit => reasons.push(unit.err().unwrap_or(wrong)),
            }
        }
        Err(reasons.join(", and "))
    });
    answer.clone().map_err(|reason| anyhow!(reason))
}

/// Whether products of whole numbers, which need no rounding, are exact.
fn multiplies_rightly(unit: &dyn Unit) -> bool {
    let rows = 37;
    let depth = 70;
    let columns = 50;
    let numbers = |count: usize, step: usize| -> Vec<f32> {
        let number = |i: usize| (i * step % 17) as f32 - 8.0;
        (0..count).map(number).collect()
    };
    let a = numbers(rows * depth, 5);
    let b = numbers(depth * columns, 3);
    let b = Matrix::new(&b, depth, columns);
    let of_columns = Matrix::new(&a, depth, rows).transposed();
    [Matrix::new(&a, rows, depth), of_columns]
        .into_iter()
        .all(|a| {
            let mut lhs = Packed::default();
            let mut rhs = Packed::default();
            lhs.pack(a, unit.order_of_left(a));
            rhs.pack(b.transposed(), Order::Pairs);
            let mut out = vec![1.0; rows * columns];
            let mut expected = out.clone();
            unit.product(&mut out, columns, [&lhs, &rhs], true);
            product(&mut expected, a, b, true);
            out == expected
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ppo::kernels::bf16::rounded;
    use crate::rng;

    /// On a machine that lacks a unit, only the error message is tested.
    #[test]
    fn products_of_rounded_numbers_on_amx_tiles_agree_with_doubles() {
        match tiles() {
            Ok(unit) => products_agree_with_doubles(unit),
            Err(error) => assert!(error.contains("AMX"), "{error}"),
        }
    }

    /// See above.
    #[test]
    fn products_of_rounded_numbers_by_avx512_agree_with_doubles() {
        match dots() {
            Ok(unit) => products_agree_with_doubles(unit),
            Err(error) => assert!(error.contains("AVX-512"), "{error}"),
        }
    }

    fn products_agree_with_doubles(unit: &dyn Unit) {
        let mut rng = rng::stream(0, "test", 0);
        for (rows, depth, columns) in [
            (32, 32, 32),
            (1, 1, 1),
            (256, 155, 256),
            (20, 256, 64),
            (100, 33, 17),
            (3, 70, 500),
        ] {
            let mut random = |count: usize| -> Vec<f32> {
                (0..count)
                    .map(|_| rng::uniform(&mut rng, -2.0, 2.0) as f32)
                    .collect()
            };
            let a = random(rows * depth);
            let b = random(depth * columns);
            let before = random(rows * columns);
            for add in [false, true] {
                // Both operands, once stored by rows and once by columns.
                for (lhs, rhs) in [
                    (
                        Matrix::new(&a, rows, depth),
                        Matrix::new(&b, depth, columns),
                    ),
                    (
                        Matrix::new(&a, depth, rows).transposed(),
                        Matrix::new(&b, columns, depth).transposed(),
                    ),
                ] {
                    let mut left = Packed::default();
                    let mut right = Packed::default();
                    left.pack(lhs, unit.order_of_left(lhs));
                    right.pack(rhs.transposed(), Order::Pairs);
                    let mut out = before.clone();
                    unit.product(&mut out, columns, [&left, &right], add);
                    let at = |m: Matrix, i: usize, j: usize| {
                        f64::from(rounded(
                            m.data()[i * m.strides()[0] as usize + j * m.strides()[1] as usize],
                        ))
                    };
                    for (i, &found) in out.iter().enumerate() {
                        let terms =
                            (0..depth).map(|k| at(lhs, i / columns, k) * at(rhs, k, i % columns));
                        let start = if add { f64::from(before[i]) } else { 0.0 };
                        let (sum, size) =
                            terms.fold((start, start.abs()), |(s, z), x| (s + x, z + x.abs()));
                        let error = (f64::from(found) - sum).abs();
                        assert!(
                            error <= 1e-6 * size.max(1.0),
                            "{rows}×{depth}×{columns}: {found} not {sum}"
                        );
                    }
                }
            }
        }
    }
}
