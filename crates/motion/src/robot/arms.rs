//! Robots with several arms: one of them is planned for, and the others stand where they are told to.
//!
//! A [`Robot`] is seen from one of its arms, which has the number 0; the others have the numbers from 1 on. [`Robot::with_arm`] is the same
//! robot seen from another arm: that one and the arm 0 change places.

use super::{Configuration, Joint, Part, Robot, RobotFault, RobotModel};
use crate::description::{ArmDescription, RobotDescription};
use crate::joint_vector::JointVector;

/// The most arms that a robot can have.
pub const MAX_ARMS: usize = 4;

/// The posture in which an arm stands unless it is said where.
const HOME: &str = "home";

/// Where an arm and its fingers are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmPosition {
    /// The arm's joints.
    pub joints: JointVector,
    /// The distance of each of its fingers from the middle, in metres.
    pub finger: f64,
}

/// Where the arms from number 1 on are; an arm without a position is where the robot has it ([`Robot::with_other_arm_at`]).
pub type OtherArms = [Option<ArmPosition>; MAX_ARMS - 1];

/// No position of any of them.
pub const UNSAID: OtherArms = [None; MAX_ARMS - 1];

/// An arm that stands.
#[derive(Debug, Clone)]
pub(super) struct OtherArm {
    name: String,
    part: Part,
    finger: Option<Part>,
}

impl RobotDescription {
    /// The same with another arm as the one that is planned for.
    pub(super) fn with_arm(&self, name: &str) -> Option<RobotDescription> {
        let mut seen = self.clone();
        let other = seen.other_arms.iter_mut().find(|arm| arm.name == name)?;
        std::mem::swap(&mut seen.arm, other);
        (seen.gripper, other.gripper) = (seen.arm.gripper.take(), seen.gripper);
        (seen.postures, other.postures) = (std::mem::take(&mut seen.arm.postures), seen.postures);
        // A workplace says what the robot's first arm reaches.
        seen.workplace = None;
        Some(seen)
    }
}

impl OtherArm {
    /// The arms of a description that are not planned for, put where they stand by default.
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
                // Open, they take the most room.
                neutral[finger.indices[0]] = finger.joints[0].upper;
            }
            others.push(OtherArm { name: other.name.clone(), part, finger });
            taken.push(other);
        }
        Ok(others)
    }
}

impl OtherArm {
    /// Brings its joints to a position.
    pub(super) fn put(&self, at: &ArmPosition, positions: &mut [f64]) {
        self.part.put(&at.joints, positions);
        if let Some(finger) = &self.finger {
            positions[finger.indices[0]] = at.finger;
        }
    }

    /// Its joints, and that of its fingers.
    pub(super) fn parts(&self) -> [Option<&Part>; 2] {
        [Some(&self.part), self.finger.as_ref()]
    }

    /// How many numbers a position of it has.
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
    /// Brings the joints of an arm to a position. Nothing happens where the arm of that number has none yet.
    pub fn set_joints(&mut self, arm: usize, joints: JointVector) {
        match arm.checked_sub(1) {
            None => self.arm = joints,
            Some(other) => self.others.iter_mut().skip(other).take(1).flatten().for_each(|at| at.joints = joints),
        }
    }

    /// Brings the fingers of an arm to a position, as [`Configuration::set_joints`] does with its joints.
    pub fn set_finger(&mut self, arm: usize, finger: f64) {
        match arm.checked_sub(1) {
            None => self.finger = finger,
            Some(other) => self.others.iter_mut().skip(other).take(1).flatten().for_each(|at| at.finger = finger),
        }
    }

    /// Where an arm is, if that is said.
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

    /// The limits of the joints of an arm by its number; of an arm that the robot does not have there are none.
    pub fn joints_of(&self, arm: usize) -> &[Joint] {
        match arm.checked_sub(1) {
            None => &self.arm.joints,
            Some(other) => self.other_arms.get(other).map_or(&[], |arm| &arm.part.joints),
        }
    }

    /// The links that the joints of an arm move, by its number.
    pub fn links_of(&self, arm: usize) -> Vec<usize> {
        match arm.checked_sub(1) {
            None => self.arm_links.clone(),
            Some(other) => self.other_arms.get(other).map_or_else(Vec::new, |arm| arm.part.moved_links(&self.model)),
        }
    }

    /// Whether the joints of an arm move the camera, by the arm's number.
    pub fn moves_camera(&self, arm: usize) -> bool {
        self.camera.is_some_and(|camera| self.links_of(arm).contains(&camera))
    }

    /// The links of the fingers of an arm, by its number.
    pub fn finger_links_of(&self, arm: usize) -> Vec<usize> {
        match arm.checked_sub(1) {
            None => self.finger_links(),
            Some(other) => {
                let finger = self.other_arms.get(other).and_then(|arm| arm.finger.as_ref());
                finger.map_or_else(Vec::new, |finger| finger.moved_links(&self.model))
            }
        }
    }

    /// The same with a position for every arm: one without is where the robot has it.
    pub fn with_all_arms(&self, configuration: &Configuration) -> Configuration {
        let mut all = *configuration;
        for (at, arm) in all.others.iter_mut().zip(&self.other_arms) {
            at.get_or_insert_with(|| arm.at(&self.neutral));
        }
        all
    }

    /// A configuration of this robot as one of the same robot seen from another arm, by that arm's number here.
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

    /// The name of the arm that is planned for.
    pub fn arm_name(&self) -> &str {
        &self.description.arm.name
    }

    /// The names of the others.
    pub fn other_arms(&self) -> impl Iterator<Item = &str> {
        self.other_arms.iter().map(|arm| arm.name.as_str())
    }

    /// The same robot with another arm as the one that is planned for.
    ///
    /// # Errors
    /// [`RobotFault::NoArm`] where it has none of this name.
    pub fn with_arm(&self, name: &str) -> Result<Robot, RobotFault> {
        if name == self.arm_name() {
            return Ok(self.clone());
        }
        match self.description.with_arm(name) {
            Some(description) => Robot::on(description, self.model.clone()),
            None => Err(self.no_arm(name)),
        }
    }

    /// The same robot with one of the other arms standing in a posture.
    ///
    /// # Errors
    /// [`RobotFault`] where there is no other arm of this name, or it cannot take the posture.
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
