//! Vectors of three `f64`, for the judge: the physics engine's are `f32`.

use std::iter::Sum;
use std::ops::{Add, Mul, Neg, Sub};

/// A point or a direction.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Vector(pub(super) [f64; 3]);

impl Vector {
    pub(super) const ZERO: Vector = Vector([0.0; 3]);
    pub(super) const AXES: [Vector; 3] = [Vector([1.0, 0.0, 0.0]), Vector([0.0, 1.0, 0.0]), Vector([0.0, 0.0, 1.0])];

    pub(super) fn dot(self, other: Vector) -> f64 {
        let (Vector([a, b, c]), Vector([x, y, z])) = (self, other);
        a * x + b * y + c * z
    }

    pub(super) fn cross(self, other: Vector) -> Vector {
        let (Vector([a, b, c]), Vector([x, y, z])) = (self, other);
        Vector([b * z - c * y, c * x - a * z, a * y - b * x])
    }

    pub(super) fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    /// The unit vector of this direction; `None` for a vector without length.
    pub(super) fn direction(self) -> Option<Vector> {
        let length = self.length();
        (length > SHORTEST).then(|| self * (1.0 / length))
    }

    /// The part of it that is perpendicular to a unit vector.
    pub(super) fn beside(self, way: Vector) -> Vector {
        self - way * self.dot(way)
    }

    /// Two unit vectors that are perpendicular to this unit vector and to each other; the three are right-handed.
    pub(super) fn across(self) -> [Vector; 2] {
        let least = |i: &usize, j: &usize| self.0[*i].abs().total_cmp(&self.0[*j].abs());
        let axis = Vector::AXES[(0..3).min_by(least).unwrap_or_default()];
        // The axis that is farthest from it has an angle of at least 54° with it.
        let first = axis.beside(self).direction().unwrap_or(axis);
        [first, self.cross(first)]
    }
}

/// A shorter vector has no direction.
const SHORTEST: f64 = 1e-12;

impl Add for Vector {
    type Output = Vector;

    fn add(self, other: Vector) -> Vector {
        Vector(std::array::from_fn(|i| self.0[i] + other.0[i]))
    }
}

impl Sub for Vector {
    type Output = Vector;

    fn sub(self, other: Vector) -> Vector {
        Vector(std::array::from_fn(|i| self.0[i] - other.0[i]))
    }
}

impl Neg for Vector {
    type Output = Vector;

    fn neg(self) -> Vector {
        Vector(self.0.map(|c| -c))
    }
}

impl Mul<f64> for Vector {
    type Output = Vector;

    fn mul(self, by: f64) -> Vector {
        Vector(self.0.map(|c| c * by))
    }
}

impl Sum for Vector {
    fn sum<I: Iterator<Item = Vector>>(all: I) -> Vector {
        all.fold(Vector::ZERO, Add::add)
    }
}
