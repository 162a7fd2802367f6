//! Differences between individuals of a class apart from their dimensions: the shape of a wall, the lid of a can. The model itself has form 0. A fit
//! estimates the form, because a real object never equals its model, and a prior keeps the form plausible where little of the object is seen.

use super::ObjectClass;
use std::ops::RangeInclusive;

/// How an individual differs from its model: a box by [`ROUNDED`], round objects by [`BELLY`] and [`LIFT`], a fork by [`RISE`], [`BOW`] and [`GAPS`].
pub(crate) type Form = [f64; FORMS];
/// Numbers in a form.
pub(crate) const FORMS: usize = 3;
/// How much farther out than the model's the wall below the rim is, in metres.
pub(crate) const BELLY: usize = 0;
/// The radius by which a box's edges are rounded, in metres.
pub(crate) const ROUNDED: usize = 0;
/// How much higher than the model's the bottom of a hollow object or the lid of a can is, in metres.
pub(crate) const LIFT: usize = 1;

/// How much higher a fork is than the model, as a part of the model's height.
pub(crate) const RISE: usize = 0;
/// How much lower the bow of its head is, as a part of its length.
pub(crate) const BOW: usize = 1;
/// How much less metal there is between the gaps of its tines, as a part of their width.
pub(crate) const GAPS: usize = 2;

/// The prior of a number of a form: a normal distribution, and its allowed range.
#[derive(Debug, Clone)]
pub(crate) struct Usual {
    pub(crate) mean: f64,
    pub(crate) deviation: f64,
    pub(crate) range: RangeInclusive<f64>,
}

/// No deviation.
const NONE: Usual = Usual { mean: 0.0, deviation: 0.0, range: 0.0..=0.0 };

impl Usual {
    /// Whether it may deviate at all.
    pub(crate) fn is_free(&self) -> bool {
        self.deviation > 0.0
    }
}

impl ObjectClass {
    /// Errors beyond the fit's covariance: standard deviations in metres along the object's axis, across, and up. Measured with objects that have details
    /// of their own (`crate::shapes`) and a sensor with flying pixels and lasting noise (`crate::sensor`). Forks and plates have these errors without any
    /// noise, because of their form; the others because of edges and of noise that a whole object shares, and more frames do not reduce it.
    pub(crate) fn off_beyond_fit(self) -> [f64; 3] {
        match self {
            ObjectClass::Box => [0.0005, 0.0005, 0.0002],
            ObjectClass::Can => [0.0006, 0.0006, 0.0007],
            ObjectClass::Cup => [0.0005, 0.0005, 0.0006],
            ObjectClass::Bowl => [0.0005, 0.0005, 0.0004],
            ObjectClass::Plate => [0.0006, 0.0006, 0.0005],
            // The positions of neck and bow differ from fork to fork, and its ends are low.
            ObjectClass::Fork => [0.0026, 0.0012, 0.0005],
        }
    }

    /// The prior of this class's forms: crockery has a foot of a few millimetres below its bottom and its own curves, lids are sunken.
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
