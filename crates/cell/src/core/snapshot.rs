//! A snapshot: the cell's state as a value, which the same or another process can restore.
//!
//! Goals are not part of it, because their clients are gone when it is restored: every joint keeps the position that it had, and holds. The emergency
//! stop, which concerns the real surroundings, and the contacts, which are counted anew, are not part of it either.

use super::arms::FIRST;
use super::battery::Battery;
use super::cell::{Cell, joint_counts};
use super::contacts::Contacts;
use super::environment::{Environment, Saved};
use super::errors::Errors;
use super::faults::{Fault, Faults};
use super::holding::Held;
use super::parting::{Around, Closed};
use super::placement::furniture;
use super::protocol::Command;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{ArmPosition, Configuration, Robot, RobotIdentity};
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// The format version of snapshots; any other is refused.
pub const FORM: u32 = 1;

/// A cell's state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Snapshot {
    /// [`FORM`].
    form: u32,
    /// The robot; missing in snapshots of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    robot: Option<RobotIdentity>,
    seed: u64,
    ids: Vec<String>,
    tilts: Vec<f64>,
    environment: Saved,
    /// The measured posture.
    posture: Posture,
    held: Option<SavedHold>,
    battery: f64,
    frames_taken: u64,
    faults: Vec<Fault>,
    /// Words drawn from the generator of random faults so far.
    drawn: u64,
    blind_until: Timestamp,
    lost_until: Timestamp,
    /// Number of stops of the base.
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
    /// Position of the fingers after they last closed; missing in snapshots of earlier versions.
    #[serde(default)]
    closed_finger: f64,
    /// They are still at the object that they released.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    at_let_go: bool,
    /// The arms from number 1 on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    other_arms: Vec<ArmPosture>,
}

/// An arm other than the first one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ArmPosture {
    joints: JointVector,
    finger: f64,
    #[serde(default)]
    closed_finger: f64,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    at_let_go: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    held: Option<SavedHold>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SavedHold {
    object: usize,
    in_tool: Pose,
    friction: f64,
}

/// Why a snapshot does not fit this cell.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// The text is not JSON, or not that of a snapshot.
    #[error("this is no snapshot of a cell: {0}")]
    Unreadable(String),
    /// The snapshot has another format version.
    #[error("this snapshot has form {0}, this cell knows {FORM}")]
    OtherForm(u32),
    /// The snapshot is of a robot with another number of joints.
    #[error(
        "this snapshot is of a robot whose arm has {of} joints: the arm of this cell has {here}, so it cannot be put back to it"
    )]
    OtherRobot {
        /// Number of joints in the snapshot.
        of: usize,
        /// Number of joints in the cell.
        here: usize,
    },
    /// The snapshot names another robot.
    #[error(
        "this snapshot is of the robot {of}, and this cell has the robot {here}: put it back to a cell of its own robot"
    )]
    AnotherRobot {
        /// The robot of the snapshot.
        of: RobotIdentity,
        /// The robot of the cell.
        here: RobotIdentity,
    },
    /// Parts of the snapshot contradict each other.
    #[error("this snapshot contradicts itself: {0}")]
    Inconsistent(&'static str),
}

/// Allowed sizes of objects.
const SIZES_M: RangeInclusive<f64> = 1e-4..=10.0;
/// Maximum absolute value of any position, angle or speed.
const LARGEST: f64 = 1e6;

/// Whether a pose is valid: its position is within bounds, and its quaternion is a rotation.
fn is_pose(pose: &Pose) -> bool {
    let length = pose.quaternion_xyzw.iter().map(|x| x * x).sum::<f64>().sqrt();
    pose.position.iter().all(|x| x.abs() <= LARGEST) && (length - 1.0).abs() < 1e-6
}

impl Snapshot {
    /// The snapshot as JSON.
    pub fn to_json(&self) -> String {
        // Numbers, texts and lists: JSON can represent all of them.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// Reads a snapshot from JSON.
    ///
    /// # Errors
    /// [`SnapshotError`] if no cell can be restored from it.
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
        let held: Vec<usize> = snapshot.all_held().flatten().map(|held| held.object).collect();
        if held.iter().any(|object| *object >= objects) {
            return Err(SnapshotError::Inconsistent("what is held is none of its objects"));
        }
        if held.iter().enumerate().any(|(i, object)| held[..i].contains(object)) {
            return Err(SnapshotError::Inconsistent("two arms hold the same object"));
        }
        if !(0.0..=1.0).contains(&snapshot.battery) {
            return Err(SnapshotError::Inconsistent("its battery is fuller than full or emptier than empty"));
        }
        snapshot.check_numbers().map(|()| snapshot)
    }

