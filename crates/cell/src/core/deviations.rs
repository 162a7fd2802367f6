//! The effects of faults when they occur.

use super::activity::{Activity, Kind as Doing, seconds};
use super::braking::Way;
use super::cell::Cell;
use super::faults::{Fault, Kind, When};
use super::placement::{self, TABLE};
use super::protocol::{Command, Ending};
use super::tableware;
use crate::config::Setting;
use rand::RngExt;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use std::f64::consts::PI;

/// How long the camera stays blind, or the robot unlocalised, in the robot's seconds.
const OUTAGE_S: f64 = 2.0;
/// Coulomb friction coefficient of wet fingers.
const SLIPPERY: f64 = 0.02;
/// Minimum distance of a moved object from all others, beyond the sum of their radii, in metres: it must be possible to detect and grasp it.
const APART_M: f64 = 0.05;
/// Number of places that are tried.
const MAX_PLACES: usize = 400;

impl Cell {
    /// Applies the faults that are due.
    pub(super) fn deviate(&mut self, out: &mut Vec<Command>) {
        for fault in self.faults.due(self.now) {
            match fault.kind {
                Kind::GraspSlips => {
                    self.arms.held_mut().for_each(|held| held.set_friction(SLIPPERY));
                }
                Kind::ObjectMoved => self.move_something(out),
                Kind::SensorDropout => self.blind_until = self.now + seconds(OUTAGE_S),
                Kind::LocalisationLost => {
                    self.lost_until = self.now + seconds(OUTAGE_S);
                    self.halt(moves_the_base, |_| Ending::Aborted(LOST.to_owned()), 1.0, out);
                }
                Kind::ControllerAbort => self.give_up(out),
            }
        }
    }

