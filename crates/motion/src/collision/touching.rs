//! Contacts of the gripper: what of it is inside an object in a posture, how deep, and the shortest way out.
//!
//! An arm that stands in contact has to be able to leave it (`leaving`). This file finds the contacts; it does not decide which are allowed. Only
//! contacts of the hand, the fingers and what they hold with objects of the scene count: never the other links of the arm, the robot itself, a box
//! to keep out of, or a cloud.

use super::{Checker, Collision, Entry, Other, Role};
use crate::distance;
use crate::joint_vector::JointVector;

/// A part of the gripper that is inside an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Touch {
    /// Indices in the checker.
    moving: usize,
    obstacle: usize,
    /// Whether the held object touches, not the gripper itself.
    pub(crate) is_held: bool,
    /// Penetration in metres, without any padding.
    pub(crate) depth_m: f64,
}

impl<'a> Checker<'a> {
    /// All parts of the gripper that are inside an object in a posture.
    pub(crate) fn touches(&mut self, arm: &JointVector) -> Vec<Touch> {
        self.place(arm);
        let mut touches = Vec::new();
        for (i, moving) in self.moving.iter().enumerate().filter(|(_, moving)| moving.role != Role::Arm) {
            // Fingers in a hollow object are in its filled shape, and touch nothing.
            let is_in_hollow = |o: usize| moving.role == Role::Finger && self.obstacles[o].entry == Entry::Open;
            for &o in moving.obstacles.iter().filter(|o| self.is_object(**o) && !is_in_hollow(**o)) {
                let depth_m = self.depth_in(i, o);
                if depth_m > 0.0 {
                    touches.push(Touch { moving: i, obstacle: o, is_held: moving.role == Role::Held, depth_m });
                }
            }
        }
        touches
    }

    /// Penetration of each touch in a posture, in metres; 0 without contact.
    pub(crate) fn depths_m(&mut self, touches: &[Touch], arm: &JointVector) -> Vec<f64> {
        self.place(arm);
        touches.iter().map(|touch| self.depth_in(touch.moving, touch.obstacle)).collect()
    }

    /// The same checker without the pairs of these touches.
    pub(crate) fn without(&self, touches: &[Touch]) -> Checker<'a> {
        let mut checker = self.clone();
        for touch in touches {
            checker.moving[touch.moving].obstacles.retain(|o| *o != touch.obstacle);
        }
        checker
    }

    /// Direction of the shortest way out of a touch, a unit vector in the world frame, for the posture checked last.
    pub(crate) fn way_out(&self, touch: &Touch) -> Option<[f64; 3]> {
        let (moving, obstacle) = (&self.moving[touch.moving], &self.obstacles[touch.obstacle]);
        let (own, other) = (&self.placed[touch.moving], &obstacle.pose);
        distance::way_out(own, &*moving.solid.shape, other, &*obstacle.solid.shape)
    }

    /// The touch, at this depth, as it is reported in messages.
    pub(crate) fn told(&self, touch: &Touch, depth_m: f64) -> Collision {
        let (moving, other) = (&self.moving[touch.moving].name, &self.obstacles[touch.obstacle].name);
        let (moving, other) = (moving.clone(), other.clone());
        Collision { moving, other, depth_m, padding_m: 0.0 }
    }

    /// Whether an obstacle is an object of the scene that may be touched.
    fn is_object(&self, o: usize) -> bool {
        self.obstacles[o].link.is_none() && self.obstacles[o].entry != Entry::Never
    }

    /// Penetration in the posture checked last.
    fn depth_in(&self, i: usize, o: usize) -> f64 {
        let reach = self.moving[i].radius + self.obstacles[o].radius;
        if self.centres[i].distance_squared(self.obstacles[o].centre) >= reach * reach {
            return 0.0;
        }
        (-self.apart_m(i, Other::Obstacle(o), 0.0)).max(0.0)
    }
}
