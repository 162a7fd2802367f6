//! How a parallel gripper takes things from above, as poses of its tool frame in the frame of the things' poses.
//!
//! One thing is known about the gripper: its tool frame sits between the fingertips, which reach [`FINGERTIP_M`] beyond it; z points
//! out of the gripper, y is the direction in which the fingers close. What stands there stands upright: yaw is all that is asked of a
//! pose's rotation.

use crate::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// How far below an object's top the tool frame's origin goes in a grasp from above, in metres; half the height of something lower than
/// twice that, but never so low that the fingertips touch what it stands on.
pub const GRASP_DEPTH_M: f64 = 0.03;

/// How far the fingers reach beyond the tool frame's origin, in metres.
pub const FINGERTIP_M: f64 = 0.015;

/// How far the fingertips stay above what an object stands on, in metres.
const CLEARANCE_M: f64 = 0.002;

/// How far below its rim the fingertips take something, and how far from the edge their middle is, in metres: walls lean.
const RIM_DEPTH_M: f64 = 0.02;
const RIM_INSET_M: f64 = 0.005;

/// Ways to turn the fingers around something round, in half a turn; after that they are the same fingers.
const TURNS: u32 = 8;

/// Places around a rim.
const AROUND: u32 = 16;

/// The two ways to take something from above, half a turn apart: the fingers close across its shorter horizontal edge. `centre` is the
/// middle of its bounding box, `size` that one's edges in metres.
pub fn from_above(centre: &Pose, size: [f64; 3]) -> [Pose; 2] {
    let [x, y, z] = size;
    // Turned upside down (roll π), the tool's y axis points along -y of the object; a quarter turn puts it along x.
    let across = if x <= y { FRAC_PI_2 } else { 0.0 };
    let lowest = FINGERTIP_M + CLEARANCE_M - z / 2.0;
    let height = (z / 2.0 - GRASP_DEPTH_M.min(z / 2.0)).max(lowest);
    let [at_x, at_y, at_z] = centre.position;
    let turned = |by: f64| Pose::from_rpy([at_x, at_y, at_z + height], PI, 0.0, yaw(centre) + across + by);
    [turned(0.0), turned(PI)]
}

/// The ways to take something round from above that is narrower than the fingers open: they close around it from any side. As
/// [`from_above`].
pub fn around(centre: &Pose, size: [f64; 3]) -> Vec<Pose> {
    let turned = |i: u32| Pose::from_rpy([0.0; 3], 0.0, 0.0, PI * f64::from(i) / f64::from(TURNS));
    (0..TURNS).flat_map(|i| from_above(&centre.compose(&turned(i)), size)).collect()
}

/// The ways to take something round and open by its rim, all around it and each with either finger inside. As [`from_above`].
pub fn at_rim(centre: &Pose, size: [f64; 3]) -> Vec<Pose> {
    let [width, _, height] = size;
    let radius = width / 2.0 - RIM_INSET_M;
    let [x, y, z] = centre.position;
    let z = z + height / 2.0 - RIM_DEPTH_M + FINGERTIP_M;
    let place = |i: u32| {
        let around = yaw(centre) + TAU * f64::from(i) / f64::from(AROUND);
        let (sin, cos) = around.sin_cos();
        [FRAC_PI_2, -FRAC_PI_2]
            .map(|turn| Pose::from_rpy([x + radius * cos, y + radius * sin, z], PI, 0.0, around + turn))
    };
    (0..AROUND).flat_map(place).collect()
}

fn yaw(pose: &Pose) -> f64 {
    let ahead = pose.rotate([1.0, 0.0, 0.0]);
    ahead[1].atan2(ahead[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: [f64; 3], b: [f64; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn a_low_object_is_taken_with_the_fingertips_just_above_what_it_stands_on() {
        for grasp in from_above(&Pose::at(0.7, 0.1, 0.75), [0.05, 0.2, 0.02]) {
            let tip = grasp.transform([0.0, 0.0, FINGERTIP_M]);
            assert!(close(tip, [0.7, 0.1, 0.74 + CLEARANCE_M]), "{tip:?}");
        }
    }

    #[test]
    fn a_cup_is_taken_with_the_fingers_beside_it_from_every_side() {
        let centre = Pose::from_rpy([0.7, 0.1, 0.75], 0.0, 0.0, 0.3);
        let grasps = around(&centre, [0.07, 0.07, 0.09]);
        assert_eq!(grasps.len(), 2 * TURNS as usize);
        for (i, grasp) in grasps.iter().enumerate() {
            assert!(close(grasp.position, [0.7, 0.1, 0.765]) && close(grasp.rotate([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0]));
            assert!(grasps[..i].iter().all(|other| other.angle(grasp) > 0.3));
        }
    }

    #[test]
    fn a_rim_is_taken_from_above_with_one_finger_inside_and_one_outside() {
        let centre = Pose::from_rpy([0.7, 0.1, 0.75], 0.0, 0.0, 0.3);
        let grasps = at_rim(&centre, [0.13, 0.13, 0.05]);
        assert_eq!(grasps.len(), 2 * AROUND as usize);
        for grasp in grasps {
            assert!(close(grasp.rotate([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0]));
            let off = [grasp.position[0] - 0.7, grasp.position[1] - 0.1];
            assert!((off[0].hypot(off[1]) - 0.06).abs() < 1e-9);
            let closing = grasp.rotate([0.0, 1.0, 0.0]);
            let radial = (closing[0] * off[0] + closing[1] * off[1]) / 0.06;
            assert!((radial.abs() - 1.0).abs() < 1e-9, "{closing:?} {off:?}");
            assert!((grasp.position[2] + 0.005 - 0.775).abs() < 1e-9);
        }
    }
}
