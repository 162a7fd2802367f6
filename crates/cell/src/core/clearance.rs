//! Whether two arms that move at once keep apart.
//!
//! Either may be stopped anywhere on its way: its goal is cancelled, its lease ends, a fault brakes it. So the ways are compared whatever
//! the timing: wherever one arm may be on the rest of its way, the other one keeps [`APART_M`] from it on all of its own. Controllers know
//! the robot's links, not what stands around them; so what the hands hold is not looked at here, the judge sees that (`contacts`).
//!
//! An arm that stands is no matter of this file: a trajectory is checked against it with everything else of the robot's body.

use rapier3d::math::Pose as Pose32;
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::parry::query;
use rapier3d::parry::shape::SharedShape;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Robot};

/// How far from each other two arms keep that are on their ways at once, in metres.
pub(super) const APART_M: f64 = 0.02;

/// How far a point of a link may move from one looked-at posture to the next, in metres. Half of it on either side may be missed, which
/// is added to what is looked for.
const STEP_M: f64 = 0.02;

/// A link of each of two arms that come too close.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TooClose {
    /// Of the arm that is asked about.
    pub(super) link: String,
    /// Of the other one.
    pub(super) other: String,
}

/// The way that an arm has before it.
pub(super) struct Ahead<'a> {
    /// The arm's number.
    pub(super) arm: usize,
    /// Postures of the arm, near each other, in the order of time.
    pub(super) postures: &'a [JointVector],
}

/// One body of a link, wherever it is on the way.
struct Swept {
    link: usize,
    shape: SharedShape,
    radius: f32,
    places: Vec<Pose32>,
    around: Aabb,
}

/// Where two arms come nearer to each other than [`APART_M`], of a robot that is elsewhere as in `here`.
pub(super) fn too_close(robot: &Robot, here: &Configuration, one: &Ahead<'_>, other: &Ahead<'_>) -> Option<TooClose> {
    let margin = (APART_M + STEP_M) as f32;
    let (ours, theirs) = (swept(robot, here, one), swept(robot, here, other));
    for a in &ours {
        let around = a.around.loosened(margin);
        let near = theirs.iter().filter(|b| !robot.model.is_excepted(a.link, b.link) && around.intersects(&b.around));
        for b in near {
            let reach = a.radius + b.radius + margin;
            let meet = |at: &Pose32, of: &Pose32| {
                let apart = (at.translation - of.translation).length_squared();
                // A pair whose distance cannot be computed counts as one that is too close.
                apart < reach * reach
                    && query::distance(at, &*a.shape, of, &*b.shape).map_or(true, |apart| apart.distance < margin)
            };
            if a.places.iter().any(|at| b.places.iter().any(|of| meet(at, of))) {
                let name = |link: usize| robot.model.links[link].name.clone();
                return Some(TooClose { link: name(a.link), other: name(b.link) });
            }
        }
    }
    None
}

/// The bodies of an arm's links at postures so near to each other that no point of them moves farther than [`STEP_M`] in between.
fn swept(robot: &Robot, here: &Configuration, ahead: &Ahead<'_>) -> Vec<Swept> {
    let links = robot.links_of(ahead.arm);
    let mut swept: Vec<Swept> = Vec::new();
    let mut last: Option<Vec<(Pose32, f32)>> = None;
    for (i, posture) in ahead.postures.iter().enumerate() {
        let mut configuration = *here;
        configuration.set_joints(ahead.arm, *posture);
        let shapes = robot.shapes(&configuration).into_iter().filter(|(link, ..)| links.contains(link));
        let shapes: Vec<(usize, Pose32, SharedShape)> = shapes.collect();
        let is_last = i + 1 == ahead.postures.len();
        let moved = |last: &Vec<(Pose32, f32)>| {
            let farthest = last.iter().zip(&shapes).map(|((before, radius), (_, now, _))| {
                let turned = (before.rotation.inverse() * now.rotation).to_array()[3].abs().min(1.0).acos() * 2.0;
                (now.translation - before.translation).length() + radius * turned
            });
            farthest.fold(0.0, f32::max)
        };
        // The other half is left for the posture that goes beyond it: from one to the next pass 4 ms.
        if !is_last && last.as_ref().is_some_and(|last| moved(last) < 0.5 * STEP_M as f32) {
            continue;
        }
        let radius = |shape: &SharedShape| {
            let around = shape.compute_local_bounding_sphere();
            around.center.length() + around.radius
        };
        last = Some(shapes.iter().map(|(_, pose, shape)| (*pose, radius(shape))).collect());
        for (index, (link, pose, shape)) in shapes.into_iter().enumerate() {
            let around = shape.compute_aabb(&pose);
            match swept.get_mut(index) {
                Some(known) => {
                    known.around.merge(&around);
                    known.places.push(pose);
                }
                None => {
                    let radius = radius(&shape);
                    swept.push(Swept { link, shape, radius, places: vec![pose], around });
                }
            }
        }
    }
    swept
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn no_place_is_farther_from_the_one_before_than_the_step() {
        let robot = Robot::aimm();
        let from = robot.posture("home").unwrap();
        let postures: Vec<JointVector> = (0..500).map(|i| from.map(|q| q + 0.4 * f64::from(i) / 500.0)).collect();
        let here = Configuration { arm: from, ..robot.at_zero() };
        let swept = swept(&robot, &here, &Ahead { arm: 0, postures: &postures });
        assert!(swept.len() > 7, "{}", swept.len());
        for body in &swept {
            assert!((10..200).contains(&body.places.len()), "{}", body.places.len());
            for pair in body.places.windows(2) {
                assert!((pair[1].translation - pair[0].translation).length() <= STEP_M as f32);
            }
        }
    }
}
