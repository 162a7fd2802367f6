//! A shape as the exact checks see it: a closed shape is solid, and all points within its skin count as part of it.

use crate::distance;
use crate::geometry::Body;
use crate::inside::Inside;
use crate::mesh::{ConvexPiece, Mesh};
use parry3d::math::{Pose as Pose32, Vector};
use parry3d::shape::SharedShape;
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(crate) struct Solid {
    pub(crate) shape: SharedShape,
    /// Thickness of the skin in metres: what is nearer counts as touching.
    pub(crate) skin_m: f64,
    /// The inside of a mesh; other shapes are solid by themselves.
    pub(crate) inside: Option<Arc<Inside>>,
    /// The mesh, if its penetration counts as that of its convex pieces, too.
    deep: Option<Arc<Mesh>>,
}

/// A shape with its pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placed<'s> {
    pub(crate) pose: Pose32,
    pub(crate) solid: &'s Solid,
}

impl Solid {
    /// A primitive, padded on every side.
    pub(crate) fn primitive(body: &Body, padding_m: f64) -> Solid {
        Solid { shape: body.geometry.shape(padding_m), skin_m: 0.0, inside: None, deep: None }
    }

    /// A mesh, padded on every side.
    pub(crate) fn mesh(mesh: &Mesh, padding_m: f64) -> Solid {
        let (shape, inside) = mesh.solid();
        Solid { shape, skin_m: padding_m, inside: Some(inside), deep: None }
    }

    /// As [`Solid::mesh`], and as deep in a primitive as the mesh is in all, not only as its deepest triangle. The convex pieces of the mesh are
    /// computed when they are first needed, which takes long for a large mesh.
    pub(crate) fn pressing_mesh(mesh: &Arc<Mesh>, padding_m: f64) -> Solid {
        Solid { deep: Some(Arc::clone(mesh)), ..Solid::mesh(mesh, padding_m) }
    }
}

impl Placed<'_> {
    /// Whether two shapes touch or one is inside the other; a pair that cannot be decided counts as touching.
    pub(crate) fn touches(&self, other: &Placed<'_>) -> bool {
        self.gap(other, 0.0) <= 0.0 || self.enclosed_m(other).is_some()
    }

    /// Penetration of two shapes in metres, if they touch or one is inside the other.
    pub(crate) fn depth(&self, other: &Placed<'_>) -> Option<f64> {
        let apart = self.apart_m(other, 0.0);
        (apart <= 0.0).then_some(-apart)
    }

    /// Distance of two shapes in metres, or any value greater than `enough_m` if it is more than that. Negative: the penetration.
    pub(crate) fn apart_m(&self, other: &Placed<'_>, enough_m: f64) -> f64 {
        let gap = self.gap(other, enough_m);
        let skin_m = self.solid.skin_m + other.solid.skin_m;
        if gap > -skin_m {
            return match self.enclosed_m(other) {
                Some(deep) => gap.min(0.0) - deep,
                None => gap,
            };
        }
        let surface_m = distance::depth(&self.pose, &*self.solid.shape, &other.pose, &*other.solid.shape);
        -surface_m.max(self.pieces_deep_m(other)).max(other.pieces_deep_m(self)) - skin_m
    }

    /// Penetration of the convex pieces of this mesh in a primitive, in metres: that of the deepest piece, minus by how much the piece stands out of
    /// the mesh. 0 if the mesh does not count by its pieces, or the other shape is no primitive.
    fn pieces_deep_m(&self, other: &Placed<'_>) -> f64 {
        let pieces = self.solid.deep.iter().flat_map(|mesh| &mesh.pieces().hulls);
        let deep_m = |piece: &ConvexPiece| {
            let deep_m = distance::depth_of_piece(&self.pose, piece, &other.pose, &*other.solid.shape)?;
            Some(deep_m - piece.stands_out_m)
        };
        pieces.filter_map(deep_m).fold(0.0, f64::max)
    }

    /// Distance between the outer surfaces of the skins.
    fn gap(&self, other: &Placed<'_>, enough_m: f64) -> f64 {
        let skin_m = self.solid.skin_m + other.solid.skin_m;
        let (shape, its) = (&*self.solid.shape, &*other.solid.shape);
        distance::gap(&self.pose, shape, &other.pose, its, enough_m + skin_m).map_or(-skin_m, |gap| gap - skin_m)
    }

    /// Penetration if one shape is wholly inside the other.
    fn enclosed_m(&self, other: &Placed<'_>) -> Option<f64> {
        let meshes = self.solid.inside.is_some() || other.solid.inside.is_some();
        // The distance considers only the surface of a mesh.
        if meshes { self.depth_inside(other).or_else(|| other.depth_inside(self)) } else { None }
    }

    /// Penetration in another shape whose surface it does not touch: that of its deepest part, by one point of each part.
    fn depth_inside(&self, other: &Placed<'_>) -> Option<f64> {
        let centre = [[0.0; 3]];
        let points = self.solid.inside.as_ref().map_or(&centre[..], |inside| inside.corners());
        let deep = |point: &[f64; 3]| {
            let [x, y, z] = point.map(|c| c as f32);
            let at = other.pose.inverse_transform_point(self.pose.transform_point(Vector::new(x, y, z)));
            let is_inside = match &other.solid.inside {
                Some(inside) => inside.contains([at.x, at.y, at.z].map(f64::from)),
                None => other.solid.shape.contains_local_point(at),
            };
            let surface = || other.solid.shape.project_local_point(at, false).point;
            is_inside.then(|| f64::from((surface() - at).length()))
        };
        points.iter().filter_map(deep).reduce(f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use parry3d::shape::HalfSpace;

    #[test]
    fn a_pair_that_cannot_be_decided_touches() {
        let solid = |shape: SharedShape| Solid { shape, skin_m: 0.0, inside: None, deep: None };
        let floor = solid(SharedShape::new(HalfSpace::new(Vector::new(0.0, 0.0, 1.0))));
        let ball = solid(SharedShape::ball(0.1));
        let at = |solid, z: f32| Placed { pose: Pose32::from_translation(Vector::new(0.0, 0.0, z)), solid };
        // parry3d gives no answer for two half-spaces.
        assert!(at(&floor, 1.0).touches(&at(&floor, 0.0)));
        assert!(at(&ball, 0.05).touches(&at(&floor, 0.0)));
        assert!(!at(&ball, 0.2).touches(&at(&floor, 0.0)));
    }
}
