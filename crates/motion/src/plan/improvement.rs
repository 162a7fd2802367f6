//! Anytime improvement of the motion: other free paths and other candidates, compared by an estimate of their duration, and adopted if the whole
//! motion, timed exactly, is quicker.

use super::Plan;
use super::arm_in_scene::ArmInScene;
use super::candidates::{Candidate, Candidates};
use super::error::PlanError;
use crate::collision::length;
use crate::joint_vector::JointVector;
use crate::pace::{BETTER, Control, Pace, Progress, Stop};
use crate::refine::{End, Refinement};
use crate::request::Goal;
use crate::simplify::path_length;
use crate::space::{State, state};
use crate::timing::Section;
use crate::trajectory::Curve;
use rand::RngExt;
use ratn_model::pose::Pose;
use std::ops::Range;

/// Percentage of improvement steps that look for a new candidate.
const NEW_CANDIDATES: i32 = 8;

/// A quicker path is reported only if it gains at least this, in seconds.
const LEAST_REPORT_S: f32 = 1e-3;

/// The motion is timed exactly after this many steps of improvement, and again whenever their number has grown fourfold.
const FIRST_TIMED: usize = 64;
const TIMED_AGAIN: usize = 4;

/// Maximum share of a straight part that a blend may take, at the end that joins the free path.
const BLENDED_SHARE: f64 = 0.5;

/// Another goal posture is searched near a posture that is off the current path by at most this, in radians per joint.
const ASIDE_RAD: f64 = 0.5;

/// A free path from the door at the start to that of a candidate.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Way {
    pub(super) path: Vec<State>,
    pub(super) candidate: usize,
}

/// A way, and the timed motion along it.
pub(super) struct Motion {
    pub(super) way: Way,
    pub(super) curve: Curve,
}

/// What is fixed before the improvement begins.
pub(super) struct Before<'p> {
    /// The straight part at the start.
    pub(super) depart: &'p [JointVector],
    /// Length of the straight part with the way to the door.
    pub(super) length_rad: f64,
    /// Length of the first path, straight parts included.
    pub(super) first_length_rad: f64,
}

/// The state of the improvement.
pub(super) struct Improvement<'p, 'a> {
    arm: &'p mut ArmInScene<'a>,
    candidates: &'p mut Candidates<'a>,
    before: Before<'p>,
    first_duration_s: f64,
    /// Duration of the motion reported last as usable.
    usable_s: Option<f64>,
}

impl<'p, 'a> Improvement<'p, 'a> {
    pub(super) fn new(
        arm: &'p mut ArmInScene<'a>,
        candidates: &'p mut Candidates<'a>,
        before: Before<'p>,
    ) -> Improvement<'p, 'a> {
        Improvement { arm, candidates, before, first_duration_s: 0.0, usable_s: None }
    }

    /// Returns the quickest motion found, or else the one along the first path. The timing is done in any case, even if time is up.
    pub(super) fn run(mut self, first: Way, pace: &mut Pace<'_>) -> Result<Plan, PlanError> {
        let mut shorter = first.clone();
        let reported = pace.report(Progress::FirstPath { length_rad: self.before.first_length_rad });
        let shortened = reported.and_then(|()| self.arm.shorten(&mut shorter.path, pace));
        if shortened == Err(Stop::Cancelled) {
            return Err(PlanError::Cancelled);
        }
        let mut stopped = shortened.err();
        let timed = self.motion(shorter, &mut not_cancelled(pace));
        let Ok(mut motion) = timed else {
            // A shortened path whose timing would violate the constraint on the tool cannot be improved.
            let motion = self.motion(first, &mut not_cancelled(pace))?;
            self.first_duration_s = motion.curve.duration_s();
            return self.finished(&motion, stopped, pace);
        };
        self.first_duration_s = motion.curve.duration_s();
        if stopped.is_none() {
            stopped = self.refine(&mut motion, pace).err();
        }
        self.finished(&motion, stopped, pace)
    }

    fn finished(&self, motion: &Motion, stopped: Option<Stop>, pace: &mut Pace<'_>) -> Result<Plan, PlanError> {
        if stopped == Some(Stop::Cancelled) || pace.answer() == Control::Cancelled {
            return Err(PlanError::Cancelled);
        }
        Ok(Plan { time_up: stopped.is_some(), ..self.plan(motion, pace.iterations) })
    }

    fn plan(&self, Motion { way, curve }: &Motion, iterations: usize) -> Plan {
        let candidate = &self.candidates[way.candidate];
        let end = candidate.goal();
        Plan {
            trajectory: curve.named(self.arm.robot().arm_joints()),
            end,
            end_pose: self.arm.tool_pose(&end),
            first_length_rad: self.before.first_length_rad,
            length_rad: self.before.length_rad + f64::from(path_length(&way.path)) + candidate.length_rad,
            first_duration_s: self.first_duration_s,
            iterations,
            time_up: true,
        }
    }

