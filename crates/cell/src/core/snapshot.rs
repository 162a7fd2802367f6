//! The cell's state as a value: what it can be put back to, or made of in another process.
//!
//! No goal is part of it: who gave one is not there any more when it is restored, so every joint is where it had come to and holds.
//! The emergency stop is not part of it either: it is about the world outside. Nor is what has touched: that is judged from there anew.

use super::battery::Battery;
use super::cell::Cell;
use super::contacts::Contacts;
use super::environment::{Environment, Saved};
use super::errors::Errors;
use super::faults::{Fault, Faults};
use super::holding::Held;
use super::placement::furniture;
use super::protocol::Command;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Configuration;
use serde::{Deserialize, Serialize};

/// The form of what is written; another one is refused.
pub const FORM: u32 = 1;

/// A cell's state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Snapshot {
    /// [`FORM`].
    form: u32,
    seed: u64,
    ids: Vec<String>,
    tilts: Vec<f64>,
    environment: Saved,
    /// As measured.
    posture: Posture,
    held: Option<SavedHold>,
    battery: f64,
    frames_taken: u64,
    faults: Vec<Fault>,
    /// Words drawn for faults by chance so far.
    drawn: u64,
    blind_until: Timestamp,
    lost_until: Timestamp,
    /// How often the base had come to a stop.
    #[serde(default)]
    stops: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Posture {
    base: [f64; 3],
    arm: JointVector,
    pan: f64,
    tilt: f64,
    finger: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedHold {
    object: usize,
    in_tool: Pose,
    friction: f64,
}

/// A snapshot that is none of this cell.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// No JSON, or another.
    #[error("this is no snapshot of a cell: {0}")]
    Unreadable(String),
    /// Of another version.
    #[error("this snapshot has form {0}, this cell knows {FORM}")]
    OtherForm(u32),
    /// Of a robot with another number of joints.
    #[error(
        "this snapshot is of a robot whose arm has {of} joints: the arm of this cell has {here}, so it cannot be put back to it"
    )]
    OtherRobot {
        /// Of the snapshot's.
        of: usize,
        /// Of the cell's.
        here: usize,
    },
    /// Parts that do not fit each other.
    #[error("this snapshot contradicts itself: {0}")]
    Inconsistent(&'static str),
}

impl Snapshot {
    /// As text.
    pub fn to_json(&self) -> String {
        // Numbers, texts and lists: nothing that JSON cannot hold.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// From text.
    ///
    /// # Errors
    /// [`SnapshotError`] where it is none that a cell can be restored from.
    pub fn from_json(text: &str) -> Result<Snapshot, SnapshotError> {
        let snapshot: Snapshot =
            serde_json::from_str(text).map_err(|error| SnapshotError::Unreadable(error.to_string()))?;
        if snapshot.form != FORM {
            return Err(SnapshotError::OtherForm(snapshot.form));
        }
        let objects = snapshot.environment.objects.len();
        if snapshot.ids.len() != objects || snapshot.tilts.len() != objects {
            return Err(SnapshotError::Inconsistent("its objects and their names are not as many"));
        }
        if snapshot.held.as_ref().is_some_and(|held| held.object >= objects) {
            return Err(SnapshotError::Inconsistent("what is held is none of its objects"));
        }
        if !(0.0..=1.0).contains(&snapshot.battery) {
            return Err(SnapshotError::Inconsistent("its battery is fuller than full or emptier than empty"));
        }
        Ok(snapshot)
    }

    /// Whether a cell whose arm has so many joints can be put back to it.
    ///
    /// # Errors
    /// [`SnapshotError::OtherRobot`].
    pub fn check_joints(&self, here: usize) -> Result<(), SnapshotError> {
        let of = self.posture.arm.len();
        if of == here { Ok(()) } else { Err(SnapshotError::OtherRobot { of, here }) }
    }
}

impl Cell {
    /// The state now. What goes on here and what goes on from it do so alike.
    pub(super) fn save(&mut self) -> Snapshot {
        let Configuration { base, arm, pan, tilt, finger } = self.measured();
        let (faults, drawn) = self.faults.save();
        self.battery = Battery::at(self.config.battery, self.battery.level());
        Snapshot {
            form: FORM,
            seed: self.seed,
            ids: self.ids.clone(),
            tilts: self.tilts.clone(),
            environment: self.environment.save(&self.robot, &self.configuration()),
            posture: Posture { base, arm, pan, tilt, finger },
            held: self.held.map(|held| {
                let (object, in_tool, friction) = held.save();
                SavedHold { object, in_tool, friction }
            }),
            battery: self.battery.level(),
            frames_taken: self.frames_taken,
            faults,
            drawn,
            blind_until: self.blind_until,
            lost_until: self.lost_until,
            stops: self.stops,
        }
    }

    /// Back to a state; goals under way end aborted.
    pub(super) fn put_back(&mut self, snapshot: &Snapshot, out: &mut Vec<Command>) {
        self.freeze("the cell was put back to a snapshot", out);
        let Posture { base, arm, pan, tilt, finger } = snapshot.posture.clone();
        self.resting = Configuration { base, arm, pan, tilt, finger };
        (self.seed, self.stops) = (snapshot.seed, snapshot.stops);
        self.errors = Errors::new(self.config.errors, self.robot.arm_joints().len(), self.seed, self.stops);
        self.environment = Environment::restore(
            &self.robot,
            &self.configuration(),
            &furniture(&self.robot, self.config.scene),
            &snapshot.environment,
        );
        self.environment.set_time(self.now);
        self.held = snapshot.held.as_ref().map(|held| Held::new(held.object, held.in_tool, held.friction));
        self.contacts = Contacts::of(&self.robot);
        self.ids.clone_from(&snapshot.ids);
        self.tilts.clone_from(&snapshot.tilts);
        self.battery = Battery::at(self.config.battery, snapshot.battery);
        self.frames_taken = snapshot.frames_taken;
        self.faults = Faults::restore(&snapshot.faults, snapshot.seed, snapshot.drawn);
        (self.blind_until, self.lost_until) = (snapshot.blind_until, snapshot.lost_until);
    }
}
