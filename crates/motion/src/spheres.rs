//! Spheres that cover a shape: every point of it is in one of them.
//!
//! A sphere covers itself. A cylinder or capsule is cut into slices, a box into cells; each piece gets the sphere around it, so the cover is complete
//! by construction, and the smaller the pieces, the tighter it is.

use crate::geometry::{Body, Geometry};

/// How far the spheres may stand out of a shape, as a share of its minimum extent.
const OVERSHOOT: f64 = 0.25;

/// Maximum number of pieces along one edge.
const MAX_PIECES: usize = 16;

/// A sphere in a link's frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub centre: [f64; 3],
    /// Radius.
    pub radius: f64,
}

/// Spheres, in the link's frame, that cover a body.
pub fn cover(body: &Body) -> Vec<Sphere> {
    let least = match body.geometry {
        Geometry::Box { half } => return placed(body, cells(half, least(half) * (1.0 + OVERSHOOT))),
        Geometry::Cylinder { radius, half_length } if half_length < radius * OVERSHOOT => {
            let half = [radius, half_length, radius];
            return placed(body, cells(half, least(half) * (1.0 + OVERSHOOT)));
        }
        Geometry::Sphere { radius } | Geometry::Capsule { radius, .. } | Geometry::Cylinder { radius, .. } => radius,
    };
    cover_within(body, least * OVERSHOOT)
}

/// As [`cover`], standing out of the body by at most `overhang_m` metres, unless that takes too many pieces; at the ends of a cylinder the spheres
/// stand out further.
pub fn cover_within(body: &Body, overhang_m: f64) -> Vec<Sphere> {
    // A cube of half edge h stands out by (√3 - 1) h.
    let cell = overhang_m / (3_f64.sqrt() - 1.0);
    let local = match body.geometry {
        Geometry::Sphere { radius } => vec![Sphere { centre: [0.0; 3], radius }],
        Geometry::Box { half } => cells(half, cell),
        Geometry::Capsule { radius, half_length } => beads(radius, half_length, overhang_m),
        Geometry::Cylinder { radius, half_length } if half_length < radius * OVERSHOOT => {
            cells([radius, half_length, radius], cell)
        }
        Geometry::Cylinder { radius, half_length } => slices(radius, half_length, overhang_m),
    };
    placed(body, local)
}

fn placed(body: &Body, local: Vec<Sphere>) -> Vec<Sphere> {
    local.into_iter().map(|s| Sphere { centre: body.pose.transform(s.centre), ..s }).collect()
}

fn least(half: [f64; 3]) -> f64 {
    half.into_iter().fold(f64::INFINITY, f64::min)
}

/// Half the height of a slice of a cylinder whose sphere stands out by `overhang`.
fn slice(radius: f64, overhang: f64) -> f64 {
    ((radius + overhang).powi(2) - radius.powi(2)).sqrt()
}

/// A capsule along z: spheres from the centre of one end to that of the other.
fn beads(radius: f64, half_length: f64, overhang: f64) -> Vec<Sphere> {
    let pieces = pieces(half_length, slice(radius, overhang));
    let half = half_length / pieces as f64;
    let at = |i: usize| -half_length + half * (2 * i) as f64;
    (0..=pieces).map(|i| Sphere { centre: [0.0, 0.0, at(i)], radius: radius.hypot(half) }).collect()
}

/// A cylinder along y, as in parry.
fn slices(radius: f64, half_length: f64, overhang: f64) -> Vec<Sphere> {
    let pieces = pieces(half_length, slice(radius, overhang));
    let half = half_length / pieces as f64;
    let at = |i: usize| -half_length + half * (2 * i + 1) as f64;
    (0..pieces).map(|i| Sphere { centre: [0.0, at(i), 0.0], radius: radius.hypot(half) }).collect()
}

fn cells(half: [f64; 3], wanted: f64) -> Vec<Sphere> {
    let wanted = wanted.max(half.into_iter().fold(0.0, f64::max) / MAX_PIECES as f64);
    let counts = half.map(|h| pieces(h, wanted));
    let cell: [f64; 3] = std::array::from_fn(|i| half[i] / counts[i] as f64);
    let radius = cell.iter().map(|c| c * c).sum::<f64>().sqrt();
    let mut spheres = Vec::new();
    for x in 0..counts[0] {
        for y in 0..counts[1] {
            for z in 0..counts[2] {
                let at = [x, y, z];
                let centre = std::array::from_fn(|i| -half[i] + cell[i] * (2 * at[i] + 1) as f64);
                spheres.push(Sphere { centre, radius });
            }
        }
    }
    spheres
}

fn pieces(half: f64, reach: f64) -> usize {
    ((half / reach).ceil() as usize).clamp(1, MAX_PIECES)
}
