//! A trajectory of the arm, or of the base, as a curve: cubic Hermite interpolation between its points.

use crate::cubic::Cubic;
use crate::joint_vector::{JointVector, PerJoint};
use crate::robot::{Joint, Robot};
use ratn_model::value::{Trajectory, TrajectoryPoint};

/// Maximum number of points of a trajectory.
pub const MAX_POINTS: usize = 100_000;

/// A well-formed trajectory of an arm's joints, or of a base (x, y and heading); at least one knot, all of the same joints.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    knots: Vec<Knot>,
}

/// The positions and velocities of the joints at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Knot<P = JointVector> {
    /// Seconds since the start.
    pub time_s: f64,
    /// Radians, or metres for prismatic joints.
    pub positions: P,
    /// The same per second.
    pub velocities: P,
}

/// Why a trajectory is invalid for these joints.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrajectoryError {
    /// The trajectory is for other joints.
    #[error("the trajectory moves [{joints}], it should move [{expected}]")]
    OtherJoints {
        /// The joints of the trajectory.
        joints: String,
        /// The expected joints.
        expected: String,
    },
    /// There are no points, or too many.
    #[error("the trajectory has {points} points: expected 1 to {MAX_POINTS}")]
    Points {
        /// Number of points.
        points: usize,
    },
    /// A point is malformed.
    #[error("point {index} of the trajectory: {reason}")]
    Point {
        /// The index of the point, from 0.
        index: usize,
        /// The error.
        reason: String,
    },
}

impl Curve {
    /// A curve from knots of the same joints, at least one, whose times increase from 0.
    pub(crate) fn new(knots: Vec<Knot>) -> Curve {
        Curve { knots }
    }

    /// Reads a trajectory of a robot's arm.
    ///
    /// # Errors
    /// [`TrajectoryError`] if it is for other joints, or its times do not increase strictly from 0.
    pub fn of_arm(robot: &Robot, trajectory: &Trajectory) -> Result<Curve, TrajectoryError> {
        Curve::of(robot.arm_joints(), trajectory)
    }

    /// Reads a trajectory of these joints.
    ///
    /// # Errors
    /// [`TrajectoryError`] if it is for other joints, or its times do not increase strictly from 0.
    pub fn of(joints: &[Joint], trajectory: &Trajectory) -> Result<Curve, TrajectoryError> {
        let names: Vec<&str> = joints.iter().map(|j| j.name.as_str()).collect();
        if trajectory.joints != names {
            let joints = trajectory.joints.join(", ");
            return Err(TrajectoryError::OtherJoints { joints, expected: names.join(", ") });
        }
        if trajectory.points.is_empty() || trajectory.points.len() > MAX_POINTS {
            return Err(TrajectoryError::Points { points: trajectory.points.len() });
        }
        let mut knots: Vec<Knot> = Vec::with_capacity(trajectory.points.len());
        for (index, point) in trajectory.points.iter().enumerate() {
            let wrong = |reason: String| TrajectoryError::Point { index, reason };
            let numbers = |values: &[f64], what: &str| -> Result<JointVector, TrajectoryError> {
                if values.len() != joints.len() {
                    return Err(wrong(format!("{} {what}, expected {}", values.len(), joints.len())));
                }
                let read = JointVector::read(values).map_err(|error| wrong(error.to_string()))?;
                if read.iter().all(|v| v.is_finite()) { Ok(read) } else { Err(wrong(format!("{what} not finite"))) }
            };
            let after = knots.last().map_or(0.0, |k| k.time_s);
            let grows = if index == 0 { point.time_s == 0.0 } else { point.time_s > after && point.time_s.is_finite() };
            if !grows {
                return Err(wrong(format!("time {} s does not grow strictly from 0", point.time_s)));
            }
            let velocities = numbers(&point.velocities, "velocities")?;
            knots.push(Knot { time_s: point.time_s, positions: numbers(&point.positions, "positions")?, velocities });
        }
        Ok(Curve { knots })
    }

    /// The same curve with the turns counted from `start`, the posture in which it begins: continuous joints may be there in another turn.
    pub(crate) fn counted_from(mut self, joints: &[Joint], start: &JointVector) -> Curve {
        let first = self.knots[0].positions;
        let by = JointVector::from_fn(joints.len(), |j| joints[j].counted_from(start[j], first[j]) - first[j]);
        for knot in &mut self.knots {
            knot.positions.iter_mut().zip(&by).for_each(|(position, by)| *position += by);
        }
        self
    }

    /// The curve as a trajectory of the task model, with the joints' names.
    pub fn named(&self, joints: &[Joint]) -> Trajectory {
        let point = |knot: &Knot| TrajectoryPoint {
            time_s: knot.time_s,
            positions: knot.positions.to_vec(),
            velocities: knot.velocities.to_vec(),
        };
        Trajectory {
            joints: joints.iter().map(|j| j.name.clone()).collect(),
            points: self.knots.iter().map(point).collect(),
        }
    }

    /// The points.
    pub fn knots(&self) -> &[Knot] {
        &self.knots
    }

    /// Seconds from start to end.
    pub fn duration_s(&self) -> f64 {
        self.knots.last().map_or(0.0, |k| k.time_s)
    }

    /// The end positions.
    pub fn end(&self) -> JointVector {
        self.knots[self.knots.len() - 1].positions
    }

    /// Positions and velocities at a time; before the start and after the end the joints stand.
    pub fn sample(&self, time_s: f64) -> Knot {
        let next = self.knots.partition_point(|k| k.time_s <= time_s);
        if next == 0 || next == self.knots.len() {
            let knot = if next == 0 { &self.knots[0] } else { &self.knots[next - 1] };
            return Knot { time_s, positions: knot.positions, velocities: JointVector::zeros(knot.positions.len()) };
        }
        hermite(&self.knots[next - 1], &self.knots[next], time_s)
    }

    /// The motion of each joint between knot `i` and the next.
    pub(crate) fn cubics(&self, i: usize) -> PerJoint<Cubic> {
        PerJoint::from_fn(self.knots[i].positions.len(), |j| Cubic::between(&self.knots[i], &self.knots[i + 1], j))
    }
}

fn hermite(a: &Knot, b: &Knot, time_s: f64) -> Knot {
    let h = b.time_s - a.time_s;
    let t = (time_s - a.time_s) / h;
    let (t2, t3) = (t * t, t * t * t);
    let positions = JointVector::from_fn(a.positions.len(), |j| {
        (2.0 * t3 - 3.0 * t2 + 1.0) * a.positions[j]
            + (t3 - 2.0 * t2 + t) * h * a.velocities[j]
            + (3.0 * t2 - 2.0 * t3) * b.positions[j]
            + (t3 - t2) * h * b.velocities[j]
    });
    let velocities = JointVector::from_fn(a.positions.len(), |j| {
        6.0 * (t2 - t) / h * (a.positions[j] - b.positions[j])
            + (3.0 * t2 - 4.0 * t + 1.0) * a.velocities[j]
            + (3.0 * t2 - 2.0 * t) * b.velocities[j]
    });
    Knot { time_s, positions, velocities }
}
