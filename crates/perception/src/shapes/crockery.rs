//! Bowls and plates: revolved shapes on a ring-shaped foot, each with its own curve.

use super::lathe::{Point, lip, turned};
use super::mesh::Mesh;
use rand::{Rng, RngExt};
use std::f64::consts::FRAC_PI_2;

/// Number of segments of a curve.
const CURVE: i32 = 12;

/// A bowl with this radius at the rim: from a foot up along a superellipse, some flared below the lip.
pub(super) fn bowl(radius: f64, height: f64, random: &mut impl Rng) -> Mesh {
    let foot = radius * random.random_range(0.40..0.55);
    let (ring, wall) = (random.random_range(0.002..0.005), random.random_range(0.003..0.006));
    let (out, up) = (random.random_range(0.85..1.2), random.random_range(0.85..1.1));
    let flare = random.random_range(-0.02..0.02_f64).max(0.0) * radius;
    let outer = |part: f64| -> Point {
        let (sin, cos) = (part * FRAC_PI_2).sin_cos();
        let lean = flare * (1.0 - part.powi(4));
        let rise = (1.0 - cos).powf(up);
        [foot + (radius - foot) * sin.powf(out) - lean * part, ring + (height - wall / 2.0 - ring) * rise]
    };
    shell(foot, outer, wall, [radius, height])
}

/// A plate with this radius: a flat well on a ring, a shoulder, and a rim that rises to the edge.
pub(super) fn plate(radius: f64, height: f64, random: &mut impl Rng) -> Mesh {
    let (well, shoulder) = (random.random_range(0.52..0.66), random.random_range(0.06..0.14));
    let (ring, wall) = (random.random_range(0.0015..0.003), random.random_range(0.003..0.0045));
    let rise = random.random_range(0.35..0.65);
    let outer = |part: f64| -> Point {
        let across = well + (1.0 - well) * part;
        let bend = ((across - well) / shoulder).min(1.0);
        // Smooth at the shoulder, then straight.
        let beyond = ((across - well - shoulder) / (1.0 - well - shoulder)).max(0.0);
        let up = rise * bend * bend * (3.0 - 2.0 * bend) + (1.0 - rise) * beyond;
        [radius * across, ring + (height - wall / 2.0 - ring) * up]
    };
    shell(radius * well, outer, wall, [radius, height])
}

/// A wall along a curve from the foot to the rim, with a ring below and the bottom inside.
fn shell(foot: f64, outer: impl Fn(f64) -> Point, wall: f64, rim: Point) -> Mesh {
    let curve: Vec<Point> = (0..=CURVE).map(|i| outer(f64::from(i) / f64::from(CURVE))).collect();
    let bottom = curve[0][1];
    let mut outline: Vec<Point> = vec![[0.0, bottom], [foot - 0.006, bottom], [foot - 0.005, 0.0], [foot - 0.001, 0.0]];
    outline.extend(&curve);
    outline.extend(lip(rim, wall));
    // The inner side is offset from the outer one by the wall's thickness.
    let inner = (0..curve.len()).rev().map(|i| {
        let (before, after) = (curve[i.saturating_sub(1)], curve[(i + 1).min(curve.len() - 1)]);
        let (dr, dz) = (after[0] - before[0], after[1] - before[1]);
        let long = dr.hypot(dz).max(1e-9);
        [curve[i][0] - wall * dz / long, (curve[i][1] + wall * dr / long).min(rim[1] - wall / 2.0)]
    });
    outline.extend(inner);
    outline.push([0.0, bottom + wall]);
    turned(&outline, rim[1])
}
