//! What the hands of a robot with several arms hold, as the arm sees it that is planned for: what it holds itself moves with it, and what another
//! arm holds is where that arm stands.

use crate::robot::{Robot, RobotFault};
use ratn_world::scene::{Placement, Scene};

/// The scene without [`Placement::Hand`], as motions are planned in it. A scene that has none stays as it is.
///
/// # Errors
/// [`RobotFault::NoArm`] where something is in the hand of an arm that the robot does not have.
pub fn seen_from(robot: &Robot, mut scene: Scene) -> Result<Scene, RobotFault> {
    for object in &mut scene.objects {
        let Placement::Hand { arm, pose } = &object.placement else { continue };
        object.placement = if arm == robot.arm_name() {
            Placement::Gripper(*pose)
        } else {
            let tool = robot.with_arm(arm)?.tool;
            let standing = robot.at_zero().with_base(&scene.base);
            Placement::World(robot.poses(&standing)[tool].compose(pose))
        };
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::pose::Pose;
    use ratn_world::scene::{SceneObject, Shape};

    fn held_by(arm: &str) -> Scene {
        let placement = Placement::Hand { arm: arm.to_owned(), pose: Pose::at(0.0, 0.0, 0.02) };
        let held = SceneObject { name: "box_1".to_owned(), shape: Shape::Box { size: [0.05; 3] }, placement };
        Scene { base: Pose::IDENTITY, objects: vec![held] }
    }

    #[test]
    fn what_the_arm_holds_moves_with_it_and_what_another_one_holds_is_where_that_one_stands() {
        let twin = Robot::built_in("twin").unwrap();
        let placed = |robot: &Robot, by: &str| {
            let scene = seen_from(robot, held_by(by)).map_err(|fault| fault.to_string());
            scene.map(|scene| scene.objects[0].placement.clone())
        };
        let right = twin.with_arm("right").unwrap();
        for (robot, own, other) in [(&twin, "left", "right"), (&right, "right", "left")] {
            assert_eq!(placed(robot, own), Ok(Placement::Gripper(Pose::at(0.0, 0.0, 0.02))));
            // The other one is in its posture `home` unless it is said where it stands.
            let Ok(Placement::World(at_home)) = placed(robot, other) else { panic!("{:?}", placed(robot, other)) };
            let away = robot.clone().with_other_arm_at(other, &[0.5, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]).unwrap();
            let Ok(Placement::World(elsewhere)) = placed(&away, other) else { panic!("{:?}", placed(&away, other)) };
            let side = |pose: &Pose| pose.position[1] * if other == "left" { 1.0 } else { -1.0 };
            assert!(side(&at_home) > 0.3 && side(&elsewhere) > 0.3, "{at_home:?} {elsewhere:?}");
            assert!(at_home.distance(&elsewhere) > 0.1);
        }
        let fault = placed(&twin, "middle").unwrap_err();
        assert!(fault.contains("middle") && fault.contains("left, right"), "{fault}");
        let one_arm = Robot::built_in("panda").unwrap();
        assert_eq!(placed(&one_arm, "arm"), Ok(Placement::Gripper(Pose::at(0.0, 0.0, 0.02))));
    }
}
