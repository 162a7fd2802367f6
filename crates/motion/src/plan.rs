//! Planning one motion of the arm: find a path, then keep shortening it until the caller says that time is up.
//!
//! ```text
//! start ─ straight (depart) ─ free path: RRT-Connect, then improvement ─ straight (approach) ─ goal
//! ```
//!
//! A goal is a list of alternatives, and a pose has many postures: every posture from which the approach is free is a candidate end of the free
//! path. On straight parts, checked by exact shapes, the fingers and what they hold may touch what they touch at the start or the goal (`pressing`), the arm may not. The free path
//! has no contact at all: it is searched with the vector checks, between postures that have room for them; if the start or a candidate has less
//! room, a short way out of there comes first. If the tool is to stay upright, the free path keeps it so (`constrained`); the straight parts do
//! anyway. If the tool is to move in straight lines, they replace the free path (`way_points`). If the gripper is inside an object at the start, a
//! retreat comes first (`retreat`).

mod arm_in_scene;
mod candidates;
mod contact;
mod departure;
mod error;
mod improvement;
mod retreat;
mod search;
mod straight_ways;

use crate::collision::{Contact, distance, length};
use crate::connect::{Budget, ConnectError};
use crate::endless::WithEnds;
use crate::joint_vector::JointVector;
use crate::pace::{Control, Pace, Progress};
pub use crate::request::{Goal, MAX_GOALS, MIN_SPEED, Request};
use crate::robot::{Configuration, Robot};
use crate::simplify::path_length;
use crate::space::{State, state};
use arm_in_scene::ArmInScene;
use candidates::Candidates;
use departure::departure;
pub use error::PlanError;
use improvement::{Before, Improvement, Way};
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_world::scene::Scene;
use straight_ways::plan_straight;

/// Maximum number of iterations of the search.
const MAX_SEARCH_ITERATIONS: usize = 20_000;

/// A planned motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The trajectory: times in seconds, positions in radians, velocities in radians per second.
    pub trajectory: Trajectory,
    /// The posture at the end, in radians.
    pub end: JointVector,
    /// The pose of the tool frame at the end, in the world frame.
    pub end_pose: Pose,
    /// Length of the first path in joint space (radians, Euclidean), straight parts included.
    pub first_length_rad: f64,
    /// Length of the path that the trajectory follows, before its corners were rounded.
    pub length_rad: f64,
    /// Duration of the motion along the first path after shortcutting, in seconds: never less than that of the trajectory.
    pub first_duration_s: f64,
    /// Iterations of search and improvement.
    pub iterations: usize,
    /// Whether the caller's time was up before all iterations of improvement were done: with more time the path may be another.
    pub time_up: bool,
}

/// Plans a motion of the arm in a scene. `control` is called about every millisecond and says whether to go on.
///
/// # Errors
/// [`PlanError`], which names the shapes in the way, or the part of the request that is wrong.
pub fn plan(
    robot: &Robot,
    scene: &Scene,
    request: &Request,
    control: &mut dyn FnMut(Progress<'_>) -> Control,
) -> Result<Plan, PlanError> {
    // An encoder may read a little beyond a limit at which the joint stands.
    let request = &Request { start: robot.within_limits(&request.start), ..request.clone() };
    request.check(robot, scene)?;
    let Some(arm) = WithEnds::about(robot, &request.start.arm) else {
        return plan_with_ends(robot, scene, request, control);
    };
    let mut told = |progress: Progress<'_>| match progress {
        Progress::Usable(plan) => control(Progress::Usable(&arm.wound(plan.clone()))),
        other => control(other),
    };
    match plan_with_ends(&arm.robot, scene, &arm.request(request), &mut told) {
        Ok(plan) => Ok(arm.wound(plan)),
        // These are the original goals, reached by other turns.
        Err(PlanError::NoGoal { reasons, .. }) => Err(PlanError::NoGoal { goals: request.goals.len(), reasons }),
        Err(error) => Err(error),
    }
}

