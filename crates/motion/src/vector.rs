//! Vectors in doubles, and how poses act on them. [`Pose`] itself stores arrays, because it is part of the file formats.

use crate::frame;
use ratn_model::pose::Pose;

/// A point in metres, or a direction.
pub(crate) type Vector = glam::DVec3;

/// The position of a pose.
pub(crate) fn position(pose: &Pose) -> Vector {
    pose.position.into()
}

/// The vector rotated by the rotation of a pose.
#[inline]
pub(crate) fn rotate(pose: &Pose, vector: impl Into<[f64; 3]>) -> Vector {
    frame::rotate(pose, vector.into()).into()
}

/// The point mapped from the frame of a pose into its reference frame.
pub(crate) fn transform(pose: &Pose, point: Vector) -> Vector {
    rotate(pose, point) + position(pose)
}

/// The direction of a vector, of length 1; zero for the zero vector.
pub(crate) fn unit(vector: Vector) -> Vector {
    vector.normalize_or_zero()
}
