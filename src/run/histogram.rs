//! Histograms for TensorBoard.

use tensorboard_proto::summary::HistogramProto;

/// The number of bins. TensorBoard draws 30.
const BINS: usize = 60;

/// Counts of values in bins of equal width between the smallest and the largest. `bucket_limit` holds the upper limits of the
/// bins, `bucket` the number of values in each. A bin includes its lower limit. The last one also includes its upper limit.
pub type Histogram = HistogramProto;

/// Counts `values`, which must be finite.
pub fn histogram<'a>(values: impl Iterator<Item = &'a f32> + Clone) -> Histogram {
    let values = values.map(|&x| f64::from(x));
    let min = values.clone().fold(f64::INFINITY, f64::min);
    let max = values.clone().fold(f64::NEG_INFINITY, f64::max);
    // All values may be the same.
    let bins = if max > min { BINS } else { 1 };
    let width = (max - min) / bins as f64;
    let limits = (1..bins).map(|i| min + width * i as f64);
    let mut found = Histogram {
        min,
        max,
        bucket_limit: limits.chain([max]).collect(),
        bucket: vec![0.0; bins],
        ..Histogram::default()
    };
    for x in values {
        // Without a width, it is NaN, which becomes 0.
        let bin = ((x - min) / width) as usize;
        found.bucket[bin.min(bins - 1)] += 1.0;
        found.num += 1.0;
        found.sum += x;
        found.sum_squares += x * x;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_counted_in_the_bin_between_whose_limits_it_lies() {
        let values: Vec<f32> = (0..=120).map(|i| (i as f32 - 60.0) / 60.0).collect();
        let found = histogram(values.iter());
        assert_eq!(
            (found.min, found.max, found.bucket_limit.len()),
            (-1.0, 1.0, BINS)
        );
        assert_eq!(found.bucket.iter().sum::<f64>(), 121.0);
        // Two values in each bin, and the largest in the last.
        assert!(
            found.bucket[..BINS - 1]
                .iter()
                .all(|count| (1.0..=3.0).contains(count)),
            "{:?}",
            found.bucket
        );
        assert!(
            found.sum.abs() < 1e-6 && (found.sum_squares - 2.0 * 73_810.0 / 3600.0).abs() < 1e-6,
            "{found:?}"
        );
        assert!(found.bucket_limit.is_sorted() && found.bucket_limit[BINS - 1] == 1.0);
    }

    #[test]
    fn equal_values_fill_one_bin() {
        let found = histogram([0.25_f32; 20].iter());
        assert_eq!((found.bucket_limit, found.bucket), (vec![0.25], vec![20.0]));
    }
}
