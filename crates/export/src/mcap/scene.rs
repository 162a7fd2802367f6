//! The objects as the task believes them, in the form that a viewer draws.

use crate::wire::foxglove::{
    Color, CubePrimitive, CylinderPrimitive, FrameTransform, FrameTransforms, Pose, Quaternion, SceneEntity,
    SceneEntityDeletion, SceneUpdate, Vector3,
};
use prost_types::Timestamp;
use ratn_executive::protocol::LogLine;
use ratn_report::believed::Believed;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

/// Coordinate frames: of the world, of the robot's base, and of the tool that holds objects.
const WORLD: &str = "world";
const BASE: &str = "base";
/// If the URDF has another name for its tool, held objects are not shown.
const TOOL: &str = "tool";
const GREY: Color = Color { r: 0.55, g: 0.6, b: 0.68, a: 0.6 };
const BLUE: Color = Color { r: 0.25, g: 0.5, b: 0.85, a: 1.0 };
/// An object with an edge at least this long is drawn as furniture.
const FURNITURE_M: f64 = 0.5;

/// What was shown of the world as believed by the run.
#[derive(Debug, Default)]
pub(super) struct Shown {
    believed: Believed,
    scene: Option<Scene>,
}

impl Shown {
    /// Whether a line changes the root world.
    pub(super) fn follow(&mut self, line: &LogLine) -> bool {
        self.believed.follow(line)
    }

    /// The changes since the last update. A world that yields no scene, because a fact has another form, gives no update.
    pub(super) fn update(&mut self, at: Timestamp) -> Option<SceneUpdate> {
        let scene = self.believed.scene()?;
        let before = self.scene.as_ref().map_or(&[][..], |shown| &shown.objects);
        let gone = before.iter().filter(|old| !scene.objects.iter().any(|new| new.name == old.name));
        let changed = scene.objects.iter().filter(|new| !before.contains(new));
        let deletions: Vec<SceneEntityDeletion> =
            gone.map(|old| SceneEntityDeletion { timestamp: Some(at), r#type: 0, id: old.name.clone() }).collect();
        let entities: Vec<SceneEntity> = changed.map(|object| entity(object, at)).collect();
        let is_new = self.scene.as_ref().is_none_or(|shown| shown.base != scene.base);
        self.scene = Some(scene);
        let update = SceneUpdate { deletions, entities };
        (is_new || !update.deletions.is_empty() || !update.entities.is_empty()).then_some(update)
    }

    /// The pose of the base.
    pub(super) fn base(&self, at: Timestamp) -> Option<FrameTransforms> {
        let base = self.scene.as_ref()?.base;
        Some(FrameTransforms {
            transforms: vec![FrameTransform {
                timestamp: Some(at),
                parent_frame_id: WORLD.to_owned(),
                child_frame_id: BASE.to_owned(),
                translation: Some(vector(base.position)),
                rotation: Some(quaternion(base.quaternion_xyzw)),
            }],
        })
    }
}

fn entity(object: &SceneObject, at: Timestamp) -> SceneEntity {
    let (frame, pose) = match object.placement {
        Placement::World(pose) => (WORLD, pose),
        // There is only one tool frame, whichever arm holds the object.
        Placement::Gripper(pose) | Placement::Hand { pose, .. } => (TOOL, pose),
    };
    let pose =
        Some(Pose { position: Some(vector(pose.position)), orientation: Some(quaternion(pose.quaternion_xyzw)) });
    let mut entity = SceneEntity {
        timestamp: Some(at),
        frame_id: frame.to_owned(),
        id: object.name.clone(),
        frame_locked: true,
        ..SceneEntity::default()
    };
    let colour = |longest: f64| Some(if longest >= FURNITURE_M { GREY } else { BLUE });
    match object.shape {
        Shape::Box { size } => {
            let longest = size.into_iter().fold(0.0, f64::max);
            entity.cubes.push(CubePrimitive { pose, size: Some(vector(size)), color: colour(longest) });
        }
        Shape::Cylinder { radius, length } => {
            let size = Some(vector([2.0 * radius, 2.0 * radius, length]));
            let color = colour(length.max(2.0 * radius));
            entity.cylinders.push(CylinderPrimitive { pose, size, bottom_scale: 1.0, top_scale: 1.0, color });
        }
    }
    entity
}

fn vector([x, y, z]: [f64; 3]) -> Vector3 {
    Vector3 { x, y, z }
}

fn quaternion([x, y, z, w]: [f64; 4]) -> Quaternion {
    Quaternion { x, y, z, w }
}
