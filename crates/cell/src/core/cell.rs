//! The cell's state and its one way in: [`Cell::handle`].
//!
//! ```text
//! module:  idle ──Start──▶ active ──its time is over──▶ idle      (Ended: done, or aborted with the reason)
//!                            ├──Stop──▶ idle, holds where it is   (Ended: preempted)
//!                            └──LeaseEnded──▶ idle, holds         (Ended: aborted)
//! ```
//! Time is the robot's and comes in with every event; what should have happened since the last one happens first, in its
//! order. [`Cell::next_wake`] says when the next thing will happen by itself.

use super::activity::{Activity, Kind, seconds};
pub use super::activity::{Module, Ticket};
use super::battery::Battery;
use super::boxes::{ON_BASE, Place, SimulatedBox, TrueBox};
use super::grasping::Pads;
use super::picture::{Exposure, Scenery};
use super::placement::{self, PlacementError, TABLE};
use super::settling::{Surface, settle};
use super::trajectory;
use crate::config::{CellConfig, MAX_BOXES};
use ratn_model::id::LeaseId;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_model::value::Trajectory;
use ratn_motion::aimm;
use ratn_motion::robot::{Configuration, Joints, Robot};
use ratn_perception::camera::Camera;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::PI;

/// What happens to the cell.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A goal for a module.
    Start {
        /// How the goal will be called.
        ticket: Ticket,
        /// Under which lease.
        lease: Option<LeaseId>,
        /// What to do.
        request: Request,
    },
    /// A goal's giver wants it to stop, or is gone.
    Stop {
        /// Which goal.
        ticket: Ticket,
        /// Why.
        reason: String,
    },
    /// A lease is over.
    LeaseEnded {
        /// Which.
        lease: LeaseId,
        /// Why.
        reason: String,
    },
    /// Nobody knows any more which leases live.
    LeasesLost {
        /// Why.
        reason: String,
    },
    /// Only these leases live.
    LeasesAre {
        /// All of them.
        living: BTreeSet<LeaseId>,
    },
    /// A new table; the robot goes back to its first posture.
    Reset {
        /// From which seed.
        seed: u64,
        /// With how many boxes.
        boxes: usize,
    },
    /// Only time has passed.
    Tick,
}

/// What a module can do.
#[derive(Debug, Clone, PartialEq)]
pub enum Request {
    /// The arm along a trajectory.
    Follow {
        /// From where the arm is.
        trajectory: Trajectory,
    },
    /// The arm straight to a posture.
    MoveTo {
        /// Where to.
        joints: Joints,
        /// How much of its greatest speed, above 0 and at most 1.
        speed: f64,
    },
    /// Closes the fingers around something.
    Grasp {
        /// How the giver calls it.
        object: String,
        /// Where it should be in the tool frame then.
        expected: Option<Pose>,
    },
    /// Opens the fingers.
    Release,
    /// Turns the camera.
    LookAt {
        /// Towards this point of the world.
        target: [f64; 3],
    },
    /// Takes a picture.
    Capture {
        /// The average of so many frames.
        frames: u32,
    },
}

/// What the cell has to say.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// A goal has ended.
    Ended {
        /// Which.
        ticket: Ticket,
        /// How.
        ending: Ending,
    },
}

/// How a goal ends.
#[derive(Debug, Clone, PartialEq)]
pub enum Ending {
    /// As it should.
    Done(Product),
    /// It was not done, or not to its end. The module holds.
    Aborted(String),
    /// It was stopped. The module holds.
    Preempted(String),
}

/// What comes of a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Product {
    /// The arm is there.
    Moved {
        /// Its posture.
        end: Joints,
    },
    /// Something is in the gripper.
    Grasped {
        /// How the giver calls it.
        object: String,
        /// The opening of the fingers around it, in metres.
        width: f64,
        /// Where it is in the tool frame; turned like the expected pose, as far as its symmetry allows. `None` when
        /// nothing was expected: which way round it is would be anybody's guess.
        in_gripper: Option<Pose>,
    },
    /// The fingers are open.
    Released,
    /// The camera looks there.
    Looking {
        /// Radians.
        pan: f64,
        /// Radians.
        tilt: f64,
    },
    /// A picture to be developed.
    Captured {
        /// From where.
        camera: Camera,
        /// What was there, frame by frame.
        exposures: Vec<Exposure>,
    },
}

/// The simulated robot and its table.
#[derive(Debug, Clone)]
pub struct Cell {
    robot: Robot,
    config: CellConfig,
    pads: Pads,
    now: Timestamp,
    resting: Configuration,
    activities: BTreeMap<Module, Activity>,
    boxes: Vec<SimulatedBox>,
    battery: Battery,
    seed: u64,
    frames_taken: u64,
}

