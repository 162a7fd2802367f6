//! What touches what: every pair of bodies, the robot's links among each other and against furniture included.
//!
//! The bodies are those that the physics moves, where it has put them. How deep they are in each other is the judge's own answer (`overlap`): that of
//! the engine is off by up to centimetres where cylinders and capsules are deep in each other, and by millimetres where they hardly touch. Nothing of a
//! planner is asked. Two kinds of pairs are left out: those of which neither is a link or is carried, because the
//! robot does not decide what objects do to each other; and those that the robot is built to have in contact: links that hang on each
//! other, what touches in its home posture (a capsule's end reaches into the next link, the base stands on the floor), and links between
//! which a single joint decides (the flange and the link before the wrist): its limits keep them apart, not who plans. A link with meshes is looked at by
//! its primitives and by the meshes as they are (`shell`), not by the convex pieces that the engine has for them.
//!
//! Each step looks: first whether the boxes around links, pieces of furniture and objects meet, then, of two that do, at those of their parts that are in the
//! other's box.
//! What is shared with the planner: the reader of the robot's description and its forward kinematics.

use super::convex::Convex;
use super::overlap::{Meeting, meeting};
use super::shell::Surface;
use super::world::{Environment, FLOOR, LEVEL, Support, TOUCH_M};
use rapier3d::math::{Pose as Pose32, Vector};
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::parry::shape::Shape;
use rapier3d::prelude::{ColliderHandle, RigidBody, RigidBodyHandle};
use ratn_model::pose::Pose;
use ratn_motion::robot::{Body, Configuration, Drive, Geometry, Link, Robot, to_f32};
use ratn_motion::workplace::HOME;
use serde::{Deserialize, Serialize};
use std::cell::OnceCell;
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

/// By how much more than [`NEAR_M`] the box around a link is larger, in metres: where bodies are is rounded otherwise than where their link is.
const ROUNDED_M: f32 = 1e-4;

/// Which links are looked at together, by their indices in [`Robot::model`], and which stand on the floor.
#[derive(Debug, Clone, Default)]
pub(super) struct Joined {
    /// Pairs of links with shapes, the lower index first, but those that are made to touch.
    apart: Vec<[usize; 2]>,
    on_floor: BTreeSet<usize>,
    /// The box around all shapes of each link that has some, in its own frame.
    boxes: BTreeMap<usize, Aabb>,
    /// The meshes of each link that has some.
    surfaces: BTreeMap<usize, Vec<Surface>>,
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
        let poses = robot.poses(&home);
        let mut joined = Joined { boxes: boxes(robot), ..Joined::default() };
        for (index, link) in robot.model.links.iter().enumerate().filter(|(_, link)| !link.meshes.is_empty()) {
            joined.surfaces.insert(index, link.meshes.iter().map(Surface::of).collect());
        }
        let with_shapes: Vec<usize> = joined.boxes.keys().copied().collect();
        let links: Vec<Vec<Shaped<'_>>> =
            with_shapes.iter().map(|link| joined.shaped(robot, *link, &poses[*link])).collect();
        let (mut apart, mut on_floor) = (Vec::new(), BTreeSet::new());
        for (i, of_b) in links.iter().enumerate() {
            let b = with_shapes[i];
            let before = with_shapes[..i].iter().zip(&links);
            let before = before.filter(|(a, of_a)| !hangs(robot, **a, b) && !do_meet(of_a, of_b));
            apart.extend(before.map(|(a, _)| [*a, b]));
            if of_b.iter().any(|shaped| shaped.aabb.mins.z <= NEAR_M as f32) {
                on_floor.insert(b);
            }
        }
        Joined { apart, on_floor, ..joined }
    }

    /// The meshes of a link.
    pub(super) fn surfaces(&self, link: usize) -> &[Surface] {
        self.surfaces.get(&link).map_or(&[], |surfaces| surfaces)
    }

    /// The shapes of a link in its place.
    fn shaped(&self, robot: &Robot, link: usize, pose: &Pose) -> Vec<Shaped<'_>> {
        let primitives = robot.model.links[link].own_bodies().iter().map(|body| {
            let (shape, place) = (body.geometry.shape(0.0), to_f32(&pose.compose(&body.pose)));
            Shaped { form: Form::Convex(convex(&*shape, &place)), aabb: shape.compute_aabb(&place) }
        });
        let meshes = self.surfaces(link).iter();
        let meshes = meshes.map(|surface| Shaped { form: Form::Surface(surface, *pose), aabb: surface.extent(pose) });
        primitives.chain(meshes).collect()
    }
}

