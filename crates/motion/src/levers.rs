//! Chains of joints, and upper bounds of how far the end of one moves when its joints do.
//!
//! A [`Chain`] is the walk from the root to a link: for the tool's inverse kinematics, and for bounding the motion of each shape of an arm. The end
//! of a chain is never farther from a joint's axis than its lever: the sum of all offsets that follow, and of the ranges of all prismatic joints.
//! These bounds hold in every posture. They limit what can happen between two checked postures.

use crate::joint_vector::JointVector;
use crate::robot_model::{Drive, Joint, Link};
use ratn_model::pose::Pose;

/// The joints between the root and a link.
#[derive(Debug, Clone)]
pub(crate) struct Chain {
    /// From the root: for each joint that moves the link, its pose in the frame before it.
    pub(crate) joints: Vec<(Pose, Drive)>,
    /// The pose of the link in the frame of the last joint.
    pub(crate) tip: Pose,
}

impl Chain {
    /// The chain to the link with this index; `place` returns a link's pose in its parent's frame, and its drive.
    pub(crate) fn to(link: usize, links: &[Link], place: impl Fn(&Link) -> (Pose, Option<Drive>)) -> Chain {
        let mut way: Vec<usize> = std::iter::successors(Some(link), |index| links[*index].parent).collect();
        way.reverse();
        let (mut joints, mut tip) = (Vec::new(), Pose::IDENTITY);
        for index in way {
            let (origin, drive) = place(&links[index]);
            tip = tip.compose(&origin);
            if let Some(drive) = drive {
                joints.push((tip, drive));
                tip = Pose::IDENTITY;
            }
        }
        Chain { joints, tip }
    }

    /// How many joints from the root on two chains have in common: both ends move alike with these.
    pub(crate) fn shared_with(&self, other: &Chain) -> usize {
        self.joints.iter().zip(&other.joints).take_while(|(a, b)| a == b).count()
    }
}

/// The levers of a chain, from its root to its end.
#[derive(Debug, Clone)]
pub(crate) struct Levers(Vec<Lever>);

#[derive(Debug, Clone, Copy)]
struct Lever {
    drive: Drive,
    /// How far the end moves per radian, in metres (1 for a prismatic joint, per metre).
    length_m: f64,
}

impl Levers {
    /// The levers of joints, each with its pose in the frame before it, and an end at distance `end_m` from the last.
    pub(crate) fn new(chain: &[(Pose, Drive)], end_m: f64, joints: &[Joint]) -> Levers {
        let mut levers = Vec::with_capacity(chain.len());
        let mut beyond = end_m;
        for (origin, drive) in chain.iter().rev() {
            levers.push(Lever { drive: *drive, length_m: if drive.slides { 1.0 } else { beyond } });
            if drive.slides {
                let Joint { lower, upper, .. } = &joints[drive.joint];
                beyond += drive.factor.abs() * lower.abs().max(upper.abs());
            }
            beyond += origin.distance(&Pose::IDENTITY);
        }
        levers.reverse();
        Levers(levers)
    }

    /// The levers behind this many joints from the root.
    pub(crate) fn behind(&self, joints: usize) -> Levers {
        Levers(self.0[joints..].to_vec())
    }

    /// Maximum motion of the end per radian of each joint (per metre of a prismatic one), in metres.
    pub(crate) fn per_joint(&self, joints: usize) -> JointVector {
        let mut lengths = JointVector::zeros(joints);
        for Lever { drive, length_m } in &self.0 {
            lengths[drive.joint] += drive.factor.abs() * length_m;
        }
        lengths
    }

    /// Maximum motion of the end if no joint moves by more than `by`, in metres.
    pub(crate) fn moves_m(&self, by: &JointVector) -> f64 {
        self.0.iter().map(|lever| lever.amount(by) * lever.length_m).sum()
    }

    /// Maximum rotation of the end, in radians.
    pub(crate) fn turns_rad(&self, by: &JointVector) -> f64 {
        self.0.iter().filter(|lever| !lever.drive.slides).map(|lever| lever.amount(by)).sum()
    }

    /// Maximum change of the end's velocity if joints with these speeds move by `by`, in metres per second.
    pub(crate) fn swing_m(&self, by: &JointVector, speeds: &JointVector) -> f64 {
        // As in `bend_m`, for two different amounts.
        let (mut turned, mut turning, mut sum) = (0.0, 0.0, 0.0);
        for lever in &self.0 {
            let (amount, speed) = (lever.amount(by), lever.amount(speeds));
            let turns = if lever.drive.slides { 0.0 } else { 1.0 };
            sum += lever.length_m * (turned * speed + turning * amount + turns * amount * speed);
            turned += turns * amount;
            turning += turns * speed;
        }
        sum
    }

    /// Maximum distance of the end from the straight line between its two positions, if the joints move straight between two postures that differ by
    /// `by`, in metres: an eighth of the maximum second derivative.
    pub(crate) fn bend_m(&self, by: &JointVector) -> f64 {
        // ∂²p / ∂i ∂j with i before j is the axis of i times ∂p / ∂j, and zero if i is prismatic.
        let (mut before, mut second) = (0.0, 0.0);
        for lever in &self.0 {
            let amount = lever.amount(by);
            let turns = if lever.drive.slides { 0.0 } else { amount };
            second += amount * lever.length_m * (2.0 * before + turns);
            before += turns;
        }
        second / 8.0
    }
}

impl Lever {
    fn amount(&self, by: &JointVector) -> f64 {
        (self.drive.factor * by[self.drive.joint]).abs()
    }
}
