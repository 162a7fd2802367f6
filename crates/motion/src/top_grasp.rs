//! How a box that stands upright is taken from above: where the tool is then, and from how far above it comes straight down.
//!
//! Nothing here is of one robot: the tool's z axis points the way the gripper reaches, and its fingers close along y.

use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// How far above the grasp a straight approach begins, and how far a straight departure goes, in metres.
pub const APPROACH_M: f64 = 0.10;

/// How far below a box's top the tool frame is when it grasps, in metres; half of the box's height if that is less.
pub const GRASP_DEPTH_M: f64 = 0.03;

/// The two ways to grasp an upright box from above: tool z down, y along the shorter horizontal edge; half a turn apart.
pub fn grasp_poses(pose: &Pose, size: [f64; 3]) -> [Pose; 2] {
    let edge = pose.rotate(if size[0] <= size[1] { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] });
    let yaw = edge[1].atan2(edge[0]) + FRAC_PI_2;
    let top = pose.position[2] + size[2] / 2.0;
    let position = [pose.position[0], pose.position[1], top - GRASP_DEPTH_M.min(size[2] / 2.0)];
    [Pose::from_rpy(position, PI, 0.0, yaw), Pose::from_rpy(position, PI, 0.0, yaw + PI)]
}
