//! What the parts of a robot keep from each other: an arm that sets out, fingers that begin to close or to open, and a head that begins to turn
//! are compared with every other arm, where it stands and on the way that it has before it, and with a head that turns (`clearance`). A head that
//! stands is no matter of this file: the check of the arm's trajectory knows where it is.
//!
//! The fingers of another arm count where they are, where they are on their way to, and open: whoever holds that arm may open them.

use super::activity::{Kind, Module, Ticket};
use super::braking::Way;
use super::cell::Cell;
use super::clearance::{Ahead, Crossing, MAX_POSTURES, Other, Part, keep_apart};
use ratn_model::pose::Pose;
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{ArmPosition, Configuration};
use ratn_world::scene::Scene;

/// How far a finger may be from one position to the next that are compared, in metres.
const FINGER_STEP_M: f64 = 0.002;
/// The same where the arm moves meanwhile, and every position of the fingers comes with every one of its joints. No finger is as thin as that.
const OPENING_STEP_M: f64 = 0.008;
/// The same of the head's joints, in radians.
const HEAD_STEP_RAD: f64 = 0.01;

impl Cell {
    /// Whether an arm that is to go so keeps apart from the rest: on the course that its joints really take, and while it brakes at the end
    /// of that course where the controller loses it there.
    ///
    /// # Errors
    /// Which links come too close, of what, and what that one is doing.
    pub(super) fn arm_keeps_apart(&self, arm: usize, way: &Way) -> Result<(), String> {
        let from = self.arms.seen_from(arm, &self.measured()).finger;
        let joints = way.ahead(&self.robot, 0.0);
        let refused = ["the trajectory is refused: on the way ", "the trajectory is refused: its way"];
        // Its fingers may open meanwhile.
        let to = self.opens_fingers_to(arm).unwrap_or(from);
        self.keeps_apart(&self.both_move(arm, &joints, from, to), refused)?;
        self.meets_not_itself(arm, &joints, from, to, "the trajectory is refused")
    }

    /// Whether the fingers of an arm may go so: from and to these distances from the middle, in metres.
    ///
    /// # Errors
    /// Which links come too close, of what, and what that one is doing.
    pub(super) fn fingers_keep_apart(&self, arm: usize, from: f64, to: f64) -> Result<(), String> {
        if from == to {
            return Ok(());
        }
        let refused = ["the fingers stay where they are: ", "the fingers stay where they are: their way"];
        let links = self.robot.finger_links_of(arm);
        // The arm may move meanwhile.
        if let (ahead, Some(_)) = self.joints_ahead(arm) {
            self.keeps_apart(&Ahead { links, ..self.both_move(arm, &ahead, from, to) }, refused)?;
            return self.meets_not_itself(arm, &ahead, from, to, "the fingers stay where they are");
        }
        let joints = self.arms.seen_from(arm, &self.measured()).arm;
        let course = passed(from, to, FINGER_STEP_M).map(|finger| ArmPosition { joints, finger }).collect();
        let ours = Ahead { part: Part::Arm(arm), links, courses: vec![course], between_m: 0.0 };
        self.keeps_apart(&ours, refused)
    }

    /// What an arm does whose joints and fingers move at once: both take their own time, so any of the one comes with any of the other.
    fn both_move(&self, arm: usize, joints: &[JointVector], from: f64, to: f64) -> Ahead {
        let course = |finger: f64| joints.iter().map(|at| ArmPosition { joints: *at, finger }).collect();
        let courses: Vec<Vec<ArmPosition>> = passed(from, to, OPENING_STEP_M).map(course).collect();
        let between_m = if from == to { 0.0 } else { OPENING_STEP_M / 2.0 };
        Ahead { part: Part::Arm(arm), links: self.robot.links_of(arm), courses, between_m }
    }

