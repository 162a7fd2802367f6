//! The cell's state and its only entry point: [`Cell::handle`].
//!
//! ```text
//! module:  idle ──Start──▶ active ──its time is over──▶ idle      (Ended: done, or aborted with the reason)
//!                            ├──Stop──▶ brakes ──it stands──▶ idle            (Ended: preempted)
//!                            └──emergency stop──▶ brakes hard ──it stands──▶ idle   (Ended: stopped)
//! ```
//! Every event comes with the robot's time. Everything due between the previous event and this one happens first, in order of time. Motions have
//! their own time, which a hold slows down to a stop and later resumes ([`super::braking`]). [`Cell::next_wake`] returns when something is due
//! without an event.

use super::activity::{Activity, Kind, seconds};
use super::arms::{Arms, FIRST};
use super::battery::Battery;
use super::braking::{Braking, EMERGENCY, MotionClock, Way};
use super::contacts::{Contact, Contacts};
use super::deviations::LOST;
use super::environment::Environment;
use super::errors::Errors;
use super::faults::Faults;
use super::objects::{Placed, TrueObject};
use super::parting::{Around, Closed};
use super::picture::{Exposure, Scenery};
use super::placement::{self, PlacementError, TABLE};
use super::protocol::{Command, Ending, Event, Module, Product, Ticket};
use super::tableware;
use crate::config::{CellConfig, Goods, Setting};
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::drive::wrapped;
use ratn_motion::robot::{Configuration, Robot};
use ratn_worker::safety::SafetyState;
use ratn_world::scene::{Placement, Scene, SceneObject};
use std::collections::BTreeMap;

/// The simulated robot and its table.
pub struct Cell {
    /// The robot, seen from its first arm.
    pub(super) robot: Robot,
    pub(super) config: CellConfig,
    /// The robot's arms, and what each holds.
    pub(super) arms: Arms,
    pub(super) now: Timestamp,
    /// The time of motions: behind `now` by the duration of all holds.
    pub(super) motion_time: Timestamp,
    pub(super) clock: MotionClock,
    pub(super) safety: SafetyState,
    /// Positions of the joints that do not move, as measured by their encoders and the localisation.
    pub(super) resting: Configuration,
    pub(super) errors: Errors,
    /// Number of stops of the base.
    pub(super) stops: u64,
    pub(super) activities: BTreeMap<Module, Activity>,
    /// Motions that were told to stop and are braking.
    pub(super) braking: BTreeMap<Module, Braking>,
    pub(super) environment: Environment,
    /// The objects' names.
    pub(super) ids: Vec<String>,
    /// The maximum lean of each object while it was held, in radians.
    pub(super) tilts: Vec<f64>,
    pub(super) contacts: Contacts,
    pub(super) faults: Faults,
    /// The time until which the camera is blind.
    pub(super) blind_until: Timestamp,
    /// The time until which the robot does not know where it stands.
    pub(super) lost_until: Timestamp,
    pub(super) battery: Battery,
    pub(super) seed: u64,
    pub(super) frames_taken: u64,
}

/// The maximum number of scenes that one picture is made of; further frames count for the last one.
const MAX_EXPOSURES: usize = 12;

impl Cell {
    /// A cell at time 0.
    ///
    /// # Errors
    /// [`PlacementError`] if no table can be laid, or the robot cannot stand in a cell.
    pub fn new(config: CellConfig) -> Result<Cell, PlacementError> {
        let robot = Robot::named_or_file(&config.robot)?;
        let pads = placement::fit(&robot, &config)?;
        let objects = placement::objects(&robot, config.scene, config.goods(), config.seed)?;
        let arms = Arms::of(&robot, pads, &config);
        let resting = arms.first_posture();
        let errors = Errors::new(config.errors, &joint_counts(&robot), config.seed, 0);
        let (environment, ids) = environment(&robot, &errors.truth(&resting), config.scene, &objects);
        let now = Timestamp::default();
        Ok(Cell {
            arms,
            now,
            motion_time: now,
            clock: MotionClock::new(now),
            safety: SafetyState::Ready,
            resting,
            errors,
            stops: 0,
            activities: BTreeMap::new(),
            braking: BTreeMap::new(),
            environment,
            tilts: vec![0.0; ids.len()],
            ids,
            contacts: Contacts::of(&robot),
            faults: Faults::new(&config.faults, config.seed),
            blind_until: now,
            lost_until: now,
            battery: Battery::new(config.battery),
            seed: config.seed,
            frames_taken: 0,
            robot,
            config,
        })
    }

