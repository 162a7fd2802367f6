//! Whether the links of two parts of the robot (arms, its head) keep a distance from each other, wherever both are on their ways.
//!
//! Either part may be stopped anywhere on its way: its goal is cancelled, its lease ends, a fault brakes it. So the ways are compared whatever
//! the timing: every place of the one with every place of the other. Controllers know the robot's links, not what stands around them; so what
//! the hands hold is not looked at here, the judge sees that (`contacts`).
//!
//! The comparison runs on the cell's only thread, where an emergency stop waits for its end. So its work is bounded. Of two ways, places that one
//! comes to again are kept once, and the places of a body form a binary tree of which whole branches are ruled out by one distance. Beside a
//! part that stands, postures are passed over as long as no joint has moved anything by as much as there was room (conservative advancement,
//! Mirtich 1996). A comparison that takes more than [`MAX_POSTURES`], [`MAX_DISTANCES`] or [`MAX_SEARCHES`] is given up ([`Crossing::TooLong`]).

use super::levers::Levers;
use rapier3d::math::Pose as Pose32;
use rapier3d::parry::shape::SharedShape;
use ratn_model::pose::Pose;
use ratn_motion::distance::gap_within;
use ratn_motion::robot::{ArmPosition, Configuration, Joint, Robot, to_f32};
use std::collections::BTreeMap;

/// The distance of two parts that are both on their ways, in metres.
pub(super) const APART_M: f64 = 0.02;
/// The distance of a part on its way from one that stands, in metres: more than controllers and encoders are off.
pub(super) const BESIDE_M: f64 = 0.003;
/// How much nearer than at its start something may come to a part that it is too near to already, in metres: rounding.
const ROUNDED_M: f32 = 3e-4;
/// The most postures of two parts on their ways that are compared. A motion of 10 s has 2500, for each place of the fingers. Ways that are longer
/// are thinned before (`levers`), so that this is a bound of how far a part goes and not of how long it takes.
pub(super) const MAX_POSTURES: usize = 40_000;
/// The most distances of two bodies that are computed for one comparison.
const MAX_DISTANCES: u32 = 200_000;
/// The most searches of these: where a body is a mesh, each of its triangles that is near the other body takes one, which is some microsecond.
const MAX_SEARCHES: u32 = 1_000_000;
/// Of places on two ways that are nearer to each other than that one is kept, in metres: it is added to the distance on either side.
const RESOLUTION_M: f32 = 0.008;
/// The same of a part that stands; of an arm the fingers alone may move.
const FINE_M: f32 = 1e-4;

/// A part of the robot that moves beside others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    /// The arm of this number, with its fingers.
    Arm(usize),
    /// The camera's head. Its joints are pan and tilt, and it has no fingers.
    Head,
}

/// What of its bounds a comparison has left.
#[derive(Debug, Clone)]
struct Work {
    distances: u32,
    searches: u32,
}

/// What a part, or the fingers of an arm alone, will do.
#[derive(Debug, Clone)]
pub(super) struct Ahead {
    pub(super) part: Part,
    /// The links that are compared: all that move.
    pub(super) links: Vec<usize>,
    /// Courses that it may take: of each the positions, near each other, in the order of time.
    pub(super) courses: Vec<Vec<ArmPosition>>,
    /// How far anything may be beside the nearest position, in metres: positions stand for those that are left out.
    pub(super) beside_m: f64,
    /// How far fingers may be beside the nearest course besides, in metres: courses stand for what is between them.
    pub(super) between_m: f64,
}

/// What the other part does meanwhile, which says how far apart both have to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Other {
    /// It is on its way: [`APART_M`].
    Moves,
    /// It stands: [`BESIDE_M`]. What is nearer than that already may go away, and come no nearer.
    Stands,
}

/// Why two ways are not free.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Crossing {
    /// A link of each comes too close to the other.
    TooClose {
        /// Of the part that is asked about.
        link: String,
        /// Of the other one.
        other: String,
    },
    /// They are too long, or too near to each other for too long, to be compared.
    TooLong,
}

/// One body of a link, wherever it is on the way.
struct Swept {
    link: usize,
    in_link: Pose,
    shape: SharedShape,
    /// The farthest that a point of it is from its origin.
    radius: f32,
    places: Vec<Pose32>,
    /// The places as the leaves of a binary tree, its root last.
    tree: Vec<Branch>,
    /// The farthest that a point moves from one posture to the next.
    leg: f32,
    /// The farthest that a point is from where it is at the place that was kept instead.
    dropped: f32,
}

/// Some of the places of a body that follow each other.
struct Branch {
    /// One of them.
    place: usize,
    /// The farthest that a point of the body is at any of them from where it is at that one.
    spread: f32,
    halves: Option<[usize; 2]>,
}

/// Which places of a body are kept.
struct Kept {
    /// By their rounded coordinates.
    known: BTreeMap<[i32; 7], Pose32>,
    /// The one that stands for the last posture.
    last: Option<Pose32>,
    /// The place at the posture before.
    before: Option<Pose32>,
}

