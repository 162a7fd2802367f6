//! Geometry of objects on tables: the classes that detection knows, each a shape with a few free dimensions.
//!
//! A model's frame is in the centre of its bounding box, z up as it stands. Two signed distances describe it for the fit: to its surface
//! (`distance`: 0 for a measured point), and to the volume that light cannot cross from outside (`fill_distance`: hollow objects are filled up to
//! the rim). `solid` is the same object for the ray caster, so that rendering and fitting share one description.

mod fork;
pub(crate) mod form;
mod revolved;
mod solid;

use crate::vector::Vector;
pub(crate) use fork::Strip;
use form::{FORMS, Form, ROUNDED};
use revolved::Turned;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// A class of objects, named as in the ontology.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum ObjectClass {
    /// A cuboid with any edges.
    Box,
    /// An upright cylinder, closed.
    Can,
    /// A tumbler: open, slightly conical, without a handle.
    Cup,
    /// Open and round, wider than high.
    Bowl,
    /// Flat, with a raised rim.
    Plate,
    /// Lies on its back: the tips point up, the neck is the highest part.
    Fork,
}

/// An object's shape, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Model {
    /// Edges along x, y, z.
    Box {
        /// Edge lengths.
        size: [f64; 3],
    },
    /// Rotationally symmetric about z.
    Round {
        /// Can, cup, bowl or plate.
        kind: Round,
        /// The greatest radius.
        radius: f64,
        /// Height from the table to the rim.
        height: f64,
    },
    /// Along x, tines ahead.
    Fork {
        /// Length from the end of the handle to the tips.
        length: f64,
    },
}

/// Objects that are rotationally symmetric about their upright axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Round {
    /// See [`ObjectClass::Can`].
    Can,
    /// See [`ObjectClass::Cup`].
    Cup,
    /// See [`ObjectClass::Bowl`].
    Bowl,
    /// See [`ObjectClass::Plate`].
    Plate,
}

/// Rotations about z that leave an object unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Symmetry {
    /// None: every yaw differs.
    None,
    /// Half a turn.
    HalfTurn,
    /// Any turn.
    Round,
}

impl ObjectClass {
    /// Every class.
    pub const ALL: [ObjectClass; 6] = [
        ObjectClass::Box,
        ObjectClass::Can,
        ObjectClass::Cup,
        ObjectClass::Bowl,
        ObjectClass::Plate,
        ObjectClass::Fork,
    ];

    /// Its name in the ontology.
    pub fn name(self) -> &'static str {
        match self {
            ObjectClass::Box => "Box",
            ObjectClass::Can => "Can",
            ObjectClass::Cup => "Cup",
            ObjectClass::Bowl => "Bowl",
            ObjectClass::Plate => "Plate",
            ObjectClass::Fork => "Fork",
        }
    }

    /// The class with this name.
    pub fn named(name: &str) -> Option<ObjectClass> {
        ObjectClass::ALL.into_iter().find(|class| class.name() == name)
    }

    /// Prefix of the names of its individuals: `box_`, `fork_`.
    pub fn prefix(self) -> &'static str {
        match self {
            ObjectClass::Box => "box_",
            ObjectClass::Can => "can_",
            ObjectClass::Cup => "cup_",
            ObjectClass::Bowl => "bowl_",
            ObjectClass::Plate => "plate_",
            ObjectClass::Fork => "fork_",
        }
    }

    /// Its rotational symmetry.
    pub fn symmetry(self) -> Symmetry {
        match self {
            ObjectClass::Box => Symmetry::HalfTurn,
            ObjectClass::Fork => Symmetry::None,
            _ => Symmetry::Round,
        }
    }

    /// The ranges of its dimensions, in the order of [`Model::dimensions`], in metres.
    pub fn ranges(self) -> &'static [RangeInclusive<f64>] {
        match self {
            ObjectClass::Box => &[0.02..=0.35, 0.02..=0.35, 0.03..=0.25],
            ObjectClass::Can => &[0.022..=0.06, 0.05..=0.20],
            ObjectClass::Cup => &[0.030..=0.05, 0.06..=0.13],
            ObjectClass::Bowl => &[0.055..=0.10, 0.035..=0.08],
            ObjectClass::Plate => &[0.085..=0.15, 0.014..=0.032],
            ObjectClass::Fork => &[0.15..=0.23],
        }
    }

    /// The model of this class with these dimensions, clamped to their ranges.
    pub fn model(self, dimensions: &[f64]) -> Model {
        let within = |i: usize| {
            let range = &self.ranges()[i];
            dimensions.get(i).copied().unwrap_or(*range.start()).clamp(*range.start(), *range.end())
        };
        let round = |kind| Model::Round { kind, radius: within(0), height: within(1) };
        match self {
            ObjectClass::Box => Model::Box { size: [within(0), within(1), within(2)] },
            ObjectClass::Can => round(Round::Can),
            ObjectClass::Cup => round(Round::Cup),
            ObjectClass::Bowl => round(Round::Bowl),
            ObjectClass::Plate => round(Round::Plate),
            ObjectClass::Fork => Model::Fork { length: within(0) },
        }
    }
}

