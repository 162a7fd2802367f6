//! Which turns of the elbow keep an arm within the limits of its joints.
//!
//! With the tool's pose held, every entry of the shoulder's and of the wrist's rotation is `A sin t + B cos t + C` in the turn
//! `t` of the elbow. So is what is zero where a joint is at a limit: each limit cuts the circle of turns at two places at the
//! most, and between two neighbouring cuts an arm is within its limits everywhere or nowhere (Shimizu, Kakuya, Yoon, Kitagaki,
//! Kosuge: *Analytical Inverse Kinematic Computation for 7-DOF Redundant Manipulators With Joint Limits and Its Application to
//! Redundancy Resolution*, IEEE T-RO 24(5), 2008). A pose that can be reached at all is found this way, however small the arc.

use crate::joint_vector::JointVector;
use crate::robot::Joint;
use crate::spherical::{Spherical, about};
use crate::vector::rotate;
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// What is closest to an arc is this share of its width inside of it.
const INSIDE: f64 = 1e-3;

/// Turns of the elbow with one bend of it, between which some posture is within the limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Arc {
    /// How far the elbow is bent, in radians.
    pub bend: f64,
    /// The first turn, in radians, within half a turn of zero.
    pub from: f64,
    /// How far it goes on from there, at most a whole turn.
    pub width: f64,
}

impl Arc {
    /// The turn of this arc that is closest to another one, and how far that is.
    pub(crate) fn nearest(&self, turn: f64) -> (f64, f64) {
        let beyond = (turn - self.from).rem_euclid(TAU);
        if beyond <= self.width {
            return (turn, 0.0);
        }
        let (past_end, before_start) = (beyond - self.width, TAU - beyond);
        // At the very end a joint is at its limit and rounding decides.
        let inside = self.width * INSIDE;
        let end_is_nearer = past_end < before_start;
        if end_is_nearer { (self.from + self.width - inside, past_end) } else { (self.from + inside, before_start) }
    }
}

/// All arcs of the turns that reach a pose within the limits, which are in the order of the positions.
pub(crate) fn arcs(arm: &Spherical, target: &Pose, limits: &[Joint]) -> Vec<Arc> {
    let mut arcs = Vec::new();
    let others = JointVector::zeros(limits.len());
    for bend in arm.bends_for(target) {
        let within = |turn: f64| {
            // Joints that are none of the arm's are wherever they are.
            let is_within = |posture: &JointVector| {
                arm.joints.iter().all(|i| (limits[*i].lower..=limits[*i].upper).contains(&posture[*i]))
            };
            arm.solve(target, bend, turn, limits, &others).iter().any(is_within)
        };
        let cuts = cuts(arm, target, bend, limits);
        for (i, from) in cuts.iter().enumerate() {
            let width = match cuts.get(i + 1) {
                Some(next) => next - from,
                None => cuts[0] + TAU - from,
            };
            if width > 0.0 && within(from + width / 2.0) {
                arcs.push(Arc { bend, from: *from, width });
            }
        }
    }
    arcs
}

/// The turns at which a joint may be at one of its limits, or a shoulder or a wrist stretched; sorted, at least one.
fn cuts(arm: &Spherical, target: &Pose, bend: f64, limits: &[Joint]) -> Vec<f64> {
    let rotations = [0.0, FRAC_PI_2, PI].map(|turn| arm.rotations(target, bend, turn));
    let mut cuts = Vec::new();
    for (ball, first) in [0, 4].into_iter().enumerate() {
        let [a, b, c] = [arm.axes[first], arm.axes[first + 1], arm.axes[first + 2]];
        let limits = |i: usize| {
            let joint = &limits[arm.joints[first + i]];
            [joint.lower, joint.upper]
        };
        let mut cut = |value: &dyn Fn(&Pose) -> f64| {
            let [at_zero, at_quarter, at_half] = rotations.each_ref().map(|both| value(&both[ball]));
            let (cosine, constant) = ((at_zero - at_half) / 2.0, f64::midpoint(at_zero, at_half));
            cuts.extend(zeros(at_quarter - constant, cosine, constant));
        };
        for limit in limits(0) {
            let seen = a.cross(rotate(&about(a, limit), a.cross(b)));
            cut(&|rotation| seen.dot(rotate(rotation, c)));
        }
        for limit in limits(2) {
            let seen = c.cross(rotate(&about(c, -limit), c.cross(b)));
            cut(&|rotation| seen.dot(rotate(&rotation.inverse(), a)));
        }
        for limit in limits(1) {
            let seen = a.dot(rotate(&about(b, limit), c));
            cut(&|rotation| a.dot(rotate(rotation, c)) - seen);
        }
        // Where the outer axes are in line the two ways to make a rotation change over.
        let size = a.dot(c).hypot(a.dot(b.cross(c)));
        for seen in [size, -size] {
            cut(&|rotation| a.dot(rotate(rotation, c)) - seen);
        }
    }
    cuts.push(0.0);
    cuts.sort_by(f64::total_cmp);
    cuts
}

/// The angles within half a turn of zero where `sine * sin + cosine * cos + constant` is zero.
fn zeros(sine: f64, cosine: f64, constant: f64) -> impl Iterator<Item = f64> {
    let size = sine.hypot(cosine);
    let found = size > f64::EPSILON && constant.abs() <= size * (1.0 + 1e-9);
    let (middle, half) = (sine.atan2(cosine), (-constant / size.max(f64::MIN_POSITIVE)).clamp(-1.0, 1.0).acos());
    let zeros = [middle - half, middle + half].map(|angle| angle - TAU * (angle / TAU).round());
    zeros.into_iter().filter(move |_| found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_of_a_wave_are_found_where_it_has_some() {
        for (sine, cosine, constant) in [(1.0, 0.0, 0.0), (0.3, -0.8, 0.5), (0.0, 2.0, -2.0), (-0.6, 0.1, 0.2)] {
            let zeros: Vec<f64> = zeros(sine, cosine, constant).collect();
            assert_eq!(zeros.len(), 2);
            assert!(
                zeros.iter().all(|t: &f64| (sine * t.sin() + cosine * t.cos() + constant).abs() < 1e-7),
                "{zeros:?}"
            );
        }
        assert_eq!(zeros(0.3, 0.4, 0.6).count(), 0);
        assert_eq!(zeros(0.0, 0.0, 0.0).count(), 0);
    }

    #[test]
    fn an_arc_over_half_a_turn_knows_its_nearest_turn() {
        let arc = Arc { bend: 0.0, from: 3.0, width: 1.0 };
        assert_eq!(arc.nearest(3.5), (3.5, 0.0));
        assert_eq!(arc.nearest(4.5 - TAU).0, 3.999);
        assert_eq!(arc.nearest(2.0).0, 3.001);
    }
}
