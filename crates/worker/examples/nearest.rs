//! A worker in one file: which object is nearest to a pose, in the world that the goal works on.

use ratn_worker::prelude::*;
use std::error::Error;
use std::process::ExitCode;

/// `inspector/nearest`
struct Nearest;

#[async_trait]
impl Action for Nearest {
    fn name(&self) -> &str {
        "nearest"
    }

    fn description(&self) -> &str {
        "The object nearest to a pose."
    }

    /// Goals are checked against it, and whoever asks is told.
    fn signature(&self) -> Option<Signature> {
        let ports =
            Signature::new().input("from", Type::Pose).with_default("within_m", Type::Float, Value::Float(10.0));
        let ports = ports.output("object", Type::String).output("distance_m", Type::Float);
        Some(ports.outcome("nothing_near").computes().reads("at(?)"))
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let (from, within_m) = (goal.input_pose("from")?, goal.input_float("within_m")?);
        // The projection where the goal has one, else the root world. `?` on any error ends the goal `aborted` with it.
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
        let Some((object, distance_m)) = best else { return Ok(GoalOutcome::named("nothing_near")) };
        Ok(GoalOutcome::success()
            .with_output("object", Value::String(object.to_owned()))
            .with_output("distance_m", Value::Float(distance_m)))
    }
}

fn nearer(pose: &Pose, from: &Pose, best: Option<(&str, f64)>, within_m: f64) -> Option<f64> {
    let distance_m = pose.distance(from);
    (distance_m <= within_m && best.is_none_or(|(_, least)| distance_m < least)).then_some(distance_m)
}

fn main() -> Result<ExitCode, Box<dyn Error>> {
    Ok(Worker::from_args()?.provides("inspector", "Inspector").action(Nearest).start())
}