impl Model {
    /// Its class.
    pub fn class(&self) -> ObjectClass {
        match self {
            Model::Box { .. } => ObjectClass::Box,
            Model::Round { kind: Round::Can, .. } => ObjectClass::Can,
            Model::Round { kind: Round::Cup, .. } => ObjectClass::Cup,
            Model::Round { kind: Round::Bowl, .. } => ObjectClass::Bowl,
            Model::Round { kind: Round::Plate, .. } => ObjectClass::Plate,
            Model::Fork { .. } => ObjectClass::Fork,
        }
    }

    /// Its free dimensions: edges, radius and height, or length, in metres.
    pub fn dimensions(&self) -> Vec<f64> {
        match *self {
            Model::Box { size } => size.to_vec(),
            Model::Round { radius, height, .. } => vec![radius, height],
            Model::Fork { length } => vec![length],
        }
    }

    /// The edges of its bounding box along x, y, z, in metres.
    pub fn size(&self) -> [f64; 3] {
        match *self {
            Model::Box { size } => size,
            Model::Round { radius, height, .. } => [2.0 * radius, 2.0 * radius, height],
            Model::Fork { length } => fork::size(length),
        }
    }

    /// How much the topmost part of its wall leans outwards, in radians from upright; `None` where there is no rim.
    pub fn rim_lean(&self) -> Option<f64> {
        match *self {
            Model::Round { kind, radius, height } => {
                revolved::rim_lean(&Turned { kind, radius, height, form: [0.0; FORMS] })
            }
            Model::Box { .. } | Model::Fork { .. } => None,
        }
    }

    /// Signed distance of a point in its frame from its surface as seen from `eye`, in metres; negative behind the surface.
    pub(crate) fn distance(&self, form: Form, point: Vector, eye: Vector) -> f64 {
        match *self {
            Model::Box { size } => seen_box_distance(point, size, eye),
            Model::Round { kind, radius, height } => {
                let [x, y, z] = point;
                let from_axis = (x * x + y * y).sqrt();
                let outwards = (x * (eye[0] - x) + y * (eye[1] - y)) / from_axis.max(1e-9);
                let of = Turned { kind, radius, height, form };
                revolved::distance(&of, [from_axis, z + height / 2.0], [outwards, eye[2] - z])
            }
            Model::Fork { length } => fork::distance(length, point),
        }
    }

    /// Signed distance of a point in its frame from the volume that no ray from outside passes: the object with its hollows filled.
    pub(crate) fn fill_distance(&self, form: Form, point: Vector) -> f64 {
        match *self {
            Model::Round { kind, radius, height } => {
                let [x, y, z] = point;
                let of = Turned { kind, radius, height, form };
                revolved::fill_distance(&of, [(x * x + y * y).sqrt(), z + height / 2.0])
            }
            Model::Fork { length } => fork::fill_distance(length, point),
            Model::Box { size } => {
                let rounded = form[ROUNDED];
                box_distance(point, size.map(|edge| edge - 2.0 * rounded)) - rounded
            }
        }
    }
}

fn box_distance(point: Vector, size: [f64; 3]) -> f64 {
    let beyond: Vector = std::array::from_fn(|i| point[i].abs() - size[i] / 2.0);
    let outside: f64 = beyond.iter().map(|b| b.max(0.0).powi(2)).sum::<f64>().sqrt();
    outside + beyond[0].max(beyond[1]).max(beyond[2]).min(0.0)
}

