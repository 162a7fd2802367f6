//! Driving: paths of the base on the floor, in x, y and heading, among obstacles.
//!
//! The base with everything that rides on it, in its current posture, is one body moved by two prismatic joints and a revolute one; the search is
//! that of the arm. A heading is the same after a whole turn, so every goal is offered in several turns, and the nearest is used. Lengths add metres
//! and radians without weights.

use crate::connect::{Budget, ConnectError, connect};
use crate::geometry::Body;
use crate::hands::holder;
use crate::mechanism::Mechanism;
use crate::pace::Control;
use crate::pairs::Checks;
use crate::robot::{Configuration, Drive, Geometry, Joint, Link, Robot};
use crate::simplify::simplify;
use crate::space::{Obstacle, Space, State, state};
use crate::spheres::cover_within;
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};
use std::f64::consts::TAU;

/// Maximum distance by which the spheres may stand out of the vehicle, in metres.
const OVERHANG_M: f64 = 0.03;

/// A vehicle, and where it may drive.
#[derive(Debug, Clone)]
pub struct Vehicle {
    /// Everything that moves with it, in the frame of the base.
    pub bodies: Vec<Body>,
    /// Minimum and maximum x, minimum and maximum y, in metres.
    pub area: [[f64; 2]; 2],
    /// Minimum and maximum heading, in radians; without them it can rotate without end.
    pub heading: Option<[f64; 2]>,
    /// Distance that it keeps from obstacles, in metres.
    pub padding_m: f64,
}

impl Vehicle {
    /// A disc of a radius and a height, standing on the floor, in metres.
    pub fn round(radius: f64, height: f64, area: [[f64; 2]; 2], padding_m: f64) -> Vehicle {
        let geometry = Geometry::Cylinder { radius, half_length: height / 2.0 };
        Vehicle { bodies: vec![geometry.at(Pose::at(0.0, 0.0, height / 2.0))], area, heading: None, padding_m }
    }

    /// A robot in its current posture, with the objects that it holds and those of the scene that ride on it, and the obstacles. It drives in the
    /// robot's area; a robot without a base does not drive.
    pub fn of(
        robot: &Robot,
        scene: &Scene,
        configuration: &Configuration,
        riding: &[String],
        padding_m: f64,
    ) -> (Vehicle, Vec<Obstacle>) {
        let (area, heading) = robot.drive_area().unwrap_or_default();
        let [x, y, yaw] = configuration.base;
        let base = Pose::from_rpy([x, y, 0.0], 0.0, 0.0, yaw).inverse();
        let poses = robot.poses(configuration);
        let links = robot.model.links.iter().zip(&poses);
        let placed = |pose: &Pose, body: &Body| Body { pose: base.compose(pose).compose(&body.pose), ..*body };
        let mut bodies: Vec<Body> =
            links.flat_map(|(link, pose)| link.bodies.iter().map(|body| placed(pose, body))).collect();
        let mut obstacles = Vec::new();
        for object in &scene.objects {
            let geometry = Geometry::from(&object.shape);
            match object.placement {
                Placement::World(pose) if riding.contains(&object.name) => {
                    bodies.push(geometry.at(base.compose(&pose)));
                }
                Placement::World(pose) => obstacles.push(Obstacle { name: object.name.clone(), pose, geometry }),
                _ => bodies.extend(
                    holder(robot, &object.placement).map(|(link, pose)| placed(&poses[link], &geometry.at(pose))),
                ),
            }
        }
        (Vehicle { bodies, area, heading, padding_m }, obstacles)
    }

    /// A heading as a position of its joint: within half a turn of zero, or a turn away if the limits are elsewhere.
    fn heading_of(&self, heading: f64) -> f64 {
        let near = wrapped(heading);
        let within = |turned: &f64| self.heading.is_none_or(|[least, greatest]| (least..=greatest).contains(turned));
        [near, near + TAU, near - TAU].into_iter().find(within).unwrap_or(near)
    }

    pub(crate) fn mechanism(&self) -> Mechanism {
        let [[x_low, x_high], [y_low, y_high]] = self.area;
        let joint = |name: &str, lower, upper| Joint {
            name: name.to_owned(),
            lower,
            upper,
            endless: false,
            velocity: 1.0,
            acceleration: 1.0,
            jerk: 10.0,
        };
        let [least, greatest] = self.heading.unwrap_or([-TAU, TAU]);
        let joints = vec![joint("x", x_low, x_high), joint("y", y_low, y_high), joint("heading", least, greatest)];
        let link = |parent, drive| Link::bare("base", parent, Pose::IDENTITY, drive);
        let slide = |joint, axis| Some(Drive { joint, axis, slides: true, factor: 1.0 });
        let turn = Some(Drive { joint: 2, axis: [0.0, 0.0, 1.0], slides: false, factor: 1.0 });
        let mut links = vec![link(None, slide(0, [1.0, 0.0, 0.0])), link(Some(0), slide(1, [0.0, 1.0, 0.0]))];
        let mut base = link(Some(1), turn);
        base.padding_m = self.padding_m;
        base.bodies.clone_from(&self.bodies);
        let grown = |body: &Body| Body { geometry: body.geometry.grown(self.padding_m), ..*body };
        base.spheres = self.bodies.iter().flat_map(|body| cover_within(&grown(body), OVERHANG_M)).collect();
        links.push(base);
        Mechanism::new("vehicle", joints, links, Checks::default())
    }
}

/// A short path on the floor from `start` to one of `goals`, each x and y in metres and heading in radians; the motions between its places are
/// straight and free. The heading at its end equals a goal's up to whole turns. Also returns the goal's index.
///
/// # Errors
/// [`ConnectError`] says why there is none.
pub fn drive(
    vehicle: &Vehicle,
    obstacles: &[Obstacle],
    start: [f64; 3],
    goals: &[[f64; 3]],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<[f64; 3]>, usize), ConnectError> {
    drive_in(vehicle, &mut Space::new(&vehicle.mechanism(), obstacles), start, goals, budget, control)
}

/// As [`drive`], in the vehicle's space.
pub(crate) fn drive_in(
    vehicle: &Vehicle,
    space: &mut Space,
    start: [f64; 3],
    goals: &[[f64; 3]],
    budget: Budget,
    control: &mut dyn FnMut(usize) -> Control,
) -> Result<(Vec<[f64; 3]>, usize), ConnectError> {
    let offer = |goal: &[f64; 3]| [-TAU, 0.0, TAU].map(|turn| state(&[goal[0], goal[1], wrapped(goal[2]) + turn]));
    let ends: Vec<State> = goals.iter().flat_map(offer).collect();
    let from = state(&[start[0], start[1], vehicle.heading_of(start[2])]);
    let route = match connect(space, &from, &ends, budget, control) {
        Err(ConnectError::Goal { .. }) => return Err(ConnectError::Goal { goals: goals.len() }),
        other => other?,
    };
    let path = simplify(space, &route.path, budget, control)?;
    let places = path.iter().map(|s| [f64::from(s[0]), f64::from(s[1]), f64::from(s[2])]).collect();
    Ok((places, route.goal / 3))
}

/// A heading within half a turn of zero.
pub fn wrapped(heading: f64) -> f64 {
    heading - TAU * (heading / TAU).round()
}
