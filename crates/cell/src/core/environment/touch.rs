//! What touches what: every pair of bodies, the robot's links among each other and against furniture included.
//!
//! The bodies are those that the physics moves, where it has put them. How deep they are in each other is the judge's own answer (`overlap`): that of
//! the engine is off by up to centimetres where cylinders and capsules are deep in each other, and by millimetres where they hardly touch. Nothing of a
//! planner is asked. Two kinds of pairs are left out: those of which neither is a link or is carried, because the
//! robot does not decide what objects do to each other; and those that the robot is built to have in contact: links that hang on each
//! other, what touches in its home posture (a capsule's end reaches into the next link, the base stands on the floor), and links between
//! which a single joint decides (the flange and the link before the wrist): its limits keep them apart, not who plans. Two links that are told
//! apart by their meshes are looked at by those and by their primitives (`shell`): the bodies have spheres in place of the meshes, and the spheres of
//! such links nearly always meet.
//! What is shared with the planner: the reader of the robot's description and its forward kinematics.

use super::convex::Convex;
use super::overlap::{Meeting, meeting};
use super::shell::Shell;
use super::world::{Environment, FLOOR, LEVEL, TOUCH_M};
use rapier3d::math::{Pose as Pose32, Vector};
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::parry::shape::Shape;
use rapier3d::prelude::{Collider, ColliderHandle, RigidBody, RigidBodyHandle};
use ratn_model::pose::Pose;
use ratn_motion::robot::{Configuration, Drive, Geometry, Robot};
use ratn_motion::workplace::HOME;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// A body that can touch another.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Thing {
    /// A link of the robot.
    Link(String),
    /// The floor, or a piece of furniture.
    Fixed(String),
    /// An object.
    Object(usize),
}

/// Two bodies that touch, or are about to.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// Which; links before furniture before objects.
    pub things: [Thing; 2],
    /// How deep they are in each other, in metres; negative: how far apart, at most [`NEAR_M`].
    pub depth_m: f64,
    /// Where, in the world frame.
    pub at: [f64; 3],
    /// From the first to the second, where the first is pushed out: a unit vector of the world frame.
    pub normal: [f64; 3],
    /// How fast one moved as seen from the other there before they touched, in metres per second.
    pub speed_m_s: f64,
}

/// What is nearer than this is looked at, in metres.
pub const NEAR_M: f64 = 5e-4;

/// What counts as on an axis, in metres and as a sine.
const ALIGNED: f64 = 1e-9;

/// Which links may not be looked at together, by their indices in [`Robot::model`], and which stand on the floor.
#[derive(Debug, Clone, Default)]
pub(super) struct Joined {
    links: BTreeSet<[usize; 2]>,
    on_floor: BTreeSet<usize>,
    /// Those of them that are told apart by their own shapes, and may not touch.
    by_shells: Vec<[usize; 2]>,
    /// Of each link in such a pair.
    shells: BTreeMap<usize, Shell>,
}

impl Joined {
    /// Links that hang on each other, and what touches in the home posture.
    pub(super) fn of(robot: &Robot) -> Joined {
        let home = Configuration {
            arm: robot.posture(HOME).unwrap_or_else(|| robot.at_zero().arm),
            finger: robot.open_finger_m(),
            ..robot.at_zero()
        };
        // The other arms are in their postures `home` with open fingers, where the robot has them.
        let shapes = robot.shapes(&home);
        let mut joined = Joined::default();
        for (i, (a, pose_a, shape_a)) in shapes.iter().enumerate() {
            for (b, pose_b, shape_b) in &shapes[..i] {
                let touch = meeting(&convex(&**shape_a, pose_a), &convex(&**shape_b, pose_b), 0.0);
                if a == b || above(robot, *a) == Some(*b) || touch.is_some() || is_covered(robot, *a, *b) {
                    joined.links.insert([*b.min(a), *b.max(a)]);
                }
            }
            let next = above(robot, *a).and_then(|between| above(robot, between));
            if let Some(next) = next.filter(|_| turns_in_itself(robot, *a)) {
                joined.links.insert([next, *a]);
            }
            if shape_a.compute_aabb(pose_a).mins.z <= NEAR_M as f32 {
                joined.on_floor.insert(*a);
            }
        }
        joined.add_shells(robot, &robot.poses(&home));
        joined
    }

