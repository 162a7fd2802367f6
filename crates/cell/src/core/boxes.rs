//! The boxes of the cell: what is really there, as nobody on the robot knows it.

use ratn_model::pose::Pose;

/// A box.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedBox {
    /// Its name in the cell, `slc_1`. The detector finds its own names.
    pub id: String,
    /// Edge lengths in metres; x is not shorter than y.
    pub size: [f64; 3],
    /// Where it is.
    pub place: Place,
}

/// Where a box is.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// It rests on something.
    At {
        /// Its centre, in the world frame.
        pose: Pose,
        /// On what: `table`, `base`, `floor` or another box.
        on: String,
        /// Whether it stands as it was made to; else it fell.
        standing: bool,
    },
    /// It is held: its centre as seen from the tool frame.
    Held {
        /// In the tool frame.
        in_tool: Pose,
    },
}

/// What the ground truth says of a box.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueBox {
    /// Its name in the cell.
    pub id: String,
    /// Edge lengths in metres.
    pub size: [f64; 3],
    /// Its centre, in the world frame.
    pub pose: Pose,
    /// It stands on the load deck: delivered.
    pub on_base: bool,
    /// The gripper holds it.
    pub held: bool,
    /// On what it rests; empty while held.
    pub on: String,
}

/// The name of the robot's base as something to stand on.
pub const ON_BASE: &str = "base";

impl SimulatedBox {
    /// Its centre in the world frame, with the tool at `tool`.
    pub fn pose(&self, tool: &Pose) -> Pose {
        match &self.place {
            Place::At { pose, .. } => *pose,
            Place::Held { in_tool } => tool.compose(in_tool),
        }
    }

    /// What is true of it, with the tool at `tool`.
    pub fn truth(&self, tool: &Pose) -> TrueBox {
        let (on, standing, held) = match &self.place {
            Place::At { on, standing, .. } => (on.clone(), *standing, false),
            Place::Held { .. } => (String::new(), false, true),
        };
        TrueBox {
            id: self.id.clone(),
            size: self.size,
            pose: self.pose(tool),
            on_base: standing && on == ON_BASE,
            held,
            on,
        }
    }
}
