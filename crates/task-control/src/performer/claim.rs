//! Which runs may be under way beside each other: each run has a resource in its session, which the other runs see.

use super::told::Told;
use crate::NotStarted;
use crate::record::said;
use anyhow::bail;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::Resource;
use ratn_worker::client::{ResourceClient, retry_unanswered};
use std::time::Duration;

/// Maximum number of runs under way on a system.
const MOST_RUNS: usize = 64;
/// Interval at which a run checks whether others are under way.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// The attributes of the resource that says that a run is under way: its task,
const TASK: &str = "task";
/// and whether no other run may be.
const ALONE: &str = "alone";
/// The kind of that resource, whose id is the run's.
pub const RUN_KIND: &str = "Run";

/// Marks a run as under way on a system; true if others are. It runs beside them, unless it or one of them is to be `alone`. The mark is a resource
/// with the run's id, which vanishes with the run's session.
///
/// # Errors
/// If it may not run beside those under way, if it is under way already, or if the resource manager cannot be asked.
pub async fn claim(resources: &ResourceClient, run: &str, task: &str, alone: bool) -> anyhow::Result<bool> {
    claim_as("", resources, run, task, alone).await
}

/// Like `claim`, under a request id that a resumption knows; under a fresh one if `request` is empty.
pub(super) async fn claim_as(
    request: &str,
    resources: &ResourceClient,
    run: &str,
    task: &str,
    alone: bool,
) -> anyhow::Result<bool> {
    // Checked before others see the mark: a refused run is in nobody's way.
    others(resources, run, alone).await?;
    let claim = Resource::new(run, ResourceClass::Task, RUN_KIND)
        .with_attribute(TASK, Value::String(task.to_owned()))
        .with_attribute(ALONE, Value::Bool(alone));
    match retry_unanswered(|| resources.create_once(request, claim.clone())).await {
        Ok(_) => {}
        Err(error) if error.code() == Some(tonic::Code::AlreadyExists) => {
            return Err(NotStarted(format!("{run} is under way on this system")).into());
        }
        Err(error) => bail!("cannot begin the run: {}", said(&error)),
    }
    // If two runs begin at the same moment, each sees the other.
    others(resources, run, alone).await
}

/// Reports to `told` repeatedly whether other runs are under way on the system.
pub(super) async fn look_for_others(resources: ResourceClient, run: String, told: Told) {
    loop {
        tokio::time::sleep(LOOK_AGAIN).await;
        if let Ok(runs) = resources.list(&[RUN_KIND]).await {
            told.beside_others(runs.iter().any(|other| other.id != run));
        }
    }
}

/// Whether other runs are under way; an error if this one may not run beside them.
async fn others(resources: &ResourceClient, run: &str, alone: bool) -> anyhow::Result<bool> {
    let runs = retry_unanswered(|| resources.list(&[RUN_KIND])).await;
    let runs = runs.map_err(|error| anyhow::anyhow!("cannot begin the run: {}", said(&error)))?;
    let others: Vec<&Resource> = runs.iter().filter(|other| other.id != run).collect();
    let task_of = |other: &Resource| match other.attributes.get(TASK) {
        Some(Value::String(task)) => format!("`{task}`"),
        _ => other.id.clone(),
    };
    let goes_alone = others.iter().find(|other| other.attributes.get(ALONE) == Some(&Value::Bool(true)));
    let message = match goes_alone {
        Some(other) => {
            let task = task_of(other);
            format!("{task} is under way on this system and goes alone: wait for its end, or use a system of your own")
        }
        None if alone && !others.is_empty() => {
            let tasks: Vec<String> = others.iter().map(|other| task_of(other)).collect();
            let tasks = tasks.join(", ");
            format!("another run is under way on this system ({tasks}): wait for its end, or use a system of your own")
        }
        None if others.len() >= MOST_RUNS => {
            format!("{MOST_RUNS} runs are under way on this system, as many as there may be: wait for the end of one")
        }
        None => return Ok(!others.is_empty()),
    };
    Err(NotStarted(message).into())
}
