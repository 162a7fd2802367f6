//! Validates a trajectory of the arm: what a controller checks before it moves, with what it knows itself.

use crate::collision::{Checker, Collision, Contact, RESOLUTION_M};
use crate::cubic::Cubic;
use crate::joint_vector::{JointVector, PerJoint};
use crate::leaving::Leaving;
use crate::request::unit;
use crate::robot::{Configuration, Joint, Robot};
use crate::trajectory::{Curve, Knot, TrajectoryError};
use ratn_model::value::Trajectory;
use ratn_world::scene::Scene;

/// Maximum distance of a trajectory's start from the arm's position, per joint, in radians (metres for a prismatic joint).
pub const START_TOLERANCE_RAD: f64 = 0.01;

/// By how much a limit may be exceeded, as a fraction: rounding.
const LIMIT_TOLERANCE: f64 = 0.01;

/// By how much a position may exceed its limit, in radians or metres.
pub(crate) const POSITION_TOLERANCE: f64 = 1e-3;

/// Why a trajectory may not be followed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Violation {
    /// It is no trajectory of this arm.
    #[error(transparent)]
    Malformed(#[from] TrajectoryError),
    /// It does not start at the arm's position.
    #[error("{joint} is at {actual:.4} {unit}, the trajectory starts at {start:.4} {unit}")]
    Start {
        /// The joint.
        joint: String,
        /// Its position.
        actual: f64,
        /// Where the trajectory starts.
        start: f64,
        /// The unit of its position.
        unit: &'static str,
    },
    /// It does not start or end at rest.
    #[error("{joint} moves at {velocity:.4} {unit}/s at {time_s:.3} s, where the trajectory must be at rest")]
    NotAtRest {
        /// The joint.
        joint: String,
        /// Its velocity, per second.
        velocity: f64,
        /// The unit of its position.
        unit: &'static str,
        /// The time.
        time_s: f64,
    },
    /// A position, velocity, acceleration or jerk exceeds its limit.
    #[error(
        "{joint} reaches {what} {value:.3} {unit} in the part that begins at {time_s:.3} s, its limit is {limit:.3} {unit}"
    )]
    Limit {
        /// The joint.
        joint: String,
        /// Position, velocity, acceleration or jerk.
        what: &'static str,
        /// Its value.
        value: f64,
        /// The limit.
        limit: f64,
        /// The unit of both.
        unit: String,
        /// The time.
        time_s: f64,
    },
    /// The acceleration steps, so the jerk has no bound.
    #[error(
        "the acceleration of {joint} steps by {step:.3} {unit}/s² at {time_s:.3} s: its jerk is limited, so it must be continuous"
    )]
    Step {
        /// The joint.
        joint: String,
        /// The size of the step.
        step: f64,
        /// The unit of the joint's position.
        unit: &'static str,
        /// The time.
        time_s: f64,
    },
    /// A collision.
    #[error("at {time_s:.2} s {collision}")]
    Collision {
        /// The time.
        time_s: f64,
        /// What touches what.
        collision: Collision,
    },
}

/// Checks a trajectory of the arm, with the rest of the robot as in `here`, its base where the scene has it, and the `contact` that the motion may
/// make. Returns the curve ready for sampling, beginning at the arm's position: a continuous joint may be whole turns from where the trajectory
/// begins.
///
/// # Errors
/// The first [`Violation`].
pub fn validate_trajectory(
    robot: &Robot,
    scene: &Scene,
    here: &Configuration,
    trajectory: &Trajectory,
    contact: Contact,
) -> Result<Curve, Violation> {
    let trajectory = Curve::of_arm(robot, trajectory)?.counted_from(robot.arm_joints(), &here.arm);
    check_start(robot, &here.arm, &trajectory, |_| START_TOLERANCE_RAD)?;
    check_rest(robot.arm_joints(), robot.arm_slides(), &trajectory)?;
    check_limits(robot.arm_joints(), robot.arm_slides(), &trajectory)?;
    let mut checker = Checker::new(robot, scene, here, 0.0);
    check_collisions_while(&mut checker, &trajectory, contact, &mut || true)?;
    Ok(trajectory)
}

