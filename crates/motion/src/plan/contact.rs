//! What may touch what on the straight parts next to start and goal.

use crate::robot::Robot;
use ratn_world::scene::{Placement, Scene, SceneObject};

/// Error of the measured poses of objects, in metres. The fingers keep this distance from what they need not touch, if there is a way.
const MEASURED_WITHIN_M: f64 = 0.002;

/// Number of steps from touching to the deepest penetration allowed; of the ways to a goal those with the smallest penetration are used.
const PRESS_STEPS: u32 = 4;

/// Allowed penetrations of the fingers and what they hold at a goal, in metres, in the order in which they are tried; negative: a
/// distance to keep. The greatest is half a finger's thickness at its pad: a finger that comes down beside an edge pushes it aside, and one that comes down
/// with more than half of its thickness on it stands on it.
pub(super) fn presses_m(robot: &Robot) -> Vec<f64> {
    let steps =
        (0..=PRESS_STEPS).map(|step| f64::from(step) / f64::from(PRESS_STEPS) * robot.finger_thickness_m() / 2.0);
    std::iter::once(-MEASURED_WITHIN_M).chain(steps).collect()
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::description::RobotDescription;

    #[test]
    fn a_finger_presses_as_deep_as_its_pad_is_thick_whatever_is_above_the_pad() {
        let read = |ending: &str| {
            std::fs::read_to_string(format!("{}/robots/aimm.{ending}", env!("CARGO_MANIFEST_DIR"))).unwrap()
        };
        let jaw = "<collision><origin xyz='0 0.03 0.005'/><geometry><box size='0.025 0.06 0.01'/></geometry></collision></link>";
        let (before, after) = ("<link name=\"finger_left\">", "</link>");
        let urdf = read("urdf");
        let (head, rest) = urdf.split_once(before).unwrap();
        let (finger, rest) = rest.split_once(after).unwrap();
        let urdf = format!("{head}{before}{finger}{jaw}{rest}");
        let description = RobotDescription::read(&read("toml")).unwrap();
        let robot = Robot::of(description, &urdf, Some(&read("srdf")), &mut |_| unreachable!()).unwrap();
        assert_eq!(robot.finger_parts().len(), Robot::aimm().finger_parts().len() + 1);
        assert_eq!(presses_m(&robot), presses_m(&Robot::aimm()));
        assert_eq!(presses_m(&robot).last(), Some(&0.007));
    }
}
