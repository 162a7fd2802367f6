//! The rigid bodies and the simulation step.

use super::object::{Kind, Model};
use super::riding::{Riding, base_pose};
use super::touch::{Joined, Speed};
use rapier3d::math::{Pose as Pose32, Vector};
use rapier3d::prelude::{
    BroadPhaseBvh, CCDSolver, Collider, ColliderBuilder, ColliderHandle, ColliderSet, Group, ImpulseJointSet,
    IntegrationParameters, InteractionGroups, InteractionTestMode, IslandManager, MultibodyJointSet, NarrowPhase,
    PhysicsPipeline, RigidBody, RigidBodyBuilder, RigidBodyHandle, RigidBodySet, RigidBodyType, SoftBodySet,
};
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::robot::{Configuration, Geometry, Robot, to_f32};
use ratn_world::digest::{Digest, Digester};
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// The fixed step.
pub const STEP: Duration = Duration::from_millis(4);
/// The floor's name.
pub const FLOOR: &str = "floor";
/// Size of the floor, in metres; its top is at z = 0.
const FLOOR_SIZE: [f64; 3] = [12.0, 12.0, 0.1];
/// Gravity, in m/s².
pub const GRAVITY: f64 = 9.81;
/// Typical size of an object, which rapier scales its tolerances by: bodies may penetrate each other by 0.5 % of it and are pushed apart with at
/// most three times it per second.
const LENGTH_UNIT_M: f32 = 0.1;
/// A body slower than a twentieth of the length unit per second for this time stands still, in seconds.
const STILL_S: f32 = 0.3;
/// Maximum distance of an object from its support, in metres.
pub(super) const TOUCH_M: f64 = 0.003;
/// Minimum upward component of a support's normal.
pub(super) const LEVEL: f64 = 0.7;
/// Objects below this height have fallen out of the world and are not simulated any more, in metres.
pub(super) const LOST_M: f32 = -5.0;
/// Friction coefficient of fingers and links.
pub(super) const ROBOT_FRICTION: f32 = 0.6;

/// The body type of a moving link.
const LINK: RigidBodyType = RigidBodyType::KinematicPositionBased;

const OF_ROBOT: Group = Group::GROUP_1;
const OF_OBJECTS: Group = Group::GROUP_2;
const OF_FURNITURE: Group = Group::GROUP_3;

/// A piece of furniture that never moves, made of boxes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Furniture {
    /// Its name.
    pub name: String,
    /// Centres, in the world frame, and edges, in metres.
    pub parts: Vec<(Pose, [f64; 3])>,
}

/// Pose and velocity of an object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ObjectState {
    /// Its pose in the world frame.
    pub pose: Pose,
    /// Velocity in metres per second.
    pub velocity: [f64; 3],
    /// Angular velocity in radians per second.
    pub spin: [f64; 3],
    /// Whether it has stood still for a while.
    pub at_rest: bool,
    /// Whether it is carried ([`Environment::carry`]).
    pub carried: bool,
    /// Its pose in the frame of the base, if it rides on the base.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rides: Option<Pose>,
}

/// What an environment can be restored from: see [`Environment::save`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Saved {
    /// Steps since the beginning.
    pub steps: u64,
    /// All objects, in order.
    pub objects: Vec<(Model, ObjectState)>,
}

/// The rigid bodies of a cell.
pub struct Environment {
    gravity: Vector,
    parameters: IntegrationParameters,
    pipeline: PhysicsPipeline,
    islands: IslandManager,
    broad_phase: BroadPhaseBvh,
    narrow_phase: NarrowPhase,
    bodies: RigidBodySet,
    colliders: ColliderSet,
    joints: ImpulseJointSet,
    multibodies: MultibodyJointSet,
    soft_bodies: SoftBodySet,
    ccd: CCDSolver,
    steps: u64,
    furniture: Vec<Furniture>,
    /// Colliders and names of floor and furniture.
    standing: Vec<(ColliderHandle, String)>,
    links: Vec<RobotBody>,
    /// Position of the robot's base at the last step.
    pub(super) base: [f64; 3],
    /// Whether the base moved in the last step.
    pub(super) drives: bool,
    /// Per arm: whether the fingers of its gripper push what they touch.
    fingers_solid: Vec<bool>,
    objects: Vec<Body>,
    pub(super) riding: Riding,
    /// Poses of the robot's links after the last step.
    link_poses: Vec<Pose>,
    /// Their names, and the pairs that are built to touch.
    link_names: Vec<String>,
    joined: Joined,
    /// Velocities before the last step of the bodies that move freely.
    pub(super) speeds_before: Vec<(RigidBodyHandle, Speed)>,
}

