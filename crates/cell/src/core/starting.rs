//! Starts goals: refuses the impossible ones, and computes how long the others take.

use super::activity::{Activity, Kind, Module, Ticket, seconds};
use super::braking::Way;
use super::cell::Cell;
use super::deviations::LOST;
use super::motion::{Controller, Motion};
use super::protocol::Request;
use super::trajectory;
use ratn_model::value::Trajectory;
use ratn_motion::drive::wrapped;
use ratn_motion::joint_vector::{JointVector, PerJoint};
use ratn_motion::robot::Configuration;
use ratn_motion::trajectory::Curve;
use ratn_perception::camera::Camera;
use ratn_perception::noise::MAX_FRAMES;

/// Why the camera is not turned.
const NO_HEAD: &str = "the robot has no head that turns: its description has no `[head]`";
/// Why the base does not drive.
const NO_BASE: &str = "the robot has no base that drives: its description has no `[base]`";
/// Why there is no picture.
const NO_CAMERA: &str = "the robot has no camera: its description has no `[camera]`";
/// Why nothing is grasped.
const NO_GRIPPER: &str = "the arm has no gripper: its description has none";
/// Maximum angle between the camera's view and its target, in radians.
const MAX_LOOK_ERROR_RAD: f64 = 0.02;

/// Why two modules may not move at once, and how a task prevents it.
const BASE: &str = "nothing else happens while the base drives, so let both states block `Base`";
const HAND: &str = "an arm does not move while its fingers close, nor before they have parted from what they let go, so let one of both \
                    states block `Arm` and `Gripper`";
const PICTURE: &str =
    "no picture is taken while the head moves, so let one of both states block `PanTilt` and `Camera`";
const CARRIED: &str = "no picture is taken while an arm moves that carries the camera, so let one of both states block `Arm` and `Camera`";

impl Cell {
    /// Starts a goal; `arm` is the arm's number, if it is for an arm or its gripper.
    pub(super) fn start(&mut self, ticket: Ticket, arm: usize, request: Request) -> Result<(), String> {
        if arm >= self.arms.count() {
            return Err(format!("the robot has {} arms, numbered from 0: there is no arm {arm}", self.arms.count()));
        }
        let module = request.module(arm);
        if let Some(other) = self.busy_with(module) {
            return Err(format!("the {} is busy with goal {}", self.called(module), other.0));
        }
        if self.battery.level() <= 0.0 {
            return Err("the battery is empty".to_owned());
        }
        let here = self.measured();
        let (kind, lasts_s) = match request {
            Request::Drive { .. } if self.robot.base_joints().is_empty() => return Err(NO_BASE.to_owned()),
            Request::Drive { trajectory } => {
                let of_arms = self.arms.numbers().flat_map(|arm| [Module::Arm(arm), Module::Gripper(arm)]);
                for other in of_arms.chain([Module::PanTilt, Module::Camera]) {
                    self.no_motion_of(other, BASE)?;
                }
                self.arms.numbers().try_for_each(|arm| self.has_parted(arm))?;
                if self.is_lost() {
                    return Err(LOST.to_owned());
                }
                let trajectory = trajectory::check_base(&self.robot, &here, &trajectory)?;
                self.driving(trajectory)
            }
            Request::Follow { trajectory } => {
                self.may_move_arm(arm)?;
                let trajectory = self.checked(arm, &here, &trajectory)?;
                self.following(arm, trajectory)?
            }
            Request::MoveTo { joints, speed } => {
                self.may_move_arm(arm)?;
                let robot = self.arms.view(arm);
                let expected = robot.arm_joints().len();
                if joints.len() != expected {
                    return Err(format!("input `joints` has {} values: the arm has {expected}", joints.len()));
                }
                let from = self.arms.seen_from(arm, &here).arm;
                let line = trajectory::straight(robot, &from, &joints, speed)?;
                let trajectory = self.checked(arm, &here, &line)?;
                self.following(arm, trajectory)?
            }
            Request::Grasp { .. } | Request::Release | Request::OpenTo { .. } if self.arms.pads(arm).is_none() => {
                return Err(NO_GRIPPER.to_owned());
            }
            Request::Grasp { object, expected } => {
                self.no_motion_of(Module::Base, BASE)?;
                self.no_motion_of(Module::Arm(arm), HAND)?;
                if let Some(held) = self.arms.held(arm) {
                    return Err(format!("the gripper holds {} already", self.ids[held.object]));
                }
                let from = self.arms.seen_from(arm, &here).finger;
                let to = self.closes_to(arm, from)?;
                // An object that slips out lets the fingers close fully.
                self.fingers_keep_apart(arm, from, 0.0)?;
                self.contacts.closing(arm);
                (Kind::Close { from, to, object, expected }, self.config.gripper.close_s)
            }
            Request::Release => self.opening(arm, self.arms.open_finger_m(arm))?,
            Request::OpenTo { width } => self.opening(arm, self.opens_to(arm, width)?)?,
            Request::SenseBase => (Kind::SenseBase, 0.0),
            Request::SenseArm => (Kind::SenseArm, 0.0),
            Request::SenseGripper => (Kind::SenseGripper, 0.0),
            Request::LookAt { target } => {
                self.no_motion_of(Module::Base, BASE)?;
                self.no_motion_of(Module::Camera, PICTURE)?;
                let (from, to) = ([here.pan, here.tilt], self.aim(target)?);
                self.head_keeps_apart(from, to)?;
                let lasts_s = self.turning_s(from, to) + self.config.pan_tilt.settle_s;
                (Kind::Look { from, to }, lasts_s)
            }
            Request::Capture { frames } => {
                self.no_motion_of(Module::Base, BASE)?;
                self.no_motion_of(Module::PanTilt, PICTURE)?;
                let mut carriers = self.arms.numbers().filter(|arm| self.robot.moves_camera(*arm));
                carriers.try_for_each(|arm| self.no_motion_of(Module::Arm(arm), CARRIED))?;
                if !(1..=MAX_FRAMES).contains(&frames) {
                    return Err(format!("a picture has 1 to {MAX_FRAMES} frames, not {frames}"));
                }
                let pose = self.robot.camera_pose(&here).ok_or_else(|| NO_CAMERA.to_owned())?;
                let camera = Camera { intrinsics: self.config.camera.intrinsics, pose };
                let period = 1.0 / self.config.camera.frames_per_s;
                let next = self.motion_time + seconds(period);
                let kind = Kind::Capture { camera, frames, taken: 0, next, exposures: Vec::new() };
                (kind, period * f64::from(frames))
            }
        };
        let (held, of_arm) = (self.arms.all_held(), module.arm());
        for (arm, held) in held.into_iter().enumerate().filter(|(arm, _)| of_arm.is_none_or(|moves| moves == *arm)) {
            if matches!(kind, Kind::Follow(_)) {
                self.contacts.sets_out(arm, held);
                self.arms.sets_out(arm);
            }
        }
        let (started, ends) = (self.motion_time, self.motion_time + seconds(lasts_s));
        self.activities.insert(module, Activity { ticket, started, ends, kind });
        Ok(())
    }

