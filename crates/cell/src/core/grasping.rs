//! What the fingers really hold.
//!
//! When they close, the pads of the two fingers sweep a cuboid of the tool frame, along y. The part of an object that they can close around is a
//! cuboid, too (`Model::grip_part`): a box, the wall of a bowl. It is grasped when two of its opposite faces are roughly perpendicular to that
//! direction, everything of it that the pads would meet is between them, and the pads cover enough of it. Closing then rotates and shifts it until
//! its faces are flush with the pads: rigid fingers do that to objects that give way, so a pose that was off by millimetres ends exactly in the
//! middle.

use ratn_model::pose::Pose;
use ratn_motion::robot::{FingerPart, Robot};

/// The fingers' pads, in the tool frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pads {
    /// Minimum and maximum x.
    pub x: [f64; 2],
    /// Minimum z (the palm's side).
    pub z_from: f64,
    /// Maximum z (the tips).
    pub z_to: f64,
    /// Thickness of the fingers behind the pads.
    pub thick: f64,
}

/// A grasp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grip {
    /// The index of the held cuboid in the input.
    pub index: usize,
    /// The opening at which the fingers stopped, in metres.
    pub width: f64,
    /// The cuboid's pose in the tool frame after the fingers have closed.
    pub in_tool: Pose,
}

/// Why the fingers hold nothing after closing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotGrasped {
    /// No object is there.
    #[error("nothing is between the fingers")]
    Nothing,
    /// The object is rotated too far to lie flush with the pads.
    #[error("{id} stands {degrees:.0}° askew between the fingers; at most {MAX_ASKEW_DEGREES}° is taken")]
    Askew {
        /// The object.
        id: String,
        /// Its angle, in degrees.
        degrees: f64,
    },
    /// A finger would close inside of the object, or beside it.
    #[error("{id} is not between the fingers: it reaches {beyond_mm:.0} mm beyond one of them")]
    Beyond {
        /// The object.
        id: String,
        /// How far it reaches beyond a finger, in millimetres.
        beyond_mm: f64,
    },
    /// Only an edge of the object is between the pads.
    #[error("the fingers hold only an edge of {id}: {held_mm:.0} mm of it, at least {:.0} mm are needed", MIN_HOLD_M * 1e3)]
    Edge {
        /// The object.
        id: String,
        /// The length that the pads hold, in millimetres.
        held_mm: f64,
    },
    /// Two objects are between the fingers.
    #[error("{first} and {second} are both between the fingers")]
    Several {
        /// The first object.
        first: String,
        /// The second object.
        second: String,
    },
}

impl NotGrasped {
    /// The object that the fingers closed at; the first one if there are several.
    pub fn object(&self) -> Option<&str> {
        match self {
            NotGrasped::Nothing => None,
            NotGrasped::Askew { id, .. } | NotGrasped::Beyond { id, .. } | NotGrasped::Edge { id, .. } => Some(id),
            NotGrasped::Several { first, .. } => Some(first),
        }
    }
}

/// Maximum angle between a cuboid's axis and the closing direction.
pub const MAX_ASKEW_DEGREES: f64 = 15.0;
/// Minimum length of the cuboid that the pads must hold, along x and along z.
pub const MIN_HOLD_M: f64 = 0.008;
/// How far the pads give way, in metres.
const PAD_GIVE_M: f64 = 0.002;

impl Pads {
    /// The pads of a robot's gripper. `None` if no box of the finger is aligned with the tool's axes and none of its shapes is a mesh.
    pub fn of(robot: &Robot) -> Option<Pads> {
        let FingerPart { middle: [x, _, z], half, .. } = robot.pad()?;
        Some(Pads { x: [x - half[0], x + half[0]], z_from: z - half[2], z_to: z + half[2], thick: 2.0 * half[1] })
    }

