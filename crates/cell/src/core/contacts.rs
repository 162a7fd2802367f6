//! Decides which contacts were intended: the environment reports touching bodies, and they are judged by what the robot was doing.
//!
//! ```text
//!                    ┌─ a finger at the object that it grasps next or has just released (Approach, Depart), or that it holds (Grasp)
//! two bodies touch ──┼─ a held object above its support when the motion began (LiftOff), or where it is set down (SetDown)
//!                    ├─ an object on a link that does not move, or moves along with it (Stands); an object that a fault put there (PutThere)
//!                    └─ every other contact is unintended
//! ```
//! An episode begins when two bodies touch and ends when they have separated. Some episodes are judged later: a finger may brush the object that it
//! grasps next, but an object that it brushed and did not close around was hit; and an object is set down on the body that it finally stands on. An
//! intended contact has a bound as well: one deeper than [`PRESS_M`] is unintended, and what is dragged further than that was neither lifted nor set
//! down.

use super::environment::{Environment, Thing, Touch};
use ratn_model::time::Timestamp;
use ratn_motion::robot::Robot;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Contacts up to this depth are ignored, in metres: the engine itself lets bodies overlap by half of it, and pushes a resting body by as much before
/// it is still. Nothing is added for controllers that lag: contacts are judged by the true joint positions.
pub const TOLERANCE_M: f64 = 0.001;
/// Maximum depth to which a held object may be pressed into the body that it is lifted from or set down on, and maximum distance by which a finger
/// may push an object that it grasps or releases, in metres: poses are measured with an error of millimetres.
pub const PRESS_M: f64 = 0.015;
/// An object moves along with a link if its speed relative to it is no more than this, in metres per second.
const ALONG_M_S: f64 = 0.05;
/// A support is level if its normal has at least this upward component.
const LEVEL: f64 = 0.7;
/// Maximum number of stored contacts: the first ones.
pub const MAX_CONTACTS: usize = 64;

/// An episode of two bodies in contact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// When the episode began, in the robot's time.
    pub began: Timestamp,
    /// When the episode ended; if it continues, when it was last seen.
    pub ended: Timestamp,
    /// The two bodies: names of links, of furniture, of objects.
    pub bodies: [String; 2],
    /// Maximum depth of the overlap, in metres.
    pub depth_m: f64,
    /// How far an object that is not held was pushed from its place, in metres.
    pub pushed_m: f64,
    /// Point of the deepest overlap, in the world frame.
    pub at: [f64; 3],
    /// Maximum speed of the bodies relative to each other, in metres per second.
    pub speed_m_s: f64,
    /// The purpose of the contact; `None` if it is unintended.
    pub meant: Option<Purpose>,
}

/// Why two bodies may be in contact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// A finger reaches the object that it closes around next.
    Approach,
    /// A finger at the object that it holds, or tried to hold.
    Grasp,
    /// A finger leaves the object that it released.
    Depart,
    /// A held object leaves the body below it, on which it stood.
    LiftOff,
    /// A released object comes to stand on this body. Another object counts as the support only if no furniture and no link supports it.
    SetDown,
    /// An object stands on a link that does not move, or that moves along with it.
    Stands,
    /// A fault put the object there.
    PutThere,
}

/// An episode that is not over.
#[derive(Debug, Clone)]
struct Episode {
    contact: Contact,
    /// The object that is not held, and its position when the episode began, or when it first overlapped with furniture.
    from: Option<(usize, [f64; 3])>,
    dragged: Dragged,
    /// The upward component of the normal at the deepest point.
    up: f64,
}

/// How far a held object is dragged over something, horizontally, while it is deeper in that than [`TOLERANCE_M`].
#[derive(Debug, Clone, Copy, Default)]
struct Dragged {
    from: Option<[f64; 3]>,
    by_m: f64,
}

/// Watches a cell's contacts.
#[derive(Debug, Clone, Default)]
pub(super) struct Contacts {
    fingers: Fingers,
    open: BTreeMap<[Thing; 2], Episode>,
    /// Ended contacts of fingers with objects whose purpose is not known yet.
    waiting: Vec<(AtObject, Contact)>,
    /// The grippers, by the numbers of their arms.
    hands: Vec<Hand>,
    /// The names of the links that each arm moves, by the numbers of the arms.
    arm_links: Vec<Vec<String>>,
    /// Objects that were released above something and have not come to rest.
    settling: Vec<(usize, Thing, Contact)>,
    /// The object that a fault moved since the last step.
    put: Option<usize>,
    judged: Vec<Contact>,
    /// The judged contacts that have not been reported.
    fresh: Vec<Contact>,
}

