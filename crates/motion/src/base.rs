//! Motions of the base: planned from its present place to a goal with a tolerance, timed within its limits, and checked before they are executed.
//!
//! The path comes from `drive`; its corners are rounded and it is timed like the arm's (`timing`), in x, y and heading. Objects that stand on the deck or are
//! held move with the base. The path avoids what a camera saw, except the floor. Headings of a trajectory may exceed half a turn; those of a place do not.

use crate::cloud::{CloudError, MAX_RADIUS_M};
use crate::collision::length;
use crate::connect::{Budget, ConnectError};
use crate::drive::{Vehicle, drive_in, wrapped};
use crate::exact::{Exact, Touch};
use crate::geometry::Geometry;
use crate::joint_vector::JointVector;
use crate::pace::Control;
use crate::request::{MIN_SPEED, Outside, outside_of_limits};
use crate::robot::{Configuration, Joint, Robot, to_f32};
use crate::seen::Seen;
use crate::space::{Obstacle, Space, state};
use crate::surroundings::Surroundings;
use crate::timing::{Section, timed};
use crate::trajectory::{Curve, TrajectoryError};
use crate::validate::{Violation, check_limits, check_rest};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_world::scene::{Placement, Scene};
use std::f64::consts::TAU;

/// Clearance of a planned path, in metres.
const PADDING_M: f64 = 0.02;

/// Maximum distance of a trajectory's start from the base's place, in metres and in radians.
pub const START_TOLERANCE: f64 = 0.02;

/// An object stands on the deck if its lowest point is within this distance of the deck, in metres: poses are measured with an error of millimetres.
const STANDS_M: f64 = 0.01;

/// … and if it reaches beyond the deck's edges by no more than this, in metres: what reaches further may stand on something else.
const BEYOND_M: f64 = 0.03;

/// Maximum tolerances, in metres and in radians.
const MAX_TOLERANCE: f64 = 1.0;

/// Number of places tried within the tolerance of goals that are not free.
const PLACES: usize = 64;

/// Maximum number of alternative goals.
const MAX_GOALS: usize = 64;

/// Number of samples of the search.
const ITERATIONS: usize = 30_000;

/// Clearance of the rough check of a place, and resolution of the exact check, in metres.
const ROOMY_M: f64 = 0.01;
const RESOLUTION_M: f64 = 1e-3;

/// A request for a drive.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveRequest {
    /// The state of the whole robot at the start. The base drives from there; everything else stays as it is.
    pub start: Configuration,
    /// Alternative goals, any one will do: x, y and heading.
    pub goals: Vec<[f64; 3]>,
    /// Allowed deviation from a goal that is not free, in metres.
    pub position_tolerance_m: f64,
    /// … and in radians.
    pub heading_tolerance_rad: f64,
    /// Fraction of the base's velocity and acceleration limits.
    pub speed: f64,
    /// What a depth camera saw in addition to the scene, valid while the base stands where the scene has it. Points so near to the floor that they may belong
    /// to it are left out, as are points near other known objects.
    pub seen: Option<Seen>,
    /// The same request, scene and seed give the same plan.
    pub seed: u64,
}

/// A planned drive.
#[derive(Debug, Clone, PartialEq)]
pub struct DrivePlan {
    /// The timed trajectory.
    pub trajectory: Trajectory,
    /// Its end: x, y and heading within half a turn.
    pub end: [f64; 3],
    /// The length of the path; metres and radians are added up.
    pub length: f64,
}

