//! Motions whose tool moves in straight lines all the way, through way points: nothing is searched, so the result is this motion or an error.
//!
//! ```text
//! start ─ depart ─ straight ─ way point ─ straight ─ … ─ straight ─ approach ─ goal
//! ```
//!
//! Each posture is solved from the one before (`line`). Between the departure and the approach nothing may be touched. At sharp corners the arm
//! stops, unless they may be rounded. Of several goals the first reachable one is used.

use crate::collision::{Checker, Contact, length};
use crate::constrained::Constraint;
use crate::joint_vector::JointVector;
use crate::line::{Cause, Lines, Traced, trace};
use crate::pace::{Pace, Stop};
use crate::plan::{Goal, PlanError, Request};
use crate::pressing::straight_collision;
use crate::reach::Reach;
use crate::space::state;
use ratn_model::pose::Pose;
use ratn_world::scene::Scene;

/// Maximum number of way points of one motion.
pub const MAX_WAY_POINTS: usize = 256;

/// The largest `blend_m`, in metres.
pub const MAX_BLEND_M: f64 = 0.5;

/// Poses that the tool passes in straight lines on its way to the goal.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WayPoints {
    /// Poses of the tool in the world frame; if empty, straight to the goal.
    pub through: Vec<Pose>,
    /// How far from each of them the tool may deviate from the lines, so that it need not stop, in metres.
    pub blend_m: f64,
}

impl WayPoints {
    /// Refuses invalid values.
    pub(crate) fn check(&self, goals: &[Goal]) -> Result<(), PlanError> {
        let malformed = |what: &str, value: String, expected: String| {
            Err(PlanError::Malformed { what: what.to_owned(), value, expected })
        };
        if self.through.len() > MAX_WAY_POINTS {
            let expected = format!("at most {MAX_WAY_POINTS}");
            return malformed("the number of way points", self.through.len().to_string(), expected);
        }
        if !(0.0..=MAX_BLEND_M).contains(&self.blend_m) {
            return malformed("blend_m", self.blend_m.to_string(), format!("0 to {MAX_BLEND_M} m"));
        }
        let finite = |pose: &Pose| pose.position.iter().chain(&pose.quaternion_xyzw).all(|c| c.is_finite());
        if let Some(i) = self.through.iter().position(|pose| !finite(pose)) {
            return malformed(
                &format!("way point {}", i + 1),
                format!("{:?}", self.through[i]),
                "finite numbers".into(),
            );
        }
        if goals.iter().any(|goal| matches!(goal, Goal::Joints(_))) {
            let expected = "poses: which posture a straight line ends in cannot be chosen".to_owned();
            return malformed("a goal of a straight way", "joints".to_owned(), expected);
        }
        Ok(())
    }
}

/// The inputs for following and checking a straight motion.
pub(crate) struct Follower<'p, 'a> {
    pub(crate) scene: &'p Scene,
    /// The inverse kinematics of the tool, in the frame of the base, whose pose is `base`.
    pub(crate) reach: &'p Reach,
    pub(crate) base: Pose,
    pub(crate) checker: &'p mut Checker<'a>,
    /// Checks how the tool leaves a goal at which it releases an object.
    pub(crate) leaving: Option<&'p mut Checker<'a>>,
    pub(crate) constraint: Option<&'p Constraint>,
    /// Allowed depths of an approach in the object that it touches, in metres, in the order in which they are tried.
    pub(crate) presses_m: Vec<f64>,
}

/// A complete straight motion.
pub(crate) struct Followed {
    /// The postures from the end of the departure to the beginning of the approach.
    pub(crate) lines: Vec<JointVector>,
    /// The postures to the goal; at least one.
    pub(crate) approach: Vec<JointVector>,
}

impl Followed {
    /// The length in joint space.
    pub(crate) fn length_rad(&self) -> f64 {
        length(&self.lines) + length(&self.approach)
    }
}

impl Follower<'_, '_> {
    /// The motion from a posture to the first goal that the tool reaches in straight lines.
    pub(crate) fn follow(
        &mut self,
        start: &JointVector,
        request: &Request,
        way: &WayPoints,
        pace: &mut Pace<'_>,
    ) -> Result<Followed, PlanError> {
        let mut reasons = Vec::new();
        for goal in &request.goals {
            // Other kinds of goals have been refused.
            let Goal::Pose(goal) = goal else { continue };
            match self.to(start, &self.base.inverse().compose(goal), request, way, pace)? {
                Ok(followed) => return Ok(followed),
                Err(reason) => reasons.push(reason),
            }
        }
        Err(PlanError::no_straight_way(reasons))
    }

