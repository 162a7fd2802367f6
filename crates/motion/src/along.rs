//! Checks that a property holds on a whole timed curve: a proof, not samples.
//!
//! At the middle of a piece of the curve, `room` tells how far the tool may move and rotate from there. If no joint deviates so far within the piece
//! that the tool could exceed this (`levers`), the property holds on the piece; else its halves are checked.

use crate::joint_vector::JointVector;
use crate::levers::Levers;
use crate::trajectory::Curve;

/// Smaller violations may be missed, in metres and radians.
const RESOLUTION: f64 = 1e-5;

/// The first time, in seconds, at which the property does not hold. `room` returns how far the tool may move (metres) and rotate (radians) from a
/// posture; negative where the property does not hold.
pub(crate) fn first_breach(
    curve: &Curve,
    levers: &Levers,
    room: &mut dyn FnMut(&JointVector) -> [f64; 2],
) -> Option<f64> {
    let knots = curve.knots();
    if let [only] = knots {
        return room(&only.positions).iter().any(|left| *left < -RESOLUTION).then_some(only.time_s);
    }
    for (i, pair) in knots.windows(2).enumerate() {
        let cubics = curve.cubics(i);
        // In order of time: the last element is taken first.
        let mut pieces = vec![[0.0, pair[1].time_s - pair[0].time_s]];
        while let Some([from, to]) = pieces.pop() {
            let middle = (from + to) / 2.0;
            let posture = cubics.map(|cubic| cubic.position_at(middle));
            let strays = JointVector::from_fn(posture.len(), |j| {
                let [least, greatest] = cubics[j].range(from, to);
                (posture[j] - least).max(greatest - posture[j])
            });
            let moves = [levers.moves_m(&strays), levers.turns_rad(&strays)];
            let left = room(&posture);
            if left.iter().any(|left| *left < -RESOLUTION) {
                return Some(pair[0].time_s + middle);
            }
            let is_small = moves.iter().all(|by| *by < RESOLUTION);
            if !is_small && (0..2).any(|k| moves[k] > left[k]) {
                pieces.extend([[middle, to], [from, middle]]);
            }
        }
    }
    None
}
