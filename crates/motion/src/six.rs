//! Closed-form inverse kinematics for six revolute joints with suitable axes: a spherical wrist behind a shoulder whose first two axes intersect or whose
//! second and third are parallel, or three parallel axes before two that intersect. The reverse of each is supported as well: then the shoulder is the
//! spherical part.
//!
//! Products of exponentials, one unknown at a time: quantities that a joint does not change give the equation of another joint (Paden-Kahan subproblems;
//! Murray, Li, Sastry: *A Mathematical Introduction to Robotic Manipulation*, 3.3; Elias and Wen: *IK-Geo*, 2022, for which arms decompose in this way). Joint
//! limits, and the choice among the turns of a joint, are left to the caller.

use crate::frame::compose;
use crate::spherical::{about, angle_about};
use crate::vector::{Vector, rotate, transform};
use ratn_model::pose::Pose;
use std::f64::consts::TAU;

/// Axes intersect if their distance is less than this, in metres, and directions are equal if they differ by less, in radians. Angles in a URDF are often
/// rounded to five digits; the caller corrects the resulting error of a solution.
const ROUNDED: f64 = 2e-5;

/// Smaller values are zero up to rounding.
const EXACT: f64 = 1e-9;

/// An equation that misses a solution by less than this has two equal solutions: an effect of rounded axes.
const SLACK: f64 = 1e-4;

/// Number of evenly spaced angles that are used where an angle has no influence.
const SPREAD: usize = 16;

/// A rotation axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axis {
    pub(crate) direction: Vector,
    pub(crate) point: Vector,
}

/// How the six axes decompose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Kind {
    shape: Shape,
    /// Seen from the tool: the last joint is the first.
    is_reversed: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shape {
    /// The last three axes intersect, and so do the first two.
    WristAndShoulder,
    /// The last three axes intersect; the second and the third are parallel.
    WristAndElbow,
    /// The second to fourth axes are parallel; the last two intersect.
    ThreeParallel,
}

/// The solutions for a motion.
#[derive(Debug, Clone, Default)]
pub(crate) struct Solutions {
    /// Joint angles, not resolved to a particular turn.
    pub(crate) all: Vec<[f64; 6]>,
    /// Whether a joint had no influence, so that these are samples of infinitely many solutions.
    pub(crate) is_singular: bool,
}

impl Kind {
    /// The first shape that fits six axes.
    pub(crate) fn of(axes: &[Axis; 6]) -> Option<Kind> {
        [false, true].into_iter().find_map(|is_reversed| {
            let axes = if is_reversed { reversed(axes) } else { *axes };
            Some(Kind { shape: shape(&axes, ROUNDED)?, is_reversed })
        })
    }

    /// Whether the axes have this shape exactly, so that a pose without a solution is certainly unreachable.
    pub(crate) fn is_exact(self, axes: &[Axis; 6]) -> bool {
        shape(&if self.is_reversed { reversed(axes) } else { *axes }, EXACT) == Some(self.shape)
    }

    /// The joint angles that produce a motion of the last link, measured from the given axes.
    pub(crate) fn solve(self, axes: &[Axis; 6], motion: &Pose) -> Solutions {
        if !self.is_reversed {
            return self.shape.solve(axes, motion);
        }
        let mut found = self.shape.solve(&reversed(axes), &motion.inverse());
        found.all.iter_mut().for_each(|angles| angles.reverse());
        found
    }
}

impl Shape {
    fn solve(self, axes: &[Axis; 6], motion: &Pose) -> Solutions {
        let mut found = Solutions::default();
        match self {
            Shape::WristAndShoulder | Shape::WristAndElbow => solve_wrist(self, axes, motion, &mut found),
            Shape::ThreeParallel => solve_three_parallel(axes, motion, &mut found),
        }
        found
    }
}

fn shape(axes: &[Axis; 6], within: f64) -> Option<Shape> {
    let parallel = |a: usize, b: usize| axes[a].direction.cross(axes[b].direction).length() < within;
    let meet = |a: usize, b: usize| !parallel(a, b) && between(&axes[a], &axes[b]).is_some_and(|(_, gap)| gap < within);
    let wrist = meet(3, 4)
        && !parallel(4, 5)
        && between(&axes[3], &axes[4])
            .is_some_and(|(point, _)| (point - axes[5].point).cross(axes[5].direction).length() < within);
    if wrist && meet(0, 1) {
        return Some(Shape::WristAndShoulder);
    }
    if wrist && parallel(1, 2) && !parallel(0, 1) {
        return Some(Shape::WristAndElbow);
    }
    (parallel(1, 2) && parallel(2, 3) && !parallel(0, 1) && !parallel(3, 4) && meet(4, 5))
        .then_some(Shape::ThreeParallel)
}