    /// Advances the time to `now`, then handles the event.
    pub fn handle(&mut self, now: Timestamp, event: Event) -> Vec<Command> {
        let mut out = Vec::new();
        self.advance(now, &mut out);
        match event {
            Event::Start { ticket, arm, request } => {
                let refused = match &self.safety {
                    SafetyState::Stopped { reason } => Some(Ending::Stopped(reason.clone())),
                    _ => self.start(ticket, arm, request).err().map(Ending::Aborted),
                };
                out.extend(refused.map(|ending| Command::Ended { ticket, ending, tracking: None }));
            }
            Event::Stop { ticket, reason } => {
                self.halt(|a| a.ticket == ticket, |_| Ending::Preempted(reason.clone()), 1.0, &mut out);
            }
            Event::Safety { state } => {
                if let SafetyState::Stopped { reason } = &state {
                    for braking in self.braking.values_mut() {
                        braking.harder(&self.robot, self.now, EMERGENCY);
                    }
                    self.halt(|_| true, |_| Ending::Stopped(reason.clone()), EMERGENCY, &mut out);
                }
                self.go_on(!matches!(state, SafetyState::Held { .. }));
                self.safety = state;
            }
            Event::Reset { seed, goods } => self.reset(seed, goods, &mut out),
            Event::Fault { fault } => self.faults.add(fault),
            Event::Save => out.push(Command::Saved { snapshot: Box::new(self.save()) }),
            Event::PutBack { snapshot } => self.put_back(&snapshot, &mut out),
            Event::Tick => {}
        }
        out.extend(self.contacts.tell().into_iter().map(|contact| Command::Touched { contact }));
        out
    }

    /// When something is due without an event, if anything is.
    pub fn next_wake(&self) -> Option<Timestamp> {
        let ends = self.activities.values().map(|a| a.ends).min().and_then(|ends| self.clock.real_time(ends));
        let stands = self.clock.comes_to_stand().filter(|stands| *stands > self.now);
        let braking = self.braking.values().map(Braking::ends);
        ends.into_iter().chain(self.faults.next()).chain(stands).chain(braking).min()
    }

    /// Whether something moves. Then the caller has to send ticks often: each step takes time to compute, and steps that are left until the end of a
    /// motion delay that end.
    pub fn is_restless(&self) -> bool {
        !self.environment.is_at_rest() || self.may_move()
    }

    /// Whether a stop or a hold is complete: no goal is braking, and during a hold nothing moves.
    pub fn stands(&self) -> bool {
        self.braking.is_empty() && (self.clock.goes_on() || self.clock.stands(self.now))
    }

    /// The true positions of the joints and the base.
    pub fn configuration(&self) -> Configuration {
        self.errors.truth(&self.measured())
    }

    /// The measured positions: the arms by their encoders, the base by its localisation.
    pub fn measured(&self) -> Configuration {
        let mut configuration = self.resting;
        for (module, activity) in &self.activities {
            configuration.base = activity.base(self.motion_time).unwrap_or(configuration.base);
            let arm = module.arm().unwrap_or(FIRST);
            if let Some(joints) = activity.arm(self.motion_time) {
                configuration.set_joints(arm, joints);
            }
            if let Some(finger) = activity.finger(self.motion_time) {
                configuration.set_finger(arm, finger);
            }
            [configuration.pan, configuration.tilt] =
                activity.head(self.motion_time).unwrap_or([configuration.pan, configuration.tilt]);
        }
        self.braking.values().for_each(|braking| braking.place(self.now, &mut configuration));
        configuration
    }

    /// The true pose of the base, in the world frame.
    pub fn base_pose(&self) -> Pose {
        standing(self.configuration().base)
    }

    /// The pose of the base by its localisation, in the world frame.
    pub fn believed_base_pose(&self) -> Pose {
        standing(self.measured().base)
    }

    /// The ground truth: the real pose of every object, and what it stands on.
    pub fn ground_truth(&self) -> Vec<TrueObject> {
        let tools = self.arms.tools(&self.configuration());
        let truth = |i: usize| {
            let holder = self.arms.holder_of(i).map(|(arm, _)| self.arms.name(arm).to_owned());
            let held = holder.is_some();
            let on = if held { String::new() } else { self.support_of(i) };
            let pose = self.pose_of(i, &tools);
            let kind = self.environment.model(i).kind;
            let on_base = self.is_delivered(&pose, &on);
            let in_place = match self.config.scene {
                Setting::Boxes => on_base,
                Setting::Table => on == TABLE && tableware::is_in_place(placement::workplace(&self.robot), kind, &pose),
            };
            let (id, size, greatest_tilt_rad) = (self.ids[i].clone(), self.size_of(i), self.tilts[i]);
            TrueObject { id, kind, size, pose, on_base, in_place, greatest_tilt_rad, held, holder, on }
        };
        (0..self.ids.len()).map(truth).collect()
    }

