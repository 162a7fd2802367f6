//! The actions of the modules that the robot has: reads a goal's inputs, has the core do it, writes its outputs.

use super::cell_actor::CellHandle;
use crate::config::CellConfig;
use crate::core::protocol::{Ending, Module, Product, Request};
use ratn_model::fact::{FactKey, Term};
use ratn_model::value::Value;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Configuration;
use ratn_perception::noise::MAX_FRAMES;
use ratn_worker::action::{Action, ActionFailure, ActionResult, ActionServer, GoalContext, GoalOutcome};
use ratn_worker::client::Channels;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::safety::Safety;

/// How fast `move_to` goes unless told otherwise, as a fraction of the limits: a line that nobody planned is taken with care.
const MOVE_TO_SPEED: f64 = 0.2;

/// The id of a module's resource on a host, `pan-tilt@sim`.
pub(crate) fn resource_id(module: Module, host: &str) -> String {
    let name = match module {
        Module::Base => "base",
        Module::Arm => "arm",
        Module::Gripper => "gripper",
        Module::PanTilt => "pan-tilt",
        Module::Camera => "camera",
    };
    format!("{name}@{host}")
}

/// The watch of who holds the modules.
pub(crate) fn leases(modules: &[Module], config: &CellConfig) -> LeaseWatch {
    LeaseWatch::of(modules.iter().map(|module| resource_id(*module, &config.host)))
}

/// The server of all modules. Each takes one goal at a time, under a lease of its own resource.
pub(crate) fn server(
    handle: &CellHandle,
    config: &CellConfig,
    channels: Channels,
    safety: Safety,
    leases: &LeaseWatch,
) -> ActionServer {
    let mut builder = ActionServer::builder("").one_at_a_time().channels(channels).safety(safety).leases(leases);
    let modules = handle.modules();
    for (module, name, description, read) in ACTIONS.into_iter().filter(|(module, ..)| modules.contains(module)) {
        builder = builder.action(ModuleAction {
            name,
            description,
            resource: resource_id(module, &config.host),
            handle: handle.clone(),
            seed: config.seed,
            calibration: config.errors.camera_covariance(),
            read,
        });
    }
    builder.build()
}

type Read = fn(&GoalContext) -> Result<Request, ActionFailure>;

/// All modules are behind one server: no two actions have the same name.
const ACTIONS: [(Module, &str, &str, Read); 10] = [
    (Module::Base, "drive", "moves the base along a trajectory", |goal| {
        Ok(Request::Drive { trajectory: goal.input_trajectory("trajectory")?.clone() })
    }),
    (Module::Base, "localise", "says where the base stands", |_| Ok(Request::SenseBase)),
    (Module::Arm, "follow", "moves the arm along a trajectory", |goal| {
        Ok(Request::Follow { trajectory: goal.input_trajectory("trajectory")?.clone() })
    }),
    (Module::Arm, "move_to", "moves the arm on a straight line of joint space", |goal| {
        let joints = JointVector::read(goal.input_joints("joints")?);
        let joints = joints.map_err(|wrong| ActionFailure::aborted(format!("input `joints` has {wrong}")))?;
        let speed = goal.optional_float("speed")?.unwrap_or(MOVE_TO_SPEED);
        Ok(Request::MoveTo { joints, speed })
    }),
    (Module::Gripper, "grasp", "closes the fingers around an object", |goal| {
        let expected = goal.port("expected").optional().map(|port| port.pose()).transpose()?;
        Ok(Request::Grasp { object: goal.input_string("object")?.to_owned(), expected })
    }),
    (Module::Gripper, "release", "opens the fingers", |_| Ok(Request::Release)),
    (Module::Arm, "where", "says where the arm's joints are", |_| Ok(Request::SenseArm)),
    (Module::Gripper, "feel", "says whether the fingers hold something", |_| Ok(Request::SenseGripper)),
    (Module::PanTilt, "look_at", "turns the camera to a point of the world", |goal| {
        Ok(Request::LookAt { target: goal.input_pose("target")?.position })
    }),
    (Module::Camera, "capture", "takes a depth image, averaged over frames", |goal| {
        let frames = goal.optional_int("frames")?.unwrap_or(1);
        let wrong = |_| ActionFailure::aborted(format!("input `frames` is {frames}: expected 1 to {MAX_FRAMES}"));
        Ok(Request::Capture { frames: u32::try_from(frames).map_err(wrong)? })
    }),
];

/// All degrees of freedom in their order: base x, y, yaw, the arm, pan, tilt, finger.
fn configuration_value(at: &Configuration) -> Value {
    Value::List(at.values().into_iter().map(Value::Float).collect())
}

