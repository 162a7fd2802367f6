//! What stands around in the cell: its shape as convex parts, its mass, and how it rubs.
//!
//! An object's frame sits in the middle of its bounding box, z up when it stands as it was made to. Bowls and cups are hollow:
//! a ring of slabs on a disc, so that something can lie in them and a finger can reach in. Thicknesses and masses are those of
//! small load carriers, porcelain and cutlery.

use ratn_model::pose::Pose;
use ratn_perception::model::{Model as Seen, Round};
use ratn_world::scene::Shape;
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

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

/// How thick the walls of bowls and cups are, in metres.
const WALL_M: f64 = 0.004;
/// How many slabs a round wall has.
const SLABS: u32 = 16;
/// The foot of plates and bowls, as a part of their greatest width.
pub(super) const FOOT: f64 = 0.6;
/// How much of a fork's length its handle is, and how wide that is as a part of its head.
const HANDLE: f64 = 0.7;
const HANDLE_WIDTH: f64 = 0.4;
/// How far down from the rim fingers hold what they hold by its rim, and how much of its round they meet as a flat wall, in metres.
const RIM_M: f64 = 0.02;
const RIM_WIDTH_M: f64 = 0.03;

impl Kind {
    /// As in a text.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Box => "box",
            Kind::Plate => "plate",
            Kind::Bowl => "bowl",
            Kind::Cup => "cup",
            Kind::Fork => "fork",
        }
    }

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

    /// The cuboid of it that fingers at `tool` (in its frame, closing along y) can close around: all of a box or a cup, a fork's
    /// handle or head, of what is wider the wall next to them. Of what is round only as wide a part as lies flat enough.
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
                // Flat fingers meet its round at a line each: what is farther to the side slides out from between them.
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

    /// By how much its rim leans outwards, in radians, where that is so much that fingers which close around it from above slide off:
    /// friction holds up to a lean of its own angle.
    pub fn slips_off(&self) -> Option<f64> {
        let is_held_by_it = matches!(self.kind, Kind::Bowl | Kind::Plate);
        let lean = self.seen().rim_lean().filter(|_| is_held_by_it)?;
        (lean.tan() > self.kind.friction()).then_some(lean)
    }

    /// What turns about its upright axis leave the same.
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

/// An upright disc with its middle at a height.
fn disc(height: f64, radius: f64, thickness: f64) -> (Pose, Shape) {
    (Pose::at(0.0, 0.0, height), Shape::Cylinder { radius, length: thickness })
}

/// A bottom and a ring of slabs that lean outwards from the bottom's radius to the rim's.
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
