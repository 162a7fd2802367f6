//! Durations of the robot's time, from seconds.

use std::time::Duration;

/// A duration of `seconds`, at least 1 ns where they are more than zero: what takes any time is never over at once. Negative values and NaN give zero;
/// values beyond the range give the longest duration.
pub(crate) fn span(seconds: f64) -> Duration {
    let least = Duration::from_nanos(u64::from(seconds > 0.0));
    Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(Duration::MAX).max(least)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_counted_is_for_ever_and_never_at_once() {
        assert_eq!(span(1e300), Duration::MAX);
        assert_eq!(span(f64::INFINITY), Duration::MAX);
        assert_eq!([span(-1.0), span(f64::NAN)], [Duration::ZERO; 2]);
        assert_eq!(span(1.5), Duration::from_millis(1_500));
        assert_eq!(span(1e-12), Duration::from_nanos(1));
    }
}
