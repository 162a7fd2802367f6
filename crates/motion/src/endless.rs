//! Joints that turn without end: the same posture a whole turn later, so the way to it is the short one.
//!
//! A search needs a range. It has one in which the joint counts its turns otherwise: the start is turned back by whole turns to be near zero, where
//! numbers are the most exact, and the goals to be near the start; a goal is also taken the other way round, for where the short way is blocked.
//! What is found is counted as before again. So a path begins where the problem does, and may end whole turns from the goal that was given.

use crate::drive::wrapped;
use crate::joint_vector::JointVector;
use crate::mechanism::Mechanism;
use crate::plan::Plan;
use crate::request::{Goal, Request};
use crate::robot::{Joint, Robot};
use crate::robot_model::MOST_TURNS;
use std::f64::consts::TAU;

/// How far beyond the ends of a path a joint may turn, in radians.
const BESIDE: f64 = TAU / 4.0;

/// What is wrong with positions of joints that turn without end; `which` of the problem's ends they are begins each line.
pub(crate) fn wound_too_far(mechanism: &Mechanism, positions: &[f64], which: &str) -> Vec<String> {
    let joints = mechanism.joints.iter().zip(positions);
    let far = joints.filter(|(joint, position)| joint.endless && !joint.allows(**position, 0.0));
    far.map(|(joint, position)| {
        format!(
            "{which}: {} is at {position:e} rad, {:.0} turns from zero: at most {MOST_TURNS} are taken; give the same posture within a turn",
            joint.name,
            (position / TAU).abs()
        )
    })
    .collect()
}

/// A joint with ends, for a search.
fn bounded(joint: &Joint, lower: f64, upper: f64) -> Joint {
    Joint { lower, upper, endless: false, ..joint.clone() }
}

/// A way to a goal the other way round.
fn around(way: f64) -> f64 {
    if way > 0.0 { way - TAU } else { way + TAU }
}

/// A problem in which joints turn the short way.
#[derive(Debug, Clone)]
pub(crate) struct Unwound {
    /// The robot with ranges about the ends of the problem.
    pub(crate) mechanism: Mechanism,
    pub(crate) start: Vec<f64>,
    /// The nearest first; each of the others has one joint go the other way round.
    pub(crate) goals: Vec<Vec<f64>>,
    /// By how much each joint was turned back.
    turned: Vec<f64>,
}

/// The problem from a start to a goal; as it is where no joint turns without end.
pub(crate) fn unwound(mechanism: &Mechanism, start: &[f64], goal: &[f64]) -> Unwound {
    let mut unwound = Unwound {
        mechanism: mechanism.clone(),
        start: start.to_vec(),
        goals: vec![goal.to_vec()],
        turned: vec![0.0; start.len()],
    };
    for (j, joint) in mechanism.joints.iter().enumerate().filter(|(_, joint)| joint.endless) {
        let (Some(&from), Some(&to)) = (start.get(j), goal.get(j)) else { continue };
        if !(from.is_finite() && to.is_finite()) {
            continue;
        }
        let (near, way) = (wrapped(from), wrapped(to - from));
        let around = around(way);
        (unwound.start[j], unwound.turned[j]) = (near, from - near);
        unwound.goals.iter_mut().for_each(|goal| goal[j] = near + way);
        let mut other = unwound.goals[0].clone();
        other[j] = near + around;
        unwound.goals.push(other);
        unwound.mechanism.joints[j] = bounded(joint, near + way.min(around) - BESIDE, near + way.max(around) + BESIDE);
    }
    unwound
}

impl Unwound {
    /// A posture as the problem counts turns.
    pub(crate) fn wound(&self, posture: &[f64]) -> Vec<f64> {
        posture.iter().zip(&self.turned).map(|(q, turned)| q + turned).collect()
    }
}

/// A robot whose arm has ends: one motion turns each joint by a turn at the most, to either side.
#[derive(Debug, Clone)]
pub(crate) struct WithEnds {
    pub(crate) robot: Robot,
    /// Where the arm is there.
    pub(crate) start: JointVector,
    /// By how much each joint was turned back.
    turned: JointVector,
    /// Which joints have no ends really.
    endless: Vec<usize>,
}

impl WithEnds {
    /// For motions from a posture; of an arm none of whose joints turns without end there is none, because it is what it is.
    pub(crate) fn about(robot: &Robot, start: &JointVector) -> Option<WithEnds> {
        let joints = robot.arm_joints();
        let endless: Vec<usize> = (0..joints.len()).filter(|j| joints[*j].endless).collect();
        if endless.is_empty() {
            return None;
        }
        let near = JointVector::from_fn(joints.len(), |j| joints[j].counted_from(0.0, start[j]));
        let turned = JointVector::from_fn(joints.len(), |j| start[j] - near[j]);
        let joints = joints
            .iter()
            .zip(&near)
            .map(|(joint, near)| if joint.endless { bounded(joint, near - TAU, near + TAU) } else { joint.clone() });
        let robot = robot.with_arm_joints(joints.collect());
        Some(WithEnds { robot, start: near, turned, endless })
    }

    /// What is asked for, as this robot counts.
    pub(crate) fn request(&self, request: &Request) -> Request {
        let mut asked = Request { goals: Vec::new(), ..request.clone() };
        asked.start.arm = self.start;
        for goal in &request.goals {
            match goal {
                Goal::Pose(_) => asked.goals.push(*goal),
                Goal::Joints(posture) => asked.goals.extend(self.ways_to(posture).map(Goal::Joints)),
            }
        }
        asked
    }

    /// A posture, the nearest way first; on each of the other ways one joint goes the other way round.
    fn ways_to(&self, posture: &JointVector) -> impl Iterator<Item = JointVector> {
        let mut nearest = *posture;
        for &j in &self.endless {
            nearest[j] = self.start[j] + wrapped(posture[j] - self.start[j]);
        }
        let other = move |j: &usize| {
            let mut other = nearest;
            other[*j] = self.start[*j] + around(nearest[*j] - self.start[*j]);
            other
        };
        std::iter::once(nearest).chain(self.endless.iter().map(other))
    }

    /// A motion as the arm itself counts its turns.
    pub(crate) fn wound(&self, mut plan: Plan) -> Plan {
        let wind = |positions: &mut [f64]| positions.iter_mut().zip(&self.turned).for_each(|(q, turned)| *q += turned);
        plan.trajectory.points.iter_mut().for_each(|point| wind(&mut point.positions));
        wind(&mut plan.end);
        plan
    }
}
