//! Minimum distances between the parts of a robot. When an arm starts a motion, fingers begin to close or open, or the head begins to turn, the part
//! is compared with every other arm, at its current posture and along the rest of its motion, and with a turning head (`clearance`). A head is also
//! compared with the links of the robot that neither it nor an arm moves. Fingers are also compared with their own robot and with a standing head;
//! for an arm that starts a motion, the check of its trajectory covers those.
//!
//! For the fingers of an arm, three positions count: the current one, the one that they move to, and open, because the holder of the arm's lease
//! may open them. This holds for both of two moving arms, and moving fingers keep the same distance from another moving part as arms do. So the result does
//! not depend on which part begins first.

use super::activity::{Kind, Module, Ticket};
use super::braking::Way;
use super::cell::Cell;
use super::clearance::{Ahead, Crossing, MAX_POSTURES, Other, Part, keep_apart};
use super::levers::{Levers, Thinned};
use ratn_model::pose::Pose;
use ratn_motion::collision::Checker;
use ratn_motion::fingers_meanwhile::{TooLong, met_on_the_way};
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{ArmPosition, Configuration};
use ratn_world::scene::Scene;
use std::collections::BTreeSet;

/// Maximum distance between two finger positions that are compared, in metres.
const FINGER_STEP_M: f64 = 0.002;
/// The same where the arm moves meanwhile, beside another part on its way: every position of the fingers comes with every one of the joints. Half
/// of it is kept besides.
const OPENING_STEP_M: f64 = 0.008;
/// Maximum number of combined finger positions and joint postures compared with a standing part at the fine step; beyond it, the coarse step is used.
const MAX_POSTURES_BESIDE: usize = 10 * MAX_POSTURES;
/// Maximum change of a head joint between two compared positions, in radians.
const HEAD_STEP_RAD: f64 = 0.01;

/// The future motion of a part, for comparison with others.
struct Ours {
    /// For comparison with moving parts.
    beside_moving: Ahead,
    /// For comparison with standing parts.
    beside_standing: Ahead,
}

impl Ours {
    /// The same for moving and standing parts.
    fn alike(ahead: Ahead) -> Ours {
        Ours { beside_moving: ahead.clone(), beside_standing: ahead }
    }

    fn with(&self, does: Other) -> &Ahead {
        match does {
            Other::Moves => &self.beside_moving,
            Other::Stands => &self.beside_standing,
        }
    }
}

/// The future motion of another part.
struct Theirs {
    ahead: Ahead,
    does: Other,
    /// The goal that moves it.
    ticket: Option<Ticket>,
}

impl Theirs {
    /// A part with a goal moves; without one it stands.
    fn of(ahead: Ahead, ticket: Option<Ticket>) -> Theirs {
        let does = if ticket.is_some() { Other::Moves } else { Other::Stands };
        Theirs { ahead, does, ticket }
    }
}

impl Cell {
    /// Whether an arm that follows `way` keeps its distance from the other parts: on the course that its joints really take, and while it brakes
    /// beyond the end of that course, in case the controller loses it there.
    ///
    /// # Errors
    /// Names the links that come too close, their parts, and what the other part is doing.
    pub(super) fn arm_keeps_apart(&self, arm: usize, way: &Way) -> Result<(), String> {
        let from = self.arms.seen_from(arm, &self.measured()).finger;
        let joints = way.ahead(&self.robot, 0.0);
        let refused = ["the trajectory is refused: on the way ", "the trajectory is refused: its way"];
        // The arm's fingers may open during the motion.
        let to = self.opens_fingers_to(arm).unwrap_or(from);
        self.keeps_apart(&self.both_move(arm, &joints, [from, to], self.robot.links_of(arm)), refused)?;
        if from == to { Ok(()) } else { self.meets_not_itself(arm, &joints, [from, to], "the trajectory is refused") }
    }

