//! Contacts of every pair of bodies, including the robot's links with each other and with furniture.
//!
//! The bodies are those of the physics engine, where it has moved them. Their depth is computed by the judge itself (`overlap`): the engine's is
//! off by up to centimetres if cylinders and capsules are deep in each other, and by millimetres if they hardly touch. No planner is asked. Two
//! kinds of pairs are left out: those without a link or a carried object, because the robot does not decide what objects do to each other; and
//! those that the robot is built to have in contact: a link and its parent, links that touch in the home posture (a capsule's end reaches into the
//! next link, the base stands on the floor), and links with only a single joint between them that decides (the flange and the link before the
//! wrist): the limits of that joint keep them apart, not the planner. A link with meshes is checked by its primitives and by the meshes as they
//! are (`shell`), not by the convex pieces that the engine uses.
//!
//! Each step first checks the bounding boxes of links, pieces of furniture and objects (broad phase), then, for two that meet, the parts of each
//! that are in the other's box. Shared with the planner are only the reader of the robot's description and its forward kinematics.

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

/// A contact of two bodies, or a distance below `NEAR_M`.
#[derive(Debug, Clone, PartialEq)]
pub struct Touch {
    /// The two bodies: links before furniture before objects.
    pub things: [Thing; 2],
    /// Penetration depth in metres; negative: the distance, at most [`NEAR_M`].
    pub depth_m: f64,
    /// The point of contact, in the world frame.
    pub at: [f64; 3],
    /// Unit vector from the first to the second, in the world frame; the first is pushed out against it.
    pub normal: [f64; 3],
    /// Relative speed of the two at the point before they touched, in metres per second.
    pub speed_m_s: f64,
}

/// Maximum distance that is reported, in metres.
pub const NEAR_M: f64 = 5e-4;

/// Tolerance for being on an axis, in metres and as a sine.
const ALIGNED: f64 = 1e-9;

/// Enlargement of a link's bounding box beyond [`NEAR_M`], in metres: the poses of bodies are rounded differently from those of their links.
const ROUNDED_M: f32 = 1e-4;

/// The pairs of links that are checked, by their indices in [`Robot::model`], and the links that stand on the floor.
#[derive(Debug, Clone, Default)]
pub(super) struct Joined {
    /// Pairs of links with shapes, the lower index first, without those that are built to touch.
    apart: Vec<[usize; 2]>,
    on_floor: BTreeSet<usize>,
    /// The bounding box of all shapes of each link that has any, in its own frame.
    boxes: BTreeMap<usize, Aabb>,
    /// The meshes of each link that has any.
    surfaces: BTreeMap<usize, Vec<Surface>>,
}

impl Joined {
    /// Leaves out links that are attached to each other, and pairs that touch in the home posture.
    pub(super) fn of(robot: &Robot) -> Joined {
        let home = Configuration {
            arm: robot.posture(HOME).unwrap_or_else(|| robot.at_zero().arm),
            finger: robot.open_finger_m(),
            ..robot.at_zero()
        };
        // The other arms are in their `home` postures with open fingers, if the robot defines them.
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

    /// The shapes of a link at a pose.
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

/// A shape with its pose.
#[derive(Clone, Copy)]
enum Form<'s> {
    Convex(Convex),
    /// A mesh of a link, with the link's pose.
    Surface(&'s Surface, Pose),
}

/// The same with its bounding box.
struct Shaped<'s> {
    form: Form<'s>,
    aabb: Aabb,
}

impl Form<'_> {
    /// Its contact with another shape, if they are no farther apart than `within_m` metres. A negative `within_m` is a minimum depth.
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

/// Whether a link is built to touch one before it: its parent, or its grandparent if its joint only turns it in place (links without shapes are
/// skipped).
fn hangs(robot: &Robot, on: usize, link: usize) -> bool {
    let next = above(robot, link).filter(|_| turns_in_itself(robot, link)).and_then(|between| above(robot, between));
    above(robot, link) == Some(on) || next == Some(on)
}

/// The bounding box of the shapes of each link that has any, in its own frame.
fn boxes(robot: &Robot) -> BTreeMap<usize, Aabb> {
    let around = |link: &Link| {
        let primitives = link.own_bodies().iter();
        let primitives = primitives.map(|body| body.geometry.shape(0.0).compute_aabb(&to_f32(&body.pose)));
        let meshes = link.meshes.iter().map(|meshed| meshed.mesh.surface().compute_aabb(&to_f32(&meshed.pose)));
        primitives.chain(meshes).reduce(|a, b| a.merged(&b))
    };
    robot.model.links.iter().enumerate().filter_map(|(i, link)| Some((i, around(link)?))).collect()
}

/// The first link with a shape from a link towards the root.
fn above(robot: &Robot, link: usize) -> Option<usize> {
    let mut parents = std::iter::successors(robot.model.links[link].parent, |parent| robot.model.links[*parent].parent);
    parents.find(|parent| !robot.model.links[*parent].bodies.is_empty())
}

/// Whether the joint of a link only turns it about its own axis of symmetry, so that its shape stays in place.
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

/// The velocity of a body.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Speed {
    middle: Vector,
    along: Vector,
    about: Vector,
}

