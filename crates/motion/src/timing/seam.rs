//! Passes from one section of a path into the next without stopping, where both leave room for it: the ends on both sides of the seam are
//! cut off and replaced by a quintic with the same position, direction and curvature at both ends.

use super::blend::{LEAST_RAD, SHARPEST_RAD, is_free_along};
use super::follow::{Bounds, estimate};
use super::path::{Path, Segment, norm};
use super::room::Room;

/// Number of halvings of the cut width before the arm stops at the seam instead.
const HALVINGS: usize = 4;

/// What remains of a segment that is cut is at least this part of the width.
const CRUMB_SHARE: f64 = 0.1;

/// A smooth path, and how much of it a seam may take at its beginning and at its end, in radians.
#[derive(Debug, Clone)]
pub(crate) struct Loose<const N: usize> {
    pub(crate) path: Path<N>,
    pub(crate) ends: [f64; 2],
}

/// The pieces of all sections in order, each from rest to rest, with fewer stops between the sections. `None` where every seam stays.
pub(crate) fn joined<const N: usize>(
    sections: &[Vec<Loose<N>>],
    bounds: &Bounds<N>,
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Path<N>>> {
    let mut pieces: Vec<Loose<N>> = Vec::new();
    let mut joins = false;
    for section in sections.iter().filter(|section| !section.is_empty()) {
        let mut rest = section.iter().cloned();
        if let (Some(last), Some(first)) = (pieces.last(), section.first())
            && let Some(whole) = across(last, first, bounds, room, is_free, goes_on)
        {
            (joins, _) = (true, rest.next());
            pieces.pop();
            pieces.push(whole);
        }
        pieces.extend(rest);
    }
    joins.then(|| pieces.into_iter().map(|piece| piece.path).collect())
}

/// Joins two pieces: among the widths that are free, the fastest by estimate, if it is faster than a stop.
fn across<const N: usize>(
    before: &Loose<N>,
    after: &Loose<N>,
    bounds: &Bounds<N>,
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Loose<N>> {
    let mut best: Option<(f64, Loose<N>)> = None;
    let stopping = estimate(&before.path, bounds) + estimate(&after.path, bounds);
    let mut width = before.ends[1].min(after.ends[0]);
    for _ in 0..=HALVINGS {
        if width < LEAST_RAD || !goes_on() {
            break;
        }
        let (cut, seam, goes_on_at) = seam(&before.path, &after.path, width)?;
        if is_free_along(&seam, room, is_free) {
            let mut path = before.path.part(0.0, cut);
            path.push(seam);
            path.append(after.path.part(goes_on_at, after.path.length()));
            let lasts = estimate(&path, bounds);
            match &best {
                // Narrower seams only get slower from here on.
                Some((least, _)) if lasts >= *least => break,
                None if lasts >= stopping => {}
                _ => best = Some((lasts, Loose { path, ends: [before.ends[0], after.ends[1]] })),
            }
        }
        width /= 2.0;
    }
    best.map(|(_, whole)| whole)
}

/// The quintic across a seam, with the s at which the path before is left and the path after is entered; `None` where the path reverses.
fn seam<const N: usize>(before: &Path<N>, after: &Path<N>, width: f64) -> Option<(f64, Segment<N>, f64)> {
    // No segment is left with only a crumb.
    let crumb = CRUMB_SHARE * width;
    let (out, on) = (before.length() - width, width);
    let left = before.breaks().filter(|b| *b <= out).fold(0.0, f64::max) + crumb;
    let right = after.breaks().filter(|b| *b >= on).fold(after.length(), f64::min) - crumb;
    let (out, on) = (out.max(left), on.min(right));
    let (from, to) = (before.at(out), after.at(on));
    let [a, b] = [from.first, to.first].map(|d| d.map(|x| x / norm(&d).max(1e-12)));
    let difference: [f64; N] = std::array::from_fn(|j| b[j] - a[j]);
    let leads_on = norm(&difference) < 2.0 * (SHARPEST_RAD / 2.0).sin();
    leads_on.then(|| (out, Segment::between(&from, &to, before.length() - out + on), on))
}
