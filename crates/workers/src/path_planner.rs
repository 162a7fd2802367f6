//! The path planner worker: `plan` for the arm, and `drive` for the base.
//!
//! For each goal it fetches the scene of the goal's projection (as the difference to a scene that it has), plans on a thread of its own, and
//! answers with a timed trajectory. All durations in goals and answers are in the robot's seconds; `clock` converts them to wall time. With
//! `budget_s`, planning takes exactly that long and finds a quicker motion. Without it, the first path is improved for 50 ms of wall time.

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

/// The action `path_planner/plan`: plans a motion of an arm.
#[derive(Debug)]
pub struct PlanAction {
    robot: Arc<Robot>,
    speed: f64,
    scenes: Arc<SceneCache>,
}

/// The worker for a robot, which does not run yet. `speed` is how many of the robot's seconds pass in one second of wall time.
pub fn worker(options: WorkerOptions, robot: Robot, speed: f64) -> Worker {
    let plan = PlanAction::new(robot, speed);
    let drive = DriveAction::new(&plan.robot, speed, &plan.scenes);
    Worker::new(options).action(plan).action(drive)
}

/// Runs the [`worker`] until a signal or the end of the parent process.
///
/// # Errors
/// The worker cannot start, or serving failed ([`ratn_worker::worker::WorkerError`]).
pub async fn run(options: WorkerOptions, robot: Robot, speed: f64) -> anyhow::Result<()> {
    Ok(worker(options, robot, speed).run().await?)
}

impl PlanAction {
    /// The action for a robot; `speed` as for [`worker`].
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
