//! Which contacts were meant: what the environment says of touching bodies, judged by what the robot was doing.
//!
//! ```text
//!                    ┌─ a finger at what it closes around next, or has just let go (Approach, Depart), or at what it holds (Grasp)
//! two bodies touch ──┼─ what is held at what it stood on when its motion began (LiftOff), or is set down on (SetDown)
//!                    ├─ an object stands on a link (Stands); something was put there by a fault (PutThere)
//!                    └─ everything else is unintended
//! ```
//! An episode begins when two bodies are as near as touching and ends when they have come apart. Some are judged only by what comes after: a
//! finger may brush what it is about to grasp, but what it brushed and did not close around was hit. No episode is forgiven for how
//! deep it went at the worst where contact was meant: [`PRESS_M`] bounds those, too.

use super::environment::{Environment, Thing, Touch};
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What counts as no contact, in metres: the engine itself lets bodies sink into each other by half as much, and pushes
/// something that rests by as much before it is still. Nothing is added for controllers that lag: the judge sees where the joints are.
pub const TOLERANCE_M: f64 = 0.001;
/// How deep what is held may be pressed into what it was lifted from or is set down on, and how far a finger may push what it
/// grasps or lets go, in metres: poses are measured, with an error of millimetres.
pub const PRESS_M: f64 = 0.015;
/// How much of a support's normal points up at the least.
const LEVEL: f64 = 0.7;
/// The most contacts that are kept; the first ones are.
pub const MAX_CONTACTS: usize = 64;

/// An episode of two bodies in contact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// When it began, in the robot's time.
    pub began: Timestamp,
    /// When it ended; when it was last seen, where it goes on.
    pub ended: Timestamp,
    /// The two bodies: names of links, of furniture, of objects.
    pub bodies: [String; 2],
    /// How deep they were in each other at the most, in metres.
    pub depth_m: f64,
    /// How far an object that nobody held was pushed from where it was, in metres.
    pub pushed_m: f64,
    /// Where it was deepest, in the world frame.
    pub at: [f64; 3],
    /// How fast one moved as seen from the other at the most, in metres per second.
    pub speed_m_s: f64,
    /// What for; `None`: it was not meant.
    pub meant: Option<Purpose>,
}

/// Why two bodies may be in contact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// A finger comes to what it closes around next.
    Approach,
    /// A finger at what it holds, or tried to.
    Grasp,
    /// A finger leaves what it has let go.
    Depart,
    /// What is held leaves what it stood on.
    LiftOff,
    /// What is held comes to stand on something, and is let go there.
    SetDown,
    /// An object stands on a link.
    Stands,
    /// A fault put it there.
    PutThere,
}

/// An episode that goes on.
#[derive(Debug, Clone)]
struct Episode {
    contact: Contact,
    /// Where the object was that is not held.
    from: Option<(usize, [f64; 3])>,
    /// How much of the normal points up where it is deepest.
    up: f64,
}

/// Watches a cell's contacts.
#[derive(Debug, Clone, Default)]
pub(super) struct Contacts {
    open: BTreeMap<[Thing; 2], Episode>,
    /// Fingers at objects, over before it is known what for.
    waiting: Vec<(usize, Contact)>,
    /// What the fingers have let go, or closed around in vain, until the arm has moved away from it.
    parting: Option<usize>,
    /// Something has just been grasped.
    grasped: bool,
    /// What a fault put somewhere since the last step.
    put: Option<usize>,
    judged: Vec<Contact>,
    /// Of those, the ones that nobody was told of.
    fresh: Vec<Contact>,
}

/// What the robot is doing at a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Doing {
    pub(super) now: Timestamp,
    /// What the fingers hold.
    pub(super) held: Option<usize>,
    /// The arm or the base is on its way.
    pub(super) moves: bool,
    /// The fingers push what they meet; while they close they do not.
    pub(super) fingers_solid: bool,
}

impl Purpose {
    /// As in a text.
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
    /// Whether it counts: it was not meant, or went too deep, by more than a tolerance.
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

impl Contacts {
    /// After a step: what touches what.
    pub(super) fn observe(&mut self, touches: &[Touch], doing: Doing, environment: &Environment, ids: &[String]) {
        for touch in touches {
            self.see(touch, doing, environment, ids);
        }
        for (things, episode) in self.take(|things, _| touches.iter().all(|touch| touch.things != *things)) {
            match finger_at(&things) {
                Some(object) if episode.contact.meant.is_none() && (doing.moves || !doing.fingers_solid) => {
                    self.waiting.push((object, episode.contact));
                }
                _ => self.judge(episode.contact),
            }
        }
        (self.put, self.grasped) = (None, false);
    }

    /// The fingers begin to close: what they touch already they came to.
    pub(super) fn closing(&mut self) {
        let came = self.take(|things, episode| finger_at(things).is_some() && episode.contact.meant.is_none());
        self.waiting.extend(came.into_iter().filter_map(|(things, e)| Some((finger_at(&things)?, e.contact))));
    }