    /// Checks that the physics can continue with its numbers.
    fn check_numbers(&self) -> Result<(), SnapshotError> {
        let wrong = |what| Err(SnapshotError::Inconsistent(what));
        if self.environment.objects.iter().any(|(model, _)| !model.size.iter().all(|size| SIZES_M.contains(size))) {
            return wrong("the size of an object is not from 0.1 mm to 10 m");
        }
        let states = || self.environment.objects.iter().map(|(_, state)| state);
        let held = || self.all_held().flatten();
        let poses = states().flat_map(|state| std::iter::once(&state.pose).chain(&state.rides));
        if !poses.chain(held().map(|held| &held.in_tool)).all(is_pose) {
            return wrong("a pose is farther away than 1,000 km, or its quaternion is not of length 1");
        }
        let Posture { base, pan, tilt, finger, closed_finger, .. } = &self.posture;
        let of_states = states().flat_map(|state| state.velocity.into_iter().chain(state.spin));
        let others = self.posture.other_arms.iter();
        let of_others = others.flat_map(|arm| arm.joints.iter().copied().chain([arm.finger, arm.closed_finger]));
        let of_posture = base.iter().chain(self.posture.arm.iter()).chain([pan, tilt, finger, closed_finger]).copied();
        let rest = self.tilts.iter().copied().chain(held().map(|held| held.friction));
        match of_states.chain(of_others).chain(of_posture).chain(rest).all(|x| x.abs() <= LARGEST) {
            true => Ok(()),
            false => wrong("a speed, a joint or a place of the robot is beyond 1,000,000"),
        }
    }

    /// Checks that a cell with this robot can restore the snapshot. If the snapshot names no robot, the numbers of joints have to be equal.
    ///
    /// # Errors
    /// [`SnapshotError::AnotherRobot`], [`SnapshotError::OtherRobot`] or [`SnapshotError::Inconsistent`].
    pub fn check_robot(&self, here: &Robot) -> Result<(), SnapshotError> {
        if let Some(of) = self.robot.as_ref() {
            let here = here.identity();
            if *of != here {
                return Err(SnapshotError::AnotherRobot { of: of.clone(), here });
            }
        }
        let others = self.posture.other_arms.iter().map(|arm| arm.joints.len());
        let mut joints = std::iter::once(self.posture.arm.len()).chain(others).zip(joint_counts(here));
        if let Some((of, here)) = joints.find(|(of, here)| of != here) {
            return Err(SnapshotError::OtherRobot { of, here });
        }
        if self.posture.other_arms.len() + 1 != here.arm_names().count() {
            return Err(SnapshotError::Inconsistent("it has postures of another number of arms than its robot"));
        }
        Ok(())
    }

    /// The held object of each arm, in the order of the arm numbers.
    fn all_held(&self) -> impl Iterator<Item = Option<&SavedHold>> {
        let others = self.posture.other_arms.iter().map(|arm| arm.held.as_ref());
        std::iter::once(self.held.as_ref()).chain(others)
    }

    /// The stored closing position of each arm's fingers, and whether they are at the object that they released.
    fn all_closed(&self) -> impl Iterator<Item = (f64, bool)> {
        let others = self.posture.other_arms.iter().map(|arm| (arm.closed_finger, arm.at_let_go));
        std::iter::once((self.posture.closed_finger, self.posture.at_let_go)).chain(others)
    }
}

/// The last closing of fingers that are `finger` metres from the middle: their position if they hold an object, and never wider than they are now.
fn closed_as((said_m, at_let_go): (f64, bool), finger: f64, holds: bool, open_m: f64) -> Closed {
    if holds {
        return Closed { at_m: finger, around: Around::Something };
    }
    let closed = Closed { at_m: said_m.clamp(0.0, finger.max(0.0)), around: Around::Something };
    match (at_let_go, closed.has_parted(finger, open_m)) {
        (true, _) => closed,
        (false, true) => Closed { around: Around::Nothing, ..closed },
        // The object that they failed to grasp is not in a snapshot.
        (false, false) => Closed { around: Around::Slipped, ..closed },
    }
}

