//! Composition of poses for the inner loops, without the normalisation that [`Pose::compose`] adds: for a chain of eleven links the loss of precision
//! is negligible.

use crate::vector::{position, rotate};
use ratn_model::pose::Pose;

/// `a` followed by `b`, which is given in the frame of `a`.
#[inline]
pub(crate) fn compose(a: &Pose, b: &Pose) -> Pose {
    let [ax, ay, az, aw] = a.quaternion_xyzw;
    let [bx, by, bz, bw] = b.quaternion_xyzw;
    Pose {
        position: (position(a) + rotate(a, b.position)).to_array(),
        quaternion_xyzw: [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
    }
}
