//! A goal of the path planner, read from its inputs: `start`, `goal` (joints, a pose, or a list of these); optional `depart_m`,
//! `approach_m` (straight parts; with `…_direction` and `…_frame`, by default straight up and straight down), `straight`, `way_points`,
//! `blend_m` (straight lines of the tool between them, too), `upright_rad` (maximum tilt of the tool's axis that points up), `reaches_into`
//! (names of hollow objects that the fingers may enter on the straight parts), `cloud` (points from a depth camera), `speed`, `budget_s`;
//! `pan`, `tilt` and `width_m` (of head and fingers, as reported by `pan_tilt` and `gripper`; by default [`assumed`]: the head looks
//! straight ahead, the fingers are around a held object, else open). Constraints of the motion: `bounds`.

use super::bounds;
use ratn_model::value::Value;
use ratn_motion::arm::assumed;
use ratn_motion::cloud::Cloud;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::{Goal, Request};
use ratn_motion::point_files::points_by_content;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::seen::{KNOWN_WITHIN_M, Seen};
use ratn_motion::straight::{Frame, Straight};
use ratn_motion::way_points::WayPoints;
use ratn_worker::action::{ActionFailure, GoalContext};
use ratn_world::scene::Scene;
use std::sync::Arc;

/// Default fraction of the joints' limits.
const DEFAULT_SPEED: f64 = 0.3;

/// Maximum budget of a goal, in seconds of robot time.
const MOST_BUDGET_S: f64 = 86_400.0;

/// Default radius of the ball around a measured point, in metres.
const POINT_RADIUS_M: f64 = 0.01;

/// Posture of arm, head and fingers, as far as given.
#[derive(Debug, Clone, Copy)]
pub(super) struct Said {
    arm: JointVector,
    pan: Option<f64>,
    tilt: Option<f64>,
    width_m: Option<f64>,
}

/// A request that still needs its scene.
#[derive(Debug)]
pub(super) struct Asked {
    said: Said,
    /// The start is not set yet.
    request: Request,
}

impl Asked {
    /// Sets the start by a scene.
    pub(super) fn in_scene(self, robot: &Robot, scene: &Scene) -> Request {
        Request { start: self.said.in_scene(robot, scene), ..self.request }
    }
}

impl Said {
    /// From the inputs `pan`, `tilt`, `width_m`, and the one with the arm's posture.
    pub(super) fn read(goal: &GoalContext, robot: &Robot, arm_port: &str) -> Result<Said, ActionFailure> {
        let of_part = |port: &str, is_there: bool, lacks: &str| match goal.optional_float(port)? {
            Some(_) if !is_there => Err(ActionFailure::aborted(format!(
                "input `{port}` is given, but the robot `{}` has no {lacks}: leave the input out",
                robot.name()
            ))),
            said => Ok(said),
        };
        let (head, fingers) = (!robot.head_joints().is_empty(), robot.finger().is_some());
        Ok(Said {
            arm: joints(robot, arm_port, goal.input_joints(arm_port)?)?,
            pan: of_part("pan", head, "head that turns (its description has no `[head]`)")?,
            tilt: of_part("tilt", head, "head that turns (its description has no `[head]`)")?,
            width_m: of_part("width_m", fingers, "gripper on this arm (its description has none)")?,
        })
    }

    /// The configuration of the whole robot; missing values are assumed.
    pub(super) fn in_scene(self, robot: &Robot, scene: &Scene) -> Configuration {
        let assumed = assumed(robot, scene);
        Configuration {
            arm: self.arm,
            pan: self.pan.unwrap_or(assumed.pan),
            tilt: self.tilt.unwrap_or(assumed.tilt),
            finger: self.width_m.map_or(assumed.finger, |width| width / 2.0),
            ..assumed
        }
    }
}

/// The request, and the budget in seconds of robot time.
pub(super) fn asked(goal: &GoalContext, robot: &Robot) -> Result<(Asked, Option<f64>), ActionFailure> {
    let budget_s = goal.optional_float("budget_s")?;
    if let Some(s) = budget_s
        && !(0.0..=MOST_BUDGET_S).contains(&s)
    {
        return Err(ActionFailure::aborted(format!(
            "input `budget_s` is {s}: expected seconds, from 0 to {MOST_BUDGET_S}"
        )));
    }
    let request = Request {
        depart: straight(goal, "depart", Straight::up)?,
        approach: straight(goal, "approach", Straight::down)?,
        straight: way_points(goal)?,
        upright_rad: goal.optional_float("upright_rad")?,
        keep: bounds::keep(goal)?,
        keep_out: bounds::kept_out(goal)?,
        scales: bounds::scales(goal, robot.arm_joints().len())?,
        tool_speed: bounds::tool_speed(goal)?,
        reaches_into: names(goal)?,
        seen: seen(goal)?,
        speed: goal.optional_float("speed")?.unwrap_or(DEFAULT_SPEED),
        seed: goal.seed,
        // The clock ends the improvement.
        improvement_iterations: usize::MAX,
        // The start is set when the scene is known.
        ..Request::new(robot.at_zero(), goals(robot, goal.port("goal").any()?)?)
    };
    Ok((Asked { said: Said::read(goal, robot, "start")?, request }, budget_s))
}