    /// Finds the links that are told apart by their own shapes, but those of which one hangs on the other, and what touches in a posture.
    fn add_shells(&mut self, robot: &Robot, poses: &[Pose]) {
        let links = &robot.model.links;
        let all = (0..links.len()).flat_map(|b| (0..b).map(move |a| [a, b]));
        let hang = |a: usize, b: usize| {
            let next = above(robot, b).filter(|_| turns_in_itself(robot, b)).and_then(|between| above(robot, between));
            above(robot, b) == Some(a) || next == Some(a)
        };
        for [a, b] in all.filter(|[a, b]| is_covered(robot, *a, *b) && !hang(*a, *b)) {
            for link in [a, b] {
                self.shells.entry(link).or_insert_with(|| Shell::of(&links[link]));
            }
            if self.shells[&a].meeting(poses[a], &self.shells[&b], poses[b], 0.0).is_none() {
                self.by_shells.push([a, b]);
            }
        }
    }

    fn has(&self, a: usize, b: usize) -> bool {
        a == b || self.links.contains(&[a.min(b), a.max(b)])
    }
}

/// Whether spheres that stand for meshes say nothing of two links.
fn is_covered(robot: &Robot, a: usize, b: usize) -> bool {
    robot.model.is_by_shapes(a, b) && [a, b].iter().any(|link| robot.model.links[*link].covers > 0)
}

/// The next link with a shape above another.
fn above(robot: &Robot, link: usize) -> Option<usize> {
    let mut parents = std::iter::successors(robot.model.links[link].parent, |parent| robot.model.links[*parent].parent);
    parents.find(|parent| !robot.model.links[*parent].bodies.is_empty())
}

/// Whether the joint of a link only turns it about its own axis: seen from elsewhere, it is where it was.
fn turns_in_itself(robot: &Robot, link: usize) -> bool {
    let Some(Drive { axis, slides: false, .. }) = robot.model.links[link].drive else { return false };
    let off = |v: [f64; 3]| {
        let along: f64 = (0..3).map(|i| v[i] * axis[i]).sum();
        (0..3).map(|i| (v[i] - along * axis[i]).powi(2)).sum::<f64>().sqrt() < ALIGNED
    };
    robot.model.links[link].bodies.iter().all(|body| {
        let round = match body.geometry {
            Geometry::Box { .. } => false,
            Geometry::Cylinder { .. } => off(body.pose.rotate([0.0, 1.0, 0.0])),
            Geometry::Capsule { .. } => off(body.pose.rotate([0.0, 0.0, 1.0])),
            Geometry::Sphere { .. } => true,
        };
        round && off(body.pose.position)
    })
}

/// How a body moves.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Speed {
    middle: Vector,
    along: Vector,
    about: Vector,
}

impl Speed {
    /// Of a body, now.
    pub(super) fn of(body: &RigidBody) -> Speed {
        Speed { middle: body.center_of_mass(), along: body.linvel(), about: body.angvel() }
    }

    fn at(&self, point: Vector) -> Vector {
        self.along + self.about.cross(point - self.middle)
    }
}

/// A collider as one of the pair.
struct Part<'a> {
    collider: &'a Collider,
    speed: Speed,
    place: Pose32,
    aabb: Aabb,
}

impl Part<'_> {
    fn convex(&self) -> Convex {
        convex(self.collider.shape(), &self.place)
    }
}

/// A shape of a body in its place.
pub(super) fn convex(shape: &dyn Shape, place: &Pose32) -> Convex {
    #[expect(clippy::expect_used, reason = "links, furniture and objects have no other shapes: `Geometry::shape`")]
    Convex::of(shape, place).expect("bodies are made of balls, boxes, cylinders and capsules")
}