/// One body of a robot's link: a primitive, or a mesh, which has a collider for each of its convex pieces.
#[derive(Clone)]
struct RobotBody {
    body: RigidBodyHandle,
    colliders: Vec<ColliderHandle>,
    /// Whether it is a mesh: the judge has its own copy.
    is_mesh: bool,
    /// The arm whose finger it is.
    finger_of: Option<usize>,
    link: usize,
    /// Its pose in the frame of its link.
    pose: Pose,
    at: Pose32,
    /// Whether it did not move in the last step.
    stands: bool,
}

#[derive(Clone)]
struct Body {
    model: Model,
    body: RigidBodyHandle,
    parts: Vec<ColliderHandle>,
}

impl Environment {
    /// Furniture, a robot, and objects that sleep until something touches them.
    pub fn new(
        robot: &Robot,
        configuration: &Configuration,
        furniture: &[Furniture],
        objects: &[(Model, Pose)],
    ) -> Environment {
        let state = |pose: &Pose| ObjectState {
            pose: *pose,
            velocity: [0.0; 3],
            spin: [0.0; 3],
            at_rest: true,
            carried: false,
            rides: None,
        };
        let objects = objects.iter().map(|(model, pose)| (model.clone(), state(pose))).collect();
        Environment::restore(robot, configuration, furniture, &Saved { steps: 0, objects })
    }

    /// Restores a saved environment. It continues as the saved one does, to the last bit.
    pub fn restore(
        robot: &Robot,
        configuration: &Configuration,
        furniture: &[Furniture],
        saved: &Saved,
    ) -> Environment {
        Environment::made(robot, configuration, furniture, saved, Joined::of(robot))
    }

    fn made(
        robot: &Robot,
        configuration: &Configuration,
        furniture: &[Furniture],
        saved: &Saved,
        joined: Joined,
    ) -> Environment {
        let parameters = IntegrationParameters {
            dt: STEP.as_secs_f32(),
            length_unit: LENGTH_UNIT_M,
            ..IntegrationParameters::default()
        };
        let mut environment = Environment {
            gravity: Vector::new(0.0, 0.0, -GRAVITY as f32),
            parameters,
            pipeline: PhysicsPipeline::new(),
            islands: IslandManager::new(),
            broad_phase: BroadPhaseBvh::default(),
            narrow_phase: NarrowPhase::new(),
            bodies: RigidBodySet::new(),
            colliders: ColliderSet::new(),
            joints: ImpulseJointSet::new(),
            multibodies: MultibodyJointSet::new(),
            soft_bodies: SoftBodySet::new(),
            ccd: CCDSolver::new(),
            steps: saved.steps,
            furniture: furniture.to_vec(),
            standing: Vec::new(),
            links: Vec::new(),
            base: configuration.base,
            drives: false,
            fingers_solid: vec![true; robot.arm_names().count()],
            objects: Vec::new(),
            riding: Riding::restored(riders(saved)),
            link_poses: robot.poses(configuration),
            link_names: robot.model.links.iter().map(|link| link.name.clone()).collect(),
            joined,
            speeds_before: Vec::new(),
        };
        environment.furnish();
        environment.add_robot(robot, configuration);
        for (model, state) in &saved.objects {
            environment.add(model, state);
        }
        environment
    }

    /// Saves the state for `restore`, and also remakes this environment from it, so that both continue alike: what the solver remembers of past
    /// contacts is not part of the state.
    pub fn save(&mut self, robot: &Robot, configuration: &Configuration) -> Saved {
        let saved = self.saved();
        self.make_again(robot, configuration, &saved);
        saved
    }

    pub(super) fn saved(&self) -> Saved {
        Saved { steps: self.steps, objects: self.states().collect() }
    }

    /// Remakes the bodies from a saved state; nothing else changes.
    pub(super) fn make_again(&mut self, robot: &Robot, configuration: &Configuration, saved: &Saved) {
        let (solid, joined) = (std::mem::take(&mut self.fingers_solid), std::mem::take(&mut self.joined));
        *self = Environment::made(robot, configuration, &self.furniture, saved, joined);
        solid.into_iter().enumerate().for_each(|(arm, solid)| self.set_fingers_solid(arm, solid));
    }

    /// The time of the last step.
    pub fn now(&self) -> Timestamp {
        Timestamp::default() + STEP * u32::try_from(self.steps).unwrap_or(u32::MAX)
    }

    /// The time of the next step.
    pub fn next_step(&self) -> Timestamp {
        self.now() + STEP
    }

