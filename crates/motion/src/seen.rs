//! The points that a depth camera saw, as an obstacle for one motion.
//!
//! A camera sees the robot and the objects of the scene, too. These are known already, with better shapes than balls about points, so their points
//! are left out. The remaining points belong to unknown objects: the motion keeps away from them.

use crate::cloud::{Cloud, CloudError};
use crate::frame::compose;
use crate::hands::holder;
use crate::robot::{Body, Configuration, Geometry, Robot, to_f32};
use ratn_world::scene::{Placement, Scene};
use std::sync::Arc;

/// Default distance within which a point belongs to a known shape, in metres: the error of depth cameras.
pub const KNOWN_WITHIN_M: f64 = 0.02;

/// Balls about the points that a depth camera saw.
#[derive(Debug, Clone, PartialEq)]
pub struct Seen {
    /// The cloud in the world frame.
    pub cloud: Arc<Cloud>,
    /// Points within this distance of the robot in its start posture, or of an object of the scene, belong to these, in metres.
    pub known_within_m: f64,
}

impl Seen {
    /// The points that belong neither to the robot nor to the scene, in the world frame.
    ///
    /// # Errors
    /// None for a valid cloud.
    pub(crate) fn unknown(&self, robot: &Robot, scene: &Scene, here: &Configuration) -> Result<Cloud, CloudError> {
        let poses = robot.poses(here);
        let on_robot = |body: &Body, link: usize| Body { pose: compose(&poses[link], &body.pose), ..*body };
        let links = robot.model.links.iter().enumerate();
        let own = links.flat_map(|(link, of)| of.bodies.iter().map(move |body| (link, body)));
        let mut known: Vec<Body> = own.map(|(link, body)| on_robot(body, link)).collect();
        known.extend(scene.objects.iter().filter_map(|object| {
            let geometry = Geometry::from(&object.shape);
            match &object.placement {
                Placement::World(pose) => Some(geometry.at(*pose)),
                held => holder(robot, held).map(|(link, pose)| on_robot(&geometry.at(pose), link)),
            }
        }));
        let mut is_known = vec![false; self.cloud.points().len()];
        for body in &known {
            let shape = body.geometry.shape(0.0);
            self.cloud.visit_near(&to_f32(&body.pose), &shape, None, self.known_within_m as f32, &mut |point, _| {
                is_known[point] = true;
                true
            });
        }
        let points = self.cloud.points().iter().zip(&is_known).filter(|(_, is_known)| !**is_known);
        let points: Vec<[f32; 3]> = points.map(|(point, _)| *point).collect();
        Cloud::new(&self.cloud.name, &points, self.cloud.radius_m())
    }

    /// As [`Seen::unknown`], without the points of the floor, at z = 0, on which robots drive.
    ///
    /// # Errors
    /// None for a valid cloud.
    pub(crate) fn beside_the_floor(
        &self,
        robot: &Robot,
        scene: &Scene,
        here: &Configuration,
    ) -> Result<Cloud, CloudError> {
        let unknown = self.unknown(robot, scene, here)?;
        let is_above = |point: &&[f32; 3]| f64::from(point[2]) > self.known_within_m;
        let points: Vec<[f32; 3]> = unknown.points().iter().filter(is_above).copied().collect();
        Cloud::new(&unknown.name, &points, unknown.radius_m())
    }
}
