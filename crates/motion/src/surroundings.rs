//! All that stands around a robot: primitive shapes, clouds of points, meshes.

use crate::cloud::Cloud;
use crate::mesh::Mesh;
use crate::space::Obstacle;
use ratn_model::pose::Pose;
use std::sync::Arc;

/// How far the balls of the vector checks stand out of a mesh at most, unless it is very large, in metres.
pub const OVERHANG_M: f64 = 0.005;

/// A mesh that stands still. Where it is closed it is solid.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshObstacle {
    /// For messages.
    pub name: String,
    /// Where its frame is.
    pub pose: Pose,
    /// Its triangles.
    pub mesh: Arc<Mesh>,
    /// How far the vector checks may take it larger, in metres; for [`MOST_SAMPLES`](crate::surface::MOST_SAMPLES) balls over a large mesh, more.
    pub overhang_m: f64,
}

/// What stands around; lists of primitive shapes become this by themselves.
#[derive(Debug, Clone, Copy, Default)]
pub struct Surroundings<'a> {
    /// Primitive shapes.
    pub obstacles: &'a [Obstacle],
    /// Points.
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
