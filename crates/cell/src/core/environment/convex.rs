//! A convex shape with its pose, as the judge sees it: a point, a line, a triangle, a box or a cylinder, and all points within a radius of it.
//!
//! All numbers are `f64` and in the world frame. The shapes are read from the bodies that the physics engine moves.

use super::vector::{Vector, direction};
use rapier3d::math::{Pose as Pose32, Vector as Vector32};
use rapier3d::parry::shape::Shape;
use ratn_model::pose::Pose;
use std::f64::consts::TAU;

/// A shape with its pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Convex {
    /// Its centre, in the world frame.
    pub(super) middle: Vector,
    core: Core,
    /// All points within this distance of the core belong to the shape, in metres.
    pub(super) radius: f64,
}

/// The core of a shape, without its radius, relative to its centre and along the axes of the world.
#[derive(Debug, Clone, Copy)]
enum Core {
    Point,
    /// From the centre to one end.
    Line(Vector),
    Triangle([Vector; 3]),
    /// Half extents as vectors.
    Box([Vector; 3]),
    Cylinder {
        axis: Vector,
        radius: f64,
        half_length: f64,
    },
}

/// Number of corners that approximate a round face.
const ROUND: u32 = 32;

impl Convex {
    /// The shape of a body; `None` for a kind that no body of the cell has.
    pub(super) fn of(shape: &dyn Shape, place: &Pose32) -> Option<Convex> {
        let [x, y, z, w] = place.rotation.to_array().map(f64::from);
        // After rounding to `f32` the quaternion is not exactly of length 1.
        let length = (x * x + y * y + z * z + w * w).sqrt();
        let turn = Pose { position: [0.0; 3], quaternion_xyzw: [x, y, z, w].map(|c| c / length) };
        let turned = |v: Vector| Vector::from(turn.rotate(v.to_array()));
        let (at, axes) = (wide(place.translation), Vector::AXES.map(turned));
        let placed = |middle: Vector, core: Core, radius: f64| Some(Convex { middle, core, radius });
        if let Some(ball) = shape.as_ball() {
            return placed(at, Core::Point, f64::from(ball.radius));
        }
        if let Some(capsule) = shape.as_capsule() {
            let [a, b] = [capsule.segment.a, capsule.segment.b].map(|end| turned(wide(end)));
            return placed(at + (a + b) * 0.5, Core::Line((b - a) * 0.5), f64::from(capsule.radius));
        }
        if let Some(cuboid) = shape.as_cuboid() {
            let half = wide(cuboid.half_extents);
            return placed(at, Core::Box(std::array::from_fn(|i| axes[i] * half[i])), 0.0);
        }
        let cylinder = shape.as_cylinder()?;
        let (radius, half_length) = (f64::from(cylinder.radius), f64::from(cylinder.half_height));
        placed(at, Core::Cylinder { axis: axes[1], radius, half_length }, 0.0)
    }

    pub(super) fn triangle(corners: [Vector; 3]) -> Convex {
        let middle = corners.into_iter().sum::<Vector>() * (1.0 / 3.0);
        Convex { middle, core: Core::Triangle(corners.map(|corner| corner - middle)), radius: 0.0 }
    }

    /// The support point of the core: the farthest along a direction.
    pub(super) fn farthest(&self, way: Vector) -> Vector {
        let along = |edge: Vector| if edge.dot(way) < 0.0 { -edge } else { edge };
        let from_middle = match self.core {
            Core::Point => Vector::ZERO,
            Core::Line(half) => along(half),
            Core::Triangle([a, b, c]) => {
                let farther = |a: Vector, b: Vector| if b.dot(way) > a.dot(way) { b } else { a };
                farther(farther(a, b), c)
            }
            Core::Box([x, y, z]) => along(x) + along(y) + along(z),
            Core::Cylinder { axis, radius, half_length } => {
                along(axis * half_length) + outward(way, axis).unwrap_or_default() * radius
            }
        };
        self.middle + from_middle
    }

    /// Whether it has only flat faces.
    pub(super) fn is_flat(&self) -> bool {
        !matches!(self.core, Core::Cylinder { .. })
    }

    /// Normals of its faces.
    pub(super) fn across(&self) -> Vec<Vector> {
        match self.core {
            Core::Point => Vec::new(),
            // A line has no face; but the common points of two lines are in planes that contain one of them.
            Core::Line(half) => {
                direction(half).into_iter().flat_map(|way| <[Vector; 2]>::from(way.any_orthonormal_pair())).collect()
            }
            Core::Triangle([a, b, c]) => vec![(b - a).cross(c - b)],
            Core::Box(half) => half.to_vec(),
            Core::Cylinder { axis, .. } => vec![axis],
        }
    }

    /// Directions of its edges, or of its axis.
    pub(super) fn edges(&self) -> Vec<Vector> {
        match self.core {
            Core::Point => Vec::new(),
            Core::Line(half) => vec![half],
            Core::Triangle([a, b, c]) => vec![b - a, c - b, a - c],
            Core::Box(half) => half.to_vec(),
            Core::Cylinder { axis, .. } => vec![axis],
        }
    }

    /// The corners of its core that are farthest along a direction, and those that are at most `within_m` metres less far: a point, the ends of an
    /// edge, or the corners of a face.
    pub(super) fn face(&self, way: Vector, within_m: f64) -> Vec<Vector> {
        let corners: Vec<Vector> = match self.core {
            Core::Point => vec![Vector::ZERO],
            Core::Line(half) => vec![half, -half],
            Core::Triangle(corners) => corners.to_vec(),
            Core::Box(half) => {
                let signed = |bits: u32, i: usize| half[i] * if bits >> i & 1 == 0 { 1.0 } else { -1.0 };
                (0..8).map(|bits| (0..3).map(|i| signed(bits, i)).sum()).collect()
            }
            Core::Cylinder { axis, radius, half_length } => {
                let out = outward(way, axis).unwrap_or(axis.any_orthonormal_vector());
                let aside = axis.cross(out);
                let rim = (0..ROUND).map(|i| (TAU * f64::from(i) / f64::from(ROUND)).sin_cos());
                let round = rim.map(|(sin, cos)| out * (radius * cos) + aside * (radius * sin));
                round.flat_map(|p| [p - axis * half_length, p + axis * half_length]).collect()
            }
        };
        let far = corners.iter().map(|corner| corner.dot(way)).fold(f64::NEG_INFINITY, f64::max);
        let on_face = corners.into_iter().filter(|corner| far - corner.dot(way) <= within_m);
        on_face.map(|corner| self.middle + corner).collect()
    }
}

/// The unit vector perpendicular to an axis that is nearest to `way`; `None` if `way` is along the axis.
fn outward(way: Vector, axis: Vector) -> Option<Vector> {
    // If the direction is nearly along the axis, normalising amplifies the rounding error along it, so that part is removed again.
    direction(way.reject_from_normalized(axis)).map(|out| out.reject_from_normalized(axis))
}

fn wide(v: Vector32) -> Vector {
    v.as_dvec3()
}
