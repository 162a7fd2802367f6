//! The detector worker: finds boxes on a surface in depth images.
//!
//! It asks the camera of its goal's own lease for a picture and works on nothing else: the picture, the camera's pose in it,
//! and the region or the box that the goal names. What it finds is named `box_1`, `box_2`, …, the nearest first.

use ratn_model::value::Value;
use ratn_perception::camera::{Camera, DepthImage, Intrinsics};
use ratn_perception::detection::{BoxEstimate, Region, locate, segment};
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, InputError, Port};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;

/// Frames of a picture in which a whole surface is searched, unless the goal says otherwise: noise falls with their root.
const SEGMENT_FRAMES: i64 = 60;
/// Frames of a picture in which one known box is looked for.
const LOCATE_FRAMES: i64 = 8;

/// Serves until told to stop. The robot's time (`speed`) passes in the camera; the detector is as fast as it is.
///
/// # Errors
/// Where it cannot serve.
pub async fn run(options: WorkerOptions, _speed: f64) -> anyhow::Result<()> {
    Ok(worker(options).run().await?)
}

/// The worker, not running yet.
pub fn worker(options: WorkerOptions) -> Worker {
    Worker::new(options).action(Segment).action(Locate)
}

/// `detector/segment`
#[derive(Debug)]
pub struct Segment;

/// `detector/locate`
#[derive(Debug)]
pub struct Locate;

#[tonic::async_trait]
impl Action for Segment {
    fn name(&self) -> &str {
        "segment"
    }

    fn description(&self) -> &str {
        "Every box that stands on a surface, the nearest to the camera first."
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let (pose, size) = (goal.port("region").field("pose").pose()?, goal.port("region").field("size").list()?);
        let [x, y, ..] = &size[..] else {
            let reason = format!("input `region.size` has {} numbers: expected at least 2, x and y", size.len());
            return Err(ActionFailure::aborted(reason));
        };
        let region = Region { pose, size: [x.float()?, y.float()?] };
        let (image, camera) = picture(&goal, SEGMENT_FRAMES).await?;
        let found = working(&goal, move || segment(&image, &camera, &region)).await??;
        goal.progress(format!("{} boxes", found.len()));
        let named = found.iter().enumerate().map(|(i, estimate)| {
            Value::map([
                ("id", Value::String(format!("box_{}", i + 1))),
                ("pose", Value::Pose(estimate.pose)),
                ("size", size_value(estimate)),
            ])
        });
        Ok(GoalOutcome::success().with_output("boxes", Value::List(named.collect())))
    }
}

#[tonic::async_trait]
impl Action for Locate {
    fn name(&self) -> &str {
        "locate"
    }

    fn description(&self) -> &str {
        "Where a box that was seen before stands now."
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let object = goal.port("object");
        let prior = BoxEstimate { pose: object.field("pose").pose()?, size: object.field("size").vector3()? };
        let id = object.field("id").string()?.to_owned();
        let (image, camera) = picture(&goal, LOCATE_FRAMES).await?;
        let found = working(&goal, move || locate(&image, &camera, &prior)).await??;
        let found = found.ok_or_else(|| {
            let [x, y, z] = prior.pose.position;
            ActionFailure::aborted(format!("{id} is not near ({x:.2}, {y:.2}, {z:.2}), where it was seen before"))
        })?;
        let outcome = GoalOutcome::success().with_output("pose", Value::Pose(found.pose));
        Ok(outcome.with_output("size", size_value(&found)))
    }
}

/// A picture of the leased camera.
async fn picture(goal: &GoalContext, default_frames: i64) -> Result<(DepthImage, Camera), ActionFailure> {
    let frames = goal.optional_int("frames")?.unwrap_or(default_frames);
    let inputs = BTreeMap::from([("frames".to_owned(), Value::Int(frames))]);
    let outputs = goal.unless_cancelled(goal.call("Camera", "capture", inputs)).await??;
    let output = |name: &str| Port::new(name, outputs.get(name));
    let pixels = |name: &str| -> Result<usize, InputError> { Ok(usize::try_from(output(name).int()?).unwrap_or(0)) };
    let intrinsics = Intrinsics {
        width: pixels("width")?,
        height: pixels("height")?,
        fx: output("fx").float()?,
        fy: output("fy").float()?,
        cx: output("cx").float()?,
        cy: output("cy").float()?,
    };
    let image = DepthImage::from_bytes(intrinsics.width, intrinsics.height, output("image").bytes()?)?;
    Ok((image, Camera { intrinsics, pose: output("camera").pose()? }))
}

/// Works on a thread of its own; milliseconds, so a goal that shall stop only leaves the answer behind.
async fn working<T: Send + 'static>(
    goal: &GoalContext,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, ActionFailure> {
    Ok(goal.unless_cancelled(tokio::task::spawn_blocking(work)).await??)
}

fn size_value(estimate: &BoxEstimate) -> Value {
    Value::List(estimate.size.map(Value::Float).to_vec())
}
