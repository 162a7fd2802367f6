//! Which arm of the robot moves, and the postures of the others: the optional inputs `arm` (its name; by default the only or first one) and
//! `other_arms` (joint positions by arm name; an arm that is omitted is in its posture `home`, else at zero). While the base drives, no arm
//! moves: the first arm is in the posture of the input `arm`.

use ratn_model::value::Value;
use ratn_motion::hands;
use ratn_motion::robot::{Robot, RobotFault};
use ratn_worker::action::{ActionFailure, GoalContext};
use ratn_world::scene::{Placement, Scene, SceneObject};
use std::sync::Arc;

/// Maximum number of held objects: the checks of every posture grow with their number, and those of held objects against each other with
/// its square.
const MOST_HELD: usize = 64;

/// The robot with the moving arm selected.
pub(super) fn moving(robot: &Arc<Robot>, goal: &GoalContext) -> Result<Arc<Robot>, ActionFailure> {
    let arm = goal.port("arm").optional().map(|port| port.string()).transpose()?;
    let others = goal.port("other_arms").optional();
    if others.is_none() && arm.is_none_or(|arm| arm == robot.arm_name()) {
        return Ok(Arc::clone(robot));
    }
    let seen = robot.with_arm(arm.unwrap_or(robot.arm_name())).map_err(|fault| wrong("arm", fault))?;
    Ok(Arc::new(with_others(seen, goal)?))
}

/// The robot with its other arms in their given postures.
pub(super) fn standing(robot: &Arc<Robot>, goal: &GoalContext) -> Result<Arc<Robot>, ActionFailure> {
    match goal.port("other_arms").optional() {
        None => Ok(Arc::clone(robot)),
        Some(_) => Ok(Arc::new(with_others(Robot::clone(robot), goal)?)),
    }
}

fn with_others(mut seen: Robot, goal: &GoalContext) -> Result<Robot, ActionFailure> {
    if let Some(others) = goal.port("other_arms").optional() {
        let Value::Map(postures) = others.any()? else {
            let found = others.any()?.type_name();
            return Err(ActionFailure::aborted(format!(
                "input `other_arms` has a {found}: expected joints by the names of arms"
            )));
        };
        for name in postures.keys() {
            let joints = others.field(name).joints()?;
            seen = seen.with_other_arm_at(name, joints).map_err(|fault| wrong("other_arms", fault))?;
        }
    }
    Ok(seen)
}

fn wrong(port: &str, fault: RobotFault) -> ActionFailure {
    ActionFailure::aborted(format!("input `{port}`: {fault}"))
}

/// The scene with the objects in the robot's hands: those of the moving arm move with it, those of the others stand still.
pub(super) fn in_hands(robot: &Robot, scene: Arc<Scene>) -> Result<Arc<Scene>, ActionFailure> {
    with_hands(robot, scene, hands::seen_from)
}

/// The same for a driving base: all held objects move along.
pub(super) fn carried(robot: &Robot, scene: Arc<Scene>) -> Result<Arc<Scene>, ActionFailure> {
    with_hands(robot, scene, hands::carried_by)
}

fn with_hands(
    robot: &Robot,
    scene: Arc<Scene>,
    seen: impl FnOnce(&Robot, Scene) -> Result<Scene, RobotFault>,
) -> Result<Arc<Scene>, ActionFailure> {
    let is_held = |object: &&SceneObject| matches!(object.placement, Placement::Gripper(_) | Placement::Hand { .. });
    let held = scene.objects.iter().filter(is_held).count();
    if held > MOST_HELD {
        let message = format!("by facts `in_gripper` {held} objects are held: at most {MOST_HELD} are planned with");
        return Err(ActionFailure::aborted(message));
    }
    if !scene.objects.iter().any(|object| matches!(object.placement, Placement::Hand { .. })) {
        return Ok(scene);
    }
    let seen = seen(robot, Scene::clone(&scene)).map(Arc::new);
    seen.map_err(|fault| ActionFailure::aborted(format!("a fact `in_gripper`: {fault}")))
}