impl Cell {
    /// The current state. The battery restarts its times here, as it does in a cell that restores the snapshot: so both cells behave alike afterwards.
    pub(super) fn save(&mut self) -> Snapshot {
        let measured = self.measured();
        let Configuration { base, arm, pan, tilt, finger, .. } = measured;
        let held = |arm: usize| {
            self.arms.held(arm).map(|held| {
                let (object, in_tool, friction) = held.save();
                SavedHold { object, in_tool, friction }
            })
        };
        let closed =
            |arm: usize, finger: f64| (self.arms.closed(arm).at_m, self.arms.is_at_what_it_let_go(arm, finger));
        let other_arms = self.arms.others(&measured).into_iter().enumerate();
        let other_arms = other_arms
            .map(|(i, ArmPosition { joints, finger })| {
                let (closed_finger, at_let_go) = closed(i + 1, finger);
                ArmPosture { joints, finger, closed_finger, at_let_go, held: held(i + 1) }
            })
            .collect();
        let (first_held, (closed_finger, at_let_go)) = (held(FIRST), closed(FIRST, finger));
        let (faults, drawn) = self.faults.save();
        self.battery = Battery::at(self.config.battery, self.battery.level());
        Snapshot {
            form: FORM,
            robot: Some(self.robot.identity()),
            seed: self.seed,
            ids: self.ids.clone(),
            tilts: self.tilts.clone(),
            environment: self.environment.save(&self.robot, &self.configuration()),
            posture: Posture { base, arm, pan, tilt, finger, closed_finger, at_let_go, other_arms },
            held: first_held,
            battery: self.battery.level(),
            frames_taken: self.frames_taken,
            faults,
            drawn,
            blind_until: self.blind_until,
            lost_until: self.lost_until,
            stops: self.stops,
        }
    }

    /// Restores a state; current goals end `aborted`. A snapshot of another robot changes nothing: such a request is refused before
    /// ([`Snapshot::check_robot`]).
    pub(super) fn put_back(&mut self, snapshot: &Snapshot, out: &mut Vec<Command>) {
        if snapshot.check_robot(&self.robot).is_err() {
            return;
        }
        self.freeze("the cell was put back to a snapshot", out);
        let Posture { base, arm, pan, tilt, finger, other_arms, .. } = snapshot.posture.clone();
        self.resting = Configuration { base, arm, pan, tilt, finger, ..self.arms.first_posture() };
        for (i, other) in other_arms.into_iter().enumerate() {
            self.resting.set_joints(i + 1, other.joints);
            self.resting.set_finger(i + 1, other.finger);
        }
        (self.seed, self.stops) = (snapshot.seed, snapshot.stops);
        self.errors = Errors::new(self.config.errors, &joint_counts(&self.robot), self.seed, self.stops);
        self.environment = Environment::restore(
            &self.robot,
            &self.configuration(),
            &furniture(&self.robot, self.config.scene),
            &snapshot.environment,
        );
        self.environment.set_time(self.now);
        for (arm, (held, closed)) in snapshot.all_held().zip(snapshot.all_closed()).enumerate() {
            let finger = self.arms.seen_from(arm, &self.resting).finger;
            self.arms.have_closed(arm, closed_as(closed, finger, held.is_some(), self.arms.open_finger_m(arm)));
            self.arms.hold(arm, held.map(|held| Held::new(held.object, held.in_tool, held.friction)));
        }
        self.contacts = Contacts::of(&self.robot);
        self.ids.clone_from(&snapshot.ids);
        self.tilts.clone_from(&snapshot.tilts);
        self.battery = Battery::at(self.config.battery, snapshot.battery);
        self.frames_taken = snapshot.frames_taken;
        self.faults = Faults::restore(&snapshot.faults, snapshot.seed, snapshot.drawn);
        (self.blind_until, self.lost_until) = (snapshot.blind_until, snapshot.lost_until);
    }
}
