//! A box whose edges are bevelled, by 2 to 5 mm.

use super::mesh::Mesh;
use rand::{Rng, RngExt};

/// A box of this size with all edges and corners cut off.
pub(super) fn bevelled(size: [f64; 3], random: &mut impl Rng) -> Mesh {
    let bevel = random.random_range(0.002..0.005);
    let mut mesh = Mesh::default();
    // For every corner a point on each of the three faces that meet there.
    let corners: Vec<[u32; 3]> = (0..8_u32)
        .map(|corner| {
            let side = |axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
            [0, 1, 2].map(|face| {
                mesh.point(
                    [0, 1, 2].map(|axis| side(axis) * (size[axis] / 2.0 - if axis == face { 0.0 } else { bevel })),
                )
            })
        })
        .collect();
    for face in 0..3 {
        let (u, v) = ((face + 1) % 3, (face + 2) % 3);
        for side in [0, 1 << face] {
            let at = |corner: usize| corners[side | corner][face];
            mesh.quad([at(0), at(1 << u), at(1 << u | 1 << v), at(1 << v)]);
        }
        // The edges along this axis, between the other two faces.
        for corner in [0, 1 << u, 1 << v, 1 << u | 1 << v] {
            let (near, far) = (corners[corner], corners[corner | 1 << face]);
            mesh.quad([near[u], far[u], far[v], near[v]]);
        }
    }
    corners.into_iter().for_each(|corner| mesh.triangle(corner));
    mesh
}