/// What a drive measures: where the base believes to stand at its stop.
fn stands() -> FactKey {
    FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name("base".to_owned())] }
}

struct ModuleAction {
    name: &'static str,
    description: &'static str,
    resource: String,
    handle: CellHandle,
    seed: u64,
    /// The variances of the camera's pose.
    calibration: [f64; 6],
    read: Read,
}

#[tonic::async_trait]
impl Action for ModuleAction {
    fn name(&self) -> &str {
        self.name
    }

    fn description(&self) -> &str {
        self.description
    }

    fn resource(&self) -> Option<&str> {
        Some(&self.resource)
    }

    fn can_be_suspended(&self) -> bool {
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let request = (self.read)(&goal)?;
        goal.while_held().await?;
        let mut suspended = goal.suspended();
        let mut motion = self.handle.perform(request)?;
        let ending = loop {
            motion.suspend(*suspended.borrow_and_update());
            tokio::select! {
                biased;
                ending = motion.ended() => break ending,
                () = goal.cancelled.cancelled() => match motion.stop().await {
                    // It had been done before the word came.
                    Ok(Ending::Done(product)) => break Ok(Ending::Done(product)),
                    _ => return Err(goal.stopped()),
                },
                // The sender is in the goal.
                _ = suspended.changed() => {}
            }
        };
        match ending? {
            Ending::Done(product) => self.outcome(product).await,
            Ending::Aborted(reason) => Err(ActionFailure::Aborted(reason)),
            Ending::Preempted(reason) => Err(ActionFailure::Preempted(reason)),
            Ending::Stopped(reason) => Err(ActionFailure::emergency_stop(&reason)),
        }
    }
}

impl ModuleAction {
    async fn outcome(&self, product: Product) -> ActionResult {
        let success = GoalOutcome::success();
        Ok(match product {
            Product::Driven { end, tracking } => success
                .with_measured(stands(), Value::Pose(end))
                .with_output("end", Value::Pose(end))
                .with_output("tracking_max_m", Value::Float(tracking.most_m))
                .with_output("tracking_rms_m", Value::Float(tracking.rms_m))
                .with_output("tracking_max_rad", Value::Float(tracking.most_rad))
                .with_output("tracking_rms_rad", Value::Float(tracking.rms_rad)),
            Product::BaseSensed { pose } => success.with_output("pose", Value::Pose(pose)),
            Product::Moved { end, tracking } => success
                .with_output("end", Value::Joints(end.to_vec()))
                .with_output("tracking_max_rad", Value::Float(tracking.most_rad))
                .with_output("tracking_rms_rad", Value::Float(tracking.rms_rad)),
            Product::Grasped { object, width, in_gripper } => {
                let outcome = success.with_output("width_m", Value::Float(width));
                let fact = FactKey { predicate: "in_gripper".to_owned(), arguments: vec![Term::Name(object)] };
                match in_gripper {
                    Some(pose) => outcome.with_measured(fact, Value::Pose(pose)),
                    None => outcome,
                }
            }
            Product::Released => success,
            Product::ArmSensed { joints } => success.with_output("joints", Value::Joints(joints.to_vec())),
            Product::GripperSensed { width, holding } => {
                success.with_output("width_m", Value::Float(width)).with_output("holding", Value::Bool(holding))
            }
            Product::Looking { pan, tilt } => {
                success.with_output("pan", Value::Float(pan)).with_output("tilt", Value::Float(tilt))
            }
            Product::Captured { camera, exposures } => {
                let (handle, seed) = (self.handle.clone(), self.seed);
                let robot = exposures.iter().map(|e| configuration_value(&e.scenery.measured)).collect();
                let developing = tokio::task::spawn_blocking(move || handle.develop(&camera, seed, &exposures));
                let image = developing.await?;
                let optics = camera.intrinsics;
                success
                    .with_output("image", Value::Bytes(image.to_bytes()))
                    .with_output("width", Value::Int(image.width as i64))
                    .with_output("height", Value::Int(image.height as i64))
                    .with_output("camera", Value::Pose(camera.pose))
                    .with_output("camera_covariance", Value::List(self.calibration.map(Value::Float).to_vec()))
                    .with_output("robot", Value::List(robot))
                    .with_output("fx", Value::Float(optics.fx))
                    .with_output("fy", Value::Float(optics.fy))
                    .with_output("cx", Value::Float(optics.cx))
                    .with_output("cy", Value::Float(optics.cy))
            }
        })
    }
}
