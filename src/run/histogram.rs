//! Histograms for TensorBoard.

/// The number of bins. TensorBoard draws 30.
const BINS: usize = 60;

/// Counts of values in bins of equal width between the smallest and the largest.
#[derive(Clone, Debug, PartialEq)]
pub struct Histogram {
    /// The smallest value.
    pub min: f64,
    /// The largest value.
    pub max: f64,
    /// The sum of the values.
    pub sum: f64,
    /// The sum of their squares.
    pub sum_squares: f64,
    /// The upper limits of the bins.
    pub limits: Vec<f64>,
    /// The number of values in each bin, which holds its lower limit; the last also holds its upper one.
    pub counts: Vec<f64>,
}

impl Histogram {
    /// Counts `values`, which must be finite.
    pub fn new<'a>(values: impl Iterator<Item = &'a f32> + Clone) -> Self {
        let values = values.map(|&x| f64::from(x));
        let (min, max) = values.clone().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        // All values may be the same.
        let bins = if max > min { BINS } else { 1 };
        let width = (max - min) / bins as f64;
        let (mut counts, mut sum, mut sum_squares) = (vec![0.0; bins], 0.0, 0.0);
        for x in values {
            let bin = if width > 0.0 { ((x - min) / width) as usize } else { 0 };
            counts[bin.min(bins - 1)] += 1.0;
            sum += x;
            sum_squares += x * x;
        }
        let limits = (1..=bins).map(|i| if i == bins { max } else { min + width * i as f64 }).collect();
        Self { min, max, sum, sum_squares, limits, counts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_counted_in_the_bin_between_whose_limits_it_lies() {
        let values: Vec<f32> = (0..=120).map(|i| (i as f32 - 60.0) / 60.0).collect();
        let found = Histogram::new(values.iter());
        assert_eq!((found.min, found.max, found.limits.len()), (-1.0, 1.0, BINS));
        assert_eq!(found.counts.iter().sum::<f64>(), 121.0);
        // Two values in each bin, and the largest in the last.
        assert!(found.counts[..BINS - 1].iter().all(|count| (1.0..=3.0).contains(count)), "{:?}", found.counts);
        assert!(found.sum.abs() < 1e-6 && (found.sum_squares - 2.0 * 73_810.0 / 3600.0).abs() < 1e-6, "{found:?}");
        assert!(found.limits.is_sorted() && found.limits[BINS - 1] == 1.0);
    }

    #[test]
    fn equal_values_fill_one_bin() {
        let found = Histogram::new([0.25_f32; 20].iter());
        assert_eq!((found.limits, found.counts), (vec![0.25], vec![20.0]));
    }
}
