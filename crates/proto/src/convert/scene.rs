//! Scenes, as differences from known ones.

use super::{Malformed, each, missing_choice, required};
use crate::v1;
use crate::v1::scene_shape::Kind;
use ratn_model::fact::Term;
use ratn_world::digest::Digest;
use ratn_world::scene::delta::SceneDelta;
use ratn_world::scene::{Placement, SceneObject, Shape};

/// A digest from its bytes.
///
/// # Errors
/// There are not exactly 32 bytes.
pub fn digest(bytes: &[u8], field: &str) -> Result<Digest, Malformed> {
    let wrong = |_| Malformed::new(field, format!("has {} bytes: a digest has 32", bytes.len()));
    bytes.try_into().map(Digest::from_bytes).map_err(wrong)
}

impl From<SceneDelta> for v1::GetSceneResponse {
    fn from(delta: SceneDelta) -> v1::GetSceneResponse {
        v1::GetSceneResponse {
            from: delta.from.map_or_else(Vec::new, |from| from.as_bytes().to_vec()),
            to: delta.to.as_bytes().to_vec(),
            base: Some(delta.base.into()),
            gone: delta.gone.into_iter().map(v1::Term::from).collect(),
            changed: delta.changed.into_iter().map(|(individual, object)| wire(individual, &object)).collect(),
        }
    }
}

impl TryFrom<v1::GetSceneResponse> for SceneDelta {
    type Error = Malformed;

    fn try_from(scene: v1::GetSceneResponse) -> Result<SceneDelta, Malformed> {
        Ok(SceneDelta {
            from: if scene.from.is_empty() { None } else { Some(digest(&scene.from, "from")?) },
            to: digest(&scene.to, "to")?,
            base: required(scene.base, "base")?,
            gone: each(scene.gone, "gone")?,
            changed: each::<_, Placed>(scene.changed, "changed")?.into_iter().map(|placed| placed.0).collect(),
        })
    }
}

fn wire(individual: Term, object: &SceneObject) -> v1::SceneObject {
    let kind = match object.shape {
        Shape::Box { size } => Kind::Box(v1::SceneBox { size_m: size.to_vec() }),
        Shape::Cylinder { radius, length } => Kind::Cylinder(v1::SceneCylinder { radius_m: radius, length_m: length }),
    };
    let (pose, held, held_by) = match &object.placement {
        Placement::World(pose) => (*pose, false, String::new()),
        Placement::Gripper(pose) => (*pose, true, String::new()),
        Placement::Hand { arm, pose } => (*pose, true, arm.clone()),
    };
    v1::SceneObject {
        individual: Some(individual.into()),
        shape: Some(v1::SceneShape { kind: Some(kind) }),
        pose: Some(pose.into()),
        held,
        held_by,
    }
}

/// An individual with its object.
struct Placed((Term, SceneObject));

impl TryFrom<v1::SceneObject> for Placed {
    type Error = Malformed;

    fn try_from(object: v1::SceneObject) -> Result<Placed, Malformed> {
        let individual: Term = required(object.individual, "individual")?;
        let shape = object.shape.ok_or_else(|| Malformed::new("shape", "is missing"))?;
        let shape = match shape.kind.ok_or_else(|| missing_choice("box, cylinder"))? {
            Kind::Box(v1::SceneBox { size_m }) => {
                let size =
                    size_m.as_slice().try_into().map_err(|_| Malformed::new("shape", "a box has three edges"))?;
                Shape::Box { size }
            }
            Kind::Cylinder(v1::SceneCylinder { radius_m, length_m }) => {
                Shape::Cylinder { radius: radius_m, length: length_m }
            }
        };
        let lengths: &[f64] = match &shape {
            Shape::Box { size } => size,
            Shape::Cylinder { radius, length } => &[*radius, *length],
        };
        if lengths.iter().any(|length| !length.is_finite() || *length <= 0.0) {
            return Err(Malformed::new("shape", "lengths are numbers above 0"));
        }
        let pose = required(object.pose, "pose")?;
        let placement = match (object.held, object.held_by) {
            (false, _) => Placement::World(pose),
            (true, arm) if arm.is_empty() => Placement::Gripper(pose),
            (true, arm) => Placement::Hand { arm, pose },
        };
        Ok(Placed((individual.clone(), SceneObject { name: individual.to_string(), shape, placement })))
    }
}