/// Checks that a trajectory starts so near to the arm's position, per joint, in radians (metres for a prismatic joint).
///
/// # Errors
/// [`Violation::Start`] names the first joint that is farther away.
pub fn check_start(
    robot: &Robot,
    start: &JointVector,
    trajectory: &Curve,
    within: impl Fn(usize) -> f64,
) -> Result<(), Violation> {
    let knots = trajectory.knots();
    for (j, joint) in robot.arm_joints().iter().enumerate() {
        let planned = knots[0].positions[j];
        if (start[j] - planned).abs() > within(j) {
            let unit = unit(robot.arm_slides()[j]);
            return Err(Violation::Start { joint: joint.name.clone(), actual: start[j], start: planned, unit });
        }
    }
    Ok(())
}

/// Checks that it starts and ends at rest. `slides`: which joints are prismatic.
pub(crate) fn check_rest(joints: &[Joint], slides: &[bool], trajectory: &Curve) -> Result<(), Violation> {
    let knots = trajectory.knots();
    let moves = |knot: &Knot| (0..joints.len()).find(|j| knot.velocities[*j].abs() > 1e-3);
    match [&knots[0], &knots[knots.len() - 1]].into_iter().find_map(|knot| moves(knot).map(|j| (knot, j))) {
        None => Ok(()),
        Some((knot, j)) => {
            let (joint, velocity) = (joints[j].name.clone(), knot.velocities[j]);
            Err(Violation::NotAtRest { joint, velocity, unit: unit(slides[j]), time_s: knot.time_s })
        }
    }
}

/// Checks that positions, velocities, accelerations and jerks are within the limits, also between the knots: the extremes of the cubics, in closed
/// form. If the acceleration steps from one cubic to the next, or from rest, the jerk has no bound. `slides`: which joints are prismatic.
pub(crate) fn check_limits(joints: &[Joint], slides: &[bool], trajectory: &Curve) -> Result<(), Violation> {
    let knots = trajectory.knots();
    let exceeded = |j: usize, (what, per): (&'static str, &str), value: f64, limit: f64, time_s| {
        let (joint, unit) = (joints[j].name.clone(), format!("{}{per}", unit(slides[j])));
        Err(Violation::Limit { joint, what, value, limit, unit, time_s })
    };
    let mut before = JointVector::zeros(joints.len());
    for i in 0..knots.len() {
        let is_last = i + 1 == knots.len();
        let lasts_s = if is_last { 0.0 } else { knots[i + 1].time_s - knots[i].time_s };
        let still = |j: usize| Cubic { position: knots[i].positions[j], ..Cubic::default() };
        let cubics = if is_last { PerJoint::from_fn(joints.len(), still) } else { trajectory.cubics(i) };
        let time_s = knots[i].time_s;
        for (j, (joint, cubic)) in joints.iter().zip(&cubics).enumerate() {
            let [least, greatest] = cubic.range(0.0, lasts_s);
            if !joint.allows(least, POSITION_TOLERANCE) {
                return exceeded(j, ("position", ""), least, joint.clamp(least), time_s);
            }
            if !joint.allows(greatest, POSITION_TOLERANCE) {
                return exceeded(j, ("position", ""), greatest, joint.clamp(greatest), time_s);
            }
            let step = (cubic.acceleration - before[j]).abs();
            let used = [
                (("velocity", "/s"), cubic.greatest_velocity(), joint.velocity),
                (("acceleration", "/s²"), cubic.greatest_acceleration(), joint.acceleration),
                (("jerk", "/s³"), cubic.jerk.abs(), joint.jerk),
            ];
            for (what, value, limit) in used {
                if value > limit * (1.0 + LIMIT_TOLERANCE) {
                    return exceeded(j, what, value, limit, time_s);
                }
            }
            if joint.jerk.is_finite() && step > joint.acceleration * LIMIT_TOLERANCE {
                return Err(Violation::Step { joint: joint.name.clone(), step, unit: unit(slides[j]), time_s });
            }
            before[j] = cubic.acceleration_at(lasts_s);
        }
    }
    Ok(())
}

