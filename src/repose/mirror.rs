//! The mirror image of a hand: turns what it observes into what the hand on the other side would observe. The mirror is the
//! plane y = 0 of the world.

use anyhow::{Result, ensure};

use super::observation::{Layout, TIP_QUAT};
use super::record::Record;
use crate::quat::{self, Quat};

/// The largest allowed difference between mirrored fingertips and the fingertips of the policy's hand: m, and components
/// of quaternions.
const TOLERANCE: f64 = 1e-4;

/// Turns observations of a hand into observations of its mirror image.
#[derive(Clone)]
pub struct Mirror {
    /// The values that change their sign, by index.
    signs: Vec<usize>,
    /// For each fingertip the index of its orientation, and the rotation between the mirrored frame and the frame of the other
    /// hand.
    tips: Vec<(usize, Quat)>,
}

impl Mirror {
    /// The mirror from the hand of `here` to the hand of `policy`.
    ///
    /// # Errors
    /// Fails if, in any recorded pose, the fingertips of one hand are not where the mirrored fingertips of the other are.
    pub fn new(here: &Record, policy: &Record, layout: &Layout) -> Result<Self> {
        // Returns how far a fingertip is from its counterpart on the other hand in a recorded pose, and the rotation
        // between the two.
        let compare = |at: usize| {
            let [x, y, z, qw, qx, qy, qz] = here.tips[at];
            let [a, b, c, other @ ..] = policy.tips[at];
            let apart = [x - a, y + b, z - c].map(f64::abs);
            // The axis of a mirrored rotation is mirrored like a point, and its sense is the opposite one.
            let mirrored = [qw, -qx, qy, -qz];
            let between = quat::mul(quat::conj(mirrored), other);
            (apart.into_iter().fold(0.0, f64::max), between)
        };
        let mut tips = Vec::new();
        for (i, start) in layout.tips().enumerate() {
            let poses = [i, i + here.fingertips.len()].map(compare);
            let (_, turn) = poses[0];
            for (apart, between) in poses {
                let turned = between.iter().zip(turn).map(|(a, b)| a * b).sum::<f64>();
                ensure!(
                    apart <= TOLERANCE && turned >= 1.0 - TOLERANCE,
                    "the hand is not the mirror image of the policy's hand (plane y = 0): the fingertip `{}` is {:.1} mm off",
                    here.fingertips[i],
                    1e3 * apart
                );
            }
            tips.push((start + TIP_QUAT, turn));
        }
        Ok(Self {
            signs: layout.mirrored(),
            tips,
        })
    }

    /// The mirror between hands whose names do not tell that they are on different sides, if the fingertips are in the same places only in
    /// the mirror.
    pub fn by_fingertips(here: &Record, policy: &Record, layout: &Layout) -> Option<Self> {
        let mut tips = here.tips.iter().zip(&policy.tips);
        if tips.all(|(a, b)| (0..3).all(|i| (a[i] - b[i]).abs() <= TOLERANCE)) {
            None
        } else {
            Self::new(here, policy, layout).ok()
        }
    }

    /// Mirrors an observation in place.
    pub fn apply(&self, observation: &mut [f32]) {
        for &i in &self.signs {
            observation[i] = -observation[i];
        }
        for &(at, turn) in &self.tips {
            let turned = quat::mul(quat::read(observation, at), turn.map(|x| x as f32));
            observation[at..at + 4].copy_from_slice(&turned);
        }
    }

    /// The matrix `[O, O]` that mirrors an observation, which is a row on its left.
    pub fn matrix(&self, size: usize) -> Vec<f32> {
        let mut matrix = vec![0.0; size * size];
        for (i, row) in matrix.chunks_exact_mut(size).enumerate() {
            row[i] = 1.0;
            self.apply(row);
        }
        matrix
    }
}
