//! Events that go into the cell's core, and commands that come out of it.

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

/// What happens to the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// A goal for a module.
    Start {
        /// The goal's id, by which commands name it.
        ticket: Ticket,
        /// The number of the arm that does it, or whose gripper; 0 unless said. A request for another module does not look at it.
        #[serde(default, skip_serializing_if = "is_first")]
        arm: usize,
        /// What to do.
        request: Request,
    },
    /// A goal is to stop: its giver wants that or is gone, or its lease has ended.
    Stop {
        /// The goal.
        ticket: Ticket,
        /// Why it is to stop.
        reason: String,
    },
    /// An emergency stop or a hold is in force from now on, or neither is any more.
    Safety {
        /// What is in force now.
        state: SafetyState,
    },
    /// A new table; the robot goes back to its first posture.
    Reset {
        /// The seed that sizes and places of the objects are derived from.
        seed: u64,
        /// The objects on it.
        goods: Goods,
    },
    /// A fault is injected.
    Fault {
        /// What goes wrong, and when.
        fault: Fault,
    },
    /// Asks for the whole state (a snapshot).
    Save,
    /// Back to a state; goals under way end aborted.
    PutBack {
        /// The state.
        snapshot: Box<Snapshot>,
    },
    /// Only time has passed.
    Tick,
}

/// What a module can do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Request {
    /// Moves the base along a trajectory.
    Drive {
        /// Points in x, y (metres) and heading (radians), beginning where the base is.
        trajectory: Trajectory,
    },
    /// Moves an arm along a trajectory.
    Follow {
        /// Beginning where the arm is; positions in radians.
        trajectory: Trajectory,
    },
    /// Moves the arm to a posture, in a straight line of joint positions.
    MoveTo {
        /// The posture that the arm ends in.
        joints: JointVector,
        /// The fraction of its greatest speed, above 0 and at most 1.
        speed: f64,
    },
    /// Closes the fingers around something.
    Grasp {
        /// The name that the goal's giver has for the object; it comes back in [`Product::Grasped`].
        object: String,
        /// The pose in the tool frame that the object is expected to have then.
        expected: Option<Pose>,
    },
    /// Opens the fingers.
    Release,
    /// Opens the fingers so far and no further.
    OpenTo {
        /// How far they are apart then, in metres.
        width: f64,
    },
    /// Turns the camera.
    LookAt {
        /// Towards this point of the world.
        target: [f64; 3],
    },
    /// Asks where the base stands.
    SenseBase,
    /// Asks where the arm's joints are.
    SenseArm,
    /// Asks how far the fingers are open, and whether they hold something.
    SenseGripper,
    /// Takes a picture.
    Capture {
        /// How many frames are averaged.
        frames: u32,
    },
}

/// A command of the core to the process around it.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// A goal has ended.
    Ended {
        /// The goal.
        ticket: Ticket,
        /// How it has ended.
        ending: Ending,
        /// How well it followed a trajectory, to its end or as far as it came.
        tracking: Option<Tracking>,
    },
    /// The state that [`Event::Save`] asked for.
    Saved {
        /// The whole state.
        snapshot: Box<Snapshot>,
    },
    /// Two bodies touched that should not have.
    Touched {
        /// The two bodies, how deep they were in each other, and how they moved.
        contact: Contact,
    },
    /// What only the cell knows: why the fingers hold nothing, what somebody has moved. For the cell's log, not for the task.
    Noted {
        /// A sentence without a full stop.
        what: String,
    },
}

/// How a goal ends.
#[derive(Debug, Clone, PartialEq)]
pub enum Ending {
    /// It was done.
    Done(Product),
    /// It was not done, or not to its end. The module holds.
    Aborted(String),
    /// It was stopped. The module holds.
    Preempted(String),
    /// An emergency stop ended it, before or after it began. The module holds.
    Stopped(String),
}

/// What comes of a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Product {
    /// The base has come to the end of its trajectory.
    Driven {
        /// Where it believes to stand, in the world frame.
        end: Pose,
        /// How well it followed.
        tracking: Tracking,
    },
    /// The arm has come to the end of its trajectory.
    Moved {
        /// Its posture.
        end: JointVector,
        /// How well it followed.
        tracking: Tracking,
    },
    /// Something is in the gripper.
    Grasped {
        /// The name that the goal gave the object.
        object: String,
        /// The opening of the fingers around it, in metres.
        width: f64,
        /// Where it is in the tool frame, by what was expected and what two fingers feel of it ([`super::grasping::felt`]). `None` when
        /// nothing was expected: fingers feel a width and no more.
        in_gripper: Option<Pose>,
    },
    /// The fingers are open.
    Released,
    /// Where the base believes to stand.
    BaseSensed {
        /// Its frame, in the world frame.
        pose: Pose,
    },
    /// Where the arm is.
    ArmSensed {
        /// Its posture.
        joints: JointVector,
    },
    /// How the fingers are.
    GripperSensed {
        /// Their opening, in metres.
        width: f64,
        /// Whether they are closed around something.
        holding: bool,
    },
    /// The camera looks at the point that was asked for.
    Looking {
        /// Pan, in radians.
        pan: f64,
        /// Tilt, in radians.
        tilt: f64,
    },
    /// A picture to be developed.
    Captured {
        /// The camera as the robot has it, by its own kinematics.
        camera: Camera,
        /// What was there, frame by frame.
        exposures: Vec<Exposure>,
    },
}

fn is_first(arm: &usize) -> bool {
    *arm == FIRST
}

impl Request {
    /// The module that does it, where it is meant for the arm of this number.
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