/// The most scenes that one picture can be made of; further frames count for the last one.
const MAX_EXPOSURES: usize = 12;
/// The most frames of one picture.
pub const MAX_FRAMES: u32 = 1000;
/// How far the camera may look past its target, in radians.
const MAX_LOOK_ERROR_RAD: f64 = 0.02;

impl Cell {
    /// A cell at time 0.
    ///
    /// # Errors
    /// [`PlacementError`] when no table can be laid.
    pub fn new(config: CellConfig) -> Result<Cell, PlacementError> {
        let robot = Robot::aimm();
        #[expect(
            clippy::expect_used,
            reason = "the built-in robot has fingers made of boxes, and every test uses them"
        )]
        let pads = Pads::of(&robot).expect("the gripper of the built-in robot has two fingers");
        let boxes = placement::boxes(&robot, config.boxes, config.seed)?;
        let resting = first_posture(&config);
        let (battery, seed) = (Battery::new(config.battery), config.seed);
        let (now, activities) = (Timestamp::default(), BTreeMap::new());
        Ok(Cell { robot, config, pads, now, resting, activities, boxes, battery, seed, frames_taken: 0 })
    }

    /// Time goes on to `now`, and then the event happens.
    pub fn handle(&mut self, now: Timestamp, event: Event) -> Vec<Command> {
        let mut out = Vec::new();
        self.advance(now, &mut out);
        match event {
            Event::Start { ticket, lease, request } => {
                if let Err(reason) = self.start(ticket, lease, request) {
                    out.push(Command::Ended { ticket, ending: Ending::Aborted(reason) });
                }
            }
            Event::Stop { ticket, reason } => {
                self.hold(|a| a.ticket == ticket, |_| Ending::Preempted(reason.clone()), &mut out);
            }
            Event::LeaseEnded { lease, reason } => {
                let ending = |_: &Activity| Ending::Aborted(format!("its lease {lease} ended: {reason}; it holds"));
                self.hold(|a| a.lease == Some(lease), ending, &mut out);
            }
            Event::LeasesLost { reason } => {
                let ending = |_: &Activity| Ending::Aborted(format!("its lease may have ended: {reason}; it holds"));
                self.hold(|a| a.lease.is_some(), ending, &mut out);
            }
            Event::LeasesAre { living } => {
                let ending = |_: &Activity| Ending::Aborted("its lease has ended; it holds".to_owned());
                self.hold(|a| a.lease.is_some_and(|lease| !living.contains(&lease)), ending, &mut out);
            }
            Event::Reset { seed, boxes } => self.reset(seed, boxes, &mut out),
            Event::Tick => {}
        }
        out
    }

    /// When something will happen by itself.
    pub fn next_wake(&self) -> Option<Timestamp> {
        self.activities.values().map(|a| a.ends).min()
    }

    /// Where the joints are.
    pub fn configuration(&self) -> Configuration {
        let mut configuration = self.resting;
        for activity in self.activities.values() {
            configuration.arm = activity.arm(self.now).unwrap_or(configuration.arm);
            configuration.finger = activity.finger(self.now).unwrap_or(configuration.finger);
            [configuration.pan, configuration.tilt] =
                activity.head(self.now).unwrap_or([configuration.pan, configuration.tilt]);
        }
        configuration
    }

    /// What is true of every box.
    pub fn ground_truth(&self) -> Vec<TrueBox> {
        let tool = self.robot.tool_pose(&self.configuration());
        self.boxes.iter().map(|b| b.truth(&tool)).collect()
    }

    /// How full the battery is, 0 to 1.
    pub fn battery(&self) -> f64 {
        self.battery.level()
    }

    /// Whether a module is doing something.
    pub fn is_active(&self, module: Module) -> bool {
        self.activities.contains_key(&module)
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// The configuration that it was made with.
    pub fn config(&self) -> &CellConfig {
        &self.config
    }

    /// The seed of the present table.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// What collides: the table and the boxes, held ones in the gripper.
    pub fn scene(&self) -> Scene {
        let boxes = self.boxes.iter().map(|b| SceneObject {
            name: b.id.clone(),
            shape: Shape::Box { size: b.size },
            placement: match &b.place {
                Place::At { pose, .. } => Placement::World(*pose),
                Place::Held { in_tool } => Placement::Gripper(*in_tool),
            },
        });
        Scene { base: Pose::IDENTITY, objects: boxes.chain([placement::table()]).collect() }
    }

    fn advance(&mut self, now: Timestamp, out: &mut Vec<Command>) {
        loop {
            let frame = self.activities.get(&Module::Camera).and_then(next_frame);
            let due = self.next_wake().into_iter().chain(frame).min().filter(|t| *t <= now);
            self.pass_until(due.unwrap_or(now));
            let Some(due) = due else { break };
            if frame.is_some_and(|f| f <= due) {
                self.expose();
            }
            let over: Vec<Module> = self.activities.iter().filter(|(_, a)| a.ends <= due).map(|(m, _)| *m).collect();
            for module in over {
                // The last frame is taken when the picture's time is over.
                let unfinished = |a: &Activity| next_frame(a).is_some_and(|f| f <= due);
                if !self.activities.get(&module).is_some_and(unfinished) {
                    self.finish(module, out);
                }
            }
        }
    }

    fn pass_until(&mut self, time: Timestamp) {
        self.battery.drain(time.since(self.now), self.is_active(Module::Arm));
        self.now = self.now.max(time);
    }

    fn start(&mut self, ticket: Ticket, lease: Option<LeaseId>, request: Request) -> Result<(), String> {
        let module = request.module();
        if let Some(other) = self.activities.get(&module) {
            return Err(format!("the {} is busy with goal {}", module.kind(), other.ticket.0));
        }
        if self.battery.level() <= 0.0 {
            return Err("the battery is empty".to_owned());
        }
        let here = self.configuration();
        let (kind, lasts_s) = match request {
            Request::Follow { trajectory } => {
                self.no_motion_of(Module::Gripper)?;
                let trajectory = trajectory::check(&self.robot, &self.scene(), &here, &trajectory)?;
                let lasts_s = trajectory.duration_s();
                (Kind::Follow { trajectory }, lasts_s)
            }
            Request::MoveTo { joints, speed } => {
                self.no_motion_of(Module::Gripper)?;
                let scene = self.scene();
                let line = trajectory::straight(&self.robot, &scene, &here.arm, &joints, speed)?;
                let trajectory = trajectory::check(&self.robot, &scene, &here, &line)?;
                let lasts_s = trajectory.duration_s();
                (Kind::Follow { trajectory }, lasts_s)
            }
            Request::Grasp { object, expected } => {
                self.no_motion_of(Module::Arm)?;
                if let Some(held) = self.held() {
                    return Err(format!("the gripper holds {} already", self.boxes[held].id));
                }
                (Kind::Close { from: here.finger, object, expected }, self.config.gripper.close_s)
            }
            Request::Release => {
                self.no_motion_of(Module::Arm)?;
                self.let_go();
                let to = self.config.gripper.opening_m / 2.0;
                (Kind::Open { from: here.finger, to }, self.config.gripper.open_s)
            }
            Request::LookAt { target } => {
                self.no_motion_of(Module::Camera)?;
                let to = self.aim(target)?;
                let from = [here.pan, here.tilt];
                let lasts_s = self.turning_s(from, to) + self.config.pan_tilt.settle_s;
                (Kind::Look { from, to }, lasts_s)
            }
            Request::Capture { frames } => {
                self.no_motion_of(Module::PanTilt)?;
                if !(1..=MAX_FRAMES).contains(&frames) {
                    return Err(format!("a picture has 1 to {MAX_FRAMES} frames, not {frames}"));
                }
                let camera = Camera { intrinsics: self.config.camera.intrinsics, pose: self.robot.camera_pose(&here) };
                let period = 1.0 / self.config.camera.frames_per_s;
                let next = self.now + seconds(period);
                let kind = Kind::Capture { camera, frames, taken: 0, next, exposures: Vec::new() };
                (kind, period * f64::from(frames))
            }
        };
        let (started, ends) = (self.now, self.now + seconds(lasts_s));
        self.activities.insert(module, Activity { ticket, lease, started, ends, kind });
        Ok(())
    }

    fn no_motion_of(&self, module: Module) -> Result<(), String> {
        match self.activities.get(&module) {
            None => Ok(()),
            Some(other) => Err(format!("the {} is under way with goal {}", module.kind(), other.ticket.0)),
        }
    }

    fn finish(&mut self, module: Module, out: &mut Vec<Command>) {
        let Some(activity) = self.activities.remove(&module) else { return };
        let ending = match activity.kind {
            Kind::Follow { ref trajectory } => {
                let end = trajectory.end();
                self.resting.arm = end;
                Ending::Done(Product::Moved { end })
            }
            Kind::Close { from, object, expected } => self.close(from, object, expected.as_ref()),
            Kind::Open { to, .. } => {
                self.resting.finger = to;
                Ending::Done(Product::Released)
            }
            Kind::Look { to: [pan, tilt], .. } => {
                (self.resting.pan, self.resting.tilt) = (pan, tilt);
                Ending::Done(Product::Looking { pan, tilt })
            }
            Kind::Capture { camera, exposures, .. } => Ending::Done(Product::Captured { camera, exposures }),
        };
        out.push(Command::Ended { ticket: activity.ticket, ending });
    }

    /// Ends activities where they are: every joint stays where it has come to.
    fn hold(
        &mut self,
        which: impl Fn(&Activity) -> bool,
        ending: impl Fn(&Activity) -> Ending,
        out: &mut Vec<Command>,
    ) {
        self.resting = self.configuration();
        let stopped: Vec<Module> = self.activities.iter().filter(|(_, a)| which(a)).map(|(m, _)| *m).collect();
        for module in stopped {
            if let Some(activity) = self.activities.remove(&module) {
                out.push(Command::Ended { ticket: activity.ticket, ending: ending(&activity) });
            }
        }
    }

    fn reset(&mut self, seed: u64, count: usize, out: &mut Vec<Command>) {
        self.hold(|_| true, |_| Ending::Aborted("the cell was reset".to_owned()), out);
        self.resting = first_posture(&self.config);
        self.seed = seed;
        // The request was checked before it became an event; a table that cannot be laid is an empty one.
        self.boxes = placement::boxes(&self.robot, count.clamp(1, MAX_BOXES), seed).unwrap_or_default();
    }

    fn held(&self) -> Option<usize> {
        self.boxes.iter().position(|b| matches!(b.place, Place::Held { .. }))
    }

    fn close(&mut self, from: f64, object: String, expected: Option<&Pose>) -> Ending {
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

    fn let_go(&mut self) {
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

    fn aim(&self, target: [f64; 3]) -> Result<[f64; 2], String> {
        let (pan, tilt) = self.robot.look_at(&Pose::IDENTITY, target);
        let camera = self.robot.camera_pose(&Configuration { pan, tilt, ..self.configuration() });
        let seen = camera.inverse().transform(target);
        let off = seen[0].hypot(seen[1]).atan2(seen[2]);
        if off > MAX_LOOK_ERROR_RAD {
            let degrees = off.to_degrees();
            let [x, y, z] = target;
            return Err(format!(
                "the camera cannot be turned to ({x:.2}, {y:.2}, {z:.2}): its limits end {degrees:.0}° before"
            ));
        }
        Ok([pan, tilt])
    }

    /// How long the head takes, with ramps of the greatest acceleration on the joint that takes longest.
    fn turning_s(&self, from: [f64; 2], to: [f64; 2]) -> f64 {
        let time = |joint: usize, way: f64| {
            let (speed, acceleration) =
                (self.robot.joints[joint].velocity * self.config.pan_tilt.speed, self.robot.joints[joint].acceleration);
            let ramp = speed * speed / acceleration;
            if way >= ramp { way / speed + speed / acceleration } else { 2.0 * (way / acceleration).sqrt() }
        };
        time(10, (to[0] - from[0]).abs()).max(time(11, (to[1] - from[1]).abs()))
    }

    /// One frame of the picture under way.
    fn expose(&mut self) {
        let configuration = self.configuration();
        let tool = self.robot.tool_pose(&configuration);
        let boxes = self.boxes.iter().map(|b| (b.size, b.pose(&tool))).collect();
        let scenery = Scenery { configuration, boxes };
        let period = seconds(1.0 / self.config.camera.frames_per_s);
        let first_frame = self.frames_taken;
        self.frames_taken += 1;
        if let Some(Activity { kind: Kind::Capture { taken, next, exposures, .. }, .. }) =
            self.activities.get_mut(&Module::Camera)
        {
            *taken += 1;
            *next = *next + period;
            let full = exposures.len() == MAX_EXPOSURES;
            match exposures.last_mut() {
                Some(last) if full || last.scenery == scenery => last.frames += 1,
                _ => exposures.push(Exposure { scenery, first_frame, frames: 1 }),
            }
        }
    }
}

impl Request {
    /// The module that does it.
    pub fn module(&self) -> Module {
        match self {
            Request::Follow { .. } | Request::MoveTo { .. } => Module::Arm,
            Request::Grasp { .. } | Request::Release => Module::Gripper,
            Request::LookAt { .. } => Module::PanTilt,
            Request::Capture { .. } => Module::Camera,
        }
    }
}

/// When the next frame of a picture is due. Rounding of periods never moves the last one past the picture's end.
fn next_frame(activity: &Activity) -> Option<Timestamp> {
    match &activity.kind {
        Kind::Capture { frames, taken, next, .. } if taken < frames => Some((*next).min(activity.ends)),
        _ => None,
    }
}

fn first_posture(config: &CellConfig) -> Configuration {
    Configuration { arm: aimm::HOME, finger: config.gripper.opening_m / 2.0, ..Configuration::ZERO }
}

/// The load deck: the top of the base.
fn deck(robot: &Robot) -> Option<Surface> {
    use ratn_motion::robot::Geometry;
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