    /// Whether every object stands still, or goes only where it is carried.
    pub fn is_at_rest(&self) -> bool {
        !self.riding.is_under_way() && self.objects.iter().all(|o| !self.moves(&self.bodies[o.body]))
    }

    /// Advances the time to the last step that is not after `until` without simulating: for when everything is at rest.
    pub fn skip_until(&mut self, until: Timestamp) {
        let steps = until.since(Timestamp::default()).as_nanos() / STEP.as_nanos();
        self.steps = self.steps.max(u64::try_from(steps).unwrap_or(u64::MAX));
    }

    /// Sets the time, whatever it was before.
    pub fn set_time(&mut self, now: Timestamp) {
        self.steps = 0;
        self.skip_until(now);
    }

    /// One step, in which the robot's joints move to `configuration`.
    pub fn step(&mut self, robot: &Robot, configuration: &Configuration) {
        self.take_along(robot, configuration);
        let before = std::mem::replace(&mut self.base, configuration.base);
        self.drives = before != configuration.base;
        // A contact recycled from the step before has its points where the carrier was then: on a turning deck, objects would creep outwards.
        self.parameters.contact_recycling = !self.drives;
        let poses = robot.poses(configuration);
        for link in &mut self.links {
            let (body, pose) = (&mut self.bodies[link.body], to_f32(&poses[link.link].compose(&link.pose)));
            let stands = link.at == pose;
            if stands != link.stands {
                // A body that is set to the pose that it has gets a velocity from rounding, and nothing on it would ever sleep.
                body.set_body_type(if stands { RigidBodyType::Fixed } else { LINK }, !stands);
            }
            if !stands {
                body.set_next_kinematic_position(pose);
            }
            (link.at, link.stands) = (pose, stands);
        }
        self.link_poses = poses;
        let left = self.objects.iter().map(|object| (object.body, &self.bodies[object.body]));
        self.speeds_before =
            left.filter(|(_, body)| body.is_dynamic()).map(|(handle, body)| (handle, Speed::of(body))).collect();
        self.pipeline.step(
            self.gravity,
            &self.parameters,
            &mut self.islands,
            &mut self.broad_phase,
            &mut self.narrow_phase,
            &mut self.bodies,
            &mut self.colliders,
            &mut self.joints,
            &mut self.multibodies,
            &mut self.soft_bodies,
            &mut self.ccd,
            &(),
            &(),
        );
        self.steps += 1;
        self.board(robot, configuration, before);
    }

    /// Pose and velocity of an object.
    pub fn state(&self, object: usize) -> ObjectState {
        let (body, rides) = (self.body(object), self.riding.seat(object));
        ObjectState {
            pose: to_f64(body.position()),
            velocity: body.linvel().to_array().map(f64::from),
            spin: body.angvel().to_array().map(f64::from),
            at_rest: body.is_sleeping(),
            carried: body.is_kinematic() && rides.is_none(),
            rides,
        }
    }

    /// Position of an object in the frame of the base.
    pub fn position_on_base(&self, object: usize) -> [f64; 3] {
        base_pose(self.base).inverse().transform(self.state(object).pose.position)
    }

    /// The model of an object.
    pub fn model(&self, object: usize) -> &Model {
        &self.objects[object].model
    }

    /// Number of objects.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether there is no object.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// Carries an object: from now on it is where it is put, and at `pose` after the next step. It pushes what it touches.
    pub fn carry(&mut self, object: usize, pose: &Pose) {
        self.alight(object);
        let body = &mut self.bodies[self.objects[object].body];
        if !body.is_kinematic() {
            body.set_body_type(RigidBodyType::KinematicPositionBased, true);
        }
        body.set_next_kinematic_position(to_f32(pose));
    }

    /// Releases an object at `pose` with a velocity; from now on it moves freely.
    pub fn let_go(&mut self, object: usize, pose: &Pose, velocity: [f64; 3]) {
        self.alight(object);
        let body = &mut self.bodies[self.objects[object].body];
        body.set_body_type(RigidBodyType::Dynamic, true);
        body.set_position(to_f32(pose), true);
        body.set_linvel(Vector::from_array(velocity.map(|v| v as f32)), true);
        body.set_angvel(Vector::ZERO, true);
    }

    /// Puts an object at `pose` from outside the simulation; from now on it moves freely.
    pub fn put(&mut self, object: usize, pose: &Pose) {
        let was = to_f64(self.bodies[self.objects[object].body].position());
        self.let_go(object, pose, [0.0; 3]);
        // A sleeping object that stood on it does not wake by itself.
        let reach = self.objects.iter().map(|o| (o.body, self.bodies[o.body].translation()));
        let near: Vec<RigidBodyHandle> = reach
            .filter(|(_, at)| (*at - Vector::from_array(was.position.map(|c| c as f32))).length() < 4.0 * LENGTH_UNIT_M)
            .map(|(body, _)| body)
            .collect();
        for body in near {
            self.bodies[body].wake_up(true);
        }
    }