/// The axes as seen from the last link: the inverse of a product has its inverted factors in reverse order.
fn reversed(axes: &[Axis; 6]) -> [Axis; 6] {
    std::array::from_fn(|i| {
        let Axis { direction, point } = axes[5 - i];
        Axis { direction: -direction, point }
    })
}

/// The first three joints move the wrist to its position, the last three orient it.
fn solve_wrist(shape: Shape, axes: &[Axis; 6], motion: &Pose, found: &mut Solutions) {
    let Some((wrist, _)) = between(&axes[3], &axes[4]) else { return };
    let target = transform(motion, wrist);
    let mut places: Vec<[f64; 3]> = Vec::new();
    if shape == Shape::WristAndShoulder {
        let Some((shoulder, _)) = between(&axes[0], &axes[1]) else { return };
        let seen = target - shoulder;
        for third in found.distances(&axes[2], wrist, shoulder, seen.length()) {
            let bent = turned(&axes[2], third, wrist) - shoulder;
            let [first, second] = [axes[0].direction, axes[1].direction];
            for middle in found.angles(wave(second, bent, first), first.dot(seen)) {
                let outer = angle_about(first, rotate(&about(second, middle), bent), seen);
                places.push([outer, middle, third]);
            }
        }
    } else {
        let along = axes[1].direction;
        let seen = target - axes[0].point;
        let wanted = along.dot(wrist - axes[0].point);
        for back in found.angles(wave(axes[0].direction, seen, along), wanted) {
            let target = turned(&axes[0], back, target);
            let rest = found.two_parallel(&axes[1], &axes[2], wrist, target);
            places.extend(rest.into_iter().map(|[b, c]| [-back, b, c]));
        }
    }
    for place in places {
        let carried = (0..3).fold(Pose::IDENTITY, |pose, i| compose(&pose, &exponential(&axes[i], place[i])));
        let rest = compose(&carried.inverse(), motion);
        let ([a, b, c], directions) = (place, [axes[3].direction, axes[4].direction, axes[5].direction]);
        for [d, e, f] in found.three_turns(directions, &rest) {
            found.all.push([a, b, c, d, e, f]);
        }
    }
}

fn solve_three_parallel(axes: &[Axis; 6], motion: &Pose, found: &mut Solutions) {
    let Some((wrist, _)) = between(&axes[4], &axes[5]) else { return };
    let along = axes[1].direction;
    let target = transform(motion, wrist);
    let wanted = along.dot(wrist - axes[0].point);
    let [fifth, sixth] = [axes[4].direction, axes[5].direction];
    // Parallel axes may point in opposite directions.
    let [third_sign, fourth_sign] = [2, 3].map(|i: usize| axes[i].direction.dot(along).signum());
    for back in found.angles(wave(axes[0].direction, target - axes[0].point, along), wanted) {
        let rest = compose(&exponential(&axes[0], back), motion);
        let seen = rotate(&rest, sixth);
        for e in found.angles(wave(fifth, sixth, along), along.dot(seen)) {
            let tilted = rotate(&about(fifth, e), sixth);
            let in_line = along.cross(tilted).length() < SLACK;
            // If the last axis is in line with the three parallel ones it rotates as they do, so that any division of the angle is right.
            found.is_singular |= in_line;
            let mut sums = vec![angle_about(along, tilted, seen)];
            sums.extend(in_line.then(evenly).into_iter().flatten());
            for sum in sums {
                let before = compose(&about(along, sum), &about(fifth, e));
                let f = remaining(sixth, &compose(&before.inverse(), &rest));
                let hand = compose(&exponential(&axes[4], e), &exponential(&axes[5], f));
                let elbow = transform(&compose(&rest, &hand.inverse()), axes[3].point);
                for [b, c] in found.two_parallel(&axes[1], &axes[2], axes[3].point, elbow) {
                    found.all.push([-back, b, c, fourth_sign * (sum - b - third_sign * c), e, f]);
                }
            }
        }
    }
}

