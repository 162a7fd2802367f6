//! Collision check for an arm and its fingers that move at the same time, each with its own timing: any position of the fingers may come with any
//! posture of the arm.
//!
//! A stretch of the arm's way is checked together with a stretch of the fingers' way. Both are free if, at the middle of both, the distance to
//! everything is more than anything moves from there within them. Otherwise the stretch that causes the larger motion is halved, until nothing
//! moves by more than half a millimetre. That is the check of a trajectory (`validate`) with the fingers as one more joint, so nothing is too thin
//! to be found. Only pairs with a finger are compared: those of the arm's other links are part of the check of its trajectory.

use crate::collision::{Checker, Collision, Contact, RESOLUTION_M, between};
use crate::joint_vector::JointVector;

/// The maximum number of checks was not enough.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooLong;

/// A stretch of the arm's way with a stretch of the fingers' way.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    /// Start and end. A whole number is the index of a posture of the way; between two of them the way is straight.
    way: [f64; 2],
    /// Start and end, in metres from the middle.
    fingers: [f64; 2],
}

/// The first collision found while the arm follows a way through `postures` and each finger moves between two distances from the middle, in
/// metres. Pairs that already collide at the start of both are ignored. `checker` has no padding.
///
/// # Errors
/// If `most` checks do not decide it.
pub fn met_on_the_way(
    mut checker: Checker<'_>,
    postures: &[JointVector],
    fingers: [f64; 2],
    most: usize,
) -> Result<Option<Collision>, TooLong> {
    let Some(last) = postures.len().checked_sub(1) else { return Ok(None) };
    checker = checker.of_fingers();
    checker.set_finger(fingers[0]);
    while let Some(met) = checker.collision(&postures[0], Contact::None) {
        checker = checker.but_for(&met);
    }
    let mut stretches = vec![Stretch { way: [0.0, last as f64], fingers }];
    for _ in 0..most {
        let Some(stretch) = stretches.pop() else { return Ok(None) };
        let (posture, finger) = (at(postures, middle(stretch.way)), middle(stretch.fingers));
        checker.set_finger(finger);
        let by_arm_m = checker.moves_m(&strays(postures, stretch.way, &posture));
        let by_fingers_m = checker.fingers_move_m(stretch.fingers[1] - finger);
        let moves_m = by_arm_m + by_fingers_m;
        let room = match checker.room(&posture, Contact::None, moves_m) {
            Ok(room) => room,
            Err(met) => return Ok(Some(met)),
        };
        if room < moves_m && moves_m > RESOLUTION_M {
            stretches.extend(if by_fingers_m > by_arm_m {
                halves(stretch.fingers).map(|fingers| Stretch { fingers, ..stretch })
            } else {
                halves(stretch.way).map(|way| Stretch { way, ..stretch })
            });
        }
    }
    if stretches.is_empty() { Ok(None) } else { Err(TooLong) }
}

fn middle([from, to]: [f64; 2]) -> f64 {
    (from + to) / 2.0
}

/// Both halves; the first one is last, because the last is checked first.
fn halves(whole: [f64; 2]) -> [[f64; 2]; 2] {
    [[middle(whole), whole[1]], [whole[0], middle(whole)]]
}

/// The posture at a position of the way.
fn at(postures: &[JointVector], place: f64) -> JointVector {
    let before = place.floor() as usize;
    match postures.get(before + 1) {
        Some(next) => between(&postures[before], next, place.fract()),
        None => postures[before],
    }
}

/// Maximum deviation of each joint from a posture on a part of the way.
fn strays(postures: &[JointVector], [from, to]: [f64; 2], posture: &JointVector) -> JointVector {
    let within = &postures[from.ceil() as usize..=to.floor() as usize];
    let ends = [at(postures, from), at(postures, to)];
    ends.iter().chain(within).fold(JointVector::zeros(posture.len()), |most, other| {
        JointVector::from_fn(posture.len(), |j| most[j].max((other[j] - posture[j]).abs()))
    })
}
