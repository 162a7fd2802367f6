//! A rigid pose in three dimensions.

use serde::{Deserialize, Serialize};

/// Position in metres and unit quaternion, of a frame as seen from its reference (the world, unless said otherwise).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// x, y, z in metres.
    pub position: [f64; 3],
    /// x, y, z, w; of length one.
    pub quaternion_xyzw: [f64; 4],
}

impl Pose {
    /// No translation, no rotation.
    pub const IDENTITY: Pose = Pose { position: [0.0; 3], quaternion_xyzw: [0.0, 0.0, 0.0, 1.0] };

    /// A translation without rotation.
    pub fn at(x: f64, y: f64, z: f64) -> Pose {
        Pose { position: [x, y, z], ..Pose::IDENTITY }
    }

    /// A pose from roll, pitch and yaw in radians (rotations about the fixed x, then y, then z axis, as in URDF).
    pub fn from_rpy(position: [f64; 3], roll: f64, pitch: f64, yaw: f64) -> Pose {
        let (sr, cr) = (roll / 2.0).sin_cos();
        let (sp, cp) = (pitch / 2.0).sin_cos();
        let (sy, cy) = (yaw / 2.0).sin_cos();
        Pose {
            position,
            quaternion_xyzw: [
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ],
        }
    }

    /// Rotates a vector by this pose's rotation.
    pub fn rotate(&self, v: [f64; 3]) -> [f64; 3] {
        let [x, y, z, w] = self.quaternion_xyzw;
        let t = [2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0])];
        [
            v[0] + w * t[0] + y * t[2] - z * t[1],
            v[1] + w * t[1] + z * t[0] - x * t[2],
            v[2] + w * t[2] + x * t[1] - y * t[0],
        ]
    }

    /// Maps a point of this frame into the reference frame.
    pub fn transform(&self, point: [f64; 3]) -> [f64; 3] {
        let r = self.rotate(point);
        [r[0] + self.position[0], r[1] + self.position[1], r[2] + self.position[2]]
    }

    /// `self` followed by `next` as seen from `self` (matrix product of the two).
    pub fn compose(&self, next: &Pose) -> Pose {
        let [ax, ay, az, aw] = self.quaternion_xyzw;
        let [bx, by, bz, bw] = next.quaternion_xyzw;
        let q = [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ];
        Pose { position: self.transform(next.position), quaternion_xyzw: normalized(q) }
    }

    /// The pose of the reference as seen from this frame.
    pub fn inverse(&self) -> Pose {
        let [x, y, z, w] = self.quaternion_xyzw;
        let turned = Pose { position: [0.0; 3], quaternion_xyzw: [-x, -y, -z, w] };
        let p = turned.rotate(self.position);
        Pose { position: [-p[0], -p[1], -p[2]], ..turned }
    }

    /// Distance of the origins, in metres.
    pub fn distance(&self, other: &Pose) -> f64 {
        (0..3).map(|i| (self.position[i] - other.position[i]).powi(2)).sum::<f64>().sqrt()
    }

    /// The angle of the rotation between the two, in radians, 0 to π.
    pub fn angle(&self, other: &Pose) -> f64 {
        let dot: f64 = (0..4).map(|i| self.quaternion_xyzw[i] * other.quaternion_xyzw[i]).sum();
        2.0 * dot.abs().min(1.0).acos()
    }
}

fn normalized(q: [f64; 4]) -> [f64; 4] {
    let n = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if n > 0.0 { q.map(|c| c / n) } else { Pose::IDENTITY.quaternion_xyzw }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_followed_by_its_inverse_is_no_motion() {
        let pose = Pose::from_rpy([0.3, -0.2, 1.0], 0.4, -1.1, 2.5);
        let back = pose.compose(&pose.inverse());
        assert!(back.distance(&Pose::IDENTITY) < 1e-12 && back.angle(&Pose::IDENTITY) < 1e-7);
    }

    #[test]
    fn yaw_turns_x_towards_y() {
        let turned = Pose::from_rpy([0.0; 3], 0.0, 0.0, std::f64::consts::FRAC_PI_2).rotate([1.0, 0.0, 0.0]);
        assert!((turned[1] - 1.0).abs() < 1e-12);
    }
}
