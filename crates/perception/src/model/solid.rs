//! Models as parry shapes, for the ray caster.

use super::form::FORMS;
use super::{Model, fork, revolved};
use parry3d::math::Vector;
use parry3d::shape::SharedShape;
use std::f64::consts::TAU;

/// Number of corners around the axis: at 15 cm of radius a chord is 0.1 mm within the circle.
const CORNERS: u32 = 80;

impl Model {
    /// Its shape in its frame.
    pub fn solid(&self) -> SharedShape {
        match *self {
            Model::Box { size } => {
                let [x, y, z] = size.map(|edge| edge as f32 / 2.0);
                SharedShape::cuboid(x, y, z)
            }
            Model::Round { kind, radius, height } => {
                let of = revolved::Turned { kind, radius, height, form: [0.0; FORMS] };
                turned(&revolved::outline(&of), height / 2.0)
            }
            Model::Fork { length } => strip(length),
        }
    }
}

/// An outline revolved about the axis, lowered by `down`.
fn turned(outline: &[[f64; 2]], down: f64) -> SharedShape {
    let rows = outline.len() as u32;
    let mut vertices = Vec::with_capacity(outline.len() * CORNERS as usize);
    for corner in 0..CORNERS {
        let (sin, cos) = (TAU * f64::from(corner) / f64::from(CORNERS)).sin_cos();
        vertices
            .extend(outline.iter().map(|[r, z]| Vector::new((r * cos) as f32, (r * sin) as f32, (z - down) as f32)));
    }
    let mut triangles = Vec::new();
    for corner in 0..CORNERS {
        let next = (corner + 1) % CORNERS;
        for row in 0..rows - 1 {
            let [a, b, c, d] = [corner * rows + row, corner * rows + row + 1, next * rows + row + 1, next * rows + row];
            // On the axis one side of the quad is a point.
            if outline[row as usize][0] > 0.0 {
                triangles.push([a, b, d]);
            }
            if outline[row as usize + 1][0] > 0.0 {
                triangles.push([b, c, d]);
            }
        }
    }
    mesh(vertices, triangles)
}

#[expect(
    clippy::expect_used,
    reason = "the vertices and triangles are made here, and every class is rendered by a test"
)]
fn mesh(vertices: Vec<Vector>, triangles: Vec<[u32; 3]>) -> SharedShape {
    SharedShape::trimesh(vertices, triangles).expect("a solid has triangles")
}

/// The faces of a block whose corners are numbered by bits: 4 is ahead, 2 to the left, 1 above.
const BLOCK: [[u32; 4]; 6] = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

/// The fork: a block for each part of the strip, and one for each tine.
fn strip(length: f64) -> SharedShape {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    let down = fork::size(1.0)[2] / 2.0;
    for part in 0..fork::NODES.len() - 1 {
        let ends = [part, part + 1].map(|node| (fork::NODES[node], across(node)));
        let tines = if part + 2 == fork::NODES.len() { fork::TINES } else { 1 };
        for tine in 0..tines {
            // From -1 to 1 across the width.
            let span = |side: f64| {
                if tines == 1 {
                    return side;
                }
                let pitch = 2.0 / (tines as f64 - 1.0 + fork::TINE);
                -1.0 + pitch * (tine as f64 + fork::TINE * (side + 1.0) / 2.0)
            };
            let first = vertices.len() as u32;
            for (node, across) in ends {
                for side in [-1.0, 1.0] {
                    for face in [-1.0, 1.0] {
                        let y = span(side) * node.width / 2.0;
                        let corner = [node.x + face * across[0], y, node.z + face * across[1] - down];
                        let [x, y, z] = corner.map(|c| (c * length) as f32);
                        vertices.push(Vector::new(x, y, z));
                    }
                }
            }
            for side in BLOCK {
                let [a, b, c, d] = side.map(|corner| first + corner);
                triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    mesh(vertices, triangles)
}

/// The vector from the strip's middle to its upper side at a node, along x and z: where the sides of the adjacent
/// parts meet.
fn across(node: usize) -> [f64; 2] {
    let normal = |pair: &[fork::Node]| {
        let (dx, dz) = (pair[1].x - pair[0].x, pair[1].z - pair[0].z);
        [-dz, dx].map(|c| c / dx.hypot(dz))
    };
    let parts = fork::NODES.windows(2);
    let before = parts.clone().nth(node.saturating_sub(1)).map_or([0.0, 1.0], normal);
    let after = parts.clone().nth(node.min(parts.len() - 1)).map_or([0.0, 1.0], normal);
    let along = 1.0 + before[0] * after[0] + before[1] * after[1];
    [0, 1].map(|i| fork::THICKNESS / 2.0 * (before[i] + after[i]) / along)
}
