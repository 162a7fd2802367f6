//! Planning one motion of the arm: find a path, then keep shortening it until the caller says that time is up.
//!
//! ```text
//! start ─ straight up (depart) ─ free path: RRT-Connect, then improvement ─ straight down (approach) ─ goal
//! ```
//!
//! A goal is a list of alternatives, and a pose has many postures: every posture from which the approach is free is a
//! candidate end of the free path. On straight parts the fingers and what they hold may touch their surroundings, the
//! arm may not; on the free path nothing touches anything.

use crate::collision::{CONTACT_TOLERANCE_M, Checker, Collision, Contact, PADDING_M, distance};
use crate::improve::improve;
use crate::inverse::{Solver, is_same};
use crate::line::{LineError, line};
use crate::pace::{Control, Pace, Progress, Stop};
pub use crate::request::{Goal, MAX_GOALS, MAX_STRAIGHT_M, MIN_SPEED, Request};
use crate::robot::{Configuration, Joints, Robot};
use crate::search::search;
use crate::shorten::{length, shortcut};
use crate::timing::{Part, parameterise};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_world::scene::Scene;

/// The padding where the start is too close to something for the usual one, in metres.
const TIGHT_PADDING_M: f64 = 0.002;

/// Postures looked for per goal pose, and descents spent on it: at first, and once more if there were none.
const SOLUTIONS: [(usize, usize); 2] = [(4, 8), (8, 80)];

/// Iterations of the search before it gives up by itself.
const MAX_SEARCH_ITERATIONS: usize = 20_000;

/// Shortcuts tried on the first path before anything else.
const FIRST_SHORTCUTS: usize = 100;

/// A motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Timed.
    pub trajectory: Trajectory,
    /// Where it ends.
    pub end: Joints,
    /// The tool frame there, in the world frame.
    pub end_pose: Pose,
    /// Length of the first path in joint space, straight parts included.
    pub first_length_rad: f64,
    /// Length of the path that the trajectory follows, before its corners were rounded.
    pub length_rad: f64,
    /// Iterations of search and improvement.
    pub iterations: usize,
}

/// Why there is no plan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The request makes no sense.
    #[error("{what} is {value}: expected {expected}")]
    Malformed {
        /// Which part of it.
        what: String,
        /// What it is.
        value: String,
        /// What it should be.
        expected: String,
    },
    /// The arm touches something where it stands.
    #[error("at the start {collision}")]
    StartInCollision {
        /// What touches what.
        collision: Collision,
    },
    /// The straight part at the start cannot be followed.
    #[error("departing {depart_m:.3} m straight up: {reason}")]
    Depart {
        /// How far it should go, in metres.
        depart_m: f64,
        /// What is in the way.
        reason: String,
    },
    /// No alternative of the goal has a posture that is free.
    #[error("none of the {goals} goals can be reached: {}", reasons.join("; "))]
    NoGoal {
        /// How many alternatives there were.
        goals: usize,
        /// The different reasons.
        reasons: Vec<String>,
    },
    /// There are goals, but no way was found.
    #[error(
        "no way found to any of {postures} goal postures after {iterations} iterations; on the straight way {collision}"
    )]
    NoPath {
        /// How many goal postures were tried.
        postures: usize,
        /// Iterations of the search.
        iterations: usize,
        /// What blocks the straight way to the nearest of them.
        collision: String,
    },
    /// The caller's time was up before there was any path.
    #[error("no path was found in the time given")]
    TimeUp,
    /// The caller gave up.
    #[error("planning was cancelled")]
    Cancelled,
}

/// A posture at the goal, with the straight part that leads to it.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// From the end of the free path to the goal; at least one posture.
    pub(crate) approach: Vec<Joints>,
    /// Length of the approach.
    pub(crate) length_rad: f64,
}

impl Candidate {
    /// Where the free path ends.
    pub(crate) fn entry(&self) -> &Joints {
        &self.approach[0]
    }
}

/// A free path and the candidate it leads to.
#[derive(Debug, Clone)]
pub(crate) struct Way {
    pub(crate) path: Vec<Joints>,
    pub(crate) candidate: usize,
}

