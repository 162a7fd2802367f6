//! Chains of joints, and how far the end of one moves at the most while its joints do.
//!
//! A [`Chain`] is the one walk from the root to a link: for the tool's inverse kinematics, and for how far each shape of an arm can move. The end of a chain is no further from a joint's axis than its lever: the sum of all offsets that follow, and of all that can slide.
//! These bounds hold in every posture. They say what cannot happen between two postures that were looked at.

use crate::joint_vector::JointVector;
use crate::robot_model::{Drive, Joint, Link};
use ratn_model::pose::Pose;

/// The joints between the root and a link.
#[derive(Debug, Clone)]
pub(crate) struct Chain {
    /// From the root: where each moving link's joint sits in the frame before it.
    pub(crate) joints: Vec<(Pose, Drive)>,
    /// The link in the frame of the last joint.
    pub(crate) tip: Pose,
}

impl Chain {
    /// To the link with this index; `place` says where a link sits in its parent's frame, and what moves it there.
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
    /// How far the end moves per radian (1 for what slides, per metre).
    length_m: f64,
}

impl Levers {
    /// Of joints, each at its place in the frame before it, and an end so far from the last.
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

    /// Those behind so many joints from the root.
    pub(crate) fn behind(&self, joints: usize) -> Levers {
        Levers(self.0[joints..].to_vec())
    }

    /// How far the end moves at the most per radian of each joint (per metre of one that slides), in metres.
    pub(crate) fn per_joint(&self, joints: usize) -> JointVector {
        let mut lengths = JointVector::zeros(joints);
        for Lever { drive, length_m } in &self.0 {
            lengths[drive.joint] += drive.factor.abs() * length_m;
        }
        lengths
    }

    /// How far the end moves at the most where no joint moves by more than so much, in metres.
    pub(crate) fn moves_m(&self, by: &JointVector) -> f64 {
        self.0.iter().map(|lever| lever.amount(by) * lever.length_m).sum()
    }

    /// How far it turns at the most, in radians.
    pub(crate) fn turns_rad(&self, by: &JointVector) -> f64 {
        self.0.iter().filter(|lever| !lever.drive.slides).map(|lever| lever.amount(by)).sum()
    }

    /// How much the end's velocity changes at the most, where joints of these speeds move by so much, in metres per second.
    pub(crate) fn swing_m(&self, by: &JointVector, speeds: &JointVector) -> f64 {
        // As below, for two different amounts.
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

    /// How far the end is at the most from the straight line between its two places, where the joints go straight from one posture to
    /// another that differs by so much, in metres: an eighth of the greatest second derivative.
    pub(crate) fn bend_m(&self, by: &JointVector) -> f64 {
        // ∂²p / ∂i ∂j with i before j is the axis of i times ∂p / ∂j, and nothing where i slides.
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