    /// Checks that nothing happens that has to wait while an arm moves: the base moves, a camera that the arm carries takes a picture, or the
    /// arm's own fingers close or have not separated from a released object.
    fn may_move_arm(&self, arm: usize) -> Result<(), String> {
        self.no_motion_of(Module::Base, BASE)?;
        if self.robot.moves_camera(arm) {
            self.no_motion_of(Module::Camera, CARRIED)?;
        }
        let finger = self.arms.seen_from(arm, &self.measured()).finger;
        let parted = self.arms.closed(arm).has_parted(finger, self.arms.open_finger_m(arm));
        if parted && self.opens_fingers_to(arm).is_some() {
            return Ok(());
        }
        self.no_motion_of(Module::Gripper(arm), HAND)?;
        self.has_parted(arm)
    }

    /// Checks that the fingers of an arm have separated from the object that they released, if any. They need not be moving: a motion that opened
    /// them a little may have ended, or been stopped.
    fn has_parted(&self, arm: usize) -> Result<(), String> {
        let finger = self.arms.seen_from(arm, &self.measured()).finger;
        if !self.arms.is_at_what_it_let_go(arm, finger) {
            return Ok(());
        }
        let by_mm = 1e3 * (finger - self.arms.closed(arm).at_m);
        Err(format!(
            "the fingers of the {} have not parted from what they let go: each has opened by {by_mm:.1} mm; open them first, or close them \
             around it again",
            self.called(Module::Gripper(arm))
        ))
    }

    /// The target position of an arm's opening fingers, as distance from the middle.
    pub(super) fn opens_fingers_to(&self, arm: usize) -> Option<f64> {
        match self.activities.get(&Module::Gripper(arm))?.kind {
            Kind::Open { to, .. } => Some(to),
            _ => None,
        }
    }

    /// The distance of each finger from the middle for this distance between them.
    ///
    /// # Errors
    /// If the fingers do not open by moving there.
    fn opens_to(&self, arm: usize, width: f64) -> Result<f64, String> {
        let (finger, open) = (self.arms.seen_from(arm, &self.measured()).finger, self.arms.open_finger_m(arm));
        if width / 2.0 > finger && width / 2.0 <= open {
            return Ok(width / 2.0);
        }
        let [from, at_most] = [finger, open].map(|finger| 2e3 * finger);
        Err(format!(
            "input `width_m` is {width}: the fingers are {from:.0} mm apart, so they open to more than that and at most {at_most:.0} mm"
        ))
    }

