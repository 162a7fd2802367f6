//! Exact collision check: does the robot, in a posture of its arm, touch the scene or itself?
//!
//! A [`Checker`] is made once per scene: what stands still (objects, base, mast) becomes a flat array of obstacles, what the arm moves (links,
//! hand, fingers, the held object) an array of moving shapes. Bounding spheres decide most pairs, distances decide the rest. The mechanism
//! ([`arm::holding`](crate::arm::holding)) defines which links are to be kept apart. The checker reports what touches what, how deep, and where
//! contact is allowed; free motions are searched with the vector checks of `arm` and `space`.
//!
//! Moving shapes are grown by a padding. Between two postures no further apart than [`Checker::steps`] allows, no distance is smaller by more than
//! the padding than in the nearer posture: if both are free, the motion between them is. Without padding a motion is checked in pieces, each by the
//! distance in its middle (`free_in_pieces`). Meshes are checked as they are. Pairs of links that
//! spheres cannot decide ([`Checks::by_shapes`](crate::pairs::Checks::by_shapes)) may be built to run closer to each other than the padding, so
//! they have none: for these pairs the finished motion is checked, from posture to posture (`validate`).

use crate::arm::is_gripper;
use crate::cloud::Cloud;
use crate::confirmed::Couples;
use crate::frame::compose;
use crate::joint_vector::JointVector;
use crate::keep::Region;
use crate::levers::{Chain, Levers};
use crate::mechanism::Mechanism;
use crate::pairs::Pair;
use crate::request::kept_out;
use crate::robot::{Configuration, Geometry, Robot, to_f32};
use crate::robot_model::Joint;
use crate::solid::{Placed, Solid};
use crate::space::Obstacle as Standing;
use crate::vector::transform;
use parry3d::math::{Pose as Pose32, Vector};
use ratn_model::pose::Pose;
use ratn_world::scene::{Scene, Shape};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

mod touching;

pub(crate) use touching::{Press, Touch};

/// Clearance that the planner keeps around the moving shapes at the start and the end, in metres.
pub const PADDING_M: f64 = crate::arm::OVERHANG_M;

/// Maximum penetration of the fingers and the held object where contact is allowed, in metres: poses are measured, and the arm is compliant.
pub const CONTACT_TOLERANCE_M: f64 = 0.012;

/// Relative enlargement of the bounding sphere of a mesh, for rounding.
const ROUNDED: f64 = 1e-5;

/// Maximum distance that a point moves in one of the [`steps`](Checker::steps) of a motion if there is no padding, in metres.
const UNPADDED_STEP_M: f64 = 0.005;

/// Maximum share of the radius of a cloud's balls by which they may be pressed: what was seen is at their centres, and is not touched.
const IN_BALLS: f64 = 0.9;

/// Without padding, a contact less deep than this may be missed on a motion, in metres.
pub(crate) const RESOLUTION_M: f64 = 5e-4;

/// Checks postures against one scene.
#[derive(Clone)]
pub struct Checker<'a> {
    robot: &'a Robot,
    padding: f64,
    /// The pose of the base in the world frame. Everything is checked in the frame of the base: far from the world's origin `f32` is too coarse.
    base: Pose,
    /// Positions of all joints, with the base at zero; the arm's are those of the posture checked last.
    configuration: Configuration,
    obstacles: Vec<Obstacle>,
    moving: Vec<Moving>,
    /// Pairs of moving shapes that can meet.
    pairs: Vec<(usize, usize)>,
    /// Links with meshes that have no padding beside each other.
    close: BTreeSet<Pair>,
    /// Point cloud of balls around the robot, in the frame of the base.
    cloud: Option<Arc<Cloud>>,
    /// Maximum motion of any point, or of two shapes towards each other, per radian of each arm joint (per metre of a prismatic joint), in metres.
    reach: JointVector,
    poses: Vec<Pose>,
    placed: Vec<Pose32>,
    centres: Vec<Vector>,
}

#[derive(Clone)]
struct Obstacle {
    name: String,
    link: Option<usize>,
    solid: Solid,
    pose: Pose32,
    centre: Vector,
    radius: f32,
    entry: Entry,
}

/// What may penetrate an obstacle where contact is allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Entry {
    /// The fingers and what they hold, up to the allowed penetration.
    Pressed,
    /// The fingers, at any depth.
    Open,
    /// Nothing. Fingers and what they hold may only come closer than the padding.
    Never,
}

/// A shape of a link or of an obstacle.
struct Part {
    /// Its pose.
    at: Pose,
    solid: Solid,
    padded: Solid,
    /// Bounding sphere: its centre in the frame of the shape, and how far the shape reaches from there and how much farther the padded one does.
    middle: Vector,
    reach: [f64; 2],
}

