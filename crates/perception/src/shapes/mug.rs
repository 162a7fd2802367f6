//! A cup: a tapering wall with a rounded lip on a ring, usually with a handle.

use super::lathe::{Point, lip, turned};
use super::mesh::Mesh;
use rand::{Rng, RngExt};
use std::f64::consts::{PI, TAU};

/// Numbers of segments: along the wall's height, along the handle's bow, and around its cross
/// section.
const RISE: i32 = 8;
const BOW: i32 = 12;
const AROUND: i32 = 8;

/// A cup with this radius at the rim.
pub(super) fn mug(radius: f64, height: f64, has_handle: bool, random: &mut impl Rng) -> Mesh {
    let foot = radius * if has_handle { random.random_range(0.72..0.96) } else { random.random_range(0.84..0.95) };
    // How far the wall bulges at half its height.
    let bulge = random.random_range(0.0..0.025) * radius;
    let wall = random.random_range(0.003..0.005);
    let side = |part: f64| foot + (radius - foot) * part + bulge * (PI * part).sin();
    let widest = (0..=RISE).map(|i| side(f64::from(i) / f64::from(RISE))).fold(0.0, f64::max);
    let side = |part: f64| side(part) * radius / widest;
    let at = |part: f64| -> Point { [side(part), 0.002 + part * (height - 0.002 - wall / 2.0)] };
    let parts = || (0..=RISE).map(|i| f64::from(i) / f64::from(RISE));
    let mut outline: Vec<Point> =
        vec![[0.0, 0.003], [side(0.0) - 0.006, 0.003], [side(0.0) - 0.005, 0.0], [side(0.0) - 0.001, 0.0]];
    outline.extend(parts().map(at));
    outline.extend(lip([side(1.0), height], wall));
    let floor = 0.003 + wall;
    outline.extend(parts().rev().map(at).map(|[r, z]| [r - wall, z.max(floor)]));
    outline.push([0.0, floor]);
    let mut mesh = turned(&outline, height);
    if has_handle {
        let reach = random.random_range(0.018..super::HANDLE_M - 0.006);
        let (low, high) = (random.random_range(0.2..0.35), random.random_range(0.72..0.88));
        let thick = random.random_range(0.003..0.005);
        let turn = random.random_range(0.0..TAU);
        let way = |bow: f64| -> Point {
            // From the upper end to the lower one; both ends are inside the wall.
            let part = (high + low) / 2.0 + (high - low) / 2.0 * (PI * bow).cos();
            [side(part) - wall / 2.0 + reach * (PI * bow).sin().powf(0.8), part * height]
        };
        handle(&mut mesh, way, thick, turn, height);
    }
    mesh
}

/// A tube with an oval cross section along a path in an upright plane, turned about the axis.
fn handle(mesh: &mut Mesh, way: impl Fn(f64) -> Point, thick: f64, turn: f64, height: f64) {
    let (sin, cos) = turn.sin_cos();
    let rings: Vec<Vec<u32>> = (0..=BOW)
        .map(|i| {
            let bow = f64::from(i) / f64::from(BOW);
            let ([r, z], [r0, z0], [r1, z1]) = (way(bow), way((bow - 0.02).max(0.0)), way((bow + 0.02).min(1.0)));
            let (dr, dz) = (r1 - r0, z1 - z0);
            let long = dr.hypot(dz);
            (0..AROUND)
                .map(|corner| {
                    let (s, c) = (TAU * f64::from(corner) / f64::from(AROUND)).sin_cos();
                    let (out, beside) = (thick * c, 1.5 * thick * s);
                    let (r, z) = (r + out * dz / -long, z + out * dr / long);
                    mesh.point([r * cos - beside * sin, r * sin + beside * cos, z - height / 2.0])
                })
                .collect()
        })
        .collect();
    mesh.skin(&rings);
}
