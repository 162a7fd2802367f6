//! Candidates for the end of the free path: every posture at a goal from which the approach is free, with that approach.

use super::arm_in_scene::ArmInScene;
use super::contact::presses_m;
use super::error::{MAX_REASONS, PlanError};
use crate::collision::{Checker, Contact, distance, length};
use crate::joint_vector::JointVector;
use crate::pace::{Pace, Stop};
use crate::pressing::straight_collision;
use crate::reach::is_new;
use crate::refine::End;
use crate::request::Goal;
use crate::space::{State, state};
use ratn_model::pose::Pose;
use std::ops::Index;

/// Postures searched per goal pose, and attempts spent on it: at first, and once more if none was found.
const SOLUTIONS: [(usize, usize); 2] = [(6, 8), (40, 80)];

/// Number of postures taken from one attempt: the nearest ones.
const SOLUTIONS_PER_ATTEMPT: usize = 2;

/// Maximum number of candidates.
const MAX_CANDIDATES: usize = 64;

/// A posture at the goal, with the straight part that leads to it.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    /// The end of the free path.
    pub(super) door: State,
    /// From the door to the goal: a way in if the approach begins with little room, and the approach, which has at least one posture.
    pub(super) way_in: Option<JointVector>,
    pub(super) approach: Vec<JointVector>,
    /// Length of both, in radians.
    pub(super) length_rad: f64,
    /// Estimated duration of both, in seconds.
    lasts_s: f64,
}

impl Candidate {
    /// The posture at the goal.
    pub(super) fn goal(&self) -> JointVector {
        self.approach[self.approach.len() - 1]
    }

    pub(super) fn end(&self) -> End {
        End { state: self.door, rest: self.length_rad as f32, rest_s: self.lasts_s as f32 }
    }
}

/// Why a posture at a goal is no candidate.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
    /// The vector checks find no room at the start of this approach.
    #[error("there is too little room before the goal")]
    Crowded(Vec<JointVector>),
    /// A message for people.
    #[error("{0}")]
    Other(String),
}

/// The candidates of one request; their indices do not change.
pub(super) struct Candidates<'a> {
    /// Allowed penetration at the goal of an approach, in metres.
    press_m: f64,
    /// The checker for leaving a goal where the tool releases what it holds.
    leaving: Option<Checker<'a>>,
    found: Vec<Candidate>,
}

impl Index<usize> for Candidates<'_> {
    type Output = Candidate;

    fn index(&self, number: usize) -> &Candidate {
        &self.found[number]
    }
}

impl<'a> Candidates<'a> {
    /// Candidates that keep a distance from what they need not touch, or else those with the smallest penetration; the nearest to a posture first.
    pub(super) fn find(
        arm: &mut ArmInScene<'a>,
        near: &JointVector,
        pace: &mut Pace<'_>,
    ) -> Result<Candidates<'a>, PlanError> {
        let mut candidates = Candidates { press_m: 0.0, leaving: arm.with_open_fingers(), found: Vec::new() };
        let mut reasons: Vec<String> = Vec::new();
        for (wanted, attempts) in SOLUTIONS {
            let postures = goal_postures(arm, near, wanted, attempts, &mut reasons, pace)?;
            let mut refused = Vec::new();
            for press_m in presses_m(arm.robot()) {
                candidates.press_m = press_m;
                refused.clear();
                let mut crowded = Vec::new();
                for posture in &postures {
                    pace.poll()?;
                    match candidates.candidate(arm, posture) {
                        Ok(candidate) => candidates.found.push(candidate),
                        Err(Refusal::Crowded(approach)) => crowded.push(approach),
                        Err(Refusal::Other(reason)) => refused.push(reason),
                    }
                }
                let is_in_vain = candidates.found.is_empty();
                for approach in crowded {
                    // Only as a last resort: couples checked by meshes make the search slower.
                    let is_told_apart = is_in_vain && arm.tells_apart_at(&approach[0]);
                    let mended = if is_told_apart { with_door(arm, approach) } else { Err(Refusal::Crowded(approach)) };
                    match mended {
                        Ok(candidate) => candidates.found.push(candidate),
                        Err(refusal) => refused.push(refusal.to_string()),
                    }
                }
                if !candidates.found.is_empty() {
                    let cost = |c: &Candidate| distance(near, &arm.joints(&c.door)) + c.length_rad;
                    candidates.found.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
                    return Ok(candidates);
                }
            }
            reasons.append(&mut refused);
        }
        reasons.sort();
        reasons.dedup();
        reasons.truncate(MAX_REASONS);
        Err(PlanError::NoGoal { goals: arm.request().goals.len(), reasons })
    }

    /// The possible ends of the free path, by index.
    pub(super) fn doors(&self) -> Vec<State> {
        self.found.iter().map(|candidate| candidate.door).collect()
    }

    /// The doors with the length and duration of what follows.
    pub(super) fn ends(&self) -> Vec<End> {
        self.found.iter().map(Candidate::end).collect()
    }

    pub(super) fn is_full(&self) -> bool {
        self.found.len() >= MAX_CANDIDATES
    }

    pub(super) fn add(&mut self, candidate: Candidate) {
        self.found.push(candidate);
    }

    /// The candidate of a goal posture, or why there is none.
    pub(super) fn candidate(&mut self, arm: &mut ArmInScene<'a>, goal: &JointVector) -> Result<Candidate, Refusal> {
        let part = &arm.request().approach;
        let mut approach = vec![*goal];
        if part.is_some() {
            let back = arm.line_back(goal, part);
            approach =
                back.map_err(|e| Refusal::Other(format!("approaching the goal {part}, backwards from there: {e}")))?;
            if let Some(collision) = arm.straight_collision(&approach, self.press_m) {
                return Err(Refusal::Other(format!("approaching the goal, {collision}")));
            }
            let leaving = self.leaving.as_mut();
            if let Some(collision) = leaving.and_then(|open| straight_collision(open, &approach, self.press_m)) {
                return Err(Refusal::Other(format!("leaving the goal with open fingers, {collision}")));
            }
            approach.reverse();
        }
        match arm.collision(&approach[0], Contact::None) {
            Some(collision) if part.is_some() => Err(Refusal::Other(format!("before the approach, {collision}"))),
            Some(collision) => Err(Refusal::Other(format!("at the goal, {collision}"))),
            None => with_door(arm, approach),
        }
    }
}

