//! Spheres that hold a shape: every point of it lies in one of them.
//!
//! A sphere stays itself. A round column is cut into slices, a box into cells; each piece gets its circumscribed sphere, so the
//! cover is complete by construction, and as tight as the pieces are small.

use crate::geometry::{Body, Geometry};

/// How far the spheres may stand out of a shape, as a part of its least extent.
const OVERSHOOT: f64 = 0.25;

/// Pieces along one edge at the most.
const MAX_PIECES: usize = 16;

/// A sphere in a link's frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub centre: [f64; 3],
    /// Radius.
    pub radius: f64,
}

/// Spheres, in the link's frame, that hold a body.
pub fn cover(body: &Body) -> Vec<Sphere> {
    let local = match body.geometry {
        Geometry::Sphere { radius } => vec![Sphere { centre: [0.0; 3], radius }],
        Geometry::Box { half } => cells(half),
        Geometry::Capsule { radius, half_length } => column(radius, half_length, 2),
        Geometry::Cylinder { radius, half_length } => {
            if half_length < radius * OVERSHOOT {
                cells([radius, half_length, radius])
            } else {
                column(radius, half_length, 1)
            }
        }
    };
    local.into_iter().map(|s| Sphere { centre: body.pose.transform(s.centre), ..s }).collect()
}

/// Slices of a round column along the axis with this index; a cylinder's is parry's, y.
fn column(radius: f64, half_length: f64, axis: usize) -> Vec<Sphere> {
    // A slice of half height h stands out by sqrt(r² + h²) - r.
    let reach = radius * ((1.0 + OVERSHOOT).powi(2) - 1.0).sqrt();
    let pieces = pieces(half_length, reach);
    let half = half_length / pieces as f64;
    (0..pieces)
        .map(|i| {
            let mut centre = [0.0; 3];
            centre[axis] = -half_length + half * (2 * i + 1) as f64;
            // A capsule's caps are held because its last centres are at most `half` away from theirs.
            let radius = if axis == 2 { radius + half } else { radius.hypot(half) };
            Sphere { centre, radius }
        })
        .collect()
}

fn cells(half: [f64; 3]) -> Vec<Sphere> {
    let least = half.into_iter().fold(f64::INFINITY, f64::min);
    let wanted = (least * (1.0 + OVERSHOOT)).max(half.into_iter().fold(0.0, f64::max) / MAX_PIECES as f64);
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
