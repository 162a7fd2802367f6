//! The objects of the cell: their shapes as convex parts, masses and friction.
//!
//! The origin of an object's frame is the centre of its bounding box, with z up when the object stands upright. Bowls and cups are hollow: a ring
//! of slabs on a disc, so that something can lie in them and a finger can reach in. Thicknesses and masses are those of small load carriers,
//! porcelain and cutlery.

use ratn_model::pose::Pose;
use ratn_perception::model::{Model as Seen, Round};
use ratn_world::scene::Shape;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

/// The kind of an object.
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

/// An object that can be moved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Model {
    /// Its kind.
    pub kind: Kind,
    /// Its extents along x, y, z in metres; round objects are as deep as they are wide.
    pub size: [f64; 3],
}

/// Thickness of the walls of bowls and cups, in metres.
const WALL_M: f64 = 0.004;
/// Number of slabs of a round wall.
const SLABS: u32 = 16;
/// Width of the foot of plates and bowls, as a fraction of their greatest width.
pub(super) const FOOT: f64 = 0.6;
/// Length of a fork's handle as a fraction of the fork's length, and its width as a fraction of that of the head.
const HANDLE: f64 = 0.7;
const HANDLE_WIDTH: f64 = 0.4;
/// For objects held by their rim: how far below the rim the fingers hold, and the width of the rim that counts as a flat wall, in metres.
const RIM_M: f64 = 0.02;
const RIM_WIDTH_M: f64 = 0.03;

impl Kind {
    /// Its name in texts.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Box => "box",
            Kind::Plate => "plate",
            Kind::Bowl => "bowl",
            Kind::Cup => "cup",
            Kind::Fork => "fork",
        }
    }

    /// Density, in kilograms per cubic metre of its bounding box.
    fn density(self) -> f64 {
        match self {
            Kind::Box => 400.0,
            Kind::Plate => 900.0,
            Kind::Bowl => 450.0,
            Kind::Cup => 650.0,
            Kind::Fork => 2000.0,
        }
    }

    /// Coulomb's friction coefficient against wood and rubber.
    pub fn friction(self) -> f64 {
        match self {
            Kind::Box => 0.6,
            Kind::Plate | Kind::Bowl | Kind::Cup => 0.45,
            Kind::Fork => 0.4,
        }
    }
}

impl Model {
    /// Its mass, in kilograms.
    pub fn mass_kg(&self) -> f64 {
        self.kind.density() * self.size.iter().product::<f64>()
    }

    /// Its convex parts, in its frame.
    pub fn parts(&self) -> Vec<(Pose, Shape)> {
        let [x, y, z] = self.size;
        match self.kind {
            Kind::Box => vec![(Pose::IDENTITY, Shape::Box { size: self.size })],
            Kind::Plate => vec![disc(-z / 4.0, FOOT * x / 2.0, z / 2.0), disc(z / 4.0, x / 2.0, z / 2.0)],
            Kind::Bowl => hollow(FOOT * x / 2.0, x / 2.0, z),
            Kind::Cup => hollow(x / 2.0, x / 2.0, z),
            Kind::Fork => {
                let (handle, head) = (HANDLE * x, (1.0 - HANDLE) * x);
                vec![
                    (Pose::at((handle - x) / 2.0, 0.0, 0.0), Shape::Box { size: [handle, HANDLE_WIDTH * y, z] }),
                    (Pose::at((x - head) / 2.0, 0.0, 0.0), Shape::Box { size: [head, y, z] }),
                ]
            }
        }
    }

    /// The cuboid that fingers at `tool` (in the object's frame, closing along y) can close around: all of a box or a cup, a fork's handle or
    /// head, and for wider objects the wall next to the fingers. Of a round wall only the width that is flat enough.
    pub fn grip_part(&self, tool: &Pose) -> (Pose, [f64; 3]) {
        let [x, y, z] = self.size;
        let [at_x, at_y, _] = tool.position;
        match self.kind {
            Kind::Box => (Pose::IDENTITY, self.size),
            Kind::Fork => {
                let (handle, head) = (HANDLE * x, (1.0 - HANDLE) * x);
                if at_x < handle - x / 2.0 {
                    (Pose::at((handle - x) / 2.0, 0.0, 0.0), [handle, HANDLE_WIDTH * y, z])
                } else {
                    (Pose::at((x - head) / 2.0, 0.0, 0.0), [head, y, z])
                }
            }
            Kind::Cup => {
                let closing = tool.rotate([0.0, 1.0, 0.0]);
                // Each flat finger touches the round wall along a line: what is farther to the side slides out from between them.
                (Pose::from_rpy([0.0; 3], 0.0, 0.0, closing[1].atan2(closing[0])), [x, RIM_WIDTH_M, z])
            }
            Kind::Plate | Kind::Bowl => {
                let turned = Pose::from_rpy([0.0; 3], 0.0, 0.0, at_y.atan2(at_x));
                let lean = (1.0 - FOOT) * x / 2.0 * (RIM_M / z).min(1.0);
                let thickness = WALL_M + lean;
                (turned.compose(&Pose::at((x - thickness) / 2.0, 0.0, 0.0)), [thickness, RIM_WIDTH_M, z])
            }
        }
    }

    /// Lean of the rim outwards, in radians, if fingers that close around it from above slide off: friction holds up to a lean of the friction
    /// angle.
    pub fn slips_off(&self) -> Option<f64> {
        let is_held_by_it = matches!(self.kind, Kind::Bowl | Kind::Plate);
        let lean = self.seen().rim_lean().filter(|_| is_held_by_it)?;
        (lean.tan() > self.kind.friction()).then_some(lean)
    }

    /// Whether rotations about its upright axis leave it the same.
    pub fn is_round(&self) -> bool {
        matches!(self.kind, Kind::Plate | Kind::Bowl | Kind::Cup)
    }

    /// What the camera sees of it.
    pub fn seen(&self) -> Seen {
        let [x, _, height] = self.size;
        let round = |kind| Seen::Round { kind, radius: x / 2.0, height };
        match self.kind {
            Kind::Box => Seen::Box { size: self.size },
            Kind::Plate => round(Round::Plate),
            Kind::Bowl => round(Round::Bowl),
            Kind::Cup => round(Round::Cup),
            Kind::Fork => Seen::Fork { length: x },
        }
    }
}

/// An upright disc with its centre at a height.
fn disc(height: f64, radius: f64, thickness: f64) -> (Pose, Shape) {
    (Pose::at(0.0, 0.0, height), Shape::Cylinder { radius, length: thickness })
}

/// A bottom and a ring of slabs that lean outwards from the radius of the bottom to that of the rim.
fn hollow(bottom: f64, rim: f64, height: f64) -> Vec<(Pose, Shape)> {
    let mut parts = vec![disc((WALL_M - height) / 2.0, bottom, WALL_M)];
    let lean = ((rim - bottom) / height).atan();
    let length = height / lean.cos() - WALL_M * lean.tan();
    let middle = (bottom + rim - WALL_M) / 2.0;
    let width = 2.0 * middle * (PI / f64::from(SLABS)).tan();
    for slab in 0..SLABS {
        let around = Pose::from_rpy([0.0; 3], 0.0, 0.0, TAU * f64::from(slab) / f64::from(SLABS));
        let leaning = Pose::from_rpy([middle, 0.0, 0.0], 0.0, lean, 0.0);
        parts.push((around.compose(&leaning), Shape::Box { size: [WALL_M, width, length] }));
    }
    parts
}
