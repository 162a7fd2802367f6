//! The actions of the robot's modules: reads a goal's inputs, has the core perform it, writes its outputs.

use super::cell_actor::CellHandle;
use crate::config::CellConfig;
use crate::core::arms::FIRST;
use crate::core::protocol::{Ending, Module, Product, Request};
use ratn_model::fact::{FactKey, Term};
use ratn_model::resource::Lease;
use ratn_model::value::Value;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Robot};
use ratn_perception::noise::MAX_FRAMES;
use ratn_worker::action::{
    Action, ActionFailure, ActionResult, ActionServer, Goal, GoalContext, GoalOutcome, NoResource, Signature,
};
use ratn_worker::client::Channels;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::safety::Safety;

/// The default speed of `move_to`, as a fraction of the limits: slow, because the line was not planned.
const MOVE_TO_SPEED: f64 = 0.2;

/// The id of a module's resource on a host, `pan-tilt@sim`; for a robot with several arms `arm_right@sim` and `gripper_right@sim`.
pub(crate) fn resource_id(module: Module, robot: &Robot, host: &str) -> String {
    let name = match module {
        Module::Base => "base",
        Module::Arm(_) => "arm",
        Module::Gripper(_) => "gripper",
        Module::PanTilt => "pan-tilt",
        Module::Camera => "camera",
    };
    match module.arm_name(robot) {
        Some(arm) => format!("{name}_{arm}@{host}"),
        None => format!("{name}@{host}"),
    }
}

/// The watch of the leases of the modules.
pub(crate) fn leases(handle: &CellHandle, config: &CellConfig) -> LeaseWatch {
    LeaseWatch::of(handle.modules().iter().map(|module| resource_id(*module, handle.robot(), &config.host)))
}

/// The action server of all modules. Each performs one goal at a time, under a lease of its own resource.
pub(crate) fn server(
    handle: &CellHandle,
    config: &CellConfig,
    channels: Channels,
    safety: Safety,
    leases: &LeaseWatch,
) -> ActionServer {
    let mut builder = ActionServer::builder("").one_at_a_time().channels(channels).safety(safety).leases(leases);
    let modules = handle.modules();
    for (kind, name, description, read) in ACTIONS {
        let of_kind = modules.iter().filter(|module| module.kind() == kind.kind());
        let resources: Vec<Performer> = of_kind
            .map(|module| Performer {
                arm: module.arm().unwrap_or(FIRST),
                arm_name: module.arm_name(handle.robot()).map(str::to_owned),
                resource: resource_id(*module, handle.robot(), &config.host),
            })
            .collect();
        if resources.is_empty() {
            continue;
        }
        builder = builder.action(ModuleAction {
            kind: kind.kind(),
            name,
            description,
            performers: resources,
            handle: handle.clone(),
            seed: config.seed,
            calibration: config.errors.camera_covariance(),
            read,
        });
    }
    builder.build()
}

type Read = fn(&GoalContext) -> Result<Request, ActionFailure>;

/// One server serves all modules: no two actions have the same name. An action of the arm is offered by every arm.
const ACTIONS: [(Module, &str, &str, Read); 10] = [
    (Module::Base, "drive", "moves the base along a trajectory", |goal| {
        Ok(Request::Drive { trajectory: goal.input_trajectory("trajectory")?.clone() })
    }),
    (Module::Base, "localise", "says where the base stands", |_| Ok(Request::SenseBase)),
    (Module::Arm(FIRST), "follow", "moves the arm along a trajectory", |goal| {
        Ok(Request::Follow { trajectory: goal.input_trajectory("trajectory")?.clone() })
    }),
    (Module::Arm(FIRST), "move_to", "moves the arm on a straight line of joint space", |goal| {
        let joints = JointVector::read(goal.input_joints("joints")?);
        let joints = joints.map_err(|wrong| ActionFailure::aborted(format!("input `joints` has {wrong}")))?;
        let speed = goal.optional_float("speed")?.unwrap_or(MOVE_TO_SPEED);
        Ok(Request::MoveTo { joints, speed })
    }),
    (Module::Gripper(FIRST), "grasp", "closes the fingers around an object", |goal| {
        let expected = goal.port("expected").optional().map(|port| port.pose()).transpose()?;
        Ok(Request::Grasp { object: goal.input_string("object")?.to_owned(), expected })
    }),
    (Module::Gripper(FIRST), "release", "opens the fingers", |goal| {
        Ok(goal.optional_float("width_m")?.map_or(Request::Release, |width| Request::OpenTo { width }))
    }),
    (Module::Arm(FIRST), "where", "says where the arm's joints are", |_| Ok(Request::SenseArm)),
    (Module::Gripper(FIRST), "feel", "says whether the fingers hold something", |_| Ok(Request::SenseGripper)),
    (Module::PanTilt, "look_at", "turns the camera to a point of the world", |goal| {
        Ok(Request::LookAt { target: goal.input_pose("target")?.position })
    }),
    (Module::Camera, "capture", "takes a depth image, averaged over frames", |goal| {
        let frames = goal.optional_int("frames")?.unwrap_or(1);
        let wrong = |_| ActionFailure::aborted(format!("input `frames` is {frames}: expected 1 to {MAX_FRAMES}"));
        Ok(Request::Capture { frames: u32::try_from(frames).map_err(wrong)? })
    }),
];

/// All degrees of freedom in their order: base x, y, yaw, the arm, pan, tilt, finger; then each other arm and its finger.
fn configuration_value(at: &Configuration) -> Value {
    Value::List(at.values().into_iter().map(Value::Float).collect())
}

/// The key of the fact that a drive measures: the localised pose of the base at its stop.
fn stands() -> FactKey {
    FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name("base".to_owned())] }
}

