//! Whether the arm may follow a trajectory: what a controller checks before it moves, against what it knows itself.

use crate::collision::{Checker, Collision, Contact};
use crate::robot::{Joint, Joints, Robot};
use crate::trajectory::{ArmTrajectory, Curve, Knot, TrajectoryError};
use ratn_model::value::Trajectory;
use ratn_world::scene::Scene;

/// How far from the arm's position a trajectory may start, per joint, in radians.
pub const START_TOLERANCE_RAD: f64 = 0.01;

/// How much a limit may be exceeded, as a fraction: rounding.
const LIMIT_TOLERANCE: f64 = 0.01;

/// Time between two checked postures at the most, in seconds.
const CHECK_S: f64 = 0.02;

/// Why a trajectory may not be followed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Violation {
    /// It is not a trajectory of this arm.
    #[error(transparent)]
    Malformed(#[from] TrajectoryError),
    /// It starts elsewhere.
    #[error("{joint} is at {actual_rad:.4} rad, the trajectory starts at {start_rad:.4} rad")]
    Start {
        /// Which joint.
        joint: String,
        /// Where it is.
        actual_rad: f64,
        /// Where the trajectory starts.
        start_rad: f64,
    },
    /// It does not start or end at rest.
    #[error("{joint} moves at {velocity:.4} per second at {time_s:.3} s, where the trajectory must be at rest")]
    NotAtRest {
        /// Which joint.
        joint: String,
        /// How fast.
        velocity: f64,
        /// When.
        time_s: f64,
    },
    /// A position, velocity or acceleration beyond the limit.
    #[error("{joint} reaches {what} {value:.3} at {time_s:.3} s, its limit is {limit:.3}")]
    Limit {
        /// Which joint.
        joint: String,
        /// Position, velocity or acceleration.
        what: &'static str,
        /// How much.
        value: f64,
        /// What is allowed.
        limit: f64,
        /// When.
        time_s: f64,
    },
    /// Something is in the way.
    #[error("at {time_s:.2} s {collision}")]
    Collision {
        /// When.
        time_s: f64,
        /// What touches what.
        collision: Collision,
    },
}

/// Checks a trajectory for an arm that is at `start` in `scene`, each finger `finger` metres from the middle (`None`: around
/// what is held, else open), with the `contact` that the motion may make. Returns it ready to be sampled.
///
/// # Errors
/// The first [`Violation`].
pub fn validate_trajectory(
    robot: &Robot,
    scene: &Scene,
    start: &Joints,
    finger: Option<f64>,
    trajectory: &Trajectory,
    contact: Contact,
) -> Result<ArmTrajectory, Violation> {
    let trajectory = ArmTrajectory::read(robot, trajectory)?;
    check_start(robot, start, &trajectory)?;
    check_rest(robot.arm_joints(), &trajectory)?;
    check_limits(robot.arm_joints(), &trajectory)?;
    let mut checker = match finger {
        Some(finger) => Checker::with_finger(robot, scene, 0.0, finger),
        None => Checker::new(robot, scene, 0.0),
    };
    check_collisions(&mut checker, &trajectory, contact)?;
    Ok(trajectory)
}

fn check_start(robot: &Robot, start: &Joints, trajectory: &ArmTrajectory) -> Result<(), Violation> {
    let knots = trajectory.knots();
    for (j, joint) in robot.arm_joints().iter().enumerate() {
        let planned = knots[0].positions[j];
        if (start[j] - planned).abs() > START_TOLERANCE_RAD {
            let (joint, actual_rad) = (joint.name.clone(), start[j]);
            return Err(Violation::Start { joint, actual_rad, start_rad: planned });
        }
    }
    Ok(())
}

/// It starts and ends at rest.
pub(crate) fn check_rest<const N: usize>(joints: &[Joint], trajectory: &Curve<N>) -> Result<(), Violation> {
    let knots = trajectory.knots();
    let moves = |knot: &Knot<N>| (0..N).find(|j| knot.velocities[*j].abs() > 1e-3);
    match [&knots[0], &knots[knots.len() - 1]].into_iter().find_map(|knot| moves(knot).map(|j| (knot, j))) {
        None => Ok(()),
        Some((knot, j)) => {
            let (joint, velocity) = (joints[j].name.clone(), knot.velocities[j]);
            Err(Violation::NotAtRest { joint, velocity, time_s: knot.time_s })
        }
    }
}

/// Positions, velocities and accelerations are within the limits.
pub(crate) fn check_limits<const N: usize>(joints: &[Joint], trajectory: &Curve<N>) -> Result<(), Violation> {
    let exceeded = |j: usize, what, value: f64, limit: f64, time_s| {
        let joint = joints[j].name.clone();
        Err(Violation::Limit { joint, what, value, limit, time_s })
    };
    for knot in trajectory.knots() {
        for (j, joint) in joints.iter().enumerate() {
            let position = knot.positions[j];
            if position < joint.lower - 1e-3 {
                return exceeded(j, "position", position, joint.lower, knot.time_s);
            }
            if position > joint.upper + 1e-3 {
                return exceeded(j, "position", position, joint.upper, knot.time_s);
            }
        }
    }
    for (i, (velocities, accelerations)) in trajectory.extremes().enumerate() {
        let time_s = trajectory.knots()[i].time_s;
        for (j, joint) in joints.iter().enumerate() {
            if velocities[j] > joint.velocity * (1.0 + LIMIT_TOLERANCE) {
                return exceeded(j, "velocity", velocities[j], joint.velocity, time_s);
            }
            if accelerations[j] > joint.acceleration * (1.0 + LIMIT_TOLERANCE) {
                return exceeded(j, "acceleration", accelerations[j], joint.acceleration, time_s);
            }
        }
    }
    Ok(())
}

/// Samples the curve as densely as the checker asks for.
fn check_collisions(checker: &mut Checker<'_>, trajectory: &ArmTrajectory, contact: Contact) -> Result<(), Violation> {
    let knots = trajectory.knots();
    let at = |checker: &mut Checker<'_>, time_s: f64, posture: &Joints| match checker.collision(posture, contact) {
        Some(collision) => Err(Violation::Collision { time_s, collision }),
        None => Ok(()),
    };
    at(checker, 0.0, &knots[0].positions)?;
    for pair in knots.windows(2) {
        let duration = pair[1].time_s - pair[0].time_s;
        let samples = checker.steps(&pair[0].positions, &pair[1].positions).max((duration / CHECK_S).ceil() as usize);
        for i in 1..=samples {
            let time_s = pair[0].time_s + duration * i as f64 / samples as f64;
            at(checker, time_s, &trajectory.sample(time_s).positions)?;
        }
    }
    Ok(())
}
