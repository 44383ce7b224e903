//! Figures that describe many numbers.

/// The mean, or `NaN` of no values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The value below which the `fraction` of the `sorted` values lies, interpolated linearly, or `NaN` if there are none.
pub fn percentile(sorted: &[f64], fraction: f64) -> f64 {
    let place = fraction * sorted.len().saturating_sub(1) as f64;
    let below = place as usize;
    let [low, high] =
        [below, below + 1].map(|i| sorted.get(i).or(sorted.last()).copied().unwrap_or(f64::NAN));
    low + place.fract() * (high - low)
}

/// Fits the least-squares line y(x), and returns its offset and slope, or `NaN` for fewer than two distinct x.
pub fn line(points: impl Iterator<Item = [f64; 2]> + Clone) -> [f64; 2] {
    let count = points.clone().count() as f64;
    let mean = |of: &dyn Fn([f64; 2]) -> f64| points.clone().map(of).sum::<f64>() / count;
    let x_mean = mean(&|[x, _]| x);
    let y_mean = mean(&|[_, y]| y);
    let spread = mean(&|[x, _]| (x - x_mean).powi(2));
    let slope = if spread > 0.0 {
        mean(&|[x, y]| (x - x_mean) * (y - y_mean)) / spread
    } else {
        f64::NAN
    };
    [y_mean - slope * x_mean, slope]
}
