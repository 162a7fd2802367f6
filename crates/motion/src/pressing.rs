//! Contacts on a straight part: followed from its contact end, which is the start of a departure or the goal of an approach.
//!
//! At the contact end the fingers and what they hold may press what is there, within a bound: poses are measured, and in a row a finger presses its
//! neighbours. Away from there nothing else is touched, nothing is pressed deeper, and what was left is not touched again. So nothing is passed
//! through, however thin it is: the penetration of two shapes is the shortest way out, which is short across a pen and at the edge of a shelf.
//!
//! Fingers and what they hold are fixed to the tool, so their contacts depend on the tool's pose alone, not on the posture of the elbow.

use crate::collision::{Checker, Collision, Contact, Press, between};
use crate::joint_vector::JointVector;
use crate::leaving::GROWS_M;
use std::collections::BTreeMap;

/// What is pressed at the contact end, with the minimum penetration of each since, in metres.
#[derive(Debug, Clone)]
pub(crate) struct Pressing {
    press_m: f64,
    least_m: BTreeMap<(usize, usize), f64>,
}

impl Pressing {
    /// At the contact end, where a penetration of `press_m` is allowed; negative: a distance to keep on the whole part.
    ///
    /// # Errors
    /// The first forbidden contact.
    pub(crate) fn at(checker: &mut Checker<'_>, end: &JointVector, press_m: f64) -> Result<Pressing, Collision> {
        match checker.collision(end, Contact::Gripper(press_m)) {
            Some(collision) => Err(collision),
            None => {
                let least_m = checker.presses().iter().map(|press| (press.pair, press.depth_m)).collect();
                Ok(Pressing { press_m, least_m })
            }
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
            self.comes(&checker.presses()).map_err(|press| checker.pressed(&press))
        })
    }

    /// The contacts in the next posture; the error is the one that is new or deeper.
    fn comes(&mut self, presses: &[Press]) -> Result<(), Press> {
        let least_m = |press: &Press| self.least_m.get(&press.pair).copied().unwrap_or(0.0);
        if let Some(press) = presses.iter().find(|press| press.depth_m > least_m(press) + GROWS_M) {
            return Err(*press);
        }
        let now: BTreeMap<(usize, usize), f64> = presses.iter().map(|press| (press.pair, press.depth_m)).collect();
        for (pair, least_m) in &mut self.least_m {
            *least_m = least_m.min(now.get(pair).copied().unwrap_or(0.0));
        }
        Ok(())
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