/// A shape in its place.
#[derive(Clone, Copy)]
enum Form<'s> {
    Convex(Convex),
    /// A mesh of a link that is there.
    Surface(&'s Surface, Pose),
}

/// The same, with the box around it.
struct Shaped<'s> {
    form: Form<'s>,
    aabb: Aabb,
}

impl Form<'_> {
    /// How it meets another shape, if they are no farther apart than `within_m` metres, or, where that is below 0, at least so deep in each other.
    fn meeting(&self, other: &Form<'_>, within_m: f64) -> Option<Meeting> {
        match (self, other) {
            (Form::Convex(a), Form::Convex(b)) => meeting(a, b, within_m),
            (Form::Surface(a, at), Form::Convex(b)) => a.meeting(*at, b, within_m),
            (Form::Convex(a), Form::Surface(b, at)) => b.meeting(*at, a, within_m).map(Meeting::turned),
            (Form::Surface(a, at), Form::Surface(b, its)) => a.meeting_surface(*at, b, *its, within_m),
        }
    }
}

/// Whether two links touch.
fn do_meet(of_a: &[Shaped<'_>], of_b: &[Shaped<'_>]) -> bool {
    let mut pairs = of_a.iter().flat_map(|a| of_b.iter().map(move |b| (a, b)));
    let touch = |a: &Shaped<'_>, b: &Shaped<'_>| b.form.meeting(&a.form, 0.0).is_some();
    pairs.any(|(a, b)| a.aabb.loosened(NEAR_M as f32).intersects(&b.aabb) && touch(a, b))
}

/// Whether a link is made to touch one before it: it hangs on that, or its joint only turns it about itself and the link between hangs on that.
fn hangs(robot: &Robot, on: usize, link: usize) -> bool {
    let next = above(robot, link).filter(|_| turns_in_itself(robot, link)).and_then(|between| above(robot, between));
    above(robot, link) == Some(on) || next == Some(on)
}

/// The box around the shapes of each link that has some, in its own frame.
fn boxes(robot: &Robot) -> BTreeMap<usize, Aabb> {
    let around = |link: &Link| {
        let primitives = link.own_bodies().iter();
        let primitives = primitives.map(|body| body.geometry.shape(0.0).compute_aabb(&to_f32(&body.pose)));
        let meshes = link.meshes.iter().map(|meshed| meshed.mesh.surface().compute_aabb(&to_f32(&meshed.pose)));
        primitives.chain(meshes).reduce(|a, b| a.merged(&b))
    };
    robot.model.links.iter().enumerate().filter_map(|(i, link)| Some((i, around(link)?))).collect()
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
    let link = &robot.model.links[link];
    let is_round = |body: &Body| {
        let round = match body.geometry {
            Geometry::Box { .. } => false,
            Geometry::Cylinder { .. } => off(body.pose.rotate([0.0, 1.0, 0.0])),
            Geometry::Capsule { .. } => off(body.pose.rotate([0.0, 0.0, 1.0])),
            Geometry::Sphere { .. } => true,
        };
        round && off(body.pose.position)
    };
    link.meshes.is_empty() && link.own_bodies().iter().all(is_round)
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

/// What is a link, a piece of furniture or an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of<'a> {
    Link(usize),
    Fixed(&'a str),
    Object(usize),
}

/// The parts of one thing, placed when they are asked for.
struct Group<'a> {
    environment: &'a Environment,
    of: Of<'a>,
    /// Holds all of them and what is near.
    room: Aabb,
    parts: OnceCell<Parts<'a>>,
}

struct Parts<'a> {
    all: Vec<Part<'a>>,
    around: Aabb,
}

/// All things that can touch; links by their indices.
struct Groups<'a> {
    links: BTreeMap<usize, Group<'a>>,
    fixed: Vec<Group<'a>>,
    objects: Vec<Group<'a>>,
}

/// Two colliders that may touch: each is in the box around the thing that the other belongs to.
struct Candidate<'g, 'a> {
    of: [Of<'a>; 2],
    parts: [&'g Part<'a>; 2],
}

impl<'a> Group<'a> {
    /// A link, by the box that moves with it.
    fn link(environment: &'a Environment, link: usize) -> Option<Group<'a>> {
        let own = environment.joined().boxes.get(&link)?;
        let room = own.transform_by(&to_f32(&environment.link_pose(link))).loosened(NEAR_M as f32 + ROUNDED_M);
        Some(Group { environment, of: Of::Link(link), room, parts: OnceCell::new() })
    }

    /// Something of few shapes.
    fn placed(environment: &'a Environment, of: Of<'a>, colliders: Vec<ColliderHandle>) -> Option<Group<'a>> {
        let all = colliders.into_iter().map(|collider| environment.part(collider)).collect();
        let parts = Parts::of(all)?;
        Some(Group { environment, of, room: parts.around, parts: OnceCell::from(parts) })
    }