    /// The opening of fingers and its duration: with the speed of opening completely from where they had closed. An arm that releases an object has
    /// to stand; otherwise the arm may move meanwhile.
    fn opening(&mut self, arm: usize, to: f64) -> Result<(Kind, f64), String> {
        self.no_motion_of(Module::Base, BASE)?;
        let from = self.arms.seen_from(arm, &self.measured()).finger;
        let (closed, open, whole_s) = (self.arms.closed(arm), self.arms.open_finger_m(arm), self.config.gripper.open_s);
        if self.arms.held(arm).is_some() || !closed.has_parted(from, open) {
            self.no_motion_of(Module::Arm(arm), HAND)?;
        }
        self.fingers_keep_apart(arm, from, to)?;
        self.let_go(arm);
        let part = (to - from) / (open - closed.at_m);
        Ok((Kind::Open { from, to }, if part > 0.0 && part < 1.0 { whole_s * part } else { whole_s }))
    }

    /// Checks a trajectory of an arm beside the other arms twice, with their fingers at their current positions and open: neither covers the space of
    /// both, because closed fingers are in the middle and open ones are beside it.
    fn checked(&self, arm: usize, here: &Configuration, trajectory: &Trajectory) -> Result<Curve, String> {
        let robot = self.arms.view(arm);
        let as_they_are = self.arms.seen_from(arm, here);
        let open = self.arms.seen_from(arm, &self.arms.with_others_open(arm, here));
        let stiffness = self.config.controllers.arm_stiffness;
        let checked = trajectory::check(robot, &as_they_are, trajectory, stiffness)?;
        if open != as_they_are {
            trajectory::check(robot, &open, trajectory, stiffness)?;
        }
        Ok(checked)
    }

    /// The motion of an arm and its duration.
    ///
    /// # Errors
    /// If the arm would come too close to another arm, or to a turning head.
    fn following(&mut self, arm: usize, trajectory: Curve) -> Result<(Kind, f64), String> {
        let lasts_s = trajectory.duration_s();
        let config = self.config.controllers;
        let slides = self.arms.view(arm).arm_slides();
        let controller = Controller {
            of: "arm",
            stiffness: config.arm_stiffness,
            most_off: config.arm_most_off_rad,
            slides: PerJoint::from_fn(slides.len(), |j| slides[j]),
        };
        let from = self.arms.seen_from(arm, &self.measured()).arm;
        let motion = Motion::new(trajectory.clone(), from, controller, None);
        self.arm_keeps_apart(arm, &Way::Arm(arm, motion))?;
        let breaks = self.arm_breaks_off(lasts_s);
        let motion = Motion::new(trajectory, from, controller, breaks);
        let lasts_s = motion.lasts_s();
        Ok((Kind::Follow(Way::Arm(arm, motion)), lasts_s))
    }

    /// The motion of the base and its duration.
    fn driving(&mut self, trajectory: Curve) -> (Kind, f64) {
        let lasts_s = trajectory.duration_s();
        let config = self.config.controllers;
        let controller = Controller {
            of: "base",
            stiffness: config.base_stiffness,
            most_off: config.base_most_off,
            slides: Controller::base_slides(),
        };
        let breaks = self.drive_breaks_off(lasts_s);
        // A heading is the same after a whole turn: the one nearest to the trajectory's start is used.
        let ([x, y, heading], first) = (self.measured().base, trajectory.knots()[0].positions[2]);
        let start = JointVector::of([x, y, first + wrapped(heading - first)]);
        let motion = Motion::new(trajectory, start, controller, breaks);
        let lasts_s = motion.lasts_s();
        (Kind::Follow(Way::Base(motion)), lasts_s)
    }

    fn no_motion_of(&self, module: Module, why: &str) -> Result<(), String> {
        match self.busy_with(module) {
            None => Ok(()),
            Some(other) => Err(format!("the {} is under way with goal {}: {why}", self.called(module), other.0)),
        }
    }

    /// The name of a module in messages: for a robot with several arms with the name of its arm.
    fn called(&self, module: Module) -> String {
        match module.arm() {
            Some(arm) if self.arms.count() > 1 => format!("{} of the arm `{}`", module.kind(), self.arms.name(arm)),
            _ => module.kind().to_owned(),
        }
    }

    fn aim(&self, target: [f64; 3]) -> Result<[f64; 2], String> {
        if self.robot.head_joints().is_empty() {
            return Err(NO_HEAD.to_owned());
        }
        let (pan, tilt) = self.robot.look_at(&self.measured(), target);
        let looking = Configuration { pan, tilt, ..self.measured() };
        let camera = self.robot.camera_pose(&looking).ok_or_else(|| NO_CAMERA.to_owned())?;
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

    /// Duration of a head motion, with ramps at maximum acceleration for the joint that takes longest.
    fn turning_s(&self, from: [f64; 2], to: [f64; 2]) -> f64 {
        let time = |joint: usize, way: f64| {
            let Some(joint) = self.robot.head_joints().get(joint) else { return 0.0 };
            let (speed, acceleration) = (joint.velocity * self.config.pan_tilt.speed, joint.acceleration);
            let ramp = speed * speed / acceleration;
            if way >= ramp { way / speed + speed / acceleration } else { 2.0 * (way / acceleration).sqrt() }
        };
        time(0, (to[0] - from[0]).abs()).max(time(1, (to[1] - from[1]).abs()))
    }
}
