//! The objects of the cell in its ground truth, which the robot itself does not know.

use super::environment::{Kind, Model};
use ratn_model::pose::Pose;

/// An object of a new scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// Its name in the cell, `slc_1`. The detector assigns its own names.
    pub id: String,
    /// Its kind and size.
    pub model: Model,
    /// Its centre, in the world frame.
    pub pose: Pose,
}

/// The ground truth of an object.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueObject {
    /// Its name in the cell.
    pub id: String,
    /// Its kind.
    pub kind: Kind,
    /// Edge lengths of its bounding box in metres.
    pub size: [f64; 3],
    /// Its centre, in the world frame.
    pub pose: Pose,
    /// Whether it stands at a place of the load deck: delivered.
    pub on_base: bool,
    /// Whether it stands where this cell's task has to bring it: a box on the load deck, tableware at a place for its kind on the table.
    pub in_place: bool,
    /// Its maximum lean while a gripper held it, in radians.
    pub greatest_tilt_rad: f64,
    /// Whether a gripper holds it.
    pub held: bool,
    /// The name of the arm whose gripper holds it.
    pub holder: Option<String>,
    /// The name of its support; empty while it is held or in the air.
    pub on: String,
}

/// The name of the robot's base as a support.
pub const ON_BASE: &str = "base";