    /// The fingers have closed around an object, in vain or not; `None`: around nothing.
    pub(super) fn closed(&mut self, around: Option<usize>) {
        for (things, episode) in &mut self.open {
            if finger_at(things).is_some() && finger_at(things) == around {
                episode.contact.meant = Some(Purpose::Grasp);
            }
        }
        for (object, contact) in std::mem::take(&mut self.waiting) {
            let meant = (Some(object) == around).then_some(Purpose::Approach);
            self.judge(Contact { meant, ..contact });
        }
        (self.parting, self.grasped) = (around, true);
    }

    /// The fingers have let go of an object, on purpose or not.
    pub(super) fn let_go(&mut self, object: usize, on_purpose: bool) {
        for (_, Episode { mut contact, up, .. }) in self.take(|things, _| things[1] == Thing::Object(object)) {
            // The normal leads from what it stands on to what is held.
            if contact.meant.is_none() && on_purpose && up >= LEVEL {
                contact.meant = Some(Purpose::SetDown);
            }
            self.judge(contact);
        }
        self.parting = Some(object);
    }

    /// The arm or the base begins to move.
    pub(super) fn sets_out(&mut self) {
        for (_, contact) in std::mem::take(&mut self.waiting) {
            self.judge(contact);
        }
    }

    /// The arm has come to the end of a motion.
    pub(super) fn arrived(&mut self) {
        self.parting = None;
    }

    /// Somebody puts an object somewhere.
    pub(super) fn put(&mut self, object: usize) {
        self.put = Some(object);
        for (_, episode) in self.take(|things, _| things.contains(&Thing::Object(object))) {
            self.judge(episode.contact);
        }
    }

    /// What was not meant: those that are over, and, as it looks now, those that go on and those of which it is not known yet.
    pub(super) fn unintended(&self) -> Vec<Contact> {
        let open = self.open.values().map(|episode| &episode.contact);
        let undecided = open.chain(self.waiting.iter().map(|(_, contact)| contact));
        self.judged.iter().chain(undecided.filter(|contact| contact.is_unintended())).cloned().collect()
    }

    /// What is over, was not meant, and has not been told yet.
    pub(super) fn tell(&mut self) -> Vec<Contact> {
        std::mem::take(&mut self.fresh)
    }

    fn see(&mut self, touch: &Touch, doing: Doing, environment: &Environment, ids: &[String]) {
        if !self.open.contains_key(&touch.things) {
            let loose = touch.things.iter().find_map(|thing| match thing {
                Thing::Object(object) if doing.held != Some(*object) => Some(*object),
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
            let from = loose.map(|object| (object, environment.state(object).pose.position));
            self.open.insert(touch.things.clone(), Episode { contact, from, up: 0.0 });
        }
        let Some(Episode { contact, from, up }) = self.open.get_mut(&touch.things) else { return };
        contact.ended = doing.now;
        contact.speed_m_s = contact.speed_m_s.max(touch.speed_m_s);
        if touch.depth_m > contact.depth_m {
            (contact.depth_m, contact.at, *up) = (touch.depth_m, touch.at, touch.normal[2]);
        }
        if let Some((object, from)) = from
            && doing.held != Some(*object)
        {
            let at = environment.state(*object).pose.position;
            let pushed = (0..3).map(|i| (at[i] - from[i]).powi(2)).sum::<f64>().sqrt();
            contact.pushed_m = contact.pushed_m.max(pushed);
        }
    }

    /// What a contact is for, where that is known as it begins.
    fn known(&self, touch: &Touch, doing: Doing) -> Option<Purpose> {
        let lifts = (self.grasped || !doing.moves).then_some(Purpose::LiftOff);
        match &touch.things {
            things if things.iter().any(|thing| self.put.map(Thing::Object).as_ref() == Some(thing)) => {
                Some(Purpose::PutThere)
            }
            [Thing::Link(_), Thing::Object(object)] if finger_at(&touch.things).is_some() => {
                if doing.held == Some(*object) {
                    return Some(Purpose::Grasp);
                }
                let purpose = if doing.fingers_solid { Purpose::Depart } else { Purpose::Grasp };
                (self.parting == Some(*object)).then_some(purpose)
            }
            [Thing::Link(_), Thing::Object(object)] if doing.held != Some(*object) => {
                (touch.normal[2] >= LEVEL).then_some(Purpose::Stands)
            }
            [_, Thing::Object(_)] => lifts,
            _ => None,
        }
    }

    /// Takes episodes out of those that go on.
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

/// The object at which a finger is.
fn finger_at(things: &[Thing; 2]) -> Option<usize> {
    match things {
        [Thing::Link(link), Thing::Object(object)] if link.starts_with("finger") => Some(*object),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let mut contacts = Contacts { waiting: vec![(0, hit.clone())], ..Contacts::default() };
        assert_eq!(contacts.unintended(), [hit]);
        // It was what the fingers came to.
        contacts.closed(Some(0));
        assert_eq!(contacts.unintended().len(), 1, "it was pushed too far for that");
    }
}
