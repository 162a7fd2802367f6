//! Robots with several arms: one of them is planned, and the others stand at given positions.
//!
//! A [`Robot`] is seen from one of its arms, which has the number 0; the others have the numbers from 1 on. [`Robot::with_arm`] is the same robot
//! seen from another arm: that arm and arm 0 are exchanged.

use super::{Configuration, Joint, Part, Robot, RobotFault, RobotModel};
use crate::description::{ArmDescription, RobotDescription};
use crate::joint_vector::JointVector;

/// Maximum number of arms of a robot.
pub const MAX_ARMS: usize = 4;

/// The default posture of an arm that is not planned.
const HOME: &str = "home";

/// The position of an arm and its fingers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmPosition {
    /// The arm's joints.
    pub joints: JointVector,
    /// The distance of each of its fingers from the middle, in metres.
    pub finger: f64,
}

/// The positions of the arms from number 1 on; an arm without a position stands at the robot's default ([`Robot::with_other_arm_at`]).
pub type OtherArms = [Option<ArmPosition>; MAX_ARMS - 1];

/// No position for any of them.
pub const UNSAID: OtherArms = [None; MAX_ARMS - 1];

/// An arm that is not planned.
#[derive(Debug, Clone)]
pub(super) struct OtherArm {
    name: String,
    part: Part,
    finger: Option<Part>,
}

impl RobotDescription {
    /// The same description with another arm as the planned one.
    pub(super) fn with_arm(&self, name: &str) -> Option<RobotDescription> {
        let mut seen = self.clone();
        let other = seen.other_arms.iter_mut().find(|arm| arm.name == name)?;
        std::mem::swap(&mut seen.arm, other);
        (seen.gripper, other.gripper) = (seen.arm.gripper.take(), seen.gripper);
        (seen.postures, other.postures) = (std::mem::take(&mut seen.arm.postures), seen.postures);
        // A workplace describes what the robot's first arm reaches.
        seen.workplace = None;
        Some(seen)
    }
}

impl OtherArm {
    /// The arms of a description that are not planned; puts their default positions into `neutral`.
    pub(super) fn all(
        description: &RobotDescription,
        model: &RobotModel,
        neutral: &mut [f64],
    ) -> Result<Vec<OtherArm>, RobotFault> {
        let RobotDescription { arm, other_arms, .. } = description;
        let mut taken: Vec<&ArmDescription> = vec![arm];
        let mut others = Vec::new();
        if other_arms.len() >= MAX_ARMS {
            return Err(RobotFault::Arms { count: other_arms.len() + 1 });
        }
        for other in other_arms {
            if taken.iter().any(|arm| arm.name == other.name) {
                return Err(RobotFault::ArmTwice { arm: other.name.clone() });
            }
            let part = Part::of(model, &other.joints)?;
            if let Some(home) = other.postures.get(HOME) {
                part.put(&part.posture(HOME, home)?, neutral);
            }
            let finger = other.gripper.as_ref().map(|gripper| Part::gripper(model, gripper)).transpose()?;
            if let Some(finger) = &finger {
                // Open fingers take the most room.
                neutral[finger.indices[0]] = finger.joints[0].upper;
            }
            others.push(OtherArm { name: other.name.clone(), part, finger });
            taken.push(other);
        }
        Ok(others)
    }
}

impl OtherArm {
    /// Sets the positions of its joints.
    pub(super) fn put(&self, at: &ArmPosition, positions: &mut [f64]) {
        self.part.put(&at.joints, positions);
        if let Some(finger) = &self.finger {
            positions[finger.indices[0]] = at.finger;
        }
    }

    /// The parts of its joints and of its fingers.
    pub(super) fn parts(&self) -> [Option<&Part>; 2] {
        [Some(&self.part), self.finger.as_ref()]
    }

    /// Number of values of its position.
    pub(super) fn values(&self) -> usize {
        self.part.joints.len() + 1
    }

    fn at(&self, positions: &[f64]) -> ArmPosition {
        ArmPosition {
            joints: JointVector::from_fn(self.part.indices.len(), |j| positions[self.part.indices[j]]),
            finger: self.finger.as_ref().map_or(0.0, |finger| positions[finger.indices[0]]),
        }
    }
}

impl Configuration {
    /// Sets the joints of an arm. Does nothing if the arm of that number has no position yet.
    pub fn set_joints(&mut self, arm: usize, joints: JointVector) {
        match arm.checked_sub(1) {
            None => self.arm = joints,
            Some(other) => self.others.iter_mut().skip(other).take(1).flatten().for_each(|at| at.joints = joints),
        }
    }

    /// Sets the fingers of an arm, as [`Configuration::set_joints`] does with its joints.
    pub fn set_finger(&mut self, arm: usize, finger: f64) {
        match arm.checked_sub(1) {
            None => self.finger = finger,
            Some(other) => self.others.iter_mut().skip(other).take(1).flatten().for_each(|at| at.finger = finger),
        }
    }

