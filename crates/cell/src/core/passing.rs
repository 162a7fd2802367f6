//! Time that passes: the environment's steps, what is held, the battery.

use super::activity::{Activity, Kind};
use super::cell::Cell;
use super::contacts::Doing;
use super::protocol::{Command, Ending, Module};
use ratn_model::time::Timestamp;

/// How far the fingers may be from fully open and still count as open, in metres.
const OPEN_M: f64 = 1e-4;

impl Cell {
    /// Time goes on to `time`, step by step where something moves; to the step at which what is held was lost, where that comes first:
    /// then something else may be due before `time`. Whether it did.
    pub(super) fn pass_until(&mut self, time: Timestamp, out: &mut Vec<Command>) -> bool {
        while self.environment.next_step() <= time {
            if self.environment.is_at_rest() && !self.may_move() {
                self.environment.skip_until(time);
                break;
            }
            self.drain_until(self.environment.next_step());
            if self.step(out) {
                return true;
            }
        }
        self.drain_until(time);
        false
    }

    /// Whether what was held was lost.
    fn step(&mut self, out: &mut Vec<Command>) -> bool {
        let configuration = self.configuration();
        let tool = self.robot.tool_pose(&configuration);
        let lost = self.keep_hold(&tool);
        if let Some(lost) = lost {
            let holds = if self.is_active(Module::Base) { "base" } else { "arm" };
            let reason = format!("{} slipped out of the fingers; the {holds} holds", self.ids[lost]);
            let moves = |a: &Activity| matches!(a.kind, Kind::Follow(_));
            self.halt(moves, |_| Ending::Aborted(reason.clone()), 1.0, out);
        }
        let open = self.open_finger_m() - configuration.finger < OPEN_M;
        // Closed around something, they stand at its faces.
        let solid = open || self.held.is_some();
        self.environment.set_fingers_solid(solid);
        self.environment.step(&self.robot, &configuration);
        if self.contacts.parts_from().is_some_and(|object| !self.fingers_are_at(object, &tool, configuration.finger)) {
            self.contacts.parted();
        }
        let doing = Doing {
            now: self.environment.now(),
            held: self.held.map(|held| held.object),
            moves: self.is_active(Module::Arm) || self.is_active(Module::Base),
            arm_of: self.is_active(Module::Arm).then_some(&self.robot),
            fingers_solid: solid,
        };
        self.contacts.observe(&self.environment.touches(), doing, &self.environment, &self.ids);
        lost.is_some()
    }

    /// Whether something may move that the environment does not know of: the robot, or what it holds.
    pub(super) fn may_move(&self) -> bool {
        let modules = [Module::Base, Module::Arm, Module::Gripper, Module::PanTilt];
        let moves = modules.into_iter().any(|module| self.activities.contains_key(&module));
        let moves = (moves && !self.clock.stands(self.now)) || !self.braking.is_empty();
        moves || self.held.is_some_and(|held| !held.is_steady())
    }

    fn drain_until(&mut self, time: Timestamp) {
        let passed = time.since(self.now);
        let stands = self.clock.stands(self.now);
        let moves = |module| self.braking.contains_key(&module) || (self.activities.contains_key(&module) && !stands);
        let (moving, driving) = (moves(Module::Arm), moves(Module::Base));
        self.battery.drain(passed, moving, driving);
        self.now = self.now.max(time);
        self.motion_time = self.motion_time.max(self.clock.motion_time(self.now));
    }
}
