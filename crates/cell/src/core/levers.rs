//! Upper bounds of how far the links of a part move when its joints do, and motions that are reduced to a limited number of postures.
//!
//! A controller's course has a posture every few milliseconds. In a slow motion many of them hardly differ, and the speed of a motion says nothing
//! about its obstacles: such a motion is thinned.

use super::clearance::Part;
use ratn_model::pose::Pose;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{ArmPosition, Robot};

/// Allowed distance of any point from its position in the nearest posture that is kept, in metres: at first,
const FINEST_M: f64 = 0.001;
/// and at most, if there would be too many postures otherwise.
const COARSEST_M: f64 = 0.008;

/// Upper bounds of the motion of a part's bodies per joint motion: by the length of all links between, so they hold in every posture.
pub(super) struct Levers {
    /// In metres per radian, or per metre for a prismatic joint.
    joints: Vec<f64>,
    /// In metres per metre of the fingers.
    finger: f64,
}

/// A motion of which only some postures are kept.
#[derive(Debug, Clone)]
pub(super) struct Thinned {
    pub(super) way: Vec<JointVector>,
    /// Maximum distance of any point from its position in the nearest kept posture, in metres.
    pub(super) beside_m: f64,
}

impl Levers {
    /// The bounds for the bodies of these links of a part.
    pub(super) fn of(robot: &Robot, part: Part, of_part: &[usize]) -> Levers {
        let links = &robot.model.links;
        let joints: Vec<Option<usize>> =
            part.joints(robot).iter().map(|joint| robot.model.joint(&joint.name)).collect();
        let fingers: Vec<usize> =
            part.finger_links(robot).iter().filter_map(|link| Some(links[*link].drive?.joint)).collect();
        let mut levers = Levers { joints: vec![0.0; joints.len()], finger: 0.0 };
        for (link, body) in of_part.iter().flat_map(|link| links[*link].bodies.iter().map(move |body| (*link, body))) {
            let around = body.geometry.shape(0.0).compute_local_bounding_sphere();
            let radius = f64::from(around.center.length() + around.radius);
            let (mut of_joints, mut of_finger) = (vec![0.0; joints.len()], 0.0);
            let mut length = body.pose.distance(&Pose::IDENTITY) + radius;
            for index in std::iter::successors(Some(link), |index| links[*index].parent) {
                let link = &links[index];
                if let Some(drive) = link.drive {
                    let by = drive.factor.abs() * if drive.slides { 1.0 } else { length };
                    let joint = &robot.model.joints[drive.joint];
                    if let Some(j) = joints.iter().position(|joint| *joint == Some(drive.joint)) {
                        of_joints[j] += by;
                    } else if fingers.contains(&drive.joint) {
                        of_finger += by;
                    }
                    if drive.slides {
                        length += drive.factor.abs() * joint.lower.abs().max(joint.upper.abs());
                    }
                }
                length += link.origin.distance(&Pose::IDENTITY);
            }
            for (most, by) in levers.joints.iter_mut().zip(of_joints) {
                *most = most.max(by);
            }
            levers.finger = levers.finger.max(of_finger);
        }
        levers
    }

    /// Upper bound of the distance that any point of any body moves between two positions, in metres.
    pub(super) fn moved(&self, from: &ArmPosition, to: &ArmPosition) -> f32 {
        (self.moved_by_joints(&from.joints, &to.joints) + self.finger * (to.finger - from.finger).abs()) as f32
    }

    fn moved_by_joints(&self, from: &JointVector, to: &JointVector) -> f64 {
        self.joints.iter().enumerate().map(|(j, by)| by * (to[j] - from[j]).abs()).sum()
    }

    /// Postures that represent a whole motion: at most `most`, unless those are more than [`COARSEST_M`] apart.
    pub(super) fn thinned(&self, way: &[JointVector], most: usize) -> Thinned {
        let mut apart_m = FINEST_M;
        loop {
            let thinned = self.kept(way, apart_m);
            if thinned.way.len() <= most || apart_m >= COARSEST_M {
                return thinned;
            }
            apart_m *= 2.0;
        }
    }