    /// Why a picture that was begun at `started` is unusable, if it is.
    pub(super) fn spoilt_picture(&mut self, started: Timestamp, out: &mut Vec<Command>) -> Option<&'static str> {
        if self.faults.occurs(Kind::SensorDropout).is_some() {
            self.blind_until = self.now;
        }
        if self.faults.occurs(Kind::LocalisationLost).is_some() {
            self.lost_until = self.now;
        }
        let within = |until: Timestamp| until > Timestamp::default() && started < until;
        let spoilt = if within(self.blind_until) {
            Some("the camera delivers no image: its connection broke; take another")
        } else if within(self.lost_until) {
            Some("the robot does not know where it stands: no picture can be placed in the world; take another")
        } else {
            None
        };
        if self.faults.occurs(Kind::ObjectMoved).is_some() {
            self.move_something(out);
        }
        spoilt
    }

    /// When a motion of the arm that lasts `lasts_s` breaks off, in seconds, and why, if it does.
    pub(super) fn arm_breaks_off(&mut self, lasts_s: f64) -> Option<(f64, String)> {
        self.faults.occurs(Kind::ControllerAbort).map(|_| (lasts_s / 2.0, GAVE_UP.to_owned()))
    }

    /// The same for a drive.
    pub(super) fn drive_breaks_off(&mut self, lasts_s: f64) -> Option<(f64, String)> {
        let (gave_up, lost) = (self.faults.occurs(Kind::ControllerAbort), self.faults.occurs(Kind::LocalisationLost));
        let reason = if gave_up.is_some() { BASE_GAVE_UP } else { LOST };
        gave_up.or(lost).map(|_| (lasts_s / 2.0, reason.to_owned()))
    }

    /// Whether the robot does not know where it stands.
    pub(super) fn is_lost(&self) -> bool {
        self.lost_until > self.now
    }

    /// The controller of the current motion gives up now; if nothing moves, the controller of the next motion.
    fn give_up(&mut self, out: &mut Vec<Command>) {
        let moves_the_arm = |a: &Activity| matches!(a.kind, Doing::Follow(Way::Arm(..)));
        if self.activities.values().any(|a| moves_the_arm(a) || moves_the_base(a)) {
            let why = |a: &Activity| if moves_the_base(a) { BASE_GAVE_UP } else { GAVE_UP };
            self.halt(|a| moves_the_arm(a) || moves_the_base(a), |a| Ending::Aborted(why(a).to_owned()), 1.0, out);
        } else {
            // There is room: a fault was just taken out.
            self.faults.add(Fault { kind: Kind::ControllerAbort, when: When::Nth(1) });
        }
    }

    /// Moves an object that is still to be fetched to another place on the same support, away from all others.
    fn move_something(&mut self, out: &mut Vec<Command>) {
        let (support, height, regions) = match self.config.scene {
            Setting::Boxes => {
                let workplace = placement::workplace(&self.robot);
                let regions: Vec<_> = workplace.shares().map(|(boxes, _)| [boxes.x, boxes.y]).collect();
                (TABLE, workplace.table.top_m(), regions)
            }
            Setting::Table => {
                let Some(tableware) = &placement::workplace(&self.robot).tableware else { return };
                (tableware::RACK, tableware::top_m(&tableware.rack), vec![[tableware.region.x, tableware.region.y]])
            }
        };
        let movable: Vec<usize> = (0..self.ids.len())
            .filter(|i| {
                let on = self.support_of(*i);
                let held = self.arms.holder_of(*i).is_some();
                on == support && !held && !self.is_delivered(&self.environment.state(*i).pose, &on)
            })
            .collect();
        if movable.is_empty() {
            return;
        }
        let object = movable[self.faults.random().random_range(0..movable.len())];
        // The boxes are divided evenly among the arms, the first arm's first: a box stays where its own arm fetches it.
        let [[x_low, x_high], [y_low, y_high]] = regions[object * regions.len() / self.ids.len()];
        let radius = |i: usize| self.size_of(i)[0].hypot(self.size_of(i)[1]) / 2.0;
        let others: Vec<([f64; 3], f64)> = (0..self.ids.len())
            .filter(|i| *i != object)
            .map(|i| (self.environment.state(i).pose.position, radius(i)))
            .collect();
        let (mine, height) = (radius(object), height + self.size_of(object)[2] / 2.0);
        let tools: Vec<[f64; 3]> = self.arms.tools(&self.configuration()).iter().map(|tool| tool.position).collect();
        let random = self.faults.random();
        let place = (0..MAX_PLACES).find_map(|_| {
            let (x, y) = (random.random_range(x_low..=x_high), random.random_range(y_low..=y_high));
            let yaw = random.random_range(-PI..PI);
            let apart = |at: &[f64; 3], radius: f64| (at[0] - x).hypot(at[1] - y) > mine + radius + APART_M;
            let free =
                others.iter().all(|(at, radius)| apart(at, *radius)) && tools.iter().all(|tool| apart(tool, 0.0));
            free.then(|| Pose::from_rpy([x, y, height], 0.0, 0.0, yaw))
        });
        if let Some(pose) = place {
            let from = self.environment.state(object).pose;
            let ([x, y, _], by_mm) = (pose.position, 1e3 * pose.distance(&from));
            let (id, at_s) = (&self.ids[object], self.now.seconds());
            let what = format!("at {at_s:.2} s somebody moves {id} by {by_mm:.0} mm, to ({x:.3}, {y:.3})");
            out.push(Command::Noted { what });
            self.contacts.put(object);
            self.environment.put(object, &pose);
        }
    }
}

fn moves_the_base(activity: &Activity) -> bool {
    matches!(activity.kind, Doing::Follow(Way::Base(_)))
}

/// Why a motion ended.
const GAVE_UP: &str = "the arm's controller gave up: its tracking error was too great; it holds";
const BASE_GAVE_UP: &str = "the base's controller gave up: its tracking error was too great; it holds";
/// Why the base does not drive.
pub(super) const LOST: &str = "the robot does not know where it stands; it holds; localise it before it drives on";
