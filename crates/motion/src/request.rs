//! A request to the planner.

use crate::cloud::MAX_RADIUS_M;
use crate::constrained::LEAST_TOLERANCE;
use crate::joint_vector::JointVector;
use crate::keep::{Keep, Region};
use crate::plan::PlanError;
use crate::robot::{Configuration, Joint, Robot, on_floor};
use crate::seen::Seen;
use crate::straight::Straight;
use crate::tool_speed::ToolSpeed;
use crate::way_points::WayPoints;
use ratn_model::pose::Pose;
use ratn_world::scene::Scene;
use std::f64::consts::FRAC_PI_2;

/// Maximum number of boxes to keep out of.
const MAX_KEPT_OUT: usize = 64;

/// Maximum number of alternative goals.
pub const MAX_GOALS: usize = 64;

/// The slowest motion, as a fraction of the limits: the number of a trajectory's points grows with its duration.
pub const MIN_SPEED: f64 = 0.01;

/// Tolerance for the base pose of a robot without a base, relative to the origin, in metres and radians: rounding.
const STANDS_STILL: f64 = 1e-6;

/// A motion to plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// The start: the positions of all parts of the robot. The arm moves from there; head and fingers do not move. The base pose is that of the
    /// scene, whatever this says. [`assumed`](crate::arm::assumed) fills in unknown parts.
    pub start: Configuration,
    /// The goals; the motion ends at any one of them.
    pub goals: Vec<Goal>,
    /// The straight line of the tool with which the motion begins.
    pub depart: Straight,
    /// The straight line of the tool with which the motion ends.
    pub approach: Straight,
    /// Move in straight lines of the tool from the end of the departure to the beginning of the approach, instead of along a free path.
    pub straight: Option<WayPoints>,
    /// Keeps the tool upright: the direction that points up in the tool at the end of the departure stays within this angle of the vertical along the
    /// free path, in radians.
    pub upright_rad: Option<f64>,
    /// Further constraints on the tool, for the whole motion.
    pub keep: Keep,
    /// Boxes that no moving part may enter: no link, no finger, no held object; not on the straight parts either, where fingers and held objects may
    /// touch things. The boxes are not obstacles, so they hide nothing that a camera saw.
    pub keep_out: Vec<Region>,
    /// Names, in the scene, of hollow objects with filled shapes into which the fingers may reach on the straight parts.
    pub reaches_into: Vec<String>,
    /// Obstacles that a depth camera saw in addition to the scene.
    pub seen: Option<Seen>,
    /// Fraction of the joints' velocity and acceleration limits, [`MIN_SPEED`] to 1.
    pub speed: f64,
    /// Fractions of the limits of velocity (in addition to `speed`), acceleration (in addition to `speed`) and jerk, for each joint.
    pub scales: [JointVector; 3],
    /// Limits of the tool's speed.
    pub tool_speed: ToolSpeed,
    /// The same seed, scene and iterations give the same plan.
    pub seed: u64,
    /// Iterations of improvement after the first path and its shortcutting, unless the time is up before.
    pub improvement_iterations: usize,
}

/// The name of a box to keep out of, in messages.
pub(crate) fn kept_out(index: usize) -> String {
    format!("keep_out[{index}]")
}

/// A goal of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// A posture: positions of the arm's joints in radians.
    Joints(JointVector),
    /// A pose of the tool frame, in the world frame, in metres.
    Pose(Pose),
}

impl Request {
    /// A request for the fastest motion to one of the goals, without straight parts and without improvement.
    pub fn new(start: Configuration, goals: Vec<Goal>) -> Request {
        Request {
            start,
            goals,
            depart: Straight::up(0.0),
            approach: Straight::down(0.0),
            straight: None,
            upright_rad: None,
            keep: Keep::default(),
            keep_out: Vec::new(),
            reaches_into: Vec::new(),
            seen: None,
            speed: 1.0,
            scales: [JointVector::all(start.arm.len(), 1.0); 3],
            tool_speed: ToolSpeed::default(),
            seed: 0,
            improvement_iterations: 0,
        }
    }

    /// The arm's joints with the limits of this motion.
    pub(crate) fn joints(&self, robot: &Robot) -> Vec<Joint> {
        let [velocity, acceleration, jerk] = &self.scales;
        let scaled = |(j, joint): (usize, &Joint)| Joint {
            velocity: joint.velocity * velocity[j],
            acceleration: joint.acceleration * acceleration[j],
            jerk: joint.jerk * jerk[j],
            ..joint.clone()
        };
        robot.arm_joints().iter().enumerate().map(scaled).collect()
    }

