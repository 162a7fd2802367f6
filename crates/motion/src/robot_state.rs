//! Where every joint of a robot is: those that are planned for, and those that stand still meanwhile.

use crate::robot_model::{Joint, RobotModel};
use std::collections::BTreeMap;

/// A position for each joint of a [`RobotModel`], in radians (metres for a joint that slides). Joints that mimic follow.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotState {
    positions: Vec<f64>,
}

/// A position that a joint cannot be given.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StateError {
    /// No such joint.
    #[error("the robot has no joint `{joint}` that moves")]
    Unknown {
        /// Its name.
        joint: String,
    },
    /// It has no position of its own.
    #[error("joint `{joint}` mimics another: give the position of that one")]
    Mimics {
        /// Its name.
        joint: String,
    },
    /// Not within the limits.
    #[error("joint `{joint}` cannot be at {position}: its limits are {lower} to {upper}")]
    Beyond {
        /// Its name.
        joint: String,
        /// As given.
        position: f64,
        /// Its least position.
        lower: f64,
        /// Its greatest position.
        upper: f64,
    },
}

impl RobotState {
    /// Every joint at zero, or at the limit next to it.
    pub fn neutral(model: &RobotModel) -> RobotState {
        let rest = |joint: &Joint| 0.0_f64.max(joint.lower).min(joint.upper);
        RobotState { positions: model.joints.iter().map(rest).collect() }
    }

    /// The same with some joints elsewhere.
    ///
    /// # Errors
    /// [`StateError`] names the joint.
    pub fn with(mut self, model: &RobotModel, named: &BTreeMap<String, f64>) -> Result<RobotState, StateError> {
        for (name, position) in named {
            let Some(index) = model.joint(name) else {
                let joint = name.clone();
                let mimics = model.mimics.contains(name);
                return Err(if mimics { StateError::Mimics { joint } } else { StateError::Unknown { joint } });
            };
            let joint = &model.joints[index];
            if !position.is_finite() || !joint.allows(*position, 0.0) {
                let [lower, upper] = joint.limits();
                return Err(StateError::Beyond { joint: name.clone(), position: *position, lower, upper });
            }
            self.positions[index] = *position;
        }
        Ok(self)
    }

    /// The positions, in the order of the model's joints.
    pub fn positions(&self) -> &[f64] {
        &self.positions
    }
}