/// The names of the links that are fingers, by arm number.
#[derive(Debug, Clone, Default)]
struct Fingers(Vec<Vec<String>>);

/// A finger of an arm that touches an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct AtObject {
    arm: usize,
    object: usize,
}

/// The state of a gripper, for judging its contacts.
#[derive(Debug, Clone, Copy, Default)]
struct Hand {
    /// The object that its fingers have released, or failed to grasp, until they are away from it.
    parting: Option<Parting>,
    /// It has just closed its fingers.
    grasped: bool,
}

/// The object that fingers leave.
#[derive(Debug, Clone, Copy)]
struct Parting {
    object: usize,
    /// A motion has begun since: the fingers are no longer where they released it.
    set_out: bool,
}

/// What the robot is doing in a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Doing<'a> {
    pub(super) now: Timestamp,
    /// What each arm is doing, by arm number.
    pub(super) arms: &'a [ArmDoing],
    /// The base moves.
    pub(super) drives: bool,
}

/// What an arm and its gripper are doing in a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct ArmDoing {
    /// The object that its fingers hold.
    pub(super) held: Option<usize>,
    /// The arm itself moves.
    pub(super) moves: bool,
    /// The arm moves, or the base that carries it.
    pub(super) is_moved: bool,
    /// The fingers push the objects that they touch; closing fingers do not.
    pub(super) fingers_solid: bool,
}

impl Doing<'_> {
    /// The arm that holds an object.
    fn holder_of(&self, object: usize) -> Option<usize> {
        self.arms.iter().position(|arm| arm.held == Some(object))
    }
}

impl Purpose {
    /// The name of the purpose in texts.
    pub fn name(self) -> &'static str {
        match self {
            Purpose::Approach => "approach",
            Purpose::Grasp => "grasp",
            Purpose::Depart => "depart",
            Purpose::LiftOff => "lift_off",
            Purpose::SetDown => "set_down",
            Purpose::Stands => "stands",
            Purpose::PutThere => "put_there",
        }
    }
}

impl Contact {
    /// Whether the contact counts: it was unintended, or too deep, by more than a tolerance.
    pub fn is_unintended(&self) -> bool {
        let most = match self.meant {
            None => TOLERANCE_M,
            Some(Purpose::Grasp | Purpose::Stands | Purpose::PutThere) => f64::INFINITY,
            Some(_) => PRESS_M,
        };
        self.depth_m.max(self.pushed_m) > most
    }
}

impl std::fmt::Display for Contact {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Contact { began, bodies: [a, b], depth_m, pushed_m, at: [x, y, z], speed_m_s, meant, .. } = self;
        write!(f, "at {:.2} s {a} touches {b}, {:.1} mm deep", began.seconds(), depth_m * 1e3)?;
        if *pushed_m > 0.0 {
            write!(f, " and pushes it by {:.1} mm", pushed_m * 1e3)?;
        }
        write!(f, ", at ({x:.3}, {y:.3}, {z:.3}) with {speed_m_s:.2} m/s")?;
        if let Some(purpose) = meant { write!(f, " ({})", purpose.name()) } else { Ok(()) }
    }
}

impl Fingers {
    /// The arm and object of this contact, if it is between a finger and an object.
    fn at(&self, things: &[Thing; 2]) -> Option<AtObject> {
        let [Thing::Link(link), Thing::Object(object)] = things else { return None };
        let arm = self.0.iter().position(|of_arm| of_arm.contains(link))?;
        Some(AtObject { arm, object: *object })
    }
}

impl Contacts {
    /// Contacts of this robot; nothing has touched yet.
    pub(super) fn of(robot: &Robot) -> Contacts {
        let arms = 0..robot.arm_names().count();
        let names = |links: Vec<usize>| links.into_iter().map(|link| robot.model.links[link].name.clone()).collect();
        Contacts {
            fingers: Fingers(arms.clone().map(|arm| names(robot.finger_links_of(arm))).collect()),
            arm_links: arms.clone().map(|arm| names(robot.links_of(arm))).collect(),
            hands: vec![Hand::default(); arms.len()],
            ..Contacts::default()
        }
    }

