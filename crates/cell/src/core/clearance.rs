//! Whether the links of two parts of the robot (arms, its head) keep a minimum distance wherever both are along their motions.
//!
//! Either part may be stopped anywhere along its motion: its goal is cancelled, its lease ends, or a fault brakes it. So the motions are compared
//! independently of timing: every position of one part with every position of the other. Controllers know the robot's links, not the obstacles
//! around them; so held objects are not compared here, the judge checks them (`contacts`).
//!
//! The comparison runs on the cell's only thread, and an emergency stop has to wait for it, so its work is bounded. Positions that a motion visits
//! again are kept once, and the positions of a body form a binary tree whose branches are ruled out by one distance each. Beside a standing part,
//! postures are skipped as long as no joint has moved anything by as much as there was room at the last comparison (conservative advancement,
//! Mirtich 1996). A comparison that takes more than [`MAX_POSTURES`], [`MAX_DISTANCES`] or [`MAX_SEARCHES`] is given up ([`Crossing::TooLong`]).

use super::levers::Levers;
use rapier3d::math::Pose as Pose32;
use rapier3d::parry::shape::SharedShape;
use ratn_model::pose::Pose;
use ratn_motion::distance::gap_within;
use ratn_motion::robot::{ArmPosition, Configuration, Joint, Robot, to_f32};
use std::collections::BTreeMap;

/// Minimum distance of two moving parts, in metres.
pub(super) const APART_M: f64 = 0.02;
/// Minimum distance of a moving part from a standing one, in metres: more than the errors of controllers and encoders.
pub(super) const BESIDE_M: f64 = 0.003;
/// How much nearer than at its start a body may come to a part that is already too near, in metres: rounding.
const ROUNDED_M: f32 = 3e-4;
/// Maximum number of postures of two moving parts that are compared. A motion of 10 s has 2500 for each finger position. Longer motions are
/// thinned before (`levers`), so that this limits how far a part moves and not how long it takes.
pub(super) const MAX_POSTURES: usize = 40_000;
/// Maximum number of distances of two bodies computed for one comparison.
const MAX_DISTANCES: u32 = 200_000;
/// Maximum number of searches for these distances: each triangle of a mesh that is near the other body takes one, about a microsecond.
const MAX_SEARCHES: u32 = 1_000_000;
/// Of positions on two motions that are nearer to each other than this only one is kept, in metres; this is added to the distance on either side.
const RESOLUTION_M: f32 = 0.008;
/// The same beside a standing part. Of a standing arm only the fingers may move.
const FINE_M: f32 = 1e-4;

/// A part of the robot that moves beside other parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    /// The arm of this number, with its fingers.
    Arm(usize),
    /// The camera's head. Its joints are pan and tilt, and it has no fingers.
    Head,
    /// The links that no arm and not the head moves: a mast, a stand.
    Rest,
}

/// The remaining work that a comparison may do.
#[derive(Debug, Clone)]
struct Work {
    distances: u32,
    searches: u32,
}

/// The future motion of a part, or of the fingers of an arm alone.
#[derive(Debug, Clone)]
pub(super) struct Ahead {
    pub(super) part: Part,
    /// The links that are compared: all that move.
    pub(super) links: Vec<usize>,
    /// Possible courses of the part: for each the positions in the order of time, with small steps.
    pub(super) courses: Vec<Vec<ArmPosition>>,
    /// Maximum distance of any point from its place at the nearest position, in metres, because positions stand for those that are left out.
    pub(super) beside_m: f64,
    /// Additional distance of the fingers from the nearest course, in metres, because courses stand for the finger positions between them.
    pub(super) between_m: f64,
}

/// What the other part does meanwhile; it decides the minimum distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Other {
    /// It moves: [`APART_M`].
    Moves,
    /// It stands: [`BESIDE_M`]. What is nearer than that already may move away, but come no nearer.
    Stands,
}

/// Why two motions do not keep their distance.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Crossing {
    /// A link of one part comes too close to a link of the other.
    TooClose {
        /// The link of the part that asks.
        link: String,
        /// The link of the other part.
        other: String,
    },
    /// The motions are too long, or too near to each other for too long, to be compared.
    TooLong,
}

/// One body of a link, with all its positions along the motion.
struct Swept {
    link: usize,
    in_link: Pose,
    shape: SharedShape,
    /// Maximum distance of its points from its origin.
    radius: f32,
    places: Vec<Pose32>,
    /// The positions as the leaves of a binary tree, whose root is last.
    tree: Vec<Branch>,
    /// Maximum motion of a point between two consecutive postures.
    leg: f32,
    /// Maximum distance of a point from its place at the position that was kept instead.
    dropped: f32,
}

