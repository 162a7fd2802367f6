//! The passing of time: the environment's steps, the held objects, the battery.

use super::activity::{Activity, Kind};
use super::braking::Way;
use super::cell::Cell;
use super::contacts::{ArmDoing, Doing};
use super::protocol::{Command, Ending, Module};
use ratn_model::time::Timestamp;

impl Cell {
    /// Advances the time to `time`, step by step where something moves. Stops at a step at which a held object is lost, because that ends motions,
    /// and something else may be due before `time`; returns whether it stopped.
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

    /// One step. Returns whether a held object was lost.
    fn step(&mut self, out: &mut Vec<Command>) -> bool {
        let configuration = self.configuration();
        let tools = self.arms.tools(&configuration);
        let mut is_lost = false;
        for arm in self.arms.numbers() {
            let Some(lost) = self.keep_hold(arm, &tools[arm]) else { continue };
            is_lost = true;
            let holds = if self.is_active(Module::Base) { "base" } else { "arm" };
            let reason = format!("{} slipped out of the fingers; the {holds} holds", self.ids[lost]);
            let carries = |a: &Activity| match &a.kind {
                Kind::Follow(Way::Arm(of, _)) => *of == arm,
                Kind::Follow(Way::Base(_)) => true,
                _ => false,
            };
            self.halt(carries, |_| Ending::Aborted(reason.clone()), 1.0, out);
        }
        let finger = |arm: usize| configuration.of_arm(arm).map_or(0.0, |at| at.finger);
        let closes = |arm: usize| {
            let gripper = self.activities.get(&Module::Gripper(arm));
            gripper.is_some_and(|gripper| matches!(gripper.kind, Kind::Close { .. }))
        };
        let solid = self.arms.numbers().map(|arm| !closes(arm) && self.arms.fingers_push(arm, finger(arm)));
        let solid: Vec<bool> = solid.collect();
        solid.iter().enumerate().for_each(|(arm, solid)| self.environment.set_fingers_solid(arm, *solid));
        self.environment.step(&self.robot, &configuration);
        for arm in self.arms.numbers() {
            let parts_from = self.contacts.parts_from(arm);
            if parts_from.is_some_and(|object| !self.fingers_are_at(arm, object, &tools, finger(arm))) {
                self.contacts.parted(arm);
            }
        }
        let drives = self.is_active(Module::Base);
        let doing = self.arms.all_held().into_iter().zip(&solid).enumerate().map(|(arm, (held, solid))| {
            let moves = self.is_active(Module::Arm(arm));
            ArmDoing { held, moves, is_moved: moves || drives, fingers_solid: *solid }
        });
        let arms: Vec<ArmDoing> = doing.collect();
        let doing = Doing { now: self.environment.now(), arms: &arms, drives };
        self.contacts.observe(&self.environment.touches(), doing, &self.environment, &self.ids);
        is_lost
    }

    /// Whether something may move that the environment does not simulate: the robot, or an object that it holds.
    pub(super) fn may_move(&self) -> bool {
        let moves = self.activities.keys().any(|module| *module != Module::Camera);
        let moves = (moves && !self.clock.stands(self.now)) || !self.braking.is_empty();
        moves || self.arms.holds_unsteadily()
    }

    fn drain_until(&mut self, time: Timestamp) {
        let passed = time.since(self.now);
        let stands = self.clock.stands(self.now);
        let moves = |module| self.braking.contains_key(&module) || (self.activities.contains_key(&module) && !stands);
        let moving = self.arms.numbers().any(|arm| moves(Module::Arm(arm)));
        let driving = moves(Module::Base);
        self.battery.drain(passed, moving, driving);
        self.now = self.now.max(time);
        self.motion_time = self.motion_time.max(self.clock.motion_time(self.now));
    }
}