/// Checks a whole motion. If the gripper is inside an object at its start, that contact is left first, as in a retreat ([`Leaving`]). `goes_on` is
/// called before each check of the rest; returns whether all of it was checked.
pub(crate) fn check_collisions_while(
    checker: &mut Checker<'_>,
    trajectory: &Curve,
    contact: Contact,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<bool, Violation> {
    let whole = [0.0, trajectory.duration_s()];
    let start = trajectory.knots()[0].positions;
    let stands_in = if checker.is_free(&start, contact) { None } else { Leaving::from(checker, &start) };
    let Some(leaving) = stands_in else {
        return check_part(checker, trajectory, whole, contact, goes_on);
    };
    let mut rest = leaving.of_the_rest(checker);
    let left_s = left_after_s(leaving, checker, trajectory)?;
    Ok(check_part(&mut rest, trajectory, [0.0, left_s], contact, goes_on)?
        && check_part(checker, trajectory, [left_s, whole[1]], contact, goes_on)?)
}

/// The time when all contacts of the start have been left.
fn left_after_s(mut leaving: Leaving, checker: &mut Checker<'_>, trajectory: &Curve) -> Result<f64, Violation> {
    for (i, pair) in trajectory.knots().windows(2).enumerate() {
        let lasts_s = pair[1].time_s - pair[0].time_s;
        let ranges = trajectory.cubics(i).map(|cubic| cubic.range(0.0, lasts_s));
        let most = JointVector::from_fn(pair[0].positions.len(), |j| ranges[j][1] - ranges[j][0]);
        let looks = ((checker.moves_m(&most) / RESOLUTION_M).ceil() as usize).max(1);
        for look in 1..=looks {
            let time_s = pair[0].time_s + lasts_s * look as f64 / looks as f64;
            let posture = trajectory.sample(time_s).positions;
            leaving.comes_to(checker, &posture).map_err(|collision| Violation::Collision { time_s, collision })?;
            if leaving.is_over() {
                return Ok(time_s);
            }
        }
    }
    Err(Violation::Collision { time_s: trajectory.duration_s(), collision: leaving.told() })
}

/// Checks a part of the curve, in pieces that are halved where there is little room.
fn check_part(
    checker: &mut Checker<'_>,
    trajectory: &Curve,
    [begins_s, ends_s]: [f64; 2],
    contact: Contact,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<bool, Violation> {
    let knots = trajectory.knots();
    let collides = |time_s| move |collision| Violation::Collision { time_s, collision };
    checker.room(&trajectory.sample(begins_s).positions, contact, 0.0).map_err(collides(begins_s))?;
    for (i, pair) in knots.windows(2).enumerate() {
        let cubics = trajectory.cubics(i);
        let within = [begins_s.max(pair[0].time_s), ends_s.min(pair[1].time_s)].map(|time_s| time_s - pair[0].time_s);
        let mut piece = |[from, to]: [f64; 2]| {
            let posture = cubics.map(|cubic| cubic.position_at((from + to) / 2.0));
            let strays = JointVector::from_fn(posture.len(), |j| {
                let [least, greatest] = cubics[j].range(from, to);
                (posture[j] - least).max(greatest - posture[j])
            });
            (posture, strays)
        };
        if within[0] < within[1] {
            let free = checker.free_in_pieces(within, contact, &mut piece, goes_on);
            if !free.map_err(|(at, collision)| collides(pair[0].time_s + at)(collision))? {
                return Ok(false);
            }
        }
    }
    checker.room(&trajectory.sample(ends_s).positions, contact, 0.0).map_err(collides(ends_s))?;
    Ok(true)
}
