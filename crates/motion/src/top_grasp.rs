//! Top grasps of an upright box: the tool's pose, and the height from which it approaches straight down.
//!
//! This is the same for all robots: the tool's z axis points in the approach direction, and its fingers close along y.

use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// Height above the grasp at which a straight approach begins, and length of a straight departure, in metres.
pub const APPROACH_M: f64 = 0.10;

/// Depth of the tool frame below a box's top in the grasp, in metres; half of the box's height if that is less.
pub const GRASP_DEPTH_M: f64 = 0.03;

/// The two top grasps of an upright box: tool z down, y along the shorter horizontal edge; half a turn apart.
pub fn grasp_poses(pose: &Pose, size: [f64; 3]) -> [Pose; 2] {
    let edge = pose.rotate(if size[0] <= size[1] { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] });
    let yaw = edge[1].atan2(edge[0]) + FRAC_PI_2;
    let top = pose.position[2] + size[2] / 2.0;
    let position = [pose.position[0], pose.position[1], top - GRASP_DEPTH_M.min(size[2] / 2.0)];
    [Pose::from_rpy(position, PI, 0.0, yaw), Pose::from_rpy(position, PI, 0.0, yaw + PI)]
}
