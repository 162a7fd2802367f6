//! Checks the trajectories of arm and base as a controller can: the trajectory's form and limits, the measured joint positions, the robot's own body,
//! and the area in which it may drive. A controller does not know the other bodies in the cell: the physics decides whether the robot touches them
//! ([`super::contacts`]).

use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_motion::base::check_drive;
use ratn_motion::collision::Contact;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::MIN_SPEED;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::timing::{Section, parameterise};
use ratn_motion::trajectory::Curve;
use ratn_motion::validate::{Violation, check_start, validate_trajectory};
use ratn_world::scene::Scene;

/// Maximum duration of a motion, in seconds: every posture is checked before it begins.
const MAX_MOTION_S: f64 = 600.0;

/// The trajectory, ready to be followed from the measured configuration `here` by a controller of this stiffness, in radians per second.
///
/// # Errors
/// Why it may not be followed.
pub(crate) fn check(
    robot: &Robot,
    here: &Configuration,
    trajectory: &Trajectory,
    stiffness: f64,
) -> Result<Curve, String> {
    is_short(trajectory)?;
    let refused = |violation: Violation| format!("the trajectory is refused: {violation}");
    let curve = validate_trajectory(robot, &nothing(), here, trajectory, Contact::None).map_err(refused)?;
    // The controller brings a joint to where the trajectory starts with an acceleration of its own.
    let within = |joint: usize| robot.arm_joints()[joint].acceleration / stiffness.powi(2);
    check_start(robot, &here.arm, &curve, within).map_err(refused)?;
    Ok(curve)
}

/// The same for the base.
///
/// # Errors
/// Why it may not be followed.
pub(crate) fn check_base(robot: &Robot, here: &Configuration, trajectory: &Trajectory) -> Result<Curve, String> {
    is_short(trajectory)?;
    check_drive(robot, &nothing(), here, &[], trajectory)
        .map_err(|violation| format!("the trajectory is refused: {violation}"))
}

/// The controller's scene of the robot's surroundings: empty.
fn nothing() -> Scene {
    Scene { base: Pose::IDENTITY, objects: Vec::new() }
}

fn is_short(trajectory: &Trajectory) -> Result<(), String> {
    let lasts_s = trajectory.duration_s();
    if lasts_s <= MAX_MOTION_S {
        return Ok(());
    }
    Err(format!("the trajectory is refused: it lasts {lasts_s:.0} s, a motion lasts at most {MAX_MOTION_S} s"))
}

/// The straight line in joint space to a posture; continuous joints use the nearest turn.
///
/// # Errors
/// If the speed is out of its range.
pub(crate) fn straight(robot: &Robot, from: &JointVector, to: &JointVector, speed: f64) -> Result<Trajectory, String> {
    if !(MIN_SPEED..=1.0).contains(&speed) {
        return Err(format!("a speed of {speed} is none: it is a fraction of the limits, from {MIN_SPEED} to 1"));
    }
    // A line has no corners to round.
    let joints = robot.arm_joints();
    let to = JointVector::from_fn(joints.len(), |j| joints[j].counted_from(from[j], to[j]));
    Ok(parameterise(robot, &[Section::AsGiven(vec![*from, to])], speed, &mut |_, _| false))
}
