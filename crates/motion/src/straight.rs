//! A straight part of a motion of the tool: how far it goes, in which direction, and in whose frame that direction is given.
//!
//! The tool keeps its rotation along the part. What the arm does for it: `line`.

use crate::frame::norm;
use crate::plan::PlanError;
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};
use std::fmt;

/// The longest straight part, in metres.
pub const MAX_STRAIGHT_M: f64 = 0.5;

/// A direction that is shorter has none.
const LEAST_DIRECTION: f64 = 1e-6;

/// The most objects that an error names.
const MAX_NAMES: usize = 12;

/// A straight part of a motion; none where its length is 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Straight {
    /// Where the tool moves; of any length but zero.
    pub direction: [f64; 3],
    /// Whose axes `direction` is along.
    pub frame: Frame,
    /// How far it goes, in metres.
    pub length_m: f64,
}

/// Whose axes a direction is along.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Frame {
    /// z is up.
    World,
    /// x is ahead, z is up.
    Base,
    /// The tool's, whose rotation stays the same along the part.
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

    /// Whether there is such a part.
    pub fn is_some(&self) -> bool {
        self.length_m > 0.0
    }

    /// The way of the tool from the beginning of the part to its end, in the frame of the base, which is at `base`; `tool` is there, too.
    /// None for an object that is not in the scene.
    pub(crate) fn way(&self, scene: &Scene, base: &Pose, tool: &Pose) -> Option<[f64; 3]> {
        let direction = self.direction.map(|c| c / norm(self.direction) * self.length_m);
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

    /// Refuses what makes no sense; where there is no part, nobody looks at the frame. `which` is `approach` or `depart`.
    pub(crate) fn check(&self, which: &str, scene: &Scene) -> Result<(), PlanError> {
        let malformed = |part: &str, value: String, expected: String| {
            Err(PlanError::Malformed { what: format!("{which}_{part}"), value, expected })
        };
        if !(0.0..=MAX_STRAIGHT_M).contains(&self.length_m) {
            return malformed("m", self.length_m.to_string(), format!("0 to {MAX_STRAIGHT_M} m"));
        }
        let length = norm(self.direction);
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