/// A straight part from the inputs `…_m`, `…_direction` and `…_frame`; `usual` is the part without a direction.
fn straight(goal: &GoalContext, which: &str, usual: fn(f64) -> Straight) -> Result<Straight, ActionFailure> {
    let port = |end: &str| format!("{which}_{end}");
    let length_m = goal.optional_float(&port("m"))?.unwrap_or(0.0);
    let direction = goal.port(&port("direction")).optional().map(|port| port.vector3()).transpose()?;
    let frame = goal.port(&port("frame")).optional().map(|port| port.string()).transpose()?;
    match (direction, frame) {
        (None, None) => Ok(usual(length_m)),
        (Some(direction), frame) => {
            Ok(Straight { direction, frame: frame.map_or(Frame::World, Frame::from), length_m })
        }
        (None, Some(frame)) => Err(ActionFailure::aborted(format!(
            "input `{which}_frame` is {frame}, but `{which}_direction` is missing: say along which direction of that frame"
        ))),
    }
}

/// Whether the tool moves in straight lines all the way, and through which poses.
fn way_points(goal: &GoalContext) -> Result<Option<WayPoints>, ActionFailure> {
    let straight = goal.port("straight").optional().map(|port| port.bool()).transpose()?;
    let blend_m = goal.optional_float("blend_m")?;
    let through = match goal.port("way_points").optional() {
        Some(port) => Some(port.list()?.iter().map(|pose| pose.pose()).collect::<Result<Vec<_>, _>>()?),
        None => None,
    };
    match (straight, through) {
        (Some(false), Some(_)) => Err(ActionFailure::aborted(
            "input `straight` is false, but `way_points` are there, which are passed in straight lines: leave one of them out",
        )),
        (Some(false) | None, None) if blend_m.is_some_and(|blend_m| blend_m > 0.0) => Err(ActionFailure::aborted(
            "input `blend_m` is given, but the motion has no corners to round: it rounds those of a motion with `straight: true` or \
             `way_points`; give one of them, or leave it out",
        )),
        (Some(false) | None, None) => Ok(None),
        (_, through) => Ok(Some(WayPoints { through: through.unwrap_or_default(), blend_m: blend_m.unwrap_or(0.0) })),
    }
}

/// Points from a depth camera: `cloud`, a PCD or PLY file with points in the world frame, with `cloud_radius_m` and `cloud_known_within_m`.
pub(super) fn seen(goal: &GoalContext) -> Result<Option<Seen>, ActionFailure> {
    let radius_m = goal.optional_float("cloud_radius_m")?.unwrap_or(POINT_RADIUS_M);
    let known_within_m = goal.optional_float("cloud_known_within_m")?.unwrap_or(KNOWN_WITHIN_M);
    let Some(port) = goal.port("cloud").optional() else { return Ok(None) };
    let wrong = |reason: String| ActionFailure::aborted(format!("input `cloud`: {reason}"));
    let points = points_by_content(port.bytes()?).map_err(|error| wrong(error.to_string()))?;
    let cloud = Cloud::new("what was seen", &points, radius_m).map_err(|error| wrong(error.to_string()))?;
    Ok(Some(Seen { cloud: Arc::new(cloud), known_within_m }))
}

fn names(goal: &GoalContext) -> Result<Vec<String>, ActionFailure> {
    let Some(port) = goal.port("reaches_into").optional() else { return Ok(Vec::new()) };
    port.list()?.iter().map(|name| Ok(name.string()?.to_owned())).collect()
}

fn goals(robot: &Robot, value: &Value) -> Result<Vec<Goal>, ActionFailure> {
    match value {
        Value::Joints(values) => Ok(vec![Goal::Joints(joints(robot, "goal", values)?)]),
        Value::Pose(pose) => Ok(vec![Goal::Pose(*pose)]),
        Value::List(alternatives) => {
            let one = |value: &Value| match value {
                Value::List(_) => Err(not_a_goal(value)),
                _ => goals(robot, value),
            };
            let goals: Result<Vec<Vec<Goal>>, ActionFailure> = alternatives.iter().map(one).collect();
            Ok(goals?.concat())
        }
        other => Err(not_a_goal(other)),
    }
}

fn not_a_goal(value: &Value) -> ActionFailure {
    let found = value.type_name();
    ActionFailure::aborted(format!("input `goal` has a {found}: expected joints, a pose, or a list of these"))
}

fn joints(robot: &Robot, port: &str, values: &[f64]) -> Result<JointVector, ActionFailure> {
    let expected = robot.arm_joints().len();
    let vector = JointVector::read(values).ok().filter(|vector| vector.len() == expected);
    vector.ok_or_else(|| {
        let (found, name) = (values.len(), robot.name());
        ActionFailure::aborted(format!(
            "input `{port}` has {found} joints: expected {expected}, as many as the arm of {name} has"
        ))
    })
}