/// Postures at the goals, and the reasons for goals without any.
fn goal_postures(
    arm: &mut ArmInScene<'_>,
    near: &JointVector,
    wanted: usize,
    attempts: usize,
    reasons: &mut Vec<String>,
    pace: &mut Pace<'_>,
) -> Result<Vec<JointVector>, Stop> {
    let mut postures = Vec::new();
    for goal in &arm.request().goals {
        match goal {
            Goal::Joints(posture) => postures.push(*posture),
            Goal::Pose(pose) => {
                let found = postures_at(arm, pose, near, wanted, attempts, pace)?;
                if found.is_empty() {
                    let [x, y, z] = pose.position;
                    reasons.push(format!("the arm does not reach ({x:.3}, {y:.3}, {z:.3})"));
                }
                postures.extend(found);
            }
        }
    }
    Ok(postures)
}

/// As [`Reach::solutions`](crate::reach::Reach::solutions), but asks the caller between attempts whether to go on.
fn postures_at(
    arm: &mut ArmInScene<'_>,
    pose: &Pose,
    near: &JointVector,
    wanted: usize,
    attempts: usize,
    pace: &mut Pace<'_>,
) -> Result<Vec<JointVector>, Stop> {
    let postures = arm.postures(pose);
    let mut found = Vec::new();
    for attempt in 0..attempts {
        pace.poll()?;
        for posture in arm.attempt(&postures, near, attempt).into_iter().take(SOLUTIONS_PER_ATTEMPT) {
            if found.len() < wanted && is_new(&found, &posture) {
                found.push(posture);
            }
        }
        if found.len() == wanted || postures.is_empty() {
            break;
        }
    }
    Ok(found)
}

fn with_door(arm: &mut ArmInScene<'_>, approach: Vec<JointVector>) -> Result<Candidate, Refusal> {
    let entry = approach[0];
    let Some(door) = arm.door(&entry) else { return Err(Refusal::Crowded(approach)) };
    arm.kept_at(&door).map_err(|reason| Refusal::Other(format!("at the goal {reason}")))?;
    arm.kept_along(&approach).map_err(|reason| Refusal::Other(format!("approaching the goal {reason}")))?;
    let way_in = (door != state(&entry)).then(|| arm.joints(&door));
    let length_rad = length(&approach) + way_in.map_or(0.0, |way_in| distance(&way_in, &entry));
    let way_in_s = way_in.map_or(0.0, |way_in| arm.lasts_s(&[state(&way_in), state(&entry)]));
    let lasts_s = way_in_s + arm.lasts_s(&approach.iter().map(|posture| state(posture)).collect::<Vec<_>>());
    Ok(Candidate { door, way_in, approach, length_rad, lasts_s })
}
