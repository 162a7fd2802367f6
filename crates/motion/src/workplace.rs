//! Where a robot fetches boxes: a table, a region of it on which they stand, and the places that they are brought to.
//!
//! It is the `[workplace]` of a `robot.toml` and what a cell is furnished with; planner and detector do not need it.
//! Metres and radians in the world frame; places on the base are seen from the base.

use crate::robot::Robot;
use crate::tableware::Tableware;
use ratn_model::pose::Pose;
use serde::Deserialize;

/// The most places.
pub const MAX_PLACES: usize = 9;
/// How far a place on the table may be above or below the table's top, in metres.
const LEVEL_M: f64 = 0.001;

/// See the module.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Workplace {
    /// The table's top.
    pub table: Slab,
    /// The boxes on it: those of the first arm.
    pub boxes: Boxes,
    /// Where they are brought to.
    pub places: Places,
    /// What further arms have of their own.
    #[serde(default, rename = "other_arm")]
    pub others: Vec<Share>,
    /// The part of the table into which several arms reach, one at a time.
    #[serde(default)]
    pub middle: Option<Middle>,
    /// The rack and the places of tableware, for the scene `table` of a cell.
    #[serde(default)]
    pub tableware: Option<Tableware>,
}

/// What a further arm fetches, and whereto.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Share {
    /// The arm's name.
    pub arm: String,
    /// Its boxes.
    pub boxes: Boxes,
    /// Where it brings them.
    pub places: Places,
}

/// A strip of the table that belongs to nobody. A cell offers it as a resource: who goes there holds that.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Middle {
    /// From which y to which.
    pub y: [f64; 2],
}

/// A flat cuboid.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slab {
    /// Its centre.
    pub centre: [f64; 3],
    /// Its edges.
    pub size: [f64; 3],
}

/// Where boxes stand, and how large they are.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Boxes {
    /// Least and greatest x of their centres.
    pub x: [f64; 2],
    /// Least and greatest y.
    pub y: [f64; 2],
    /// Least edges: longer horizontal, shorter horizontal, height.
    pub least: [f64; 3],
    /// Greatest edges.
    pub greatest: [f64; 3],
}

/// Places for a box each.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Places {
    /// On what.
    pub on: Surface,
    /// How a box's longer edge lies there, from the x axis.
    #[serde(default)]
    pub yaw: f64,
    /// Points on that surface.
    pub at: Vec<[f64; 3]>,
}

/// What places are on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// The table.
    Table,
    /// The robot's base, which carries them away.
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
    /// As poses: on the surface, x along a box's longer edge.
    pub fn poses(&self) -> Vec<Pose> {
        self.at.iter().map(|at| Pose::from_rpy(*at, 0.0, 0.0, self.yaw)).collect()
    }
}

impl Workplace {
    /// The boxes and the places of every arm that has some, the first arm's first.
    pub fn shares(&self) -> impl Iterator<Item = (&Boxes, &Places)> {
        let others = self.others.iter().map(|share| (&share.boxes, &share.places));
        std::iter::once((&self.boxes, &self.places)).chain(others)
    }

    /// What is wrong with it for this robot, if anything.
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

/// What is wrong with the boxes and places of the arm from which the robot is seen, if anything.
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

/// The posture that a robot begins in.
pub const HOME: &str = "home";
