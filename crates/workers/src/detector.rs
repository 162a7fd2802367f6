//! The detector worker: finds objects on a surface in depth images.
//!
//! It takes a picture with the camera in its goal's lease. It uses nothing but that picture, the poses of camera and robot that come with
//! it, and the region or the object that the goal names. Objects are named `box_1`, `fork_1`, `box_2`, …, the nearest first (numbered from
//! `first` if the goal gives it). Each has its class, the confidence of that, its pose in the world frame (metres) and the covariance of
//! the pose.

mod body;
mod facts;
mod pictures;

use facts::Facts;
use pictures::Pictures;
use ratn_model::value::Value;
use ratn_motion::robot::{Configuration, Robot};
use ratn_perception::calibration::{Calibration, Surface};
use ratn_perception::camera::{Camera, DepthImage, Intrinsics};
use ratn_perception::detection::{Detection, DetectionError, ObjectClass, Prior, Region, locate, segment};
use ratn_perception::mask::Ball;
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, GoalOutcome, InputError, Port, Signature};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Default number of frames in a picture in which a whole surface is searched: noise falls with the square root of their number.
const SEGMENT_FRAMES: i64 = 60;
/// Number of frames in a picture in which one known object is searched.
const LOCATE_FRAMES: i64 = 8;
/// Number of frames in a picture that only confirms a known object.
const CONFIRM_FRAMES: i64 = 4;
/// Standard deviations of a surface whose height the goal gives: of its height, and of its tilt; as for furniture and floors.
const SURFACE_SIGMA_M: f64 = 0.001;
const SURFACE_SIGMA_RAD: f64 = 0.002;
/// The outcome of `detector/confirm` where the object is not there. Where the camera fails it is `aborted`.
const GONE: &str = "gone";
/// Maximum number of robot postures in one picture.
const MAX_POSTURES: usize = 64;

/// Serves until a signal or the end of the parent process. If the folder `pictures` is given, every picture and its detections are saved
/// there as PNG files.
///
/// # Errors
/// The worker cannot start, or serving failed ([`ratn_worker::worker::WorkerError`]).
pub async fn run(options: WorkerOptions, robot: Robot, pictures: Option<PathBuf>) -> anyhow::Result<()> {
    Ok(worker(options, robot, pictures).run().await?)
}

/// The worker, not running yet.
pub fn worker(options: WorkerOptions, robot: Robot, pictures: Option<PathBuf>) -> Worker {
    let eyes = Eyes { robot: Arc::new(robot), pictures: Pictures::into(pictures) };
    Worker::new(options).action(Segment(eyes.clone())).action(Locate(eyes.clone())).action(Confirm(eyes))
}

/// The action `detector/segment`: finds all objects on a surface in a region.
#[derive(Debug)]
pub struct Segment(Eyes);

/// The action `detector/locate`: searches one known object again.
#[derive(Debug)]
pub struct Locate(Eyes);

/// The action `detector/confirm`: looks whether a known object is still there.
#[derive(Debug)]
pub struct Confirm(Eyes);

/// What the actions need to take and evaluate pictures.
#[derive(Debug, Clone)]
struct Eyes {
    robot: Arc<Robot>,
    pictures: Pictures,
}

/// A picture, with the space that the robot occupies in it.
struct Seen {
    image: DepthImage,
    camera: Camera,
    body: Vec<Ball>,
    calibration: Calibration,
}

#[tonic::async_trait]
impl Action for Segment {
    fn name(&self) -> &str {
        "segment"
    }

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled("Detector", self.name())
    }

    fn description(&self) -> &str {
        "Every object that stands on a surface, the nearest to the camera first."
    }

    fn can_be_suspended(&self) -> bool {
        // The action moves nothing.
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let (pose, size) = (goal.port("region").field("pose").pose()?, goal.port("region").field("size").list()?);
        let [x, y, ..] = &size[..] else {
            let reason = format!("input `region.size` has {} numbers: expected at least 2, x and y", size.len());
            return Err(ActionFailure::aborted(reason));
        };
        let region = Region { pose, size: [x.float()?, y.float()?] };
        let (classes, facts) = (classes(&goal)?, Facts::of(&goal)?);
        let surface = surface(&goal)?;
        let all = move |seen: &Seen| {
            let found = segment(&seen.image, &seen.camera, &region, &classes, &seen.body)?;
            Ok(found.into_iter().map(|object| seen.in_the_world(object, surface.as_ref())).collect())
        };
        let found = self.0.find(&goal, SEGMENT_FRAMES, all).await?;
        let first = goal.optional_int("first")?.unwrap_or(1);
        goal.progress(format!("{} objects", found.len()));
        let mut numbers: BTreeMap<ObjectClass, i64> = BTreeMap::new();
        let (mut boxes, mut outcome) = (Vec::new(), GoalOutcome::success());
        for object in &found {
            let number = numbers.entry(object.model.class()).or_insert(first);
            let id = format!("{}{number}", object.model.class().prefix());
            *number += 1;
            outcome = facts.write(outcome, &id, object);
            boxes.push(Value::Map(fields([("id", Value::String(id))].into_iter().chain(described(object)))));
        }
        Ok(outcome.with_output("boxes", Value::List(boxes.into())))
    }
}