/// Consecutive positions of a body.
struct Branch {
    /// Index of one of them.
    place: usize,
    /// Maximum distance of a point of the body at any of them from its place at that one.
    spread: f32,
    halves: Option<[usize; 2]>,
}

/// The positions of a body that are kept.
struct Kept {
    /// By their rounded coordinates.
    known: BTreeMap<[i32; 7], Pose32>,
    /// The kept position that stands for the last posture.
    last: Option<Pose32>,
    /// The position at the posture before.
    before: Option<Pose32>,
}

impl Other {
    /// Minimum distance from the other part, in metres.
    pub(super) fn apart_m(self) -> f64 {
        match self {
            Other::Moves => APART_M,
            Other::Stands => BESIDE_M,
        }
    }
}

/// Whether a moving part stays away from another part; the rest of the robot is as in `here`.
///
/// # Errors
/// [`Crossing`] if it does not, or if that cannot be decided.
pub(super) fn keep_apart(
    robot: &Robot,
    here: &Configuration,
    ours: &Ahead,
    theirs: &Ahead,
    other: Other,
) -> Result<(), Crossing> {
    match other {
        Other::Moves => ways_apart(robot, here, ours, theirs),
        Other::Stands => stays_beside(robot, here, ours, theirs),
    }
}

/// Whether two motions keep [`APART_M`] from each other.
fn ways_apart(robot: &Robot, here: &Configuration, ours: &Ahead, theirs: &Ahead) -> Result<(), Crossing> {
    if ours.postures() + theirs.postures() > MAX_POSTURES {
        return Err(Crossing::TooLong);
    }
    let (ours, theirs) = (swept(robot, here, ours, RESOLUTION_M), swept(robot, here, theirs, RESOLUTION_M));
    let mut work = Work::WHOLE;
    for a in &ours {
        for b in theirs.iter().filter(|b| a.is_kept_from(b, robot)) {
            let margin = APART_M as f32 + a.missed() + b.missed();
            if a.comes_to(b, margin, &mut work)? {
                return Err(Crossing::of(robot, a, b));
            }
        }
    }
    Ok(())
}

/// Whether a motion keeps [`BESIDE_M`] from a standing part. A body that is nearer at the start may come no nearer, and a finger of which only
/// some courses are compared has to be farther away by the distance between them.
fn stays_beside(robot: &Robot, here: &Configuration, ours: &Ahead, theirs: &Ahead) -> Result<(), Crossing> {
    let (bodies, others) = (Swept::all(robot, ours), swept(robot, here, theirs, FINE_M));
    let levers = ours.levers(robot);
    let between = ours.between_courses(robot);
    let (mut work, mut configuration) = (Work::WHOLE, *here);
    for course in &ours.courses {
        // Per pair: how near it may come, once its distance at the start is known; and whether that is nearer than it should be.
        let mut allowed: Vec<Option<(f32, bool)>> = vec![None; bodies.len() * others.len()];
        let mut looked_at: Option<(&ArmPosition, f32)> = None;
        for (i, at) in course.iter().enumerate() {
            let beside = [i.checked_sub(1), Some(i + 1)].map(|next| next.and_then(|next| course.get(next)));
            let leg = beside.into_iter().flatten().map(|next| levers.moved(at, next)).fold(0.0, f32::max) / 2.0;
            let leg = leg + (ours.beside_m + ours.between_m) as f32;
            if looked_at.is_some_and(|(before, room)| levers.moved(before, at) + leg <= room) {
                continue;
            }
            ours.part.put(at, &mut configuration);
            let poses = robot.poses(&configuration);
            let mut room = f32::INFINITY;
            for (body, a) in bodies.iter().enumerate() {
                let place = to_f32(&poses[a.link].compose(&a.in_link));
                for (other, b) in others.iter().enumerate() {
                    if !a.is_kept_from(b, robot) {
                        continue;
                    }
                    let known = &mut allowed[body * others.len() + other];
                    let sure = BESIDE_M as f32 + b.missed();
                    let up_to = known.map_or(f32::INFINITY, |(least, _)| (room.max(leg) + least).max(sure + leg));
                    let distance = a.nearest(&place, b, up_to, &mut work)?;
                    let (least, is_near) = match *known {
                        // Once it has been far enough away, the usual minimum applies when it comes back.
                        _ if distance >= sure + leg => (sure, false),
                        Some(known) => known,
                        None => (distance.min(BESIDE_M as f32) - ROUNDED_M, true),
                    };
                    *known = Some((least, is_near));
                    if distance < least + if is_near { between(a.link) } else { leg } {
                        return Err(Crossing::of(robot, a, b));
                    }
                    room = room.min(distance - least);
                }
            }
            looked_at = Some((at, room));
        }
    }
    Ok(())
}

