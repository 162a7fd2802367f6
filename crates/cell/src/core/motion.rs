//! A trajectory that is being followed.

use ratn_motion::trajectory::Curve;

/// Joints on their way along a trajectory.
#[derive(Debug, Clone)]
pub(crate) struct Motion<const N: usize> {
    trajectory: Curve<N>,
    /// When it ends before it is done, and why.
    breaks: Option<(f64, String)>,
}

impl<const N: usize> Motion<N> {
    /// Along all of it, or until it breaks off: after so many seconds, for that reason.
    pub(crate) fn new(trajectory: Curve<N>, breaks: Option<(f64, String)>) -> Motion<N> {
        Motion { trajectory, breaks }
    }

    /// How long it takes, in seconds.
    pub(crate) fn lasts_s(&self) -> f64 {
        self.breaks.as_ref().map_or(self.trajectory.duration_s(), |(at_s, _)| *at_s)
    }

    /// Where the joints are after so many seconds.
    pub(crate) fn at(&self, time_s: f64) -> [f64; N] {
        self.trajectory.sample(time_s).positions
    }

    /// Where they end; why they do not get to the trajectory's end, if so.
    pub(crate) fn end(&self) -> ([f64; N], Option<&str>) {
        match &self.breaks {
            Some((at_s, reason)) => (self.at(*at_s), Some(reason)),
            None => (self.trajectory.end(), None),
        }
    }
}
