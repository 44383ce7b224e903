//! Unit quaternions as `[w, x, y, z]`, the order that MuJoCo uses. A quaternion and its negative are the same rotation.

use std::f32::consts::FRAC_1_SQRT_2 as R;
use std::f64::consts::TAU;

use rand_distr::num_traits::Float;

/// A unit quaternion w, x, y, z.
pub type Quat = [f64; 4];

/// The rotation that changes nothing.
pub const IDENTITY: Quat = [1.0, 0.0, 0.0, 0.0];

const H: f32 = 0.5;

/// The rotations that map a cube onto itself, as w, x, y, z. Each pair q and -q has one entry.
#[rustfmt::skip]
pub const CUBE_ROTATIONS: [[f32; 4]; 24] = [
    // None, and half turns about an axis through the centres of two faces.
    [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0],
    // Quarter turns about the same axes.
    [R, R, 0.0, 0.0], [R, -R, 0.0, 0.0], [R, 0.0, R, 0.0], [R, 0.0, -R, 0.0], [R, 0.0, 0.0, R], [R, 0.0, 0.0, -R],
    // Half turns about an axis through the midpoints of two edges.
    [0.0, R, R, 0.0], [0.0, R, -R, 0.0], [0.0, R, 0.0, R], [0.0, R, 0.0, -R], [0.0, 0.0, R, R], [0.0, 0.0, R, -R],
    // Third turns about an axis through two corners.
    [H, H, H, H], [H, -H, H, H], [H, H, -H, H], [H, H, H, -H],
    [H, H, -H, -H], [H, -H, H, -H], [H, -H, -H, H], [H, -H, -H, -H],
];

/// The Hamilton product `a ⊗ b`: first the rotation `b`, then `a`.
pub fn mul<T: Float>([aw, ax, ay, az]: [T; 4], [bw, bx, by, bz]: [T; 4]) -> [T; 4] {
    [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
}

/// The quaternion in these values from `at` on.
pub fn read<T: Copy>(values: &[T], at: usize) -> [T; 4] {
    *values[at..].first_chunk().expect("a quaternion")
}

/// The inverse rotation.
pub fn conj([w, x, y, z]: Quat) -> Quat {
    [w, -x, -y, -z]
}

/// The length of a vector or quaternion.
pub fn length(values: &[f64]) -> f64 {
    values.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// `q`, scaled to length 1.
pub fn normalized(q: Quat) -> Quat {
    let length = length(&q);
    q.map(|x| x / length)
}

/// `v`, rotated by `q`.
pub fn rotate(q: Quat, [x, y, z]: [f64; 3]) -> [f64; 3] {
    let [_, x, y, z] = mul(mul(q, [0.0, x, y, z]), conj(q));
    [x, y, z]
}

/// Either `q` or `-q`, whichever has w ≥ 0, so that each rotation has one sign.
pub fn canonical<T: Float>(q: [T; 4]) -> [T; 4] {
    if q[0] < T::zero() { q.map(|x| -x) } else { q }
}

/// The angle in rad, 0 to π, of the rotation that takes `b` to `a`.
pub fn angle_between(a: Quat, b: Quat) -> f64 {
    let [_, x, y, z] = mul(a, conj(b));
    2.0 * (x * x + y * y + z * z).sqrt().min(1.0).asin()
}

/// The axis of a rotation times its angle in rad, which is at most π.
pub fn rotation_vector(q: Quat) -> [f64; 3] {
    let [w, axis @ ..] = canonical(q);
    let sine = length(&axis);
    let factor = if sine > 1e-9 {
        2.0 * sine.atan2(w) / sine
    } else {
        2.0
    };
    axis.map(|x| factor * x)
}

/// A uniformly distributed rotation, given three uniform numbers in [0, 1).
///
/// K. Shoemake, "Uniform random rotations", Graphics Gems III (1992).
pub fn uniform([u, v, w]: [f64; 3]) -> Quat {
    let inner = (1.0 - u).sqrt();
    let outer = u.sqrt();
    let (sin_v, cos_v) = (TAU * v).sin_cos();
    let (sin_w, cos_w) = (TAU * w).sin_cos();
    [outer * cos_w, inner * sin_v, inner * cos_v, outer * sin_w]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;
    use std::f64::consts::{FRAC_1_SQRT_2, PI};

    const ABOUT_Z_90: Quat = [FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2];

    fn close(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    }

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        assert!(close(
            &rotate(ABOUT_Z_90, [1.0, 0.0, 0.0]),
            &[0.0, 1.0, 0.0]
        ));
    }

    #[test]
    fn products_follow_hamilton() {
        let (i, j) = ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]);
        assert_eq!(mul(i, j), [0.0, 0.0, 0.0, 1.0]);
        assert_eq!(mul(j, i), [0.0, 0.0, 0.0, -1.0]);
        assert!(close(
            &mul(ABOUT_Z_90, conj(ABOUT_Z_90)),
            &[1.0, 0.0, 0.0, 0.0]
        ));
    }

    #[test]
    fn the_angle_is_that_of_the_shorter_way_and_ignores_signs() {
        let identity = [1.0, 0.0, 0.0, 0.0];
        assert!((angle_between(ABOUT_Z_90, identity) - PI / 2.0).abs() < 1e-12);
        assert!((angle_between(ABOUT_Z_90.map(|x| -x), identity) - PI / 2.0).abs() < 1e-12);
        assert!((angle_between([0.0, 1.0, 0.0, 0.0], identity) - PI).abs() < 1e-12);
        // Rounding may make the vector part longer than one.
        assert!(angle_between([0.0, 1.0 + 1e-15, 0.0, 0.0], identity).is_finite());
    }

    #[test]
    fn canonical_quaternions_have_no_negative_w() {
        assert_eq!(canonical([-0.5, 0.5, -0.5, 0.5]), [0.5, -0.5, 0.5, -0.5]);
        assert_eq!(canonical(ABOUT_Z_90), ABOUT_Z_90);
    }

    #[test]
    fn uniform_rotations_have_unit_length_and_the_right_mean_angle() {
        let mut rng = rng::stream(0, "test", 0);
        let mut draw = || rng::uniform(&mut rng, 0.0, 1.0);
        let angles: Vec<f64> = (0..20_000)
            .map(|_| {
                let q = uniform([draw(), draw(), draw()]);
                assert!((q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
                angle_between(q, [1.0, 0.0, 0.0, 0.0])
            })
            .collect();
        // The angle of a uniform rotation has the density (1 - cos a) / π, so its mean is π/2 + 2/π.
        let mean = angles.iter().sum::<f64>() / angles.len() as f64;
        assert!(
            (mean - (PI / 2.0 + 2.0 / PI)).abs() < 0.02,
            "mean angle {mean}"
        );
    }

    #[test]
    fn a_rotation_vector_is_the_axis_times_the_shorter_angle() {
        assert!(close(&rotation_vector(ABOUT_Z_90), &[0.0, 0.0, PI / 2.0]));
        assert!(close(
            &rotation_vector(ABOUT_Z_90.map(|x| -x)),
            &[0.0, 0.0, PI / 2.0]
        ));
        let (cos, sin) = (1e-15, 1.0);
        assert!(close(
            &rotation_vector([-cos, sin, 0.0, 0.0]),
            &[-PI, 0.0, 0.0]
        ));
        assert!(close(&rotation_vector([1.0, 0.0, 0.0, 0.0]), &[0.0; 3]));
    }
}
