//! Whether a curve keeps every joint in its range, also between its postures: by the extremes of its
//! polynomials.

use super::follow::Bounds;
use super::path::Segment;
use crate::cubic::Cubic;
use crate::trajectory::Knot;

/// Tolerance of a joint's range, in radians or metres, for rounding.
const ROUNDED: f64 = 1e-6;

/// The allowed range of each joint.
#[derive(Debug, Clone)]
pub(crate) struct Room<const N: usize> {
    lower: [f64; N],
    upper: [f64; N],
}

impl<const N: usize> Room<N> {
    /// The limits of the joints, extended to contain given postures.
    pub(crate) fn new<'p>(bounds: &Bounds<N>, postures: impl IntoIterator<Item = &'p [f64; N]>) -> Room<N> {
        let mut room = Room { lower: bounds.lower, upper: bounds.upper };
        postures.into_iter().for_each(|posture| (0..N).for_each(|j| room.widen(j, [posture[j]; 2])));
        room
    }

    /// Extends the ranges to contain a motion that is followed exactly.
    pub(crate) fn with(mut self, knots: &[Knot<[f64; N]>]) -> Room<N> {
        ranges(knots).for_each(|(j, range)| self.widen(j, range));
        self
    }

    fn widen(&mut self, j: usize, [least, greatest]: [f64; 2]) {
        self.lower[j] = self.lower[j].min(least);
        self.upper[j] = self.upper[j].max(greatest);
    }

    fn has(&self, j: usize, [least, greatest]: [f64; 2]) -> bool {
        least >= self.lower[j] - ROUNDED && greatest <= self.upper[j] + ROUNDED
    }

    /// Whether a segment stays within the ranges.
    pub(crate) fn holds(&self, segment: &Segment<N>) -> bool {
        (0..N).all(|j| self.has(j, segment.hull(j)) || self.has(j, segment.range(j)))
    }

    /// Whether a motion stays within the ranges.
    pub(crate) fn holds_motion(&self, knots: &[Knot<[f64; N]>]) -> bool {
        ranges(knots).all(|(j, range)| self.has(j, range))
    }
}

/// The range of each joint between any two knots.
fn ranges<const N: usize>(knots: &[Knot<[f64; N]>]) -> impl Iterator<Item = (usize, [f64; 2])> + '_ {
    knots.windows(2).flat_map(|pair| {
        (0..N).map(move |j| (j, Cubic::between(&pair[0], &pair[1], j).range(0.0, pair[1].time_s - pair[0].time_s)))
    })
}