/// The tools and the knowledge of one planning.
pub(crate) struct Planning<'a> {
    pub(crate) checker: Checker<'a>,
    pub(crate) solver: Solver<'a>,
    pub(crate) random: ChaCha8Rng,
    pub(crate) goals: Vec<Goal>,
    pub(crate) approach_m: f64,
    pub(crate) candidates: Vec<Candidate>,
}

/// Plans a motion of the arm in a scene; `control` is asked at least every millisecond or so whether to go on.
///
/// # Errors
/// [`PlanError`] says what is in the way.
pub fn plan(
    robot: &Robot,
    scene: &Scene,
    request: &Request,
    control: &mut dyn FnMut(Progress) -> Control,
) -> Result<Plan, PlanError> {
    request.check(robot)?;
    let mut pace = Pace::new(control);
    let mut planning = Planning {
        checker: Checker::new(robot, scene, PADDING_M),
        solver: Solver::new(robot, &scene.base),
        random: ChaCha8Rng::seed_from_u64(request.seed),
        goals: request.goals.clone(),
        approach_m: request.approach_m,
        candidates: Vec::new(),
    };
    let depart = match planning.depart(request) {
        Err(_) => {
            planning.checker = Checker::new(robot, scene, TIGHT_PADDING_M);
            planning.depart(request)?
        }
        depart => depart?,
    };
    let start = depart[depart.len() - 1];
    planning.find_candidates(&start, &mut pace)?;

    let first = planning.first_way(&start, &mut pace)?;
    let total = |planning: &Planning<'_>, way: &Way| {
        length(&depart) + length(&way.path) + planning.candidates[way.candidate].length_rad
    };
    let first_length_rad = total(&planning, &first);
    let mut best = first;
    let improved = match pace.report(Progress::FirstPath { length_rad: first_length_rad }) {
        Ok(()) => planning.shorten_first(&mut best, &mut pace),
        stopped => stopped,
    };
    let improved = improved
        .and_then(|()| improve(&mut planning, &mut best, length(&depart), request.improvement_iterations, &mut pace));
    if let Err(Stop::Cancelled) = improved {
        return Err(PlanError::Cancelled);
    }

    let length_rad = total(&planning, &best);
    let approach = planning.candidates[best.candidate].approach.clone();
    let end = approach[approach.len() - 1];
    let parts = [Part::Straight(depart), Part::Free(best.path), Part::Straight(approach)];
    let trajectory = parameterise(&mut planning.checker, &parts, request.speed);
    let end_pose = robot.tool_pose(&Configuration { arm: end, ..Configuration::ZERO.with_base(&scene.base) });
    Ok(Plan { trajectory, end, end_pose, first_length_rad, length_rad, iterations: pace.iterations })
}

impl From<Stop> for PlanError {
    fn from(stop: Stop) -> PlanError {
        match stop {
            Stop::TimeUp => PlanError::TimeUp,
            Stop::Cancelled => PlanError::Cancelled,
        }
    }
}