/// Why there is no path.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DriveError {
    /// A part of the request is out of range or contradicts the robot.
    #[error("{what} is {value}: expected {expected}")]
    Malformed {
        /// The part.
        what: String,
        /// Its value.
        value: String,
        /// The allowed values.
        expected: String,
    },
    /// What was seen cannot be used as an obstacle.
    #[error("what was seen: {error}")]
    Seen {
        /// The reason.
        error: CloudError,
    },
    /// The robot has no base that drives.
    #[error("{robot} has no base that drives: its description has no `[base]`")]
    NoBase {
        /// The robot's name.
        robot: String,
    },
    /// The robot touches something at the start.
    #[error("the robot cannot drive off: there is less than {:.0} mm between it and something else{}", PADDING_M * 1e3, touching(.touch.as_ref()))]
    Start {
        /// The contact, where there is one.
        touch: Option<Touch>,
    },
    /// The robot would touch something at every goal.
    #[error(
        "none of the {goals} goals is free, nor any place tried within {position_m:.2} m and {heading_rad:.2} rad of them"
    )]
    Goal {
        /// Number of goals.
        goals: usize,
        /// The tolerance, in metres.
        position_m: f64,
        /// The tolerance, in radians.
        heading_rad: f64,
    },
    /// The search found no path.
    #[error(transparent)]
    NoPath(ConnectError),
    /// The caller cancelled the planning.
    #[error("planning was cancelled")]
    Cancelled,
}

