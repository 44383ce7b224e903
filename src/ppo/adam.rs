//! Adam, in place on all parameters and in parallel, and the norm of a gradient.

use std::ops::Range;

use rayon::prelude::*;

use super::kernels::widest;

/// The decay rate of the mean gradient.
const BETA1: f64 = 0.9;

/// The decay rate of the mean squared gradient.
const BETA2: f64 = 0.999;

/// Added to the denominator, so that it is never zero.
const EPSILON: f64 = 1e-8;

/// Parameters that one task updates.
const CHUNK: usize = 8192;

/// Values whose squares one task adds up. The number is fixed, so that the result does not depend on the number of threads.
const NORM_CHUNK: usize = 4096;

/// The Adam optimizer: D. P. Kingma, J. Ba, "Adam: a method for stochastic optimization" (2015), algorithm 1.
#[derive(PartialEq)]
pub struct Adam {
    /// The running mean of the gradient.
    pub mean: Vec<f32>,
    /// The running mean of the squared gradient.
    pub square: Vec<f32>,
    /// The number of steps taken.
    pub steps: u64,
}

impl Adam {
    /// Creates an optimizer of `count` parameters that has not taken a step.
    pub fn new(count: usize) -> Self {
        Self {
            mean: vec![0.0; count],
            square: vec![0.0; count],
            steps: 0,
        }
    }

    /// Moves the parameters in the range `own` one step against the gradient, which is first multiplied by `scale`, with this
    /// learning `rate`.
    pub fn step(
        &mut self,
        parameters: &mut [f32],
        gradient: &[f32],
        own: Range<usize>,
        (rate, scale): (f64, f64),
    ) {
        self.steps += 1;
        let correction = |beta: f64| 1.0 - beta.powi(self.steps as i32);
        let scale = scale as f32;
        let rate = (rate / correction(BETA1)) as f32;
        let unbiased = (1.0 / correction(BETA2)) as f32;
        let [mean, square] =
            [&mut self.mean, &mut self.square].map(|moment| &mut moment[own.clone()]);
        let parameters = parameters[own.clone()]
            .par_chunks_mut(CHUNK)
            .zip(gradient[own].par_chunks(CHUNK));
        let moments = mean.par_chunks_mut(CHUNK).zip(square.par_chunks_mut(CHUNK));
        parameters
            .zip(moments)
            .for_each(|((x, grad), (mean, square))| {
                widest!({
                    for (((x, grad), mean), square) in x.iter_mut().zip(grad).zip(mean).zip(square)
                    {
                        let grad = grad * scale;
                        *mean = BETA1 as f32 * *mean + (1.0 - BETA1) as f32 * grad;
                        *square = BETA2 as f32 * *square + (1.0 - BETA2) as f32 * grad * grad;
                        *x -= rate * *mean / ((*square * unbiased).sqrt() + EPSILON as f32);
                    }
                });
            });
    }
}

/// The chunks of these ranges of parameters, whose squares are added up separately.
pub fn norm_chunks(groups: &[Range<usize>]) -> Vec<Range<usize>> {
    let mut chunks = Vec::new();
    for group in groups {
        chunks.extend(
            group
                .clone()
                .step_by(NORM_CHUNK)
                .map(|first| first..group.end.min(first + NORM_CHUNK)),
        );
    }
    chunks
}

/// The Euclidean norm of a gradient with these `squares` in the chunks of its groups. They are added group by
/// group.
pub fn norm(squares: &[f64], groups: &[Range<usize>]) -> f64 {
    let mut squares = squares.iter();
    let of_groups = groups.iter().map(|group| {
        let chunks = group.len().div_ceil(NORM_CHUNK);
        squares.by_ref().take(chunks).sum::<f64>()
    });
    of_groups.sum::<f64>().sqrt()
}

/// The sum of squares, added in lanes: in f32 within a lane, then in f64 over the lanes.
pub fn sum_of_squares(x: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 32];
    widest!({
        let (whole, rest) = x.as_chunks::<32>();
        for chunk in whole.iter().map(|chunk| &chunk[..]).chain([rest]) {
            lanes
                .iter_mut()
                .zip(chunk)
                .for_each(|(lane, x)| *lane += x * x);
        }
    });
    lanes.into_iter().map(f64::from).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn norm_of(gradient: &[f32], groups: &[Range<usize>]) -> f64 {
        let chunks = norm_chunks(groups).into_par_iter();
        norm(
            &chunks
                .map(|chunk| sum_of_squares(&gradient[chunk]))
                .collect::<Vec<f64>>(),
            groups,
        )
    }

    /// The expected values come from this program (PyTorch):
    /// ```python
    /// import torch
    /// x = torch.tensor([1.0, -2.0, 3.0], requires_grad=True)
    /// adam = torch.optim.Adam([x], lr=0.1)
    /// for _ in range(3):
    ///     adam.zero_grad()
    ///     (x ** 2 * torch.tensor([1.0, 0.5, 0.1])).sum().backward()
    ///     norm = torch.nn.utils.clip_grad_norm_([x], 1.0)
    ///     adam.step()
    ///     print(norm.item(), x.tolist())
    /// ```
    #[test]
    fn steps_with_clipped_gradients_match_pytorch() {
        let (mut x, mut adam) = ([1.0f32, -2.0, 3.0], Adam::new(3));
        for (expected_norm, expected) in GOLDEN {
            let gradient = [2.0 * x[0], x[1], 0.2 * x[2]];
            let norm = norm_of(&gradient, &[0..2, 2..3]);
            assert!((norm - expected_norm).abs() < 1e-5, "norm {norm}");
            adam.step(
                &mut x,
                &gradient,
                0..3,
                (0.1, (1.0 / (norm + 1e-6)).min(1.0)),
            );
            for (found, expected) in x.iter().zip(expected) {
                assert!(
                    (found - expected).abs() < 1e-6,
                    "{found} instead of {expected}"
                );
            }
        }
        assert_eq!(adam.steps, 3);
    }

    const GOLDEN: [(f64, [f32; 3]); 3] = [
        (2.891_366_5, [0.900_000_04, -1.9, 2.9]),
        (2.680_746_3, [0.800_088_5, -1.799_943_9, 2.799_913_2]),
        (2.472_639_3, [0.700_356_66, -1.699_788_2, 2.699_673_2]),
    ];

    #[test]
    fn the_norm_is_that_of_all_numbers_on_any_number_of_threads() {
        let gradient: Vec<f32> = (0..20_000)
            .map(|i| ((i * 7919) % 1000) as f32 - 500.0)
            .collect();
        let exact = gradient
            .iter()
            .map(|&x| f64::from(x).powi(2))
            .sum::<f64>()
            .sqrt();
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| norm_of(&gradient, &[0..12_345, 12_345..20_000]))
        };
        assert!((on(1) / exact - 1.0).abs() < 1e-5);
        assert!([2, 8].map(on) == [on(1); 2]);
    }
}
