//! The objects of the cell as its ground truth tells of them; the robot itself does not know this.

use super::environment::{Kind, Model};
use ratn_model::pose::Pose;

/// An object of a new table.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// Its name in the cell, `slc_1`. The detector finds its own names.
    pub id: String,
    /// What it is.
    pub model: Model,
    /// Its centre, in the world frame.
    pub pose: Pose,
}

/// What the ground truth says of an object.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueObject {
    /// Its name in the cell.
    pub id: String,
    /// What it is.
    pub kind: Kind,
    /// Edge lengths of its bounding box in metres.
    pub size: [f64; 3],
    /// Its centre, in the world frame.
    pub pose: Pose,
    /// It stands at a place of the load deck: delivered.
    pub on_base: bool,
    /// It stands where the task of this cell is to bring it: a box on the load deck, tableware at a place for its kind on the table.
    pub in_place: bool,
    /// How far it leaned at the most while the gripper held it, in radians.
    pub greatest_tilt_rad: f64,
    /// A gripper holds it.
    pub held: bool,
    /// The name of the arm whose gripper holds it.
    pub holder: Option<String>,
    /// On what it rests; empty while held, and in the air.
    pub on: String,
}

/// The name of the robot's base as something to stand on.
pub const ON_BASE: &str = "base";