    /// The unintended contacts since the scene was laid: the first [`super::contacts::MAX_CONTACTS`].
    pub fn unintended_contacts(&self) -> Vec<Contact> {
        self.contacts.unintended()
    }

    /// The battery's level, 0 to 1.
    pub fn battery(&self) -> f64 {
        self.battery.level()
    }

    /// Number of scheduled faults; at most [`super::faults::MAX_FAULTS`] are accepted.
    pub fn faults_to_come(&self) -> usize {
        self.faults.len()
    }

    /// Whether a module is doing something.
    pub fn is_active(&self, module: Module) -> bool {
        self.busy_with(module).is_some()
    }

    /// The goal that a module performs, or from which it is braking.
    pub(super) fn busy_with(&self, module: Module) -> Option<Ticket> {
        let active = self.activities.get(&module).map(|activity| activity.ticket);
        active.or(self.braking.get(&module).map(|braking| braking.ticket))
    }

    /// The robot, seen from its first arm.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// The number of the arm with this name.
    pub fn arm(&self, name: &str) -> Option<usize> {
        self.arms.numbers().find(|arm| self.arms.name(*arm) == name)
    }

    /// The robot seen from one of its arms, by that arm's number.
    ///
    /// # Panics
    /// If the robot has no arm with this number.
    pub fn robot_of(&self, arm: usize) -> &Robot {
        self.arms.view(arm)
    }

    /// The measured positions, as the robot seen from one of its arms has them.
    pub fn measured_of(&self, arm: usize) -> Configuration {
        self.arms.seen_from(arm, &self.measured())
    }

    /// The configuration with which the cell was created.
    pub fn config(&self) -> &CellConfig {
        &self.config
    }

    /// The seed of the current scene.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// The collision scene: the furniture and the parts of all objects; those that the first arm holds are in its gripper.
    pub fn scene(&self) -> Scene {
        self.scene_of(FIRST)
    }

    /// The collision scene as seen from the arm of this number. An object that this arm holds is placed in its gripper; an object that another arm
    /// holds is placed in the world, at its current pose.
    pub fn scene_of(&self, arm: usize) -> Scene {
        let tools = self.arms.tools(&self.configuration());
        let held = self.arms.held(arm);
        let parts = (0..self.ids.len()).flat_map(|i| {
            let place = match held {
                Some(held) if held.object == i => None,
                _ => Some(self.pose_of(i, &tools)),
            };
            let in_tool = held.map_or(Pose::IDENTITY, |held| held.in_tool);
            self.environment.model(i).parts().into_iter().map(move |(part, shape)| SceneObject {
                name: self.ids[i].clone(),
                shape,
                placement: match place {
                    Some(pose) => Placement::World(pose.compose(&part)),
                    None => Placement::Gripper(in_tool.compose(&part)),
                },
            })
        });
        Scene {
            base: self.base_pose(),
            objects: parts.chain(placement::fixed(&self.robot, self.config.scene)).collect(),
        }
    }

    /// What a camera sees now.
    pub fn scenery(&self) -> Scenery {
        let configuration = self.configuration();
        let tools = self.arms.tools(&configuration);
        let object = |i| (self.environment.model(i).clone(), self.pose_of(i, &tools));
        let eye = self.robot.camera_pose(&configuration).map_or(Pose::IDENTITY, |pose| self.errors.eye(&pose));
        let measured = self.measured();
        Scenery {
            configuration,
            measured,
            eye,
            setting: self.config.scene,
            objects: (0..self.ids.len()).map(object).collect(),
        }
    }

    fn advance(&mut self, now: Timestamp, out: &mut Vec<Command>) {
        loop {
            let frame = self.activities.get(&Module::Camera).and_then(next_frame);
            let motion_due = self.activities.values().map(|a| a.ends).chain(frame).min();
            let moved = motion_due.and_then(|due| Some((due, self.clock.real_time(due)?)));
            let stands = self.braking.values().map(Braking::ends).min();
            let due = moved.map(|(_, due)| due).into_iter().chain(self.faults.next()).chain(stands).min();
            let due = due.filter(|due| *due <= now);
            if self.pass_until(due.unwrap_or(now), out) {
                continue;
            }
            let Some(due) = due else { break };
            self.deviate(out);
            self.come_to_rest(out);
            let Some((motion_due, _)) = moved.filter(|(_, moved)| *moved <= due) else { continue };
            // A rounding error must not prevent a motion from ending.
            self.motion_time = self.motion_time.max(motion_due);
            let due = self.motion_time;
            if frame.is_some_and(|f| f <= due) {
                self.expose();
            }
            let over: Vec<Module> = self.activities.iter().filter(|(_, a)| a.ends <= due).map(|(m, _)| *m).collect();
            for module in over {
                // The last frame is taken when the picture's time ends.
                let unfinished = |a: &Activity| next_frame(a).is_some_and(|f| f <= due);
                if !self.activities.get(&module).is_some_and(unfinished) {
                    self.finish(module, out);
                }
            }
        }
    }