/// A module that performs an action.
struct Performer {
    /// The number of the module's arm.
    arm: usize,
    /// The name of the module's arm, if the robot has several.
    arm_name: Option<String>,
    /// The id of the module's resource.
    resource: String,
}

struct ModuleAction {
    /// The kind of resource that performs the action.
    kind: &'static str,
    name: &'static str,
    description: &'static str,
    /// The modules that can perform it, at least one: for a robot with several arms one per arm.
    performers: Vec<Performer>,
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

    fn checked_by(&self) -> Option<Signature> {
        Signature::bundled(self.kind, self.name)
    }

    fn resource(&self) -> Option<&str> {
        match &self.performers[..] {
            [only] => Some(&only.resource),
            _ => None,
        }
    }

    fn resources(&self) -> Vec<&str> {
        self.performers.iter().map(|performer| performer.resource.as_str()).collect()
    }

    fn resource_for(&self, goal: &Goal) -> Result<Option<&str>, NoResource> {
        Ok(Some(&self.performer(goal.inputs.get("arm"), goal.lease.as_ref())?.resource))
    }

    fn can_be_suspended(&self) -> bool {
        true
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let request = (self.read)(&goal)?;
        let performer = self.performer(goal.inputs.get("arm"), goal.lease.as_ref())?;
        let arm = performer.arm;
        let hand = goal.port("hand").optional().map(|port| port.string()).transpose()?.map(str::to_owned);
        let of_arm = performer.arm_name.as_deref().unwrap_or(self.handle.robot().arm_name());
        if let Some(hand) = &hand
            && hand != of_arm
        {
            let why = format!(
                "input `hand` is `{hand}`, and the goal is for the arm `{of_arm}`: what it takes is in its own hand"
            );
            return Err(ActionFailure::Aborted(why));
        }
        goal.while_held().await?;
        let mut suspended = goal.suspended();
        let mut motion = self.handle.perform_with(arm, request)?;
        let ending = loop {
            motion.suspend(*suspended.borrow_and_update());
            tokio::select! {
                biased;
                ending = motion.ended() => break ending,
                () = goal.cancelled.cancelled() => match motion.stop().await {
                    // The goal had succeeded before the cancel arrived.
                    Ok(Ending::Done(product)) => break Ok(Ending::Done(product)),
                    _ => return Err(goal.stopped()),
                },
                // The goal owns the sender, so this cannot fail.
                _ = suspended.changed() => {}
            }
        };
        match ending? {
            Ending::Done(product) => self.outcome(product, hand.as_deref()).await,
            Ending::Aborted(reason) => Err(ActionFailure::Aborted(reason)),
            Ending::Preempted(reason) => Err(ActionFailure::Preempted(reason)),
            Ending::Stopped(reason) => Err(ActionFailure::emergency_stop(&reason)),
        }
    }
}

impl ModuleAction {
    /// The module that performs a goal: that of the arm which the input `arm` names; without this input the module whose resource the lease holds. A
    /// module that belongs to no arm, or to the only arm, ignores the input.
    ///
    /// # Errors
    /// [`NoResource`] if no module of such an arm performs this action, or the lease holds none or several of the resources.
    fn performer(&self, arm: Option<&Value>, lease: Option<&Lease>) -> Result<&Performer, NoResource> {
        let of_arms: Vec<&str> = self.performers.iter().filter_map(|one| one.arm_name.as_deref()).collect();
        let named = match arm.filter(|_| !of_arms.is_empty()) {
            None | Some(Value::Null) => None,
            Some(Value::String(name)) => Some(name),
            Some(other) => {
                let has = other.type_name();
                return Err(NoResource::Input(format!(
                    "input `arm` has a {has}: expected the name of an arm, a string"
                )));
            }
        };
        let arms = || of_arms.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        if let Some(name) = named {
            let found = self.performers.iter().find(|performer| performer.arm_name.as_ref() == Some(name));
            let several = if of_arms.len() > 1 { "arms" } else { "arm" };
            let why = || format!("input `arm` is `{name}`: `{}` is for the {several} {}", self.name, arms());
            return found.ok_or_else(|| NoResource::Input(why()));
        }
        if let [only] = &self.performers[..] {
            return Ok(only);
        }
        let is_leased = |performer: &&Performer| {
            lease.is_some_and(|lease| lease.resources.iter().any(|leased| leased.id == performer.resource))
        };
        let leased: Vec<&Performer> = self.performers.iter().filter(is_leased).collect();
        match leased[..] {
            [only] => Ok(only),
            [] => Err(NoResource::Lease(format!(
                "the goal has no lease of any of {}: acquire one and send the lease along",
                self.resources().join(", ")
            ))),
            [..] => {
                let held: Vec<&str> = leased.iter().map(|performer| performer.resource.as_str()).collect();
                Err(NoResource::Lease(format!(
                    "the goal's lease holds {}, so the goal has to say which arm it is for: give it the input `arm`, one of {}",
                    held.join(" and "),
                    arms()
                )))
            }
        }
    }

    async fn outcome(&self, product: Product, hand: Option<&str>) -> ActionResult {
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
                let arguments = std::iter::once(object).chain(hand.map(str::to_owned)).map(Term::Name).collect();
                let fact = FactKey { predicate: "in_gripper".to_owned(), arguments };
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
                    .with_output("camera_covariance", Value::List(self.calibration.map(Value::Float).to_vec().into()))
                    .with_output("robot", Value::List(robot))
                    .with_output("fx", Value::Float(optics.fx))
                    .with_output("fy", Value::Float(optics.fy))
                    .with_output("cx", Value::Float(optics.cx))
                    .with_output("cy", Value::Float(optics.cy))
            }
        })
    }
}