impl Other {
    /// How far from the other part to stay, in metres.
    pub(super) fn apart_m(self) -> f64 {
        match self {
            Other::Moves => APART_M,
            Other::Stands => BESIDE_M,
        }
    }
}

/// Whether what moves stays away from another part, of a robot that is elsewhere as in `here`.
///
/// # Errors
/// [`Crossing`] where it does not, or where that is not found out.
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

/// Whether two ways keep [`APART_M`] from each other.
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

/// Whether a way keeps [`BESIDE_M`] from a part that stands. A body that is nearer as it sets out may come no nearer, and a finger of which only
/// some courses are compared has to be as far away as they are from each other.
fn stays_beside(robot: &Robot, here: &Configuration, ours: &Ahead, theirs: &Ahead) -> Result<(), Crossing> {
    let (bodies, others) = (Swept::all(robot, ours), swept(robot, here, theirs, FINE_M));
    let levers = ours.levers(robot);
    let between = ours.between_courses(robot);
    let (mut work, mut configuration) = (Work::WHOLE, *here);
    for course in &ours.courses {
        // How near each pair may come, once it is known how near it is at the start; and whether that is nearer than it should be.
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
                        // Once it has been far enough away it comes back as any other.
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

/// The bodies of a part's links wherever they come to.
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
    /// Brings the part to a position.
    fn put(self, at: &ArmPosition, configuration: &mut Configuration) {
        match self {
            Part::Arm(arm) => {
                configuration.set_joints(arm, at.joints);
                configuration.set_finger(arm, at.finger);
            }
            Part::Head => [configuration.pan, configuration.tilt] = [at.joints[0], at.joints[1]],
        }
    }

    pub(super) fn joints(self, robot: &Robot) -> &[Joint] {
        match self {
            Part::Arm(arm) => robot.joints_of(arm),
            Part::Head => robot.head_joints(),
        }
    }

    pub(super) fn finger_links(self, robot: &Robot) -> Vec<usize> {
        match self {
            Part::Arm(arm) => robot.finger_links_of(arm),
            Part::Head => Vec::new(),
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

    /// How far a point of a link may be beside the nearest course: only fingers are elsewhere from one to the next.
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
    /// The bodies of the links that are compared, nowhere yet.
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

    /// The farthest that a point of the body is at one place from where it is at another.
    fn moved(&self, from: &Pose32, to: &Pose32) -> f32 {
        let [x, y, z, _] = (from.rotation.inverse() * to.rotation).to_array();
        // The sine of half the angle: a point turns by a chord of twice that.
        let sine = (x * x + y * y + z * z).sqrt();
        (to.translation - from.translation).length() + 2.0 * self.radius * sine
    }

    /// The body comes to a place.
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

    /// Coordinates that two places have in common only where no point of the body is farther apart than the resolution: half of it is for
    /// the translation and half for the rotation.
    fn rounded(&self, place: &Pose32, resolution: f32) -> [i32; 7] {
        let along = resolution / (2.0 * 3_f32.sqrt());
        let about = resolution / (8.0 * self.radius.max(1e-3));
        let [x, y, z] = place.translation.to_array().map(|c| (c / along).floor() as i32);
        // A rotation has two quaternions.
        let sign = if place.rotation.to_array()[3] < 0.0 { -1.0 } else { 1.0 };
        let [i, j, k, w] = place.rotation.to_array().map(|c| (sign * c / about).floor() as i32);
        [x, y, z, i, j, k, w]
    }

    /// How far a point of the body may be, anywhere on the way, from where it is at the nearest place that was kept.
    fn missed(&self) -> f32 {
        self.dropped + self.leg / 2.0
    }

    /// Makes a branch of the places `from..to`.
    fn grow(&mut self, from: usize, to: usize) -> usize {
        let place = usize::midpoint(from, to);
        let spread = self.places[from..to].iter().map(|at| self.moved(&self.places[place], at)).fold(0.0_f32, f32::max);
        let halves = (to - from > 1).then(|| [self.grow(from, place), self.grow(place, to)]);
        self.tree.push(Branch { place, spread, halves });
        self.tree.len() - 1
    }

    /// How far it is at a place from another body at one, or something greater than `enough` where that is more.
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

    /// Whether two bodies are to be kept apart: not where their links are excepted.
    fn is_kept_from(&self, other: &Swept, robot: &Robot) -> bool {
        !robot.model.is_excepted(self.link, other.link)
    }

    /// How far it is from another body at the places of that one, or `up_to` where that is less.
    fn nearest(&self, at: &Pose32, other: &Swept, up_to: f32, work: &mut Work) -> Result<f32, Crossing> {
        let mut nearest = up_to;
        for of in &other.places {
            if (at.translation - of.translation).length() - self.radius - other.radius < nearest {
                nearest = nearest.min(self.distance(at, other, of, nearest, work)?);
            }
        }
        Ok(nearest)
    }

    /// Whether any of its places is nearer than `margin` to any place of another body.
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

    /// The arm swings about its foot by so much and back, so many times; each way takes so many steps.
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