    fn parts(&self) -> Option<&Parts<'a>> {
        if let Some(parts) = self.parts.get() {
            return Some(parts);
        }
        let Of::Link(link) = self.of else { return None };
        let parts = Parts::of(self.environment.link_parts(link))?;
        Some(self.parts.get_or_init(|| parts))
    }

    /// The pairs of a part of this and one of the other that may touch, in the order of the parts.
    fn pairs<'g>(&'g self, other: &'g Group<'a>) -> impl Iterator<Item = [&'g Part<'a>; 2]> {
        let do_meet = |a: &Aabb, b: &Aabb| a.intersects(b);
        let near = do_meet(&self.room, &other.room).then(|| Some([self.parts()?, other.parts()?])).flatten();
        near.filter(|[mine, its]| do_meet(&mine.around, &its.around)).into_iter().flat_map(move |[mine, its]| {
            let within = |parts: &'g Parts<'a>, around: &Aabb| -> Vec<&'g Part<'a>> {
                parts.all.iter().filter(|part| do_meet(&part.aabb, around)).collect()
            };
            let (mine, its) = (within(mine, &its.around), within(its, &mine.around));
            mine.into_iter().flat_map(move |a| its.clone().into_iter().map(move |b| [a, b]))
        })
    }
}

impl<'a> Parts<'a> {
    fn of(all: Vec<Part<'a>>) -> Option<Parts<'a>> {
        let around = all.iter().map(|part| part.aabb).reduce(|a, b| a.merged(&b))?;
        Some(Parts { all, around })
    }
}

/// Colliders that come one after another of what is the same thing.
fn grouped<K: PartialEq>(colliders: impl Iterator<Item = (K, ColliderHandle)>) -> Vec<(K, Vec<ColliderHandle>)> {
    let mut groups: Vec<(K, Vec<ColliderHandle>)> = Vec::new();
    for (of, collider) in colliders {
        match groups.last_mut() {
            Some((last, group)) if *last == of => group.push(collider),
            _ => groups.push((of, vec![collider])),
        }
    }
    groups
}

/// A shape as one of the pair.
struct Part<'a> {
    form: Form<'a>,
    speed: Speed,
    aabb: Aabb,
}

/// A shape of a body in its place.
fn convex(shape: &dyn Shape, place: &Pose32) -> Convex {
    #[expect(
        clippy::expect_used,
        reason = "furniture, objects and the primitives of links have no other shapes: `Geometry::shape`"
    )]
    Convex::of(shape, place).expect("bodies are made of balls, boxes, cylinders and capsules")
}

