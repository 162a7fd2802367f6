//! Leaving what the gripper touches where the arm stands: what planners call a retreat from a start in contact.
//!
//! What is believed of an object may be off, or somebody has moved it, so that the gripper is in it where the arm stands. The arm may leave it on
//! a way on which it gets deeper into nothing: from posture to posture no part of the gripper may be deeper in an object than it has ever been
//! since the start, and what it has left is not touched again. All that was not touched at the start counts as ever
//! ([`Leaving::of_the_rest`]). So an arm that retreats pushes nothing.
//!
//! The gripper goes straight, and the depth of two convex shapes has no valley along a straight line: it is enough to look at postures close to each other.

use crate::collision::{Checker, Collision, Contact, Touch, between};
use crate::joint_vector::JointVector;

/// How much deeper something may be than it has ever been since the start, in metres: rounding, and what is no contact to anybody.
const GROWS_M: f64 = 5e-4;

/// What may touch what that did not at the start: fingers and what they hold may be nearer than the padding, as before a departure.
pub(crate) const NOTHING_NEW: Contact = Contact::Gripper(0.0);

/// What the gripper touched at the start, and how deep it has been at the least since.
#[derive(Debug, Clone)]
pub(crate) struct Leaving {
    touches: Vec<Touch>,
    /// Of the deepest at the start.
    told: Collision,
    shortest_way_out: Option<[f64; 3]>,
}

impl Leaving {
    /// From a posture in which the gripper is in something; `None` where it is in nothing.
    pub(crate) fn from(checker: &mut Checker<'_>, start: &JointVector) -> Option<Leaving> {
        let touches = checker.touches(start);
        let deepest = touches.iter().max_by(|a, b| a.depth_m.total_cmp(&b.depth_m))?;
        let (told, shortest_way_out) = (checker.told(deepest, deepest.depth_m), checker.way_out(deepest));
        Some(Leaving { touches, told, shortest_way_out })
    }

    /// What was touched deepest at the start.
    pub(crate) fn told(&self) -> Collision {
        self.told.clone()
    }

    /// Whether the held object touches something.
    pub(crate) fn is_of_held(&self) -> bool {
        self.touches.iter().any(|touch| touch.is_held)
    }

    /// The shortest way out of that, in the world frame, of length 1.
    pub(crate) fn shortest_way_out(&self) -> Option<[f64; 3]> {
        self.shortest_way_out
    }

    /// A checker of all that was not touched at the start.
    pub(crate) fn of_the_rest<'a>(&self, checker: &Checker<'a>) -> Checker<'a> {
        checker.without(&self.touches)
    }

    /// The arm goes straight from posture to posture, in the order of the motion; the same checker looks.
    ///
    /// # Errors
    /// What gets deeper.
    pub(crate) fn goes(
        &mut self,
        checker: &mut Checker<'_>,
        from: &JointVector,
        to: &JointVector,
    ) -> Result<(), Collision> {
        let steps = checker.steps(from, to);
        (1..=steps).try_for_each(|i| self.comes_to(checker, &between(from, to, i as f64 / steps as f64)))
    }

    /// The arm comes to a posture, close to the one before.
    ///
    /// # Errors
    /// What gets deeper.
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

    /// Whether everything that was touched has been left.
    pub(crate) fn is_over(&self) -> bool {
        self.touches.iter().all(|touch| touch.depth_m <= 0.0)
    }
}
