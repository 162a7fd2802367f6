//! What happens to objects when the fingers close and open, and while they hold something.

use super::cell::Cell;
use super::environment::{GRAVITY, Grip, Hold, Load, STEP, Slip, Support};
use super::faults::Kind as Fault;
use super::grasping::{Grip as GripOf, NotGrasped, felt};
use super::objects::ON_BASE;
use super::parting::Around;
use super::placement::{self, TABLE};
use super::protocol::{Command, Ending, Product};
use ratn_model::pose::Pose;
use ratn_motion::workplace::Surface;

/// The object that the fingers hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Held {
    pub(super) object: usize,
    pub(super) in_tool: Pose,
    slip: Slip,
    friction: f64,
    /// Positions of the tool at the last two steps, the newest last.
    trail: [Option<[f64; 3]>; 2],
    /// The tool stood still and the object did not slip.
    steady: bool,
}

/// A part of an object, in the object's frame, and its edges in metres.
type Cuboid = (Pose, [f64; 3]);

/// Maximum lean of an object that stands upright.
const MAX_LEAN_RAD: f64 = 0.2;
/// Maximum distance of a delivered object from the middle of its place, in metres.
const MAX_OFF_PLACE_M: f64 = 0.03;

impl Held {
    /// A hold of an object that does not slip.
    pub(super) fn new(object: usize, in_tool: Pose, friction: f64) -> Held {
        Held { object, in_tool, slip: Slip::default(), friction, trail: [None; 2], steady: false }
    }

    /// The state for restoring the hold.
    pub(super) fn save(&self) -> (usize, Pose, f64) {
        (self.object, self.in_tool, self.friction)
    }

    /// Whether the object does not move relative to the tool as long as the tool stands.
    pub(super) fn is_steady(&self) -> bool {
        self.steady
    }

    /// Sets the friction of the fingers from now on.
    pub(super) fn set_friction(&mut self, friction: f64) {
        (self.friction, self.steady) = (friction, false);
    }
}

impl Cell {
    /// Distance of each finger of an arm from the middle when an object between them stops them; 0 without one.
    ///
    /// # Errors
    /// If that object is held by another arm.
    pub(super) fn closes_to(&self, arm: usize, from: f64) -> Result<f64, String> {
        let tools = self.arms.tools(&self.configuration());
        let (parts, closed) = self.between(arm, from, &tools);
        self.held_by_another(arm, from, &parts, &tools).map_or(Ok(closed.map_or(0.0, |grip| grip.width / 2.0)), Err)
    }

    /// Why the fingers of an arm do not close if an object between them is held by another arm, whether they would hold it or not: two grippers on
    /// one object are not simulated. `parts` are those of [`Cell::between`].
    fn held_by_another(&self, arm: usize, from: f64, parts: &[Cuboid], tools: &[Pose]) -> Option<String> {
        let (pads, seen) = (self.arms.pads(arm)?, tools[arm].inverse());
        let held = |(object, (part, size)): (usize, &Cuboid)| {
            let (holder, _) = self.arms.holder_of(object).filter(|(holder, _)| *holder != arm)?;
            let in_tool = seen.compose(&self.pose_of(object, tools)).compose(part);
            pads.meets(from, &in_tool, size).then_some((object, holder))
        };
        let (object, holder) = parts.iter().enumerate().find_map(held)?;
        Some(format!(
            "nothing is grasped: {} is between the fingers, and the arm `{}` holds it; this cell does not simulate that two arms hold one \
             object, so have it put down first",
            self.ids[object],
            self.arms.name(holder)
        ))
    }

    /// For every object the part that the fingers of an arm could close around, and what they hold when they close from `from`.
    fn between(&self, arm: usize, from: f64, tools: &[Pose]) -> (Vec<Cuboid>, Result<GripOf, NotGrasped>) {
        let tool = &tools[arm];
        let parts: Vec<Cuboid> =
            (0..self.ids.len()).map(|i| self.grip_part(i, &tool.inverse().compose(&self.pose_of(i, tools)))).collect();
        let there: Vec<(String, Pose, [f64; 3])> = (parts.iter().enumerate())
            .map(|(i, (part, size))| (self.ids[i].clone(), self.pose_of(i, tools).compose(part), *size))
            .collect();
        let closed = self.arms.pads(arm).map_or(Err(NotGrasped::Nothing), |pads| pads.close(tool, from, &there));
        (parts, closed)
    }

