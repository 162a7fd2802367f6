//! Grasps from above with a parallel gripper, as poses of its tool frame, in the frame of the objects' poses.
//!
//! Assumptions about the gripper: its tool frame is between the fingertips, which reach [`FINGERTIP_M`] beyond it; z points out of the
//! gripper, y is the direction in which the fingers close. Objects stand upright: of a pose's rotation only the yaw is used.

use crate::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Depth of the tool frame's origin below an object's top in a grasp from above, in metres. At most half the height of the object; and
/// never so deep that the fingertips touch the surface below it.
pub const GRASP_DEPTH_M: f64 = 0.03;

/// Length of the fingertips beyond the tool frame's origin, in metres.
pub const FINGERTIP_M: f64 = 0.015;

/// Clearance of the fingertips above the surface below an object, in metres.
const CLEARANCE_M: f64 = 0.002;

/// Depth of the fingertips below the rim, and distance of their middle from the edge, in metres; the distance is needed because walls
/// lean.
const RIM_DEPTH_M: f64 = 0.02;
const RIM_INSET_M: f64 = 0.005;

/// Number of rotations of the fingers around a round object within half a turn; after half a turn the grasp repeats.
const TURNS: u32 = 8;

/// Number of grasp positions around a rim.
const AROUND: u32 = 16;

/// The two grasps of a box from above, half a turn apart: the fingers close across its shorter horizontal edge. `centre` is the middle
/// of its bounding box, `size` are the edges of the bounding box in metres.
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

/// Grasps from above of a round object that is narrower than the opened fingers: they close around it from any side. Arguments as in
/// [`from_above`].
pub fn around(centre: &Pose, size: [f64; 3]) -> Vec<Pose> {
    let turned = |i: u32| Pose::from_rpy([0.0; 3], 0.0, 0.0, PI * f64::from(i) / f64::from(TURNS));
    (0..TURNS).flat_map(|i| from_above(&centre.compose(&turned(i)), size)).collect()
}

/// Grasps of a round, open object by its rim, at every position around it and with either finger inside. Arguments as in
/// [`from_above`].
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