impl Planning<'_> {
    /// The straight part at the start; its end is free.
    fn depart(&mut self, request: &Request) -> Result<Vec<Joints>, PlanError> {
        let start = request.start;
        if request.depart_m <= 0.0 {
            return match self.checker.collision(&start, Contact::None) {
                None => Ok(vec![start]),
                Some(collision) => Err(PlanError::StartInCollision { collision }),
            };
        }
        let failed = |reason: String| PlanError::Depart { depart_m: request.depart_m, reason };
        let postures =
            line(&mut self.solver, &start, [0.0, 0.0, request.depart_m]).map_err(|e| failed(e.to_string()))?;
        match self.straight_collision(&postures) {
            Some(collision) => Err(failed(collision.to_string())),
            None => match self.checker.collision(&postures[postures.len() - 1], Contact::None) {
                Some(collision) => Err(failed(format!("at its end {collision}"))),
                None => Ok(postures),
            },
        }
    }

    fn straight_collision(&mut self, postures: &[Joints]) -> Option<Collision> {
        let contact = Contact::Gripper(CONTACT_TOLERANCE_M);
        let first = self.checker.collision(&postures[0], contact);
        first.or_else(|| postures.windows(2).find_map(|w| self.checker.edge_collision(&w[0], &w[1], contact)))
    }

    /// Fills the list of candidates.
    fn find_candidates(&mut self, near: &Joints, pace: &mut Pace<'_>) -> Result<(), PlanError> {
        let mut reasons: Vec<String> = Vec::new();
        for (wanted, attempts) in SOLUTIONS {
            for goal in self.goals.clone() {
                let postures = match goal {
                    Goal::Joints(posture) => vec![posture],
                    Goal::Pose(pose) => {
                        let found = self.postures(&pose, near, wanted, attempts, pace)?;
                        if found.is_empty() {
                            let [x, y, z] = pose.position;
                            reasons.push(format!("the arm does not reach ({x:.3}, {y:.3}, {z:.3})"));
                        }
                        found
                    }
                };
                for posture in postures {
                    pace.poll()?;
                    match self.candidate(&posture) {
                        Ok(candidate) => self.candidates.push(candidate),
                        Err(reason) => reasons.push(reason),
                    }
                }
            }
            if !self.candidates.is_empty() {
                let cost = |c: &Candidate| distance(near, c.entry()) + c.length_rad;
                self.candidates.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
                return Ok(());
            }
        }
        reasons.sort();
        reasons.dedup();
        Err(PlanError::NoGoal { goals: self.goals.len(), reasons: reasons.into_iter().take(MAX_REASONS).collect() })
    }

    /// As [`Solver::solutions`], asking between the attempts whether to go on.
    fn postures(
        &mut self,
        pose: &Pose,
        near: &Joints,
        wanted: usize,
        attempts: usize,
        pace: &mut Pace<'_>,
    ) -> Result<Vec<Joints>, Stop> {
        let mut found: Vec<Joints> = Vec::new();
        for attempt in 0..attempts {
            pace.poll()?;
            if let Some(posture) = self.solver.attempt(pose, near, attempt, &mut self.random)
                && found.iter().all(|other| !is_same(other, &posture))
            {
                found.push(posture);
                if found.len() == wanted {
                    break;
                }
            }
        }
        Ok(found)
    }

    /// The goal posture with its approach, or why it is none.
    pub(crate) fn candidate(&mut self, goal: &Joints) -> Result<Candidate, String> {
        let mut approach = vec![*goal];
        if self.approach_m > 0.0 {
            let up = [0.0, 0.0, self.approach_m];
            approach = line(&mut self.solver, goal, up).map_err(|e: LineError| format!("approaching the goal, {e}"))?;
            if let Some(collision) = self.straight_collision(&approach) {
                return Err(format!("approaching the goal, {collision}"));
            }
            approach.reverse();
        }
        match self.checker.collision(&approach[0], Contact::None) {
            Some(collision) if self.approach_m > 0.0 => Err(format!("before the approach, {collision}")),
            Some(collision) => Err(format!("at the goal, {collision}")),
            None => Ok(Candidate { length_rad: length(&approach), approach }),
        }
    }

    /// The straight way where it is free, else what the search finds.
    fn first_way(&mut self, start: &Joints, pace: &mut Pace<'_>) -> Result<Way, PlanError> {
        for (i, candidate) in self.candidates.iter().enumerate() {
            pace.iteration()?;
            if self.checker.edge_is_free(start, candidate.entry(), Contact::None) {
                return Ok(Way { path: vec![*start, *candidate.entry()], candidate: i });
            }
        }
        let goals: Vec<Joints> = self.candidates.iter().map(|c| *c.entry()).collect();
        let (solver, random) = (&self.solver, &mut self.random);
        let mut sample = || solver.random(random);
        match search(&mut self.checker, start, &goals, MAX_SEARCH_ITERATIONS, &mut sample, pace)? {
            Some((path, candidate)) => Ok(Way { path, candidate }),
            None => {
                let collision = self.checker.edge_collision(start, &goals[0], Contact::None);
                Err(PlanError::NoPath {
                    postures: goals.len(),
                    iterations: pace.iterations,
                    collision: collision.map_or_else(|| "nothing is in the way".to_owned(), |c| c.to_string()),
                })
            }
        }
    }

    fn shorten_first(&mut self, way: &mut Way, pace: &mut Pace<'_>) -> Result<(), Stop> {
        for _ in 0..FIRST_SHORTCUTS {
            pace.iteration()?;
            shortcut(&mut way.path, &mut self.checker, &mut self.random);
        }
        Ok(())
    }
}

/// How many different reasons an error names.
const MAX_REASONS: usize = 5;
