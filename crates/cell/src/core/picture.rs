//! What the camera sees: the true scene at one moment, including the robot, and the frames taken of it.

use super::environment::Model;
use super::placement::furniture;
use crate::config::Setting;
use ratn_model::pose::Pose;
use ratn_motion::robot::{Configuration, Robot, to_f32};
use ratn_perception::camera::{Camera, DepthImage};
use ratn_perception::noise::{Noise, average, observe};
use ratn_perception::photograph::photograph;
use ratn_perception::picture::Picture;
use ratn_perception::render::{Body, render};
use ratn_world::scene::Shape;

/// The true scene at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Scenery {
    /// The true configuration of the robot.
    pub configuration: Configuration,
    /// The measured configuration of the robot.
    pub measured: Configuration,
    /// The true pose of the camera's optical frame, in the world.
    pub eye: Pose,
    /// The setting, which determines the furniture.
    pub setting: Setting,
    /// All movable objects and their poses in the world frame.
    pub objects: Vec<(Model, Pose)>,
}

/// Frames of a scene that did not change.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposure {
    /// The scene.
    pub scenery: Scenery,
    /// The number of the first frame since the cell began.
    pub first_frame: u64,
    /// Number of frames.
    pub frames: u32,
}

/// Red, green and blue of the bodies in a photograph.
const ROBOT_COLOUR: [u8; 3] = [235, 140, 40];
const TABLE_COLOUR: [u8; 3] = [170, 125, 85];
const FLOOR_COLOUR: [u8; 3] = [140, 140, 145];
const OBJECT_COLOUR: [u8; 3] = [60, 120, 200];

/// The floor around the robot, in metres; its top is at z = 0.
const FLOOR_SIZE: [f64; 3] = [12.0, 12.0, 0.1];

impl Scenery {
    /// All bodies that the camera could see.
    pub fn bodies(&self, robot: &Robot) -> Vec<Body> {
        self.in_colours(robot).into_iter().map(|(body, _)| body).collect()
    }

    /// A colour picture for people, from any camera pose.
    pub fn photograph(&self, robot: &Robot, camera: &Camera) -> Picture {
        photograph(camera, &self.in_colours(robot))
    }

    fn in_colours(&self, robot: &Robot) -> Vec<(Body, [u8; 3])> {
        let links = robot.shapes(&self.configuration).into_iter();
        let links = links.map(|(_, pose, shape)| (Body { shape, pose }, ROBOT_COLOUR));
        let pieces = furniture(robot, self.setting).into_iter().flat_map(|piece| piece.parts);
        let pieces = pieces.map(|(pose, size)| (Body::new(&Shape::Box { size }, &pose), TABLE_COLOUR));
        let floor = Body::new(&Shape::Box { size: FLOOR_SIZE }, &Pose::at(0.0, 0.0, -FLOOR_SIZE[2] / 2.0));
        let objects = self
            .objects
            .iter()
            .map(|(model, pose)| (Body { shape: model.seen().solid(), pose: to_f32(pose) }, OBJECT_COLOUR));
        links.chain(pieces).chain([(floor, FLOOR_COLOUR)]).chain(objects).collect()
    }
}

/// The average of all frames, each from the true camera pose; a moving body is left out where what stands behind it was seen. Takes milliseconds per
/// exposure.
pub fn develop(robot: &Robot, camera: &Camera, noise: &Noise, seed: u64, exposures: &[Exposure]) -> DepthImage {
    let pictures = exposures.iter().map(|exposure| {
        let eye = Camera { pose: exposure.scenery.eye, ..*camera };
        let clean = render(&eye, &exposure.scenery.bodies(robot));
        (observe(&clean, &camera.intrinsics, noise, seed, exposure.first_frame, exposure.frames), exposure.frames)
    });
    average(camera.intrinsics.width, camera.intrinsics.height, noise, pictures)
}
