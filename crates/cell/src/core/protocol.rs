//! The events that the cell's core handles, and the commands that it returns.

pub use super::activity::{Module, Ticket};
use super::arms::FIRST;
use super::contacts::Contact;
use super::faults::Fault;
pub use super::motion::Tracking;
use super::picture::Exposure;
use super::snapshot::Snapshot;
use crate::config::Goods;
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_motion::joint_vector::JointVector;
use ratn_perception::camera::Camera;
use ratn_worker::safety::SafetyState;
use serde::{Deserialize, Serialize};

/// An input of the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// A goal for a module.
    Start {
        /// The goal's id, which commands refer to.
        ticket: Ticket,
        /// The number of the arm, or of the gripper's arm; 0 by default. Requests for other modules ignore it.
        #[serde(default, skip_serializing_if = "is_first")]
        arm: usize,
        /// What to do.
        request: Request,
    },
    /// Stops a goal: its client wants that or is gone, or its lease has ended.
    Stop {
        /// The goal.
        ticket: Ticket,
        /// The reason.
        reason: String,
    },
    /// An emergency stop or a hold begins, or the last one ends.
    Safety {
        /// The state from now on.
        state: SafetyState,
    },
    /// A new scene; the robot returns to its first posture.
    Reset {
        /// The seed for the sizes and poses of the objects.
        seed: u64,
        /// The objects in it.
        goods: Goods,
    },
    /// A fault is injected.
    Fault {
        /// What fails, and when.
        fault: Fault,
    },
    /// Asks for the complete state (a snapshot).
    Save,
    /// Restores a state; current goals end `aborted`.
    PutBack {
        /// The state.
        snapshot: Box<Snapshot>,
    },
    /// Only time has passed.
    Tick,
}

/// What a module can be asked to do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// Moves the base along a trajectory.
    Drive {
        /// Points in x, y (metres) and heading (radians), beginning at the base's pose.
        trajectory: Trajectory,
    },
    /// Moves an arm along a trajectory.
    Follow {
        /// Points in joint positions, in radians, beginning at the arm's posture.
        trajectory: Trajectory,
    },
    /// Moves the arm to a posture, in a straight line in joint space.
    MoveTo {
        /// The goal posture.
        joints: JointVector,
        /// The fraction of the maximum speed, above 0 and at most 1.
        speed: f64,
    },
    /// Closes the fingers around something.
    Grasp {
        /// The client's name for the object; it is returned in [`Product::Grasped`].
        object: String,
        /// The expected pose of the object in the tool frame.
        expected: Option<Pose>,
    },
    /// Opens the fingers.
    Release,
    /// Opens the fingers to a given width.
    OpenTo {
        /// The distance between them, in metres.
        width: f64,
    },
    /// Turns the camera.
    LookAt {
        /// The point in the world at which the camera shall look.
        target: [f64; 3],
    },
    /// Asks for the pose of the base.
    SenseBase,
    /// Asks for the arm's joint positions.
    SenseArm,
    /// Asks how far the fingers are open, and whether they hold an object.
    SenseGripper,
    /// Takes a picture.
    Capture {
        /// Number of frames to average.
        frames: u32,
    },
}

/// An output of the core, for the process around it.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// A goal has ended.
    Ended {
        /// The goal.
        ticket: Ticket,
        /// Its result.
        ending: Ending,
        /// The tracking errors of its trajectory, as far as it was followed.
        tracking: Option<Tracking>,
    },
    /// The reply to [`Event::Save`].
    Saved {
        /// The complete state.
        snapshot: Box<Snapshot>,
    },
    /// An unintended contact of two bodies.
    Touched {
        /// The two bodies, the depth of their overlap, and their speed.
        contact: Contact,
    },
    /// A fact that only the cell knows, such as why the fingers hold nothing, or which object was moved. For the cell's log, not for the task.
    Noted {
        /// A sentence without a full stop.
        what: String,
    },
}

/// The end of a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Ending {
    /// The goal succeeded.
    Done(Product),
    /// The goal failed. The module holds its position.
    Aborted(String),
    /// The goal was stopped. The module holds its position.
    Preempted(String),
    /// An emergency stop ended the goal, before or after it began. The module holds its position.
    Stopped(String),
}

/// The result of a successful goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Product {
    /// The base has reached the end of its trajectory.
    Driven {
        /// Its localised pose, in the world frame.
        end: Pose,
        /// The tracking errors.
        tracking: Tracking,
    },
    /// The arm has reached the end of its trajectory.
    Moved {
        /// Its posture.
        end: JointVector,
        /// The tracking errors.
        tracking: Tracking,
    },
    /// The gripper holds an object.
    Grasped {
        /// The name that the goal gave the object.
        object: String,
        /// The opening of the fingers around it, in metres.
        width: f64,
        /// The pose in the tool frame, from the expected pose and what two fingers measure ([`super::grasping::felt`]). `None` without an expected
        /// pose: fingers measure only a width.
        in_gripper: Option<Pose>,
    },
    /// The fingers are open.
    Released,
    /// The localised pose of the base.
    BaseSensed {
        /// The pose of its frame, in the world frame.
        pose: Pose,
    },
    /// The posture of the arm.
    ArmSensed {
        /// Its joint positions.
        joints: JointVector,
    },
    /// The state of the gripper.
    GripperSensed {
        /// The opening, in metres.
        width: f64,
        /// Whether the fingers are closed around an object.
        holding: bool,
    },
    /// The camera looks at the requested point.
    Looking {
        /// Pan, in radians.
        pan: f64,
        /// Tilt, in radians.
        tilt: f64,
    },
    /// A picture to be rendered.
    Captured {
        /// The camera with the pose that the robot computes by its own kinematics.
        camera: Camera,
        /// The scenes of its frames.
        exposures: Vec<Exposure>,
    },
}

fn is_first(arm: &usize) -> bool {
    *arm == FIRST
}

impl Request {
    /// The module that performs the request, if it is for the arm of this number.
    pub fn module(&self, arm: usize) -> Module {
        match self {
            Request::Drive { .. } | Request::SenseBase => Module::Base,
            Request::Follow { .. } | Request::MoveTo { .. } | Request::SenseArm => Module::Arm(arm),
            Request::Grasp { .. } | Request::Release | Request::OpenTo { .. } | Request::SenseGripper => {
                Module::Gripper(arm)
            }
            Request::LookAt { .. } => Module::PanTilt,
            Request::Capture { .. } => Module::Camera,
        }
    }
}
