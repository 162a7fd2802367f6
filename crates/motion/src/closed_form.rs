//! Which six joints of a chain are solved in closed form, with the others held at fixed positions.
//!
//! An arm of six joints whose axes allow it ([`six`](crate::six)) is solved completely: all postures of a pose are known, or that there are none. An
//! arm with more joints is solved for fixed positions of the others: an arm on a column for a height of the column, an arm of seven joints without a
//! spherical wrist for an angle of one joint.

use crate::frame::compose;
use crate::joint_vector::JointVector;
use crate::robot_model::{Drive, Joint};
use crate::six::{Axis, Kind};
use crate::vector::{Vector, position, rotate};
use ratn_model::pose::Pose;
use std::f64::consts::TAU;

/// Tolerance for positions beyond a limit, because axes are rounded, in radians.
const SLACK: f64 = 1e-4;

/// Maximum number of joints of a chain that is tried.
const MOST_JOINTS: usize = 10;

/// Positions of the held joints at which the structure of the others is analysed, as shares of their ranges.
const GENERIC: [f64; 2] = [0.37, 0.71];

/// Six joints of a chain that have a closed-form solution for all positions of the others.
#[derive(Debug, Clone)]
pub(crate) struct ClosedForm {
    /// The indices of those six in the chain.
    solved: [usize; 6],
    /// The held joints.
    pub(crate) held: Vec<usize>,
    kind: Kind,
    is_exact: bool,
}

/// The postures of a pose with the held joints at given positions.
#[derive(Debug, Clone)]
pub(crate) struct Solved {
    /// Within the limits, up to rounding; each joint in any of its turns.
    pub(crate) postures: Vec<JointVector>,
    /// Whether these are all.
    pub(crate) is_complete: bool,
}

impl ClosedForm {
    /// The closed form of a chain, from its root, with the limits of its joints.
    pub(crate) fn of(chain: &[(Pose, Drive)], joints: &[Joint]) -> Option<ClosedForm> {
        if !(6..=MOST_JOINTS).contains(&chain.len()) {
            return None;
        }
        let is_plain = |place: &usize| {
            let drive = &chain[*place].1;
            let is_alone = chain.iter().filter(|(_, other)| other.joint == drive.joint).count() == 1;
            !drive.slides && drive.factor == 1.0 && is_alone
        };
        let choices = (0_u32..1 << chain.len()).filter(|choice| choice.count_ones() == 6);
        choices.into_iter().find_map(|choice| {
            let places: Vec<usize> = (0..chain.len()).filter(|place| choice & 1 << place != 0).collect();
            let solved: [usize; 6] = places.try_into().ok()?;
            if !solved.iter().all(is_plain) {
                return None;
            }
            let mut held: Vec<usize> = chain.iter().map(|(_, drive)| drive.joint).collect();
            held.retain(|joint| solved.iter().all(|place| chain[*place].1.joint != *joint));
            let kinds = GENERIC.map(|share| {
                let mut positions = JointVector::zeros(joints.len());
                for joint in &held {
                    positions[*joint] = joints[*joint].lower + share * (joints[*joint].upper - joints[*joint].lower);
                }
                let (axes, _) = axes(chain, &solved, &positions);
                Kind::of(&axes).map(|kind| (kind, kind.is_exact(&axes)))
            });
            let [Some((kind, is_exact)), Some((other, _))] = kinds else { return None };
            (kind == other).then_some(ClosedForm { solved, held, kind, is_exact })
        })
    }

    /// The postures that bring the tip to a pose, with the held joints and the joints outside of the chain as in `others`.
    pub(crate) fn solve(
        &self,
        chain: &[(Pose, Drive)],
        tip: &Pose,
        joints: &[Joint],
        target: &Pose,
        others: &JointVector,
    ) -> Solved {
        let (axes, last) = axes(chain, &self.solved, others);
        let motion = compose(target, &compose(&last, tip).inverse());
        let found = self.kind.solve(&axes, &motion);
        let within = |angles: &[f64; 6]| {
            let mut posture = *others;
            for (place, angle) in self.solved.iter().zip(angles) {
                let joint = chain[*place].1.joint;
                posture[joint] = turn_nearest(*angle, &joints[joint], others[joint])?;
            }
            Some(posture)
        };
        let postures = found.all.iter().filter_map(within).collect();
        Solved { postures, is_complete: self.held.is_empty() && self.is_exact && !found.is_singular }
    }
}

/// The axes of the solved joints when these are at zero, and the pose of the last joint's frame.
fn axes(chain: &[(Pose, Drive)], solved: &[usize; 6], held: &JointVector) -> ([Axis; 6], Pose) {
    let mut axes = [Axis { direction: Vector::ZERO, point: Vector::ZERO }; 6];
    let (mut pose, mut next) = (Pose::IDENTITY, 0);
    for (place, (origin, drive)) in chain.iter().enumerate() {
        pose = compose(&pose, origin);
        if solved.contains(&place) {
            axes[next] = Axis { direction: rotate(&pose, drive.axis), point: position(&pose) };
            next += 1;
        } else {
            pose = compose(&pose, &drive.moved(held[drive.joint]));
        }
    }
    (axes, pose)
}

/// The turn of an angle that is nearest to a position, among those within the limits; if it exceeds a limit by rounding, the limit.
pub(crate) fn turn_nearest(angle: f64, joint: &Joint, near: f64) -> Option<f64> {
    let least = ((joint.lower - SLACK - angle) / TAU).ceil();
    let most = ((joint.upper + SLACK - angle) / TAU).floor();
    let turn = ((near - angle) / TAU).round();
    (least <= most).then(|| (angle + TAU * turn.clamp(least, most)).clamp(joint.lower, joint.upper))
}
