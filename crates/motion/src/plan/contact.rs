//! What may touch what on the straight parts next to start and goal.

use crate::robot::Robot;
use ratn_world::scene::{Placement, Scene, SceneObject};

/// Error of the measured poses of objects, in metres. The fingers keep this distance from what they need not touch, if there is a way.
const MEASURED_WITHIN_M: f64 = 0.002;

/// Number of steps from touching to the deepest penetration allowed; of the ways to a goal those with the smallest penetration are used.
const PRESS_STEPS: u32 = 4;

/// Allowed penetrations of the fingers and what they hold at a goal, in metres, in the order in which they are tried; negative: a
/// distance to keep. The greatest is half a finger's thickness: a finger that comes down beside an edge pushes it aside, and one that comes down
/// with more than half of its thickness on it stands on it.
pub(super) fn presses_m(robot: &Robot) -> Vec<f64> {
    let steps = (0..=PRESS_STEPS).map(|step| f64::from(step) / f64::from(PRESS_STEPS) * half_finger_m(robot));
    std::iter::once(-MEASURED_WITHIN_M).chain(steps).collect()
}

/// Half of a finger's thickness along its closing direction, in metres; 0 for a robot without fingers.
fn half_finger_m(robot: &Robot) -> f64 {
    robot.finger_parts().iter().map(|part| part.half[1]).fold(0.0, f64::max)
}

/// The scene in which the tool leaves a goal where it releases what it holds: fingers that open there may press a neighbour, too. `None` if it
/// holds nothing.
pub(super) fn let_go(scene: &Scene) -> Option<Scene> {
    let is_held = |object: &SceneObject| matches!(object.placement, Placement::Gripper(_));
    if !scene.objects.iter().any(is_held) {
        return None;
    }
    let left = scene.objects.iter().filter(|object| !is_held(object)).cloned().collect();
    Some(Scene { objects: left, ..scene.clone() })
}
