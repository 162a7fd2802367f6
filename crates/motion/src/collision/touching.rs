//! Contacts of the gripper: what of it is inside something in a posture, how deep, and the shortest way out.
//!
//! This file finds the contacts; it does not decide which are allowed. An arm that stands in contact has to be able to leave it (`leaving`): of the
//! hand, the fingers and what they hold with objects of the scene, never of the other links of the arm, nor with the robot itself, a box to keep
//! out of, or a cloud. On straight parts the fingers and what they hold may press whatever they touch at the contact end (`pressing`).

use super::{Checker, Collision, Entry, Other, RESOLUTION_M, Role};
use crate::distance;
use crate::joint_vector::JointVector;
use std::collections::BTreeMap;

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

/// A contact of a finger, or of what it holds, with an obstacle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Press {
    /// The link, which is rigid though it may have several shapes, and the obstacle: indices in the checker.
    pub(crate) pair: (usize, usize),
    /// The shape of the link that is deepest.
    shape: usize,
    /// Penetration in metres, without any padding.
    pub(crate) depth_m: f64,
}

impl<'a> Checker<'a> {
    /// What fingers, and what they hold, are in in the posture checked last, one contact for each link and obstacle. Fingers are in no hollow object. A
    /// cloud is in none: its balls are larger than what was seen, which lies at their centres.
    pub(crate) fn presses(&self) -> Vec<Press> {
        let mut presses: BTreeMap<(usize, usize), Press> = BTreeMap::new();
        for i in (0..self.moving.len()).filter(|i| self.can_press(*i)) {
            for &o in self.moving[i].obstacles.iter().filter(|o| !self.is_in_hollow(i, **o)) {
                let press = Press { pair: (self.moving[i].link, o), shape: i, depth_m: self.depth_in(i, o) };
                if press.depth_m > 0.0 {
                    let deepest = presses.entry(press.pair).or_insert(press);
                    if press.depth_m > deepest.depth_m {
                        *deepest = press;
                    }
                }
            }
        }
        presses.into_values().collect()
    }

    /// The contact, as it is reported in messages.
    pub(crate) fn pressed(&self, press: &Press) -> Collision {
        self.contact(press.shape, press.pair.1, press.depth_m)
    }

    fn contact(&self, i: usize, o: usize, depth_m: f64) -> Collision {
        let (moving, other) = (self.moving[i].name.clone(), self.obstacles[o].name.clone());
        Collision { moving, other, depth_m, padding_m: 0.0 }
    }

    /// Number of equal steps into which the motion between two close postures must be cut so that in one step no shape that may press something
    /// near it moves further than [`RESOLUTION_M`]; 1 where nothing is near. The second posture is the one checked last.
    pub(crate) fn steps_of_presses(&mut self, from: &JointVector, to: &JointVector) -> usize {
        self.place(from);
        let before = self.placed.clone();
        self.place(to);
        let mut steps = 1;
        for i in (0..self.moving.len()).filter(|i| self.can_press(*i)) {
            let (was, moving) = (before[i].transform_point(self.moving[i].middle), &self.moving[i]);
            let turned = 2.0 * (before[i].rotation.inverse() * self.placed[i].rotation).xyz().length();
            let moves_m = f64::from((self.centres[i] - was).length() + turned * moving.radius);
            let is_near =
                |o: &usize| self.is_within(i, *o, moves_m) && self.apart_m(i, Other::Obstacle(*o), moves_m) < moves_m;
            if moving.obstacles.iter().any(is_near) {
                steps = steps.max((moves_m / RESOLUTION_M).ceil() as usize);
            }
        }
        steps
    }

    /// All parts of the gripper that are inside an object in a posture.
    pub(crate) fn touches(&mut self, arm: &JointVector) -> Vec<Touch> {
        self.place(arm);
        let mut touches = Vec::new();
        for (i, moving) in self.moving.iter().enumerate().filter(|(_, moving)| moving.role != Role::Arm) {
            for &o in moving.obstacles.iter().filter(|o| self.is_object(**o) && !self.is_in_hollow(i, **o)) {
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
        let way = distance::way_out(own, &*moving.solid.shape, other, &*obstacle.solid.shape)?;
        Some(self.base.rotate(way))
    }

    /// The touch, at this depth, as it is reported in messages.
    pub(crate) fn told(&self, touch: &Touch, depth_m: f64) -> Collision {
        self.contact(touch.moving, touch.obstacle, depth_m)
    }

    /// Whether an obstacle is an object of the scene that may be touched.
    fn is_object(&self, o: usize) -> bool {
        self.obstacles[o].link.is_none() && self.obstacles[o].entry != Entry::Never
    }

    /// Whether this is a finger beside a hollow object: it may be in the filled shape of that, and touches nothing.
    fn is_in_hollow(&self, i: usize, o: usize) -> bool {
        self.moving[i].role == Role::Finger && self.obstacles[o].entry == Entry::Open
    }

    /// Whether the bounding spheres are nearer to each other than `within_m` metres in the posture checked last.
    fn is_within(&self, i: usize, o: usize, within_m: f64) -> bool {
        let reach = self.moving[i].radius + self.obstacles[o].radius + within_m as f32;
        self.centres[i].distance_squared(self.obstacles[o].centre) < reach * reach
    }

    /// Penetration in the posture checked last.
    fn depth_in(&self, i: usize, o: usize) -> f64 {
        if !self.is_within(i, o, 0.0) {
            return 0.0;
        }
        (-self.apart_m(i, Other::Obstacle(o), 0.0)).max(0.0)
    }
}