    /// Whether the fingers of an arm meet nothing of their own robot while they go so and its joints go so. A trajectory is checked with the fingers
    /// where they are; how near the robot's links may come to each other is the same here.
    fn meets_not_itself(
        &self,
        arm: usize,
        joints: &[JointVector],
        from: f64,
        to: f64,
        near: &str,
    ) -> Result<(), String> {
        if from == to {
            return Ok(());
        }
        let robot = self.arms.view(arm);
        let nothing = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        let at = self.arms.seen_from(arm, &self.measured());
        let steps = ((to - from).abs() / OPENING_STEP_M).ceil() as usize + 1;
        if steps * joints.len() > MAX_POSTURES {
            return Err(format!(
                "{near}: arm and fingers move for too long at once to be checked: move one after the other"
            ));
        }
        // From one finger position to the next they move by less than they are thick: nothing is passed over.
        for finger in passed(from, to, OPENING_STEP_M) {
            let mut checker = Checker::new(robot, &nothing, &Configuration { finger, ..at }, 0.0);
            let mut before: Option<&JointVector> = None;
            for (i, posture) in joints.iter().enumerate() {
                // The last one is always looked at, and no step of a link is longer than the checker's own.
                let is_next_far =
                    joints.get(i + 1).is_none_or(|next| before.is_none_or(|b| checker.steps(b, next) > 1));
                if !is_next_far {
                    continue;
                }
                before = Some(posture);
                if let Some(collision) = checker.collision(posture, Contact::None) {
                    return Err(format!("{near}: while its fingers open, {collision}"));
                }
            }
        }
        Ok(())
    }

    /// Whether the head may turn so: from and to these positions of pan and tilt, in radians.
    ///
    /// # Errors
    /// Which links come too close, of what, and what that one is doing.
    pub(super) fn head_keeps_apart(&self, from: [f64; 2], to: [f64; 2]) -> Result<(), String> {
        let (links, courses) = (self.robot.head_links(), vec![turned(from, to)]);
        let ours = Ahead { part: Part::Head, links, courses, between_m: 0.0 };
        self.keeps_apart(&ours, ["the head stays where it is: ", "the head stays where it is: its way"])
    }

    /// What may be on its way beside a part, or in its way.
    fn beside(&self, part: Part) -> impl Iterator<Item = Part> {
        let turns = matches!(self.activities.get(&Module::PanTilt).map(|head| &head.kind), Some(Kind::Look { .. }));
        let others = self.arms.numbers().map(Part::Arm).chain(turns.then_some(Part::Head));
        others.filter(move |other| *other != part)
    }

    /// `near` begins the sentence that something comes too near, `long` the one that this was not found out.
    fn keeps_apart(&self, ours: &Ahead, [near, long]: [&str; 2]) -> Result<(), String> {
        let here = self.measured();
        for other in self.beside(ours.part) {
            let (mut theirs, ticket) = self.ahead_of(other);
            let does = if ticket.is_some() { Other::Moves } else { Other::Stands };
            let (our_name, name) = (self.named(ours.part), self.named(other));
            let under_way = ticket.map_or_else(String::new, |ticket| format!("is under way with goal {}", ticket.0));
            // A torso that is one of the arm's joints carries the head.
            let of_both = theirs.links.iter().copied().find(|link| ours.links.contains(link));
            if let (Some(link), Other::Moves) = (of_both, does) {
                return Err(format!(
                    "{near}{} is moved by {our_name} and by {name}, which {under_way}: move one after the other",
                    self.robot.model.links[link].name
                ));
            }
            theirs.links.retain(|link| !ours.links.contains(link));
            let Err(crossing) = keep_apart(&self.robot, &here, ours, &theirs, does) else { continue };
            return Err(match (crossing, does) {
                (Crossing::TooClose { link, other }, Other::Moves) => format!(
                    "{near}{link} of {our_name} comes nearer than {:.0} mm to {other} of {name}, which {under_way}. Either may be stopped \
                     anywhere, so the ways of two that move at once must not cross: move one after the other, or plan another way",
                    does.apart_m() * 1e3
                ),
                (Crossing::TooClose { link, other }, Other::Stands) => format!(
                    "{near}{link} of {our_name} comes nearer than {:.0} mm to {other} of {name}, which stands there with its fingers as they \
                     are or may open: move that arm away first, or plan another way",
                    does.apart_m() * 1e3
                ),
                (Crossing::TooLong, _) => format!(
                    "{long} and that of {name}{} are too long, or too near to each other for too long, to be compared: move one after the \
                     other, or in shorter motions",
                    if under_way.is_empty() { String::new() } else { format!(", which {under_way},") }
                ),
            });
        }
        Ok(())
    }

    /// A part for people.
    fn named(&self, part: Part) -> String {
        match part {
            Part::Arm(arm) => format!("the arm `{}`", self.arms.name(arm)),
            Part::Head => "the head".to_owned(),
        }
    }