/// The bodies of a part's links with all their positions.
fn swept(robot: &Robot, here: &Configuration, ahead: &Ahead, resolution: f32) -> Vec<Swept> {
    let mut swept: Vec<(Swept, Kept)> =
        Swept::all(robot, ahead).into_iter().map(|body| (body, Kept::nothing())).collect();
    let mut configuration = *here;
    for course in &ahead.courses {
        swept.iter_mut().for_each(|(_, kept)| (kept.last, kept.before) = (None, None));
        for at in course {
            ahead.part.put(at, &mut configuration);
            let poses = robot.poses(&configuration);
            for (body, kept) in &mut swept {
                let place = to_f32(&poses[body.link].compose(&body.in_link));
                body.pass(place, kept, resolution);
            }
        }
    }
    let between = ahead.between_courses(robot);
    let grown = |(mut body, _): (Swept, Kept)| {
        body.dropped += ahead.beside_m as f32 + between(body.link);
        if !body.places.is_empty() {
            body.grow(0, body.places.len());
        }
        body
    };
    swept.into_iter().map(grown).collect()
}

impl Part {
    /// Puts the part at a position.
    fn put(self, at: &ArmPosition, configuration: &mut Configuration) {
        match self {
            Part::Arm(arm) => {
                configuration.set_joints(arm, at.joints);
                configuration.set_finger(arm, at.finger);
            }
            Part::Head => [configuration.pan, configuration.tilt] = [at.joints[0], at.joints[1]],
            Part::Rest => {}
        }
    }

    pub(super) fn joints(self, robot: &Robot) -> &[Joint] {
        match self {
            Part::Arm(arm) => robot.joints_of(arm),
            Part::Head => robot.head_joints(),
            Part::Rest => &[],
        }
    }

    pub(super) fn finger_links(self, robot: &Robot) -> Vec<usize> {
        match self {
            Part::Arm(arm) => robot.finger_links_of(arm),
            Part::Head | Part::Rest => Vec::new(),
        }
    }
}

impl Ahead {
    fn postures(&self) -> usize {
        self.courses.iter().map(Vec::len).sum()
    }

    fn levers(&self, robot: &Robot) -> Levers {
        Levers::of(robot, self.part, &self.links)
    }

    /// Maximum distance of a point of a link from the nearest course: only fingers differ from one course to the next.
    fn between_courses(&self, robot: &Robot) -> impl Fn(usize) -> f32 {
        let (fingers, between_m) = (self.part.finger_links(robot), self.between_m as f32);
        move |link| if fingers.contains(&link) { between_m } else { 0.0 }
    }
}

impl Work {
    const WHOLE: Work = Work { distances: MAX_DISTANCES, searches: MAX_SEARCHES };
}

impl Kept {
    fn nothing() -> Kept {
        Kept { known: BTreeMap::new(), last: None, before: None }
    }
}

impl Crossing {
    fn of(robot: &Robot, a: &Swept, b: &Swept) -> Crossing {
        let name = |body: &Swept| robot.model.links[body.link].name.clone();
        Crossing::TooClose { link: name(a), other: name(b) }
    }
}

impl Swept {
    /// The bodies of the links that are compared, still without positions.
    fn all(robot: &Robot, ahead: &Ahead) -> Vec<Swept> {
        let of_link = |link: &usize| {
            let (link, of) = (*link, &robot.model.links[*link]);
            let primitives = of.own_bodies().iter().map(|body| (body.pose, body.geometry.shape(0.0)));
            let meshes = of.meshes.iter().map(|meshed| (meshed.pose, meshed.mesh.surface()));
            primitives.chain(meshes).map(move |(pose, shape)| Swept::new(link, pose, shape)).collect::<Vec<_>>()
        };
        ahead.links.iter().flat_map(of_link).collect()
    }

    fn new(link: usize, in_link: Pose, shape: SharedShape) -> Swept {
        let around = shape.compute_local_bounding_sphere();
        let radius = around.center.length() + around.radius;
        Swept { link, in_link, shape, radius, places: Vec::new(), tree: Vec::new(), leg: 0.0, dropped: 0.0 }
    }