    /// Records which bodies touch after a step.
    pub(super) fn observe(&mut self, touches: &[Touch], doing: Doing<'_>, environment: &Environment, ids: &[String]) {
        let fingers = self.fingers.clone();
        // Fingers that have opened after a failed grasp push the object that they are in from now on.
        let in_vain = |things: &[Thing; 2], e: &Episode| {
            let opened = |at: AtObject| doing.arms[at.arm].fingers_solid && doing.arms[at.arm].held != Some(at.object);
            e.contact.meant == Some(Purpose::Grasp) && fingers.at(things).is_some_and(opened)
        };
        self.end(in_vain);
        for touch in touches {
            self.see(touch, doing, environment, ids);
        }
        for (things, episode) in self.take(|things, _| touches.iter().all(|touch| touch.things != *things)) {
            match fingers.at(&things) {
                Some(at)
                    if episode.contact.meant.is_none()
                        && (doing.arms[at.arm].is_moved || !doing.arms[at.arm].fingers_solid) =>
                {
                    self.waiting.push((at, episode.contact));
                }
                _ => self.judge(episode.contact),
            }
        }
        self.settle(|object| environment.state(object).at_rest, environment);
        self.put = None;
        self.hands.iter_mut().for_each(|hand| hand.grasped = false);
    }

    /// The fingers of an arm begin to close: the objects that they already touch may be the ones that they came to grasp.
    pub(super) fn closing(&mut self, arm: usize) {
        let fingers = self.fingers.clone();
        let of_arm = |things: &[Thing; 2]| fingers.at(things).is_some_and(|at| at.arm == arm);
        let came = self.take(|things, episode| of_arm(things) && episode.contact.meant.is_none());
        self.waiting.extend(came.into_iter().filter_map(|(things, e)| Some((fingers.at(&things)?, e.contact))));
    }

    /// The fingers of an arm have closed around an object, whether they hold it or not; `None` if around nothing.
    pub(super) fn closed(&mut self, arm: usize, around: Option<usize>, environment: &Environment) {
        self.settle(|object| Some(object) == around, environment);
        let Contacts { fingers, open, .. } = self;
        let closed = around.map(|object| AtObject { arm, object });
        for (things, episode) in open {
            if closed.is_some() && fingers.at(things) == closed {
                episode.contact.meant = Some(Purpose::Grasp);
            }
        }
        for (at, contact) in self.waiting_of(arm) {
            let meant = (Some(at) == closed).then_some(Purpose::Approach);
            self.judge(Contact { meant, ..contact });
        }
        self.hands[arm] = Hand { parting: around.map(|object| Parting { object, set_out: false }), grasped: true };
    }

    /// The fingers of an arm have released an object, on purpose or not.
    pub(super) fn let_go(&mut self, arm: usize, object: usize, on_purpose: bool) {
        let of_object = |things: &[Thing; 2], _: &Episode| things[1] == Thing::Object(object);
        for ([below, _], Episode { mut contact, up, dragged, .. }) in self.take(of_object) {
            // The normal points from the support to the held object.
            if contact.meant.is_none() && on_purpose && up >= LEVEL && dragged.by_m <= PRESS_M {
                contact.meant = Some(Purpose::SetDown);
                self.settling.push((object, below, contact));
            } else {
                self.judge(contact);
            }
        }
        self.hands[arm].parting = Some(Parting { object, set_out: false });
    }

    /// An arm, or the base that carries it, begins to move, with or without an object in the arm's fingers. A failed grasp is over then: contacts of
    /// the fingers with that object are new contacts from now on.
    pub(super) fn sets_out(&mut self, arm: usize, held: Option<usize>) {
        for (_, contact) in self.waiting_of(arm) {
            self.judge(contact);
        }
        let fingers = self.fingers.clone();
        let in_vain = |things: &[Thing; 2], episode: &Episode| {
            let not_held = |at: AtObject| at.arm == arm && Some(at.object) != held;
            episode.contact.meant == Some(Purpose::Grasp) && fingers.at(things).is_some_and(not_held)
        };
        self.end(in_vain);
        if let Some(parting) = &mut self.hands[arm].parting {
            parting.set_out = true;
        }
    }

    /// The object that the fingers of an arm leave in the current motion.
    pub(super) fn parts_from(&self, arm: usize) -> Option<usize> {
        self.hands[arm].parting.filter(|parting| parting.set_out).map(|parting| parting.object)
    }