#[derive(Clone)]
struct Moving {
    name: String,
    /// Index in the arm with what it holds.
    link: usize,
    /// The robot's link that the shape is fixed to.
    frame: usize,
    /// No joint of the arm moves the shape relative to the tool.
    is_with_tool: bool,
    role: Role,
    local: Pose,
    /// Grown by the padding.
    padded: Solid,
    solid: Solid,
    /// Centre of the bounding sphere, in the frame of the shape.
    middle: Vector,
    radius: f32,
    /// Indices of the obstacles that it can collide with.
    obstacles: Vec<usize>,
}

/// Role of a moving shape; it decides which contacts are allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Arm,
    /// The hand, or what is fixed to it.
    Hand,
    /// What the gripper's joint moves.
    Finger,
    Held,
}

/// The contacts that are allowed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Contact {
    /// No contact.
    None,
    /// The fingers and the held object may touch anything, with at most this penetration in metres.
    Gripper(f64),
}

/// A collision of two things, or too little distance between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Collision {
    /// The moving one: a link, or a held object.
    pub moving: String,
    /// The other one: an object, or a link.
    pub other: String,
    /// Penetration in metres. Negative: the distance, where it is less than the padding.
    pub depth_m: f64,
    /// The required distance, in metres.
    pub padding_m: f64,
}

impl fmt::Display for Collision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Collision { moving, other, .. } = self;
        let millimetres = self.depth_m.abs() * 1000.0;
        if self.depth_m > 0.0 {
            return write!(f, "{moving} is {millimetres:.0} mm inside {other}");
        }
        // Rounded to a tenth, so that a distance just below the required one does not read as if it were enough.
        let [apart, kept] = [millimetres, self.padding_m * 1000.0].map(|mm| (10.0 * mm).round() / 10.0);
        write!(f, "{moving} is {apart} mm away from {other}: at least {kept} mm are required")
    }
}

impl<'a> Checker<'a> {
    /// A checker of `robot` in `scene`. Everything but arm and base is as in `here`; the base is where the scene has it.
    pub fn new(robot: &'a Robot, scene: &Scene, here: &Configuration, padding: f64) -> Checker<'a> {
        let configuration = Configuration { base: [0.0; 3], ..*here };
        let poses = robot.poses(&configuration);
        let arm = crate::arm::holding(robot, scene, &configuration);
        let mut checker = Checker {
            robot,
            padding,
            base: crate::arm::on_floor(robot, &scene.base),
            configuration,
            obstacles: Vec::new(),
            moving: Vec::new(),
            pairs: Vec::new(),
            close: BTreeSet::new(),
            cloud: None,
            reach: JointVector::zeros(robot.arm_joints().len()),
            poses,
            placed: Vec::new(),
            centres: Vec::new(),
        };
        checker.add_arm(&arm);
        checker.add_scene(scene);
        checker.find_pairs(&arm);
        checker.find_reach();
        checker
    }

    /// The same checker, but where contact is allowed the fingers may be inside these objects: hollow ones, whose shapes are filled.
    pub fn reaching_into(mut self, objects: &[String]) -> Checker<'a> {
        for obstacle in &mut self.obstacles {
            if obstacle.link.is_none() && objects.contains(&obstacle.name) {
                obstacle.entry = Entry::Open;
            }
        }
        self
    }

