//! Joints that turn without end: the same posture a whole turn later, so the way to it is the short one.
//!
//! Planning needs a range. The ends of a problem are turned back by whole turns to be near each other, and the range of the joint is put about
//! them; the goal is also taken the other way round, for where the short way is blocked. A path begins where the problem does, and may end whole
//! turns from the goal that was given.

use crate::drive::wrapped;
use crate::mechanism::Mechanism;
use std::f64::consts::TAU;

/// How far beyond the ends of a path a joint may turn, in radians.
const BESIDE: f64 = TAU / 4.0;

/// How many turns from zero a position may be. Beyond, positions lose the digits that a path needs.
const MOST_TURNS: f64 = 1e4;

/// What is wrong with positions of joints that turn without end; `which` of the problem's ends they are begins each line.
pub(crate) fn wound_too_far(mechanism: &Mechanism, positions: &[f64], which: &str) -> Vec<String> {
    let joints = mechanism.joints.iter().zip(&mechanism.endless).zip(positions);
    let far = joints.filter(|((_, endless), position)| **endless && position.abs() > MOST_TURNS * TAU);
    far.map(|((joint, _), position)| {
        format!(
            "{which}: {} is at {position:e} rad, {:.0} turns from zero: at most {MOST_TURNS} are taken; give the same posture within a turn",
            joint.name,
            (position / TAU).abs()
        )
    })
    .collect()
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
    for (j, _) in mechanism.endless.iter().enumerate().filter(|(_, endless)| **endless) {
        let (Some(&from), Some(&to)) = (start.get(j), goal.get(j)) else { continue };
        if !(from.is_finite() && to.is_finite()) {
            continue;
        }
        // Near zero numbers are the most exact.
        let (near, way) = (wrapped(from), wrapped(to - from));
        let around = if way > 0.0 { way - TAU } else { way + TAU };
        (unwound.start[j], unwound.turned[j]) = (near, from - near);
        unwound.goals.iter_mut().for_each(|goal| goal[j] = near + way);
        let mut other = unwound.goals[0].clone();
        other[j] = near + around;
        unwound.goals.push(other);
        let joint = &mut unwound.mechanism.joints[j];
        (joint.lower, joint.upper) = (near + way.min(around) - BESIDE, near + way.max(around) + BESIDE);
    }
    unwound
}

impl Unwound {
    /// A posture as the problem counts turns.
    pub(crate) fn wound(&self, posture: &[f64]) -> Vec<f64> {
        posture.iter().zip(&self.turned).map(|(q, turned)| q + turned).collect()
    }
}
