//! What a module is doing, and its state at a given time.

use super::arms::FIRST;
use super::braking::Way;
use super::motion::Tracking;
use super::picture::Exposure;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Robot;
use ratn_perception::camera::Camera;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// A goal that is being performed, by the number that its sender chose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Ticket(pub u64);

/// A module of the robot. Each performs one activity at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Module {
    /// The base, which carries everything else.
    Base,
    /// The joints of an arm, by the arm's number.
    Arm(usize),
    /// The two fingers of an arm, by the arm's number.
    Gripper(usize),
    /// The head with the camera.
    PanTilt,
    /// The camera.
    Camera,
}

#[derive(Debug, Clone)]
pub(crate) struct Activity {
    pub(crate) ticket: Ticket,
    pub(crate) started: Timestamp,
    pub(crate) ends: Timestamp,
    pub(crate) kind: Kind,
}

#[derive(Debug, Clone)]
pub(crate) enum Kind {
    Follow(Way),
    Close { from: f64, to: f64, object: String, expected: Option<Pose> },
    Open { from: f64, to: f64 },
    Look { from: [f64; 2], to: [f64; 2] },
    SenseBase,
    SenseArm,
    SenseGripper,
    Capture { camera: Camera, frames: u32, taken: u32, next: Timestamp, exposures: Vec<Exposure> },
}

impl Module {
    /// The modules of a robot with one arm, a gripper, a base, a head and a camera.
    pub const ALL: [Module; 5] =
        [Module::Base, Module::Arm(FIRST), Module::Gripper(FIRST), Module::PanTilt, Module::Camera];

    /// The modules of a robot.
    pub fn of(robot: &Robot) -> Vec<Module> {
        let arms = 0..robot.arm_names().count();
        let grippers = arms.clone().filter(|arm| !robot.finger_links_of(*arm).is_empty());
        let base = (!robot.base_joints().is_empty()).then_some(Module::Base);
        let head = (!robot.head_joints().is_empty()).then_some(Module::PanTilt);
        let camera = robot.camera_pose(&robot.at_zero()).map(|_| Module::Camera);
        base.into_iter()
            .chain(arms.map(Module::Arm))
            .chain(grippers.map(Module::Gripper))
            .chain(head)
            .chain(camera)
            .collect()
    }

    /// The number of the arm that this module is, or whose gripper it is.
    pub fn arm(self) -> Option<usize> {
        match self {
            Module::Arm(arm) | Module::Gripper(arm) => Some(arm),
            Module::Base | Module::PanTilt | Module::Camera => None,
        }
    }

    /// The name of the arm that this module is, or whose gripper it is, for a robot with several arms: the attribute `arm` of its resource.
    pub fn arm_name(self, robot: &Robot) -> Option<&str> {
        let arm = self.arm().filter(|_| robot.arm_names().count() > 1)?;
        robot.arm_names().nth(arm)
    }

    /// The kind of the module's resource.
    pub fn kind(self) -> &'static str {
        match self {
            Module::Base => "Base",
            Module::Arm(_) => "Arm",
            Module::Gripper(_) => "Gripper",
            Module::PanTilt => "PanTilt",
            Module::Camera => "Camera",
        }
    }
}

impl Activity {
    /// Seconds since the activity started.
    pub(crate) fn elapsed_s(&self, now: Timestamp) -> f64 {
        now.since(self.started).as_secs_f64()
    }

    /// The tracking errors so far, if the activity follows a trajectory.
    pub(crate) fn tracking(&self, now: Timestamp) -> Option<Tracking> {
        match &self.kind {
            Kind::Follow(way) => Some(way.tracking(self.elapsed_s(now))),
            _ => None,
        }
    }

    /// The share of the activity's time that has passed, 0 to 1.
    fn fraction(&self, now: Timestamp) -> f64 {
        let whole = self.ends.since(self.started).as_secs_f64();
        if whole > 0.0 { (self.elapsed_s(now) / whole).clamp(0.0, 1.0) } else { 1.0 }
    }

    /// x, y and heading of the base, if the activity moves the base.
    pub(crate) fn base(&self, now: Timestamp) -> Option<[f64; 3]> {
        match &self.kind {
            Kind::Follow(Way::Base(motion)) => {
                let at = motion.at(self.elapsed_s(now));
                Some([at[0], at[1], at[2]])
            }
            _ => None,
        }
    }

    /// The positions of the arm's joints, if the activity moves the arm.
    pub(crate) fn arm(&self, now: Timestamp) -> Option<JointVector> {
        match &self.kind {
            Kind::Follow(Way::Arm(_, motion)) => Some(motion.at(self.elapsed_s(now))),
            _ => None,
        }
    }

    /// Distance of each finger from the middle, if the activity moves the fingers.
    pub(crate) fn finger(&self, now: Timestamp) -> Option<f64> {
        let fraction = self.fraction(now);
        match &self.kind {
            Kind::Close { from, to, .. } | Kind::Open { from, to } => Some(from + (to - from) * fraction),
            _ => None,
        }
    }

    /// Pan and tilt, if the activity moves the head.
    pub(crate) fn head(&self, now: Timestamp) -> Option<[f64; 2]> {
        let fraction = self.fraction(now);
        // A smooth start and stop.
        let eased = fraction * fraction * (3.0 - 2.0 * fraction);
        match &self.kind {
            Kind::Look { from, to } => Some([0, 1].map(|i| from[i] + (to[i] - from[i]) * eased)),
            _ => None,
        }
    }
}

/// Seconds of the robot as a duration; negative values and NaN give zero, values too large for a duration give the longest one.
pub(crate) fn seconds(s: f64) -> Duration {
    Duration::try_from_secs_f64(s.max(0.0)).unwrap_or(Duration::MAX)
}
