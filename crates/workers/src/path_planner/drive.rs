//! `path_planner/drive`: plans a motion of the base in the goal's projection. Inputs: `arm` (the arm's posture), `goal` (a pose on the
//! floor, or a list of such poses); optional `start`, `position_tolerance_m`, `heading_tolerance_rad`, `speed`, and `pan`, `tilt`,
//! `width_m`, `other_arms`, and `cloud` with its parameters as for `path_planner/plan`.

use super::arms;
use super::goal::{Said, seen};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_motion::base::{DriveError, DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::robot::Robot;
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, SceneCache, Signature};
use ratn_world::scene::Scene;
use std::sync::Arc;
use std::time::Instant;

/// Default fraction of the base's limits.
const DEFAULT_SPEED: f64 = 0.5;

/// The action `path_planner/drive`: plans a motion of the base.
#[derive(Debug)]
pub struct DriveAction {
    robot: Arc<Robot>,
    speed: f64,
    scenes: Arc<SceneCache>,
}

impl DriveAction {
    pub(super) fn new(robot: &Arc<Robot>, speed: f64, scenes: &Arc<SceneCache>) -> DriveAction {
        DriveAction { robot: Arc::clone(robot), speed, scenes: Arc::clone(scenes) }
    }
}

#[tonic::async_trait]
impl Action for DriveAction {
    fn name(&self) -> &str {
        "drive"
    }

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled("PathPlanner", self.name())
    }

    fn description(&self) -> &str {
        "A collision-free way of the base to a place on the floor, timed."
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let begin = Instant::now();
        let robot = arms::standing(&self.robot, &goal)?;
        let scene = goal.unless_cancelled(goal.scene(&self.scenes)).await??;
        let scene = arms::carried(&robot, scene)?;
        let request = request(&goal, &robot, &scene)?;
        let goal = Arc::new(goal);
        let asking = Arc::clone(&goal);
        let mut control = move |_| if asking.cancelled.is_cancelled() { Control::Cancelled } else { Control::Continue };
        let planning = tokio::task::spawn_blocking(move || plan_drive(&robot, &scene, &request, &mut control));
        match planning.await? {
            Ok(plan) => Ok(GoalOutcome::success()
                .with_output("trajectory", Value::Trajectory(plan.trajectory))
                .with_output("end", Value::Pose(on_floor(plan.end)))
                .with_output("length_m", Value::Float(plan.length))
                .with_output("planning_s", Value::Float(begin.elapsed().as_secs_f64() * self.speed))),
            Err(DriveError::Cancelled) => Err(goal.stopped()),
            Err(error) => Err(error.into()),
        }
    }
}

fn request(goal: &GoalContext, robot: &Robot, scene: &Scene) -> Result<DriveRequest, ActionFailure> {
    let goals = match goal.port("goal").any()? {
        Value::List(_) => goal.port("goal").list()?.iter().map(|port| port.pose()).collect::<Result<Vec<_>, _>>()?,
        _ => vec![goal.input_pose("goal")?],
    };
    let start = goal.port("start").optional().map(|port| port.pose()).transpose()?;
    let here = Said::read(goal, robot, "arm")?.in_scene(robot, scene);
    Ok(DriveRequest {
        start: here.with_base(&start.unwrap_or(scene.base)),
        goals: goals.iter().map(place).collect(),
        position_tolerance_m: goal.optional_float("position_tolerance_m")?.unwrap_or(0.0),
        heading_tolerance_rad: goal.optional_float("heading_tolerance_rad")?.unwrap_or(0.0),
        speed: goal.optional_float("speed")?.unwrap_or(DEFAULT_SPEED),
        seen: seen(goal)?,
        seed: goal.seed,
    })
}

fn place(pose: &Pose) -> [f64; 3] {
    ratn_motion::robot::on_floor(pose)
}

fn on_floor([x, y, heading]: [f64; 3]) -> Pose {
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, heading)
}