/// As `plan`, for an arm without continuous joints.
fn plan_with_ends(
    robot: &Robot,
    scene: &Scene,
    request: &Request,
    control: &mut dyn FnMut(Progress<'_>) -> Control,
) -> Result<Plan, PlanError> {
    let mut pace = Pace::new(control);
    let mut arm = ArmInScene::new(robot, scene, request)?;
    let depart = departure(&mut arm, &mut pace)?;
    arm.keep_from(&depart)?;
    if let Some(way) = &request.straight {
        arm.pad_at_least_tightly();
        return plan_straight(&mut arm, way, &depart, &mut pace);
    }
    let start = depart[depart.len() - 1];
    let door = door(&mut arm, &start)?;
    let way_out_rad = if door == state(&start) { 0.0 } else { distance(&start, &arm.joints(&door)) };
    let before_rad = length(&depart) + way_out_rad;
    arm.pad_at_least_tightly();
    let mut candidates = Candidates::find(&mut arm, &start, &mut pace)?;
    loop {
        let first = first_way(&mut arm, &start, &door, &candidates, &mut pace)?;
        let candidate = &candidates[first.candidate];
        let first_length_rad = before_rad + f64::from(path_length(&first.path)) + candidate.length_rad;
        let (goal, before) = (candidate.goal(), Before { depart: &depart, length_rad: before_rad, first_length_rad });
        match Improvement::new(&mut arm, &mut candidates, before).run(first, &mut pace) {
            Err(PlanError::Unseen { reason }) => {
                if !arm.doubt_between(&start, &goal, &mut pace)? {
                    return Err(PlanError::Unseen { reason });
                }
            }
            planned => return planned,
        }
    }
}

/// The first free path from the door at the start to the door of a candidate.
fn first_way(
    arm: &mut ArmInScene<'_>,
    start: &JointVector,
    door: &State,
    candidates: &Candidates<'_>,
    pace: &mut Pace<'_>,
) -> Result<Way, PlanError> {
    let doors = candidates.doors();
    let budget = Budget { iterations: MAX_SEARCH_ITERATIONS, seed: arm.request().seed };
    pace.iteration()?;
    let mut route = arm.connect(door, &doors, budget, pace);
    if matches!(route, Err(ConnectError::Exhausted { .. })) && arm.doubt_between(start, &arm.joints(&doors[0]), pace)? {
        route = arm.connect(door, &doors, budget, pace);
    }
    match route {
        Ok(route) => {
            pace.iterations += route.iterations;
            Ok(Way { path: route.path, candidate: route.goal })
        }
        Err(ConnectError::Cancelled) => Err(PlanError::Cancelled),
        Err(ConnectError::TimeUp { .. }) => Err(PlanError::TimeUp),
        Err(_) => {
            let collision = arm.edge_collision(start, &arm.joints(&doors[0]));
            Err(PlanError::NoPath {
                postures: doors.len(),
                iterations: MAX_SEARCH_ITERATIONS,
                collision: collision.map_or_else(|| "nothing is in the way".to_owned(), |c| c.to_string()),
            })
        }
    }
}

/// Whether a posture that touches nothing has enough room for a motion to begin there.
///
/// # Errors
/// [`PlanError::NoRoom`] names what is close.
pub(crate) fn has_room(robot: &Robot, scene: &Scene, start: &Configuration) -> Result<(), PlanError> {
    let arm = WithEnds::about(robot, &start.arm);
    let (robot, start) = match &arm {
        Some(arm) => (&arm.robot, Configuration { arm: arm.start, ..*start }),
        None => (robot, *start),
    };
    let request = Request::new(start, vec![Goal::Joints(start.arm)]);
    door(&mut ArmInScene::new(robot, scene, &request)?, &start.arm).map(drop)
}

fn door(arm: &mut ArmInScene<'_>, posture: &JointVector) -> Result<State, PlanError> {
    if let Some(door) = arm.door(posture) {
        return Ok(door);
    }
    if arm.tells_apart_at(posture)
        && let Some(door) = arm.door(posture)
    {
        return Ok(door);
    }
    let reason = match arm.collision(posture, Contact::None) {
        Some(collision) => collision.to_string(),
        None => arm.crowding(posture).unwrap_or_else(|| "there is too little room to move".to_owned()),
    };
    Err(PlanError::NoRoom { reason })
}
