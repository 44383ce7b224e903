//! The activations and their derivatives, on the calling thread, in the widest vectors of the processor.
//!
//! candle computes these functions one element at a time, in several passes, which costs more than the matrix products
//! between them.

use super::widest::widest;
use crate::config::Activation;

/// The value of e^x - 1 with an error below 3e-7 · max(|e^x - 1|, |x|). The argument x is clamped to [-87, 88].
///
/// With x = n ln 2 + r, |r| ≤ ln 2 / 2: e^x - 1 = 2ⁿ (e^r - 1) + (2ⁿ - 1), which loses no precision near 0. The
/// polynomial for (e^r - 1 - r) / r² is taken from `expf` in Cephes (S. L. Moshier).
#[inline(always)]
fn exp_m1(x: f32) -> f32 {
    /// 1.5 · 2²³: adding it rounds to a whole number, which is then in the low bits.
    const ROUND: f32 = 12_582_912.0;
    /// ln 2 in two parts. The first has so few digits that its product with n is exact.
    const LN2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    let x = x.clamp(-87.0, 88.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-LN2[1], n.mul_add(-LN2[0], x));
    let mut p = 1.987_569_1e-4f32;
    for coefficient in [1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_66, 0.5] {
        p = p.mul_add(r, coefficient);
    }
    let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23));
    scale.mul_add((p * r).mul_add(r, r), scale - 1.0)
}

#[inline(always)]
fn elu(x: f32) -> f32 {
    if x > 0.0 { x } else { exp_m1(x) }
}

/// Unlike `max`, propagates NaN.
#[inline(always)]
fn relu(x: f32) -> f32 {
    if x < 0.0 { 0.0 } else { x }
}

#[inline(always)]
fn tanh(x: f32) -> f32 {
    let m = exp_m1(2.0 * x.clamp(-40.0, 40.0));
    m / (m + 2.0)
}

/// Adds `bias` `[C]` to each row of `x` `[B, C]`, then applies the activation, if any, in place.
pub fn add_bias(x: &mut [f32], bias: &[f32], activation: Option<Activation>) {
    match activation {
        None => each_row(x, bias, |x, b| x + b),
        Some(Activation::Elu) => each_row(x, bias, |x, b| elu(x + b)),
        Some(Activation::Relu) => each_row(x, bias, |x, b| relu(x + b)),
        Some(Activation::Tanh) => each_row(x, bias, |x, b| tanh(x + b)),
    }
}

/// Multiplies `grad` `[B, C]` by the derivatives of the activation, in place, and adds the sums of its columns to
/// `sums` `[C]`.
///
/// `outputs` `[B, C]` are the outputs of the activation, which determine its derivatives.
pub fn slopes_and_sums(
    grad: &mut [f32],
    outputs: &[f32],
    activation: Option<Activation>,
    sums: &mut [f32],
) {
    match activation {
        None => each_and_sum(grad, outputs, sums, |g, _| g),
        Some(Activation::Elu) => {
            each_and_sum(
                grad,
                outputs,
                sums,
                |g, y| if y > 0.0 { g } else { g * (y + 1.0) },
            )
        }
        Some(Activation::Relu) => {
            each_and_sum(grad, outputs, sums, |g, y| if y > 0.0 { g } else { 0.0 })
        }
        Some(Activation::Tanh) => each_and_sum(grad, outputs, sums, |g, y| g * (1.0 - y * y)),
    }
}

/// Sets `x[i] = f(x[i], y[i])` and adds the rows of `x` to `sums`.
#[inline(always)]
fn each_and_sum(x: &mut [f32], y: &[f32], sums: &mut [f32], f: impl Fn(f32, f32) -> f32) {
    assert_eq!(x.len(), y.len());
    let width = sums.len();
    widest!({
        for (x, y) in x.chunks_exact_mut(width).zip(y.chunks_exact(width)) {
            for ((x, &y), sum) in x.iter_mut().zip(y).zip(&mut *sums) {
                *x = f(*x, y);
                *sum += *x;
            }
        }
    });
}

/// Sets `x[i, j] = f(x[i, j], y[j])` for each row of `x` `[B, C]`, compiled for the processor it runs on.
#[inline(always)]
fn each_row(x: &mut [f32], y: &[f32], f: impl Fn(f32, f32) -> f32) {
    widest!({
        for row in x.chunks_exact_mut(y.len()) {
            row.iter_mut().zip(y).for_each(|(x, &y)| *x = f(*x, y));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Activation; 3] = [Activation::Elu, Activation::Relu, Activation::Tanh];

    fn exact(activation: Activation, x: f64) -> f64 {
        match activation {
            Activation::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp_m1()
                }
            }
            Activation::Relu => x.max(0.0),
            Activation::Tanh => x.tanh(),
        }
    }

    fn inputs() -> Vec<f32> {
        (-100_000..=100_000)
            .map(|i| i as f32 * 2e-4)
            .chain([-1e30, -100.0, 100.0, 1e30, 0.0, 1e-30, -1e-30])
            .collect()
    }

    #[test]
    fn activations_are_accurate_to_three_parts_in_ten_million() {
        for activation in ALL {
            let mut found = inputs();
            add_bias(&mut found, &[0.0], Some(activation));
            for (x, y) in inputs().into_iter().zip(found) {
                let expected = exact(activation, f64::from(x));
                let error = (f64::from(y) - expected).abs();
                assert!(
                    error <= 3e-7 * expected.abs().max(1e-30) || error < 2e-7,
                    "{activation:?}({x}) = {y}, not {expected}"
                );
            }
        }
    }

    #[test]
    fn small_inputs_keep_their_relative_accuracy() {
        for x in [1e-3f32, -1e-3, 1e-6, -1e-6, 1e-20, -1e-20] {
            let relative = |y: f32, expected: f64| ((f64::from(y) - expected) / expected).abs();
            assert!(
                relative(exp_m1(x), f64::from(x).exp_m1()) < 3e-7,
                "exp_m1({x})"
            );
            assert!(relative(tanh(x), f64::from(x).tanh()) < 3e-7, "tanh({x})");
        }
    }

    #[test]
    fn what_is_not_a_number_stays_so() {
        for activation in ALL {
            let mut x = [f32::NAN];
            add_bias(&mut x, &[0.0], Some(activation));
            assert!(x[0].is_nan(), "{activation:?}");
        }
    }

    #[test]
    fn slopes_are_those_of_the_activations() {
        for activation in ALL {
            for x in [-3.0f32, -0.7, -0.01, 0.02, 0.9, 4.0] {
                let mut output = [x];
                add_bias(&mut output, &[0.0], Some(activation));
                let mut grad = [2.0];
                let mut sums = [1.0];
                slopes_and_sums(&mut grad, &output, Some(activation), &mut sums);
                assert_eq!(sums[0], 1.0 + grad[0]);
                let step = 1e-6;
                let x = f64::from(x);
                let slope =
                    (exact(activation, x + step) - exact(activation, x - step)) / (2.0 * step);
                assert!(
                    (f64::from(grad[0]) - 2.0 * slope).abs() < 1e-5,
                    "{activation:?} at {x}"
                );
            }
        }
    }

    #[test]
    fn without_an_activation_only_the_columns_are_summed() {
        let mut grad = [1.0, 2.0, 3.0, 0.5, -2.0, 4.0];
        let mut sums = [10.0, 20.0, 30.0];
        slopes_and_sums(&mut grad, &[0.0; 6], None, &mut sums);
        assert_eq!(sums, [11.5, 20.0, 37.0]);
        assert_eq!(grad, [1.0, 2.0, 3.0, 0.5, -2.0, 4.0]);
    }
}