    /// What the fingers hold when they close from `finger` metres on each side of the middle.
    ///
    /// # Errors
    /// [`NotGrasped`] says why they hold nothing.
    pub fn close(&self, tool: &Pose, finger: f64, cuboids: &[(String, Pose, [f64; 3])]) -> Result<Grip, NotGrasped> {
        let mut grip: Option<Grip> = None;
        for (index, (id, pose, size)) in cuboids.iter().enumerate() {
            let in_tool = tool.inverse().compose(pose);
            if !self.meets(finger, &in_tool, size) {
                continue;
            }
            let new = self.grip(index, id, &in_tool, size, finger)?;
            if let Some(other) = grip {
                return Err(NotGrasped::Several { first: cuboids[other.index].0.clone(), second: id.clone() });
            }
            grip = Some(new);
        }
        grip.ok_or(NotGrasped::Nothing)
    }

    /// The part of a cuboid between the closed pads: minimum and maximum x and z in the tool frame. `None` if it is too small to be held.
    pub fn patch(&self, in_tool: &Pose, size: &[f64; 3]) -> Option<[[f64; 2]; 2]> {
        let axes = axes(in_tool);
        let across = (0..3).max_by(|a, b| axes[*a][1].abs().total_cmp(&axes[*b][1].abs())).unwrap_or(1);
        let [x, z] = [(0, self.x), (2, [self.z_from, self.z_to])].map(|(axis, [from, to])| {
            let reach: f64 = (0..3).filter(|k| *k != across).map(|k| axes[k][axis].abs() * size[k] / 2.0).sum();
            [(in_tool.position[axis] - reach).max(from), (in_tool.position[axis] + reach).min(to)]
        });
        let enough = [x, z].iter().all(|[low, high]| high - low >= MIN_HOLD_M);
        enough.then_some([x, z])
    }

    /// Whether a cuboid is between the fingers, `finger` metres on each side of the middle, or in one of them.
    pub fn are_at(&self, finger: f64, in_tool: &Pose, size: &[f64; 3]) -> bool {
        self.meets(finger + self.thick, in_tool, size)
    }

    /// Whether a cuboid overlaps with the one that the pads sweep when they close from `finger` metres on each side of the middle: no axis of either
    /// separates the two.
    pub fn meets(&self, finger: f64, in_tool: &Pose, size: &[f64; 3]) -> bool {
        let [x_from, x_to] = self.x;
        let half = [(x_to - x_from) / 2.0, finger, (self.z_to - self.z_from) / 2.0];
        let middle = [(x_to + x_from) / 2.0, 0.0, (self.z_to + self.z_from) / 2.0];
        let offset: [f64; 3] = std::array::from_fn(|i| in_tool.position[i] - middle[i]);
        let axes = axes(in_tool);
        let along_tool = |i: usize| {
            let reach: f64 = (0..3).map(|k| axes[k][i].abs() * size[k] / 2.0).sum();
            offset[i].abs() < half[i] + reach
        };
        let along_it = |k: usize| {
            let reach: f64 = (0..3).map(|i| axes[k][i].abs() * half[i]).sum();
            let distance: f64 = (0..3).map(|i| axes[k][i] * offset[i]).sum();
            distance.abs() < size[k] / 2.0 + reach
        };
        (0..3).all(along_tool) && (0..3).all(along_it)
    }