    /// An arm has reached the end of a motion, or its fingers are away from the object that they leave.
    pub(super) fn parted(&mut self, arm: usize) {
        self.hands[arm].parting = None;
    }

    /// An object is moved by a fault.
    pub(super) fn put(&mut self, object: usize) {
        self.put = Some(object);
        for (_, episode) in self.take(|things, _| things.contains(&Thing::Object(object))) {
            self.judge(episode.contact);
        }
    }

    /// The unintended contacts: those that are over, and those that continue or are not judged yet, by their current state.
    pub(super) fn unintended(&self) -> Vec<Contact> {
        let open = self.open.values().map(|episode| &episode.contact);
        let undecided = open.chain(self.waiting.iter().map(|(_, contact)| contact));
        let undecided = undecided.chain(self.settling.iter().map(|(_, _, contact)| contact));
        self.judged.iter().chain(undecided.filter(|contact| contact.is_unintended())).cloned().collect()
    }

    /// Takes the unintended contacts that are over and have not been reported yet.
    pub(super) fn tell(&mut self) -> Vec<Contact> {
        std::mem::take(&mut self.fresh)
    }

    fn see(&mut self, touch: &Touch, doing: Doing<'_>, environment: &Environment, ids: &[String]) {
        if !self.open.contains_key(&touch.things) {
            let loose = touch.things.iter().find_map(|thing| match thing {
                Thing::Object(object) if doing.holder_of(*object).is_none() => Some(*object),
                _ => None,
            });
            let contact = Contact {
                began: doing.now,
                ended: doing.now,
                bodies: touch.things.clone().map(|thing| match thing {
                    Thing::Link(name) | Thing::Fixed(name) => name,
                    Thing::Object(object) => ids[object].clone(),
                }),
                depth_m: 0.0,
                pushed_m: 0.0,
                at: touch.at,
                speed_m_s: 0.0,
                meant: self.known(touch, doing),
            };
            let from = loose.filter(|_| !is_fixed(touch)).map(|object| (object, position(environment, object)));
            let dragged = Dragged::default();
            self.open.insert(touch.things.clone(), Episode { contact, from, dragged, up: 0.0 });
        }
        let Some(Episode { contact, from, dragged, up }) = self.open.get_mut(&touch.things) else { return };
        if contact.meant == Some(Purpose::Stands) && is_moved(&self.arm_links, touch, doing) {
            // The link leaves with the object on it: from now on the link pushes.
            contact.meant = None;
            *from = from.map(|(object, _)| (object, position(environment, object)));
            (contact.began, contact.depth_m, contact.pushed_m) = (doing.now, 0.0, 0.0);
        }
        if contact.meant == Some(Purpose::LiftOff) && is_pushed(&self.arm_links, touch, doing) {
            contact.meant = None;
            (contact.began, contact.depth_m, contact.pushed_m) = (doing.now, 0.0, 0.0);
        }
        if let Thing::Object(object) = touch.things[1] {
            if doing.holder_of(object).is_some() {
                dragged.see(touch, environment, object);
            } else if is_fixed(touch) && from.is_none() && touch.depth_m > 0.0 {
                // Aboard: the base drives it past furniture or against it.
                *from = Some((object, position(environment, object)));
            }
        }
        if contact.meant == Some(Purpose::LiftOff) && dragged.by_m > PRESS_M {
            contact.meant = None;
            (contact.began, contact.depth_m, contact.pushed_m) = (doing.now, 0.0, 0.0);
        }
        contact.ended = doing.now;
        contact.speed_m_s = contact.speed_m_s.max(touch.speed_m_s);
        if touch.depth_m > contact.depth_m {
            (contact.depth_m, contact.at, *up) = (touch.depth_m, touch.at, touch.normal[2]);
            if contact.meant == Some(Purpose::LiftOff) && *up < LEVEL {
                contact.meant = None;
            }
        }
        if let Some((object, from)) = from
            && doing.holder_of(*object).is_none()
            && (touch.depth_m > 0.0 || !is_fixed(touch))
        {
            let at = position(environment, *object);
            let pushed = (0..3).map(|i| (at[i] - from[i]).powi(2)).sum::<f64>().sqrt();
            contact.pushed_m = contact.pushed_m.max(pushed);
        }
    }

