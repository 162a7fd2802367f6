//! What happens to objects when the fingers close and open, and while they hold something.

use super::boxes::ON_BASE;
use super::cell::Cell;
use super::environment::{GRAVITY, Grip, Hold, Load, STEP, Slip, Support};
use super::faults::Kind as Fault;
use super::protocol::{Ending, Product};
use ratn_model::pose::Pose;
use std::f64::consts::PI;

/// What the fingers are closed around.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Held {
    pub(super) object: usize,
    pub(super) in_tool: Pose,
    slip: Slip,
    friction: f64,
    /// Where the tool was at the last two steps, the last one last.
    trail: [Option<[f64; 3]>; 2],
    /// The tool stood still and it did not slip.
    steady: bool,
}

/// How far something may lean and still stand as it was made to.
const MAX_LEAN_RAD: f64 = 0.2;

impl Held {
    /// Around an object that does not slip.
    pub(super) fn new(object: usize, in_tool: Pose, friction: f64) -> Held {
        Held { object, in_tool, slip: Slip::default(), friction, trail: [None; 2], steady: false }
    }

    /// What it can be made of again.
    pub(super) fn save(&self) -> (usize, Pose, f64) {
        (self.object, self.in_tool, self.friction)
    }

    /// Whether it stays where it is as long as the tool does.
    pub(super) fn is_steady(&self) -> bool {
        self.steady
    }

    /// The fingers are as slippery as that from now on.
    pub(super) fn set_friction(&mut self, friction: f64) {
        (self.friction, self.steady) = (friction, false);
    }
}

impl Cell {
    /// The fingers have closed from `from` metres on each side of the middle.
    pub(super) fn close(&mut self, from: f64, object: String, expected: Option<&Pose>) -> Ending {
        let tool = self.robot.tool_pose(&self.configuration());
        let there: Vec<(String, Pose, [f64; 3])> =
            (0..self.ids.len()).map(|i| (self.ids[i].clone(), self.pose_of(i, &tool), self.size_of(i))).collect();
        let grip = match self.pads.close(&tool, from, &there) {
            Ok(grip) => grip,
            Err(reason) => {
                // Something stopped the fingers, or nothing did: either way they hold nothing.
                self.resting.finger = 0.0;
                return Ending::Aborted(format!("{object} is not grasped: {reason}"));
            }
        };
        if self.faults.occurs(Fault::GraspSlips).is_some() {
            self.resting.finger = 0.0;
            let id = &self.ids[grip.index];
            return Ending::Aborted(format!("{object} is not grasped: {id} slipped out of the fingers"));
        }
        self.resting.finger = grip.width / 2.0;
        let friction = self.environment.model(grip.index).kind.friction();
        let in_tool = grip.in_tool;
        self.held = Some(Held::new(grip.index, in_tool, friction));
        self.environment.carry(grip.index, &tool.compose(&in_tool));
        let size = self.size_of(grip.index);
        let in_gripper = expected.map(|e| turned_like(&in_tool, &size, e));
        Ending::Done(Product::Grasped { object, width: grip.width, in_gripper })
    }

    /// The fingers open: what they held is left to itself.
    pub(super) fn let_go(&mut self) {
        let Some(held) = self.held.take() else { return };
        let tool = self.robot.tool_pose(&self.configuration());
        self.environment.let_go(held.object, &tool.compose(&held.in_tool), [0.0; 3]);
    }

    /// One step of holding, with the tool where it is now; the object that was lost.
    pub(super) fn keep_hold(&mut self, tool: &Pose) -> Option<usize> {
        let mut held = self.held?;
        let dt = STEP.as_secs_f64();
        let at = tool.position;
        let acceleration = match held.trail {
            [Some(a), Some(b)] => std::array::from_fn(|i| (at[i] - 2.0 * b[i] + a[i]) / (dt * dt)),
            _ => [0.0; 3],
        };
        let velocity = held.trail[1].map_or([0.0; 3], |b| std::array::from_fn(|i| (at[i] - b[i]) / dt));
        let stands = held.trail == [Some(at); 2];
        held.trail = [held.trail[1], Some(at)];
        let felt = [-acceleration[0], -acceleration[1], -acceleration[2] - GRAVITY];
        let turned = Pose { position: [0.0; 3], ..tool.inverse() };
        let (model, size) = (self.environment.model(held.object), self.size_of(held.object));
        if let Some(patch) = self.pads.patch(&held.in_tool, &size) {
            let mass_kg = model.mass_kg();
            let [a, b] = across(&held.in_tool, &size);
            let hold = Hold { in_tool: held.in_tool, patch, mass_kg, inertia: mass_kg * (a * a + b * b) / 12.0 };
            let grip = Grip { force_n: self.config.gripper.force_n, friction: held.friction };
            (held.slip, held.in_tool) = grip.step(&hold, &Load(turned.rotate(felt)), held.slip, dt);
        }
        held.steady = stands && held.slip.is_none();
        let pose = tool.compose(&held.in_tool);
        if self.pads.patch(&held.in_tool, &size).is_some() {
            self.environment.carry(held.object, &pose);
            self.held = Some(held);
            return None;
        }
        let slid = tool.rotate([held.slip.along[0], 0.0, held.slip.along[1]]);
        self.environment.let_go(held.object, &pose, std::array::from_fn(|i| velocity[i] + slid[i]));
        self.held = None;
        // Nothing is left to stop the fingers.
        self.resting.finger = 0.0;
        Some(held.object)
    }

    /// An object's extents.
    pub(super) fn size_of(&self, object: usize) -> [f64; 3] {
        self.environment.model(object).size
    }

    /// Where an object is, with the tool at `tool`.
    pub(super) fn pose_of(&self, object: usize, tool: &Pose) -> Pose {
        match self.held {
            Some(held) if held.object == object => tool.compose(&held.in_tool),
            _ => self.environment.state(object).pose,
        }
    }

    /// On what an object rests; empty where on nothing.
    pub(super) fn support_of(&self, object: usize) -> String {
        match self.environment.rests_on(object) {
            Some(Support::Named(name)) => name.to_owned(),
            Some(Support::Object(other)) => self.ids[other].clone(),
            None => String::new(),
        }
    }

    /// Whether an object stands on the load deck. A box has no top.
    pub(super) fn is_delivered(&self, pose: &Pose, on: &str) -> bool {
        on == ON_BASE && pose.rotate([0.0, 0.0, 1.0])[2].abs() >= MAX_LEAN_RAD.cos()
    }
}

/// The two edges that lie across the closing direction.
fn across(in_tool: &Pose, size: &[f64; 3]) -> [f64; 2] {
    let along = |k: usize| in_tool.rotate(std::array::from_fn(|i| f64::from(u8::from(i == k))))[1].abs();
    match (0..3).max_by(|a, b| along(*a).total_cmp(&along(*b))) {
        Some(0) => [size[1], size[2]],
        Some(2) => [size[0], size[1]],
        _ => [size[0], size[2]],
    }
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
