//! Vectors in doubles, and how poses act on them. What is computed with is a vector. What is stored, sent or read from a file (poses, corners of
//! meshes, fields of requests) is an array: its form is part of formats.

use ratn_model::pose::Pose;

/// A point in metres, or a direction.
pub(crate) type Vector = glam::DVec3;

/// The position of a pose.
#[inline]
pub(crate) fn position(pose: &Pose) -> Vector {
    pose.position.into()
}

/// The vector rotated by the rotation of a pose.
#[inline]
pub(crate) fn rotate(pose: &Pose, vector: impl Into<[f64; 3]>) -> Vector {
    let ([x, y, z, w], v) = (pose.quaternion_xyzw, Vector::from(vector.into()));
    let axis = Vector::new(x, y, z);
    let t = 2.0 * axis.cross(v);
    v + w * t + axis.cross(t)
}

/// The point mapped from the frame of a pose into its reference frame.
pub(crate) fn transform(pose: &Pose, point: Vector) -> Vector {
    rotate(pose, point) + position(pose)
}

/// The direction of a vector, of length 1; zero for the zero vector.
pub(crate) fn unit(vector: Vector) -> Vector {
    vector.normalize_or_zero()
}
