//! Motions whose tool goes in straight lines all the way, through way points: nothing is searched, so it is that way or an error.
//!
//! ```text
//! start ─ depart ─ straight ─ way point ─ straight ─ … ─ straight ─ approach ─ goal
//! ```
//!
//! The arm follows from posture to posture (`line`). Between the departure and the approach nothing touches anything. Where the way bends
//! sharply the arm stops, unless the corners may be rounded. Of several goals the first is taken that the tool gets to.

use crate::collision::{Checker, Contact, length};
use crate::constrained::Constraint;
use crate::joint_vector::JointVector;
use crate::line::{Cause, Lines, Traced, trace};
use crate::pace::{Pace, Stop};
use crate::plan::{Goal, PlanError, Request, straight_collision};
use crate::reach::Reach;
use crate::space::state;
use ratn_model::pose::Pose;
use ratn_world::scene::Scene;

/// The most way points of one motion.
pub const MAX_WAY_POINTS: usize = 256;

/// The largest `blend_m`, in metres.
pub const MAX_BLEND_M: f64 = 0.5;

/// Poses that the tool passes in straight lines on its way to the goal.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WayPoints {
    /// Of the tool in the world frame; none: straight to the goal.
    pub through: Vec<Pose>,
    /// How far from each of them the tool may leave the lines, so that it need not stop, in metres.
    pub blend_m: f64,
}

impl WayPoints {
    /// Refuses what makes no sense.
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

/// What a straight way is followed and checked with.
pub(crate) struct Follower<'p, 'a> {
    pub(crate) scene: &'p Scene,
    /// The tool, in the frame of the base, which is at `base`.
    pub(crate) reach: &'p Reach,
    pub(crate) base: Pose,
    pub(crate) checker: &'p mut Checker<'a>,
    /// How the tool leaves a goal where it lets go.
    pub(crate) leaving: Option<&'p mut Checker<'a>>,
    pub(crate) constraint: Option<&'p Constraint>,
    /// How deep an approach may press into what it touches, in the order in which it is tried.
    pub(crate) presses_m: Vec<f64>,
}

/// A way that was followed to its end.
pub(crate) struct Followed {
    /// From the end of the departure to the beginning of the approach.
    pub(crate) lines: Vec<JointVector>,
    /// To the goal; at least one posture.
    pub(crate) approach: Vec<JointVector>,
}

impl Followed {
    /// In joint space.
    pub(crate) fn length_rad(&self) -> f64 {
        length(&self.lines) + length(&self.approach)
    }
}

impl Follower<'_, '_> {
    /// From a posture to the first goal that the tool gets to in straight lines.
    pub(crate) fn follow(
        &mut self,
        start: &JointVector,
        request: &Request,
        way: &WayPoints,
        pace: &mut Pace<'_>,
    ) -> Result<Followed, PlanError> {
        let mut reasons = Vec::new();
        for goal in &request.goals {
            // Others have been refused.
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
        // What presses least is looked for along the way that is found; one that presses too deep is none.
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

    /// What the tool does not keep on an approach.
    fn broken(&self, approach: &[JointVector]) -> Option<String> {
        let constraint = self.constraint?;
        let breaks = |pair: &&[JointVector]| !constraint.holds_along(&state(&pair[0]), &state(&pair[1]));
        approach.windows(2).find(breaks).map(|pair| constraint.breach(&state(&pair[1])))
    }

    /// What is in the way of an approach that presses as little as it can.
    fn pressed(&mut self, approach: &[JointVector]) -> Option<String> {
        let mut reason = None;
        for press_m in &self.presses_m {
            let closed = straight_collision(self.checker, approach, *press_m).map(|c| c.to_string());
            let open = self.leaving.as_deref_mut().and_then(|open| straight_collision(open, approach, *press_m));
            reason = closed.or(open.map(|collision| format!("leaving the goal with open fingers, {collision}")));
            if reason.is_none() {
                break;
            }
        }
        reason
    }
}

/// What is in the way of a straight motion of the joints.
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

/// How far the tool gets, and why no further.
fn said(traced: &Traced, way: &WayPoints, cause: &Cause) -> String {
    let (reached_m, wanted_m) = (traced.along_m[traced.along_m.len() - 1], traced.wanted_m);
    let whither = match traced.whither < way.through.len() {
        true => format!("way point {} of {}", traced.whither + 1, way.through.len()),
        false => "the goal".to_owned(),
    };
    format!("the tool can go straight for {reached_m:.3} m of {wanted_m:.3} m, on the way to {whither}: {cause}")
}
