//! Planning one motion of the arm: find a path, then keep shortening it until the caller says that time is up.
//!
//! ```text
//! start ─ straight (depart) ─ free path: RRT-Connect, then improvement ─ straight (approach) ─ goal
//! ```
//!
//! A goal is a list of alternatives, and a pose has many postures: every posture from which the approach is free is a
//! candidate end of the free path. On straight parts, checked by exact shapes, the fingers and what they hold may touch their
//! surroundings, the arm may not. On the free path nothing touches anything: it is searched with the vector checks, between
//! postures that have room for them; where the start or a candidate has less, a short way out of there comes first. Where the
//! tool is to stay upright, the free path keeps it so (`constrained`), and the straight parts do anyway. Where the tool is to go in
//! straight lines, they take the place of the free path (`way_points`).

use crate::arm::{self, joints};
use crate::collision::{CONTACT_TOLERANCE_M, Checker, Collision, Contact, PADDING_M, distance, length};
use crate::connect::{Budget, ConnectError, connect};
use crate::constrained::{self, Constraint};
use crate::joint_vector::JointVector;
use crate::keep::{KeptAxis, timed_keeping};
use crate::line::LineError;
use crate::pace::{Control, Pace, Progress, Stop};
use crate::reach::{Postures, Reach, Target, is_new};
use crate::refine::{End, Measure, Refinement};
pub use crate::request::{Goal, MAX_GOALS, MIN_SPEED, Request};
use crate::robot::{Configuration, Geometry, Robot};
use crate::simplify::{path_length, shortened};
use crate::space::{Space, State, state};
use crate::straight::Straight;
use crate::timing::rough::Rough;
use crate::timing::{Section, timed_while};
use crate::trajectory::Curve;
use crate::way_points::{Follower, WayPoints};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_world::scene::{Placement, Scene, SceneObject};

/// The padding where the start is too close to something for the usual one, in metres. As much room is on a free path at the least; a
/// controller that gives up there stops a little beside it, so a start with less is left, too, as long as it touches nothing.
const TIGHT_PADDING_M: f64 = 0.002;

/// Postures looked for per goal pose, and attempts spent on it: at first, and once more if there were none.
const SOLUTIONS: [(usize, usize); 2] = [(6, 8), (40, 80)];

/// Postures taken from one attempt: the nearest that it gives.
const SOLUTIONS_PER_ATTEMPT: usize = 2;

/// Iterations of the search before it gives up by itself.
const MAX_SEARCH_ITERATIONS: usize = 20_000;

/// Postures tried around one that has no room, and how far away the last of them are, in radians per joint.
const WAYS_OUT: usize = 100;
const WAY_OUT_RAD: f64 = 0.4;

/// The most candidates.
const MAX_CANDIDATES: usize = 64;

/// Of a hundred steps of improvement, those that look for a new candidate.
const NEW_CANDIDATES: i32 = 8;

/// How far off the measured poses of objects are, in metres: as far as that the fingers keep away from what they need not touch, where
/// there is a way.
const MEASURED_WITHIN_M: f64 = 0.002;

/// Steps from touching to the deepest that may be pressed: of the ways to a goal those count that press the least.
const PRESS_STEPS: u32 = 4;

/// A path must have become this much quicker to be worth a word, in seconds.
const LEAST_REPORT_S: f32 = 1e-3;

/// The motion is timed exactly after so many steps of improvement, and after four times as many, again and again.
const FIRST_TIMED: usize = 64;
const TIMED_AGAIN: usize = 4;

/// How much of a straight part a blend may take, at the end that is away from what it leads to or from.
const BLENDED_SHARE: f64 = 0.5;