impl Environment {
    /// What touches what, after the last step: all pairs of a link, or of a carried object, with anything else, but those that the robot
    /// is built to have in contact. Of two bodies the deepest place.
    pub fn touches(&self) -> Vec<Touch> {
        let groups = self.groups();
        let mut found: Vec<Touch> = Vec::new();
        let mut deepest_yet: Option<([Of<'_>; 2], f64)> = None;
        for Candidate { of, parts: [a, b] } in self.candidates(&groups) {
            // Of two things the deepest place counts: what is less deep than another one of them need not be known.
            let within_m = deepest_yet.filter(|(of_it, _)| *of_it == of).map_or(NEAR_M, |(_, depth_m)| -depth_m);
            let Some(touch) = a.aabb.intersects(&b.aabb).then(|| touch(a, b, within_m)).flatten() else { continue };
            deepest_yet = Some((of, touch.depth_m));
            found.push(Touch { things: of.map(|of| self.thing(of)), ..touch });
        }
        deepest(found)
    }

    fn thing(&self, of: Of<'_>) -> Thing {
        match of {
            Of::Link(link) => Thing::Link(self.link_name(link).to_owned()),
            Of::Fixed(name) => Thing::Fixed(name.to_owned()),
            Of::Object(object) => Thing::Object(object),
        }
    }

    /// All that can touch, where it is after the last step.
    fn groups(&self) -> Groups<'_> {
        let links = self.joined().boxes.keys().filter_map(|link| Some((*link, Group::link(self, *link)?))).collect();
        let fixed = grouped(self.fixed_colliders()).into_iter();
        let fixed = fixed.filter_map(|(name, colliders)| Group::placed(self, Of::Fixed(name), colliders)).collect();
        let object = |object| Group::placed(self, Of::Object(object), self.object_colliders(object).collect());
        Groups { links, fixed, objects: (0..self.len()).filter_map(object).collect() }
    }

    /// The pairs of colliders that have to be looked at.
    fn candidates<'g, 'a>(&'a self, groups: &'g Groups<'a>) -> Vec<Candidate<'g, 'a>> {
        let mut found = Vec::new();
        // The parts of the first are gone through one by one; `turned` names the second before it.
        let mut look = |first: &'g Group<'a>, second: &'g Group<'a>, turned: bool| {
            let candidate = |[a, b]: [&'g Part<'a>; 2]| match turned {
                true => Candidate { of: [second.of, first.of], parts: [b, a] },
                false => Candidate { of: [first.of, second.of], parts: [a, b] },
            };
            found.extend(first.pairs(second).map(candidate));
        };
        let Groups { links, fixed, objects } = groups;
        for [a, b] in &self.joined().apart {
            if let (Some(a), Some(b)) = (links.get(a), links.get(b)) {
                look(b, a, true);
            }
        }
        for (index, link) in links {
            let stands = self.joined().on_floor.contains(index);
            let is_floor = |group: &Group<'_>| matches!(group.of, Of::Fixed(FLOOR));
            let fixed = fixed.iter().filter(|piece| !(stands && is_floor(piece)));
            fixed.chain(objects).for_each(|other| look(link, other, false));
        }
        let is_carried = |group: &&Group<'_>| matches!(group.of, Of::Object(object) if self.state(object).carried);
        for (at, carried) in objects.iter().enumerate().filter(|(_, object)| is_carried(object)) {
            let others = objects.iter().enumerate().filter(|(other, _)| *other != at).map(|(_, other)| other);
            fixed.iter().chain(others).for_each(|other| look(carried, other, true));
        }
        found
    }

    /// What an object stands on: all that touches it from below.
    pub fn supports_of(&self, object: usize) -> Vec<Thing> {
        let mine: Vec<Part<'_>> = self.object_colliders(object).map(|c| self.part(c)).collect();
        let all = self.links_beside().chain(self.fixed_beside()).chain(self.objects_beside(object));
        let bears = |(_, below): &(Of<'_>, Part<'_>)| mine.iter().any(|part| bears(below, part).is_some());
        let mut found: Vec<Thing> = all.filter(bears).map(|(of, _)| self.thing(of)).collect();
        found.dedup();
        found
    }

    /// On what an object rests: the deepest level contact. `None` in the air.
    pub fn rests_on(&self, object: usize) -> Option<Support<'_>> {
        let mine: Vec<Part<'_>> = self.object_colliders(object).map(|c| self.part(c)).collect();
        let mut best: Option<(f64, Of<'_>)> = None;
        for (of, below) in self.fixed_beside().chain(self.links_beside()).chain(self.objects_beside(object)) {
            for depth_m in mine.iter().filter_map(|part| bears(&below, part)) {
                if best.is_none_or(|(deepest, _)| depth_m > deepest) {
                    best = Some((depth_m, of));
                }
            }
        }
        best.map(|(_, of)| match of {
            Of::Link(link) => Support::Named(self.link_name(link)),
            Of::Fixed(name) => Support::Named(name),
            Of::Object(other) => Support::Object(other),
        })
    }

    /// The parts of all links.
    fn links_beside(&self) -> impl Iterator<Item = (Of<'_>, Part<'_>)> {
        let links = self.joined().boxes.keys();
        links.flat_map(|link| self.link_parts(*link).into_iter().map(|part| (Of::Link(*link), part)))
    }

    /// Those of floor and furniture.
    fn fixed_beside(&self) -> impl Iterator<Item = (Of<'_>, Part<'_>)> {
        self.fixed_colliders().map(|(name, collider)| (Of::Fixed(name), self.part(collider)))
    }

    /// Those of all objects but one.
    fn objects_beside(&self, object: usize) -> impl Iterator<Item = (Of<'_>, Part<'_>)> {
        let others = (0..self.len()).filter(move |other| *other != object);
        others.flat_map(move |other| self.object_colliders(other).map(move |c| (Of::Object(other), self.part(c))))
    }

    /// The primitives of a link, and its meshes.
    fn link_parts(&self, link: usize) -> Vec<Part<'_>> {
        let primitives = self.link_colliders(link).map(|collider| self.part(collider));
        let (pose, speed) = (self.link_pose(link), self.link_body(link).map(Speed::of).unwrap_or_default());
        let meshes = self.joined().surfaces(link).iter().map(|surface| Part {
            form: Form::Surface(surface, pose),
            speed,
            aabb: surface.extent(&pose).loosened(NEAR_M as f32),
        });
        primitives.chain(meshes).collect()
    }

