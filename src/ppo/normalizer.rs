//! Running mean and variance of the observations, saved with the policy that was trained on them.

use rayon::prelude::*;

use super::kernels::widest;
use crate::ranks::Exchange;

/// Rows that one task sums. The number is fixed, so that the result does not depend on the number of threads.
const ROWS_PER_TASK: usize = 1024;

/// Statistics of each of the O values of an observation.
#[derive(Debug, PartialEq)]
pub struct Normalizer {
    /// `[O]`: means
    pub mean: Vec<f64>,
    /// `[O]`: variances
    pub variance: Vec<f64>,
    /// The number of observations seen.
    pub count: f64,
    /// What is added to a variance, so that a constant value does not cause a division by zero.
    pub epsilon: f64,
    /// Normalised values are clipped to ± this many standard deviations, so that rare outliers do not upset the nets.
    pub clip: f64,
}

/// What is added to variances.
pub const EPSILON: f64 = 1e-5;

/// The limit of normalised values.
pub const CLIP: f64 = 5.0;

impl Normalizer {
    /// Creates a normaliser that has seen nothing and leaves observations of `size` values almost unchanged.
    pub fn new(size: usize) -> Self {
        Self {
            mean: vec![0.0; size],
            variance: vec![1.0; size],
            count: 0.0,
            epsilon: EPSILON,
            clip: CLIP,
        }
    }

    /// Adds the raw rows of these arrays `[B, O]` on all ranks to the statistics. `perceive` is first applied to each row.
    ///
    /// T. F. Chan, G. H. Golub, R. J. LeVeque, "Updating formulae and a pairwise algorithm for computing sample
    /// variances" (1979), eq. 2.1.
    pub fn update(
        &mut self,
        arrays: &[&[f32]],
        exchange: &Exchange,
        perceive: impl Fn(&mut [f32]) + Sync,
    ) {
        let size = self.mean.len();
        let rows = exchange.of_all(arrays.iter().map(|array| array.len() / size).sum()) as f64;
        let mean_of = |f: fn(f64, f64) -> f64, means: &[f64]| -> Vec<f64> {
            exchange
                .sum(
                    arrays,
                    |arrays| column_sums(arrays, means, &perceive, f),
                    add,
                )
                .into_iter()
                .map(|total| total / rows)
                .collect()
        };
        let mean = mean_of(|x, _| x, &vec![0.0; size]);
        let variance = mean_of(|x, mean| (x - mean).powi(2), &mean);
        let total = self.count + rows;
        for i in 0..size {
            let delta = mean[i] - self.mean[i];
            let between = delta * delta * self.count * rows / total;
            self.variance[i] =
                (self.variance[i] * self.count + variance[i] * rows + between) / total;
            self.mean[i] += delta * rows / total;
        }
        self.count = total;
    }
}

/// The sum of `f(value, mean)` over the perceived rows of these arrays in each column, with the mean of the column.
fn column_sums(
    arrays: &[&[f32]],
    means: &[f64],
    perceive: impl Fn(&mut [f32]) + Sync,
    f: fn(f64, f64) -> f64,
) -> Vec<f64> {
    let size = means.len();
    let of_task = |rows: &[f32]| {
        let mut sums = vec![0.0; size];
        let mut seen = vec![0.0; size];
        widest!({
            for row in rows.chunks_exact(size) {
                seen.copy_from_slice(row);
                perceive(&mut seen);
                for ((sum, &x), &mean) in sums.iter_mut().zip(&seen).zip(means) {
                    *sum += f(f64::from(x), mean);
                }
            }
        });
        sums
    };
    let tasks = arrays
        .par_iter()
        .flat_map(|array| array.par_chunks(ROWS_PER_TASK * size));
    let partial: Vec<Vec<f64>> = tasks.map(of_task).collect();
    partial.into_iter().reduce(add).expect("a row")
}

fn add(mut sums: Vec<f64>, more: Vec<f64>) -> Vec<f64> {
    sums.iter_mut().zip(more).for_each(|(sum, x)| *sum += x);
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    #[test]
    fn many_batches_give_the_mean_and_variance_of_all_rows_at_once() {
        let mut rng = rng::stream(0, "test", 0);
        // The second column is far from zero: a naive sum of squares would lose its variance.
        let rows: Vec<f32> = (0..5000)
            .flat_map(|_| {
                [
                    rng::uniform(&mut rng, -1.0, 3.0) as f32,
                    rng::uniform(&mut rng, 4000.0, 4001.0) as f32,
                ]
            })
            .collect();
        let mut normalizer = Normalizer::new(2);
        for batch in [
            &[&rows[..14]][..],
            &[&rows[14..3000], &rows[3000..3004]],
            &[&rows[3004..]],
        ] {
            normalizer.update(batch, &Exchange::alone(1), |_| {});
        }
        for column in 0..2 {
            let values: Vec<f64> = rows
                .iter()
                .skip(column)
                .step_by(2)
                .map(|&x| f64::from(x))
                .collect();
            let mean = values.iter().sum::<f64>() / 5000.0;
            let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 5000.0;
            assert!((normalizer.mean[column] - mean).abs() < 1e-9 * mean.abs());
            assert!((normalizer.variance[column] / variance - 1.0).abs() < 1e-9);
        }
        assert_eq!(normalizer.count, 5000.0);
    }
}
