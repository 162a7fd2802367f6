//! The robot's own body in its camera's image: points within it are not objects.

use crate::vector::Vector;
use ratn_model::pose::Pose;

/// Part of the robot: a sphere in the world, in metres. Several spheres cover a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// Its centre.
    pub centre: [f64; 3],
    /// Its radius.
    pub radius: f64,
}

/// How far outside its spheres the body may be seen, because of noise and motion since the image; in metres.
const MARGIN: f64 = 0.015;

/// The spheres that reach into a box around the surface, in the surface's frame.
#[derive(Debug, Clone, Default)]
pub(crate) struct Mask(Vec<(Vector, f64)>);

impl Mask {
    /// `frame` is the surface's, `reach` is half of the box's edges along x and y, and its height.
    pub(crate) fn new(balls: &[Ball], frame: &Pose, reach: Vector) -> Mask {
        let to_frame = frame.inverse();
        let near = balls.iter().filter_map(|ball| {
            let (centre, radius) = (to_frame.transform(ball.centre), ball.radius + MARGIN);
            let beside = centre[0].abs() > reach[0] + radius || centre[1].abs() > reach[1] + radius;
            let apart = centre[2] < -radius || centre[2] > reach[2] + radius;
            (!beside && !apart).then_some((centre, radius * radius))
        });
        Mask(near.collect())
    }

    pub(crate) fn hides(&self, p: Vector) -> bool {
        self.0.iter().any(|(c, square)| (0..3).map(|i| (p[i] - c[i]).powi(2)).sum::<f64>() < *square)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_within_a_ball_is_hidden_and_balls_far_away_are_not_asked() {
        let balls = [Ball { centre: [1.0, 0.0, 0.8], radius: 0.05 }, Ball { centre: [-1.0, 0.0, 0.8], radius: 0.05 }];
        let mask = Mask::new(&balls, &Pose::at(1.0, 0.0, 0.7), [0.3, 0.3, 0.25]);
        assert_eq!(mask.0.len(), 1);
        assert!(mask.hides([0.06, 0.0, 0.1]));
        assert!(!mask.hides([0.07, 0.0, 0.1]));
    }
}