    fn finish(&mut self, module: Module, out: &mut Vec<Command>) {
        let Some(activity) = self.activities.remove(&module) else { return };
        let tracking = activity.tracking(self.motion_time);
        let followed = tracking.unwrap_or_default();
        let arm = module.arm().unwrap_or(FIRST);
        let ending = match activity.kind {
            Kind::Follow(Way::Base(ref motion)) => match motion.end() {
                Ok(end) => {
                    self.resting.base = [end[0], end[1], wrapped(end[2])];
                    self.relocalise();
                    Ending::Done(Product::Driven { end: self.believed_base_pose(), tracking: followed })
                }
                Err(reason) => {
                    let ending = Ending::Aborted(reason.to_owned());
                    return self.brake(module, activity, ending, 1.0);
                }
            },
            Kind::Follow(Way::Arm(_, ref motion)) => match motion.end() {
                Ok(end) => {
                    self.resting.set_joints(arm, end);
                    self.contacts.parted(arm);
                    Ending::Done(Product::Moved { end, tracking: followed })
                }
                Err(reason) => {
                    let ending = Ending::Aborted(reason.to_owned());
                    return self.brake(module, activity, ending, 1.0);
                }
            },
            Kind::Close { from, object, expected, .. } => self.close(arm, from, object, expected.as_ref(), out),
            Kind::Open { to, .. } => {
                self.resting.set_finger(arm, to);
                Ending::Done(Product::Released)
            }
            Kind::SenseBase if self.is_lost() => Ending::Aborted(LOST.to_owned()),
            Kind::SenseBase => Ending::Done(Product::BaseSensed { pose: self.believed_base_pose() }),
            Kind::SenseArm => Ending::Done(Product::ArmSensed { joints: self.arms.seen_from(arm, &self.resting).arm }),
            Kind::SenseGripper => {
                let finger = self.arms.seen_from(arm, &self.resting).finger;
                let (width, holding) = (2.0 * finger, self.arms.held(arm).is_some());
                Ending::Done(Product::GripperSensed { width, holding })
            }
            Kind::Look { to: [pan, tilt], .. } => {
                (self.resting.pan, self.resting.tilt) = (pan, tilt);
                Ending::Done(Product::Looking { pan, tilt })
            }
            Kind::Capture { camera, exposures, .. } => {
                match self.spoilt_picture(activity.started + self.now.since(self.motion_time), out) {
                    Some(reason) => Ending::Aborted(reason.to_owned()),
                    None => Ending::Done(Product::Captured { camera, exposures }),
                }
            }
        };
        out.push(Command::Ended { ticket: activity.ticket, ending, tracking });
    }

    /// Ends activities: arm and base brake, within `times` the limits that motions are planned with, and end when they have come to rest; other
    /// moving parts stop where they are.
    pub(super) fn halt(
        &mut self,
        which: impl Fn(&Activity) -> bool,
        ending: impl Fn(&Activity) -> Ending,
        times: f64,
        out: &mut Vec<Command>,
    ) {
        self.resting = self.measured();
        let stopped: Vec<Module> = self.activities.iter().filter(|(_, a)| which(a)).map(|(m, _)| *m).collect();
        for module in stopped {
            let Some(activity) = self.activities.remove(&module) else { continue };
            let ending = ending(&activity);
            if let (Kind::Close { .. }, Some(arm)) = (&activity.kind, module.arm()) {
                // The fingers may or may not overlap the object by now.
                self.arms.close(arm, self.arms.seen_from(arm, &self.resting).finger, Around::Slipped);
            }
            if matches!(activity.kind, Kind::Follow(_)) {
                self.brake(module, activity, ending, times);
            } else {
                out.push(Command::Ended { ticket: activity.ticket, ending, tracking: None });
            }
        }
        self.come_to_rest(out);
    }

    /// Starts to brake a motion.
    fn brake(&mut self, module: Module, activity: Activity, ending: Ending, times: f64) {
        let at_s = activity.elapsed_s(self.motion_time);
        if let Kind::Follow(way) = activity.kind {
            let along = [self.clock.rate(self.now), at_s];
            let whose = (activity.ticket, ending);
            self.braking.insert(module, Braking::begin(&self.robot, self.now, way, along, times, whose));
        }
    }

