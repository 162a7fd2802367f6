//! Which motions arm and base follow: those that ratn-motion finds nothing wrong with in the *true* scene.

use ratn_model::value::Trajectory;
use ratn_motion::base::check_drive;
use ratn_motion::collision::Contact;
use ratn_motion::plan::MIN_SPEED;
use ratn_motion::robot::{Configuration, Joints, Robot};
use ratn_motion::timing::{Part, parameterise};
use ratn_motion::trajectory::{ArmTrajectory, BaseTrajectory};
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::Scene;

/// How deep the fingers and what they hold may press into something, in metres: what the planner takes for certain was
/// measured, and rubber and cardboard give way. Arm links may not.
const COMPLIANCE_M: f64 = 0.015;

/// The longest motion, in seconds: every posture of it is checked before it begins.
const MAX_MOTION_S: f64 = 600.0;

/// The trajectory, ready to be followed from `here`.
///
/// # Errors
/// Why it may not be followed.
pub(crate) fn check(
    robot: &Robot,
    scene: &Scene,
    here: &Configuration,
    trajectory: &Trajectory,
) -> Result<ArmTrajectory, String> {
    is_short(trajectory)?;
    let contact = Contact::Gripper(COMPLIANCE_M);
    validate_trajectory(robot, scene, &here.arm, Some(here.finger), trajectory, contact)
        .map_err(|violation| format!("the trajectory is refused: {violation}"))
}

/// The same for the base, with what rides on it.
///
/// # Errors
/// Why it may not be followed.
pub(crate) fn check_base(
    robot: &Robot,
    scene: &Scene,
    here: &Configuration,
    riding: &[String],
    trajectory: &Trajectory,
) -> Result<BaseTrajectory, String> {
    is_short(trajectory)?;
    check_drive(robot, scene, here, riding, trajectory)
        .map_err(|violation| format!("the trajectory is refused: {violation}"))
}

fn is_short(trajectory: &Trajectory) -> Result<(), String> {
    let lasts_s = trajectory.duration_s();
    if lasts_s <= MAX_MOTION_S {
        return Ok(());
    }
    Err(format!("the trajectory is refused: it lasts {lasts_s:.0} s, a motion lasts at most {MAX_MOTION_S} s"))
}

/// The straight line of joint space to a posture.
///
/// # Errors
/// When the speed is none.
pub(crate) fn straight(robot: &Robot, from: &Joints, to: &Joints, speed: f64) -> Result<Trajectory, String> {
    if !(MIN_SPEED..=1.0).contains(&speed) {
        return Err(format!("a speed of {speed} is none: it is a fraction of the limits, from {MIN_SPEED} to 1"));
    }
    // A line without corners to round.
    Ok(parameterise(robot, &[Part::Straight(vec![*from, *to])], speed, &mut |_, _| false))
}
