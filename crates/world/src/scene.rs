//! The geometric scene, derived from facts.
//!
//! `shape(o) = {type: box, size: [x, y, z]}` or `{type: cylinder, radius: r, length: l}` (metres, centred, axis z) gives an object its shape; `at(o) = pose`
//! places it in the world; `in_gripper(o) = pose` attaches it to the gripper's tool frame (then `at(o)`, if any, is ignored). For a robot with several arms,
//! `in_gripper(o, arm) = pose` names the arm. `on(o, carrier)` attaches it to the carrier that it stands on or in: the value is true, or its pose relative to
//! the carrier. An object on a held object is held with it, in the same relative position: that between the two `at`, unless the pose is given. The mobile base
//! stands at `at(base)`, and needs no shape.
//!
//! - [`Scene::of`]: makes the whole scene of a world
//! - [`live::LiveScene`]: follows the changes of a world; each change costs the objects that it moves
//! - [`delta::SceneDelta`]: the difference between two scenes, for a reader that has the first one

pub mod delta;
pub mod live;

use crate::world::World;
use ratn_model::fact::{FactKey, FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};

/// The individual that names the robot's mobile base.
pub const BASE: &str = "base";

/// Limit of objects on objects; beyond it, a circle is assumed.
pub const MAX_STACK: usize = 32;

/// Limit of sizes and distances, in metres, because planners compute in numbers of limited range.
pub const LARGEST_M: f64 = 1e6;

/// The objects with their places.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Pose of the robot's base in the world frame.
    pub base: Pose,
    /// The objects, by name.
    pub objects: Vec<SceneObject>,
}

/// One object of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneObject {
    /// The individual.
    pub name: String,
    /// Its shape.
    pub shape: Shape,
    /// Its place.
    pub placement: Placement,
}

/// A shape, centred on its frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Shape {
    /// Edge lengths in metres along x, y, z.
    Box {
        /// Edge lengths.
        size: [f64; 3],
    },
    /// Axis along z, in metres.
    Cylinder {
        /// Radius.
        radius: f64,
        /// Length along z.
        length: f64,
    },
}

/// The place of an object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Placement {
    /// In the world frame.
    World(Pose),
    /// Held: the pose in the gripper's tool frame. With several arms: of the arm that is planned for.
    Gripper(Pose),
    /// Held by the arm with this name: the pose in its tool frame.
    Hand {
        /// The arm, as the robot's description names it.
        arm: String,
        /// The pose in its tool frame.
        pose: Pose,
    },
}

/// Error: a geometric fact cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// The value has the wrong form.
    #[error("{fact} = {value}: expected {expected}")]
    Malformed {
        /// The fact.
        fact: String,
        /// Its value.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
    /// Objects stand on each other in a circle, or the stack is too high.
    #[error("`{individual}` stands on things in a circle, or on more than {MAX_STACK} of them: see its `on` facts")]
    Circle {
        /// One of them.
        individual: String,
    },
}

impl Scene {
    /// The scene of a world. Objects with a shape but no place are left out.
    ///
    /// # Errors
    /// [`SceneError::Malformed`] where a geometric fact has a value of another form.
    pub fn of(world: &World) -> Result<Scene, SceneError> {
        let mut scene = Scene { base: base(world)?, objects: Vec::new() };
        let shapes = FactPattern { predicate: "shape".to_owned(), arguments: vec![None] };
        for (key, _) in world.matching(&shapes) {
            scene.objects.extend(object(world, &key.arguments[0])?);
        }
        Ok(scene)
    }
}

/// The pose of the mobile base.
fn base(world: &World) -> Result<Pose, SceneError> {
    Ok(pose_of(world, "at", &Term::Name(BASE.to_owned()))?.unwrap_or(Pose::IDENTITY))
}

/// An individual, if it is an object of the scene.
fn object(world: &World, individual: &Term) -> Result<Option<SceneObject>, SceneError> {
    let key = FactKey { predicate: "shape".to_owned(), arguments: vec![individual.clone()] };
    let Some(value) = world.get(&key).filter(|value| **value != Value::Null) else { return Ok(None) };
    let Some(placement) = placement(world, individual, 0)? else { return Ok(None) };
    let shape = shape(value).ok_or_else(|| SceneError::Malformed {
        fact: key.to_string(),
        value: value.to_string(),
        expected: "{type: box, size: [x, y, z]} or {type: cylinder, radius: r, length: l}, all above 0 and at most 1000000 (metres)",
    })?;
    Ok(Some(SceneObject { name: individual.to_string(), shape, placement }))
}