impl Speed {
    /// The present velocity of a body.
    pub(super) fn of(body: &RigidBody) -> Speed {
        Speed { middle: body.center_of_mass(), along: body.linvel(), about: body.angvel() }
    }

    fn at(&self, point: Vector) -> Vector {
        self.along + self.about.cross(point - self.middle)
    }
}

/// A link, a piece of furniture or an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of<'a> {
    Link(usize),
    Fixed(&'a str),
    Object(usize),
}

/// The parts of one thing, computed when first needed.
struct Group<'a> {
    environment: &'a Environment,
    of: Of<'a>,
    /// Bounding box of all parts, with a margin.
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

/// Two colliders that may touch: each is in the bounding box of the thing that the other belongs to.
struct Candidate<'g, 'a> {
    of: [Of<'a>; 2],
    parts: [&'g Part<'a>; 2],
}

impl<'a> Group<'a> {
    /// A link, with the bounding box that moves with it.
    fn link(environment: &'a Environment, link: usize) -> Option<Group<'a>> {
        let own = environment.joined().boxes.get(&link)?;
        let room = own.transform_by(&to_f32(&environment.link_pose(link))).loosened(NEAR_M as f32 + ROUNDED_M);
        Some(Group { environment, of: Of::Link(link), room, parts: OnceCell::new() })
    }

    /// A thing with few shapes.
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

    /// The pairs of a part of this thing and one of the other that may touch, in the order of the parts.
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

/// Groups consecutive colliders of the same thing.
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

/// A shape of a thing.
struct Part<'a> {
    form: Form<'a>,
    speed: Speed,
    aabb: Aabb,
}

/// A shape of a body at its pose.
fn convex(shape: &dyn Shape, place: &Pose32) -> Convex {
    #[expect(
        clippy::expect_used,
        reason = "furniture, objects and the primitives of links have no other shapes: `Geometry::shape`"
    )]
    Convex::of(shape, place).expect("bodies are made of balls, boxes, cylinders and capsules")
}

impl Environment {
    /// All contacts after the last step: of links and carried objects with anything else, and of objects aboard a driving base with everything that
    /// does not drive along, without the pairs that the robot is built to have in contact. Of two bodies only the deepest contact.
    pub fn touches(&self) -> Vec<Touch> {
        let groups = self.groups();
        let mut found = self.met(self.candidates(&groups));
        let mut aboard = BTreeSet::new();
        // What stands on something aboard is found one after the other.
        loop {
            let boards = |object: &usize| !aboard.contains(object) && self.is_aboard(*object, &found, &aboard);
            let more: BTreeSet<usize> = (0..self.len()).filter(boards).collect();
            if more.is_empty() {
                break;
            }
            aboard.extend(&more);
            found.extend(self.met(self.candidates_aboard(&groups, &more, &aboard)));
        }
        let is_aboard = |thing: &Thing| matches!(thing, Thing::Object(object) if aboard.contains(object));
        found.retain(|touch| !touch.things.iter().all(is_aboard));
        deepest(found)
    }

