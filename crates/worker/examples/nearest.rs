//! A worker in one file: which object is nearest to a pose, in the world that the goal works on.

use ratn_model::fact::{FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::error::Error;

/// `inspector/nearest`
struct Nearest;

#[tonic::async_trait]
impl Action for Nearest {
    fn name(&self) -> &str {
        "nearest"
    }

    fn description(&self) -> &str {
        "The object nearest to a pose."
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        // A missing or ill-typed input ends the goal `aborted` with a message that names it.
        let from = goal.input_pose("from")?;
        let within_m = goal.optional_float("within_m")?.unwrap_or(f64::INFINITY);
        // The projection where the goal has one, else the root world. `?` on any error aborts with it.
        let every_place = FactPattern { predicate: "at".to_owned(), arguments: vec![None] };
        let facts = goal.unless_cancelled(goal.facts(&[every_place])).await??;
        goal.progress(format!("{} objects", facts.len()));

        let mut best: Option<(&str, f64)> = None;
        for fact in &facts {
            // Often enough to end within a tenth of a second. Heavy work goes to `spawn_blocking` and looks there.
            goal.checkpoint()?;
            if let ([Term::Name(object)], Value::Pose(pose)) = (fact.key.arguments.as_slice(), &fact.value)
                && let Some(distance_m) = nearer(pose, &from, best, within_m)
            {
                best = Some((object, distance_m));
            }
        }
        let (object, distance_m) = best.ok_or_else(|| ActionFailure::aborted("there is no object so near"))?;
        Ok(GoalOutcome::success()
            .with_output("object", Value::String(object.to_owned()))
            .with_output("distance_m", Value::Float(distance_m)))
    }
}

fn nearer(pose: &Pose, from: &Pose, best: Option<(&str, f64)>, within_m: f64) -> Option<f64> {
    let distance_m = pose.distance(from);
    (distance_m <= within_m && best.is_none_or(|(_, least)| distance_m < least)).then_some(distance_m)
}

#[tokio::main]
async fn main() -> Result<(), Box<dyn Error>> {
    Worker::new(options()?).action(Nearest).run().await?;
    Ok(())
}

/// What the template of the process manager passes.
fn options() -> Result<WorkerOptions, Box<dyn Error>> {
    let mut options = WorkerOptions { exit_with_parent: true, ..WorkerOptions::default() };
    let mut arguments = std::env::args().skip(1);
    while let Some(name) = arguments.next() {
        let value = arguments.next().ok_or_else(|| format!("{name} needs a value"))?;
        match name.as_str() {
            "--id" => options.id = value,
            "--listen" => options.listen = value.parse()?,
            "--endpoint-file" => options.endpoint_file = Some(value.into()),
            _ => return Err(format!("there is no option {name}").into()),
        }
    }
    Ok(options)
}
