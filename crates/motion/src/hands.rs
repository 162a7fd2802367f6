//! Objects in the hands of a robot with several arms: for planning one arm, and for driving the base.

use crate::robot::{Robot, RobotFault};
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};

/// The scene without [`Placement::Hand`], for planning one arm: objects that this arm holds move with it, and objects that another arm holds are
/// placed where that arm stands.
///
/// # Errors
/// [`RobotFault::NoArm`] if an object is in the hand of an arm that the robot does not have.
pub fn seen_from(robot: &Robot, scene: Scene) -> Result<Scene, RobotFault> {
    let standing = robot.at_zero().with_base(&scene.base);
    with_others(robot, scene, |tool, _, pose| Placement::World(robot.poses(&standing)[tool].compose(&pose)))
}

/// The scene for driving the base: objects that any arm holds move along. [`Placement::Hand`] remains for those that another arm than the planned one holds.
///
/// # Errors
/// As [`seen_from`].
pub fn carried_by(robot: &Robot, scene: Scene) -> Result<Scene, RobotFault> {
    with_others(robot, scene, |_, arm, pose| Placement::Hand { arm, pose })
}

/// Objects of the planned arm are placed in its gripper; those of another arm by `placed`, from its tool link, its name and the pose.
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

/// The link that holds an object, and the object's pose in its frame; `None` if it is in no hand of this robot.
pub(crate) fn holder(robot: &Robot, placement: &Placement) -> Option<(usize, Pose)> {
    match placement {
        Placement::World(_) => None,
        Placement::Gripper(pose) => Some((robot.tool, *pose)),
        Placement::Hand { arm, pose } => Some((robot.with_arm(arm).ok()?.tool, *pose)),
    }
}
