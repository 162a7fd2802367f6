//! A mesh under construction: points in metres, in double precision, and triangles of them.

use parry3d::math::Vector;
use parry3d::shape::SharedShape;

/// Points and triangles.
#[derive(Debug, Clone, Default)]
pub(super) struct Mesh {
    points: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Adds a point and returns its index.
    pub(super) fn point(&mut self, point: [f64; 3]) -> u32 {
        self.points.push(point);
        self.points.len() as u32 - 1
    }

    pub(super) fn triangle(&mut self, corners: [u32; 3]) {
        self.triangles.push(corners);
    }

    /// Adds a face with four corners, in order around it.
    pub(super) fn quad(&mut self, [a, b, c, d]: [u32; 4]) {
        self.triangles.extend([[a, b, c], [a, c, d]]);
    }

    /// Adds the skin over rings with the same number of points, from one ring to the next, each ring closed.
    pub(super) fn skin(&mut self, rings: &[Vec<u32>]) {
        for (near, far) in rings.iter().zip(rings.iter().skip(1)) {
            for i in 0..near.len() {
                let next = (i + 1) % near.len();
                self.quad([near[i], near[next], far[next], far[i]]);
            }
        }
    }

    /// Adds a flat end over a convex ring.
    pub(super) fn cap(&mut self, ring: &[u32]) {
        for i in 1..ring.len().saturating_sub(1) {
            self.triangle([ring[0], ring[i], ring[i + 1]]);
        }
    }

    /// Scales and shifts everything along each axis, so that the bounding box has this size and is centred.
    pub(super) fn fitted(mut self, size: [f64; 3]) -> Mesh {
        for (axis, edge) in size.into_iter().enumerate() {
            let along = self.points.iter().map(|p| p[axis]);
            let (low, high) =
                along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), c| (low.min(c), high.max(c)));
            for point in &mut self.points {
                point[axis] = ((point[axis] - low) / (high - low) - 0.5) * edge;
            }
        }
        self
    }

    /// The mesh as a shape for ray casting.
    #[expect(clippy::expect_used, reason = "every kind of mesh is made by a test, and all have triangles")]
    pub(super) fn shape(self) -> SharedShape {
        let points = self.points.into_iter().map(|p| Vector::from_array(p.map(|c| c as f32))).collect();
        SharedShape::trimesh(points, self.triangles).expect("a mesh has triangles")
    }
}