impl Solutions {
    /// Angles at which `sine · sin + cosine · cos + constant` has a value.
    fn angles(&mut self, [sine, cosine, constant]: [f64; 3], value: f64) -> Vec<f64> {
        let (size, missing) = (sine.hypot(cosine), value - constant);
        if missing.abs() > size + SLACK {
            return Vec::new();
        }
        let (middle, half) = (sine.atan2(cosine), (missing / size.max(EXACT)).clamp(-1.0, 1.0).acos());
        let mut angles = vec![middle + half, middle - half];
        if size < SLACK {
            self.is_singular = true;
            angles.extend(evenly());
        }
        angles
    }

    /// Angles about an axis that bring a point to a distance from another point.
    fn distances(&mut self, axis: &Axis, point: Vector, from: Vector, distance: f64) -> Vec<f64> {
        let (arm, offset) = (point - axis.point, axis.point - from);
        let product = (distance * distance - arm.dot(arm) - offset.dot(offset)) / 2.0;
        self.angles(wave(axis.direction, arm, offset), product)
    }

    /// Angles of two parallel axes that bring a point to a target at the same position along them.
    fn two_parallel(&mut self, first: &Axis, second: &Axis, point: Vector, target: Vector) -> Vec<[f64; 2]> {
        let seen = target - first.point;
        let bends = self.distances(second, point, first.point, seen.length());
        let both = |bend: f64| {
            let bent = turned(second, bend, point) - first.point;
            [angle_about(first.direction, bent, seen), bend]
        };
        bends.into_iter().map(both).collect()
    }

    /// Decompositions of a rotation into three turns.
    fn three_turns(&mut self, [a, b, c]: [Vector; 3], rotation: &Pose) -> Vec<[f64; 3]> {
        let seen = rotate(rotation, c);
        let mut ways = Vec::new();
        for middle in self.angles(wave(b, c, a), a.dot(seen)) {
            let third = rotate(&about(b, middle), c);
            let last = |outer: f64| {
                let before = compose(&about(a, outer), &about(b, middle));
                remaining(c, &compose(&before.inverse(), rotation))
            };
            if a.cross(third).length() < EXACT {
                // Only the sum of the two outer turns matters.
                let (sum, sign) = (last(0.0), a.dot(third).signum());
                self.is_singular = true;
                ways.extend(evenly().into_iter().map(|share| [sign * (sum - share), middle, share]));
            } else {
                let outer = angle_about(a, third, seen);
                ways.push([outer, middle, last(outer)]);
            }
        }
        ways
    }
}

/// The component along a vector of another vector rotated about a unit vector: coefficients of sine and cosine of the angle, and a constant.
fn wave(axis: Vector, turned: Vector, along: Vector) -> [f64; 3] {
    let constant = axis.dot(turned) * axis.dot(along);
    [along.dot(axis.cross(turned)), along.dot(turned) - constant, constant]
}

/// The angle of a rotation about this axis.
fn remaining(axis: Vector, rotation: &Pose) -> f64 {
    let [x, y, z, w] = rotation.quaternion_xyzw;
    2.0 * axis.dot(Vector::new(x, y, z)).atan2(w)
}

fn evenly() -> Vec<f64> {
    (0..SPREAD).map(|i| TAU * i as f64 / SPREAD as f64).collect()
}

/// The rigid motion of a rotation about an axis.
fn exponential(axis: &Axis, angle: f64) -> Pose {
    let turn = about(axis.direction, angle);
    Pose { position: (axis.point - rotate(&turn, axis.point)).into(), ..turn }
}

fn turned(axis: &Axis, angle: f64, point: Vector) -> Vector {
    transform(&exponential(axis, angle), point)
}

/// The midpoint between the closest points of two axes, and their distance; `None` for parallel axes.
fn between(a: &Axis, b: &Axis) -> Option<(Vector, f64)> {
    let normal = a.direction.cross(b.direction);
    let square = normal.dot(normal);
    if square < EXACT {
        return None;
    }
    let way = b.point - a.point;
    let on_a = way.cross(b.direction).dot(normal) / square;
    let on_b = way.cross(a.direction).dot(normal) / square;
    let (p, q) = (a.point + on_a * a.direction, b.point + on_b * b.direction);
    Some((p.midpoint(q), (p - q).length()))
}
