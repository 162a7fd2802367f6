//! The workplace of a robot: a table, the region of it where boxes stand, and the places to which they are brought.
//!
//! This is `[workplace]` of a `robot.toml` and defines the furniture of a cell; planner and detector do not need it. Metres and radians in the world
//! frame; places on the base are in the base's frame.

use crate::robot::Robot;
use crate::tableware::Tableware;
use ratn_model::pose::Pose;
use serde::Deserialize;

/// Maximum number of places.
pub const MAX_PLACES: usize = 9;
/// Maximum height of a place on the table above or below the table's top, in metres.
const LEVEL_M: f64 = 0.001;

/// See the module's description.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Workplace {
    /// The table's top.
    pub table: Slab,
    /// The boxes of the first arm, on the table.
    pub boxes: Boxes,
    /// The places to which these boxes are brought.
    pub places: Places,
    /// The boxes and places of further arms.
    #[serde(default, rename = "other_arm")]
    pub others: Vec<Share>,
    /// The part of the table that several arms can reach, one at a time.
    #[serde(default)]
    pub middle: Option<Middle>,
    /// The rack and the places of tableware, for the scene `table` of a cell.
    #[serde(default)]
    pub tableware: Option<Tableware>,
}

/// The boxes of a further arm and their places.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Share {
    /// The arm's name.
    pub arm: String,
    /// Its boxes.
    pub boxes: Boxes,
    /// The places to which it brings them.
    pub places: Places,
}

/// A strip of the table that is shared by the arms. A cell offers it as a resource, which has to be held to move there.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Middle {
    /// Minimum and maximum y.
    pub y: [f64; 2],
}

/// A flat cuboid.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slab {
    /// The position of its centre.
    pub centre: [f64; 3],
    /// Its edge lengths.
    pub size: [f64; 3],
}

/// The region and the sizes of boxes.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Boxes {
    /// Minimum and maximum x of their centres.
    pub x: [f64; 2],
    /// Minimum and maximum y.
    pub y: [f64; 2],
    /// Minimum edges: longer horizontal, shorter horizontal, height.
    pub least: [f64; 3],
    /// Maximum edges.
    pub greatest: [f64; 3],
}

/// Places for one box each.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Places {
    /// The surface.
    pub on: Surface,
    /// The angle of a box's longer edge from the x axis, in radians.
    #[serde(default)]
    pub yaw: f64,
    /// The points on that surface.
    pub at: Vec<[f64; 3]>,
}

/// The surface of places.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// The table.
    Table,
    /// The robot's base, which carries the boxes.
    Base,
}

impl Slab {
    /// Height of its upper face.
    pub fn top_m(&self) -> f64 {
        self.centre[2] + self.size[2] / 2.0
    }

    pub(crate) fn holds(&self, x: f64, y: f64) -> bool {
        [x, y].into_iter().zip(self.centre).zip(self.size).all(|((at, centre), size)| (at - centre).abs() <= size / 2.0)
    }
}

impl Places {
    /// The poses of the places: on the surface, x along a box's longer edge.
    pub fn poses(&self) -> Vec<Pose> {
        self.at.iter().map(|at| Pose::from_rpy(*at, 0.0, 0.0, self.yaw)).collect()
    }
}

impl Workplace {
    /// The boxes and places of every arm that has any, the first arm's first.
    pub fn shares(&self) -> impl Iterator<Item = (&Boxes, &Places)> {
        let others = self.others.iter().map(|share| (&share.boxes, &share.places));
        std::iter::once((&self.boxes, &self.places)).chain(others)
    }

    /// The error in it for this robot, if any.
    pub(crate) fn fault(&self, robot: &Robot) -> Option<String> {
        let Workplace { table, tableware, others, middle, .. } = self;
        if !positive(&table.size) || table.centre.iter().any(|c| !c.is_finite()) {
            return Some("`table` needs a centre and edges above 0".to_owned());
        }
        if let Some(fault) = share_fault(robot, table, &self.boxes, &self.places) {
            return Some(fault);
        }
        let mut shared: Vec<&str> = Vec::new();
        for Share { arm, boxes, places } in others {
            let view = robot.other_arms().any(|name| name == arm).then(|| robot.with_arm(arm));
            let Some(Ok(view)) = view.filter(|_| !shared.contains(&arm.as_str())) else {
                return Some(format!(
                    "`other_arm` has the arm `{arm}`: each of the further arms ({}) can have one share",
                    robot.other_arms().collect::<Vec<_>>().join(", ")
                ));
            };
            if let Some(fault) = share_fault(&view, table, boxes, places) {
                return Some(format!("`other_arm` `{arm}`: {fault}"));
            }
            shared.push(arm);
        }
        if let Some(Middle { y }) = middle.filter(|middle| !ordered(middle.y)) {
            return Some(format!("`middle.y` is {y:?}: expected a least and a greatest value"));
        }
        tableware.as_ref().and_then(|tableware| tableware.fault(table))
    }
}

fn ordered([low, high]: [f64; 2]) -> bool {
    low.is_finite() && high.is_finite() && low <= high
}

fn positive(size: &[f64; 3]) -> bool {
    size.iter().all(|edge| edge.is_finite() && *edge > 0.0)
}

/// The error in the boxes and places of the arm from which the robot is seen, if any.
fn share_fault(robot: &Robot, table: &Slab, boxes: &Boxes, places: &Places) -> Option<String> {
    let corners = [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(i, j)| (boxes.x[i], boxes.y[j]));
    let opening = 2.0 * robot.open_finger_m();
    let count = places.at.len();
    let off = |at: &&[f64; 3]| !(table.holds(at[0], at[1]) && (at[2] - table.top_m()).abs() <= LEVEL_M);
    if !ordered(boxes.x) || !ordered(boxes.y) {
        Some("`boxes.x` and `boxes.y` are each a least and a greatest value".to_owned())
    } else if let Some((x, y)) = corners.into_iter().find(|(x, y)| !table.holds(*x, *y)) {
        Some(format!("`boxes` reaches ({x}, {y}), which is beyond the table"))
    } else if !positive(&boxes.least)
        || (0..3).any(|i| boxes.least[i] > boxes.greatest[i] || !boxes.greatest[i].is_finite())
    {
        Some("`boxes.least` has an edge that is not above 0, or greater than the same of `boxes.greatest`".to_owned())
    } else if boxes.greatest[1] >= opening {
        let width = boxes.greatest[1];
        Some(format!("`boxes.greatest` is {width} m across: the gripper opens to {opening} m"))
    } else if !(1..=MAX_PLACES).contains(&count)
        || !places.yaw.is_finite()
        || places.at.iter().flatten().any(|c| !c.is_finite())
    {
        Some(format!("`places.at` has {count} points: 1 to {MAX_PLACES} of three numbers each are needed"))
    } else if places.on == Surface::Base && robot.base_joints().is_empty() {
        Some("`places.on` is `base`: this robot has no [base]; use `table`".to_owned())
    } else if let Some(at) = places.at.iter().find(off).filter(|_| places.on == Surface::Table) {
        Some(format!("the place {at:?} is not on the table, whose top is at z = {}", table.top_m()))
    } else if robot.posture(HOME).is_none() {
        Some(format!("the robot begins in the posture `{HOME}`: add it to [postures]"))
    } else {
        None
    }
}

/// The name of the robot's initial posture.
pub const HOME: &str = "home";
