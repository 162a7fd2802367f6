//! A straight part of a tool motion: its length, its direction, and the frame of that direction.
//!
//! The tool keeps its rotation along the part. `line` computes the motion of the arm.

use crate::plan::PlanError;
use crate::vector::{Vector, unit};
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};
use std::fmt;

/// Maximum length of a straight part, in metres.
pub const MAX_STRAIGHT_M: f64 = 0.5;

/// Minimum length of a direction vector.
const LEAST_DIRECTION: f64 = 1e-6;

/// Maximum number of objects in an error message.
const MAX_NAMES: usize = 12;

/// A straight part of a motion; there is none if its length is 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Straight {
    /// Direction of the tool's motion; of any length but zero.
    pub direction: [f64; 3],
    /// The frame of `direction`.
    pub frame: Frame,
    /// Length of the part, in metres.
    pub length_m: f64,
}

/// The frame of a direction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Frame {
    /// The world: z is up.
    World,
    /// The base: x is forward, z is up.
    Base,
    /// The tool, whose rotation stays the same along the part.
    Tool,
    /// An object of the scene, by its name; held or not.
    Object(String),
}

impl From<&str> for Frame {
    fn from(name: &str) -> Frame {
        match name {
            "world" => Frame::World,
            "base" => Frame::Base,
            "tool" => Frame::Tool,
            object => Frame::Object(object.to_owned()),
        }
    }
}

impl Straight {
    /// Straight up in the world.
    pub fn up(length_m: f64) -> Straight {
        Straight { direction: [0.0, 0.0, 1.0], frame: Frame::World, length_m }
    }

    /// Straight down in the world.
    pub fn down(length_m: f64) -> Straight {
        Straight { direction: [0.0, 0.0, -1.0], frame: Frame::World, length_m }
    }

    /// Whether the motion has this part.
    pub fn is_some(&self) -> bool {
        self.length_m > 0.0
    }

    /// The vector from the beginning of the part to its end, in the frame of the base, whose pose is `base`; `tool` is in the base's frame, too.
    /// `None` for an object that is not in the scene.
    pub(crate) fn way(&self, scene: &Scene, base: &Pose, tool: &Pose) -> Option<[f64; 3]> {
        let direction = (unit(self.direction.into()) * self.length_m).to_array();
        let from_world = base.inverse();
        Some(match &self.frame {
            Frame::World => from_world.rotate(direction),
            Frame::Base => direction,
            Frame::Tool => tool.rotate(direction),
            Frame::Object(name) => match &scene.objects.iter().find(|object| object.name == *name)?.placement {
                Placement::World(pose) => from_world.rotate(pose.rotate(direction)),
                Placement::Gripper(pose) => tool.rotate(pose.rotate(direction)),
                Placement::Hand { .. } => return None,
            },
        })
    }

    /// Refuses invalid values; without a part, the frame is not checked. `which` is `approach` or `depart`.
    pub(crate) fn check(&self, which: &str, scene: &Scene) -> Result<(), PlanError> {
        let malformed = |part: &str, value: String, expected: String| {
            Err(PlanError::Malformed { what: format!("{which}_{part}"), value, expected })
        };
        if !(0.0..=MAX_STRAIGHT_M).contains(&self.length_m) {
            return malformed("m", self.length_m.to_string(), format!("0 to {MAX_STRAIGHT_M} m"));
        }
        let length = Vector::from(self.direction).length();
        if !length.is_finite() || length < LEAST_DIRECTION {
            let expected = format!("a direction of finite numbers, longer than {LEAST_DIRECTION}");
            return malformed("direction", format!("{:?}", self.direction), expected);
        }
        match &self.frame {
            Frame::Object(name) if self.is_some() && !scene.objects.iter().any(|object| object.name == *name) => {
                let names: Vec<&str> = scene.objects.iter().take(MAX_NAMES).map(|o| o.name.as_str()).collect();
                let objects = if names.is_empty() { "there is none".to_owned() } else { names.join(", ") };
                malformed("frame", name.clone(), format!("world, base, tool, or an object of the scene ({objects})"))
            }
            _ => Ok(()),
        }
    }
}

impl fmt::Display for Straight {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let whose = match &self.frame {
            Frame::World if self.direction == [0.0, 0.0, 1.0] => {
                return write!(f, "{:.3} m straight up", self.length_m);
            }
            Frame::World if self.direction == [0.0, 0.0, -1.0] => {
                return write!(f, "{:.3} m straight down", self.length_m);
            }
            Frame::World => "the world",
            Frame::Base => "the base",
            Frame::Tool => "the tool",
            Frame::Object(name) => name,
        };
        let [x, y, z] = self.direction;
        write!(f, "{:.3} m along ({x}, {y}, {z}) of {whose}", self.length_m)
    }
}