    /// Sets whether the fingers of an arm push what they touch. While they close they do not: `grip` decides the result of closing.
    pub fn set_fingers_solid(&mut self, arm: usize, solid: bool) {
        match self.fingers_solid.get_mut(arm) {
            Some(known) if *known != solid => *known = solid,
            _ => return,
        }
        let groups = if solid { robot_groups() } else { InteractionGroups::none() };
        for collider in self.links.iter().filter(|link| link.finger_of == Some(arm)).flat_map(|link| &link.colliders) {
            self.colliders[*collider].set_collision_groups(groups);
        }
    }

    /// An object's body.
    pub(super) fn body(&self, object: usize) -> &RigidBody {
        &self.bodies[self.objects[object].body]
    }

    /// An object's body, mutable.
    pub(super) fn body_mut(&mut self, object: usize) -> &mut RigidBody {
        &mut self.bodies[self.objects[object].body]
    }

    /// Whether the support of this name is a link of the robot.
    pub(super) fn is_of_robot(&self, name: &str) -> bool {
        name != FLOOR && self.furniture.iter().all(|piece| piece.name != name)
    }

    /// A digest of the state of all objects, and the time.
    pub fn digest(&self) -> Digest {
        let mut digester = Digester::default();
        digester.number(self.steps);
        for object in &self.objects {
            let body = &self.bodies[object.body];
            let (at, turned) = (body.translation().to_array(), body.rotation().to_array());
            let moves = [body.linvel().to_array(), body.angvel().to_array()];
            let numbers = at.iter().chain(&turned).chain(moves.as_flattened());
            numbers.for_each(|x| digester.number(u64::from(x.to_bits())));
            digester.number(u64::from(body.is_sleeping()));
        }
        digester.finish()
    }

