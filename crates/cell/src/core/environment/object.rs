//! What stands around in the cell: its shape as convex parts, its mass, and how it rubs.
//!
//! An object's frame sits in the middle of its bounding box, z up when it stands as it was made to. Bowls and cups are hollow:
//! a ring of slabs on a disc, so that something can lie in them and a finger can reach in. Thicknesses and masses are those of
//! small load carriers, porcelain and cutlery.

use rapier3d::math::{Pose, Rotation, Vector};
use rapier3d::prelude::SharedShape;
use serde::{Deserialize, Serialize};
use std::f32::consts::{FRAC_PI_2, TAU};

/// What something is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A small load carrier.
    Box,
    /// Flat, with a foot smaller than its rim.
    Plate,
    /// Hollow, wider at the top.
    Bowl,
    /// Hollow, with upright walls.
    Cup,
    /// Thin and long: a handle and a head.
    Fork,
}

/// Something that can be moved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// What it is.
    pub kind: Kind,
    /// Its extents along x, y, z in metres; round things are as deep as they are wide.
    pub size: [f64; 3],
}

/// One convex part of it, in its frame.
pub(super) type Part = (Pose, SharedShape);

/// How thick the walls of bowls and cups are, in metres.
const WALL_M: f32 = 0.004;
/// How many slabs a round wall has.
const SLABS: u32 = 16;
/// The foot of plates and bowls, as a part of their greatest width.
const FOOT: f32 = 0.6;

impl Kind {
    /// Kilograms per cubic metre of its outline.
    fn density(self) -> f64 {
        match self {
            Kind::Box => 400.0,
            Kind::Plate => 900.0,
            Kind::Bowl => 450.0,
            Kind::Cup => 650.0,
            Kind::Fork => 2000.0,
        }
    }

    /// Coulomb's coefficient against wood and rubber.
    pub fn friction(self) -> f64 {
        match self {
            Kind::Box => 0.6,
            Kind::Plate | Kind::Bowl | Kind::Cup => 0.45,
            Kind::Fork => 0.4,
        }
    }
}

impl Model {
    /// Kilograms.
    pub fn mass_kg(&self) -> f64 {
        self.kind.density() * self.size.iter().product::<f64>()
    }

    /// Its convex parts.
    pub(super) fn parts(&self) -> Vec<Part> {
        let [x, y, z] = self.size.map(|edge| edge as f32 / 2.0);
        match self.kind {
            Kind::Box => vec![(Pose::IDENTITY, SharedShape::cuboid(x, y, z))],
            Kind::Plate => vec![disc(-z / 2.0, FOOT * x, z / 2.0), disc(z / 2.0, x, z / 2.0)],
            Kind::Bowl => hollow(FOOT * x, x, z),
            Kind::Cup => hollow(x, x, z),
            Kind::Fork => {
                let (handle, head) = (1.4 * x, 0.6 * x);
                vec![
                    (Pose::translation(handle / 2.0 - x, 0.0, 0.0), SharedShape::cuboid(handle / 2.0, 0.4 * y, z)),
                    (Pose::translation(x - head / 2.0, 0.0, 0.0), SharedShape::cuboid(head / 2.0, y, z)),
                ]
            }
        }
    }
}

/// A disc about the z axis; parry's cylinders stand along y.
fn disc(height: f32, radius: f32, half_thickness: f32) -> Part {
    let upright = Rotation::from_rotation_x(FRAC_PI_2);
    (Pose::from_parts(Vector::new(0.0, 0.0, height), upright), SharedShape::cylinder(half_thickness, radius))
}

/// A bottom and a ring of slabs that lean outwards from the bottom's radius to the rim's.
fn hollow(bottom: f32, rim: f32, half_height: f32) -> Vec<Part> {
    let mut parts = vec![disc(WALL_M / 2.0 - half_height, bottom, WALL_M / 2.0)];
    let lean = ((rim - bottom) / (2.0 * half_height)).atan();
    let half_length = half_height / lean.cos() - WALL_M / 2.0 * lean.tan();
    let middle = (bottom + rim) / 2.0 - WALL_M / 2.0;
    let half_width = middle * (TAU / 2.0 / SLABS as f32).tan();
    for slab in 0..SLABS {
        let around = Rotation::from_rotation_z(TAU * slab as f32 / SLABS as f32);
        let place = around * Vector::new(middle, 0.0, 0.0);
        let pose = Pose::from_parts(place, around * Rotation::from_rotation_y(lean));
        parts.push((pose, SharedShape::cuboid(WALL_M / 2.0, half_width, half_length)));
    }
    parts
}