/// The place of an individual, following the objects that it stands on.
fn placement(world: &World, individual: &Term, depth: usize) -> Result<Option<Placement>, SceneError> {
    if depth > MAX_STACK {
        return Err(SceneError::Circle { individual: individual.to_string() });
    }
    if let Some(pose) = pose_of(world, "in_gripper", individual)? {
        return Ok(Some(Placement::Gripper(pose)));
    }
    if let Some((arm, pose)) = hand(world, individual)? {
        return Ok(Some(Placement::Hand { arm, pose }));
    }
    let at = pose_of(world, "at", individual)?;
    if let Some((carrier, said)) = carrier(world, individual)? {
        let below = placement(world, &carrier, depth + 1)?;
        let seen = match (&below, said) {
            (Some(Placement::Gripper(_) | Placement::Hand { .. }), None) => {
                let of_carrier = pose_of(world, "at", &carrier)?;
                of_carrier.zip(at).map(|(carrier, at)| carrier.inverse().compose(&at))
            }
            (_, said) => said,
        };
        let placed = below.zip(seen).map(|(below, seen)| match below {
            Placement::World(pose) => Placement::World(pose.compose(&seen)),
            Placement::Gripper(pose) => Placement::Gripper(pose.compose(&seen)),
            Placement::Hand { arm, pose } => Placement::Hand { arm, pose: pose.compose(&seen) },
        });
        if placed.is_some() {
            return Ok(placed);
        }
    }
    Ok(at.map(Placement::World))
}

/// The arm that holds an individual, and the pose in its tool frame: the first in the order of keys.
fn hand(world: &World, individual: &Term) -> Result<Option<(String, Pose)>, SceneError> {
    let held = FactPattern { predicate: "in_gripper".to_owned(), arguments: vec![Some(individual.clone()), None] };
    for (key, fact) in world.matching(&held) {
        match &fact.value {
            Value::Pose(pose) => return Ok(Some((key.arguments[1].to_string(), *pose))),
            Value::Null | Value::Bool(false) => {}
            other => {
                let (fact, value) = (key.to_string(), other.to_string());
                return Err(SceneError::Malformed { fact, value, expected: "a pose" });
            }
        }
    }
    Ok(None)
}

/// The carrier of an individual (the first in the order of keys), and its pose relative to the carrier, if given.
fn carrier(world: &World, individual: &Term) -> Result<Option<(Term, Option<Pose>)>, SceneError> {
    let on = FactPattern { predicate: "on".to_owned(), arguments: vec![Some(individual.clone()), None] };
    for (key, fact) in world.matching(&on) {
        let carrier = || key.arguments[1].clone();
        match &fact.value {
            Value::Bool(true) => return Ok(Some((carrier(), None))),
            Value::Pose(pose) => return Ok(Some((carrier(), Some(*pose)))),
            Value::Bool(false) | Value::Null => {}
            other => {
                let (fact, value) = (key.to_string(), other.to_string());
                return Err(SceneError::Malformed {
                    fact,
                    value,
                    expected: "true, or a pose as seen from what it stands on",
                });
            }
        }
    }
    Ok(None)
}

impl Shape {
    /// The value of a `shape` fact.
    pub fn to_value(&self) -> Value {
        let number = |x: &f64| Value::Float(*x);
        match self {
            Shape::Box { size } => Value::map([
                ("type", Value::String("box".to_owned())),
                ("size", Value::List(size.iter().map(number).collect())),
            ]),
            Shape::Cylinder { radius, length } => Value::map([
                ("type", Value::String("cylinder".to_owned())),
                ("radius", number(radius)),
                ("length", number(length)),
            ]),
        }
    }
}

fn pose_of(world: &World, predicate: &str, individual: &Term) -> Result<Option<Pose>, SceneError> {
    let key = FactKey { predicate: predicate.to_owned(), arguments: vec![individual.clone()] };
    match world.get(&key) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::Pose(pose)) if pose.position.iter().all(|x| x.abs() <= LARGEST_M) => Ok(Some(*pose)),
        Some(Value::Pose(pose)) => Err(SceneError::Malformed {
            fact: key.to_string(),
            value: Value::Pose(*pose).to_string(),
            expected: "a pose no farther than 1000000 m along each axis",
        }),
        Some(other) => {
            Err(SceneError::Malformed { fact: key.to_string(), value: other.to_string(), expected: "a pose" })
        }
    }
}

fn shape(value: &Value) -> Option<Shape> {
    let is_length = |x: &f64| *x > 0.0 && *x <= LARGEST_M;
    let number = |name: &str| value.field(name).and_then(Value::as_number).filter(is_length);
    match value.field("type")? {
        Value::String(kind) if kind == "box" => {
            let Some(Value::List(edges)) = value.field("size") else { return None };
            let size: Option<Vec<f64>> = edges.iter().map(|edge| edge.as_number().filter(is_length)).collect();
            Some(Shape::Box { size: size?.try_into().ok()? })
        }
        Value::String(kind) if kind == "cylinder" => {
            Some(Shape::Cylinder { radius: number("radius")?, length: number("length")? })
        }
        _ => None,
    }
}