    fn grip(&self, index: usize, id: &str, in_tool: &Pose, size: &[f64; 3], finger: f64) -> Result<Grip, NotGrasped> {
        let id = || id.to_owned();
        let axes = axes(in_tool);
        let across = (0..3).max_by(|a, b| axes[*a][1].abs().total_cmp(&axes[*b][1].abs())).unwrap_or(1);
        let askew = axes[across][1].abs().min(1.0).acos().to_degrees();
        if askew > MAX_ASKEW_DEGREES {
            return Err(NotGrasped::Askew { id: id(), degrees: askew });
        }
        let width = size[across];
        let beyond = in_tool.position[1].abs() + width / 2.0 - finger;
        if beyond > PAD_GIVE_M {
            return Err(NotGrasped::Beyond { id: id(), beyond_mm: beyond * 1e3 });
        }
        let held = |axis: usize, from: f64, to: f64| {
            let reach: f64 = (0..3).filter(|k| *k != across).map(|k| axes[k][axis].abs() * size[k] / 2.0).sum();
            (in_tool.position[axis] + reach).min(to) - (in_tool.position[axis] - reach).max(from)
        };
        let held = held(0, self.x[0], self.x[1]).min(held(2, self.z_from, self.z_to));
        if held < MIN_HOLD_M {
            return Err(NotGrasped::Edge { id: id(), held_mm: held.max(0.0) * 1e3 });
        }
        Ok(Grip { index, width, in_tool: flush(in_tool, axes[across]) })
    }
}

/// The pose of an object in the tool frame after the fingers have closed around it, `width` metres apart, from the pose estimate before and from what
/// two fingers measure.
///
/// They measure the width, and that there is something. If the centre of the estimated pose is between the pads, the object's faces are flush with
/// them and it is centred: this gives one position and the rotations about the two other axes. If it is not, as for a bowl that is held by its rim,
/// nothing follows from the width. Errors along the fingers, and about the axis on which they close, remain unmeasured.
pub fn felt(believed: &Pose, width: f64) -> Pose {
    if believed.position[1].abs() > width / 2.0 {
        return *believed;
    }
    let axes = axes(believed);
    let across = (0..3).max_by(|a, b| axes[*a][1].abs().total_cmp(&axes[*b][1].abs())).unwrap_or(1);
    if axes[across][1].abs() < MAX_ASKEW_DEGREES.to_radians().cos() {
        // The object is round, or not the estimated one: its rotation cannot be felt.
        let [x, _, z] = believed.position;
        return Pose { position: [x, 0.0, z], ..*believed };
    }
    flush(believed, axes[across])
}

/// The pose after closing: the axis that was roughly along ±y is exactly so, and the cuboid is centred.
fn flush(in_tool: &Pose, axis: [f64; 3]) -> Pose {
    let side = axis[1].signum();
    // The rotation from `axis` to ±y: about their cross product, by the angle between them.
    let turn = [-axis[2] * side, 0.0, axis[0] * side];
    let sine = (turn[0] * turn[0] + turn[2] * turn[2]).sqrt();
    let mut pose = *in_tool;
    if sine > 1e-12 {
        let half = sine.atan2(axis[1].abs()) / 2.0;
        let scale = half.sin() / sine;
        let rotation =
            Pose { position: [0.0; 3], quaternion_xyzw: [turn[0] * scale, 0.0, turn[2] * scale, half.cos()] };
        pose.quaternion_xyzw = rotation.compose(&Pose { position: [0.0; 3], ..*in_tool }).quaternion_xyzw;
    }
    pose.position[1] = 0.0;
    pose
}

