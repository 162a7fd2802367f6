//! Which elbow angles (also called arm angles or swivel angles) keep an arm within its joint limits.
//!
//! With a fixed tool pose, every entry of the shoulder's and of the wrist's rotation is `A sin t + B cos t + C` in the elbow angle `t`. The same
//! holds for the functions that are zero where a joint is at a limit: each limit cuts the circle of angles at two places at most, and between two
//! neighbouring cuts an arm is within its limits everywhere or nowhere (Shimizu, Kakuya, Yoon, Kitagaki, Kosuge: *Analytical Inverse Kinematic
//! Computation for 7-DOF Redundant Manipulators With Joint Limits and Its Application to Redundancy Resolution*, IEEE T-RO 24(5), 2008). So every
//! reachable pose is found, however small the arc.

use crate::joint_vector::JointVector;
use crate::robot::Joint;
use crate::spherical::{Spherical, about};
use crate::vector::rotate;
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// The angle of an arc that is closest to an outside angle is inside by this share of the width.
const INSIDE: f64 = 1e-3;

/// An interval of elbow angles, for one elbow bend, with postures within the limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Arc {
    /// The elbow's bend, in radians.
    pub bend: f64,
    /// The first elbow angle, in radians, within half a turn of zero.
    pub from: f64,
    /// The width of the interval, at most a whole turn.
    pub width: f64,
}

impl Arc {
    /// The elbow angle of this arc that is closest to `turn`, and its distance.
    pub(crate) fn nearest(&self, turn: f64) -> (f64, f64) {
        let beyond = (turn - self.from).rem_euclid(TAU);
        if beyond <= self.width {
            return (turn, 0.0);
        }
        let (past_end, before_start) = (beyond - self.width, TAU - beyond);
        // Exactly at the end a joint is at its limit, and rounding decides.
        let inside = self.width * INSIDE;
        let end_is_nearer = past_end < before_start;
        if end_is_nearer { (self.from + self.width - inside, past_end) } else { (self.from + inside, before_start) }
    }
}

/// All arcs of elbow angles that reach a pose within the limits, which are in the order of the positions.
pub(crate) fn arcs(arm: &Spherical, target: &Pose, limits: &[Joint]) -> Vec<Arc> {
    let mut arcs = Vec::new();
    let others = JointVector::zeros(limits.len());
    for bend in arm.bends_for(target) {
        let within = |turn: f64| {
            // Joints that do not belong to the arm keep their positions.
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

/// The elbow angles at which a joint may be at one of its limits, or a shoulder or wrist is stretched; sorted, at least one.
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
        // Where the outer axes are aligned, the two solutions for a rotation meet.
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