    /// The fingers of an arm have closed from `from` metres on each side of the middle. The goal's result has what fingers can measure: the width of
    /// the object that stopped them, and whether it still does. Only the cell knows why they hold nothing: that is a [`Command::Noted`].
    pub(super) fn close(
        &mut self,
        arm: usize,
        from: f64,
        object: String,
        expected: Option<&Pose>,
        out: &mut Vec<Command>,
    ) -> Ending {
        let tools = self.arms.tools(&self.configuration());
        let tool = tools[arm];
        let (parts, closed) = self.between(arm, from, &tools);
        if let Some(reason) = self.held_by_another(arm, from, &parts, &tools) {
            self.contacts.closed(arm, None, &self.environment);
            self.resting.set_finger(arm, from);
            return Ending::Aborted(reason);
        }
        let around = match &closed {
            Ok(grip) => Some(grip.index),
            Err(reason) => reason.object().and_then(|id| self.ids.iter().position(|known| known == id)),
        };
        self.contacts.closed(arm, around, &self.environment);
        let in_vain = if around.is_some() { Around::Slipped } else { Around::Nothing };
        let held = closed.map_err(|reason| (None, reason.to_string())).and_then(|grip| {
            let slips = |reason: String| Err((Some(grip.width), reason));
            let id = &self.ids[grip.index];
            if let Some(lean) = self.environment.model(grip.index).slips_off() {
                let degrees = lean.to_degrees();
                return slips(format!("the rim of {id} leans outwards by {degrees:.0}°, the fingers slide off it"));
            }
            if self.faults.occurs(Fault::GraspSlips).is_some() {
                return slips(format!("{id} slipped by a fault"));
            }
            Ok(grip)
        });
        let grip = match held {
            Ok(grip) => grip,
            Err((stopped, reason)) => {
                self.resting.set_finger(arm, 0.0);
                self.arms.close(arm, 0.0, in_vain);
                let felt = stopped.map_or("nothing stopped the fingers".to_owned(), |width| {
                    format!("something {:.0} mm wide slipped out of the fingers", width * 1e3)
                });
                out.push(Command::Noted { what: format!("the fingers hold nothing: {reason}") });
                return Ending::Aborted(format!("{object} is not grasped: {felt}, they are closed fully"));
            }
        };
        self.resting.set_finger(arm, grip.width / 2.0);
        self.arms.close(arm, grip.width / 2.0, Around::Something);
        let friction = self.environment.model(grip.index).kind.friction();
        let in_tool = grip.in_tool.compose(&parts[grip.index].0.inverse());
        self.arms.hold(arm, Some(Held::new(grip.index, in_tool, friction)));
        self.environment.carry(grip.index, &tool.compose(&in_tool));
        let in_gripper = expected.map(|believed| felt(believed, grip.width));
        Ending::Done(Product::Grasped { object, width: grip.width, in_gripper })
    }

    /// The fingers of an arm open and release the object that they held.
    pub(super) fn let_go(&mut self, arm: usize) {
        let Some(held) = self.arms.hold(arm, None) else { return };
        self.contacts.let_go(arm, held.object, true);
        let tool = self.arms.tools(&self.configuration())[arm];
        self.environment.let_go(held.object, &tool.compose(&held.in_tool), [0.0; 3]);
    }

