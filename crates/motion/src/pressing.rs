//! Contacts on a straight part: followed from its contact end, which is the start of a departure or the goal of an approach.
//!
//! At the contact end the fingers and what they hold may press what is there, within a bound: poses are measured, and in a row a finger presses its
//! neighbours. Away from there nothing else is touched, nothing is pressed deeper, and what was left is not touched again. So nothing is passed
//! through, however thin it is: the penetration of two shapes is the shortest way out, which is short across a pen and at the edge of a shelf.
//!
//! Fingers and what they hold are fixed to the tool, so their contacts depend on the tool's pose alone, not on the posture of the elbow.

use crate::collision::{Against, Checker, Collision, Contact, between};
use crate::joint_vector::JointVector;
use crate::leaving::GROWS_M;
use std::collections::BTreeMap;

/// What is pressed at the contact end, with the minimum penetration of each since, in metres.
#[derive(Debug, Clone)]
pub(crate) struct Pressing {
    press_m: f64,
    least_m: BTreeMap<(usize, Against), f64>,
}

impl Pressing {
    /// At the contact end, where a penetration of `press_m` is allowed; negative: a distance to keep on the whole part.
    ///
    /// # Errors
    /// The first forbidden contact.
    pub(crate) fn at(checker: &mut Checker<'_>, end: &JointVector, press_m: f64) -> Result<Pressing, Collision> {
        match checker.collision(end, Contact::Gripper(press_m)) {
            Some(collision) => Err(collision),
            None => Ok(Pressing { press_m, least_m: checker.presses().into_iter().collect() }),
        }
    }

    /// Follows the arm to the next posture away from the contact end.
    ///
    /// # Errors
    /// The first forbidden contact.
    pub(crate) fn goes(
        &mut self,
        checker: &mut Checker<'_>,
        from: &JointVector,
        to: &JointVector,
    ) -> Result<(), Collision> {
        let steps = checker.steps(from, to);
        let at = |i: usize| between(from, to, i as f64 / steps as f64);
        (0..steps).try_for_each(|i| self.steps(checker, &at(i), &at(i + 1)))
    }

    fn steps(&mut self, checker: &mut Checker<'_>, from: &JointVector, to: &JointVector) -> Result<(), Collision> {
        if let Some(collision) = checker.collision(to, Contact::Gripper(self.press_m)) {
            return Err(collision);
        }
        let steps = checker.steps_of_presses(from, to);
        (1..=steps).try_for_each(|i| {
            checker.place(&between(from, to, i as f64 / steps as f64));
            self.comes(&checker.presses()).map_err(|(what, depth_m)| checker.pressed(what, depth_m))
        })
    }

    /// The contacts in the next posture; the error is the one that is new or deeper.
    fn comes(&mut self, presses: &[((usize, Against), f64)]) -> Result<(), ((usize, Against), f64)> {
        let now: BTreeMap<(usize, Against), f64> = presses.iter().copied().collect();
        for (what, least_m) in &mut self.least_m {
            let depth_m = now.get(what).copied().unwrap_or(0.0);
            if depth_m > *least_m + GROWS_M {
                return Err((*what, depth_m));
            }
            *least_m = least_m.min(depth_m);
        }
        let is_new = |(what, depth_m): &((usize, Against), f64)| !self.least_m.contains_key(what) && *depth_m > GROWS_M;
        presses.iter().copied().find(is_new).map_or(Ok(()), Err)
    }
}

/// The first forbidden contact on a straight part, whose postures begin at its contact end.
pub(crate) fn straight_collision(
    checker: &mut Checker<'_>,
    postures: &[JointVector],
    press_m: f64,
) -> Option<Collision> {
    let mut pressing = match Pressing::at(checker, &postures[0], press_m) {
        Ok(pressing) => pressing,
        Err(collision) => return Some(collision),
    };
    postures.windows(2).find_map(|pair| pressing.goes(checker, &pair[0], &pair[1]).err())
}
