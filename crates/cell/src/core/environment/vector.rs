//! Vectors in doubles, for the judge: the physics engine's are `f32`.

/// A point or a direction.
pub(super) type Vector = glam::DVec3;

/// A shorter vector has no direction.
const SHORTEST: f64 = 1e-12;

/// The unit vector of a direction; `None` for a vector without length.
pub(super) fn direction(vector: Vector) -> Option<Vector> {
    let length = vector.length();
    (length > SHORTEST).then(|| vector / length)
}