    /// Whether the fingers of an arm may move between these distances from the middle, in metres.
    ///
    /// # Errors
    /// Names the links that come too close, their parts, and what the other part is doing.
    pub(super) fn fingers_keep_apart(&self, arm: usize, from: f64, to: f64) -> Result<(), String> {
        if from == to {
            return Ok(());
        }
        let refused = ["the fingers stay where they are: ", "the fingers stay where they are: their way"];
        let links = self.robot.finger_links_of(arm);
        let (joints, moves) = self.joints_ahead(arm);
        let ours = if moves.is_some() {
            self.both_move(arm, &joints, [from, to], links)
        } else {
            Ours::alike(fingers_alone(arm, joints[0], links, [from, to], None))
        };
        self.keeps_apart(&ours, refused)?;
        self.meets_not_itself(arm, &joints, [from, to], "the fingers stay where they are")
    }

    /// The future motion of these links of an arm whose joints move while its fingers may move from one position to another. Both take their own
    /// time, so every finger position is combined with every joint posture.
    fn both_move(&self, arm: usize, joints: &[JointVector], fingers: [f64; 2], links: Vec<usize>) -> Ours {
        Ours {
            beside_moving: self.beside_moving(arm, joints, fingers, links.clone()),
            beside_standing: self.beside_standing(arm, joints, fingers, links),
        }
    }

    /// The motion that is compared with moving parts: the fingers may open as well.
    fn beside_moving(&self, arm: usize, joints: &[JointVector], [from, to]: [f64; 2], links: Vec<usize>) -> Ahead {
        let part = Part::Arm(arm);
        let fingers: Vec<f64> = passed(from, to, OPENING_STEP_M).chain(self.may_open(arm, to)).collect();
        // Each of the two parts gets half of the postures.
        let most = MAX_POSTURES / 2 / fingers.len();
        let Thinned { way, beside_m } = Levers::of(&self.robot, part, &links).thinned(joints, most);
        let between_m = if from == to { 0.0 } else { OPENING_STEP_M / 2.0 };
        Ahead { part, links, courses: courses(&way, fingers), beside_m, between_m }
    }

    /// The motion that is compared with standing parts.
    fn beside_standing(&self, arm: usize, joints: &[JointVector], [from, to]: [f64; 2], links: Vec<usize>) -> Ahead {
        let part = Part::Arm(arm);
        if from == to {
            return Ahead { part, links, courses: courses(joints, [from]), beside_m: 0.0, between_m: 0.0 };
        }
        let Thinned { way, beside_m } = Levers::of(&self.robot, part, &links).thinned(joints, usize::MAX);
        let finely: Vec<f64> = passed(from, to, FINGER_STEP_M).collect();
        let few = finely.len() * way.len() <= MAX_POSTURES_BESIDE;
        let step_m = if few { FINGER_STEP_M } else { OPENING_STEP_M };
        let courses = courses(&way, passed(from, to, step_m));
        Ahead { part, links, courses, beside_m, between_m: step_m / 2.0 }
    }

    /// The open position of an arm's fingers, as a further position that they may take, where it differs from `finger`.
    fn may_open(&self, arm: usize, finger: f64) -> Option<f64> {
        let open = self.arms.open_finger_m(arm);
        (self.arms.view(arm).finger().is_some() && open != finger).then_some(open)
    }

    /// Whether the fingers of an arm touch nothing of their own robot while they and the arm's joints move. A trajectory is checked with the fingers
    /// at their current position; the minimum distances between the robot's links are the same here. A pair of links that touches at the start says
    /// nothing about the motion and is ignored.
    fn meets_not_itself(
        &self,
        arm: usize,
        joints: &[JointVector],
        [from, to]: [f64; 2],
        near: &str,
    ) -> Result<(), String> {
        let robot = self.arms.view(arm);
        let nothing = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        let at = self.arms.seen_from(arm, &self.measured());
        let checker = Checker::new(robot, &nothing, &Configuration { finger: from, ..at }, 0.0);
        match met_on_the_way(checker, joints, [from, to], MAX_POSTURES) {
            Ok(None) => Ok(()),
            Ok(Some(met)) => {
                let go = if to > from { "open" } else { "close" };
                Err(format!("{near}: while its fingers {go}, {met}"))
            }
            Err(TooLong) => {
                Err(format!("{near}: arm and fingers move too far at once to be checked: move one after the other"))
            }
        }
    }

