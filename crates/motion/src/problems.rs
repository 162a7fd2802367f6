//! Planning problems from a file: a robot's joints and, by class, scenes with a start and a goal.
//!
//! The format is JSON: `robot`, `joints` (names, the order of all positions) and `problems`, per class a list of `index`, `start`,
//! `goal` (radians, metres for sliding joints) and `objects` (`name`, `position` in metres, `quat_xyzw`, and by `type` a `box`
//! with `size`, a `cylinder` or `capsule` with `length` and `radius`, a `sphere` with `radius`; a capsule's `length` is between
//! the centres of its ends). `attached` counts what the robot holds, which must be nothing.

use crate::geometry::Geometry;
use crate::space::Obstacle;
use ratn_model::pose::Pose;
use serde::Deserialize;
use std::collections::BTreeMap;

/// All problems of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Problems {
    /// The robot's name.
    pub robot: String,
    /// What is planned for.
    pub joints: Vec<String>,
    /// By class, in the order of the alphabet.
    pub classes: BTreeMap<String, Vec<Problem>>,
}

/// A start and a goal among obstacles.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// Its number in its class.
    pub index: u64,
    /// What stands around.
    pub obstacles: Vec<Obstacle>,
    /// Joint positions.
    pub start: Vec<f64>,
    /// Joint positions.
    pub goal: Vec<f64>,
}

/// A file that holds no problems.
#[derive(Debug, thiserror::Error)]
pub enum ProblemError {
    /// Not JSON of this form.
    #[error("not a file of planning problems: {0}")]
    Form(#[from] serde_json::Error),
    /// No problem at all.
    #[error("it holds no problems: `problems` is a list of problems for each class")]
    None,
    /// A joint that is named twice.
    #[error("the joint `{joint}` is named twice in `joints`")]
    Twice {
        /// Its name.
        joint: String,
    },
    /// A value that cannot be.
    #[error("problem {index} of class `{class}`: {reason}")]
    Value {
        /// Its class.
        class: String,
        /// Its number.
        index: u64,
        /// What is wrong with it.
        reason: String,
    },
}

impl Problems {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// [`ProblemError`] names the line, or the problem and what is wrong with it.
    pub fn parse(text: &str) -> Result<Problems, ProblemError> {
        let file: File = serde_json::from_str(text)?;
        let twice = file.joints.iter().enumerate().find(|(i, name)| file.joints[..*i].contains(name));
        if let Some((_, joint)) = twice {
            return Err(ProblemError::Twice { joint: joint.clone() });
        }
        if file.problems.values().all(Vec::is_empty) {
            return Err(ProblemError::None);
        }
        let mut classes = BTreeMap::new();
        for (class, entries) in file.problems {
            let read = |entry: Entry| {
                let index = entry.index;
                entry.read(file.joints.len()).map_err(|reason| ProblemError::Value {
                    class: class.clone(),
                    index,
                    reason,
                })
            };
            let problems = entries.into_iter().map(read).collect::<Result<Vec<_>, _>>()?;
            classes.insert(class, problems);
        }
        Ok(Problems { robot: file.robot, joints: file.joints, classes })
    }
}

#[derive(Deserialize)]
struct File {
    #[serde(default)]
    robot: String,
    joints: Vec<String>,
    problems: BTreeMap<String, Vec<Entry>>,
}

#[derive(Deserialize)]
struct Entry {
    #[serde(default)]
    index: u64,
    objects: Vec<Object>,
    #[serde(default)]
    attached: u64,
    start: Vec<f64>,
    goal: Vec<f64>,
}

#[derive(Deserialize)]
struct Object {
    name: String,
    position: [f64; 3],
    quat_xyzw: [f64; 4],
    #[serde(flatten)]
    shape: Shape,
}

#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Shape {
    Box { size: [f64; 3] },
    Cylinder { length: f64, radius: f64 },
    Capsule { length: f64, radius: f64 },
    Sphere { radius: f64 },
}

impl Entry {
    fn read(self, joints: usize) -> Result<Problem, String> {
        for (what, positions) in [("start", &self.start), ("goal", &self.goal)] {
            if positions.len() != joints {
                return Err(format!("its {what} has {} positions, the robot has {joints} joints", positions.len()));
            }
            if !positions.iter().all(|p| p.is_finite()) {
                return Err(format!("its {what} is not finite"));
            }
        }
        if self.attached > 0 {
            return Err("attached objects are not supported".to_owned());
        }
        let obstacles = self.objects.into_iter().map(Object::read).collect::<Result<_, _>>()?;
        Ok(Problem { index: self.index, obstacles, start: self.start, goal: self.goal })
    }
}

impl Object {
    fn read(self) -> Result<Obstacle, String> {
        let (geometry, extents) = match self.shape {
            Shape::Box { size } => (Geometry::Box { half: size.map(|s| s / 2.0) }, size.to_vec()),
            Shape::Cylinder { length, radius } => {
                (Geometry::Cylinder { radius, half_length: length / 2.0 }, vec![length, radius])
            }
            Shape::Capsule { length, radius } => {
                (Geometry::Capsule { radius, half_length: length / 2.0 }, vec![length, radius])
            }
            Shape::Sphere { radius } => (Geometry::Sphere { radius }, vec![radius]),
        };
        let norm = self.quat_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        let good = extents.iter().all(|e| *e > 0.0 && e.is_finite()) && self.position.iter().all(|c| c.is_finite());
        if !good || !norm.is_finite() || norm < 1e-6 {
            return Err(format!("object `{}` has no proper size, place or rotation", self.name));
        }
        let quaternion_xyzw = self.quat_xyzw.map(|c| c / norm);
        Ok(Obstacle { name: self.name, pose: Pose { position: self.position, quaternion_xyzw }, geometry })
    }
}
