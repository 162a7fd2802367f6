//! The positions of all joints of a robot: those that are planned, and those that stand still.

use crate::robot_model::{Joint, RobotModel};
use std::collections::BTreeMap;

/// A position for each joint of a [`RobotModel`], in radians (metres for a prismatic joint). Mimic joints follow.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotState {
    positions: Vec<f64>,
}

/// Why a joint cannot have a position.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StateError {
    /// There is no such joint.
    #[error("the robot has no joint `{joint}` that moves")]
    Unknown {
        /// Its name.
        joint: String,
    },
    /// The joint mimics another one.
    #[error("joint `{joint}` mimics another: give the position of that one")]
    Mimics {
        /// Its name.
        joint: String,
    },
    /// The position is beyond the limits.
    #[error("joint `{joint}` cannot be at {position}: its limits are {lower} to {upper}")]
    Beyond {
        /// Its name.
        joint: String,
        /// The given position.
        position: f64,
        /// Its lower limit.
        lower: f64,
        /// Its upper limit.
        upper: f64,
    },
}

impl RobotState {
    /// Every joint at zero, or at the limit next to it.
    pub fn neutral(model: &RobotModel) -> RobotState {
        let rest = |joint: &Joint| 0.0_f64.max(joint.lower).min(joint.upper);
        RobotState { positions: model.joints.iter().map(rest).collect() }
    }

    /// The same with other positions of some joints.
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