    /// Does the requested number of improvement steps, and times the result now and then.
    fn refine(&mut self, best: &mut Motion, pace: &mut Pace<'_>) -> Result<(), Stop> {
        let Way { path, candidate } = best.way.clone();
        let mut refinement = self.arm.refinement(path, candidate, self.candidates.ends());
        let mut steps = 0..self.arm.request().improvement_iterations;
        let mut stopped = self.steps(&mut steps, &mut refinement, best, pace);
        if stopped != Err(Stop::Cancelled) {
            self.time_if_new(&refinement, best, &mut not_cancelled(pace));
        }
        if stopped.is_ok() && pace.is_settled() {
            stopped = self.refine_usable(&mut steps, best, pace);
        }
        stopped
    }

    /// Steps until all are done, or the caller has settled for the current motion.
    fn steps(
        &mut self,
        steps: &mut Range<usize>,
        refinement: &mut Refinement,
        best: &mut Motion,
        pace: &mut Pace<'_>,
    ) -> Result<(), Stop> {
        let (mut reported, mut timed_at) = (refinement.cost(), FIRST_TIMED);
        pace.report(Progress::Quicker { about_s: f64::from(reported) })?;
        for step in steps {
            pace.iteration()?;
            if pace.is_settled() {
                return Ok(());
            }
            if self.arm.random().random_range(0..100) < NEW_CANDIDATES {
                self.find_another(refinement);
            } else {
                self.arm.step(refinement, pace)?;
            }
            let about_s = refinement.cost();
            if about_s < reported - LEAST_REPORT_S {
                reported = about_s;
                pace.report(Progress::Quicker { about_s: f64::from(about_s) })?;
            }
            if step + 1 == timed_at {
                timed_at = timed_at.saturating_mul(TIMED_AGAIN);
                self.time_if_new(refinement, best, &mut || pace.answer() == Control::Continue);
            }
        }
        Ok(())
    }

    /// The caller already uses the best motion, including its end: the remaining steps make only the way to that end quicker.
    fn refine_usable(&mut self, steps: &mut Range<usize>, best: &mut Motion, pace: &mut Pace<'_>) -> Result<(), Stop> {
        self.report_usable(best, pace)?;
        // Only the end of this candidate, so its index is 0.
        let Way { path, candidate } = best.way.clone();
        let mut refinement = self.arm.refinement(path, 0, vec![self.candidates[candidate].end()]);
        let mut timed_s = refinement.cost();
        for _ in steps {
            pace.iteration()?;
            self.arm.step(&mut refinement, pace)?;
            // Timed only if the result may be worth a report, because timing takes longer than many steps.
            if refinement.cost() < timed_s * (1.0 - BETTER as f32) {
                timed_s = refinement.cost();
                let way = Way { path: refinement.path().to_vec(), candidate };
                self.take_if_quicker(way, best, &mut || pace.answer() == Control::Continue);
                self.report_usable(best, pace)?;
            }
        }
        let way = Way { path: refinement.path().to_vec(), candidate };
        self.take_if_quicker(way, best, &mut not_cancelled(pace));
        Ok(())
    }

    /// Reports the first usable motion, and later ones that are noticeably quicker.
    fn report_usable(&mut self, best: &Motion, pace: &mut Pace<'_>) -> Result<(), Stop> {
        let lasts_s = best.curve.duration_s();
        if self.usable_s.is_some_and(|usable_s| lasts_s > usable_s * (1.0 - BETTER)) {
            return Ok(());
        }
        self.usable_s = Some(lasts_s);
        let plan = self.plan(best, pace.iterations);
        pace.report(Progress::Usable(&plan))
    }

    /// Times the path of a refinement, and adopts it if the motion is quicker: never a slower one, whatever the estimate says.
    fn time_if_new(&mut self, refinement: &Refinement, best: &mut Motion, goes_on: &mut dyn FnMut() -> bool) {
        let way = Way { path: refinement.path().to_vec(), candidate: refinement.end() };
        self.take_if_quicker(way, best, goes_on);
    }

    fn take_if_quicker(&mut self, way: Way, best: &mut Motion, goes_on: &mut dyn FnMut() -> bool) {
        if way == best.way {
            return;
        }
        match self.motion(way, goes_on) {
            Ok(motion) if motion.curve.duration_s() < best.curve.duration_s() => *best = motion,
            _ => {}
        }
    }