#[tonic::async_trait]
impl Action for Locate {
    fn name(&self) -> &str {
        "locate"
    }

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled("Detector", self.name())
    }

    fn description(&self) -> &str {
        "Where an object that was seen before stands now."
    }

    fn can_be_suspended(&self) -> bool {
        // The action moves nothing.
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        self.0.look_for_one(&goal, LOCATE_FRAMES).await?.map_err(ActionFailure::aborted)
    }
}

#[tonic::async_trait]
impl Action for Confirm {
    fn name(&self) -> &str {
        "confirm"
    }

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled("Detector", self.name())
    }

    fn description(&self) -> &str {
        "Whether an object that was seen before is still there, and where it stands now."
    }

    fn can_be_suspended(&self) -> bool {
        // It moves nothing.
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let looked = self.0.look_for_one(&goal, CONFIRM_FRAMES).await?;
        Ok(looked.unwrap_or_else(|reason| GoalOutcome { reason, ..GoalOutcome::named(GONE) }))
    }
}

impl Eyes {
    /// Looks for the object that a goal names: what was found, or why it counts as gone.
    async fn look_for_one(
        &self,
        goal: &GoalContext,
        default_frames: i64,
    ) -> Result<Result<GoalOutcome, String>, ActionFailure> {
        let object = goal.port("object");
        let prior = Prior { pose: object.field("pose").pose()?, size: object.field("size").vector3()? };
        let id = object.field("id").string()?.to_owned();
        let (classes, facts) = (classes(goal)?, Facts::of(goal)?);
        let surface = surface(goal)?;
        let one = move |seen: &Seen| {
            let found = locate(&seen.image, &seen.camera, &prior, &classes, &seen.body)?;
            Ok(found.into_iter().map(|object| seen.in_the_world(object, surface.as_ref())).collect())
        };
        let Some(found) = self.find(goal, default_frames, one).await?.pop() else {
            let [x, y, z] = prior.pose.position;
            return Ok(Err(format!("{id} is not near ({x:.2}, {y:.2}, {z:.2}), where it was seen before")));
        };
        let outcome = facts.write(GoalOutcome::success(), &id, &found);
        Ok(Ok(described(&found).into_iter().fold(outcome, |out, (name, value)| out.with_output(name, value))))
    }

    /// Finds objects in a picture of the leased camera, on a thread of its own. That takes milliseconds: a goal that has to stop meanwhile just
    /// drops the answer.
    async fn find(
        &self,
        goal: &GoalContext,
        default_frames: i64,
        search: impl FnOnce(&Seen) -> Result<Vec<Detection>, DetectionError> + Send + 'static,
    ) -> Result<Vec<Detection>, ActionFailure> {
        let (seen, pictures) = (self.look(goal, default_frames).await?, self.pictures.clone());
        let searching = tokio::task::spawn_blocking(move || {
            let found = search(&seen)?;
            pictures.keep(&seen.image, &seen.camera, &found);
            Ok::<_, DetectionError>(found)
        });
        Ok(goal.unless_cancelled(searching).await???)
    }