    /// Whether an object goes where the base drives: it rides, or stands on the robot or on something aboard.
    fn is_aboard(&self, object: usize, found: &[Touch], aboard: &BTreeSet<usize>) -> bool {
        let stands = |touch: &Touch| match touch.things {
            [Thing::Link(_), Thing::Object(above)] => above == object && touch.normal[2] >= LEVEL,
            [Thing::Object(above), Thing::Object(below)] => {
                above == object && aboard.contains(&below) && touch.normal[2] <= -LEVEL
            }
            _ => false,
        };
        if !self.drives || self.state(object).carried {
            return false;
        }
        self.riding.seat(object).is_some() || found.iter().any(stands)
    }

    /// The contacts of these pairs. Several of two things may be found; the last one is the deepest.
    fn met(&self, candidates: Vec<Candidate<'_, '_>>) -> Vec<Touch> {
        let mut found: Vec<Touch> = Vec::new();
        let mut deepest_yet: Option<([Of<'_>; 2], f64)> = None;
        for Candidate { of, parts: [a, b] } in candidates {
            // Only the deepest contact of two things counts: a contact less deep than one already found need not be computed.
            let within_m = deepest_yet.filter(|(of_it, _)| *of_it == of).map_or(NEAR_M, |(_, depth_m)| -depth_m);
            let Some(touch) = a.aabb.intersects(&b.aabb).then(|| touch(a, b, within_m)).flatten() else { continue };
            deepest_yet = Some((of, touch.depth_m));
            found.push(Touch { things: of.map(|of| self.thing(of)), ..touch });
        }
        found
    }

    fn thing(&self, of: Of<'_>) -> Thing {
        match of {
            Of::Link(link) => Thing::Link(self.link_name(link).to_owned()),
            Of::Fixed(name) => Thing::Fixed(name.to_owned()),
            Of::Object(object) => Thing::Object(object),
        }
    }

    /// All things that can touch, after the last step.
    fn groups(&self) -> Groups<'_> {
        let links = self.joined().boxes.keys().filter_map(|link| Some((*link, Group::link(self, *link)?))).collect();
        let fixed = grouped(self.fixed_colliders()).into_iter();
        let fixed = fixed.filter_map(|(name, colliders)| Group::placed(self, Of::Fixed(name), colliders)).collect();
        let object = |object| Group::placed(self, Of::Object(object), self.object_colliders(object).collect());
        Groups { links, fixed, objects: (0..self.len()).filter_map(object).collect() }
    }

    /// The pairs of colliders that have to be checked.
    fn candidates<'g, 'a>(&'a self, groups: &'g Groups<'a>) -> Vec<Candidate<'g, 'a>> {
        let mut found = Vec::new();
        let mut look = |first: &'g Group<'a>, second: &'g Group<'a>, turned: bool| {
            found.extend(candidates_of(first, second, turned));
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

    /// The pairs of colliders of objects aboard and of what is not aboard. Carried objects and links are among the other candidates.
    fn candidates_aboard<'g, 'a>(
        &'a self,
        groups: &'g Groups<'a>,
        of: &BTreeSet<usize>,
        aboard: &BTreeSet<usize>,
    ) -> Vec<Candidate<'g, 'a>> {
        let Groups { fixed, objects, .. } = groups;
        let is_in = |group: &&Group<'_>, set: &BTreeSet<usize>| matches!(group.of, Of::Object(o) if set.contains(&o));
        let is_carried = |group: &&Group<'_>| matches!(group.of, Of::Object(o) if self.state(o).carried);
        let others = || objects.iter().filter(|other| !is_in(other, aboard) && !is_carried(other));
        let boarded = objects.iter().filter(|object| is_in(object, of));
        boarded.flat_map(|one| fixed.iter().chain(others()).flat_map(|other| candidates_of(one, other, true))).collect()
    }

    /// The supports of an object: everything that touches it from below.
    pub fn supports_of(&self, object: usize) -> Vec<Thing> {
        let mine: Vec<Part<'_>> = self.object_colliders(object).map(|c| self.part(c)).collect();
        let all = self.links_beside().chain(self.fixed_beside()).chain(self.objects_beside(object));
        let bears = |(_, below): &(Of<'_>, Part<'_>)| mine.iter().any(|part| bears(below, part).is_some());
        let mut found: Vec<Thing> = all.filter(bears).map(|(of, _)| self.thing(of)).collect();
        found.dedup();
        found
    }

    /// The support of an object: the deepest level contact. `None` in the air.
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

    /// The parts of floor and furniture.
    fn fixed_beside(&self) -> impl Iterator<Item = (Of<'_>, Part<'_>)> {
        self.fixed_colliders().map(|(name, collider)| (Of::Fixed(name), self.part(collider)))
    }

    /// The parts of all objects but one.
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
        // The step has already applied the contact to an object, so its velocity before the step counts.
        let of_it = |(body, _): &&(RigidBodyHandle, Speed)| collider.parent() == Some(*body);
        let before = self.speeds_before.iter().find(of_it).map(|(_, speed)| *speed);
        let speed = before.or(body.map(Speed::of)).unwrap_or_default();
        let aabb = collider.shape().compute_aabb(&place).loosened(NEAR_M as f32);
        Part { form: Form::Convex(convex(collider.shape(), &place)), speed, aabb }
    }
}

/// The pairs of colliders of two things that may touch, in the order of the parts of the first; with `turned` the second thing is the first of each
/// pair.
fn candidates_of<'g, 'a>(
    first: &'g Group<'a>,
    second: &'g Group<'a>,
    turned: bool,
) -> impl Iterator<Item = Candidate<'g, 'a>> {
    first.pairs(second).map(move |[a, b]| match turned {
        true => Candidate { of: [second.of, first.of], parts: [b, a] },
        false => Candidate { of: [first.of, second.of], parts: [a, b] },
    })
}

/// Depth of a thing in the support below it; `None` if the support does not bear it.
fn bears(below: &Part<'_>, above: &Part<'_>) -> Option<f64> {
    let met = below.form.meeting(&above.form, TOUCH_M)?;
    (met.normal.z >= LEVEL).then_some(met.depth_m)
}

/// The contact of two parts, if they are no farther apart than `within_m` metres. A negative `within_m` is a minimum depth.
fn touch(a: &Part<'_>, b: &Part<'_>, within_m: f64) -> Option<Touch> {
    Some(touched(&a.form.meeting(&b.form, within_m)?, [a.speed, b.speed]))
}

/// The contact of two bodies that meet so, with these velocities.
fn touched(met: &Meeting, speeds: [Speed; 2]) -> Touch {
    let at = met.at.as_vec3();
    let [va, vb] = speeds.map(|speed| speed.at(at));
    Touch {
        things: [Thing::Object(0), Thing::Object(0)],
        depth_m: met.depth_m,
        at: met.at.to_array(),
        normal: met.normal.to_array(),
        speed_m_s: f64::from((va - vb).length()),
    }
}

/// Keeps the deepest contact of each two things.
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

    /// Number of links of an arm made of cubes.
    const CUBES: usize = 6;

    /// An arm of cubes, which are meshes, each 0.2 m beyond the one before; each turns about the vertical axis.
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
        // The third cube turns the rest back: the fourth is beside the second, the others beyond are free.
        let (pairs, placed, touches) = look([0.0, 0.0, 2.6, 0.0, -1.5, 0.0]);
        assert!(touches.iter().any(|touch| touch.depth_m > 0.0), "{touches:?}");
        assert!(pairs > 0 && pairs < CUBES * (CUBES - 1) / 4, "{pairs} pairs of cubes");
        assert!(placed < CUBES, "{placed}");
    }
}