    /// The whole motion along a way, as quick as the limits allow.
    fn motion(&mut self, way: Way, goes_on: &mut dyn FnMut() -> bool) -> Result<Motion, PlanError> {
        let chosen = &self.candidates[way.candidate];
        let backwards: Vec<JointVector> = chosen.approach.iter().rev().copied().collect();
        let [after, before] = [self.before.depart, backwards.as_slice()].map(|straight| {
            let tools: Vec<Pose> = straight.iter().map(|posture| self.arm.tool_from_base(posture)).collect();
            blended_share(straight, &tools)
        });
        let sections = [
            Section::Loose(self.before.depart.to_vec(), [0.0, after]),
            Section::Blended(self.whole(&way.path, chosen)),
            Section::Loose(chosen.approach.clone(), [before, 0.0]),
        ];
        let curve = self.arm.timed(&sections, goes_on)?;
        Ok(Motion { way, curve })
    }

    /// The free path with its ways out and in, from the end of the departure to the start of the approach.
    fn whole(&self, path: &[State], candidate: &Candidate) -> Vec<JointVector> {
        let start = self.before.depart[self.before.depart.len() - 1];
        let mut whole: Vec<JointVector> = path.iter().map(|s| self.arm.joints(s)).collect();
        if path[0] == state(&start) {
            whole[0] = start;
        } else {
            whole.insert(0, start);
        }
        let entry = candidate.approach[0];
        match candidate.way_in {
            None if whole.len() > 1 => whole.last_mut().into_iter().for_each(|last| *last = entry),
            _ => whole.push(entry),
        }
        whole
    }

    /// Looks for a goal posture that a quicker path could lead to.
    fn find_another(&mut self, refinement: &mut Refinement) {
        let goals = &self.arm.request().goals;
        let Goal::Pose(pose) = &goals[self.arm.random().random_range(0..goals.len())] else { return };
        if self.candidates.is_full() {
            return;
        }
        let along = self.arm.random().random_range(0.0..=1.0) * path_length(refinement.path());
        let near = self.arm.joints(&refinement.point(along).0);
        let seed = near.map(|q| q + self.arm.random().random_range(-ASIDE_RAD..ASIDE_RAD));
        let Some(posture) = self.arm.nearest(&self.arm.postures(pose), &seed) else { return };
        // The posture itself is no end of the path, but the end cannot be much nearer.
        if !refinement.is_promising(&End { state: state(&posture), rest: 0.0, rest_s: 0.0 }) {
            return;
        }
        let Ok(candidate) = self.candidates.candidate(self.arm, &posture) else { return };
        if refinement.is_promising(&candidate.end()) {
            refinement.add(candidate.end());
            self.candidates.add(candidate);
        }
    }
}

/// Share of the joint motion along a straight part, at its far end, that is beyond what the tool has to follow; at most [`BLENDED_SHARE`]. `tools`
/// has the tool's pose at each posture.
fn blended_share(postures: &[JointVector], tools: &[Pose]) -> f64 {
    let [first, .., last] = tools else { return BLENDED_SHARE };
    let followed_m = (1.0 - BLENDED_SHARE) * first.distance(last);
    let beyond = tools.iter().position(|tool| tool.distance(first) >= followed_m).unwrap_or(tools.len() - 1);
    (length(&postures[beyond..]) / length(postures)).min(BLENDED_SHARE)
}

fn not_cancelled<'p>(pace: &'p mut Pace<'_>) -> impl FnMut() -> bool + 'p {
    move || pace.answer() != Control::Cancelled
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_straight_part_half_of_the_way_of_the_tool_is_followed_however_far_the_joints_go() {
        let tool = |z: f64| Pose::at(0.0, 0.0, z);
        let share = |joints: &[f64], tools: &[f64]| {
            let postures: Vec<JointVector> = joints.iter().map(|q| JointVector::of([*q])).collect();
            blended_share(&postures, &tools.iter().map(|z| tool(*z)).collect::<Vec<_>>())
        };
        // Evenly; the elbow turns first while the tool stands; the joints hardly move in the first half of the tool's way.
        assert!((share(&[0.0, 1.0, 2.0, 3.0, 4.0], &[0.0, 0.1, 0.2, 0.3, 0.4]) - 0.5).abs() < 1e-12);
        assert!((share(&[0.0, 8.0, 9.0, 10.0], &[0.0, 0.0, 0.1, 0.2]) - 0.1).abs() < 1e-12);
        assert!((share(&[0.0, 0.1, 1.0], &[0.0, 0.1, 0.2]) - BLENDED_SHARE).abs() < 1e-12);
        assert_eq!(share(&[0.0], &[0.0]), BLENDED_SHARE);
    }
}