    /// The position of an arm, if given.
    pub fn of_arm(&self, arm: usize) -> Option<ArmPosition> {
        match arm.checked_sub(1) {
            None => Some(ArmPosition { joints: self.arm, finger: self.finger }),
            Some(other) => self.others.get(other).copied().flatten(),
        }
    }
}

impl Robot {
    /// The names of all arms in the order of their numbers.
    pub fn arm_names(&self) -> impl Iterator<Item = &str> {
        std::iter::once(self.arm_name()).chain(self.other_arms())
    }

    /// The limits of the joints of the arm with this number; empty if the robot has no such arm.
    pub fn joints_of(&self, arm: usize) -> &[Joint] {
        match arm.checked_sub(1) {
            None => &self.arm.joints,
            Some(other) => self.other_arms.get(other).map_or(&[], |arm| &arm.part.joints),
        }
    }

    /// The links that the joints of the arm with this number move.
    pub fn links_of(&self, arm: usize) -> Vec<usize> {
        match arm.checked_sub(1) {
            None => self.arm_links.clone(),
            Some(other) => self.other_arms.get(other).map_or_else(Vec::new, |arm| arm.part.moved_links(&self.model)),
        }
    }

    /// Whether the joints of the arm with this number move the camera.
    pub fn moves_camera(&self, arm: usize) -> bool {
        self.camera.is_some_and(|camera| self.links_of(arm).contains(&camera))
    }

    /// The links of the fingers of the arm with this number.
    pub fn finger_links_of(&self, arm: usize) -> Vec<usize> {
        match arm.checked_sub(1) {
            None => self.finger_links(),
            Some(other) => {
                let finger = self.other_arms.get(other).and_then(|arm| arm.finger.as_ref());
                finger.map_or_else(Vec::new, |finger| finger.moved_links(&self.model))
            }
        }
    }

    /// The same with a position for every arm: the default for arms without one.
    pub fn with_all_arms(&self, configuration: &Configuration) -> Configuration {
        let mut all = *configuration;
        for (at, arm) in all.others.iter_mut().zip(&self.other_arms) {
            at.get_or_insert_with(|| arm.at(&self.neutral));
        }
        all
    }

    /// A configuration of this robot, converted to the robot seen from the arm that has this number here.
    pub fn seen_from(&self, arm: usize, configuration: &Configuration) -> Configuration {
        let mut seen = self.with_all_arms(configuration);
        if let Some(other) = arm.checked_sub(1)
            && let Some(at) = seen.of_arm(arm)
        {
            seen.others[other] = Some(ArmPosition { joints: seen.arm, finger: seen.finger });
            (seen.arm, seen.finger) = (at.joints, at.finger);
        }
        seen
    }

    /// The name of the planned arm.
    pub fn arm_name(&self) -> &str {
        &self.description.arm.name
    }

    /// The names of the other arms.
    pub fn other_arms(&self) -> impl Iterator<Item = &str> {
        self.other_arms.iter().map(|arm| arm.name.as_str())
    }

    /// The same robot with another planned arm.
    ///
    /// # Errors
    /// [`RobotFault::NoArm`] if it has no arm with this name.
    pub fn with_arm(&self, name: &str) -> Result<Robot, RobotFault> {
        if name == self.arm_name() {
            return Ok(self.clone());
        }
        match self.description.with_arm(name) {
            Some(description) => Robot::on(description, self.model.clone()),
            None => Err(self.no_arm(name)),
        }
    }

    /// The same robot with another default posture of one of the other arms.
    ///
    /// # Errors
    /// [`RobotFault`] if there is no other arm with this name, or it cannot take the posture.
    pub fn with_other_arm_at(mut self, name: &str, posture: &[f64]) -> Result<Robot, RobotFault> {
        let Some(arm) = self.other_arms.iter().find(|arm| arm.name == name) else { return Err(self.no_arm(name)) };
        let posture = arm.part.posture(name, posture)?;
        arm.part.put(&posture, &mut self.neutral);
        Ok(self)
    }

    /// The same robot with other limits of the arm's joints.
    pub(crate) fn with_arm_joints(&self, joints: Vec<Joint>) -> Robot {
        let mut seen = self.clone();
        for (index, joint) in self.arm.indices.iter().zip(&joints) {
            seen.model.joints[*index].clone_from(joint);
        }
        seen.arm.joints = joints;
        seen
    }

    fn no_arm(&self, name: &str) -> RobotFault {
        let arms: Vec<&str> = std::iter::once(self.arm_name()).chain(self.other_arms()).collect();
        RobotFault::NoArm { arm: name.to_owned(), robot: self.name().to_owned(), arms: arms.join(", ") }
    }
}

impl Part {
    fn put(&self, values: &JointVector, positions: &mut [f64]) {
        for (index, value) in self.indices.iter().zip(values) {
            positions[*index] = *value;
        }
    }
}