    /// Refuses invalid requests before planning.
    pub(crate) fn check(&self, robot: &Robot, scene: &Scene) -> Result<(), PlanError> {
        let malformed = |what: &str, value: String, expected: &str| {
            Err(PlanError::Malformed { what: what.to_owned(), value, expected: expected.to_owned() })
        };
        if !(MIN_SPEED..=1.0).contains(&self.speed) {
            return malformed("speed", self.speed.to_string(), &format!("a fraction from {MIN_SPEED} to 1"));
        }
        let [x, y, heading] = on_floor(&scene.base);
        if robot.base_joints().is_empty() && [x, y, heading].iter().any(|c| c.abs() > STANDS_STILL) {
            let value = format!("({x}, {y}) with the heading {heading}");
            let name = robot.name();
            let expected = format!(
                "the origin, or no such fact: {name} has no [base], so it stands where its URDF puts it; move its root there instead"
            );
            return malformed("the place of the base (`at(base)`)", value, &expected);
        }
        let joints = robot.arm_joints().len();
        let expected = || format!("{joints}, one for each joint of the arm of {}", robot.name());
        let asked = self.goals.iter().filter_map(|goal| match goal {
            Goal::Joints(joints) => Some(("the number of a goal's positions", joints)),
            Goal::Pose(_) => None,
        });
        let scales = self.scales.iter().map(|scales| ("the number of a scale's values", scales));
        let start = std::iter::once(("the number of the start's positions", &self.start.arm));
        if let Some((what, vector)) = start.chain(asked).chain(scales).find(|(_, vector)| vector.len() != joints) {
            return malformed(what, vector.len().to_string(), &expected());
        }
        self.depart.check("depart", scene)?;
        self.approach.check("approach", scene)?;
        if let Some(way) = &self.straight {
            way.check(&self.goals)?;
        }
        if let Some(tolerance) = self.upright_rad
            && !(LEAST_TOLERANCE..=FRAC_PI_2).contains(&tolerance)
        {
            let range = format!("{LEAST_TOLERANCE} to {FRAC_PI_2:.3} rad");
            return malformed("upright_rad", tolerance.to_string(), &range);
        }
        if self.upright_rad.is_some() && self.keep.axis.is_some() {
            let expected = "one of them: both say which direction the tool keeps";
            return malformed("upright_rad", "there beside keep_axis".to_owned(), expected);
        }
        if let Some(within) = self.seen.as_ref().map(|seen| seen.known_within_m)
            && !(0.0..=MAX_RADIUS_M).contains(&within)
        {
            return malformed("cloud_known_within_m", within.to_string(), &format!("0 to {MAX_RADIUS_M} m"));
        }
        self.keep.check()?;
        if self.keep_out.len() > MAX_KEPT_OUT {
            let expected = format!("{MAX_KEPT_OUT} at the most");
            return malformed("the number of boxes of `keep_out`", self.keep_out.len().to_string(), &expected);
        }
        self.keep_out.iter().enumerate().try_for_each(|(i, region)| region.check(&kept_out(i)))?;
        self.tool_speed.check()?;
        for (what, scales) in ["velocity_scale", "acceleration_scale", "jerk_scale"].iter().zip(&self.scales) {
            if let Some(scale) = scales.iter().find(|scale| !(MIN_SPEED..=1.0).contains(*scale)) {
                return malformed(what, scale.to_string(), &format!("fractions from {MIN_SPEED} to 1"));
            }
        }
        if self.goals.is_empty() || self.goals.len() > MAX_GOALS {
            return malformed("the number of goals", self.goals.len().to_string(), &format!("1 to {MAX_GOALS}"));
        }
        let goals = self.goals.iter().filter_map(|goal| match goal {
            Goal::Joints(joints) => Some(("the goal's", joints)),
            Goal::Pose(_) => None,
        });
        let within = |whose: &str, outside: Option<Outside>| match outside {
            None => Ok(()),
            Some(Outside { joint, position, range }) => {
                malformed(&format!("{whose} {joint}"), position.to_string(), &range)
            }
        };
        within("the start's", outside_of_limits(robot, &self.start))?;
        for (whose, posture) in goals {
            within(whose, outside(posture, robot.arm_joints(), robot.arm_slides()))?;
        }
        let finite = |pose: &Pose| pose.position.iter().chain(&pose.quaternion_xyzw).all(|c| c.is_finite());
        if let Some(Goal::Pose(pose)) = self.goals.iter().find(|g| matches!(g, Goal::Pose(p) if !finite(p))) {
            return malformed("a goal pose", format!("{pose:?}"), "finite numbers");
        }
        Ok(())
    }
}

/// A position beyond the limits of its joint.
pub(crate) struct Outside {
    pub(crate) joint: String,
    pub(crate) position: f64,
    /// The limits, with their unit.
    pub(crate) range: String,
}

/// The unit of a joint's positions.
pub(crate) fn unit(slides: bool) -> &'static str {
    if slides { "m" } else { "rad" }
}

/// The first joint of arm, head or fingers that is beyond its limits.
pub(crate) fn outside_of_limits(robot: &Robot, at: &Configuration) -> Option<Outside> {
    let head = || outside(&[at.pan, at.tilt], robot.head_joints(), &[false; 2]);
    let fingers = || outside(&[at.finger], robot.finger().map_or(&[], std::slice::from_ref), &[true]);
    outside(&at.arm, robot.arm_joints(), robot.arm_slides()).or_else(head).or_else(fingers)
}

fn outside(positions: &[f64], joints: &[Joint], slides: &[bool]) -> Option<Outside> {
    let mut all = positions.iter().zip(joints).zip(slides);
    let beyond = |(q, joint): (&f64, &Joint)| !joint.allows(*q, 1e-6);
    let ((position, joint), slides) = all.find(|(held, _)| beyond(*held))?;
    let [lower, upper] = joint.limits();
    let range = format!("{lower:.3} to {upper:.3} {}", unit(*slides));
    Some(Outside { joint: joint.name.clone(), position: *position, range })
}