    fn to(
        &mut self,
        start: &JointVector,
        goal: &Pose,
        request: &Request,
        way: &WayPoints,
        pace: &mut Pace<'_>,
    ) -> Result<Result<Followed, String>, Stop> {
        let offset = request.approach.way(self.scene, &self.base, goal).unwrap_or_default();
        let entry = Pose { position: std::array::from_fn(|i| goal.position[i] - offset[i]), ..*goal };
        let mut poses: Vec<Pose> = way.through.iter().map(|pose| self.base.inverse().compose(pose)).collect();
        poses.push(entry);
        let lines = Lines::new(self.reach.pose(start), &poses, way.blend_m);
        let (checker, constraint) = (&mut *self.checker, self.constraint);
        let is_free = &mut |from: &JointVector, to: &JointVector| free(checker, constraint, from, to);
        let traced = trace(self.reach, &lines, start, is_free, &mut || pace.answer())?;
        if let Some(cause) = &traced.ended {
            return Ok(Err(said(&traced, way, cause)));
        }
        let lines: Vec<JointVector> = traced.postures.clone();
        let last = traced.postures[traced.postures.len() - 1];
        if !request.approach.is_some() {
            return Ok(Ok(Followed { approach: vec![last], lines }));
        }
        let lines_in = Lines::new(entry, &[*goal], 0.0);
        // What is pressed at the goal is determined afterwards, along the resulting approach; deeper than the largest one is not allowed.
        let contact = Contact::Gripper(self.presses_m.last().copied().unwrap_or_default());
        let (checker, mut leaving) = (&mut *self.checker, self.leaving.as_deref_mut());
        let is_free = &mut |from: &JointVector, to: &JointVector| {
            let closed = checker.edge_collision(from, to, contact);
            let mut open = || leaving.as_mut().and_then(|leaving| leaving.edge_collision(from, to, contact));
            let collision = closed
                .map(|closed| closed.to_string())
                .or_else(|| open().map(|collision| format!("leaving the goal with open fingers, {collision}")));
            collision.map_or(Ok(()), Err)
        };
        let traced = trace(self.reach, &lines_in, &last, is_free, &mut || pace.answer())?;
        let approach: Vec<JointVector> = traced.postures.clone();
        let reason = match &traced.ended {
            Some(cause) => Some(cause.to_string()),
            None => self.pressed(&approach).or_else(|| self.broken(&approach)),
        };
        Ok(match reason {
            Some(reason) => Err(format!("approaching the goal {}: {reason}", request.approach)),
            None => Ok(Followed { lines, approach }),
        })
    }

    /// How an approach violates the constraint on the tool, if it does.
    fn broken(&self, approach: &[JointVector]) -> Option<String> {
        let constraint = self.constraint?;
        let breaks = |pair: &&[JointVector]| !constraint.holds_along(&state(&pair[0]), &state(&pair[1]));
        approach.windows(2).find(breaks).map(|pair| constraint.breach(&state(&pair[1])))
    }

    /// Tries the allowed depths in order; returns the collision of the approach if it is free at none of them.
    fn pressed(&mut self, approach: &[JointVector]) -> Option<String> {
        let back: Vec<JointVector> = approach.iter().rev().copied().collect();
        let mut reason = None;
        for press_m in &self.presses_m {
            let closed = straight_collision(self.checker, &back, *press_m).map(|c| c.to_string());
            let open = self.leaving.as_deref_mut().and_then(|open| straight_collision(open, &back, *press_m));
            reason = closed.or(open.map(|collision| format!("leaving the goal with open fingers, {collision}")));
            if reason.is_none() {
                break;
            }
        }
        reason
    }
}

/// What blocks a straight motion of the joints.
fn free(
    checker: &mut Checker<'_>,
    constraint: Option<&Constraint>,
    from: &JointVector,
    to: &JointVector,
) -> Result<(), String> {
    if let Some(collision) = checker.edge_collision(from, to, Contact::None) {
        return Err(collision.to_string());
    }
    match constraint.filter(|constraint| !constraint.holds_along(&state(from), &state(to))) {
        Some(constraint) => Err(constraint.breach(&state(to))),
        None => Ok(()),
    }
}

/// The error message: how far the tool gets, and the cause.
fn said(traced: &Traced, way: &WayPoints, cause: &Cause) -> String {
    let (reached_m, wanted_m) = (traced.along_m[traced.along_m.len() - 1], traced.wanted_m);
    let whither = match traced.whither < way.through.len() {
        true => format!("way point {} of {}", traced.whither + 1, way.through.len()),
        false => "the goal".to_owned(),
    };
    format!("the tool can go straight for {reached_m:.3} m of {wanted_m:.3} m, on the way to {whither}: {cause}")
}
