//! Continuous joints: the posture is the same after a whole turn, so the shortest way to it is used.
//!
//! A search needs limits. For the search the turns are counted differently: the start is moved by whole turns to be near zero, where floating-point
//! numbers are most exact, and the goals to be near the start; each goal is also offered with joints that go the other way round, in case the short ways are blocked.
//! Results are converted back. So a path begins at the problem's start, and may end whole turns from the given goal.

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

/// Errors for positions of continuous joints; each begins with `which`, the end of the problem that they belong to.
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

/// A joint with limits, for a search.
fn bounded(joint: &Joint, lower: f64, upper: f64) -> Joint {
    Joint { lower, upper, endless: false, ..joint.clone() }
}

/// Maximum number of goals for one posture of continuous joints, unless it has that many such joints.
const WAYS: usize = 16;

/// For each goal that is offered, the joints that go the other way round to it, and their positions there. The goals are in the order of how much
/// longer their ways are; the first is the nearest one, with no such joint.
fn ways_round(endless: &[usize], start: &[f64], nearest: &[f64]) -> Vec<Vec<(usize, f64)>> {
    let mut ways: Vec<(f64, Vec<(usize, f64)>)> = vec![(0.0, Vec::new())];
    for &j in endless {
        let way = nearest[j] - start[j];
        let (longer, position) = (TAU - 2.0 * way.abs(), start[j] + around(way));
        let also = ways.iter().map(|(far, ways)| (far + longer, [&ways[..], &[(j, position)]].concat()));
        let also: Vec<_> = also.collect();
        ways.extend(also);
        ways.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        // The nearest one, and those on which one joint alone goes round, always stay.
        let (more, mut kept) = (WAYS.saturating_sub(1 + endless.len()), 0);
        ways.retain(|(_, ways)| {
            let is_always = ways.len() < 2;
            kept += usize::from(!is_always);
            is_always || kept <= more
        });
    }
    ways.into_iter().map(|(_, ways)| ways).collect()
}

/// The displacement to the same position the other way round.
fn around(way: f64) -> f64 {
    if way > 0.0 { way - TAU } else { way + TAU }
}

/// A problem in which joints turn the short way.
#[derive(Debug, Clone)]
pub(crate) struct Unwound {
    /// The robot with joint limits around the ends of the problem.
    pub(crate) mechanism: Mechanism,
    pub(crate) start: Vec<f64>,
    /// The goals by how far it is to them, the nearest first.
    pub(crate) goals: Vec<Vec<f64>>,
    /// How far each joint was turned back, in radians.
    turned: Vec<f64>,
}

/// The problem from a start to a goal; unchanged without continuous joints.
pub(crate) fn unwound(mechanism: &Mechanism, start: &[f64], goal: &[f64]) -> Unwound {
    let mut unwound = Unwound {
        mechanism: mechanism.clone(),
        start: start.to_vec(),
        goals: Vec::new(),
        turned: vec![0.0; start.len()],
    };
    let (mut nearest, mut endless) = (goal.to_vec(), Vec::new());
    for (j, joint) in mechanism.joints.iter().enumerate().filter(|(_, joint)| joint.endless) {
        let (Some(&from), Some(&to)) = (start.get(j), goal.get(j)) else { continue };
        if !(from.is_finite() && to.is_finite()) {
            continue;
        }
        let (near, way) = (wrapped(from), wrapped(to - from));
        let around = around(way);
        (unwound.start[j], unwound.turned[j]) = (near, from - near);
        nearest[j] = near + way;
        endless.push(j);
        unwound.mechanism.joints[j] = bounded(joint, near + way.min(around) - BESIDE, near + way.max(around) + BESIDE);
    }
    unwound.goals = ways_round(&endless, &unwound.start, &nearest)
        .into_iter()
        .map(|ways| {
            let mut goal = nearest.clone();
            ways.into_iter().for_each(|(j, position)| goal[j] = position);
            goal
        })
        .collect();
    unwound
}

impl Unwound {
    /// A posture with the problem's count of turns.
    pub(crate) fn wound(&self, posture: &[f64]) -> Vec<f64> {
        posture.iter().zip(&self.turned).map(|(q, turned)| q + turned).collect()
    }
}

/// A robot whose arm has joint limits: one motion turns each joint by at most a turn, in either direction.
#[derive(Debug, Clone)]
pub(crate) struct WithEnds {
    pub(crate) robot: Robot,
    /// The arm's start posture in this robot.
    pub(crate) start: JointVector,
    /// How far each joint was turned back, in radians.
    turned: JointVector,
    /// The continuous joints.
    endless: Vec<usize>,
}

impl WithEnds {
    /// For motions from a posture; `None` for an arm without continuous joints.
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

    /// The request with this robot's count of turns.
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

    /// The goal postures for a posture, by how far it is to them, the nearest first.
    fn ways_to(&self, posture: &JointVector) -> impl Iterator<Item = JointVector> {
        let mut nearest = *posture;
        for &j in &self.endless {
            nearest[j] = self.start[j] + wrapped(posture[j] - self.start[j]);
        }
        ways_round(&self.endless, &self.start, &nearest).into_iter().map(move |ways| {
            let mut goal = nearest;
            ways.into_iter().for_each(|(j, position)| goal[j] = position);
            goal
        })
    }

    /// A motion with the arm's own count of turns.
    pub(crate) fn wound(&self, mut plan: Plan) -> Plan {
        let wind = |positions: &mut [f64]| positions.iter_mut().zip(&self.turned).for_each(|(q, turned)| *q += turned);
        plan.trajectory.points.iter_mut().for_each(|point| wind(&mut point.positions));
        wind(&mut plan.end);
        plan
    }
}