impl Environment {
    /// What touches what, after the last step: all pairs of a link, or of a carried object, with anything else, but those that the robot
    /// is built to have in contact. Of two bodies the deepest place.
    pub fn touches(&self) -> Vec<Touch> {
        let links: Vec<(usize, Part<'_>)> = self.link_colliders().map(|(link, c)| (link, self.part(c))).collect();
        let fixed: Vec<(&str, Part<'_>)> = self.fixed_colliders().map(|(name, c)| (name, self.part(c))).collect();
        let objects: Vec<Vec<Part<'_>>> =
            (0..self.len()).map(|i| self.object_colliders(i).map(|c| self.part(c)).collect()).collect();
        let around = |parts: &[Part<'_>]| parts.iter().map(|part| part.aabb).reduce(|a, b| a.merged(&b));
        let around: Vec<Option<Aabb>> = objects.iter().map(|parts| around(parts)).collect();
        let near = |part: &Part<'_>, object: usize| around[object].is_some_and(|aabb| aabb.intersects(&part.aabb));

        let mut found: Vec<Touch> = self.touches_of_shells().collect();
        let mut look = |a: &Part<'_>, b: &Part<'_>, things: &dyn Fn() -> [Thing; 2]| {
            if a.aabb.intersects(&b.aabb) {
                found.extend(touch(a, b).map(|touch| Touch { things: things(), ..touch }));
            }
        };
        for (i, (link, part)) in links.iter().enumerate() {
            let name = || Thing::Link(self.link_name(*link).to_owned());
            for (other, its) in &links[..i] {
                if !self.joined().has(*link, *other) {
                    look(its, part, &|| [Thing::Link(self.link_name(*other).to_owned()), name()]);
                }
            }
            for (other, its) in &fixed {
                if *other != FLOOR || !self.joined().on_floor.contains(link) {
                    look(part, its, &|| [name(), Thing::Fixed((*other).to_owned())]);
                }
            }
            for (object, parts) in objects.iter().enumerate().filter(|(object, _)| near(part, *object)) {
                parts.iter().for_each(|its| look(part, its, &|| [name(), Thing::Object(object)]));
            }
        }
        for (carried, parts) in objects.iter().enumerate().filter(|(object, _)| self.state(*object).carried) {
            for part in parts {
                for (other, its) in &fixed {
                    look(its, part, &|| [Thing::Fixed((*other).to_owned()), Thing::Object(carried)]);
                }
                for (other, its) in objects.iter().enumerate().filter(|(other, _)| *other != carried) {
                    if near(part, other) {
                        its.iter().for_each(|one| look(one, part, &|| [Thing::Object(other), Thing::Object(carried)]));
                    }
                }
            }
        }
        deepest(found)
    }

    /// Which links touch of those that are told apart by their own shapes.
    fn touches_of_shells(&self) -> impl Iterator<Item = Touch> {
        let Joined { by_shells, shells, .. } = self.joined();
        by_shells.iter().filter_map(|pair| {
            let [at, its] = pair.map(|link| self.link_pose(link));
            let met = shells[&pair[0]].meeting(at, &shells[&pair[1]], its, NEAR_M)?;
            let speeds = pair.map(|link| self.link_body(link).map(Speed::of).unwrap_or_default());
            let things = pair.map(|link| Thing::Link(self.link_name(link).to_owned()));
            Some(Touch { things, ..touched(&met, speeds) })
        })
    }

    /// What an object stands on: all that touches it from below.
    pub fn supports_of(&self, object: usize) -> Vec<Thing> {
        let mine: Vec<Part<'_>> = self.object_colliders(object).map(|c| self.part(c)).collect();
        let link = |(link, c)| (Thing::Link(self.link_name(link).to_owned()), c);
        let fixed = |(name, c): (&str, _)| (Thing::Fixed(name.to_owned()), c);
        let others = (0..self.len()).filter(|other| *other != object);
        let others = others.flat_map(|other| self.object_colliders(other).map(move |c| (Thing::Object(other), c)));
        let all = self.link_colliders().map(link).chain(self.fixed_colliders().map(fixed)).chain(others);
        let bears = |(_, collider): &(Thing, ColliderHandle)| {
            let below = self.part(*collider);
            let is_above = |part: &Part<'_>| {
                let found = meeting(&below.convex(), &part.convex(), TOUCH_M);
                found.is_some_and(|found| found.normal.0[2] >= LEVEL)
            };
            mine.iter().any(is_above)
        };
        let mut found: Vec<Thing> = all.filter(bears).map(|(thing, _)| thing).collect();
        found.dedup();
        found
    }

    fn part<'a>(&'a self, collider: ColliderHandle) -> Part<'a> {
        let (collider, body, place) = self.placed(collider);
        // What the step did to an object is what the contact did to it.
        let of_it = |(body, _): &&(RigidBodyHandle, Speed)| collider.parent() == Some(*body);
        let before = self.speeds_before.iter().find(of_it).map(|(_, speed)| *speed);
        let speed = before.or(body.map(Speed::of)).unwrap_or_default();
        let aabb = collider.shape().compute_aabb(&place).loosened(NEAR_M as f32);
        Part { collider, speed, place, aabb }
    }
}

/// Where two parts touch.
fn touch(a: &Part<'_>, b: &Part<'_>) -> Option<Touch> {
    Some(touched(&meeting(&a.convex(), &b.convex(), NEAR_M)?, [a.speed, b.speed]))
}

/// The same of what moves so.
fn touched(met: &Meeting, speeds: [Speed; 2]) -> Touch {
    let at = Vector::from_array(met.at.0.map(|c| c as f32));
    let [va, vb] = speeds.map(|speed| speed.at(at));
    Touch {
        things: [Thing::Object(0), Thing::Object(0)],
        depth_m: met.depth_m,
        at: met.at.0,
        normal: met.normal.0,
        speed_m_s: f64::from((va - vb).length()),
    }
}

/// One touch of each two things.
fn deepest(mut found: Vec<Touch>) -> Vec<Touch> {
    found.sort_by(|a, b| a.things.cmp(&b.things).then(b.depth_m.total_cmp(&a.depth_m)));
    found.dedup_by(|later, first| later.things == first.things);
    found
}
