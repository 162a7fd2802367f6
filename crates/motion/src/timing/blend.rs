//! Rounds the corners of a path, each by itself: a quintic Bézier curve per corner with zero curvature at both ends, as wide as the
//! neighbours and the obstacles allow; where there is no room, the path is cut at the corner, and the arm stops there.

use super::path::{Path, Segment, between};
use super::room::Room;
use super::{SAGITTA_RAD, STRAIGHT_RAD};
use crate::collision::distance;

/// Maximum and minimum distance from a corner at which its blend begins and ends, in radians.
pub(super) const BLEND_RAD: f64 = 0.5;
pub(super) const LEAST_RAD: f64 = 0.002;

/// Number of halvings of a blend that touches something before the arm stops at the corner instead.
pub(super) const BLEND_HALVINGS: usize = 5;

/// A sharper corner is a reversal: the arm stops there, in radians.
pub(super) const SHARPEST_RAD: f64 = 3.0;

/// The control points on each side, from the blend's end to the corner.
const CONTROLS: [f64; 3] = [0.0, 0.4, 0.8];

/// The path with rounded corners, cut where the arm has to stop.
pub(crate) fn rounded<const N: usize>(
    path: &[[f64; N]],
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Vec<Path<N>> {
    let mut pieces = Vec::new();
    let mut piece = Path::default();
    let mut at = path[0];
    for window in path.windows(3) {
        let [before, corner, after] = [window[0], window[1], window[2]];
        let bend = bend_rad(&before, &corner, &after);
        if bend < STRAIGHT_RAD {
            line(&mut piece, &mut at, &corner);
            continue;
        }
        let (near, far) = (distance(&before, &corner), distance(&corner, &after));
        let mut width = BLEND_RAD.min(near / 2.0).min(far / 2.0);
        let mut curve = None;
        for _ in 0..=BLEND_HALVINGS {
            if width < LEAST_RAD || bend > SHARPEST_RAD {
                break;
            }
            let (from, to) = (between(&corner, &before, width / near), between(&corner, &after, width / far));
            let blend = bezier(&from, &corner, &to, width);
            if is_free_along(&blend, room, is_free) {
                curve = Some((from, blend, to));
                break;
            }
            width /= 2.0;
        }
        if let Some((from, blend, to)) = curve {
            line(&mut piece, &mut at, &from);
            piece.push(blend);
            at = to;
        } else {
            line(&mut piece, &mut at, &corner);
            pieces.push(std::mem::take(&mut piece));
        }
    }
    line(&mut piece, &mut at, &path[path.len() - 1]);
    pieces.push(piece);
    pieces
}

/// Adds a straight line to a point, unless it has no length.
fn line<const N: usize>(piece: &mut Path<N>, at: &mut [f64; N], to: &[f64; N]) {
    if distance(at, to) > 1e-9 {
        piece.push(Segment::line(at, to));
        *at = *to;
    }
}

/// The change of direction at a corner.
pub(crate) fn bend_rad<const N: usize>(before: &[f64; N], corner: &[f64; N], after: &[f64; N]) -> f64 {
    let (near, far) = (distance(before, corner), distance(corner, after));
    let side = |j: usize| ((corner[j] - before[j]) / near, (after[j] - corner[j]) / far);
    // From the difference and the sum of two unit vectors, which is exact for small angles, too.
    let (mut difference, mut sum) = (0.0, 0.0);
    for (a, b) in (0..N).map(side) {
        difference += (b - a) * (b - a);
        sum += (a + b) * (a + b);
    }
    2.0 * f64::sqrt(difference).atan2(f64::sqrt(sum))
}

/// The curve with control points on both sides: at its ends it has their directions and zero curvature.
fn bezier<const N: usize>(from: &[f64; N], corner: &[f64; N], to: &[f64; N], width: f64) -> Segment<N> {
    let before = CONTROLS.map(|share| between(from, corner, share));
    let after = CONTROLS.map(|share| between(to, corner, share));
    // The first derivative is 5 · 0.4 · width divided by the length: one, as along a line.
    Segment::bezier(&[before[0], before[1], before[2], after[2], after[1], after[0]], 2.0 * width)
}

/// Whether sufficiently close chords of a segment are free, and no joint leaves its range.
pub(crate) fn is_free_along<const N: usize>(
    segment: &Segment<N>,
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> bool {
    room.holds(segment) && segment.points(SAGITTA_RAD).windows(2).all(|pair| is_free(&pair[0], &pair[1]))
}
