//! Quantiles of measured values.

/// The median; reorders its argument. `None` for no values.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The value below which a fraction of the values lies; reorders its argument. `None` for no
/// values.
pub(crate) fn quantile(values: &mut [f64], fraction: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let index = ((last as f64) * fraction.clamp(0.0, 1.0)).round() as usize;
    Some(*values.select_nth_unstable_by(index, f64::total_cmp).1)
}
