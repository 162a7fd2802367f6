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