    /// The same checker, but nothing that moves may ever enter these boxes, given in the world frame.
    pub fn keeping_out_of(mut self, regions: &[Region]) -> Checker<'a> {
        for (i, Region { pose, size }) in regions.iter().enumerate() {
            let part = Part::standing(&Geometry::from(&Shape::Box { size: *size }));
            self.add_obstacle(kept_out(i), None, self.base.inverse().compose(pose), part, Entry::Never);
        }
        let all = 0..self.obstacles.len();
        let regions = all.clone().skip(all.len() - regions.len());
        self.moving.iter_mut().for_each(|moving| moving.obstacles.extend(regions.clone()));
        self
    }

    /// The same checker for these couples only. If one link is checked against the cloud, all links that are left are.
    pub(crate) fn of(mut self, couples: &Couples) -> Checker<'a> {
        let has = |a: usize, b: usize| couples.pairs.contains(&(a.min(b), a.max(b)));
        let beside = |link: usize, name: &str| couples.beside.contains(&(link, name.to_owned()));
        let (moving, obstacles) = (&mut self.moving, &self.obstacles);
        for one in moving.iter_mut() {
            let link = one.link;
            one.obstacles.retain(|o| match obstacles[*o].link {
                Some(other) => has(link, other),
                None => beside(link, &obstacles[*o].name),
            });
        }
        self.pairs.retain(|(i, j)| has(moving[*i].link, moving[*j].link));
        self.cloud = self.cloud.filter(|cloud| couples.beside.iter().any(|(_, name)| *name == cloud.name));
        let name = self.cloud.as_ref().map(|cloud| cloud.name.clone());
        self.forget_idle(|link| name.as_ref().is_some_and(|name| beside(link, name)));
        self.find_reach();
        self
    }

    /// Drops moving shapes that have nothing left to be checked against. `is_beside_cloud` tells whether a link is checked against the cloud.
    fn forget_idle(&mut self, is_beside_cloud: impl Fn(usize) -> bool) {
        let in_pairs: BTreeSet<usize> = self.pairs.iter().flat_map(|(i, j)| [*i, *j]).collect();
        let is_busy = |moving: &Moving| !moving.obstacles.is_empty() || is_beside_cloud(moving.link);
        let is_kept = |i: &usize| in_pairs.contains(i) || is_busy(&self.moving[*i]);
        let kept: Vec<usize> = (0..self.moving.len()).filter(is_kept).collect();
        let now = |i: usize| kept.binary_search(&i).unwrap_or_default();
        self.pairs = self.pairs.iter().map(|(i, j)| (now(*i), now(*j))).collect();
        self.moving = kept.iter().map(|i| self.moving[*i].clone()).collect();
        self.placed.truncate(kept.len());
        self.centres.truncate(kept.len());
    }

    /// The same checker for those pairs of links of which at least one is a finger or moves with one.
    pub(crate) fn of_fingers(mut self) -> Checker<'a> {
        let fingers = self.robot.finger_links();
        let is_finger = |moving: &Moving| fingers.contains(&moving.frame);
        self.moving.iter_mut().filter(|moving| !is_finger(moving)).for_each(|moving| moving.obstacles.clear());
        let moving = &self.moving;
        self.pairs.retain(|(i, j)| is_finger(&moving[*i]) || is_finger(&moving[*j]));
        self.forget_idle(|_| false);
        self.find_reach();
        self
    }

    /// The same checker with a point cloud in the frame of the base.
    pub fn beside(self, cloud: Option<Arc<Cloud>>) -> Checker<'a> {
        Checker { cloud, ..self }
    }

    /// Adds the links of the robot, and what it holds.
    fn add_arm(&mut self, arm: &Mechanism) {
        let (fingers, own) = (self.robot.finger_links(), self.robot.model.links.len());
        for (i, link) in arm.links.iter().enumerate() {
            let moving = match () {
                () if i >= own => Some((link.name.clone(), self.robot.tool, Role::Held)),
                () if !self.robot.arm_links.contains(&i) => None,
                () if fingers.contains(&i) => Some((format!("link {}", link.name), i, Role::Finger)),
                () if is_gripper(self.robot, i) => Some((format!("link {}", link.name), i, Role::Hand)),
                () => Some((format!("link {}", link.name), i, Role::Arm)),
            };
            let primitives = link.own_bodies().iter().map(|body| Part {
                at: body.pose,
                solid: Solid::primitive(body, 0.0),
                padded: Solid::primitive(body, self.padding),
                middle: Vector::ZERO,
                // The corners of a padded box move out by more than the padding.
                reach: [body.geometry.radius(), self.padding * 3_f64.sqrt()],
            });
            let meshes = link.meshes.iter().map(|meshed| {
                // How deep the gripper is decides what it may press.
                let is_gripper = matches!(moving, Some((_, _, Role::Hand | Role::Finger)));
                let solid =
                    if is_gripper { Solid::pressing_mesh(&meshed.mesh, 0.0) } else { Solid::mesh(&meshed.mesh, 0.0) };
                let padded = Solid::mesh(&meshed.mesh, self.padding);
                let around = solid.shape.compute_local_bounding_sphere();
                let reach = [f64::from(around.radius) * (1.0 + ROUNDED), self.padding];
                Part { at: meshed.pose, solid, padded, middle: around.center, reach }
            });
            for part in primitives.chain(meshes).collect::<Vec<Part>>() {
                match &moving {
                    Some((name, frame, role)) => self.add_moving(name.clone(), [i, *frame], *role, part),
                    None => {
                        let pose = self.poses[i].compose(&part.at);
                        self.add_obstacle(format!("link {}", link.name), Some(i), pose, part, Entry::Pressed);
                    }
                }
            }
        }
    }

    /// Adds the scene's objects that are not held.
    fn add_scene(&mut self, scene: &Scene) {
        for Standing { name, pose, geometry } in crate::arm::objects(self.robot, scene) {
            let part = Part::standing(&geometry);
            self.add_obstacle(name, None, pose.compose(&part.at), part, Entry::Pressed);
        }
    }

    fn add_moving(&mut self, name: String, [link, frame]: [usize; 2], role: Role, part: Part) {
        let Part { at, solid, padded, middle, reach } = part;
        let radius = reach.iter().sum::<f64>() as f32;
        let (is_with_tool, obstacles) = (false, Vec::new());
        let moving =
            Moving { name, link, frame, is_with_tool, role, local: at, padded, solid, middle, radius, obstacles };
        self.moving.push(moving);
        self.placed.push(Pose32::IDENTITY);
        self.centres.push(Vector::ZERO);
    }

    fn add_obstacle(&mut self, name: String, link: Option<usize>, pose: Pose, part: Part, entry: Entry) {
        let pose = to_f32(&pose);
        let Part { solid, middle, reach: [radius, _], .. } = part;
        let (centre, radius) = (pose.transform_point(middle), radius as f32);
        self.obstacles.push(Obstacle { name, link, solid, pose, centre, radius, entry });
    }

    /// Finds the pairs that are to be kept apart: between links as the arm defines, and between every moving part of the arm and the objects.
    fn find_pairs(&mut self, arm: &Mechanism) {
        let carriers = arm.carriers();
        let is_looked_at =
            |a: &Moving, link: Option<usize>| link.is_none_or(|link| arm.is_checked_among(&carriers, a.link, link));
        for i in 0..self.moving.len() {
            let a = &self.moving[i];
            let beside = |o: &usize| is_looked_at(a, self.obstacles[*o].link);
            let obstacles = (0..self.obstacles.len()).filter(beside).collect();
            let among = |j: &usize| is_looked_at(a, Some(self.moving[*j].link));
            self.pairs.extend((i + 1..self.moving.len()).filter(among).map(|j| (i, j)));
            self.moving[i].is_with_tool = arm.carrier(self.moving[i].link) == arm.carrier(self.robot.tool);
            self.moving[i].obstacles = obstacles;
        }
        self.close = arm.by_shapes.iter().copied().filter(|(a, b)| arm.is_by_meshes(*a, *b)).collect();
    }

    fn find_reach(&mut self) {
        let (robot, at) = (self.robot, self.configuration);
        self.reach = self.farthest(robot.arm_joints(), |link| robot.arm_chain(&at, link));
    }

    /// Maximum motion of any moving shape, or of two shapes of a pair towards each other, per joint.
    fn farthest(&self, joints: &[Joint], chain_to: impl Fn(usize) -> Chain) -> JointVector {
        let levers_of = |moving: &Moving| {
            let chain = chain_to(moving.frame);
            let middle = transform(&chain.tip.compose(&moving.local), moving.middle.as_dvec3());
            let end_m = middle.length() + f64::from(moving.radius);
            let levers = Levers::new(&chain.joints, end_m, joints);
            (chain, levers)
        };
        let all: Vec<(Chain, Levers)> = self.moving.iter().map(levers_of).collect();
        let alone = all.iter().map(|(_, levers)| levers.per_joint(joints.len()));
        let towards_each_other = self.pairs.iter().filter_map(|(i, j)| {
            let ((chain, levers), (other, other_levers)) = (&all[*i], &all[*j]);
            let shared = chain.shared_with(other);
            // If one chain continues the other, only the longer one moves relative to the other.
            let branches = shared < chain.joints.len().min(other.joints.len());
            let [a, b] = [levers, other_levers].map(|levers| levers.behind(shared).per_joint(joints.len()));
            branches.then(|| JointVector::from_fn(joints.len(), |j| a[j] + b[j]))
        });
        let greater = |a: JointVector, b: JointVector| JointVector::from_fn(joints.len(), |j| a[j].max(b[j]));
        alone.chain(towards_each_other).fold(JointVector::zeros(joints.len()), greater)
    }

    /// The pairs of links that are kept apart, by their indices in the arm with what it holds ([`arm::holding`](crate::arm::holding)), the lower
    /// first.
    pub fn pairs(&self) -> BTreeSet<(usize, usize)> {
        let beside = self.moving.iter().flat_map(|moving| {
            let links = moving.obstacles.iter().filter_map(|o| self.obstacles[*o].link);
            links.map(|link| (moving.link, link))
        });
        let among = self.pairs.iter().map(|(i, j)| (self.moving[*i].link, self.moving[*j].link));
        beside.chain(among).map(|(a, b)| (a.min(b), a.max(b))).collect()
    }

    /// The robot that is checked.
    pub fn robot(&self) -> &'a Robot {
        self.robot
    }

    /// The padding around the moving shapes, in metres.
    pub fn padding(&self) -> f64 {
        self.padding
    }

    /// Number of equal steps into which the straight line between two postures must be cut so that in one step no point of the robot moves further
    /// than twice the padding, and no two shapes approach each other by more than that.
    pub fn steps(&self, from: &JointVector, to: &JointVector) -> usize {
        let moved: f64 = (0..self.reach.len()).map(|j| (to[j] - from[j]).abs() * self.reach[j]).sum();
        let step = if self.padding > 0.0 { 2.0 * self.padding } else { UNPADDED_STEP_M };
        ((moved / step).ceil() as usize).max(1)
    }

    /// The same checker without one pair of shapes, given by their names: these two may touch.
    pub(crate) fn but_for(mut self, met: &Collision) -> Checker<'a> {
        let is_met = |a: &str, b: &str| [[a, b], [b, a]].contains(&[&*met.moving, &*met.other]);
        let (moving, obstacles) = (&mut self.moving, &self.obstacles);
        for one in moving.iter_mut() {
            let name = one.name.clone();
            one.obstacles.retain(|o| !is_met(&name, &obstacles[*o].name));
        }
        self.pairs.retain(|(i, j)| !is_met(&moving[*i].name, &moving[*j].name));
        self
    }

    /// Sets the position of each finger, in metres from the middle.
    pub(crate) fn set_finger(&mut self, finger: f64) {
        if self.configuration.finger != finger {
            self.configuration.finger = finger;
            self.find_reach();
        }
    }

    /// Maximum motion of any point of the fingers, or of two of their shapes towards each other, when each finger moves by `by` metres.
    pub(crate) fn fingers_move_m(&self, by: f64) -> f64 {
        let farthest =
            self.farthest(self.robot.finger_joints(), |link| self.robot.finger_chain(&self.configuration, link));
        farthest.iter().map(|reach| reach * by.abs()).sum()
    }

    /// Whether a posture is free of collisions.
    pub fn is_free(&mut self, arm: &JointVector, contact: Contact) -> bool {
        self.hit(arm, contact).is_none()
    }

    /// The first collision found in a posture, if any.
    pub fn collision(&mut self, arm: &JointVector, contact: Contact) -> Option<Collision> {
        let (i, other) = self.hit(arm, contact)?;
        let depth_m = self.depth(i, other).unwrap_or(-self.padding);
        let other = match other {
            Other::Obstacle(o) => self.obstacles[o].name.clone(),
            Other::Moving(j) => self.moving[j].name.clone(),
            Other::Cloud => self.cloud.as_ref().map(|cloud| cloud.name.clone()).unwrap_or_default(),
        };
        let (moving, padding_m) = (self.moving[i].name.clone(), self.padding);
        Some(Collision { moving, other, depth_m, padding_m })
    }

    /// Whether a collision is between an obstacle and something that is fixed to the tool: then every posture with that pose of the tool has it.
    pub(crate) fn is_of_the_tool(&self, collision: &Collision) -> bool {
        self.moving.iter().any(|moving| moving.is_with_tool && moving.name == collision.moving)
            && self.obstacles.iter().any(|obstacle| obstacle.name == collision.other)
    }

    /// Maximum motion of any point of the robot, or of two of its shapes towards each other, when the joints move by `turns`, in metres.
    pub(crate) fn moves_m(&self, turns: &JointVector) -> f64 {
        (0..self.reach.len()).map(|j| turns[j].abs() * self.reach[j]).sum()
    }

    /// Distance of a posture from the next forbidden contact, in metres, at most `up_to`; or the collision. For a checker without padding.
    pub(crate) fn room(&mut self, arm: &JointVector, contact: Contact, up_to: f64) -> Result<f64, Collision> {
        if let Some(collision) = self.collision(arm, contact) {
            return Err(collision);
        }
        let mut room = up_to;
        for i in 0..self.moving.len() {
            for &o in &self.moving[i].obstacles {
                room = room.min(self.room_between(i, Other::Obstacle(o), contact, room));
            }
        }
        for &(i, j) in &self.pairs {
            room = room.min(self.room_between(i, Other::Moving(j), contact, room));
        }
        for i in 0..self.moving.len() {
            let may_press = self.may_press(i, Other::Cloud, contact);
            room = room.min((self.gap_to_cloud(i, room - may_press) + may_press).max(0.0));
        }
        Ok(room)
    }

    /// As `room`, for one pair that does not touch, in the posture checked last.
    fn room_between(&self, i: usize, other: Other, contact: Contact, up_to: f64) -> f64 {
        let moving = &self.moving[i];
        let (centre, radius) = match other {
            Other::Obstacle(o) => (self.obstacles[o].centre, self.obstacles[o].radius),
            Other::Moving(j) => (self.centres[j], self.moving[j].radius),
            Other::Cloud => return up_to,
        };
        let reach = moving.radius + radius + up_to as f32;
        if self.centres[i].distance_squared(centre) >= reach * reach {
            return up_to;
        }
        let tolerance = match (contact, other) {
            (Contact::Gripper(_), _) if moving.role == Role::Finger && self.entry(other) == Entry::Open => {
                return up_to;
            }
            _ => self.may_press(i, other, contact),
        };
        let apart = self.apart_m(i, other, up_to);
        (apart + tolerance).clamp(0.0, up_to)
    }

    /// Whether the straight motion between two postures is free of collisions; `from` itself is not checked.
    pub fn edge_is_free(&mut self, from: &JointVector, to: &JointVector, contact: Contact) -> bool {
        if !self.is_free(to, contact) {
            return false;
        }
        if self.padding <= 0.0 {
            return self.collision_between(from, to, contact).is_none();
        }
        // Bisection: an edge is most likely in collision at its middle.
        let steps = self.steps(from, to);
        let mut stride = steps.next_power_of_two();
        while stride > 1 {
            for i in (stride / 2..steps).step_by(stride) {
                if !self.is_free(&between(from, to, i as f64 / steps as f64), contact) {
                    return false;
                }
            }
            stride /= 2;
        }
        true
    }

    /// The first collision of the straight motion from one posture to another, both included.
    pub fn edge_collision(&mut self, from: &JointVector, to: &JointVector, contact: Contact) -> Option<Collision> {
        if self.padding <= 0.0 {
            let at_start = self.collision(from, contact).or_else(|| self.collision_between(from, to, contact));
            return at_start.or_else(|| self.collision(to, contact));
        }
        let steps = self.steps(from, to);
        (0..=steps).find_map(|i| self.collision(&between(from, to, i as f64 / steps as f64), contact))
    }

    /// The first collision between two postures, without padding; the postures themselves are not checked.
    fn collision_between(&mut self, from: &JointVector, to: &JointVector, contact: Contact) -> Option<Collision> {
        let mut piece = |[begin, end]: [f64; 2]| {
            let strays = JointVector::from_fn(from.len(), |j| (to[j] - from[j]).abs() * (end - begin) / 2.0);
            (between(from, to, (begin + end) / 2.0), strays)
        };
        let found = self.free_in_pieces([0.0, 1.0], contact, &mut piece, &mut || true);
        found.err().map(|(_, collision)| collision)
    }

    /// Checks the middle of a piece of a motion. If the distance there is more than anything moves from there within the piece, the piece is free;
    /// otherwise its halves are checked, in the order of the motion, until they are so short that nothing moves by more than [`RESOLUTION_M`].
    /// `piece` returns the posture in the middle of a piece, and by how much each joint strays from it within the piece. `goes_on` is called
    /// before each check; returns whether all of it was checked. For a checker without padding.
    ///
    /// # Errors
    /// The first collision, and where it is.
    pub(crate) fn free_in_pieces(
        &mut self,
        whole: [f64; 2],
        contact: Contact,
        piece: &mut dyn FnMut([f64; 2]) -> (JointVector, JointVector),
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<bool, (f64, Collision)> {
        let mut pieces = vec![whole];
        while let Some([begin, end]) = pieces.pop() {
            if !goes_on() {
                return Ok(false);
            }
            let middle = (begin + end) / 2.0;
            let (posture, strays) = piece([begin, end]);
            let moves_m = self.moves_m(&strays);
            let room = self.room(&posture, contact, moves_m).map_err(|collision| (middle, collision))?;
            if room < moves_m && moves_m > RESOLUTION_M {
                // The last piece is checked first.
                pieces.extend([[middle, end], [begin, middle]]);
            }
        }
        Ok(true)
    }

    /// Sets the posture of the arm.
    pub(crate) fn place(&mut self, arm: &JointVector) {
        self.configuration.arm = *arm;
        self.robot.update_arm(&self.configuration, &mut self.poses);
        for (i, moving) in self.moving.iter().enumerate() {
            let pose = to_f32(&compose(&self.poses[moving.frame], &moving.local));
            self.centres[i] = pose.transform_point(moving.middle);
            self.placed[i] = pose;
        }
    }

    fn hit(&mut self, arm: &JointVector, contact: Contact) -> Option<(usize, Other)> {
        self.place(arm);
        // The hand and what it holds are the most likely to collide.
        for i in (0..self.moving.len()).rev() {
            let moving = &self.moving[i];
            for &o in &moving.obstacles {
                let obstacle = &self.obstacles[o];
                let reach = moving.radius + obstacle.radius;
                if self.centres[i].distance_squared(obstacle.centre) < reach * reach
                    && self.grown(i, obstacle.link).touches(&Placed { pose: obstacle.pose, solid: &obstacle.solid })
                    && !self.allowed(i, Other::Obstacle(o), contact)
                {
                    return Some((i, Other::Obstacle(o)));
                }
            }
            let room = match contact {
                Contact::Gripper(_) if self.can_press(i) => -self.may_press(i, Other::Cloud, contact),
                _ => self.padding,
            };
            if self.gap_to_cloud(i, room) < room {
                return Some((i, Other::Cloud));
            }
        }
        for &(i, j) in &self.pairs {
            let reach = self.moving[i].radius + self.moving[j].radius;
            if self.centres[i].distance_squared(self.centres[j]) < reach * reach
                && self
                    .grown(i, Some(self.moving[j].link))
                    .touches(&Placed { pose: self.placed[j], solid: &self.moving[j].solid })
            {
                return Some((i, Other::Moving(j)));
            }
        }
        None
    }

    fn allowed(&self, i: usize, other: Other, contact: Contact) -> bool {
        let Contact::Gripper(tolerance) = contact else { return false };
        if self.entry(other) == Entry::Open && self.moving[i].role == Role::Finger {
            return true;
        }
        let deepest = if self.entry(other) == Entry::Never { tolerance.min(0.0) } else { tolerance };
        self.can_press(i) && self.depth(i, other).is_some_and(|depth| depth <= deepest)
    }

    /// What may penetrate this obstacle where contact is allowed.
    fn entry(&self, other: Other) -> Entry {
        match other {
            Other::Obstacle(o) => self.obstacles[o].entry,
            Other::Moving(_) | Other::Cloud => Entry::Pressed,
        }
    }

    /// Whether a moving shape may touch anything at all.
    fn can_press(&self, i: usize) -> bool {
        matches!(self.moving[i].role, Role::Finger | Role::Held)
    }

    /// Allowed penetration of a moving shape into another one, in metres.
    fn may_press(&self, i: usize, other: Other, contact: Contact) -> f64 {
        match contact {
            Contact::Gripper(press) if self.can_press(i) && self.entry(other) == Entry::Never => press.min(0.0),
            Contact::Gripper(press) if self.can_press(i) && matches!(other, Other::Cloud) => {
                let radius_m = self.cloud.as_ref().map_or(0.0, |cloud| cloud.radius_m());
                press.min(IN_BALLS * radius_m)
            }
            Contact::Gripper(press) if self.can_press(i) => press,
            _ => 0.0,
        }
    }

    /// Distance of an unpadded moving shape from the nearest ball of the cloud in the posture checked last, in metres, at most `up_to`. Negative:
    /// the penetration.
    fn gap_to_cloud(&self, i: usize, up_to: f64) -> f64 {
        let Some(cloud) = &self.cloud else { return up_to };
        let (pose, Solid { shape, inside, .. }) = (&self.placed[i], &self.moving[i].solid);
        let radius = cloud.radius_m() as f32;
        let mut gap = up_to;
        cloud.visit_near(pose, shape, inside.as_deref(), radius + up_to as f32, &mut |_, distance| {
            gap = gap.min(f64::from(distance - radius));
            true
        });
        gap
    }

    /// Penetration of the unpadded shapes in the posture checked last, in metres.
    fn depth(&self, i: usize, other: Other) -> Option<f64> {
        let near = 2.0 * self.padding;
        let apart = match other {
            Other::Cloud => return Some(-self.gap_to_cloud(i, near)),
            _ => self.apart_m(i, other, near),
        };
        (apart <= near).then_some(-apart)
    }

    /// A moving shape as it is checked against another one, which belongs to `link` if given: padded, except against links that may be built to
    /// run closer to its own link than the padding.
    fn grown(&self, i: usize, link: Option<usize>) -> Placed<'_> {
        let moving = &self.moving[i];
        let is_close = link.is_some_and(|link| self.close.contains(&(link.min(moving.link), link.max(moving.link))));
        Placed { pose: self.placed[i], solid: if is_close { &moving.solid } else { &moving.padded } }
    }

    /// Distance of the unpadded shapes in metres, or any value greater than `enough_m` if it is more than that. Negative: the penetration.
    fn apart_m(&self, i: usize, other: Other, enough_m: f64) -> f64 {
        let (pose, solid) = match other {
            Other::Obstacle(o) => (self.obstacles[o].pose, &self.obstacles[o].solid),
            Other::Moving(j) => (self.placed[j], &self.moving[j].solid),
            Other::Cloud => return enough_m,
        };
        let own = Placed { pose: self.placed[i], solid: &self.moving[i].solid };
        own.apart_m(&Placed { pose, solid }, enough_m)
    }
}