    /// The colliders of the primitives of a link.
    pub(super) fn link_colliders(&self, link: usize) -> impl Iterator<Item = ColliderHandle> + '_ {
        self.links
            .iter()
            .filter(move |body| body.link == link && !body.is_mesh)
            .flat_map(|body| body.colliders.iter().copied())
    }

    /// The colliders of floor and furniture, with their names.
    pub(super) fn fixed_colliders(&self) -> impl Iterator<Item = (&str, ColliderHandle)> + '_ {
        self.standing.iter().map(|(collider, name)| (name.as_str(), *collider))
    }

    /// An object's colliders.
    pub(super) fn object_colliders(&self, object: usize) -> impl Iterator<Item = ColliderHandle> + '_ {
        self.objects[object].parts.iter().copied()
    }

    /// The pose of a link.
    pub(super) fn link_pose(&self, link: usize) -> Pose {
        self.link_poses[link]
    }

    /// A body of a link.
    pub(super) fn link_body(&self, link: usize) -> Option<&RigidBody> {
        self.links.iter().find(|body| body.link == link).map(|body| &self.bodies[body.body])
    }

    /// The name of a link.
    pub(super) fn link_name(&self, link: usize) -> &str {
        &self.link_names[link]
    }

    /// The pairs of links that are built to touch.
    pub(super) fn joined(&self) -> &Joined {
        &self.joined
    }

    /// A collider with its body and pose.
    pub(super) fn placed(&self, collider: ColliderHandle) -> (&Collider, Option<&RigidBody>, Pose32) {
        let collider = &self.colliders[collider];
        (collider, collider.parent().map(|body| &self.bodies[body]), self.place(collider))
    }

    /// The pose of a collider. After the last step its body's pose may be newer than its own.
    fn place(&self, collider: &Collider) -> Pose32 {
        let parent = collider.parent().map(|body| *self.bodies[body].position());
        parent.map_or(*collider.position(), |body| {
            body * collider.position_wrt_parent().copied().unwrap_or(Pose32::IDENTITY)
        })
    }

    fn states(&self) -> impl Iterator<Item = (Model, ObjectState)> + '_ {
        (0..self.objects.len()).map(|i| (self.objects[i].model.clone(), self.state(i)))
    }

    fn furnish(&mut self) {
        let floor = (Pose::at(0.0, 0.0, -FLOOR_SIZE[2] / 2.0), FLOOR_SIZE);
        let floor = Furniture { name: FLOOR.to_owned(), parts: vec![floor] };
        for piece in std::iter::once(&floor).chain(&self.furniture) {
            for (pose, size) in &piece.parts {
                let [x, y, z] = size.map(|edge| edge as f32 / 2.0);
                let collider = ColliderBuilder::cuboid(x, y, z)
                    .position(to_f32(pose))
                    .friction(ROBOT_FRICTION)
                    .collision_groups(groups(OF_FURNITURE, OF_OBJECTS));
                self.standing.push((self.colliders.insert(collider), piece.name.clone()));
            }
        }
    }

    fn add_robot(&mut self, robot: &Robot, configuration: &Configuration) {
        let fingers: Vec<Vec<usize>> = (0..robot.arm_names().count()).map(|arm| robot.finger_links_of(arm)).collect();
        let poses = robot.poses(configuration);
        for (link, of_link) in robot.model.links.iter().enumerate() {
            let primitives = of_link.own_bodies().iter();
            let primitives = primitives.map(|body| (body.pose, vec![body.geometry.shape(0.0)], false));
            let meshes = self.joined.surfaces(link).iter();
            let meshes = meshes.map(|surface| (Pose::IDENTITY, surface.hulls().to_vec(), true));
            for (pose, shapes, is_mesh) in primitives.chain(meshes).collect::<Vec<_>>() {
                let at = to_f32(&poses[link].compose(&pose));
                let body = self.bodies.insert(RigidBodyBuilder::new(LINK).pose(at));
                let insert = |shape| {
                    let collider =
                        ColliderBuilder::new(shape).friction(ROBOT_FRICTION).collision_groups(robot_groups());
                    self.colliders.insert_with_parent(collider, body, &mut self.bodies)
                };
                let colliders = shapes.into_iter().map(insert).collect();
                let finger_of = fingers.iter().position(|of_arm| of_arm.contains(&link));
                self.links.push(RobotBody { body, colliders, is_mesh, finger_of, link, pose, at, stands: false });
            }
        }
    }

    fn add(&mut self, model: &Model, state: &ObjectState) {
        let vector = |v: [f64; 3]| Vector::from_array(v.map(|c| c as f32));
        let placed = state.carried || state.rides.is_some();
        let kind = if placed { RigidBodyType::KinematicPositionBased } else { RigidBodyType::Dynamic };
        let mut body = RigidBodyBuilder::new(kind)
            .pose(to_f32(&state.pose))
            .linvel(vector(state.velocity))
            .angvel(vector(state.spin))
            // Thin objects do not fall through thin boards.
            .ccd_enabled(model.kind == Kind::Fork || model.kind == Kind::Plate)
            .sleeping(state.at_rest)
            .build();
        body.activation_mut().time_until_sleep = STILL_S;
        let body = self.bodies.insert(body);
        let parts: Vec<_> = model.parts().iter().map(|(pose, shape)| Geometry::from(shape).at(*pose)).collect();
        let parts: Vec<_> = parts.iter().map(|part| (to_f32(&part.pose), part.geometry.shape(0.0))).collect();
        let volume: f32 = parts.iter().map(|(_, shape)| shape.mass_properties(1.0).mass()).sum();
        let density = model.mass_kg() as f32 / volume;
        let parts = parts.into_iter().map(|(pose, shape)| {
            let collider = ColliderBuilder::new(shape)
                .position(pose)
                .density(density)
                .friction(model.kind.friction() as f32)
                .collision_groups(groups(OF_OBJECTS, OF_OBJECTS | OF_ROBOT | OF_FURNITURE));
            self.colliders.insert_with_parent(collider, body, &mut self.bodies)
        });
        let parts = parts.collect();
        self.objects.push(Body { model: model.clone(), body, parts });
    }
}

/// The support of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Support<'a> {
    /// The floor, a piece of furniture, or a link of the robot.
    Named(&'a str),
    /// Another object.
    Object(usize),
}

/// The objects that rode when the state was saved.
fn riders(saved: &Saved) -> Vec<(usize, Pose)> {
    let states = saved.objects.iter().enumerate();
    states.filter_map(|(i, (_, state))| state.rides.map(|seat| (i, seat))).collect()
}

fn groups(of: Group, with: Group) -> InteractionGroups {
    InteractionGroups::new(of, with, InteractionTestMode::And)
}

fn robot_groups() -> InteractionGroups {
    groups(OF_ROBOT, OF_OBJECTS)
}

fn to_f64(pose: &Pose32) -> Pose {
    let quaternion = pose.rotation.to_array().map(f64::from);
    let length = quaternion.iter().map(|c| c * c).sum::<f64>().sqrt();
    Pose { position: pose.translation.to_array().map(f64::from), quaternion_xyzw: quaternion.map(|c| c / length) }
}