    /// Upper bound of the distance of a point of the body at one position from its place at another.
    fn moved(&self, from: &Pose32, to: &Pose32) -> f32 {
        let [x, y, z, _] = (from.rotation.inverse() * to.rotation).to_array();
        // The sine of half the angle; a point moves along a chord of twice that.
        let sine = (x * x + y * y + z * z).sqrt();
        (to.translation - from.translation).length() + 2.0 * self.radius * sine
    }

    /// Adds a position of the body.
    fn pass(&mut self, place: Pose32, kept: &mut Kept, resolution: f32) {
        if let Some(before) = kept.before.replace(place) {
            self.leg = self.leg.max(self.moved(&before, &place));
        }
        let near = kept.last.map(|last| self.moved(&last, &place)).filter(|moved| *moved < resolution);
        let dropped = near.unwrap_or_else(|| {
            let stands_for = *kept.known.entry(self.rounded(&place, resolution)).or_insert_with(|| {
                self.places.push(place);
                place
            });
            kept.last = Some(stands_for);
            self.moved(&stands_for, &place)
        });
        self.dropped = self.dropped.max(dropped);
    }

    /// Coordinates that two positions share only if no point of the body is farther apart than the resolution: half of it is for the translation
    /// and half for the rotation.
    fn rounded(&self, place: &Pose32, resolution: f32) -> [i32; 7] {
        let along = resolution / (2.0 * 3_f32.sqrt());
        let about = resolution / (8.0 * self.radius.max(1e-3));
        let [x, y, z] = place.translation.to_array().map(|c| (c / along).floor() as i32);
        // A rotation has two quaternions.
        let sign = if place.rotation.to_array()[3] < 0.0 { -1.0 } else { 1.0 };
        let [i, j, k, w] = place.rotation.to_array().map(|c| (sign * c / about).floor() as i32);
        [x, y, z, i, j, k, w]
    }

    /// Maximum distance of a point of the body, anywhere along the motion, from its place at the nearest kept position.
    fn missed(&self) -> f32 {
        self.dropped + self.leg / 2.0
    }

    /// Makes the branch of the positions `from..to`.
    fn grow(&mut self, from: usize, to: usize) -> usize {
        let place = usize::midpoint(from, to);
        let spread = self.places[from..to].iter().map(|at| self.moved(&self.places[place], at)).fold(0.0_f32, f32::max);
        let halves = (to - from > 1).then(|| [self.grow(from, place), self.grow(place, to)]);
        self.tree.push(Branch { place, spread, halves });
        self.tree.len() - 1
    }

    /// Distance from another body, each at one position, or any value greater than `enough` if it is more than that.
    fn distance(&self, at: &Pose32, other: &Swept, of: &Pose32, enough: f32, work: &mut Work) -> Result<f32, Crossing> {
        work.distances = work.distances.checked_sub(1).ok_or(Crossing::TooLong)?;
        let shapes = [&*self.shape, &*other.shape];
        match gap_within([at, of], shapes, f64::from(enough), &mut work.searches) {
            Some(apart) => Ok(apart.max(0.0) as f32),
            None if work.searches == 0 => Err(Crossing::TooLong),
            // A pair whose distance cannot be computed counts as one that touches.
            None => Ok(0.0),
        }
    }

    /// Whether two bodies are to be kept apart: not if their links are excepted.
    fn is_kept_from(&self, other: &Swept, robot: &Robot) -> bool {
        !robot.model.is_excepted(self.link, other.link)
    }

    /// Minimum distance from another body at all positions of that body, at most `up_to`.
    fn nearest(&self, at: &Pose32, other: &Swept, up_to: f32, work: &mut Work) -> Result<f32, Crossing> {
        let mut nearest = up_to;
        for of in &other.places {
            if (at.translation - of.translation).length() - self.radius - other.radius < nearest {
                nearest = nearest.min(self.distance(at, other, of, nearest, work)?);
            }
        }
        Ok(nearest)
    }

