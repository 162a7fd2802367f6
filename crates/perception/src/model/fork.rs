//! A fork on a table: it touches with the end of its handle and the bow of its head; the neck and the tips stand up.
//!
//! A bent strip along x: nodes give its height and width, everything grows with its length.

use crate::vector::Vector;

/// One cross section, of a fork of unit length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    /// Along the fork, from -0.5 at the handle's end to 0.5 at the tips.
    pub(super) x: f64,
    /// The strip's middle above the table.
    pub(super) z: f64,
    pub(super) width: f64,
}

/// Of a table fork of 190 mm: 22 mm wide, its neck 17 mm above the table.
pub(super) const NODES: [Node; 6] = [
    Node { x: -0.50, z: 0.0085, width: 0.100 },
    Node { x: -0.15, z: 0.0480, width: 0.065 },
    Node { x: 0.14, z: 0.0840, width: 0.042 },
    Node { x: 0.25, z: 0.0620, width: 0.115 },
    Node { x: 0.36, z: 0.0240, width: 0.125 },
    Node { x: 0.50, z: 0.0640, width: 0.115 },
];

/// The strip's thickness.
pub(super) const THICKNESS: f64 = 0.015;

/// What is nearer than this below the strip counts as closed for rays: hardly any gets there from above, and a strip of 3 mm would
/// not keep its own ends where the rays beside it say.
const UNDER: f64 = 0.05;
/// How much of a tine's pitch is metal; the rest is the gap.
pub(super) const TINE: f64 = 0.62;
/// Tines, in the last part of the head.
pub(super) const TINES: usize = 4;

/// Its bounding box.
pub(super) fn size(length: f64) -> [f64; 3] {
    [length, 0.125 * length, (0.0840 + THICKNESS / 2.0) * length]
}

/// Signed distance from the strip's upper side, with everything under it counted as its inside: that is what is seen from above,
/// and a point that noise has put under a strip of 3 mm still pulls it down. Gaps between tines do not count.
pub(super) fn distance(length: f64, point: Vector) -> f64 {
    let (above, aside) = offsets(length, point);
    let across = above - THICKNESS / 2.0;
    length * ((across.max(0.0).powi(2) + aside.max(0.0).powi(2)).sqrt() + across.max(aside).min(0.0))
}

/// Signed distance from the strip, a little thicker below: rays pass under its neck.
pub(super) fn fill_distance(length: f64, point: Vector) -> f64 {
    let (above, aside) = offsets(length, point);
    let across = above.max(-above - UNDER) - THICKNESS / 2.0;
    length * ((across.max(0.0).powi(2) + aside.max(0.0).powi(2)).sqrt() + across.max(aside).min(0.0))
}

/// For a fork of unit length: how far a point is above the strip's middle (below is negative), and beside its edge.
fn offsets(length: f64, point: Vector) -> (f64, f64) {
    let [x, y, z] = point.map(|c| c / length);
    let z = z + size(1.0)[2] / 2.0;
    // The square of the distance, its sign, the width there.
    let mut nearest = (f64::INFINITY, 1.0, 0.0);
    for pair in NODES.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let (dx, dz) = (b.x - a.x, b.z - a.z);
        let along = ((x - a.x) * dx + (z - a.z) * dz) / (dx * dx + dz * dz);
        let t = along.clamp(0.0, 1.0);
        let from = (x - a.x - t * dx).powi(2) + (z - a.z - t * dz).powi(2);
        if from < nearest.0 {
            // Beyond the strip's ends there is nothing below it.
            let under = (z - a.z) * dx < (x - a.x) * dz && (-0.5..=0.5).contains(&x);
            nearest = (from, if under { -1.0 } else { 1.0 }, a.width + t * (b.width - a.width));
        }
    }
    (nearest.1 * nearest.0.sqrt(), y.abs() - nearest.2 / 2.0)
}