    /// The first posture, the last one, and every one in which a point may have moved farther than `apart_m` since the last kept one.
    fn kept(&self, way: &[JointVector], apart_m: f64) -> Thinned {
        let mut thinned = Thinned { way: Vec::new(), beside_m: 0.0 };
        for (i, posture) in way.iter().enumerate() {
            let moved = thinned.way.last().map_or(f64::INFINITY, |last| self.moved_by_joints(last, posture));
            if moved > apart_m || i + 1 == way.len() {
                thinned.way.push(*posture);
            } else {
                thinned.beside_m = thinned.beside_m.max(moved);
            }
        }
        thinned
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_motion::robot::Configuration;

    /// Points of all bodies of the arm: the origin of each, and points at its radius along the axes.
    fn corners(robot: &Robot, at: &ArmPosition) -> Vec<[f64; 3]> {
        let poses = robot.poses(&Configuration { arm: at.joints, finger: at.finger, ..robot.at_zero() });
        let bodies = robot
            .links_of(0)
            .into_iter()
            .flat_map(|link| robot.model.links[link].bodies.iter().map(move |body| (link, body)));
        let of = |(link, body): (usize, &ratn_motion::geometry::Body)| {
            let around = body.geometry.shape(0.0).compute_local_bounding_sphere();
            let at = poses[link].compose(&body.pose);
            let radius = f64::from(around.radius);
            [[0.0; 3], [radius, 0.0, 0.0], [0.0, radius, 0.0], [0.0, 0.0, radius]].map(|point| at.transform(point))
        };
        bodies.flat_map(of).collect()
    }

    fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
        (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
    }

    #[test]
    fn nothing_moves_farther_than_the_levers_say() {
        let robot = Robot::aimm();
        let levers = Levers::of(&robot, Part::Arm(0), &robot.links_of(0));
        assert!(levers.joints.iter().all(|by| (0.05..2.5).contains(by)) && levers.finger == 1.0, "{:?}", levers.joints);
        let places = |at: &ArmPosition| corners(&robot, at);
        let from = ArmPosition { joints: robot.posture("home").unwrap(), finger: 0.0 };
        for j in 0..=from.joints.len() {
            let mut to = from;
            if j < from.joints.len() {
                to.joints[j] += 0.01;
            } else {
                to.finger += 0.01;
            }
            let (before, after) = (places(&from), places(&to));
            let moved = before.iter().zip(&after).map(|(a, b)| distance(a, b));
            let (most, bound) = (moved.fold(0.0, f64::max), f64::from(levers.moved(&from, &to)));
            assert!(most > 0.0 && most <= bound + 1e-6, "{j}: {most} {bound}");
        }
    }

    #[test]
    fn a_slow_way_keeps_no_more_postures_than_a_fast_one_and_none_of_it_is_far_from_those() {
        let robot = Robot::aimm();
        let levers = Levers::of(&robot, Part::Arm(0), &robot.links_of(0));
        let from = robot.posture("home").unwrap();
        let way = |steps: u32| -> Vec<JointVector> {
            let at = |i: u32| JointVector::from_fn(from.len(), |j| from[j] + 0.5 * f64::from(i) / f64::from(steps));
            (0..=steps).map(at).collect()
        };
        for most in [1_000, 100_000] {
            let [fast, slow] = [10_000, 100_000].map(|steps| levers.thinned(&way(steps), most));
            assert!(
                slow.way.len() <= most.min(fast.way.len() + fast.way.len() / 5),
                "{} {}",
                slow.way.len(),
                fast.way.len()
            );
            assert!(slow.beside_m > 0.0 && slow.beside_m <= COARSEST_M, "{}", slow.beside_m);
            let way = way(100_000);
            assert_eq!([slow.way.first(), slow.way.last()], [way.first(), way.last()]);
            for posture in way.iter().step_by(97) {
                let from_kept = slow.way.iter().map(|kept| levers.moved_by_joints(kept, posture));
                assert!(from_kept.fold(f64::INFINITY, f64::min) <= slow.beside_m + 1e-9);
            }
        }
        // A motion with long steps is not changed.
        let coarse = levers.thinned(&way(20), 100_000);
        assert_eq!((coarse.way, coarse.beside_m), (way(20), 0.0));
    }
}
