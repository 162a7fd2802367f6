//! The rectangle of least area around points in a plane: one of its sides lies on an edge of their convex hull
//! (Freeman and Shapira 1975), so every edge is tried.

/// A rectangle in the plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rectangle {
    pub(crate) centre: [f64; 2],
    /// The angle of the first side, in radians.
    pub(crate) yaw: f64,
    /// The lengths of the sides.
    pub(crate) size: [f64; 2],
}

/// The rectangle of least area; `None` for fewer than three points or collinear points.
pub(crate) fn least_area(points: &[[f64; 2]]) -> Option<Rectangle> {
    let hull = hull(points);
    if hull.len() < 3 {
        return None;
    }
    let candidates = (0..hull.len()).map(|i| {
        let (a, b) = (hull[i], hull[(i + 1) % hull.len()]);
        around(&hull, (b[1] - a[1]).atan2(b[0] - a[0]))
    });
    candidates.min_by(|a, b| (a.size[0] * a.size[1]).total_cmp(&(b.size[0] * b.size[1])))
}

fn around(points: &[[f64; 2]], yaw: f64) -> Rectangle {
    let (sin, cos) = yaw.sin_cos();
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for p in points {
        let turned = [cos * p[0] + sin * p[1], cos * p[1] - sin * p[0]];
        for axis in 0..2 {
            low[axis] = low[axis].min(turned[axis]);
            high[axis] = high[axis].max(turned[axis]);
        }
    }
    let middle = [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0];
    Rectangle {
        centre: [cos * middle[0] - sin * middle[1], sin * middle[0] + cos * middle[1]],
        yaw,
        size: [high[0] - low[0], high[1] - low[1]],
    }
}

/// The convex hull, counter-clockwise, by Andrew's monotone chain.
fn hull(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    sorted.dedup();
    if sorted.len() < 3 {
        return Vec::new();
    }
    let turn = |a: [f64; 2], b: [f64; 2], c: [f64; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for p in points {
            while chain.len() >= 2 && turn(chain[chain.len() - 2], chain[chain.len() - 1], p) <= 0.0 {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = chain(&mut sorted.iter().copied());
    hull.extend(chain(&mut sorted.iter().rev().copied()));
    hull
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_corners_of_a_rectangle_give_it_back(
            x in -1.0..1.0_f64, y in -1.0..1.0_f64, yaw in 0.0..1.5_f64, a in 0.05..0.2_f64, b in 0.05..0.2_f64,
        ) {
            let (sin, cos) = yaw.sin_cos();
            let corner = |u: f64, v: f64| [x + cos * u * a - sin * v * b, y + sin * u * a + cos * v * b];
            let points = [corner(0.5, 0.5), corner(-0.5, 0.5), corner(0.1, 0.2), corner(-0.5, -0.5), corner(0.5, -0.5)];
            let found = least_area(&points).unwrap();
            prop_assert!((found.size[0] * found.size[1] - a * b).abs() < 1e-9);
            prop_assert!((found.centre[0] - x).abs() < 1e-9 && (found.centre[1] - y).abs() < 1e-9);
        }
    }

    #[test]
    fn points_of_one_line_have_no_rectangle() {
        assert_eq!(least_area(&[[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]), None);
    }
}
