//! Closed-form inverse kinematics for arms of seven revolute joints with a spherical shoulder and a spherical wrist: the elbow from the
//! distance of the wrist, the shoulder and the wrist as three turns each. The caller chooses the redundancy: the rotation of the elbow
//! about the line from shoulder to wrist. All axes are those at zero positions, with products of exponentials from there (Paden-Kahan
//! subproblems; Murray, Li, Sastry: *A Mathematical Introduction to Robotic Manipulation*, 3.3).

use crate::frame::compose;
use crate::joint_vector::JointVector;
use crate::robot_model::{Drive, Joint};
use crate::vector::{Vector, position, rotate, transform, unit};
use ratn_model::pose::Pose;
use std::f64::consts::{PI, TAU};

/// Axes intersect if their distance is less than this, in metres; directions with a smaller scalar product are perpendicular.
const MEETING: f64 = 1e-9;

/// Axes within this angle count as parallel, in radians: a tenth of a pose's tolerance.
const IN_LINE: f64 = 1e-7;

/// The geometry of such an arm at zero positions.
#[derive(Debug, Clone)]
pub(crate) struct Spherical {
    pub(crate) axes: [Vector; 7],
    /// The position index of each axis.
    pub(crate) joints: [usize; 7],
    shoulder: Vector,
    /// A point on the elbow's axis.
    elbow: Vector,
    wrist: Vector,
    tip: Pose,
}

impl Spherical {
    /// The geometry of a chain, if it is such an arm.
    pub(crate) fn of(chain: &[(Pose, Drive)], tip: &Pose) -> Option<Spherical> {
        let chain: &[(Pose, Drive); 7] = chain.try_into().ok()?;
        let mut pose = Pose::IDENTITY;
        let (mut axes, mut points, mut joints) = ([Vector::ZERO; 7], [Vector::ZERO; 7], [0; 7]);
        for (i, (origin, drive)) in chain.iter().enumerate() {
            pose = compose(&pose, origin);
            (axes[i], points[i], joints[i]) = (rotate(&pose, drive.axis), position(&pose), drive.joint);
        }
        let turns = chain.iter().all(|(_, drive)| !drive.slides && drive.factor == 1.0);
        let distinct = (0..7).all(|i| !joints[..i].contains(&joints[i]));
        let square = [(0, 1), (1, 2), (4, 5), (5, 6)].iter().all(|(a, b)| axes[*a].dot(axes[*b]).abs() < MEETING);
        let meeting = |first: usize| {
            let point = meeting(points[first], axes[first], points[first + 1], axes[first + 1])?;
            let beside = point - points[first + 2];
            (beside.cross(axes[first + 2]).length() < MEETING).then_some(point)
        };
        if !turns || !distinct || !square {
            return None;
        }
        let (shoulder, wrist) = (meeting(0)?, meeting(4)?);
        Some(Spherical { axes, joints, shoulder, elbow: points[3], wrist, tip: compose(&pose, tip) })
    }

    /// The elbow's rotation about the line from shoulder to wrist in a posture, as [`Spherical::solve`] counts it.
    pub(crate) fn turn(&self, positions: &JointVector) -> f64 {
        let q: [f64; 7] = std::array::from_fn(|i| positions[self.joints[i]]);
        let shoulder = self.three(0, [q[0], q[1], q[2]]);
        let reach = self.bent(q[3]) - self.shoulder;
        let line = rotate(&shoulder, reach);
        let zero = from_to(reach, line);
        let rest = compose(&shoulder, &zero.inverse()).quaternion_xyzw;
        let along = Vector::new(rest[0], rest[1], rest[2]).dot(unit(line));
        wrapped(2.0 * along.atan2(rest[3]))
    }

    /// The elbow angles that put the wrist where a pose needs it; empty where that is too far away or too close.
    pub(crate) fn bends_for(&self, target: &Pose) -> Vec<f64> {
        let motion = self.motion(target);
        self.bends((transform(&motion, self.wrist) - self.shoulder).length())
    }

    /// All postures that bring the frame to a pose with the elbow at one of its bends and at this turn: each joint in the turn within its
    /// limits that is nearest to `near`, or beyond the limits where there is none. Other joints are as in `near`.
    pub(crate) fn solve(
        &self,
        target: &Pose,
        bend: f64,
        turn: f64,
        limits: &[Joint],
        near: &JointVector,
    ) -> Vec<JointVector> {
        let motion = self.motion(target);
        let mut solutions = Vec::new();
        for first in self.turns(0, &self.turned_shoulder(&motion, bend, turn)) {
            // The rotation by the solved angles, not the wanted one, so that errors do not accumulate.
            let wrist = self.turned_wrist(&motion, bend, &self.three(0, first));
            for last in self.turns(4, &wrist) {
                let mut positions = *near;
                let all = first.into_iter().chain([bend]).chain(last);
                for (joint, value) in self.joints.iter().zip(all) {
                    positions[*joint] = turn_within(value, &limits[*joint], near[*joint]);
                }
                solutions.push(positions);
            }
        }
        solutions
    }

    /// The rotations of the shoulder and of the wrist for this pose, bend and turn.
    pub(crate) fn rotations(&self, target: &Pose, bend: f64, turn: f64) -> [Pose; 2] {
        let motion = self.motion(target);
        let shoulder = self.turned_shoulder(&motion, bend, turn);
        [shoulder, self.turned_wrist(&motion, bend, &shoulder)]
    }

    /// The motion that takes the frame from its zero pose to the target.
    fn motion(&self, target: &Pose) -> Pose {
        compose(target, &self.tip.inverse())
    }

