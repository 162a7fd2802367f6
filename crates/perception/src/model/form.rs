//! What individuals of a class differ in beside their dimensions: the form of a wall, the lid of a can. A model by itself has the form 0; a
//! fit finds the form, because what is fitted is never quite its model, and the form that is usual keeps it from wandering off where
//! little of it is seen.

use super::ObjectClass;
use std::ops::RangeInclusive;

/// How much an individual differs from its model: of a box [`ROUNDED`], of what is round [`BELLY`] and [`LIFT`], of a fork [`RISE`], [`BOW`] and [`GAPS`].
pub(crate) type Form = [f64; FORMS];
/// How many numbers a form has.
pub(crate) const FORMS: usize = 3;
/// How much farther out the wall is below the rim than the model's, in metres.
pub(crate) const BELLY: usize = 0;
/// The radius by which a box's edges are rounded, in metres.
pub(crate) const ROUNDED: usize = 0;
/// How much higher the bottom of something hollow is than the model's, and how much a can's lid, in metres.
pub(crate) const LIFT: usize = 1;

/// How much higher a fork rises than the model, as a part.
pub(crate) const RISE: usize = 0;
/// How much lower the bow of its head is, as a part of its length.
pub(crate) const BOW: usize = 1;
/// How much less metal there is between the gaps of its tines, as a part of their width.
pub(crate) const GAPS: usize = 2;

/// What is usual of a number of a form: a normal distribution, and within what it is.
#[derive(Debug, Clone)]
pub(crate) struct Usual {
    pub(crate) mean: f64,
    pub(crate) deviation: f64,
    pub(crate) range: RangeInclusive<f64>,
}

/// Nothing differs.
const NONE: Usual = Usual { mean: 0.0, deviation: 0.0, range: 0.0..=0.0 };

impl Usual {
    /// Whether it may differ at all.
    pub(crate) fn is_free(&self) -> bool {
        self.deviation > 0.0
    }
}

impl ObjectClass {
    /// How far off an object is beyond what its fit knows, along its axis, across, and up, as deviations in metres. As measured on things with
    /// details of their own (`crate::shapes`) and a sensor with flying pixels and noise that lasts (`crate::sensor`). Forks and plates are so
    /// without any noise, by their form; the others by noise that a whole object shares and by edges, and no number of frames makes that less.
    pub(crate) fn off_beyond_fit(self) -> [f64; 3] {
        match self {
            ObjectClass::Box => [0.0005, 0.0005, 0.0002],
            ObjectClass::Can => [0.0006, 0.0006, 0.0007],
            ObjectClass::Cup => [0.0005, 0.0005, 0.0006],
            ObjectClass::Bowl => [0.0005, 0.0005, 0.0004],
            ObjectClass::Plate => [0.0006, 0.0006, 0.0005],
            // Where along it neck and bow are differs from fork to fork, and its ends are low.
            ObjectClass::Fork => [0.0026, 0.0012, 0.0005],
        }
    }

    /// What is usual of this class's forms: crockery has a foot of a few millimetres below its bottom and curves of its own, lids are sunken.
    pub(crate) fn usual(self) -> &'static [Usual; FORMS] {
        const HOLLOW: Usual = Usual { mean: 0.002, deviation: 0.003, range: -0.002..=0.010 };
        match self {
            ObjectClass::Box => &[Usual { mean: 0.003, deviation: 0.004, range: 0.0..=0.010 }, NONE, NONE],
            ObjectClass::Can => &[
                Usual { mean: 0.0, deviation: 0.001, range: -0.003..=0.001 },
                Usual { mean: 0.0, deviation: 0.003, range: -0.007..=0.001 },
                NONE,
            ],
            ObjectClass::Cup => &[Usual { mean: 0.002, deviation: 0.004, range: -0.006..=0.010 }, HOLLOW, NONE],
            ObjectClass::Bowl => &[Usual { mean: 0.002, deviation: 0.004, range: -0.008..=0.014 }, HOLLOW, NONE],
            ObjectClass::Plate => &[Usual { mean: 0.0, deviation: 0.006, range: -0.015..=0.015 }, HOLLOW, NONE],
            // It touches the surface with the bow, or nearly; tines get thinner towards their tips.
            ObjectClass::Fork => &[
                Usual { mean: 0.0, deviation: 0.10, range: -0.30..=0.30 },
                Usual { mean: 0.013, deviation: 0.007, range: -0.004..=0.0165 },
                Usual { mean: 0.25, deviation: 0.2, range: 0.0..=0.45 },
            ],
        }
    }
}