fn axes(pose: &Pose) -> [[f64; 3]; 3] {
    [pose.rotate([1.0, 0.0, 0.0]), pose.rotate([0.0, 1.0, 0.0]), pose.rotate([0.0, 0.0, 1.0])]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::f64::consts::PI;

    const PADS: Pads = Pads { x: [-0.0125, 0.0125], z_from: -0.055, z_to: 0.015, thick: 0.014 };
    const SIZE: [f64; 3] = [0.12, 0.07, 0.10];

    /// The tool points down from 3 cm below the top of a box at the origin.
    fn tool() -> Pose {
        Pose::from_rpy([0.0, 0.0, 0.02], PI, 0.0, 0.0)
    }

    fn close(pose: Pose) -> Result<Grip, NotGrasped> {
        PADS.close(&tool(), 0.055, &[("slc_1".to_owned(), pose, SIZE)])
    }

    #[test]
    fn a_box_between_the_fingers_is_held_and_ends_flush_in_the_middle() {
        let grip = close(Pose::from_rpy([0.02, 0.012, 0.003], 0.0, 0.0, 0.1)).unwrap();
        assert_eq!(grip.width, 0.07);
        assert!(grip.in_tool.position[1].abs() < 1e-12);
        assert!((grip.in_tool.position[0] - 0.02).abs() < 1e-9);
        assert!(grip.in_tool.rotate([0.0, 1.0, 0.0])[1].abs() > 1.0 - 1e-12);
        assert!(grip.in_tool.rotate([0.0, 0.0, 1.0])[2] < -1.0 + 1e-12, "still upright");
    }

    #[test]
    fn a_box_beside_the_fingers_is_not_held() {
        assert_eq!(close(Pose::at(0.3, 0.0, 0.0)), Err(NotGrasped::Nothing));
        assert_eq!(close(Pose::at(0.0, 0.0, -0.12)), Err(NotGrasped::Nothing));
        assert!(matches!(close(Pose::at(0.0, 0.03, 0.0)), Err(NotGrasped::Beyond { .. })));
    }

    #[test]
    fn a_box_wider_than_the_opening_is_not_held() {
        let turned = Pose::from_rpy([0.0; 3], 0.0, 0.0, PI / 2.0);
        assert!(matches!(close(turned), Err(NotGrasped::Beyond { beyond_mm, .. }) if beyond_mm > 4.0));
    }

    #[test]
    fn a_box_that_stands_askew_is_not_held() {
        assert!(matches!(close(Pose::from_rpy([0.0; 3], 0.0, 0.0, 0.5)), Err(NotGrasped::Askew { .. })));
    }

    #[test]
    fn an_edge_is_not_enough() {
        assert!(matches!(close(Pose::at(0.07, 0.0, 0.0)), Err(NotGrasped::Edge { .. })));
    }

    #[test]
    fn fingers_feel_what_is_across_them_and_believe_the_rest() {
        let believed = Pose::from_rpy([0.02, 0.006, 0.004], PI, 0.0, 0.1);
        let felt_box = felt(&believed, 0.07);
        assert_eq!(felt_box.position, [0.02, 0.0, 0.004], "only the offset across the fingers is known to be none");
        assert!(felt_box.rotate([0.0, 1.0, 0.0])[1].abs() > 1.0 - 1e-12, "a box lies flush");
        // A cup looks the same from all sides: its yaw is not changed.
        let round = Pose::from_rpy([0.02, 0.006, 0.004], PI, 0.0, 0.7);
        assert_eq!(felt(&round, 0.07), Pose { position: [0.02, 0.0, 0.004], ..round });
        // A bowl that is held by its wall: the distance of its centre is not known.
        let bowl = Pose::from_rpy([0.0, 0.06, 0.01], PI, 0.0, 0.0);
        assert_eq!(felt(&bowl, 0.005), bowl);
    }

    #[test]
    fn fingers_are_at_a_box_until_their_tips_are_above_it() {
        let at = |up: f64, aside: f64| {
            let tool = Pose { position: [0.0, aside, 0.02 + up], ..tool() };
            PADS.are_at(0.055, &tool.inverse(), &SIZE)
        };
        // The tips are 15 mm below the tool, the top of the box is 30 mm above it.
        assert!(at(0.0, 0.0) && at(0.04, 0.0) && !at(0.05, 0.0));
        // A finger fully inside the box, and one beside it.
        assert!(at(0.0, 0.055 + 0.014) && !at(0.0, 0.035 + 0.055 + 0.015));
    }

    #[test]
    fn of_two_boxes_none_is_held() {
        let boxes = [
            ("slc_1".to_owned(), Pose::at(0.0, -0.02, 0.0), [0.1, 0.03, 0.1]),
            ("slc_2".to_owned(), Pose::at(0.0, 0.02, 0.0), [0.1, 0.03, 0.1]),
        ];
        assert!(matches!(PADS.close(&tool(), 0.055, &boxes), Err(NotGrasped::Several { .. })));
    }
}