    fn turned_shoulder(&self, motion: &Pose, bend: f64, turn: f64) -> Pose {
        let line = transform(motion, self.wrist) - self.shoulder;
        let reach = self.bent(bend) - self.shoulder;
        compose(&about(unit(line), turn), &from_to(reach, line))
    }

    fn turned_wrist(&self, motion: &Pose, bend: f64, shoulder: &Pose) -> Pose {
        let elbow = compose(shoulder, &about(self.axes[3], bend));
        compose(&elbow.inverse(), motion)
    }

    /// The wrist's position after bending the elbow.
    fn bent(&self, bend: f64) -> Vector {
        rotate(&about(self.axes[3], bend), self.wrist - self.elbow) + self.elbow
    }

    /// Elbow angles that bring the wrist this far from the shoulder.
    fn bends(&self, distance: f64) -> Vec<f64> {
        let axis = self.axes[3];
        let (p, q) = (self.wrist - self.elbow, self.shoulder - self.elbow);
        let (along_p, along_q) = (axis.dot(p), axis.dot(q));
        let (p, q) = (p - along_p * axis, q - along_q * axis);
        let square = distance * distance - (along_p - along_q).powi(2);
        let cosine = (p.dot(p) + q.dot(q) - square) / (2.0 * p.length() * q.length());
        if cosine.is_nan() || cosine.abs() > 1.0 + 1e-12 {
            return Vec::new();
        }
        let straight = axis.dot(p.cross(q)).atan2(p.dot(q));
        let half = cosine.clamp(-1.0, 1.0).acos();
        if half < 1e-9 { vec![straight] } else { vec![straight + half, straight - half] }
    }

    /// The rotation by three joints from `first` on.
    fn three(&self, first: usize, angles: [f64; 3]) -> Pose {
        let turn = |i: usize| about(self.axes[first + i], angles[i]);
        compose(&compose(&turn(0), &turn(1)), &turn(2))
    }

    /// The two decompositions of a rotation into three joints from `first` on, each perpendicular to the next.
    fn turns(&self, first: usize, rotation: &Pose) -> [[f64; 3]; 2] {
        let [a, b, c] = [self.axes[first], self.axes[first + 1], self.axes[first + 2]];
        // Rotating c about b keeps its component along b; only the middle angle changes its component along a.
        let seen = rotate(rotation, c);
        let (cosine, sine) = (a.dot(c), a.dot(b.cross(c)));
        let (size, zero) = (cosine.hypot(sine), sine.atan2(cosine));
        let half = (a.dot(seen) / size).clamp(-1.0, 1.0).acos();
        [half, -half].map(|half| {
            let middle = zero + half;
            let third = rotate(&about(b, middle), c);
            let last = |outer: f64| {
                let done = compose(&about(a, outer), &about(b, middle));
                angle_about(c, b, rotate(&compose(&done.inverse(), rotation), b))
            };
            if a.cross(third).length() < IN_LINE {
                // Only the sum of the two outer turns matters: half of it for each satisfies the most limits.
                let outer = last(0.0) / 2.0 * a.dot(third).signum();
                return [outer, middle, last(outer)];
            }
            let outer = angle_about(a, third, seen);
            [outer, middle, last(outer)]
        })
    }
}

/// The intersection of two lines, if there is one.
fn meeting(p: Vector, a: Vector, q: Vector, b: Vector) -> Option<Vector> {
    let normal = a.cross(b);
    let way = q - p;
    let square = normal.dot(normal);
    if square < MEETING || way.dot(normal).abs() > MEETING {
        return None;
    }
    let along = way.cross(b).dot(normal) / square;
    Some(p + along * a)
}

/// A rotation about a unit vector.
pub(crate) fn about(axis: Vector, angle: f64) -> Pose {
    let (sin, cos) = (angle / 2.0).sin_cos();
    Pose { position: [0.0; 3], quaternion_xyzw: (axis * sin).extend(cos).into() }
}

/// The angle about an axis from one vector to another.
pub(crate) fn angle_about(axis: Vector, from: Vector, to: Vector) -> f64 {
    let across = |v: Vector| v - axis.dot(v) * axis;
    let (from, to) = (across(from), across(to));
    axis.dot(from.cross(to)).atan2(from.dot(to))
}

/// The shortest rotation from one direction to another.
fn from_to(from: Vector, to: Vector) -> Pose {
    let (from, to) = (unit(from), unit(to));
    let axis = from.cross(to);
    if axis.length() < 1e-12 {
        let aside = if from.x.abs() < 0.9 { Vector::X } else { Vector::Y };
        return about(unit(from.cross(aside)), if from.dot(to) > 0.0 { 0.0 } else { PI });
    }
    about(unit(axis), axis.length().atan2(from.dot(to)))
}

/// The turn of an angle that is within a joint's limits and nearest to a position; without one, the turn nearest to the limits.
fn turn_within(angle: f64, Joint { lower, upper, .. }: &Joint, near: f64) -> f64 {
    let (least, most) = (((lower - angle) / TAU).ceil(), ((upper - angle) / TAU).floor());
    let turn = if least <= most {
        ((near - angle) / TAU).round().clamp(least, most)
    } else {
        ((f64::midpoint(*lower, *upper) - angle) / TAU).round()
    };
    angle + TAU * turn
}

/// The angle wrapped to half a turn around zero.
fn wrapped(angle: f64) -> f64 {
    angle - TAU * (angle / TAU).round()
}
