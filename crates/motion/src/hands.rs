//! What the hands of a robot with several arms hold: as the arm sees it that is planned for, and as the base drives with it.

use crate::robot::{Robot, RobotFault};
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};

/// The scene without [`Placement::Hand`], as motions of one arm are planned in it: what the arm holds itself moves with it, and what another arm
/// holds is where that arm stands.
///
/// # Errors
/// [`RobotFault::NoArm`] where something is in the hand of an arm that the robot does not have.
pub fn seen_from(robot: &Robot, scene: Scene) -> Result<Scene, RobotFault> {
    let standing = robot.at_zero().with_base(&scene.base);
    with_others(robot, scene, |tool, _, pose| Placement::World(robot.poses(&standing)[tool].compose(&pose)))
}

/// The scene as the base drives in it: what any arm holds moves along. [`Placement::Hand`] is left for what another arm holds than the one that is
/// planned for.
///
/// # Errors
/// As [`seen_from`].
pub fn carried_by(robot: &Robot, scene: Scene) -> Result<Scene, RobotFault> {
    with_others(robot, scene, |_, arm, pose| Placement::Hand { arm, pose })
}

/// What the arm that is planned for holds is in its gripper; what another one holds is placed by the link of its tool, its name and the pose.
fn with_others(
    robot: &Robot,
    mut scene: Scene,
    placed: impl Fn(usize, String, Pose) -> Placement,
) -> Result<Scene, RobotFault> {
    for object in &mut scene.objects {
        let Placement::Hand { arm, pose } = &object.placement else { continue };
        object.placement = match arm == robot.arm_name() {
            true => Placement::Gripper(*pose),
            false => placed(robot.with_arm(arm)?.tool, arm.clone(), *pose),
        };
    }
    Ok(scene)
}

/// The link that something hangs on which is in a hand, and its pose there. `None`: it is in no hand of this robot.
pub(crate) fn holder(robot: &Robot, placement: &Placement) -> Option<(usize, Pose)> {
    match placement {
        Placement::World(_) => None,
        Placement::Gripper(pose) => Some((robot.tool, *pose)),
        Placement::Hand { arm, pose } => Some((robot.with_arm(arm).ok()?.tool, *pose)),
    }
}