    /// What another part does from now on, and with which goal where it is on its way; else it stands.
    fn ahead_of(&self, part: Part) -> (Ahead, Option<Ticket>) {
        match part {
            Part::Arm(arm) => self.ahead_of_arm(arm),
            Part::Head => self.ahead_of_head(),
        }
    }

    fn ahead_of_head(&self) -> (Ahead, Option<Ticket>) {
        let here = self.measured();
        let activity = self.activities.get(&Module::PanTilt);
        let (to, ticket) = match activity.map(|activity| (&activity.kind, activity.ticket)) {
            Some((Kind::Look { to, .. }, ticket)) => (*to, Some(ticket)),
            _ => ([here.pan, here.tilt], None),
        };
        let courses = vec![turned([here.pan, here.tilt], to)];
        (Ahead { part: Part::Head, links: self.robot.head_links(), courses, between_m: 0.0 }, ticket)
    }

    /// The fingers of an arm that stands may move.
    fn ahead_of_arm(&self, arm: usize) -> (Ahead, Option<Ticket>) {
        let at = self.arms.seen_from(arm, &self.measured());
        let (joints, ticket) = self.joints_ahead(arm);
        if let (Some(to), Some(_)) = (self.opens_fingers_to(arm), ticket) {
            return (self.both_move(arm, &joints, at.finger, to), ticket);
        }
        let mut fingers = vec![vec![at.finger]];
        if self.arms.view(arm).finger().is_some() {
            let open = self.arms.open_finger_m(arm);
            match self.activities.get(&Module::Gripper(arm)).map(|activity| &activity.kind) {
                // What slips out of fingers lets them close fully.
                Some(Kind::Close { .. }) => fingers = vec![passed(at.finger, 0.0, FINGER_STEP_M).collect(), vec![open]],
                Some(Kind::Open { to, .. }) => fingers = vec![passed(at.finger, *to, FINGER_STEP_M).collect()],
                _ if open != at.finger => fingers.push(vec![open]),
                _ => {}
            }
        }
        // Either the joints move or the fingers do; what does both is above.
        let course = |fingers: Vec<f64>| -> Vec<ArmPosition> {
            let positions = fingers.into_iter().flat_map(|finger| joints.iter().map(move |at| (*at, finger)));
            positions.map(|(joints, finger)| ArmPosition { joints, finger }).collect()
        };
        let courses = fingers.into_iter().map(course).collect();
        (Ahead { part: Part::Arm(arm), links: self.robot.links_of(arm), courses, between_m: 0.0 }, ticket)
    }

    /// Where the joints of an arm are from now on, and with which goal where it is on its way; else it stands.
    fn joints_ahead(&self, arm: usize) -> (Vec<JointVector>, Option<Ticket>) {
        let activity = self.activities.get(&Module::Arm(arm));
        let followed = activity.and_then(|activity| match &activity.kind {
            Kind::Follow(way) => Some((activity.ticket, way.ahead(&self.robot, activity.elapsed_s(self.motion_time)))),
            _ => None,
        });
        let braking = self.braking.get(&Module::Arm(arm));
        let braked = braking.map(|braking| (braking.ticket, braking.ahead(self.now)));
        let at = || vec![self.arms.seen_from(arm, &self.measured()).arm];
        followed.or(braked).map_or_else(|| (at(), None), |(ticket, way)| (way, Some(ticket)))
    }
}

/// Positions of fingers on their way.
fn passed(from: f64, to: f64, step_m: f64) -> impl Iterator<Item = f64> {
    let steps = ((to - from).abs() / step_m).ceil().max(1.0) as u32;
    (0..=steps).map(move |i| from + (to - from) * f64::from(i) / f64::from(steps))
}

/// Positions of a head on its way, which is a straight line in its joints.
fn turned(from: [f64; 2], to: [f64; 2]) -> Vec<ArmPosition> {
    let most = (to[0] - from[0]).abs().max((to[1] - from[1]).abs());
    let steps = (most / HEAD_STEP_RAD).ceil().max(1.0) as u32;
    let at = |i: u32| [0, 1].map(|j| from[j] + (to[j] - from[j]) * f64::from(i) / f64::from(steps));
    (0..=steps).map(|i| ArmPosition { joints: JointVector::of(at(i)), finger: 0.0 }).collect()
}