    /// Whether the head may turn between these positions of pan and tilt, in radians.
    ///
    /// # Errors
    /// Names the links that come too close, their parts, and what the other part is doing.
    pub(super) fn head_keeps_apart(&self, from: [f64; 2], to: [f64; 2]) -> Result<(), String> {
        let (links, courses) = (self.robot.head_links(), vec![turned(from, to)]);
        let ours = Ahead { part: Part::Head, links, courses, beside_m: 0.0, between_m: 0.0 };
        self.keeps_apart(&Ours::alike(ours), ["the head stays where it is: ", "the head stays where it is: its way"])
    }

    /// The other parts that a part is compared with: the arms, the head while it turns, and for the head the rest of the robot.
    fn beside(&self, part: Part) -> impl Iterator<Item = Part> {
        let turns = matches!(self.activities.get(&Module::PanTilt).map(|head| &head.kind), Some(Kind::Look { .. }));
        let others = self.arms.numbers().map(Part::Arm).chain(turns.then_some(Part::Head));
        let rest = (part == Part::Head).then_some(Part::Rest);
        others.filter(move |other| *other != part).chain(rest)
    }

    /// `near` begins the message that parts come too close, `long` the message that the motion is too long to check.
    fn keeps_apart(&self, ours: &Ours, [near, long]: [&str; 2]) -> Result<(), String> {
        let here = self.measured();
        let part = ours.beside_moving.part;
        for Theirs { ahead: mut theirs, does, ticket } in self.beside(part).flat_map(|other| self.ahead_of(other)) {
            let ours = ours.with(does);
            let other = theirs.part;
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
                (Crossing::TooClose { link, other: near_link }, Other::Stands) if other == Part::Rest => format!(
                    "{near}{link} of {our_name} comes nearer than {:.0} mm to {near_link}, which no arm moves: look elsewhere, or except the \
                     pair in the SRDF where the two are made to be as near as that",
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

    /// The name of a part in messages.
    fn named(&self, part: Part) -> String {
        match part {
            Part::Arm(arm) => format!("the arm `{}`", self.arms.name(arm)),
            Part::Head => "the head".to_owned(),
            Part::Rest => "the rest of the robot".to_owned(),
        }
    }

    /// The future motion of another part.
    fn ahead_of(&self, part: Part) -> Vec<Theirs> {
        match part {
            Part::Arm(arm) => self.ahead_of_arm(arm),
            Part::Head => vec![self.ahead_of_head()],
            Part::Rest => vec![self.rest_of_robot()],
        }
    }

    fn ahead_of_head(&self) -> Theirs {
        let here = self.measured();
        let activity = self.activities.get(&Module::PanTilt);
        let (to, ticket) = match activity.map(|activity| (&activity.kind, activity.ticket)) {
            Some((Kind::Look { to, .. }, ticket)) => (*to, Some(ticket)),
            _ => ([here.pan, here.tilt], None),
        };
        let (links, courses) = (self.robot.head_links(), vec![turned([here.pan, here.tilt], to)]);
        Theirs::of(Ahead { part: Part::Head, links, courses, beside_m: 0.0, between_m: 0.0 }, ticket)
    }

    /// The links that no arm and not the head moves, where they are.
    fn rest_of_robot(&self) -> Theirs {
        let moved = self.arms.numbers().flat_map(|arm| self.robot.links_of(arm)).chain(self.robot.head_links());
        let moved: BTreeSet<usize> = moved.collect();
        let links = (0..self.robot.model.links.len()).filter(|link| !moved.contains(link)).collect();
        let here = ArmPosition { joints: JointVector::zeros(0), finger: 0.0 };
        Theirs::of(Ahead { part: Part::Rest, links, courses: vec![vec![here]], beside_m: 0.0, between_m: 0.0 }, None)
    }

    /// An arm that stands may have moving fingers: they are then a moving part, and the rest of the arm a standing one.
    fn ahead_of_arm(&self, arm: usize) -> Vec<Theirs> {
        let finger = self.arms.seen_from(arm, &self.measured()).finger;
        let (joints, ticket) = self.joints_ahead(arm);
        let gripper = self.activities.get(&Module::Gripper(arm));
        let (to, fingers_ticket) = match gripper.map(|gripper| (&gripper.kind, gripper.ticket)) {
            // When an object slips out, the fingers close fully.
            Some((Kind::Close { .. }, ticket)) => (0.0, Some(ticket)),
            Some((Kind::Open { to, .. }, ticket)) => (*to, Some(ticket)),
            _ => (finger, None),
        };
        let links = self.robot.links_of(arm);
        if ticket.is_some() {
            return vec![Theirs::of(self.beside_moving(arm, &joints, [finger, to], links), ticket)];
        }
        let fingers = self.robot.finger_links_of(arm);
        let stands = fingers_alone(arm, joints[0], links, [finger, to], self.may_open(arm, to));
        let moves = fingers_ticket.map(|_| fingers_alone(arm, joints[0], fingers, [finger, to], None));
        let moves = moves.map(|ahead| Theirs::of(ahead, fingers_ticket));
        std::iter::once(Theirs::of(stands, None)).chain(moves).collect()
    }

    /// The joint postures of an arm from now on, and the goal that moves it; without a goal the arm stands.
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

/// One course per finger position: all joint postures with the fingers there.
fn courses(way: &[JointVector], fingers: impl IntoIterator<Item = f64>) -> Vec<Vec<ArmPosition>> {
    let course = |finger: f64| way.iter().map(|joints| ArmPosition { joints: *joints, finger }).collect();
    fingers.into_iter().map(course).collect()
}

/// The motion of these links of a standing arm whose fingers move from one position to another, and may be open.
fn fingers_alone(arm: usize, joints: JointVector, links: Vec<usize>, [from, to]: [f64; 2], open: Option<f64>) -> Ahead {
    let on_their_way: Vec<f64> = passed(from, to, FINGER_STEP_M).collect();
    let courses = std::iter::once(on_their_way).chain(open.map(|open| vec![open]));
    let at = |fingers: Vec<f64>| fingers.into_iter().map(|finger| ArmPosition { joints, finger }).collect();
    Ahead { part: Part::Arm(arm), links, courses: courses.map(at).collect(), beside_m: 0.0, between_m: 0.0 }
}

/// Finger positions along their motion, at most `step_m` apart.
fn passed(from: f64, to: f64, step_m: f64) -> impl Iterator<Item = f64> {
    let steps = ((to - from).abs() / step_m).ceil().max(1.0) as u32;
    (0..=steps).map(move |i| from + (to - from) * f64::from(i) / f64::from(steps))
}

/// Head positions along its motion, which is a straight line in joint space.
fn turned(from: [f64; 2], to: [f64; 2]) -> Vec<ArmPosition> {
    let most = (to[0] - from[0]).abs().max((to[1] - from[1]).abs());
    let steps = (most / HEAD_STEP_RAD).ceil().max(1.0) as u32;
    let at = |i: u32| [0, 1].map(|j| from[j] + (to[j] - from[j]) * f64::from(i) / f64::from(steps));
    (0..=steps).map(|i| ArmPosition { joints: JointVector::of(at(i)), finger: 0.0 }).collect()
}
