//! Our robot's arm among the objects of a scene, as the vector checks want it.
//!
//! A [`Mechanism`] of the seven arm joints in the frame of the base. What the arm moves (links, hand, fingers, what is held) has
//! spheres; what it does not move (base, mast, the objects of the scene) are obstacles. The spheres stand out of the shapes by
//! at most [`REACH_M`] and hold them with at least [`ROOM_M`] to spare. So what the exact check with a padding of `REACH_M`
//! finds clear of obstacles the spheres do too, and what the spheres find free is free by the exact check with `ROOM_M`.

use crate::mechanism::{Drive, MAX_JOINTS, Mechanism, Part};
use crate::reach::{Positions, Reach};
use crate::robot::{Body, Configuration, Geometry, Joints, Link, Motion, Robot};
use crate::space::{Obstacle, Space, State};
use crate::spheres::cover_within;
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene, Shape};
use std::collections::BTreeSet;

/// How far the spheres stand out of a shape at most, in metres, unless the shape is very long.
pub const REACH_M: f64 = 0.01;

/// How much room they leave around it at least, in metres.
pub const ROOM_M: f64 = 0.002;

/// Index of the first arm joint among the robot's degrees of freedom.
const FIRST_ARM_JOINT: usize = 3;

/// The degrees of freedom that the fingers follow.
const FINGER: usize = 12;

/// The arm in a scene; motions that the space finds free are free also between their postures.
pub fn space(mechanism: &Mechanism, obstacles: &[Obstacle]) -> Space {
    let mut space = Space::new(mechanism, obstacles);
    space.set_swept(true);
    space
}

/// The arm and what is around it, in the frame of the base, each finger `finger` metres from the middle, the camera looking
/// ahead.
pub fn in_scene(robot: &Robot, scene: &Scene, finger: f64) -> (Mechanism, Vec<Obstacle>) {
    let mut obstacles = Vec::new();
    let resting = robot.poses(&Configuration { finger, ..Configuration::ZERO });
    let mut links = Vec::new();
    let mut allowed = BTreeSet::new();
    for (index, link) in robot.links.iter().enumerate() {
        let (origin, drive) = placed(link, finger);
        let moves = robot.arm_links.contains(&index);
        let bodies = if moves { link.bodies.clone() } else { Vec::new() };
        links.push(part(&link.name, link.parent, origin, drive, bodies));
        if moves {
            continue;
        }
        for (i, body) in link.bodies.iter().enumerate() {
            let name = format!("link {} {i}", link.name);
            let beside = robot.arm_links.iter().filter(|a| is_neighbour(robot, **a, index));
            allowed.extend(beside.map(|a| (*a, name.clone())));
            obstacles.push(Obstacle { name, pose: resting[index].compose(&body.upright()), geometry: body.geometry });
        }
    }
    let inverse = on_floor(&scene.base).inverse();
    let mut grips: Vec<usize> = (0..links.len()).filter(|l| is_gripper(robot, *l)).collect();
    for object in &scene.objects {
        let geometry = Geometry::from(&object.shape);
        match &object.placement {
            Placement::World(pose) => {
                obstacles.push(Obstacle { name: object.name.clone(), pose: inverse.compose(pose), geometry });
            }
            Placement::Gripper(pose) => {
                grips.push(links.len());
                let name = format!("held {}", object.name);
                links.push(part(&name, Some(robot.tool), Pose::IDENTITY, None, vec![geometry.at(*pose)]));
            }
        }
    }
    let joints = robot.arm_joints().to_vec();
    let pairs = (0..links.len()).flat_map(|b| (0..b).map(move |a| (a, b)));
    let touching = |&(a, b): &(usize, usize)| {
        let neighbours = |a, b| b < robot.links.len() && is_neighbour(robot, a, b);
        grips.contains(&a) && grips.contains(&b) || neighbours(a, b)
    };
    let disabled = pairs.filter(touching).collect();
    (Mechanism { name: "arm".to_owned(), joints, links, disabled, allowed }, obstacles)
}

