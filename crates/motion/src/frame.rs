//! Composition of poses for the inner loops, without the normalisation that [`Pose::compose`] adds: for a chain of eleven links the loss of precision
//! is negligible.

use ratn_model::pose::Pose;

/// `a` followed by `b`, which is given in the frame of `a`.
#[inline]
pub(crate) fn compose(a: &Pose, b: &Pose) -> Pose {
    let [ax, ay, az, aw] = a.quaternion_xyzw;
    let [bx, by, bz, bw] = b.quaternion_xyzw;
    let moved = rotate(a, b.position);
    Pose {
        position: [a.position[0] + moved[0], a.position[1] + moved[1], a.position[2] + moved[2]],
        quaternion_xyzw: [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
    }
}

/// The vector rotated by the pose's rotation.
#[inline]
pub(crate) fn rotate(pose: &Pose, v: [f64; 3]) -> [f64; 3] {
    let [x, y, z, w] = pose.quaternion_xyzw;
    let t = cross([x, y, z], v).map(|c| 2.0 * c);
    let u = cross([x, y, z], t);
    [v[0] + w * t[0] + u[0], v[1] + w * t[1] + u[1], v[2] + w * t[2] + u[2]]
}

/// The cross product.
#[inline]
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a - b`
#[inline]
pub(crate) fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// The Euclidean length.
#[inline]
pub(crate) fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}
