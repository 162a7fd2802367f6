//! The geometric scene, derived from facts.
//!
//! `shape(o) = {type: box, size: [x, y, z]}` or `{type: cylinder, radius: r, length: l}` (metres, centred, axis z) gives an
//! object its shape; `at(o) = pose` puts it into the world; `in_gripper(o) = pose` attaches it to the gripper's tool frame
//! (then `at(o)`, if any, is ignored). The mobile base stands at `at(base)`, which needs no shape.

use crate::world::World;
use ratn_model::fact::{FactPattern, Term};
use ratn_model::pose::Pose;
use ratn_model::value::Value;

/// The individual that names the robot's mobile base.
pub const BASE: &str = "base";

/// Shapes in their places.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Where the robot's base stands, in the world frame.
    pub base: Pose,
    /// In the order of names.
    pub objects: Vec<SceneObject>,
}

/// One object of the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneObject {
    /// The individual.
    pub name: String,
    /// Its shape.
    pub shape: Shape,
    /// Where it is.
    pub placement: Placement,
}

/// A shape, centred on its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
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

/// Where an object is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Placement {
    /// In the world frame.
    World(Pose),
    /// Held: as seen from the gripper's tool frame.
    Gripper(Pose),
}

/// A geometric fact that makes no geometry.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// A value of the wrong form.
    #[error("{fact} = {value}: expected {expected}")]
    Malformed {
        /// The fact.
        fact: String,
        /// Its value.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
}

impl Scene {
    /// The scene of a world. Objects with a shape but no place are not in it.
    ///
    /// # Errors
    /// [`SceneError::Malformed`] where a geometric fact has a value of another form.
    pub fn of(world: &World) -> Result<Scene, SceneError> {
        let mut scene = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        if let Some(pose) = pose_of(world, "at", &Term::Name(BASE.to_owned()))? {
            scene.base = pose;
        }
        let shapes = FactPattern { predicate: "shape".to_owned(), arguments: vec![None] };
        for (key, fact) in world.matching(&shapes) {
            let individual = &key.arguments[0];
            let placement = match pose_of(world, "in_gripper", individual)? {
                Some(pose) => Some(Placement::Gripper(pose)),
                None => pose_of(world, "at", individual)?.map(Placement::World),
            };
            if let Some(placement) = placement {
                let shape = shape(&fact.value).ok_or_else(|| SceneError::Malformed {
                    fact: key.to_string(),
                    value: fact.value.to_string(),
                    expected: "{type: box, size: [x, y, z]} or {type: cylinder, radius: r, length: l}, all above 0",
                })?;
                scene.objects.push(SceneObject { name: individual.to_string(), shape, placement });
            }
        }
        Ok(scene)
    }
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
    let key = ratn_model::fact::FactKey { predicate: predicate.to_owned(), arguments: vec![individual.clone()] };
    match world.get(&key) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::Pose(pose)) => Ok(Some(*pose)),
        Some(other) => {
            Err(SceneError::Malformed { fact: key.to_string(), value: other.to_string(), expected: "a pose" })
        }
    }
}

fn shape(value: &Value) -> Option<Shape> {
    let number = |name: &str| value.field(name).and_then(Value::as_number).filter(|x| *x > 0.0);
    match value.field("type")? {
        Value::String(kind) if kind == "box" => {
            let Some(Value::List(edges)) = value.field("size") else { return None };
            let size: Vec<f64> = edges.iter().filter_map(Value::as_number).filter(|x| *x > 0.0).collect();
            Some(Shape::Box { size: size.try_into().ok()? })
        }
        Value::String(kind) if kind == "cylinder" => {
            Some(Shape::Cylinder { radius: number("radius")?, length: number("length")? })
        }
        _ => None,
    }
}
