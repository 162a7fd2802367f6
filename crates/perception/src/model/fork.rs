//! A fork on a table: it touches the table with the end of its handle and the bow of its head; the neck and the tips stand up.
//!
//! A bent strip along x: nodes give its height and width, and everything scales with its length.

use super::form::{BOW, Form, GAPS, RISE};
use crate::vector::Vector;

/// A cross section of a fork of unit length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    /// Position along the fork, from -0.5 at the handle's end to 0.5 at the tips.
    pub(super) x: f64,
    /// Height of the strip's middle above the table.
    pub(super) z: f64,
    pub(super) width: f64,
}

/// For a table fork of 190 mm: 22 mm wide, its neck 17 mm above the table.
pub(super) const NODES: [Node; 6] = [
    Node { x: -0.50, z: 0.0085, width: 0.100 },
    Node { x: -0.15, z: 0.0480, width: 0.065 },
    Node { x: 0.14, z: 0.0840, width: 0.042 },
    Node { x: 0.25, z: 0.0620, width: 0.115 },
    Node { x: 0.36, z: 0.0240, width: 0.125 },
    Node { x: 0.50, z: 0.0640, width: 0.115 },
];

/// How much each node goes down with a lower bow.
const BENT: [f64; NODES.len()] = [0.0, 0.0, 0.0, 0.7, 1.0, 0.0];

/// The strip's thickness.
pub(super) const THICKNESS: f64 = 0.015;

/// Thickness below the strip that counts as closed for rays: hardly any ray gets there from above, and the edges of a strip of 3 mm
/// would not lie where the rays beside it say.
const UNDER: f64 = 0.05;
/// Part of a tine's pitch that is metal; the rest is the gap.
pub(super) const TINE: f64 = 0.62;
/// Number of tines, in the last part of the head.
pub(super) const TINES: usize = 4;

/// Its bounding box.
pub(super) fn size(length: f64) -> [f64; 3] {
    [length, 0.125 * length, (0.0840 + THICKNESS / 2.0) * length]
}

/// Signed distance from the strip's upper side, with everything under it inside: the camera sees it from above, and a point that
/// noise has put under a strip of 3 mm still pulls the strip down. Gaps between tines are ignored.
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

/// The strip in straight parts, for rays from above: of a fork of unit length in its frame, but with z = 0 at the table.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Strip {
    parts: [Part; NODES.len() - 1],
    /// Part of a tine's pitch that is metal, at its root and at its tip, where it is less.
    metal: [f64; 2],
}

/// A straight part of the strip: the middle of its cross section goes from `start` along `along`.
#[derive(Debug, Clone, Copy)]
struct Part {
    start: [f64; 2],
    along: [f64; 2],
    length: f64,
    /// Width at its start, and growth per unit of length.
    width: [f64; 2],
    /// Whether its start and its end are free ends.
    ends: [bool; 2],
}

impl Strip {
    /// The strip of a fork of this form.
    pub(crate) fn new(form: Form) -> Strip {
        let node = |i: usize| {
            let lower = form[BOW] * BENT[i];
            let z = (NODES[i].z * (1.0 + form[RISE]) - lower).max(THICKNESS / 2.0);
            Node { z, ..NODES[i] }
        };
        let parts = std::array::from_fn(|i| {
            let (a, b) = (node(i), node(i + 1));
            let (dx, dz) = (b.x - a.x, b.z - a.z);
            let length = dx.hypot(dz);
            Part {
                start: [a.x, a.z],
                along: [dx / length, dz / length],
                length,
                width: [a.width, (b.width - a.width) / length],
                ends: [i == 0, i + 2 == NODES.len()],
            }
        });
        Strip { parts, metal: [TINE - 0.5 * form[GAPS], TINE - 1.5 * form[GAPS]].map(|metal| metal.max(0.05)) }
    }

