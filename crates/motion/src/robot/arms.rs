//! Robots with several arms: one of them is planned for, and the others stand where they are told to.
//!
//! A [`Robot`] is seen from one of its arms. [`Robot::with_arm`] is the same robot seen from another one; then the first is one of the others.

use super::{Part, Robot, RobotFault, RobotModel};
use crate::description::{ArmDescription, RobotDescription};
use crate::joint_vector::JointVector;

/// The posture in which an arm stands unless it is said where.
const HOME: &str = "home";

/// An arm that stands.
#[derive(Debug, Clone)]
pub(super) struct OtherArm {
    name: String,
    part: Part,
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
        for other in other_arms {
            if taken.iter().any(|arm| arm.name == other.name) {
                return Err(RobotFault::ArmTwice { arm: other.name.clone() });
            }
            let part = Part::of(model, &other.joints)?;
            if let Some(home) = other.postures.get(HOME) {
                part.put(&part.posture(HOME, home)?, neutral);
            }
            others.push(OtherArm { name: other.name.clone(), part });
            taken.push(other);
        }
        Ok(others)
    }
}

impl Robot {
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