    /// The purpose of a contact, if it is known at the beginning.
    fn known(&self, touch: &Touch, doing: Doing<'_>) -> Option<Purpose> {
        let just_held = |arm: usize| self.hands[arm].grasped || !doing.arms[arm].is_moved;
        let lifts = |object: usize| {
            let is_lifted = doing.holder_of(object).is_some_and(just_held) && touch.normal[2] >= LEVEL;
            (is_lifted && !is_pushed(&self.arm_links, touch, doing)).then_some(Purpose::LiftOff)
        };
        match &touch.things {
            things if things.iter().any(|thing| self.put.map(Thing::Object).as_ref() == Some(thing)) => {
                Some(Purpose::PutThere)
            }
            [Thing::Link(_), Thing::Object(object)] if self.fingers.at(&touch.things).is_some() => {
                let AtObject { arm, .. } = self.fingers.at(&touch.things)?;
                if doing.arms[arm].held == Some(*object) {
                    return Some(Purpose::Grasp);
                }
                let parting = self.hands[arm].parting.filter(|parting| parting.object == *object)?;
                let leaves = doing.arms[arm].fingers_solid || parting.set_out;
                Some(if leaves { Purpose::Depart } else { Purpose::Grasp })
            }
            [Thing::Link(_), Thing::Object(object)] if doing.holder_of(*object).is_none() => {
                let is_moved = is_moved(&self.arm_links, touch, doing);
                let goes_along = !doing.drives || touch.speed_m_s <= ALONG_M_S;
                (touch.normal[2] >= LEVEL && !is_moved && goes_along).then_some(Purpose::Stands)
            }
            [_, Thing::Object(object)] => lifts(*object),
            _ => None,
        }
    }

    /// Judges the contacts of released objects that have come to rest, or are about to be held again.
    fn settle(&mut self, settles: impl Fn(usize) -> bool, environment: &Environment) {
        let (settled, rest) = std::mem::take(&mut self.settling).into_iter().partition(|(object, ..)| settles(*object));
        self.settling = rest;
        let settled: Vec<(usize, Thing, Contact)> = settled;
        for (object, below, mut contact) in settled {
            let bears = environment.supports_of(object);
            let of_objects = bears.iter().all(|thing| matches!(thing, Thing::Object(_)));
            let stands = bears.contains(&below) && (of_objects || !matches!(below, Thing::Object(_)));
            contact.meant = stands.then_some(Purpose::SetDown);
            self.judge(contact);
        }
    }

    /// Takes out the contacts of an arm's fingers whose purpose is not known yet.
    fn waiting_of(&mut self, arm: usize) -> Vec<(AtObject, Contact)> {
        let (of_arm, rest) = std::mem::take(&mut self.waiting).into_iter().partition(|(at, _)| at.arm == arm);
        self.waiting = rest;
        of_arm
    }

    /// Ends these episodes.
    fn end(&mut self, which: impl Fn(&[Thing; 2], &Episode) -> bool) {
        for (_, episode) in self.take(which) {
            self.judge(episode.contact);
        }
    }

    /// Takes these episodes out of the open ones.
    fn take(&mut self, which: impl Fn(&[Thing; 2], &Episode) -> bool) -> Vec<([Thing; 2], Episode)> {
        let (taken, open) = std::mem::take(&mut self.open).into_iter().partition(|(things, e)| which(things, e));
        self.open = open;
        let taken: BTreeMap<[Thing; 2], Episode> = taken;
        taken.into_iter().collect()
    }

    fn judge(&mut self, contact: Contact) {
        if contact.is_unintended() && self.judged.len() < MAX_CONTACTS {
            self.fresh.push(contact.clone());
            self.judged.push(contact);
        }
    }
}

impl Dragged {
    /// A held object touches something: a link, which moves with the base, or something else.
    fn see(&mut self, touch: &Touch, environment: &Environment, object: usize) {
        if touch.depth_m <= TOLERANCE_M {
            return;
        }
        let at = match touch.things[0] {
            Thing::Link(_) => environment.position_on_base(object),
            _ => position(environment, object),
        };
        let from = *self.from.get_or_insert(at);
        self.by_m = self.by_m.max((at[0] - from[0]).hypot(at[1] - from[1]));
    }
}

fn position(environment: &Environment, object: usize) -> [f64; 3] {
    environment.state(object).pose.position
}

fn is_fixed(touch: &Touch) -> bool {
    matches!(touch.things[0], Thing::Fixed(_))
}