/// The same for a point that noise has moved along its ray: where that ray meets the box, the distance of a point in front is measured from the
/// face that the ray meets, and of a point behind from the nearest face that the eye sees. The nearest distance to the whole box would pull the
/// faces beside an edge only by the points in front, not by those behind.
fn seen_box_distance(point: Vector, size: [f64; 3], eye: Vector) -> f64 {
    let (mut enters, mut leaves, mut front) = (0.0_f64, f64::INFINITY, 0.0);
    let mut behind = f64::NEG_INFINITY;
    for i in 0..3 {
        let (half, way) = (size[i] / 2.0, point[i] - eye[i]);
        let (near, far) = ((-half.copysign(way) - eye[i]) / way, (half.copysign(way) - eye[i]) / way);
        // Along a face the numbers are infinite or NaN, and compare as intended.
        if near > enters {
            (enters, front) = (near, -(point[i] * way.signum() + half));
        }
        leaves = leaves.min(far);
        if near > 0.0 {
            behind = behind.max(-(point[i] * way.signum() + half));
        }
    }
    match (enters < leaves, enters > 1.0) {
        (true, true) => front,
        (true, false) if behind.is_finite() => behind.min(0.0),
        _ => box_distance(point, size),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::render::Body;
    use crate::vector::length as length_of;
    use parry3d::math::{Pose, Vector as Vector32};
    use parry3d::query::Ray;

    fn middle(class: ObjectClass) -> Model {
        let dimensions: Vec<f64> = class.ranges().iter().map(|r| (r.start() + r.end()) / 2.0).collect();
        class.model(&dimensions)
    }

    #[test]
    fn what_is_rendered_lies_on_the_surface_that_is_fitted() {
        for class in ObjectClass::ALL {
            let model = middle(class);
            let body = Body { shape: model.solid(), pose: Pose::IDENTITY };
            let mut hits = 0;
            for i in 0..2000_u32 {
                // From all directions above, towards points near the centre.
                let (turn, rise) = (f64::from(i) * 2.4, 0.35 + 0.9 * f64::from(i % 37) / 37.0);
                let from = [turn.cos() * rise.cos(), turn.sin() * rise.cos(), rise.sin()];
                let [x, y, _] = model.size();
                let to = [x * (f64::from(i % 23) / 23.0 - 0.5), y * (f64::from(i % 17) / 17.0 - 0.5), 0.0];
                let (origin, way) = ([0, 1, 2].map(|k| from[k] as f32), [0, 1, 2].map(|k| (to[k] - from[k]) as f32));
                let ray = Ray::new(Vector32::from_array(origin), Vector32::from_array(way));
                let Some(time) = body.shape.cast_ray(&body.pose, &ray, 2.0, true) else { continue };
                let hit = [0, 1, 2].map(|k| f64::from(origin[k] + way[k] * time));
                hits += 1;
                // Between the tines light reaches their sides; the fit treats the head as closed.
                let among_tines = class == ObjectClass::Fork && hit[0] > 0.35 * x;
                let least = if among_tines { -fork::THICKNESS * x } else { 0.0 };
                let distance = model.distance([0.0; FORMS], hit, from);
                assert!((least - 8e-4..8e-4).contains(&distance), "{class:?} {hit:?}: {distance}");
                assert!(
                    model.fill_distance([0.0; FORMS], hit) < 8e-4,
                    "{class:?} {hit:?}: {}",
                    model.fill_distance([0.0; FORMS], hit)
                );
            }
            assert!(hits > 500, "{class:?}: {hits}");
        }
    }

    #[test]
    fn rays_from_above_meet_the_strip_where_they_meet_what_is_rendered() {
        let length = 0.19;
        let body = Body { shape: Model::Fork { length }.solid(), pose: Pose::IDENTITY };
        let (strip, half) = (Strip::new([0.0; FORMS]), fork::size(1.0)[2] / 2.0);
        let (mut met, mut exact, mut missed) = (0, 0, 0);
        for i in 0..4000_u32 {
            let (turn, rise) = (f64::from(i) * 2.4, 0.6 + 0.8 * f64::from(i % 37) / 37.0);
            let from = [turn.cos() * rise.cos(), turn.sin() * rise.cos(), rise.sin()].map(|c| 5.0 * c);
            // Up to the tines, in whose gaps a ray may get lost.
            let to = [0.9 * f64::from(i % 83) / 83.0 - 0.55, 0.16 * (f64::from(i % 71) / 71.0 - 0.5), -half];
            let way = [0, 1, 2].map(|k| to[k] - from[k]);
            let scaled = |v: Vector| Vector32::from_array(v.map(|c| (c * length) as f32));
            let rendered = body.shape.cast_ray(&body.pose, &Ray::new(scaled(from), scaled(way)), 1.0, true);
            let seen = strip.met([from[0], from[1], from[2] + half], way, 1e-6);
            match (rendered, seen) {
                (Some(rendered), Some((covered, at))) => {
                    met += 1;
                    // One of the two has mitred corners: there they differ by about the strip's thickness, elsewhere not at all.
                    let off = (f64::from(rendered) - at).abs() * length_of(way);
                    assert!(covered > 0.99 && off < 2.0 * fork::THICKNESS, "{from:?} {to:?}: {rendered} {at}");
                    exact += u32::from(off < 0.1 * fork::THICKNESS);
                }
                (None, None) => missed += 1,
                _ => {}
            }
        }
        assert!(met > 1000 && missed > 1000 && met + missed > 3960, "{met} {missed}");
        assert!(f64::from(exact) > 0.97 * f64::from(met), "{exact} of {met}");
    }

    #[test]
    fn a_class_is_found_by_its_name_and_its_dimensions_are_held_within_its_ranges() {
        for class in ObjectClass::ALL {
            assert_eq!(ObjectClass::named(class.name()), Some(class));
            assert_eq!(class.model(&[9.0; 3]).class(), class);
            let (largest, ranges) = (class.model(&[9.0; 3]).dimensions(), class.ranges());
            assert!(largest.iter().zip(ranges).all(|(d, range)| d == range.end()));
        }
    }
}