    /// One step of an arm's hold, with its tool at its current pose; returns the object if it was lost.
    pub(super) fn keep_hold(&mut self, arm: usize, tool: &Pose) -> Option<usize> {
        let mut held = self.arms.held(arm)?;
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
        let patch = |in_tool: &Pose| {
            let (part, size) = self.grip_part(held.object, in_tool);
            self.arms.pads(arm)?.patch(&in_tool.compose(&part), &size)
        };
        if let Some(patch) = patch(&held.in_tool) {
            let mass_kg = model.mass_kg();
            let [a, b] = across(&held.in_tool, &size);
            let hold = Hold { in_tool: held.in_tool, patch, mass_kg, inertia: mass_kg * (a * a + b * b) / 12.0 };
            let grip = Grip { force_n: self.config.gripper.force_n, friction: held.friction };
            (held.slip, held.in_tool) = grip.step(&hold, &Load(turned.rotate(felt)), held.slip, dt);
        }
        held.steady = stands && held.slip.is_none();
        let pose = tool.compose(&held.in_tool);
        let lean = pose.rotate([0.0, 0.0, 1.0])[2].clamp(-1.0, 1.0).acos();
        if patch(&held.in_tool).is_some() {
            self.tilts[held.object] = self.tilts[held.object].max(lean);
            self.environment.carry(held.object, &pose);
            self.arms.hold(arm, Some(held));
            return None;
        }
        let slid = tool.rotate([held.slip.along[0], 0.0, held.slip.along[1]]);
        self.environment.let_go(held.object, &pose, std::array::from_fn(|i| velocity[i] + slid[i]));
        self.arms.hold(arm, None);
        self.contacts.let_go(arm, held.object, false);
        // Nothing is left to stop the fingers.
        self.resting.set_finger(arm, 0.0);
        self.arms.close(arm, 0.0, Around::Slipped);
        Some(held.object)
    }

    /// Whether an object is between the fingers of an arm, or overlaps with one of them, with the tools at `tools`.
    pub(super) fn fingers_are_at(&self, arm: usize, object: usize, tools: &[Pose], finger: f64) -> bool {
        let in_tool = tools[arm].inverse().compose(&self.pose_of(object, tools));
        self.arms.pads(arm).is_some_and(|pads| pads.are_at(finger, &in_tool, &self.size_of(object)))
    }

    /// The part of an object that the fingers can close around, for its pose in the tool frame.
    fn grip_part(&self, object: usize, in_tool: &Pose) -> (Pose, [f64; 3]) {
        self.environment.model(object).grip_part(&in_tool.inverse())
    }

    /// An object's extents.
    pub(super) fn size_of(&self, object: usize) -> [f64; 3] {
        self.environment.model(object).size
    }

    /// The pose of an object, with the tools of all arms at `tools`.
    pub(super) fn pose_of(&self, object: usize, tools: &[Pose]) -> Pose {
        match self.arms.holder_of(object) {
            Some((arm, held)) => tools[arm].compose(&held.in_tool),
            None => self.environment.state(object).pose,
        }
    }

    /// The name of the support of an object; empty without a support.
    pub(super) fn support_of(&self, object: usize) -> String {
        match self.environment.rests_on(object) {
            Some(Support::Named(name)) => name.to_owned(),
            Some(Support::Object(other)) => self.ids[other].clone(),
            None => String::new(),
        }
    }

    /// Whether an object stands at one of the places for delivered boxes, on any of its faces: a box has no top.
    pub(super) fn is_delivered(&self, pose: &Pose, on: &str) -> bool {
        let upright = |axis: usize| pose.rotate(unit(axis))[2].abs() >= MAX_LEAN_RAD.cos();
        placement::workplace(&self.robot).shares().any(|(_, places)| {
            let (support, seen) = match places.on {
                Surface::Base => (ON_BASE, self.base_pose().inverse().compose(pose).position),
                Surface::Table => (TABLE, pose.position),
            };
            let off = |place: &[f64; 3]| (place[0] - seen[0]).hypot(place[1] - seen[1]);
            on == support && (0..3).any(upright) && places.at.iter().any(|place| off(place) <= MAX_OFF_PLACE_M)
        })
    }
}

fn unit(axis: usize) -> [f64; 3] {
    std::array::from_fn(|i| f64::from(u8::from(i == axis)))
}

/// The two edges perpendicular to the closing direction.
fn across(in_tool: &Pose, size: &[f64; 3]) -> [f64; 2] {
    let along = |k: usize| in_tool.rotate(unit(k))[1].abs();
    match (0..3).max_by(|a, b| along(*a).total_cmp(&along(*b))) {
        Some(0) => [size[1], size[2]],
        Some(2) => [size[0], size[1]],
        _ => [size[0], size[2]],
    }
}