    /// Ends the motions that have come to rest.
    fn come_to_rest(&mut self, out: &mut Vec<Command>) {
        let standing: Vec<Module> =
            self.braking.iter().filter(|(_, b)| b.ends() <= self.now).map(|(m, _)| *m).collect();
        for module in standing {
            let Some(braking) = self.braking.remove(&module) else { continue };
            braking.place(self.now, &mut self.resting);
            if module == Module::Base {
                self.relocalise();
            }
            let tracking = Some(braking.tracking(self.now));
            out.push(Command::Ended { ticket: braking.ticket, ending: braking.ending, tracking });
        }
    }

    /// The base has stopped: its localisation gets a new error.
    fn relocalise(&mut self) {
        let stands = self.errors.truth(&self.resting).base;
        self.stops += 1;
        self.errors.localise(self.seed, self.stops);
        self.resting.base = self.errors.believed(stands);
    }

    /// Resumes or stops the motion clock.
    fn go_on(&mut self, goes_on: bool) {
        if goes_on == self.clock.goes_on() {
            return;
        }
        let ways = self.activities.values().filter_map(|activity| match &activity.kind {
            Kind::Follow(way) => Some((way, activity.elapsed_s(self.motion_time))),
            _ => None,
        });
        let ways: Vec<(&Way, f64)> = ways.collect();
        self.clock.change(&self.robot, [self.now, self.motion_time], goes_on, &ways);
    }

    /// Ends everything at once at its current position, which no real robot can do: used when the scene is replaced.
    pub(super) fn freeze(&mut self, reason: &str, out: &mut Vec<Command>) {
        self.resting = self.measured();
        let active =
            std::mem::take(&mut self.activities).into_values().map(|a| (a.ticket, a.tracking(self.motion_time)));
        let braking = std::mem::take(&mut self.braking).into_values().map(|b| (b.ticket, Some(b.tracking(self.now))));
        for (ticket, tracking) in active.chain(braking) {
            out.push(Command::Ended { ticket, ending: Ending::Aborted(reason.to_owned()), tracking });
        }
        // A hold that was beginning is complete.
        let goes_on = self.clock.goes_on();
        self.clock.change(&self.robot, [self.now, self.motion_time], goes_on, &[]);
    }

    fn reset(&mut self, seed: u64, goods: Goods, out: &mut Vec<Command>) {
        self.freeze("the cell was reset", out);
        self.resting = self.arms.first_posture();
        self.seed = seed;
        self.stops = 0;
        self.errors = Errors::new(self.config.errors, &joint_counts(&self.robot), seed, 0);
        // The request was checked before it became an event; if the table cannot be laid, it is empty.
        let objects = placement::objects(&self.robot, self.config.scene, goods, seed).unwrap_or_default();
        for arm in self.arms.numbers() {
            self.arms.hold(arm, None);
            self.arms.have_closed(arm, Closed::NEVER);
        }
        self.contacts = Contacts::of(&self.robot);
        self.tilts = vec![0.0; objects.len()];
        (self.environment, self.ids) = environment(&self.robot, &self.configuration(), self.config.scene, &objects);
        self.environment.skip_until(self.now);
    }

    /// Takes one frame of the current picture.
    fn expose(&mut self) {
        let scenery = self.scenery();
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

/// When the next frame of a picture is due. Rounding of periods never moves the last frame past the picture's end.
fn next_frame(activity: &Activity) -> Option<Timestamp> {
    match &activity.kind {
        Kind::Capture { frames, taken, next, .. } if taken < frames => Some((*next).min(activity.ends)),
        _ => None,
    }
}

/// The environment with everything in the cell, and the names of the movable objects.
fn environment(
    robot: &Robot,
    configuration: &Configuration,
    setting: Setting,
    objects: &[Placed],
) -> (Environment, Vec<String>) {
    let models: Vec<_> = objects.iter().map(|o| (o.model.clone(), o.pose)).collect();
    let environment = Environment::new(robot, configuration, &placement::furniture(robot, setting), &models);
    (environment, objects.iter().map(|o| o.id.clone()).collect())
}

/// The pose of a base in the world frame.
fn standing([x, y, heading]: [f64; 3]) -> Pose {
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, heading)
}

/// The number of joints of each arm.
pub(super) fn joint_counts(robot: &Robot) -> Vec<usize> {
    (0..robot.arm_names().count()).map(|arm| robot.joints_of(arm).len()).collect()
}