    /// Whether any of its positions is nearer than `margin` to any position of another body.
    fn comes_to(&self, other: &Swept, margin: f32, work: &mut Work) -> Result<bool, Crossing> {
        let (Some(ours), Some(theirs)) = (self.tree.len().checked_sub(1), other.tree.len().checked_sub(1)) else {
            return Ok(false);
        };
        let mut left = vec![[ours, theirs]];
        while let Some([ours, theirs]) = left.pop() {
            let (a, b) = (&self.tree[ours], &other.tree[theirs]);
            let (at, of) = (&self.places[a.place], &other.places[b.place]);
            let around = margin + a.spread + b.spread;
            if (at.translation - of.translation).length() - self.radius - other.radius > around {
                continue;
            }
            let distance = self.distance(at, other, of, around, work)?;
            if distance < margin {
                return Ok(true);
            }
            if distance >= around {
                continue;
            }
            let split =
                if a.spread >= b.spread { a.halves.map(|halves| halves.map(|half| [half, theirs])) } else { None };
            let split = split.or(b.halves.map(|halves| halves.map(|half| [ours, half])));
            left.extend(split.into_iter().flatten());
        }
        Ok(false)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn here(robot: &Robot) -> Configuration {
        Configuration { arm: robot.posture("home").unwrap(), ..robot.at_zero() }
    }

    /// An arm that swings about its foot by `by` and back, `times` times, in `steps` steps each way.
    fn swings(robot: &Robot, by: f64, steps: u32, times: u32) -> Ahead {
        let from = robot.posture("home").unwrap();
        let at = |i: u32| {
            let passed = f64::from(i % (2 * steps)) / f64::from(steps);
            let mut joints = from;
            joints[0] += by * passed.min(2.0 - passed);
            ArmPosition { joints, finger: 0.0 }
        };
        Ahead {
            part: Part::Arm(0),
            links: robot.links_of(0),
            courses: vec![(0..2 * steps * times).map(at).collect()],
            beside_m: 0.0,
            between_m: 0.0,
        }
    }

    #[test]
    fn every_place_of_the_way_is_as_near_to_a_kept_one_as_is_said() {
        let robot = Robot::aimm();
        let ahead = swings(&robot, 0.4, 250, 1);
        let resolution = 0.008;
        let swept = swept(&robot, &here(&robot), &ahead, resolution);
        assert!(swept.len() > 7, "{}", swept.len());
        for body in &swept {
            assert!((2..200).contains(&body.places.len()), "{}", body.places.len());
            assert!(body.dropped <= resolution && body.leg < 0.01, "{} {}", body.dropped, body.leg);
            for at in &ahead.courses[0] {
                let poses = robot.poses(&Configuration { arm: at.joints, finger: at.finger, ..here(&robot) });
                let place = to_f32(&poses[body.link].compose(&body.in_link));
                let nearest = body.places.iter().map(|kept| body.moved(kept, &place)).fold(f32::INFINITY, f32::min);
                assert!(nearest <= body.missed(), "{nearest}");
            }
        }
    }

    #[test]
    fn a_way_to_and_fro_has_hardly_more_places_than_once() {
        let robot = Robot::aimm();
        let places = |times: u32| -> usize {
            let ahead = swings(&robot, 0.9, 250, times);
            swept(&robot, &here(&robot), &ahead, 0.008).iter().map(|body| body.places.len()).sum()
        };
        let [once, often] = [1, 20].map(places);
        assert!(often < 8 * once, "{once} {often}");
    }

    #[test]
    fn a_tree_finds_what_all_pairs_of_places_do() {
        let robot = Robot::aimm();
        let ahead = swings(&robot, 0.9, 60, 1);
        let swept = swept(&robot, &here(&robot), &ahead, 0.008);
        let mut found = [0, 0];
        let distance = |a: &Swept, at: &Pose32, b: &Swept, of: &Pose32| {
            a.distance(at, b, of, f32::MAX, &mut Work::WHOLE.clone()).unwrap()
        };
        for (i, a) in swept.iter().enumerate() {
            for b in &swept[..i] {
                for margin in [0.01, 0.05, 0.2] {
                    let nearest = a.places.iter().flat_map(|at| b.places.iter().map(|of| distance(a, at, b, of)));
                    let expected = nearest.fold(f32::INFINITY, f32::min) < margin;
                    assert_eq!(a.comes_to(b, margin, &mut Work::WHOLE.clone()), Ok(expected));
                    found[usize::from(expected)] += 1;
                }
            }
        }
        assert!(found.iter().all(|count| *count > 10), "{found:?}");
    }

    #[test]
    fn ways_beyond_the_bounds_are_given_up() {
        let robot = Robot::aimm();
        let short = swings(&robot, 0.4, 10, 1);
        let long = swings(&robot, 0.4, 250, u32::try_from(MAX_POSTURES / 500).unwrap());
        let compared = keep_apart(&robot, &here(&robot), &long, &short, Other::Moves);
        assert_eq!(compared, Err(Crossing::TooLong));
        let swept = swept(&robot, &here(&robot), &short, 0.008);
        for mut none in [Work { distances: 0, ..Work::WHOLE }, Work { searches: 0, ..Work::WHOLE }] {
            assert_eq!(swept[0].comes_to(&swept[1], 0.0, &mut none), Err(Crossing::TooLong));
        }
    }
}
