//! The path planner worker: `plan` for the arm, and `drive` for the base.
//!
//! For each goal it fetches the scene of the goal's projection (as the difference from a scene that it has), plans on a thread of its own,
//! and returns a timed trajectory. All durations in goals and answers are in seconds of robot time; `clock` converts them to wall time.
//! With `budget_s`, planning takes exactly that long and finds a quicker motion. Without it, the first path is improved as long as that
//! saves more of the motion than it takes, but for at least 50 ms of wall time. If the goal may improve its result, this is its first
//! result, and planning goes on.

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
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, SceneCache, Signature};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::oneshot;

/// The action `path_planner/plan`: plans a motion of an arm.
#[derive(Debug)]
pub struct PlanAction {
    robot: Arc<Robot>,
    speed: f64,
    scenes: Arc<SceneCache>,
}

/// The worker for a robot, not running yet. `speed` is the number of seconds of robot time per second of wall time.
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

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled("PathPlanner", self.name())
    }

    fn description(&self) -> &str {
        "A collision-free motion of the arm from joints to joints or to a pose of the tool, timed."
    }

    fn can_be_suspended(&self) -> bool {
        // The action moves nothing.
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let begin = Instant::now();
        let robot = arms::moving(&self.robot, &goal)?;
        let (asked, budget_s) = goal::asked(&goal, &robot)?;
        // The scene contains what the task declared as read by this plan, and nothing more.
        let scene = goal.unless_cancelled(goal.scene(&self.scenes)).await??;
        let scene = arms::in_hands(&robot, scene)?;
        let request = asked.in_scene(&robot, &scene);

        let goal = Arc::new(goal);
        let mut clock = Clock::new(begin, self.speed, budget_s, Arc::clone(&goal));
        let (tell, planned) = oneshot::channel();
        let planning = move || {
            let outcome = plan(&robot, &scene, &request, &mut |progress| clock.control(progress));
            let _ = tell.send((outcome, clock.figures()));
        };
        // A thread of its own, so that its nice value affects no later goal.
        std::thread::Builder::new().name("planner".to_owned()).spawn(planning)?;
        let planned =
            planned.await.map_err(|_| ActionFailure::aborted("the planner panicked: see the worker's log"))?;
        match planned {
            (Ok(plan), figures) => Ok(GoalOutcome { outputs: outputs(&plan, &figures), ..GoalOutcome::success() }),
            (Err(PlanError::Cancelled), _) => Err(goal.stopped()),
            (Err(PlanError::TimeUp), figures) => {
                let reason = format!("{} ({:.1} s)", PlanError::TimeUp, figures.planning_s);
                Err(ActionFailure::aborted(reason))
            }
            (Err(error), _) => Err(error.into()),
        }
    }
}

fn outputs(plan: &Plan, figures: &Figures) -> BTreeMap<String, Value> {
    [
        ("trajectory", Value::Trajectory(plan.trajectory.clone())),
        ("end", Value::Joints(plan.end.to_vec())),
        ("end_pose", Value::Pose(plan.end_pose)),
        ("first_path_s", Value::Float(figures.first_path_s)),
        ("first_length_rad", Value::Float(plan.first_length_rad)),
        ("length_rad", Value::Float(plan.length_rad)),
        ("planning_s", Value::Float(figures.planning_s)),
        ("iterations", Value::Int(i64::try_from(plan.iterations).unwrap_or(i64::MAX))),
    ]
    .map(|(port, value)| (port.to_owned(), value))
    .into()
}