    /// The part of a pixel that sees the strip, 0 to 1, and the distance along its ray, in lengths of `way`. `pixel` is the width of
    /// a pixel; through the tines' gaps it sees as much as their sides leave open.
    pub(crate) fn met(&self, eye: Vector, way: Vector, pixel: f64) -> Option<(f64, f64)> {
        // The point of the ray at half the fork's height, and how far the ray moves while it passes all heights of the fork.
        let half = size(1.0)[2] / 2.0;
        let down = way[2].min(-1e-9);
        let at = (half - eye[2]) / down;
        let (x, y) = (eye[0] + at * way[0], eye[1] + at * way[1]);
        let (slack_x, slack_y) = (pixel + half * (way[0] / down).abs(), pixel + half * (way[1] / down).abs());
        if y.abs() > size(1.0)[1] / 2.0 + slack_y {
            return None;
        }
        let mut best: Option<(f64, f64)> = None;
        let near =
            |part: &&Part| x + slack_x >= part.start[0] && x - slack_x <= part.start[0] + part.along[0] * part.length;
        for part in self.parts.iter().filter(near) {
            if let Some((covered, at)) = part.met(eye, way, pixel, self.metal)
                && best.is_none_or(|(most, first)| covered > most || (covered == most && at < first))
            {
                best = Some((covered, at));
            }
        }
        best
    }
}

impl Part {
    fn met(&self, eye: Vector, way: Vector, pixel: f64, metal: [f64; 2]) -> Option<(f64, f64)> {
        let [ux, uz] = self.along;
        let (ex, ez) = (eye[0] - self.start[0], eye[2] - self.start[1]);
        let (off, fall) = (ux * ez - uz * ex, ux * way[2] - uz * way[0]);
        if fall > -1e-9 {
            return None;
        }
        // The ray enters through the upper side and leaves through the lower one.
        let [enters, leaves] = [THICKNESS / 2.0, -THICKNESS / 2.0].map(|side| (side - off) / fall);
        let [s, s_leaving] = [enters, leaves].map(|t| ux * (ex + t * way[0]) + uz * (ez + t * way[2]));
        let (low, high) = (s.min(s_leaving), s.max(s_leaving));
        let soft = |beyond: f64| (0.5 - beyond / pixel).clamp(0.0, 1.0);
        let within = |beyond: f64, is_end: bool| if is_end { soft(beyond) } else { f64::from(u8::from(beyond <= 0.0)) };
        let lengthwise = within(-high, self.ends[0]) * within(low - self.length, self.ends[1]);
        if lengthwise <= 0.0 {
            return None;
        }
        let width = self.width[0] + self.width[1] * s.clamp(0.0, self.length);
        let (y, y_leaving) = (eye[1] + enters * way[1], eye[1] + leaves * way[1]);
        let nearest = if y * y_leaving < 0.0 { 0.0 } else { y.abs().min(y_leaving.abs()) };
        let mut covered = lengthwise * soft(nearest - width / 2.0);
        if covered <= 0.0 {
            return None;
        }
        if self.ends[1] {
            let pitch = width / (TINES as f64 - 1.0 + TINE);
            let tine = metal[0] + (metal[1] - metal[0]) * (s / self.length).clamp(0.0, 1.0);
            covered *= (tine + (y - y_leaving).abs() / pitch).min(1.0);
        }
        // A ray that enters through a side or an end meets the strip later.
        let later = |outside: f64, way: f64| if outside > 0.0 { (outside / way.abs().max(1e-9)).min(1.0) } else { 0.0 };
        let aside = later(y.abs() - width / 2.0, y - y_leaving);
        let past = if self.ends[0] { -s } else { 0.0 }.max(if self.ends[1] { s - self.length } else { 0.0 });
        let beyond = later(past, s - s_leaving);
        Some((covered, enters + aside.max(beyond) * (leaves - enters)))
    }
}

/// For a fork of unit length: how far a point is above the strip's middle (negative below), and beside its edge.
fn offsets(length: f64, point: Vector) -> (f64, f64) {
    let [x, y, z] = point.map(|c| c / length);
    let z = z + size(1.0)[2] / 2.0;
    // The squared distance, its sign, and the width there.
    let mut nearest = (f64::INFINITY, 1.0, 0.0);
    for pair in NODES.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let (dx, dz) = (b.x - a.x, b.z - a.z);
        let along = ((x - a.x) * dx + (z - a.z) * dz) / (dx * dx + dz * dz);
        let t = along.clamp(0.0, 1.0);
        let from = (x - a.x - t * dx).powi(2) + (z - a.z - t * dz).powi(2);
        if from < nearest.0 {
            // Beyond the strip's ends nothing is below it.
            let under = (z - a.z) * dx < (x - a.x) * dz && (-0.5..=0.5).contains(&x);
            nearest = (from, if under { -1.0 } else { 1.0 }, a.width + t * (b.width - a.width));
        }
    }
    (nearest.1 * nearest.0.sqrt(), y.abs() - nearest.2 / 2.0)
}
