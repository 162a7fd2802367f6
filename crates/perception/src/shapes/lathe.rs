//! Shapes of a lathe or a potter's wheel: an outline revolved about the upright axis.

use super::mesh::Mesh;
use std::f64::consts::TAU;

/// Distance from the axis and height above the table, in metres.
pub(super) type Point = [f64; 2];

/// Number of corners around the axis: at 13 cm of radius a chord is 0.1 mm within the circle.
const AROUND: u32 = 72;

/// Revolves the outline, from the axis at the bottom around the rim to the axis above, with the middle of its height at 0. Points
/// on the axis are moved slightly away from it, so that every ring has an extent.
pub(super) fn turned(outline: &[Point], height: f64) -> Mesh {
    let mut mesh = Mesh::default();
    let rings: Vec<Vec<u32>> = outline
        .iter()
        .map(|[r, z]| {
            (0..AROUND)
                .map(|corner| {
                    let (sin, cos) = (TAU * f64::from(corner) / f64::from(AROUND)).sin_cos();
                    let r = r.max(1e-5);
                    mesh.point([r * cos, r * sin, z - height / 2.0])
                })
                .collect()
        })
        .collect();
    mesh.skin(&rings);
    mesh
}

/// A lip of this thickness in metres that ends at `top`: a half circle from the outer side to the inner one.
pub(super) fn lip(top: Point, thickness: f64) -> impl Iterator<Item = Point> {
    let half = thickness / 2.0;
    (1..6).map(move |i| {
        let (sin, cos) = (f64::from(i) * TAU / 12.0).sin_cos();
        [top[0] - half + half * cos, top[1] - half + half * sin]
    })
}
