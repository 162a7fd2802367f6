//! The robot's own body in a picture, by its kinematics.

use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::spheres::Sphere;
use ratn_perception::mask::Ball;

/// Spheres around every moving part of the robot, in the world frame, for all postures during the picture.
pub(super) fn balls(robot: &Robot, postures: &[Configuration]) -> Vec<Ball> {
    let nothing: &[Sphere] = &[];
    // Things stand on the top of the base's body: it hides nothing, and its spheres would reach above it.
    let is_deck = |link: usize| robot.body() == Some(link);
    let links = robot.model.links.iter().enumerate();
    let covers: Vec<&[Sphere]> = links.map(|(i, link)| if is_deck(i) { nothing } else { &link.spheres[..] }).collect();
    let placed = postures.iter().flat_map(|posture| robot.poses(posture).into_iter().zip(&covers));
    let of_link = |(pose, cover): (ratn_model::pose::Pose, &&[Sphere])| -> Vec<Ball> {
        cover.iter().map(|s| Ball { centre: pose.transform(s.centre), radius: s.radius }).collect()
    };
    placed.flat_map(of_link).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_motion::aimm;

    #[test]
    fn the_hand_is_hidden_where_it_is_and_the_deck_is_not() {
        let robot = Robot::aimm();
        let home = Configuration { arm: aimm::HOME, finger: 0.05, ..robot.at_zero() };
        let balls = balls(&robot, &[home]);
        let hidden = |p: [f64; 3]| {
            balls.iter().any(|b| (0..3).map(|i| (p[i] - b.centre[i]).powi(2)).sum::<f64>() < b.radius.powi(2))
        };
        for (link, pose, shape) in robot.shapes(&home) {
            if robot.body() != Some(link) {
                let centre = shape.compute_aabb(&pose).center();
                let centre = [centre.x, centre.y, centre.z].map(f64::from);
                assert!(hidden(centre), "{} at {centre:?}", robot.model.links[link].name);
            }
        }
        for slot in aimm::slots() {
            assert!(!hidden(slot.transform([0.0, 0.0, 0.05])), "{slot:?}");
        }
    }

    #[test]
    fn a_posture_reads_back_and_another_number_of_joints_is_none() {
        let degrees: Vec<f64> = (0..13).map(f64::from).collect();
        let read = Robot::aimm().configuration(&degrees).unwrap();
        assert_eq!((read.base[2], read.arm[0], read.arm[6]), (2.0, 3.0, 9.0));
        assert_eq!((read.pan, read.tilt, read.finger), (10.0, 11.0, 12.0));
        assert_eq!(Robot::aimm().configuration(&degrees[1..]), None);
    }
}