/// Why the base may not follow a trajectory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DriveViolation {
    /// It is not a trajectory of the base.
    #[error(transparent)]
    Malformed(#[from] TrajectoryError),
    /// It starts at another place.
    #[error("the base is {metres:.3} m and {radians:.3} rad away from where the trajectory starts")]
    Start {
        /// The distance.
        metres: f64,
        /// The difference of headings.
        radians: f64,
    },
    /// It breaks a limit, or does not start and end at rest.
    #[error(transparent)]
    Limit(#[from] Violation),
    /// It would touch something.
    #[error("at {time_s:.2} s {touch}")]
    Touch {
        /// The time.
        time_s: f64,
        /// The contact.
        touch: Touch,
    },
}

/// Objects on the robot's deck: they are within its edges, and their lowest point is at its height.
pub fn riding(robot: &Robot, scene: &Scene) -> Vec<String> {
    let standing = robot.at_zero().with_base(&scene.base);
    let Some(base) = robot.body() else { return Vec::new() };
    let frame = robot.poses(&standing)[base];
    let stands = |pose: &Pose, geometry: &Geometry| {
        robot.model.links[base].bodies.iter().any(|deck| {
            let Geometry::Box { half } = deck.geometry else { return false };
            let seen = frame.compose(&deck.pose).inverse().compose(pose);
            let around = geometry.shape(0.0).compute_aabb(&to_f32(&geometry.at(seen).pose));
            let [mins, maxs] = [around.mins, around.maxs].map(|corner| corner.to_array().map(f64::from));
            let is_within = (0..2).all(|i| maxs[i].max(-mins[i]) <= half[i] + BEYOND_M);
            is_within && (mins[2] - half[2]).abs() <= STANDS_M
        })
    };
    let on_deck = scene.objects.iter().filter(|object| match object.placement {
        Placement::World(pose) => stands(&pose, &Geometry::from(&object.shape)),
        Placement::Gripper(_) | Placement::Hand { .. } => false,
    });
    on_deck.map(|object| object.name.clone()).collect()
}

/// Plans a path for the base in a scene. The scene's base is where objects that move with it were seen from.
///
/// # Errors
/// [`DriveError`] says why there is no path.
pub fn plan_drive(
    robot: &Robot,
    scene: &Scene,
    request: &DriveRequest,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<DrivePlan, DriveError> {
    if robot.base_joints().is_empty() {
        return Err(DriveError::NoBase { robot: robot.name().to_owned() });
    }
    let request = &DriveRequest { start: robot.within_limits(&request.start), ..request.clone() };
    request.check(robot)?;
    let here = request.start.with_base(&scene.base);
    let riding = riding(robot, scene);
    let (vehicle, obstacles) = Vehicle::of(robot, scene, &here, &riding, PADDING_M);
    let mechanism = vehicle.mechanism();
    let seen = request.seen.as_ref().map(|seen| seen.beside_the_floor(robot, scene, &here)).transpose();
    let seen = seen.map_err(|error| DriveError::Seen { error })?;
    let surroundings = Surroundings { obstacles: &obstacles, clouds: seen.as_slice(), meshes: &[] };
    let mut space = Space::new(&mechanism, surroundings);
    let budget = Budget { iterations: ITERATIONS, seed: request.seed };
    let found = match drive_in(&vehicle, &mut space, request.start.base, &request.goals, budget, control) {
        Err(ConnectError::Goal { .. }) => {
            drive_in(&vehicle, &mut space, request.start.base, &request.around(), budget, control)
        }
        other => other,
    };
    let (path, _) = found.map_err(|error| match error {
        ConnectError::Start => {
            DriveError::Start { touch: Exact::new(&mechanism, surroundings).touch(&request.start.base) }
        }
        ConnectError::Goal { .. } => DriveError::Goal {
            goals: request.goals.len(),
            position_m: request.position_tolerance_m,
            heading_rad: request.heading_tolerance_rad,
        },
        ConnectError::Cancelled => DriveError::Cancelled,
        other => DriveError::NoPath(other),
    })?;
    let joints = limits(robot);
    let path: Vec<JointVector> = path.into_iter().map(JointVector::of).collect();
    let length = length(&path);
    let mut free = |from: &JointVector, to: &JointVector| space.is_free_motion(&state(from), &state(to));
    let trajectory = timed(&joints, &[Section::Blended(path)], request.speed, &mut free);
    let end = trajectory.end();
    Ok(DrivePlan { trajectory: trajectory.named(&joints), end: [end[0], end[1], wrapped(end[2])], length })
}

/// Checks a trajectory for a base that stands where the scene says, with the arm as in `configuration` and `riding` on its deck. Returns it ready to be
/// sampled.
///
/// # Errors
/// The first [`DriveViolation`].
pub fn check_drive(
    robot: &Robot,
    scene: &Scene,
    configuration: &Configuration,
    riding: &[String],
    trajectory: &Trajectory,
) -> Result<Curve, DriveViolation> {
    let joints = limits(robot);
    let trajectory: Curve = Curve::of(&joints, trajectory)?;
    let (here, first) = (configuration.base, trajectory.knots()[0].positions);
    let metres = (here[0] - first[0]).hypot(here[1] - first[1]);
    let radians = wrapped(here[2] - first[2]).abs();
    if metres > START_TOLERANCE || radians > START_TOLERANCE {
        return Err(DriveViolation::Start { metres, radians });
    }
    let slides = [true, true, false];
    check_rest(&joints, &slides, &trajectory)?;
    check_limits(&joints, &slides, &trajectory)?;
    let (vehicle, obstacles) = Vehicle::of(robot, scene, configuration, riding, 0.0);
    let roomy = Vehicle { padding_m: ROOMY_M, ..vehicle.clone() };
    check_way([&vehicle, &roomy], &obstacles, &trajectory)?;
    Ok(trajectory)
}

/// Checks the middle of a piece of the curve: roughly, with clearance for all movement within the piece; where that fails, exactly, in ever shorter pieces
/// until nothing moves by more than [`RESOLUTION_M`].
fn check_way(
    [vehicle, roomy]: [&Vehicle; 2],
    obstacles: &[Obstacle],
    trajectory: &Curve,
) -> Result<(), DriveViolation> {
    let (mechanism, padded) = (vehicle.mechanism(), roomy.mechanism());
    let mut space = Space::new(&padded, obstacles);
    let exact = Exact::new(&mechanism, obstacles);
    let reach = vehicle.bodies.iter().map(|b| b.pose.position[0].hypot(b.pose.position[1]) + b.geometry.radius());
    let reach = reach.fold(0.0, f64::max);
    let look = |time_s: f64, place: &[f64]| match exact.touch(place) {
        None => Ok(()),
        Some(touch) => Err(DriveViolation::Touch { time_s, touch }),
    };
    let knots = trajectory.knots();
    look(0.0, &knots[0].positions)?;
    for (i, pair) in knots.windows(2).enumerate() {
        let cubics = trajectory.cubics(i);
        // In order of time: the last piece is taken first.
        let mut pieces = vec![[0.0, pair[1].time_s - pair[0].time_s]];
        while let Some([from, to]) = pieces.pop() {
            let middle = (from + to) / 2.0;
            let place = cubics.map(|cubic| cubic.position_at(middle));
            let [x, y, heading] = std::array::from_fn(|j: usize| {
                let [least, greatest] = cubics[j].range(from, to);
                (place[j] - least).max(greatest - place[j])
            });
            let moves_m = x.hypot(y) + reach * heading;
            if moves_m <= roomy.padding_m && space.is_free(&state(&place)) {
                continue;
            }
            if moves_m <= roomy.padding_m {
                look(pair[0].time_s + middle, &place)?;
            }
            if moves_m > RESOLUTION_M {
                pieces.extend([[middle, to], [from, middle]]);
            }
        }
    }
    let end = &knots[knots.len() - 1];
    look(end.time_s, &end.positions)
}

/// The base's joints within its drive area; a heading without limits gets the range of a trajectory.
fn limits(robot: &Robot) -> Vec<Joint> {
    let mut joints = robot.base_joints().to_vec();
    if let (Some((_, None)), Some(heading)) = (robot.drive_area(), joints.last_mut()) {
        (heading.lower, heading.upper) = (-2.0 * TAU, 2.0 * TAU);
    }
    joints
}

impl DriveRequest {
    fn check(&self, robot: &Robot) -> Result<(), DriveError> {
        let malformed = |what: &str, value: String, expected: String| {
            Err(DriveError::Malformed { what: what.to_owned(), value, expected })
        };
        if let Some(Outside { joint, position, range }) = outside_of_limits(robot, &self.start) {
            return malformed(&format!("the start's {joint}"), position.to_string(), range);
        }
        if !(MIN_SPEED..=1.0).contains(&self.speed) {
            return malformed("speed", self.speed.to_string(), format!("a fraction from {MIN_SPEED} to 1"));
        }
        let tolerances = [
            ("position_tolerance_m", self.position_tolerance_m, "m"),
            ("heading_tolerance_rad", self.heading_tolerance_rad, "rad"),
        ];
        for (what, value, unit) in tolerances {
            if !(0.0..=MAX_TOLERANCE).contains(&value) {
                return malformed(what, value.to_string(), format!("0 to {MAX_TOLERANCE} {unit}"));
            }
        }
        if let Some(within) = self.seen.as_ref().map(|seen| seen.known_within_m)
            && !(0.0..=MAX_RADIUS_M).contains(&within)
        {
            return malformed("cloud_known_within_m", within.to_string(), format!("0 to {MAX_RADIUS_M} m"));
        }
        if !(1..=MAX_GOALS).contains(&self.goals.len()) {
            return malformed("the number of goals", self.goals.len().to_string(), format!("1 to {MAX_GOALS}"));
        }
        let finite = |place: &[f64; 3]| place.iter().all(|c| c.is_finite());
        match self.goals.iter().chain([&self.start.base]).find(|place| !finite(place)) {
            Some(place) => malformed("a place", format!("{place:?}"), "finite numbers".to_owned()),
            None => Ok(()),
        }
    }

    /// Random places within the tolerance of the goals.
    fn around(&self) -> Vec<[f64; 3]> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        let place = |i: usize| {
            let [x, y, heading] = self.goals[i % self.goals.len()];
            let (angle, share) = (random.random_range(0.0..TAU), random.random_range(0.0_f64..=1.0).sqrt());
            let away = self.position_tolerance_m * share;
            let turn = self.heading_tolerance_rad * random.random_range(-1.0..=1.0);
            [x + away * angle.cos(), y + away * angle.sin(), heading + turn]
        };
        (0..PLACES).map(place).collect()
    }
}

fn touching(touch: Option<&Touch>) -> String {
    touch.map_or(String::new(), |touch| format!("; {touch}"))
}
