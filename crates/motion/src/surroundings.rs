//! All obstacles around a robot: primitive shapes, point clouds, meshes.

use crate::cloud::Cloud;
use crate::mesh::Mesh;
use crate::space::Obstacle;
use ratn_model::pose::Pose;
use std::sync::Arc;

/// Maximum distance by which the balls of the vector checks stand out of a mesh, unless it is very large, in metres.
pub const OVERHANG_M: f64 = 0.005;

/// A static mesh. Closed parts of it are solid.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshObstacle {
    /// Its name in messages.
    pub name: String,
    /// The pose of its frame.
    pub pose: Pose,
    /// Its triangles.
    pub mesh: Arc<Mesh>,
    /// How much larger the vector checks may treat it, in metres; more for a large mesh that would need over
    /// [`MOST_SAMPLES`](crate::surface::MOST_SAMPLES) balls.
    pub overhang_m: f64,
}

/// The obstacles; lists of primitive shapes convert to this.
#[derive(Debug, Clone, Copy, Default)]
pub struct Surroundings<'a> {
    /// Primitive shapes.
    pub obstacles: &'a [Obstacle],
    /// Point clouds.
    pub clouds: &'a [Cloud],
    /// Meshes.
    pub meshes: &'a [MeshObstacle],
}

impl<'a> From<&'a [Obstacle]> for Surroundings<'a> {
    fn from(obstacles: &'a [Obstacle]) -> Surroundings<'a> {
        Surroundings { obstacles, ..Surroundings::default() }
    }
}

impl<'a> From<&'a Vec<Obstacle>> for Surroundings<'a> {
    fn from(obstacles: &'a Vec<Obstacle>) -> Surroundings<'a> {
        Surroundings::from(&obstacles[..])
    }
}

impl<'a, const N: usize> From<&'a [Obstacle; N]> for Surroundings<'a> {
    fn from(obstacles: &'a [Obstacle; N]) -> Surroundings<'a> {
        Surroundings::from(&obstacles[..])
    }
}

impl<'a> From<&'a [Cloud]> for Surroundings<'a> {
    fn from(clouds: &'a [Cloud]) -> Surroundings<'a> {
        Surroundings { clouds, ..Surroundings::default() }
    }
}

impl<'a> From<&'a [MeshObstacle]> for Surroundings<'a> {
    fn from(meshes: &'a [MeshObstacle]) -> Surroundings<'a> {
        Surroundings { meshes, ..Surroundings::default() }
    }
}