impl Part {
    /// A shape that does not move, with its axis along z.
    fn standing(geometry: &Geometry) -> Part {
        let body = geometry.at(Pose::IDENTITY);
        let solid = || Solid::primitive(&body, 0.0);
        Part { at: body.pose, solid: solid(), padded: solid(), middle: Vector::ZERO, reach: [geometry.radius(), 0.0] }
    }
}

#[derive(Debug, Clone, Copy)]
enum Other {
    Obstacle(usize),
    Moving(usize),
    Cloud,
}

/// The posture a fraction of the way from one to another.
pub fn between(from: &JointVector, to: &JointVector, fraction: f64) -> JointVector {
    JointVector::from_fn(from.len(), |j| from[j] + (to[j] - from[j]) * fraction)
}

/// The Euclidean distance of two postures, in radians.
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// The length of a path, in radians.
pub fn length(path: &[JointVector]) -> f64 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_world::scene::Placement;

    /// A robot whose arm has the joints `a` and then `b`; the URDF in `joints` has what is between and behind them.
    fn robot(joints: &str, arm: &str, tool: &str) -> Robot {
        let toml = format!("name = 'r'\nurdf = 'r'\n[arm]\njoints = [{arm}]\ntool = '{tool}'\n");
        let description = crate::description::RobotDescription::read(&toml).unwrap();
        let urdf = format!("<robot name='r'><link name='foot'/>{joints}</robot>");
        Robot::of(description, &urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap()
    }

    fn joint(name: &str, kind: &str, [parent, child]: [&str; 2], origin: &str, axis: &str, range: [f64; 2]) -> String {
        let [lower, upper] = range;
        format!(
            "<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/><origin xyz='{origin}'/>\
             <axis xyz='{axis}'/><limit lower='{lower}' upper='{upper}' velocity='1' effort='1'/></joint>"
        )
    }

    fn solid(name: &str, shape: &str) -> String {
        format!("<link name='{name}'><collision>{shape}</collision></link>")
    }

    fn checker<'a>(robot: &'a Robot, objects: Vec<ratn_world::scene::SceneObject>) -> Checker<'a> {
        Checker::new(robot, &Scene { base: Pose::IDENTITY, objects }, &robot.at_zero(), 0.0)
    }

    #[test]
    fn a_link_that_slides_does_not_pass_through_a_box() {
        let ball = solid("ball", "<geometry><sphere radius='0.03'/></geometry>");
        let slide = joint("j1", "prismatic", ["foot", "ball"], "0 0 0", "1 0 0", [0.0, 1.0]);
        let robot = robot(&(ball + &slide), "'j1'", "ball");
        let in_the_way = ratn_world::scene::SceneObject {
            name: "box".into(),
            shape: ratn_world::scene::Shape::Box { size: [0.04; 3] },
            placement: Placement::World(Pose::at(0.25, 0.0, 0.0)),
        };
        let mut checker = checker(&robot, vec![in_the_way]);
        let [from, to] = [[0.0], [1.0]].map(JointVector::of);
        assert!(checker.is_free(&from, Contact::None) && checker.is_free(&to, Contact::None));
        assert!(!checker.edge_is_free(&from, &to, Contact::None));
        assert_eq!(checker.edge_collision(&from, &to, Contact::None).unwrap().other, "box");
        assert_eq!(checker.reach, JointVector::of([1.0]));
    }

    #[test]
    fn fixed_links_and_slides_between_joints_and_the_factor_of_a_mimic_lengthen_the_lever() {
        let fixed =
            "<joint name='f' type='fixed'><parent link='upper'/><child link='mid'/><origin xyz='0.5 0 0'/></joint>";
        let capsule = solid("mid", "<geometry><capsule radius='0.01' length='0.02'/></geometry>");
        let ball = solid("tip", "<origin xyz='0.5 0 0'/><geometry><sphere radius='0.03'/></geometry>");
        let j1 = joint("j1", "revolute", ["foot", "upper"], "0 0 0", "0 0 1", [-2.0, 2.0]);
        let chain = ["<link name='upper'/>", &capsule, &ball, &j1, fixed].concat();
        let turning = joint("j2", "revolute", ["mid", "tip"], "0 0 0", "0 0 1", [-2.0, 2.0]);
        let close = |robot: &Robot, expected: [f64; 2]| {
            let reach = checker(robot, Vec::new()).reach;
            assert!(reach.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{reach:?} is not {expected:?}");
        };
        close(&robot(&(chain.clone() + &turning), "'j1', 'j2'", "tip"), [1.03, 0.53]);
        // The joint that slides may be as far out as its limits say.
        let sliding = joint("j2", "prismatic", ["mid", "tip"], "0 0 0", "1 0 0", [-0.2, 0.7]);
        close(&robot(&(chain.clone() + &sliding), "'j1', 'j2'", "tip"), [1.73, 1.0]);
        let triple = turning.replace("</joint>", "<mimic joint='j1' multiplier='0.5'/></joint>");
        let links = chain.clone() + &triple + &solid("end", "<geometry><sphere radius='0.01'/></geometry>");
        let last = joint("j3", "revolute", ["tip", "end"], "0 0 0", "0 0 1", [-2.0, 2.0]);
        close(&robot(&(links + &last), "'j1', 'j3'", "end"), [1.03 + 0.5 * 0.53, 0.01]);
    }
}
