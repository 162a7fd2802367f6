//! The path planner worker: `plan` for the arm, and `drive` for the base.
//!
//! It has the scene of the goal's projection sent, as what it differs by from one that it knows, plans on a thread of its own and answers with a timed
//! trajectory. All durations in its goals and answers are in the robot's seconds; `clock` knows how many of them pass in
//! one of ours. Where `budget_s` is given, planning takes exactly that long and gets a quicker motion for it; else the first path is
//! improved for 50 ms of our time.

mod arms;
mod bounds;
mod clock;
mod drive;
mod goal;

use clock::{Clock, Figures};
pub use drive::DriveAction;
use ratn_model::value::Value;
use ratn_motion::plan::{Plan, PlanError, plan};
use ratn_motion::robot::Robot;
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, SceneCache};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// `path_planner/plan`.
#[derive(Debug)]
pub struct PlanAction {
    robot: Arc<Robot>,
    speed: f64,
    scenes: Arc<SceneCache>,
}

/// The worker for a robot; `speed` is how many of the robot's seconds pass in one of ours.
pub fn worker(options: WorkerOptions, robot: Robot, speed: f64) -> Worker {
    let plan = PlanAction::new(robot, speed);
    let drive = DriveAction::new(&plan.robot, speed, &plan.scenes);
    Worker::new(options).action(plan).action(drive)
}

/// Runs the [`worker`] until it is told to stop.
///
/// # Errors
/// Where it cannot serve.
pub async fn run(options: WorkerOptions, robot: Robot, speed: f64) -> anyhow::Result<()> {
    Ok(worker(options, robot, speed).run().await?)
}

impl PlanAction {
    /// For a robot.
    pub fn new(robot: Robot, speed: f64) -> PlanAction {
        PlanAction { robot: Arc::new(robot), speed, scenes: Arc::default() }
    }
}

#[tonic::async_trait]
impl Action for PlanAction {
    fn name(&self) -> &str {
        "plan"
    }

    fn description(&self) -> &str {
        "A collision-free motion of the arm from joints to joints or to a pose of the tool, timed."
    }

    fn can_be_suspended(&self) -> bool {
        // It moves nothing.
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let begin = Instant::now();
        let robot = arms::moving(&self.robot, &goal)?;
        let (asked, budget_s) = goal::asked(&goal, &robot)?;
        // Whatever the task declared that this plan depends on, and no more.
        let scene = goal.unless_cancelled(goal.scene(&self.scenes)).await??;
        let request = asked.in_scene(&robot, &scene);

        let goal = Arc::new(goal);
        let mut clock = Clock::new(begin, self.speed, budget_s, Arc::clone(&goal));
        let planning = tokio::task::spawn_blocking(move || {
            let outcome = plan(&robot, &scene, &request, &mut |progress| clock.control(progress));
            (outcome, clock.figures())
        });
        match planning.await? {
            (Ok(plan), figures) => Ok(outcome(plan, &figures)),
            (Err(PlanError::Cancelled), _) => Err(goal.stopped()),
            (Err(PlanError::TimeUp), figures) => {
                let reason = format!("{} ({:.1} s)", PlanError::TimeUp, figures.planning_s);
                Err(ActionFailure::aborted(reason))
            }
            (Err(error), _) => Err(error.into()),
        }
    }
}

fn outcome(plan: Plan, figures: &Figures) -> GoalOutcome {
    let outputs: BTreeMap<String, Value> = [
        ("trajectory", Value::Trajectory(plan.trajectory)),
        ("end", Value::Joints(plan.end.to_vec())),
        ("end_pose", Value::Pose(plan.end_pose)),
        ("first_path_s", Value::Float(figures.first_path_s)),
        ("first_length_rad", Value::Float(plan.first_length_rad)),
        ("length_rad", Value::Float(plan.length_rad)),
        ("planning_s", Value::Float(figures.planning_s)),
        ("iterations", Value::Int(i64::try_from(plan.iterations).unwrap_or(i64::MAX))),
    ]
    .map(|(port, value)| (port.to_owned(), value))
    .into();
    GoalOutcome { outputs, ..GoalOutcome::success() }
}