/// Whether the touching body is a link of an arm that moves.
fn is_moved(arm_links: &[Vec<String>], touch: &Touch, doing: Doing<'_>) -> bool {
    let Thing::Link(link) = &touch.things[0] else { return false };
    moving_arm_of(arm_links, link, doing).is_some()
}

/// Whether another arm moves or carries the body that touches a held object: then the object is not lifted from that body.
fn is_pushed(arm_links: &[Vec<String>], touch: &Touch, doing: Doing<'_>) -> bool {
    let [other, Thing::Object(object)] = &touch.things else { return false };
    let arm = match other {
        Thing::Link(link) => moving_arm_of(arm_links, link, doing),
        Thing::Object(below) => doing.holder_of(*below).filter(|arm| doing.arms[*arm].moves),
        Thing::Fixed(_) => None,
    };
    arm.is_some() && doing.holder_of(*object).is_some_and(|holder| arm != Some(holder))
}

/// The moving arm that moves a link.
fn moving_arm_of(arm_links: &[Vec<String>], link: &String, doing: Doing<'_>) -> Option<usize> {
    doing.arms.iter().zip(arm_links).position(|(arm, links)| arm.moves && links.contains(link))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::environment::{Kind, Model};
    use super::*;
    use ratn_model::pose::Pose;
    use ratn_motion::robot::Configuration;

    #[test]
    fn what_a_finger_hit_in_the_last_motion_is_told_though_nothing_follows_it() {
        let hit = Contact {
            began: Timestamp::default(),
            ended: Timestamp::default(),
            bodies: ["finger_left".to_owned(), "cup_1".to_owned()],
            depth_m: 0.0,
            pushed_m: 0.02,
            at: [0.0; 3],
            speed_m_s: 0.1,
            meant: None,
        };
        let waiting = vec![(AtObject { arm: 0, object: 0 }, hit.clone())];
        let mut contacts = Contacts { waiting, ..Contacts::of(&Robot::aimm()) };
        assert_eq!(contacts.unintended(), [hit]);
        // The fingers came to grasp it.
        contacts.closed(0, Some(0), &Watched::new().environment);
        assert_eq!(contacts.unintended().len(), 1, "it was pushed too far for that");
    }

    /// A box in free space, and the contacts that are observed.
    struct Watched {
        environment: Environment,
        contacts: Contacts,
    }

    impl Watched {
        fn new() -> Watched {
            let robot = Robot::aimm();
            let model = Model { kind: Kind::Box, size: [0.1, 0.1, 0.1] };
            let stands = Configuration { finger: 0.055, ..robot.at_zero() };
            let environment = Environment::new(&robot, &stands, &[], &[(model, Pose::at(2.0, 0.0, 0.5))]);
            let contacts = Contacts::of(&robot);
            Watched { environment, contacts }
        }

        /// One step in which the box is `x` metres from its first place and overlaps with a link by this depth, or with none.
        fn step(&mut self, x: f64, link: Option<(&str, f64)>, arm_moves: bool, fingers_solid: bool) {
            self.step_beside(x, link.map(|link| (link, 0.1)), false, arm_moves, fingers_solid);
        }

        /// The same while the base drives or does not; the link is this fast.
        fn step_beside(
            &mut self,
            x: f64,
            link: Option<((&str, f64), f64)>,
            drives: bool,
            arm_moves: bool,
            fingers_solid: bool,
        ) {
            self.environment.put(0, &Pose::at(2.0 + x, 0.0, 0.5));
            let touch = |((link, depth_m), speed_m_s): ((&str, f64), f64)| Touch {
                things: [Thing::Link(link.to_owned()), Thing::Object(0)],
                depth_m,
                at: [2.0, 0.0, 0.45],
                normal: [0.0, 0.0, 1.0],
                speed_m_s,
            };
            let touches: Vec<Touch> = link.map(touch).into_iter().collect();
            let arms = [ArmDoing { held: None, moves: arm_moves, is_moved: arm_moves, fingers_solid }];
            let doing = Doing { now: Timestamp::default(), arms: &arms, drives };
            self.contacts.observe(&touches, doing, &self.environment, &["box_1".to_owned()]);
        }

        fn pushed_mm(&self) -> Vec<f64> {
            self.contacts.unintended().iter().map(|contact| (contact.pushed_m * 1e3).round()).collect()
        }
    }

    #[test]
    fn a_finger_is_a_link_that_the_gripper_moves_whatever_it_is_called() {
        let description = |file: &str| std::fs::read_to_string(format!("../motion/robots/aimm.{file}")).unwrap();
        let [toml, urdf, srdf] = ["toml", "urdf", "srdf"].map(|file| {
            description(file)
                .replace("finger_left", "jaw_a")
                .replace("finger_right", "jaw_b")
                .replace("\"arm_4\"", "\"finger_like\"")
        });
        let read = ratn_motion::description::RobotDescription::read(&toml).unwrap();
        let robot = Robot::of(read, &urdf, Some(&srdf), &mut |_| unreachable!("it has no meshes")).unwrap();
        let fingers = Contacts::of(&robot).fingers;
        let at = |link: &str| fingers.at(&[Thing::Link(link.to_owned()), Thing::Object(3)]);
        let finger = Some(AtObject { arm: 0, object: 3 });
        assert_eq!((at("jaw_a"), at("jaw_b"), at("finger_like")), (finger, finger, None));
    }

    #[test]
    fn what_stands_on_a_link_of_the_arm_is_pushed_by_it_as_soon_as_the_arm_moves() {
        let mut watched = Watched::new();
        // The box came down on a standing link, and slid on it.
        watched.step(0.0, Some(("arm_4", 0.0004)), false, true);
        watched.step(0.03, Some(("arm_4", 0.0004)), false, true);
        assert_eq!(watched.pushed_mm(), [0.0; 0]);
        watched.step(0.03, Some(("arm_4", 0.0004)), true, true);
        watched.step(0.05, Some(("arm_4", 0.0004)), true, true);
        assert_eq!(watched.pushed_mm(), [20.0]);
    }

    #[test]
    fn a_link_that_comes_from_below_is_no_place_to_stand_but_the_deck_is() {
        for (link, expected) in [("arm_4", &[20.0][..]), ("base", &[])] {
            let mut watched = Watched::new();
            watched.step(0.0, Some((link, 0.0004)), true, true);
            watched.step(0.02, Some((link, 0.0004)), true, true);
            watched.step(0.02, None, true, true);
            assert_eq!(watched.pushed_mm(), expected, "{link}");
        }
    }

    #[test]
    fn what_a_base_drives_under_is_pushed_by_it_and_what_moves_along_with_it_stands_on_it() {
        for (speed_m_s, expected) in [(0.3, &[20.0][..]), (0.01, &[])] {
            let mut watched = Watched::new();
            for x in [0.0, 0.02] {
                watched.step_beside(x, Some((("base", 0.0004), speed_m_s)), true, false, true);
            }
            assert_eq!(watched.pushed_mm(), expected, "{speed_m_s} m/s");
        }
    }

    #[test]
    fn what_is_held_is_lifted_or_set_down_where_it_is_not_dragged() {
        // The box is deep in the table, and then moves aside; it was there when it was grasped, or came from above.
        for (lifts, aside_m, is_told) in
            [(true, 0.01, false), (true, 0.2, true), (false, 0.01, false), (false, 0.2, true)]
        {
            let mut watched = Watched::new();
            let mut step = |x: f64, is_moved: bool| {
                watched.environment.put(0, &Pose::at(2.0 + x, 0.0, 0.5));
                let touch = Touch {
                    things: [Thing::Fixed("table".to_owned()), Thing::Object(0)],
                    depth_m: 0.005,
                    at: [2.0, 0.0, 0.45],
                    normal: [0.0, 0.0, 1.0],
                    speed_m_s: 0.1,
                };
                let arms = [ArmDoing { held: Some(0), moves: is_moved, is_moved, fingers_solid: true }];
                let doing = Doing { now: Timestamp::default(), arms: &arms, drives: false };
                watched.contacts.observe(&[touch], doing, &watched.environment, &["box_1".to_owned()]);
            };
            step(0.0, !lifts);
            (1..=10).for_each(|i| step(aside_m * f64::from(i) / 10.0, true));
            if !lifts {
                watched.contacts.let_go(0, 0, true);
            }
            let found = watched.contacts.unintended();
            assert_eq!(!found.is_empty(), is_told, "{lifts} {aside_m}: {found:?}");
        }
    }

    #[test]
    fn a_grasp_in_vain_excuses_the_fingers_until_the_next_motion_sets_out() {
        for (moves, excused) in [(false, true), (true, false)] {
            let mut watched = Watched::new();
            watched.contacts.closing(0);
            watched.step(0.0, Some(("finger_left", 0.03)), false, false);
            watched.contacts.closed(0, Some(0), &watched.environment);
            if moves {
                watched.contacts.sets_out(0, None);
            }
            watched.step(0.0, Some(("finger_left", 0.03)), moves, false);
            watched.step(0.0, None, moves, false);
            watched.contacts.sets_out(0, None);
            assert_eq!(watched.contacts.unintended().is_empty(), excused, "{:?}", watched.contacts.unintended());
        }
    }

    /// Presses a box while it is grasped, along a normal that points out of the table.
    fn grasped_along(normal: [f64; 3]) -> Vec<Contact> {
        let mut watched = Watched::new();
        let touch = |depth_m: f64| Touch {
            things: [Thing::Fixed("table".to_owned()), Thing::Object(0)],
            depth_m,
            at: [2.0, 0.0, 0.45],
            normal,
            speed_m_s: 0.1,
        };
        let doing = |is_moved| [ArmDoing { held: Some(0), moves: false, is_moved, fingers_solid: true }];
        watched.contacts.closed(0, Some(0), &watched.environment);
        for (depth_m, moves) in [(0.0004, false), (0.006, true)] {
            let doing = Doing { now: Timestamp::default(), arms: &doing(moves), drives: false };
            watched.contacts.observe(&[touch(depth_m)], doing, &watched.environment, &["box_1".to_owned()]);
        }
        let doing = Doing { now: Timestamp::default(), arms: &doing(true), drives: false };
        watched.contacts.observe(&[], doing, &watched.environment, &["box_1".to_owned()]);
        watched.contacts.unintended()
    }

    #[test]
    fn what_is_held_may_press_what_is_below_it_when_it_is_lifted_and_nothing_beside_it() {
        assert_eq!(grasped_along([0.0, 0.0, 1.0]), []);
        assert_eq!(grasped_along([1.0, 0.0, 0.0]).len(), 1);
    }

    #[test]
    fn what_another_arm_moves_is_nothing_that_an_object_was_lifted_from() {
        let stands = ArmDoing { held: None, moves: false, is_moved: false, fingers_solid: true };
        let holds = ArmDoing { held: Some(0), ..stands };
        let moves = ArmDoing { moves: true, is_moved: true, ..stands };
        let (keeps, carries) = (ArmDoing { held: Some(1), ..stands }, ArmDoing { held: Some(1), ..moves });
        let (link, object) = (Thing::Link("right_hand".to_owned()), Thing::Object(1));
        for (below, stays, goes) in [(&link, stands, moves), (&object, keeps, carries)] {
            let watched = Watched::new();
            let mut contacts = Contacts {
                fingers: Fingers(vec![Vec::new(), Vec::new()]),
                hands: vec![Hand::default(); 2],
                arm_links: vec![vec!["left_hand".to_owned()], vec!["right_hand".to_owned()]],
                ..Contacts::default()
            };
            let touch = Touch {
                things: [below.clone(), Thing::Object(0)],
                depth_m: 0.005,
                at: [0.0; 3],
                normal: [0.0, 0.0, 1.0],
                speed_m_s: 0.1,
            };
            let mut unintended_while = |other: ArmDoing| {
                let doing = Doing { now: Timestamp::default(), arms: &[holds, other], drives: false };
                let ids = ["box_1".to_owned(), "box_2".to_owned()];
                contacts.observe(std::slice::from_ref(&touch), doing, &watched.environment, &ids);
                contacts.unintended().len()
            };
            // From the first step of its motion on it pushes, and that remains true when the motion is over.
            assert_eq!([stays, goes, stays].map(&mut unintended_while), [0, 1, 1], "{below:?}");
        }
    }

    #[test]
    fn fingers_that_have_opened_inside_of_what_they_closed_around_in_vain_push_it() {
        let mut watched = Watched::new();
        watched.contacts.closing(0);
        watched.step(0.0, Some(("finger_left", 0.03)), false, false);
        watched.contacts.closed(0, Some(0), &watched.environment);
        watched.step(0.0, Some(("finger_left", 0.03)), false, false);
        assert_eq!(watched.contacts.unintended(), [], "they closed in it");
        watched.step(0.0, Some(("finger_left", 0.02)), false, true);
        watched.step(0.02, None, false, true);
        let [contact] = &watched.contacts.unintended()[..] else { panic!("{:?}", watched.contacts.unintended()) };
        assert_eq!(contact.meant, Some(Purpose::Depart), "{contact}");
    }
}