/// A motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Timed.
    pub trajectory: Trajectory,
    /// Where it ends.
    pub end: JointVector,
    /// The tool frame there, in the world frame.
    pub end_pose: Pose,
    /// Length of the first path in joint space, straight parts included.
    pub first_length_rad: f64,
    /// Length of the path that the trajectory follows, before its corners were rounded.
    pub length_rad: f64,
    /// How long the motion along the first path takes, after its shortcutting, in seconds: never less than the trajectory does.
    pub first_duration_s: f64,
    /// Iterations of search and improvement.
    pub iterations: usize,
    /// The caller's time was up before all iterations of improvement were done: with more of it the path may differ.
    pub time_up: bool,
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
    #[error("departing {part}: {reason}")]
    Depart {
        /// How far it should go, and where.
        part: String,
        /// What is in the way.
        reason: String,
    },
    /// The start is free, but nothing around it.
    #[error("at the start {reason}")]
    NoRoom {
        /// What is close.
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
    /// The tool cannot go straight to any of the goals.
    #[error("no straight way to any of the {goals} goals: {}", reasons.join("; "))]
    NoStraightWay {
        /// How many alternatives there were.
        goals: usize,
        /// How far the tool gets and why no further, of some of them.
        reasons: Vec<String>,
    },
    /// What the tool is to keep does not hold.
    #[error("{place} {reason}")]
    NotKept {
        /// Where.
        place: &'static str,
        /// What is broken.
        reason: String,
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
struct Candidate {
    /// Where the free path ends.
    door: State,
    /// From there to the goal: the way in where the approach begins with little room, and the approach; at least one posture.
    way_in: Option<JointVector>,
    approach: Vec<JointVector>,
    /// Length of both.
    length_rad: f64,
    /// How long both take, roughly.
    lasts_s: f64,
}

impl Candidate {
    fn end(&self) -> End {
        End { state: self.door, rest: self.length_rad as f32, rest_s: self.lasts_s as f32 }
    }
}

/// A free path from the door at the start to that of a candidate.
#[derive(Debug, Clone, PartialEq)]
struct Way {
    path: Vec<State>,
    candidate: usize,
}

/// What came of improvement.
struct Improved {
    first_duration_s: f64,
    /// The quickest that was timed.
    motion: Motion,
}

/// A way, and the whole motion along it.
struct Motion {
    way: Way,
    curve: Curve,
}

/// The tools and the knowledge of one planning.
struct Planning<'a> {
    robot: &'a Robot,
    scene: &'a Scene,
    checker: Checker<'a>,
    space: Space,
    /// The tool, in the frame of the base, which is at `base`.
    reach: Reach,
    base: Pose,
    /// What the free path keeps.
    constraint: Option<Constraint>,
    rough: Rough,
    /// The straight part at the start.
    depart: Vec<JointVector>,
    random: ChaCha8Rng,
    goals: Vec<Goal>,
    approach: Straight,
    /// How deep an approach may press into what it touches.
    press_m: f64,
    /// With the fingers open, and without what they hold: how the tool leaves a goal where it lets go.
    leaving: Option<Checker<'a>>,
    candidates: Vec<Candidate>,
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
    request.check(robot, scene)?;
    let mut pace = Pace::new(control);
    let here = request.start.with_base(&scene.base);
    let (mechanism, obstacles) = arm::in_scene(robot, scene, &here);
    let mut planning = Planning {
        robot,
        scene,
        checker: Checker::new(robot, scene, &here, PADDING_M).reaching_into(&request.reaches_into),
        space: arm::space(&mechanism, &obstacles),
        reach: Reach::new(&mechanism, robot.tool, Pose::IDENTITY),
        base: arm::on_floor(robot, &scene.base),
        constraint: None,
        rough: Rough::new(&request.joints(robot), request.speed),
        depart: Vec::new(),
        random: ChaCha8Rng::seed_from_u64(request.seed),
        goals: request.goals.clone(),
        approach: request.approach.clone(),
        press_m: 0.0,
        leaving: None,
        candidates: Vec::new(),
    };
    let mut depart = planning.depart(request);
    for padding in [TIGHT_PADDING_M, 0.0] {
        if depart.is_err() {
            planning.checker = Checker::new(robot, scene, &here, padding).reaching_into(&request.reaches_into);
            depart = planning.depart(request);
        }
    }
    let depart = depart?;
    let start = depart[depart.len() - 1];
    let tool = planning.reach.pose(&start);
    let mut keep = request.keep;
    if let Some(tolerance_rad) = request.upright_rad {
        let up = [0.0, 0.0, 1.0];
        keep.axis = Some(KeptAxis { axis: tool.inverse().rotate(up), direction: Some(up), tolerance_rad });
    }
    planning.constraint = keep.constraint(&mechanism, robot.tool, &planning.base, &tool);
    planning.kept_along(&depart).map_err(|reason| PlanError::NotKept { place: "on the departure", reason })?;
    if let Some(constraint) = planning.constraint.as_ref().filter(|c| !c.holds(&state(&start))) {
        return Err(PlanError::NotKept { place: "at the start", reason: constraint.breach(&state(&start)) });
    }
    // An arm may stand so close to something, where it was stopped; it does not go there.
    let roomy = || Checker::new(robot, scene, &here, TIGHT_PADDING_M).reaching_into(&request.reaches_into);
    if let Some(way) = &request.straight {
        if planning.checker.padding() < TIGHT_PADDING_M {
            planning.checker = roomy();
        }
        return planning.straight(request, way, depart, &mut pace);
    }
    let departure_rad = length(&depart);
    planning.depart = depart;
    let door = planning.door(&start).ok_or_else(|| planning.no_room(&start))?;
    let way_out = if door == state(&start) { 0.0 } else { distance(&start, &joints(robot, &door)) };
    if planning.checker.padding() < TIGHT_PADDING_M {
        planning.checker = roomy();
    }
    planning.leaving = leaving(robot, scene, request, planning.checker.padding());
    let before = departure_rad + way_out;
    planning.find_candidates(&start, &mut pace)?;

    let (path, candidate) = planning.first_path(&start, &door, request.seed, &mut pace)?;
    let first_length_rad = before + f64::from(path_length(&path)) + planning.candidates[candidate].length_rad;
    let mut best = None;
    let first = Way { path, candidate };
    let improved = pace
        .report(Progress::FirstPath { length_rad: first_length_rad })
        .and_then(|()| planning.improve(&first, &mut best, request, &mut pace));
    if improved == Err(Stop::Cancelled) {
        return Err(PlanError::Cancelled);
    }
    // To be timed is part of every plan, also when time is up.
    let Improved { first_duration_s, motion: Motion { way, curve } } = match best {
        Some(best) => best,
        None => {
            let motion = planning.motion(request, first, &mut || pace.answer() != Control::Cancelled)?;
            Improved { first_duration_s: motion.curve.duration_s(), motion }
        }
    };
    if pace.answer() == Control::Cancelled {
        return Err(PlanError::Cancelled);
    }
    let chosen = &planning.candidates[way.candidate];
    let length_rad = before + f64::from(path_length(&way.path)) + chosen.length_rad;
    let end = chosen.approach[chosen.approach.len() - 1];
    let trajectory = curve.named(robot.arm_joints());
    let end_pose = robot.tool_pose(&Configuration { arm: end, ..here });
    let (iterations, time_up) = (pace.iterations, improved.is_err());
    Ok(Plan { trajectory, end, end_pose, first_length_rad, length_rad, first_duration_s, iterations, time_up })
}

impl PlanError {
    pub(crate) fn no_straight_way(mut reasons: Vec<String>) -> PlanError {
        let goals = reasons.len();
        reasons.truncate(MAX_REASONS);
        PlanError::NoStraightWay { goals, reasons }
    }
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
    fn depart(&mut self, request: &Request) -> Result<Vec<JointVector>, PlanError> {
        let start = request.start.arm;
        if !request.depart.is_some() {
            return match self.checker.collision(&start, Contact::None) {
                None => Ok(vec![start]),
                Some(collision) => Err(PlanError::StartInCollision { collision }),
            };
        }
        let failed = |reason: String| PlanError::Depart { part: request.depart.to_string(), reason };
        let postures = self.line(&start, &request.depart, 1.0).map_err(|e| failed(e.to_string()))?;
        // There is one such line, so it is looked at once, with the most that may be pressed: as on an approach, or what is pressed already.
        let usual = Contact::Gripper(half_finger_m(self.robot));
        let is_deep = self.checker.collision(&start, usual).is_some();
        let press_m = if is_deep { CONTACT_TOLERANCE_M } else { half_finger_m(self.robot) };
        match straight_collision(&mut self.checker, &postures, press_m) {
            Some(collision) => Err(failed(collision.to_string())),
            None => match self.checker.collision(&postures[postures.len() - 1], Contact::None) {
                Some(collision) => Err(failed(format!("at its end {collision}"))),
                None => Ok(postures),
            },
        }
    }

    /// Postures along a straight part (`sense` 1) or against its direction (-1), from the first of them.
    fn line(&self, from: &JointVector, part: &Straight, sense: f64) -> Result<Vec<JointVector>, LineError> {
        let tool = self.reach.pose(from);
        // A request that names an object which is not there has been refused.
        let way = part.way(self.scene, &self.base, &tool).unwrap_or_default();
        arm::line(&self.reach, from, way.map(|c| sense * c))
    }

    /// The whole motion in straight lines.
    fn straight(
        mut self,
        request: &Request,
        way: &WayPoints,
        depart: Vec<JointVector>,
        pace: &mut Pace<'_>,
    ) -> Result<Plan, PlanError> {
        let robot = self.robot;
        let start = depart[depart.len() - 1];
        let mut leaving = leaving(robot, self.scene, request, self.checker.padding());
        let mut best: Option<Plan> = None;
        let mut failed = None;
        // Within limits of jerk a corner that is rounded closely may take longer than a stop.
        let blends = [way.blend_m, 0.0];
        for blend_m in blends.into_iter().take(if way.blend_m > 0.0 { 2 } else { 1 }) {
            let way = WayPoints { blend_m, ..way.clone() };
            let mut follower = Follower {
                scene: self.scene,
                reach: &self.reach,
                base: self.base,
                checker: &mut self.checker,
                leaving: leaving.as_mut(),
                constraint: self.constraint.as_ref(),
                presses_m: presses_m(robot),
            };
            let followed = match follower.follow(&start, request, &way, pace) {
                Ok(followed) => followed,
                Err(error @ PlanError::NoStraightWay { .. }) => {
                    failed = failed.or(Some(error));
                    continue;
                }
                Err(PlanError::TimeUp) if best.is_some() => {
                    best = best.map(|plan| Plan { time_up: true, ..plan });
                    break;
                }
                Err(error) => return Err(error),
            };
            let length_rad = length(&depart) + followed.length_rad();
            if best.is_none() && pace.report(Progress::FirstPath { length_rad }) == Err(Stop::Cancelled) {
                return Err(PlanError::Cancelled);
            }
            let end = followed.approach[followed.approach.len() - 1];
            let sections = [depart.clone(), followed.lines, followed.approach].map(Section::AsGiven);
            let curve = self.timed(request, &sections, &mut || pace.answer() != Control::Cancelled)?;
            if pace.answer() == Control::Cancelled {
                return Err(PlanError::Cancelled);
            }
            if best.as_ref().is_none_or(|best| curve.duration_s() < best.trajectory.duration_s()) {
                best = Some(Plan {
                    trajectory: curve.named(robot.arm_joints()),
                    first_duration_s: curve.duration_s(),
                    end,
                    end_pose: self.base.compose(&self.reach.pose(&end)),
                    first_length_rad: length_rad,
                    length_rad,
                    iterations: 0,
                    time_up: false,
                });
            }
        }
        best.ok_or_else(|| failed.unwrap_or_else(|| PlanError::no_straight_way(Vec::new())))
    }

    /// Fills the list of candidates: those that keep away from what they need not touch, or else those that press the least.
    fn find_candidates(&mut self, near: &JointVector, pace: &mut Pace<'_>) -> Result<(), PlanError> {
        let mut reasons: Vec<String> = Vec::new();
        for (wanted, attempts) in SOLUTIONS {
            let mut postures = Vec::new();
            for goal in self.goals.clone() {
                match goal {
                    Goal::Joints(posture) => postures.push(posture),
                    Goal::Pose(pose) => {
                        let found = self.postures(&pose, near, wanted, attempts, pace)?;
                        if found.is_empty() {
                            let [x, y, z] = pose.position;
                            reasons.push(format!("the arm does not reach ({x:.3}, {y:.3}, {z:.3})"));
                        }
                        postures.extend(found);
                    }
                }
            }
            let mut refused = Vec::new();
            for press_m in presses_m(self.robot) {
                self.press_m = press_m;
                refused.clear();
                for posture in &postures {
                    pace.poll()?;
                    match self.candidate(posture) {
                        Ok(candidate) => self.candidates.push(candidate),
                        Err(reason) => refused.push(reason),
                    }
                }
                if !self.candidates.is_empty() {
                    let cost = |c: &Candidate| distance(near, &joints(self.robot, &c.door)) + c.length_rad;
                    self.candidates.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
                    return Ok(());
                }
            }
            reasons.append(&mut refused);
        }
        reasons.sort();
        reasons.dedup();
        Err(PlanError::NoGoal { goals: self.goals.len(), reasons: reasons.into_iter().take(MAX_REASONS).collect() })
    }

    /// As [`Reach::solutions`], asking between the attempts whether to go on.
    fn postures(
        &mut self,
        pose: &Pose,
        near: &JointVector,
        wanted: usize,
        attempts: usize,
        pace: &mut Pace<'_>,
    ) -> Result<Vec<JointVector>, Stop> {
        let (postures, near) = (self.goal(pose), *near);
        let mut found = Vec::new();
        for attempt in 0..attempts {
            pace.poll()?;
            let some = self.reach.attempt(&postures, &near, attempt, &mut self.random);
            for posture in some.into_iter().take(SOLUTIONS_PER_ATTEMPT) {
                if found.len() < wanted && is_new(&found, &posture) {
                    found.push(posture);
                }
            }
            if found.len() == wanted || postures.is_empty() {
                break;
            }
        }
        Ok(found.to_vec())
    }

    /// All postures at a pose in the world frame.
    fn goal(&self, pose: &Pose) -> Postures {
        self.reach.postures(&Target::at(self.base.inverse().compose(pose)))
    }

    /// The goal posture with its approach, or why it is none.
    fn candidate(&mut self, goal: &JointVector) -> Result<Candidate, String> {
        let mut approach = vec![*goal];
        if self.approach.is_some() {
            let back = self.line(goal, &self.approach, -1.0);
            approach =
                back.map_err(|e| format!("approaching the goal {}, backwards from there: {e}", self.approach))?;
            if let Some(collision) = straight_collision(&mut self.checker, &approach, self.press_m) {
                return Err(format!("approaching the goal, {collision}"));
            }
            let leaving = self.leaving.as_mut();
            if let Some(collision) = leaving.and_then(|open| straight_collision(open, &approach, self.press_m)) {
                return Err(format!("leaving the goal with open fingers, {collision}"));
            }
            approach.reverse();
        }
        match self.checker.collision(&approach[0], Contact::None) {
            Some(collision) if self.approach.is_some() => Err(format!("before the approach, {collision}")),
            Some(collision) => Err(format!("at the goal, {collision}")),
            None => self.with_door(approach),
        }
    }

    /// What the tool keeps is kept along postures, or what is broken.
    fn kept_along(&self, postures: &[JointVector]) -> Result<(), String> {
        let Some(constraint) = &self.constraint else { return Ok(()) };
        let breaks = |pair: &&[JointVector]| !constraint.holds_along(&state(&pair[0]), &state(&pair[1]));
        match postures.windows(2).find(breaks) {
            Some(pair) => Err(constraint.breach(&state(&pair[1]))),
            None => Ok(()),
        }
    }

    /// The sections as one motion within the limits that were asked for, which keeps what is to be kept between all its knots as well.
    fn timed(
        &mut self,
        request: &Request,
        sections: &[Section],
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Curve, PlanError> {
        let joints = request.joints(self.robot);
        let (space, constraint) = (&mut self.space, &self.constraint);
        let mut is_free = |from: &JointVector, to: &JointVector| {
            let (from, to) = (state(from), state(to));
            constraint.as_ref().is_none_or(|c| c.holds_along(&from, &to)) && space.is_free_motion(&from, &to)
        };
        let curve = match constraint {
            None => timed_while(&joints, sections, request.speed, &mut is_free, goes_on),
            Some(constraint) => timed_keeping(&joints, sections, request.speed, constraint, &mut is_free, goes_on)
                .ok_or(PlanError::NotKept {
                    place: "on the way",
                    reason: "the tool does not keep what it is to keep between the postures that were planned"
                        .to_owned(),
                })?,
        };
        Ok(request.tool_speed.keep(&self.reach, curve))
    }

    fn with_door(&mut self, approach: Vec<JointVector>) -> Result<Candidate, String> {
        let entry = approach[0];
        let door = self.door(&entry).ok_or_else(|| "there is too little room before the goal".to_owned())?;
        if let Some(constraint) = self.constraint.as_ref().filter(|c| !c.holds(&door)) {
            return Err(format!("at the goal {}", constraint.breach(&door)));
        }
        self.kept_along(&approach).map_err(|reason| format!("approaching the goal {reason}"))?;
        let way_in = (door != state(&entry)).then(|| joints(self.robot, &door));
        let length_rad = length(&approach) + way_in.map_or(0.0, |way_in| distance(&way_in, &entry));
        let way_in_s = way_in.map_or(0.0, |way_in| self.rough.duration_s(&[state(&way_in), state(&entry)]));
        let lasts_s =
            way_in_s + self.rough.duration_s(&approach.iter().map(|posture| state(posture)).collect::<Vec<_>>());
        Ok(Candidate { door, way_in, approach, length_rad, lasts_s })
    }

    /// The posture itself where the vector checks find room for it, else one close by that can be reached from it.
    fn door(&mut self, posture: &JointVector) -> Option<State> {
        let here = state(posture);
        if self.space.is_within(&here) && self.space.is_free(&here) {
            return Some(here);
        }
        (1..=WAYS_OUT).find_map(|attempt| {
            let radius = WAY_OUT_RAD * attempt as f64 / WAYS_OUT as f64;
            let aside = posture.map(|q| q + radius * self.random.random_range(-1.0..=1.0));
            let door = state(&self.robot.clamp(&aside));
            let keeps = self.constraint.as_ref().is_none_or(|c| c.holds_along(&here, &door));
            let free = keeps
                && self.space.is_free(&door)
                && self.checker.edge_is_free(posture, &joints(self.robot, &door), Contact::None);
            free.then_some(door)
        })
    }

    /// From the door at the start to that of a candidate.
    fn first_path(
        &mut self,
        start: &JointVector,
        door: &State,
        seed: u64,
        pace: &mut Pace<'_>,
    ) -> Result<(Vec<State>, usize), PlanError> {
        let doors: Vec<State> = self.candidates.iter().map(|c| c.door).collect();
        let budget = Budget { iterations: MAX_SEARCH_ITERATIONS, seed };
        pace.iteration()?;
        let mut control = |_: usize| pace.answer();
        let route = match &self.constraint {
            None => connect(&mut self.space, door, &doors, budget, &mut control),
            Some(constraint) => constrained::connect(&mut self.space, constraint, door, &doors, budget, &mut control),
        };
        match route {
            Ok(route) => {
                pace.iterations += route.iterations;
                Ok((route.path, route.goal))
            }
            Err(ConnectError::Cancelled) => Err(PlanError::Cancelled),
            Err(ConnectError::TimeUp { .. }) => Err(PlanError::TimeUp),
            Err(_) => {
                let collision = self.checker.edge_collision(start, &joints(self.robot, &doors[0]), Contact::None);
                Err(PlanError::NoPath {
                    postures: doors.len(),
                    iterations: MAX_SEARCH_ITERATIONS,
                    collision: collision.map_or_else(|| "nothing is in the way".to_owned(), |c| c.to_string()),
                })
            }
        }
    }

    /// Makes the motion quicker, and leaves the best that was timed; with an error where that was all there was time for.
    fn improve(
        &mut self,
        first: &Way,
        best: &mut Option<Improved>,
        request: &Request,
        pace: &mut Pace<'_>,
    ) -> Result<(), Stop> {
        let mut way = first.clone();
        let shortened = self.shorten(&mut way, request.seed, pace);
        if shortened == Err(Stop::Cancelled) {
            return shortened;
        }
        let timed = self.motion(request, way, &mut || pace.answer() != Control::Cancelled);
        // Where it cannot be timed so that it keeps what it is to keep, the first path is left as it was found.
        let Ok(motion) = timed else { return Ok(()) };
        let best = best.insert(Improved { first_duration_s: motion.curve.duration_s(), motion });
        shortened?;
        let Way { path, candidate } = best.motion.way.clone();
        let ends = self.candidates.iter().map(Candidate::end).collect();
        let measure = Measure::Duration(Box::new(self.rough.clone()));
        let mut refinement = Refinement::new(path, candidate, ends, measure, request.seed);
        if let Some(constraint) = &self.constraint {
            refinement = refinement.keeping(constraint.clone());
        }
        let stopped = self.refine(&mut refinement, best, request, pace);
        if stopped != Err(Stop::Cancelled) {
            self.time_if_new(request, &refinement, best, &mut || pace.answer() != Control::Cancelled);
        }
        stopped
    }

    /// Fewer and shorter motions before the first is timed.
    fn shorten(&mut self, way: &mut Way, seed: u64, pace: &mut Pace<'_>) -> Result<(), Stop> {
        let control = &mut |_: usize| pace.answer();
        if let Some(constraint) = &self.constraint {
            let shortcuts = constrained::SHORTCUTS;
            let stopped = constrained::shorten(&mut self.space, constraint, &mut way.path, shortcuts, seed, control);
            return stopped.map_err(Stop::from);
        }
        match shortened(&mut self.space, &way.path, control) {
            Ok(short) => way.path = short,
            Err(ConnectError::Cancelled) => return Err(Stop::Cancelled),
            Err(_) => {}
        }
        Ok(())
    }

    /// So many steps of improvement; from time to time what they have led to is timed.
    fn refine(
        &mut self,
        refinement: &mut Refinement,
        best: &mut Improved,
        request: &Request,
        pace: &mut Pace<'_>,
    ) -> Result<(), Stop> {
        let (mut reported, mut timed_at) = (refinement.cost(), FIRST_TIMED);
        for iteration in 1..=request.improvement_iterations {
            pace.iteration()?;
            if self.random.random_range(0..100) < NEW_CANDIDATES {
                self.find_another(refinement);
            } else {
                refinement.step(&mut self.space, &mut |_| pace.answer())?;
            }
            let about_s = refinement.cost();
            if about_s < reported - LEAST_REPORT_S {
                reported = about_s;
                pace.report(Progress::Quicker { about_s: f64::from(about_s) })?;
            }
            if iteration == timed_at {
                timed_at = timed_at.saturating_mul(TIMED_AGAIN);
                self.time_if_new(request, refinement, best, &mut || pace.answer() == Control::Continue);
            }
        }
        Ok(())
    }

    /// Times the path of a refinement, and takes it where the motion is quicker: never one that is slower, whatever the estimate says.
    fn time_if_new(
        &mut self,
        request: &Request,
        refinement: &Refinement,
        best: &mut Improved,
        goes_on: &mut dyn FnMut() -> bool,
    ) {
        let way = Way { path: refinement.path().to_vec(), candidate: refinement.end() };
        if way == best.motion.way {
            return;
        }
        match self.motion(request, way, goes_on) {
            Ok(motion) if motion.curve.duration_s() < best.motion.curve.duration_s() => best.motion = motion,
            _ => {}
        }
    }

    /// The whole motion along a way, as quick as the limits allow.
    fn motion(&mut self, request: &Request, way: Way, goes_on: &mut dyn FnMut() -> bool) -> Result<Motion, PlanError> {
        let chosen = &self.candidates[way.candidate];
        let start = self.depart[self.depart.len() - 1];
        let sections = [
            Section::Loose(self.depart.clone(), [0.0, BLENDED_SHARE]),
            Section::Blended(self.whole(&start, &way.path, chosen)),
            Section::Loose(chosen.approach.clone(), [BLENDED_SHARE, 0.0]),
        ];
        let curve = self.timed(request, &sections, goes_on)?;
        Ok(Motion { way, curve })
    }

    /// Looks for a posture at the goal that a shorter path could lead to.
    fn find_another(&mut self, refinement: &mut Refinement) {
        let goal = self.goals[self.random.random_range(0..self.goals.len())];
        let Goal::Pose(pose) = goal else { return };
        if self.candidates.len() >= MAX_CANDIDATES {
            return;
        }
        let along = self.random.random_range(0.0..=1.0) * path_length(refinement.path());
        let near = joints(self.robot, &refinement.point(along).0);
        let seed = near.map(|q| q + self.random.random_range(-0.5..0.5));
        let postures = self.reach.nearest(&self.goal(&pose), &seed);
        let Some(posture) = postures.first().copied() else { return };
        // The posture itself is no end of the path, but where the end is cannot be much nearer.
        if !refinement.is_promising(&End { state: state(&posture), rest: 0.0, rest_s: 0.0 }) {
            return;
        }
        let Ok(candidate) = self.candidate(&posture) else { return };
        if refinement.is_promising(&candidate.end()) {
            refinement.add(candidate.end());
            self.candidates.push(candidate);
        }
    }

    /// The free path with its ways out and in, from the end of the departure to the beginning of the approach.
    fn whole(&self, start: &JointVector, path: &[State], candidate: &Candidate) -> Vec<JointVector> {
        let mut whole: Vec<JointVector> = path.iter().map(|s| joints(self.robot, s)).collect();
        if path[0] == state(start) {
            whole[0] = *start;
        } else {
            whole.insert(0, *start);
        }
        let entry = candidate.approach[0];
        match candidate.way_in {
            None if whole.len() > 1 => whole.last_mut().into_iter().for_each(|last| *last = entry),
            _ => whole.push(entry),
        }
        whole
    }

    fn no_room(&mut self, posture: &JointVector) -> PlanError {
        let collision = self.checker.collision(posture, Contact::None);
        let reason = collision.map_or_else(|| "there is too little room to move".to_owned(), |c| c.to_string());
        PlanError::NoRoom { reason }
    }
}

/// What a straight part touches first that it may not.
pub(crate) fn straight_collision(
    checker: &mut Checker<'_>,
    postures: &[JointVector],
    press_m: f64,
) -> Option<Collision> {
    let contact = Contact::Gripper(press_m);
    let first = checker.collision(&postures[0], contact);
    first.or_else(|| postures.windows(2).find_map(|w| checker.edge_collision(&w[0], &w[1], contact)))
}

/// How deep the fingers and what they hold may press into what they touch on the way to a goal, in metres, in the order in which it is
/// tried; negative: how far they keep away. The deepest is half a finger's thickness: a finger that comes down beside an edge pushes
/// it aside, and one that comes down with more than half of itself on it stands on it.
fn presses_m(robot: &Robot) -> Vec<f64> {
    let steps = (0..=PRESS_STEPS).map(|step| f64::from(step) / f64::from(PRESS_STEPS) * half_finger_m(robot));
    std::iter::once(-MEASURED_WITHIN_M).chain(steps).collect()
}

/// Half of a finger's thickness along the direction in which it closes; 0 for a robot without fingers made of boxes.
fn half_finger_m(robot: &Robot) -> f64 {
    let halves = robot.finger_link().into_iter().flat_map(|link| &robot.model.links[link].bodies);
    let thickness = halves.filter_map(|body| match body.geometry {
        Geometry::Box { half } => Some(half[1]),
        _ => None,
    });
    thickness.fold(0.0, f64::max)
}

/// The tool as it leaves a goal where it lets go of what it holds: fingers that open there may press a neighbour, too. `None` where it
/// holds nothing.
fn leaving<'a>(robot: &'a Robot, scene: &Scene, request: &Request, padding: f64) -> Option<Checker<'a>> {
    let is_held = |object: &SceneObject| matches!(object.placement, Placement::Gripper(_));
    if !scene.objects.iter().any(is_held) {
        return None;
    }
    let left = scene.objects.iter().filter(|object| !is_held(object)).cloned().collect();
    let scene = Scene { objects: left, ..scene.clone() };
    let opened = Configuration { finger: robot.open_finger_m(), ..request.start };
    Some(Checker::new(robot, &scene, &opened, padding).reaching_into(&request.reaches_into))
}

/// How many different reasons an error names.
const MAX_REASONS: usize = 5;
