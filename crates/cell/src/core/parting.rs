//! What the fingers of an arm last closed around, and whether they have separated from it.
//!
//! ```text
//! Nothing ──close──▶ Something ──release──▶ Something, the arm stays ──each 3 mm away──▶ Something, the arm may leave
//!    ▲   └─fails──▶ Slipped ──open fully, or start a motion──▶ (as Nothing)
//!    └── closed around nothing at all
//! ```

/// How far each finger moves away from a released object before the arm may leave, in metres.
const PARTED_M: f64 = 0.003;
/// Tolerance for finger positions, in metres.
const ROUNDED_M: f64 = 1e-6;

/// The last closing of an arm's fingers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Closed {
    /// Distance of each finger from the middle, in metres. They have never been closer to each other since.
    pub(super) at_m: f64,
    pub(super) around: Around,
}

/// What fingers have closed around.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Around {
    /// Nothing that they could still touch.
    Nothing,
    /// An object that they hold, or have released.
    Something,
    /// An object that they do not hold, because it slipped out or they were stopped while closing: they may overlap with it.
    Slipped,
}

impl Closed {
    /// Fingers that have never closed.
    pub(super) const NEVER: Closed = Closed { at_m: 0.0, around: Around::Nothing };

    /// Distance from the middle at which each finger has separated, in metres; `open_m` is the maximum.
    fn parted_m(self, open_m: f64) -> f64 {
        (self.at_m + PARTED_M).min(open_m) - ROUNDED_M
    }

    /// Whether fingers that are `finger` metres from the middle have moved away from where they had closed.
    pub(super) fn has_parted(self, finger: f64, open_m: f64) -> bool {
        finger >= self.parted_m(open_m)
    }

    /// Whether fingers that hold nothing may still be at the object that they released.
    pub(super) fn is_at_what_it_let_go(self, finger: f64, open_m: f64) -> bool {
        self.around == Around::Something && !self.has_parted(finger, open_m)
    }

    /// Whether fingers that hold nothing and do not close push the objects that they touch.
    pub(super) fn pushes(self, finger: f64, open_m: f64) -> bool {
        match self.around {
            Around::Nothing => true,
            Around::Something => self.has_parted(finger, open_m),
            Around::Slipped => finger >= open_m - ROUNDED_M,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingers_push_when_they_are_away_from_what_they_closed_around() {
        let pushes = |around: Around, finger: f64| Closed { at_m: 0.03, around }.pushes(finger, 0.05);
        assert_eq!([0.03, 0.0329, 0.033, 0.05].map(|at| pushes(Around::Something, at)), [false, false, true, true]);
        assert_eq!([0.03, 0.033, 0.0499, 0.05].map(|at| pushes(Around::Slipped, at)), [false, false, false, true]);
        assert!(pushes(Around::Nothing, 0.03));
    }

    #[test]
    fn fingers_that_cannot_open_by_as_much_have_parted_when_they_are_open() {
        let closed = Closed { at_m: 0.049, around: Around::Something };
        assert_eq!([0.049, 0.0499, 0.05].map(|at| closed.has_parted(at, 0.05)), [false, false, true]);
        assert_eq!([0.049, 0.0499, 0.05].map(|at| closed.is_at_what_it_let_go(at, 0.05)), [true, true, false]);
    }
}
