//! The relief of a surface and the dark patches on it: smooth random fields in space, fixed to the body.

use super::Surface;
use crate::sensor::field;

/// Distance between bumps of the relief, in metres.
const BUMP_M: f64 = 0.006;
/// Approximate size of a dark patch, in metres.
pub(super) const PATCH_M: f64 = 0.012;

/// Depth of a surface behind its mean at a point of its body, in metres.
pub(super) fn relief(surface: &Surface, at: [f64; 3]) -> f64 {
    if surface.grain_m == 0.0 {
        return 0.0;
    }
    surface.grain_m * field::in_space(at.map(|c| c / BUMP_M + surface.origin))
}

/// Whether the point is in a dark patch.
pub(super) fn is_dark(surface: &Surface, at: [f64; 3]) -> bool {
    surface.dark > 0.0 && field::share_below(field::in_space(at.map(|c| c / PATCH_M - surface.origin))) < surface.dark
}
