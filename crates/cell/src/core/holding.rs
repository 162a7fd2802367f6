//! What happens to boxes when the fingers close and open.

use super::boxes::{ON_BASE, Place};
use super::cell::Cell;
use super::placement::TABLE;
use super::protocol::{Ending, Product};
use super::settling::{Surface, settle};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::robot::{Geometry, Robot};
use std::f64::consts::PI;

impl Cell {
    pub(super) fn held(&self) -> Option<usize> {
        self.boxes.iter().position(|b| matches!(b.place, Place::Held { .. }))
    }

    pub(super) fn close(&mut self, from: f64, object: String, expected: Option<&Pose>) -> Ending {
        let tool = self.robot.tool_pose(&self.configuration());
        let there: Vec<(String, Pose, [f64; 3])> =
            self.boxes.iter().map(|b| (b.id.clone(), b.pose(&tool), b.size)).collect();
        match self.pads.close(&tool, from, &there) {
            Ok(grip) => {
                self.resting.finger = grip.width / 2.0;
                self.boxes[grip.index].place = Place::Held { in_tool: grip.in_tool };
                let size = self.boxes[grip.index].size;
                let in_gripper = expected.map(|e| turned_like(&grip.in_tool, &size, e));
                Ending::Done(Product::Grasped { object, width: grip.width, in_gripper })
            }
            Err(reason) => {
                // Something stopped the fingers, or nothing did: either way they hold nothing.
                self.resting.finger = 0.0;
                Ending::Aborted(format!("{object} is not grasped: {reason}"))
            }
        }
    }

    pub(super) fn let_go(&mut self) {
        let Some(held) = self.held() else { return };
        let tool = self.robot.tool_pose(&self.configuration());
        let pose = self.boxes[held].pose(&tool);
        let place = settle(&pose, &self.boxes[held].size, &self.surfaces(held));
        self.boxes[held].place = place;
    }

    /// What a box can stand on: the table, the deck, the other boxes.
    fn surfaces(&self, without: usize) -> Vec<Surface> {
        let [x, y, _] = aimm::TABLE_CENTRE;
        let table = Surface {
            name: TABLE.to_owned(),
            pose: Pose::at(x, y, aimm::TABLE_HEIGHT_M),
            size: [aimm::TABLE_SIZE[0], aimm::TABLE_SIZE[1]],
        };
        let mut surfaces = vec![table];
        surfaces.extend(deck(&self.robot));
        for (i, other) in self.boxes.iter().enumerate() {
            if let (Place::At { pose, standing: true, .. }, true) = (&other.place, i != without) {
                surfaces.push(Surface {
                    name: other.id.clone(),
                    pose: pose.compose(&Pose::at(0.0, 0.0, other.size[2] / 2.0)),
                    size: [other.size[0], other.size[1]],
                });
            }
        }
        surfaces
    }
}

/// The load deck: the top of the base.
fn deck(robot: &Robot) -> Option<Surface> {
    let body = robot.links[robot.link("base")?].bodies.first()?;
    let Geometry::Box { half } = body.geometry else { return None };
    let [x, y, z] = body.pose.position;
    Some(Surface { name: ON_BASE.to_owned(), pose: Pose::at(x, y, z + half[2]), size: [2.0 * half[0], 2.0 * half[1]] })
}

/// The same box turned into whichever of its symmetries is closest to `expected`: nobody can tell them apart. Quarter turns
/// count only where the sides that change places are about equal.
fn turned_like(pose: &Pose, size: &[f64; 3], expected: &Pose) -> Pose {
    const SQUARE_M: f64 = 0.01;
    let quarters = if (size[0] - size[1]).abs() < SQUARE_M { 1 } else { 2 };
    let turned = |flip: f64, quarter: usize| {
        let turn = Pose::from_rpy([0.0; 3], flip, 0.0, quarter as f64 * PI / 2.0);
        pose.compose(&turn)
    };
    let symmetries = [0.0, PI].into_iter().flat_map(|flip| (0..4).step_by(quarters).map(move |q| (flip, q)));
    symmetries
        .map(|(flip, quarter)| turned(flip, quarter))
        .min_by(|a, b| a.angle(expected).total_cmp(&b.angle(expected)))
        .unwrap_or(*pose)
}