    /// Takes a picture with the leased camera.
    async fn look(&self, goal: &GoalContext, default_frames: i64) -> Result<Seen, ActionFailure> {
        let frames = goal.optional_int("frames")?.unwrap_or(default_frames);
        let inputs = BTreeMap::from([("frames".to_owned(), Value::Int(frames))]);
        let outputs = goal.unless_cancelled(goal.call("Camera", "capture", inputs)).await??;
        let output = |name: &str| Port::new(name, outputs.get(name));
        let pixels =
            |name: &str| -> Result<usize, InputError> { Ok(usize::try_from(output(name).int()?).unwrap_or(0)) };
        let intrinsics = Intrinsics {
            width: pixels("width")?,
            height: pixels("height")?,
            fx: output("fx").float()?,
            fy: output("fy").float()?,
            cx: output("cx").float()?,
            cy: output("cy").float()?,
        };
        let image = DepthImage::from_bytes(intrinsics.width, intrinsics.height, output("image").bytes()?)?;
        let postures = output("robot")
            .list()?
            .iter()
            .take(MAX_POSTURES)
            .map(|port| posture(&self.robot, port))
            .collect::<Result<Vec<_>, _>>()?;
        let body = body::balls(&self.robot, &postures);
        let calibration = calibration(output("camera_covariance").optional())?;
        Ok(Seen { image, camera: Camera { intrinsics, pose: output("camera").pose()? }, body, calibration })
    }
}

impl Seen {
    /// The object, corrected by what is known of the camera's pose and of the surface.
    fn in_the_world(&self, object: Detection, surface: Option<&Surface>) -> Detection {
        let object = object.with_calibration(&self.camera, &self.calibration);
        surface.map_or(object, |surface| object.standing_on(surface, &self.camera, &self.calibration))
    }
}

/// The variances of the camera's pose along (m²) and about (rad²) the axes of its optical frame; zero if the camera does not report them.
fn calibration(port: Option<Port>) -> Result<Calibration, ActionFailure> {
    let Some(port) = port else { return Ok([0.0; 6]) };
    let variances = port.list()?.iter().map(|entry| entry.float()).collect::<Result<Vec<_>, _>>()?;
    match Calibration::try_from(variances) {
        Ok(variances) if variances.iter().all(|variance| *variance >= 0.0) => Ok(variances),
        _ => Err(ActionFailure::aborted("the camera's covariance is none: expected six variances of 0 or more")),
    }
}

/// The surface by its height in metres, if the goal gives it.
fn surface(goal: &GoalContext) -> Result<Option<Surface>, ActionFailure> {
    let Some(height_m) = goal.optional_float("surface_m")? else { return Ok(None) };
    Ok(Some(Surface { height_m, sigma_m: SURFACE_SIGMA_M, sigma_rad: SURFACE_SIGMA_RAD }))
}

fn posture(robot: &Robot, port: &Port) -> Result<Configuration, ActionFailure> {
    let degrees = port.list()?.iter().map(|degree| degree.float()).collect::<Result<Vec<_>, _>>()?;
    robot.configuration(&degrees).ok_or_else(|| {
        let (found, expected) = (degrees.len(), robot.at_zero().values().len());
        ActionFailure::aborted(format!("the camera says {found} positions of a robot of {expected} ({})", robot.name()))
    })
}

/// The classes to search for: all, unless the goal names some.
fn classes(goal: &GoalContext) -> Result<Vec<ObjectClass>, ActionFailure> {
    let Some(port) = goal.port("classes").optional() else { return Ok(ObjectClass::ALL.to_vec()) };
    let named = |port: &Port| {
        let name = port.string()?;
        ObjectClass::named(name).ok_or_else(|| {
            let known = ObjectClass::ALL.map(ObjectClass::name).join(", ");
            ActionFailure::aborted(format!("input `classes` has `{name}`: known are {known}"))
        })
    };
    port.list()?.iter().map(named).collect()
}

/// The properties of an object that are reported with its name.
fn described(object: &Detection) -> [(&'static str, Value); 5] {
    let floats = |values: &mut dyn Iterator<Item = f64>| Value::List(values.map(Value::Float).collect());
    [
        ("class", Value::String(object.model.class().name().to_owned())),
        ("pose", Value::Pose(object.pose)),
        ("size", floats(&mut object.model.size().into_iter())),
        ("confidence", Value::Float(object.confidence)),
        ("covariance", floats(&mut object.covariance.into_iter().flatten())),
    ]
}

fn fields(named: impl Iterator<Item = (&'static str, Value)>) -> BTreeMap<String, Value> {
    named.map(|(name, value)| (name.to_owned(), value)).collect()
}
