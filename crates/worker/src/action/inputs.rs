//! Typed access to a goal's inputs by name: for each type a required and an optional form.

use super::{GoalContext, InputError, Port};
use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, Value};

/// Generates `input_…` and `optional_…` for each type, as [`Port`] reads it.
macro_rules! inputs {
    ($($input:ident, $optional:ident, $read:ident, $what:literal, $of:ty;)*) => {
        impl GoalContext {
            $(
                #[doc = concat!("An input that must be ", $what, ".")]
                ///
                /// # Errors
                /// [`InputError`] with the action and the input, if it is missing or of another type.
                pub fn $input(&self, name: &str) -> Result<$of, InputError> {
                    self.port(name).$read()
                }

                #[doc = concat!("An input that is ", $what, " if it is there.")]
                ///
                /// # Errors
                /// [`InputError`] with the action and the input, if it is of another type.
                pub fn $optional(&self, name: &str) -> Result<Option<$of>, InputError> {
                    self.port(name).optional().map(|port| port.$read()).transpose()
                }
            )*
        }
    };
}

inputs! {
    input_any, optional_any, any, "there, whatever it is", &Value;
    input_bool, optional_bool, bool, "a truth value", bool;
    input_int, optional_int, int, "a whole number", i64;
    input_float, optional_float, float, "a number", f64;
    input_string, optional_string, string, "text", &str;
    input_pose, optional_pose, pose, "a pose", Pose;
    input_joints, optional_joints, joints, "joint positions", &[f64];
    input_trajectory, optional_trajectory, trajectory, "a trajectory", &Trajectory;
    input_bytes, optional_bytes, bytes, "bytes", &[u8];
    input_list, optional_list, list, "a list, element by element", Vec<Port<'_>>;
    input_vector3, optional_vector3, vector3, "a list of three numbers", [f64; 3];
}

impl GoalContext {
    /// The input `name`, present or not: `goal.port("region").field("pose").pose()?`.
    pub fn port(&self, name: &str) -> Port<'_> {
        Port::of(&self.action, name, self.inputs.get(name))
    }
}
