//! Leaving an object that the gripper touches at the start: what planners call a retreat from a start in contact.
//!
//! The believed pose of an object may be wrong, or somebody has moved it, so that the gripper is inside it at the start. The arm may leave it on a
//! way on which no penetration grows: from posture to posture no part of the gripper may be deeper in an object than its minimum since the start,
//! and an object that has been left is not touched again. Everything that was not touched at the start is checked as always
//! ([`Leaving::of_the_rest`]). So a retreating arm pushes nothing.
//!
//! The gripper moves straight, and the penetration of two convex shapes has no valley along a straight line: checking postures close to each other
//! is enough.

use crate::collision::{Checker, Collision, Contact, RESOLUTION_M, Touch, between};
use crate::joint_vector::JointVector;

/// Tolerance for the growth of a penetration, in metres: rounding, and what nobody would call a contact.
pub(crate) const GROWS_M: f64 = 5e-4;

/// Contacts allowed with things not touched at the start: fingers and what they hold may be nearer than the padding, as before a departure.
pub(crate) const NOTHING_NEW: Contact = Contact::Gripper(0.0);

/// The contacts of the gripper at the start, with the minimum penetration of each since.
#[derive(Debug, Clone)]
pub(crate) struct Leaving {
    touches: Vec<Touch>,
    /// The deepest contact at the start.
    told: Collision,
    shortest_way_out: Option<[f64; 3]>,
}

impl Leaving {
    /// For a posture in which the gripper is inside something; `None` if it touches nothing.
    pub(crate) fn from(checker: &mut Checker<'_>, start: &JointVector) -> Option<Leaving> {
        let touches = checker.touches(start);
        let deepest = touches.iter().max_by(|a, b| a.depth_m.total_cmp(&b.depth_m))?;
        let (told, shortest_way_out) = (checker.told(deepest, deepest.depth_m), checker.way_out(deepest));
        Some(Leaving { touches, told, shortest_way_out })
    }

    /// The deepest contact at the start.
    pub(crate) fn told(&self) -> Collision {
        self.told.clone()
    }

    /// Whether the held object touches something.
    pub(crate) fn is_of_held(&self) -> bool {
        self.touches.iter().any(|touch| touch.is_held)
    }

    /// Direction of the shortest way out of the deepest contact, a unit vector in the world frame.
    pub(crate) fn shortest_way_out(&self) -> Option<[f64; 3]> {
        self.shortest_way_out
    }

    /// The checker for everything that was not touched at the start.
    pub(crate) fn of_the_rest<'a>(&self, checker: &Checker<'a>) -> Checker<'a> {
        checker.without(&self.touches)
    }

    /// Follows the arm on a straight motion from posture to posture, in the order of the motion, always with the same checker.
    ///
    /// # Errors
    /// The contact that gets deeper.
    pub(crate) fn goes(
        &mut self,
        checker: &mut Checker<'_>,
        from: &JointVector,
        to: &JointVector,
    ) -> Result<(), Collision> {
        let turns = JointVector::from_fn(from.len(), |j| to[j] - from[j]);
        let steps = ((checker.moves_m(&turns) / RESOLUTION_M).ceil() as usize).max(1);
        (1..=steps).try_for_each(|i| self.comes_to(checker, &between(from, to, i as f64 / steps as f64)))
    }

    /// Moves the arm to a posture close to the one before.
    ///
    /// # Errors
    /// The contact that gets deeper.
    pub(crate) fn comes_to(&mut self, checker: &mut Checker<'_>, posture: &JointVector) -> Result<(), Collision> {
        let depths_m = checker.depths_m(&self.touches, posture);
        for (touch, depth_m) in self.touches.iter_mut().zip(depths_m) {
            if depth_m > touch.depth_m + GROWS_M {
                return Err(checker.told(touch, depth_m));
            }
            touch.depth_m = touch.depth_m.min(depth_m);
        }
        Ok(())
    }

    /// Whether all contacts of the start have been left.
    pub(crate) fn is_over(&self) -> bool {
        self.touches.iter().all(|touch| touch.depth_m <= 0.0)
    }
}
