//! The arms of the cell's robot: each has its own joints, may have a gripper, and holds the object between its own fingers.
//!
//! An arm has a number: 0 is the arm of the description's `[arm]`, the others follow in the order of `[[other_arm]]`. Everything specific to one arm
//! is computed with the robot *seen from* that arm ([`Robot::with_arm`]). A robot with one arm has only the number 0.

use super::grasping::Pads;
use super::holding::Held;
use super::parting::{Around, Closed};
use crate::config::CellConfig;
use ratn_model::pose::Pose;
use ratn_motion::robot::{ArmPosition, Configuration, Robot};
use ratn_motion::workplace::HOME;

/// The number of the default arm.
pub const FIRST: usize = 0;

/// The arms of one robot.
#[derive(Debug, Clone)]
pub(super) struct Arms(Vec<Arm>);

#[derive(Debug, Clone)]
struct Arm {
    name: String,
    /// The robot seen from this arm.
    view: Robot,
    /// The gripper's pads; `None` for an arm without a gripper.
    pads: Option<Pads>,
    /// Distance of each finger from the middle when the gripper is open, in metres.
    open_finger_m: f64,
    /// Position of the fingers after they last closed, and what they closed around.
    closed: Closed,
    held: Option<Held>,
}

impl Arms {
    /// The arms of a robot that meets the [demands](super::demands) of a cell; `pads` are those of the first one.
    pub(super) fn of(robot: &Robot, pads: Pads, config: &CellConfig) -> Arms {
        let mut arms: Vec<Arm> = Vec::new();
        for (number, name) in robot.arm_names().enumerate() {
            let view = match number {
                FIRST => robot.clone(),
                _ => match robot.with_arm(name) {
                    Ok(view) => view,
                    Err(fault) => unreachable!("a name that the robot has itself told is one of its arms: {fault}"),
                },
            };
            let pads = if number == FIRST { Some(pads) } else { Pads::of(&view) };
            let most = view.open_finger_m();
            let open_finger_m = config.gripper.opening_m.map_or(most, |opening_m| match number {
                FIRST => opening_m / 2.0,
                _ => most.min(opening_m / 2.0),
            });
            arms.push(Arm { name: name.to_owned(), view, pads, open_finger_m, closed: Closed::NEVER, held: None });
        }
        Arms(arms)
    }

    /// Number of arms.
    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    /// The numbers of all arms.
    pub(super) fn numbers(&self) -> std::ops::Range<usize> {
        0..self.0.len()
    }

    /// The name of an arm.
    pub(super) fn name(&self, arm: usize) -> &str {
        &self.0[arm].name
    }

    /// The robot seen from an arm.
    pub(super) fn view(&self, arm: usize) -> &Robot {
        &self.0[arm].view
    }

    /// The pads of an arm's gripper; `None` without a gripper.
    pub(super) fn pads(&self, arm: usize) -> Option<&Pads> {
        self.0[arm].pads.as_ref()
    }

    /// Distance of each finger of an arm from the middle when its gripper is open, in metres.
    pub(super) fn open_finger_m(&self, arm: usize) -> f64 {
        self.0[arm].open_finger_m
    }

    /// Position of an arm's fingers after they last closed, and what they closed around.
    pub(super) fn closed(&self, arm: usize) -> Closed {
        self.0[arm].closed
    }

    /// Records that the fingers of an arm have closed to `at_m` metres from the middle around something.
    pub(super) fn close(&mut self, arm: usize, at_m: f64, around: Around) {
        self.have_closed(arm, Closed { at_m, around });
    }

    /// Sets the position and object of the last closing of an arm's fingers.
    pub(super) fn have_closed(&mut self, arm: usize, closed: Closed) {
        self.0[arm].closed = closed;
    }

    /// An arm starts to move: from now on its fingers push the object that slipped out of them, even where they overlap with it.
    pub(super) fn sets_out(&mut self, arm: usize) {
        let around = &mut self.0[arm].closed.around;
        if *around == Around::Slipped {
            *around = Around::Nothing;
        }
    }

    /// Whether the fingers of an arm, `finger` metres from the middle, may still be at an object that they released.
    pub(super) fn is_at_what_it_let_go(&self, arm: usize, finger: f64) -> bool {
        let Arm { held, closed, open_finger_m, .. } = &self.0[arm];
        held.is_none() && closed.is_at_what_it_let_go(finger, *open_finger_m)
    }

    /// Whether the fingers of an arm, `finger` metres from the middle, push the objects that they meet without closing.
    pub(super) fn fingers_push(&self, arm: usize, finger: f64) -> bool {
        let Arm { held, closed, open_finger_m, .. } = &self.0[arm];
        // Fingers that are closed around an object stand at its faces.
        held.is_some() || closed.pushes(finger, *open_finger_m)
    }

    /// The object that an arm holds.
    pub(super) fn held(&self, arm: usize) -> Option<Held> {
        self.0[arm].held
    }

    /// The object that every arm holds, in the order of the arm numbers.
    pub(super) fn all_held(&self) -> Vec<Option<usize>> {
        self.0.iter().map(|arm| arm.held.map(|held| held.object)).collect()
    }

    /// Sets the object that an arm holds; returns the one that it held before.
    pub(super) fn hold(&mut self, arm: usize, held: Option<Held>) -> Option<Held> {
        std::mem::replace(&mut self.0[arm].held, held)
    }

    /// The held objects of all arms, mutable.
    pub(super) fn held_mut(&mut self) -> impl Iterator<Item = &mut Held> {
        self.0.iter_mut().filter_map(|arm| arm.held.as_mut())
    }

    /// The arm that holds an object, and the grasp.
    pub(super) fn holder_of(&self, object: usize) -> Option<(usize, Held)> {
        let mut held = self.0.iter().enumerate().filter_map(|(number, arm)| Some((number, arm.held?)));
        held.find(|(_, held)| held.object == object)
    }

    /// Whether any held object may still slip.
    pub(super) fn holds_unsteadily(&self) -> bool {
        self.0.iter().any(|arm| arm.held.is_some_and(|held| !held.is_steady()))
    }

    /// The tool poses of all arms in the world frame, for a configuration of the robot as seen from the first arm.
    pub(super) fn tools(&self, configuration: &Configuration) -> Vec<Pose> {
        let poses = self.0[FIRST].view.poses(configuration);
        self.0.iter().map(|arm| poses[arm.view.tool]).collect()
    }

    /// The configuration of the robot seen from an arm.
    pub(super) fn seen_from(&self, arm: usize, configuration: &Configuration) -> Configuration {
        self.0[FIRST].view.seen_from(arm, configuration)
    }

    /// Every arm in its posture `home` (without one, at the robot's default position) with open fingers.
    pub(super) fn first_posture(&self) -> Configuration {
        let robot = &self.0[FIRST].view;
        let mut first = robot.with_all_arms(&robot.at_zero());
        for (number, arm) in self.0.iter().enumerate() {
            first.set_finger(number, arm.open_finger_m);
            if let Some(home) = arm.view.posture(HOME) {
                first.set_joints(number, home);
            }
        }
        first
    }

    /// The same configuration with the fingers of all other arms open.
    pub(super) fn with_others_open(&self, arm: usize, configuration: &Configuration) -> Configuration {
        let mut opened = *configuration;
        for other in self.numbers().filter(|other| *other != arm) {
            opened.set_finger(other, self.0[other].open_finger_m);
        }
        opened
    }

    /// The positions of the arms from number 1 on.
    pub(super) fn others(&self, configuration: &Configuration) -> Vec<ArmPosition> {
        configuration.others.iter().flatten().copied().collect()
    }
}