    fn part(&self, collider: ColliderHandle) -> Part<'_> {
        let (collider, body, place) = self.placed(collider);
        // What the step did to an object is what the contact did to it.
        let of_it = |(body, _): &&(RigidBodyHandle, Speed)| collider.parent() == Some(*body);
        let before = self.speeds_before.iter().find(of_it).map(|(_, speed)| *speed);
        let speed = before.or(body.map(Speed::of)).unwrap_or_default();
        let aabb = collider.shape().compute_aabb(&place).loosened(NEAR_M as f32);
        Part { form: Form::Convex(convex(collider.shape(), &place)), speed, aabb }
    }
}

/// How deep something that is above is in what bears it; `None` where it does not.
fn bears(below: &Part<'_>, above: &Part<'_>) -> Option<f64> {
    let met = below.form.meeting(&above.form, TOUCH_M)?;
    (met.normal.0[2] >= LEVEL).then_some(met.depth_m)
}

/// Where two parts touch, if they are no farther apart than `within_m` metres, or, where that is below 0, at least so deep in each other.
fn touch(a: &Part<'_>, b: &Part<'_>, within_m: f64) -> Option<Touch> {
    Some(touched(&a.form.meeting(&b.form, within_m)?, [a.speed, b.speed]))
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_motion::description::RobotDescription;
    use ratn_motion::joint_vector::JointVector;

    /// Links of an arm that are cubes.
    const CUBES: usize = 6;

    /// An arm of cubes, which are meshes, one 0.2 m beyond the other; each turns about the upright.
    fn cubes() -> Robot {
        let corner = |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { -0.05 } else { 0.05 });
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let facet = |triangle: [usize; 3]| {
            let corners: String =
                triangle.into_iter().map(corner).map(|[x, y, z]| format!("vertex {x} {y} {z}\n")).collect();
            format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
        };
        let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
        let stl = format!("solid cube\n{}endsolid cube\n", triangles.map(facet).collect::<String>());
        let cube = "<collision><geometry><mesh filename='cube.stl'/></geometry></collision>";
        let link = |i: usize| {
            let (on, at) = if i == 0 { ("foot".to_owned(), "0 0 1") } else { (format!("cube{}", i - 1), "0.2 0 0") };
            format!(
                "<link name='cube{i}'>{cube}</link><joint name='turn{i}' type='revolute'><parent link='{on}'/><child link='cube{i}'/>\
                 <origin xyz='{at}'/><axis xyz='0 0 1'/><limit lower='-3' upper='3' velocity='1' effort='1'/></joint>"
            )
        };
        let urdf =
            format!("<robot name='cubes'><link name='foot'/>{}</robot>", (0..CUBES).map(link).collect::<String>());
        let joints: Vec<String> = (0..CUBES).map(|i| format!("'turn{i}'")).collect();
        let description = format!(
            "name = 'cubes'\nurdf = 'cubes.urdf'\n[arm]\njoints = [{}]\ntool = 'cube{}'\n",
            joints.join(", "),
            CUBES - 1
        );
        let description = RobotDescription::read(&description).unwrap();
        Robot::of(description, &urdf, Some("<robot name='cubes'/>"), &mut |_| Ok(stl.clone().into_bytes())).unwrap()
    }

    #[test]
    fn only_shapes_of_links_that_are_near_each_other_are_looked_at() {
        let robot = cubes();
        let at = |turns: [f64; CUBES]| Configuration { arm: JointVector::of(turns), ..robot.at_zero() };
        let mut environment = Environment::new(&robot, &at([0.0; CUBES]), &[], &[]);
        let mut look = |turns: [f64; CUBES]| {
            environment.step(&robot, &at(turns));
            let groups = environment.groups();
            let pairs = environment.candidates(&groups).len();
            let placed = groups.links.values().filter(|link| link.parts.get().is_some()).count();
            (pairs, placed, environment.touches())
        };
        assert_eq!(look([0.0; CUBES]), (0, 0, Vec::new()));
        // The third cube turns the rest back: the fourth comes beside the second, the others beyond are free.
        let (pairs, placed, touches) = look([0.0, 0.0, 2.6, 0.0, -1.5, 0.0]);
        assert!(touches.iter().any(|touch| touch.depth_m > 0.0), "{touches:?}");
        assert!(pairs > 0 && pairs < CUBES * (CUBES - 1) / 4, "{pairs} pairs of cubes");
        assert!(placed < CUBES, "{placed}");
    }
}