/// The tool of the arm in the frame of the base.
pub fn reach(robot: &Robot) -> Reach {
    let bare = |link: &Link| {
        let (origin, drive) = placed(link, 0.0);
        part(&link.name, link.parent, origin, drive, Vec::new())
    };
    let links = robot.links.iter().map(bare).collect();
    let (joints, disabled, allowed) = (robot.arm_joints().to_vec(), BTreeSet::new(), BTreeSet::new());
    let mechanism = Mechanism { name: "arm".to_owned(), joints, links, disabled, allowed };
    Reach::new(&mechanism, robot.tool, Pose::IDENTITY)
}

/// Where a link sits in its parent's frame, each finger `finger` metres from the middle, and which joint of the arm moves it.
fn placed(link: &Link, finger: f64) -> (Pose, Option<Drive>) {
    match link.motion {
        Motion::Turn { axis, joint } if (FIRST_ARM_JOINT..FIRST_ARM_JOINT + 7).contains(&joint) => {
            (link.origin, Some(Drive { joint: joint - FIRST_ARM_JOINT, axis, slides: false }))
        }
        Motion::Slide { axis, joint: FINGER } => {
            let [x, y, z] = axis.map(|c| c * finger);
            (link.origin.compose(&Pose::at(x, y, z)), None)
        }
        _ => (link.origin, None),
    }
}

/// The base's place and heading on the floor.
pub fn on_floor(base: &Pose) -> Pose {
    let [x, y, yaw] = Configuration::ZERO.with_base(base).base;
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, yaw)
}

/// Where the fingers are around what is held, else open: each this far from the middle, in metres.
pub fn finger_around_held(robot: &Robot, scene: &Scene) -> f64 {
    let open = robot.finger().upper;
    let widths = scene.objects.iter().filter_map(|object| match (&object.placement, &object.shape) {
        (Placement::Gripper(pose), Shape::Box { size }) => {
            let axis = pose.inverse().rotate([0.0, 1.0, 0.0]);
            Some((0..3).map(|i| axis[i].abs() * size[i]).sum::<f64>())
        }
        (Placement::Gripper(_), Shape::Cylinder { radius, .. }) => Some(2.0 * radius),
        _ => None,
    });
    widths.map(|w| w / 2.0).next().map_or(open, |finger| finger.min(open))
}

/// Whether a link is the hand or hangs on it.
fn is_gripper(robot: &Robot, link: usize) -> bool {
    let hand = robot.link("hand");
    hand.is_some() && (Some(link) == hand || robot.links[link].parent == hand)
}

/// Whether two links are made to touch: at most one small link with a shape is between them.
pub(crate) fn is_neighbour(robot: &Robot, a: usize, b: usize) -> bool {
    let solid_parent = |mut link: usize| {
        while let Some(parent) = robot.links[link].parent {
            if !robot.links[parent].bodies.is_empty() {
                return Some(parent);
            }
            link = parent;
        }
        None
    };
    // A short link between two long ones hides their contact: the wrist's ball, the flange.
    let close = |child: usize, parent: usize| {
        solid_parent(child) == Some(parent)
            || solid_parent(child).is_some_and(|middle| {
                let small = robot.links[middle].bodies.iter().all(|body| body.geometry.radius() < 0.07);
                small && solid_parent(middle) == Some(parent)
            })
    };
    a == b || close(a, b) || close(b, a)
}

fn part(name: &str, parent: Option<usize>, origin: Pose, drive: Option<Drive>, bodies: Vec<Body>) -> Part {
    let grown = |body: &Body| Body { geometry: body.geometry.grown(ROOM_M), ..*body };
    let spheres = bodies.iter().flat_map(|body| cover_within(&grown(body), REACH_M - ROOM_M)).collect();
    Part { name: name.to_owned(), parent, origin, drive, bodies, meshes: Vec::new(), padding_m: ROOM_M, spheres }
}

/// A posture for the vector checks.
pub fn state(arm: &Joints) -> State {
    let mut state = [0.0; MAX_JOINTS];
    for (to, from) in state.iter_mut().zip(arm) {
        *to = *from as f32;
    }
    state
}

/// A posture as [`Reach`] wants it.
pub fn positions(arm: &Joints) -> Positions {
    let mut positions = [0.0; MAX_JOINTS];
    positions[..7].copy_from_slice(arm);
    positions
}

/// A posture of the vector checks, within the arm's limits.
pub fn joints(robot: &Robot, state: &State) -> Joints {
    robot.clamp(&std::array::from_fn(|j| f64::from(state[j])))
}
