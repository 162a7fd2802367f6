//! A robot's arm among the objects of a scene, as the vector checks need it.
//!
//! A [`Mechanism`] of the arm's joints in the frame of the base. What the arm moves (links, hand, fingers, held objects) is covered by spheres;
//! what it does not move (base, mast, the objects of the scene) are obstacles. The spheres stand out of the shapes by at most [`OVERHANG_M`] and
//! hold them with at least [`CLEARANCE_M`] to spare. So a posture that the exact check with a padding of `OVERHANG_M` finds free of obstacles is
//! also free by the spheres, and what the spheres find free is free by the exact check with `CLEARANCE_M`.

use crate::endless::WithEnds;
use crate::joint_vector::JointVector;
use crate::line::{self, LineError};
use crate::mechanism::Mechanism;
use crate::pairs::Pair;
use crate::reach::Reach;
use crate::robot::{Body, Configuration, Geometry, Link, Robot};
use crate::space::{Obstacle, Space, State};
use crate::spheres::cover_within;
use crate::surroundings::Surroundings;
use ratn_model::pose::Pose;
use ratn_world::scene::{Placement, Scene};
use std::collections::BTreeSet;

/// Maximum distance by which the spheres stand out of a shape, in metres, unless the shape is very long.
pub const OVERHANG_M: f64 = 0.01;

/// Minimum clearance of the spheres around a shape, in metres.
pub const CLEARANCE_M: f64 = 0.002;

/// The arm in a scene. Motions that the space finds free are also free between their postures.
pub fn space<'s>(mechanism: &Mechanism, surroundings: impl Into<Surroundings<'s>>) -> Space {
    let mut space = Space::new(mechanism, surroundings);
    space.set_swept(true);
    space
}

/// The arm with what it holds. Each held object is a link of its own, named `held` and the object's name, after the links of the robot and in the
/// scene's order. All links have their exact shapes. Everything but the arm is as in `here`.
///
/// Every check of the arm takes its pairs of links from here ([`Mechanism::is_checked`]).
pub fn holding(robot: &Robot, scene: &Scene, here: &Configuration) -> Mechanism {
    let mut arm = robot.arm(here);
    // The gripper and the held object may touch each other.
    let mut grips: Vec<usize> = (0..arm.links.len()).filter(|l| is_gripper(robot, *l)).collect();
    for object in &scene.objects {
        if let Placement::Gripper(pose) = &object.placement {
            let body = Geometry::from(&object.shape).at(*pose);
            grips.push(arm.attach(&format!("held {}", object.name), robot.tool, vec![body], &grips));
        }
    }
    arm
}

/// The arm and the obstacles around it, in the frame of the base. Everything but arm and base is as in `here`; the base is where the scene has it.
pub fn in_scene(robot: &Robot, scene: &Scene, here: &Configuration) -> (Mechanism, Vec<Obstacle>) {
    let BySpheres { arm, mut standing, .. } = BySpheres::of(robot, from_base(robot, scene, here));
    standing.extend(objects(robot, scene));
    (arm, standing)
}

/// As [`holding`], in the frame of the base.
pub(crate) fn from_base(robot: &Robot, scene: &Scene, here: &Configuration) -> Mechanism {
    holding(robot, scene, &Configuration { base: [0.0; 3], ..*here })
}

/// The scene's objects that are not held, in the frame of the base.
pub(crate) fn objects(robot: &Robot, scene: &Scene) -> Vec<Obstacle> {
    let inverse = on_floor(robot, &scene.base).inverse();
    let standing = scene.objects.iter().filter_map(|object| match &object.placement {
        // Held objects are in `holding`; `hands` has the poses of the others.
        Placement::World(pose) => {
            let geometry = Geometry::from(&object.shape);
            Some(Obstacle { name: object.name.clone(), pose: inverse.compose(pose), geometry })
        }
        _ => None,
    });
    standing.collect()
}

/// An arm as the vector checks see it.
pub(crate) struct BySpheres {
    /// The moving links, covered by spheres.
    pub(crate) arm: Mechanism,
    /// The primitives of links that do not move.
    pub(crate) standing: Vec<Obstacle>,
    /// The link of each primitive in `standing`.
    pub(crate) links: Vec<usize>,
}

impl BySpheres {
    /// From an arm whose links have their exact shapes. Pairs of links that the spheres of meshes cannot decide are not checked.
    pub(crate) fn of(robot: &Robot, mut arm: Mechanism) -> BySpheres {
        let resting = arm.poses(&JointVector::zeros(arm.joints.len()));
        let (moving, standing): (Vec<usize>, Vec<usize>) =
            (0..arm.links.len()).partition(|link| *link >= robot.model.links.len() || robot.arm_links.contains(link));
        let (mut obstacles, mut links, carriers) = (Vec::new(), Vec::new(), arm.carriers());
        for index in standing {
            let is_beside =
                |link: &usize| !arm.is_checked_among(&carriers, *link, index) || arm.is_by_meshes(*link, index);
            let beside: Vec<usize> = moving.iter().copied().filter(is_beside).collect();
            let link = &mut arm.links[index];
            link.spheres.clear();
            link.meshes.clear();
            link.covers = 0;
            for (i, body) in std::mem::take(&mut link.bodies).into_iter().enumerate() {
                // No object of a scene has a name with a control character.
                let name = format!("link {} {i}\0", arm.links[index].name);
                arm.allowed.extend(beside.iter().map(|link| (*link, name.clone())));
                obstacles.push(Obstacle {
                    name,
                    pose: resting[index].compose(&body.upright()),
                    geometry: body.geometry,
                });
                links.push(index);
            }
        }
        for link in moving {
            cover(&mut arm.links[link]);
        }
        BySpheres { arm, standing: obstacles, links }
    }
}

/// Pairs of links, at least one moved by the arm, that are to be kept apart but that the vector checks skip, because spheres cannot decide them.
/// The primitives of links that do not move are checked exactly.
pub(crate) fn unseen(robot: &Robot, arm: &Mechanism) -> BTreeSet<Pair> {
    let moves = |link: &usize| robot.arm_links.contains(link);
    let is_unseen = |(a, b): &&Pair| moves(a) && moves(b) || arm.is_by_meshes(*a, *b);
    let by_shapes = arm.by_shapes.iter().filter(|(a, b)| arm.is_checked(*a, *b));
    by_shapes.filter(is_unseen).copied().collect()
}

/// The kinematics of the tool in the frame of the base. Continuous joints may turn one whole turn from zero, to either side.
pub fn reach(robot: &Robot) -> Reach {
    let zero = robot.at_zero();
    let arm = WithEnds::about(robot, &zero.arm).map_or_else(|| robot.arm(&zero), |arm| arm.robot.arm(&zero));
    Reach::new(&arm, robot.tool, Pose::IDENTITY)
}

/// The configuration assumed from a scene alone: the base is where the scene has it, the fingers are around the held object or else open, the head
/// looks straight ahead, and the arm is at zero.
pub fn assumed(robot: &Robot, scene: &Scene) -> Configuration {
    Configuration { finger: finger_around_held(robot, scene), ..robot.at_zero().with_base(&scene.base) }
}

/// The base's position and heading on the floor. A robot without base joints stands where its URDF puts it, whatever the scene says.
pub fn on_floor(robot: &Robot, base: &Pose) -> Pose {
    if robot.base_joints().is_empty() {
        return Pose::IDENTITY;
    }
    let [x, y, yaw] = crate::robot::on_floor(base);
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, yaw)
}

/// Position of each finger around the held object, or open, in metres from the middle.
fn finger_around_held(robot: &Robot, scene: &Scene) -> f64 {
    let open = robot.open_finger_m();
    // The fingers close along the tool's y.
    let halves = scene.objects.iter().filter_map(|object| match &object.placement {
        Placement::Gripper(pose) => Some(Geometry::from(&object.shape).extents(pose)[1]),
        _ => None,
    });
    halves.take(1).fold(open, f64::min)
}

/// Whether a link is the hand or carried by it: a finger, or what is fixed to one of them.
pub(crate) fn is_gripper(robot: &Robot, link: usize) -> bool {
    let mut above = std::iter::successors(Some(link), |link| robot.model.links[*link].parent);
    robot.hand().is_some_and(|hand| above.any(|link| link == hand))
}

/// Covers the bodies of a link with spheres.
fn cover(link: &mut Link) {
    let grown = |body: &Body| Body { geometry: body.geometry.grown(CLEARANCE_M), ..*body };
    link.spheres = link.bodies.iter().flat_map(|body| cover_within(&grown(body), OVERHANG_M - CLEARANCE_M)).collect();
    link.padding_m = CLEARANCE_M;
}

/// Postures along the straight line of the tool from `start` by `offset` (in the frame of the base, metres), its rotation kept; the first
/// is `start`.
///
/// # Errors
/// [`LineError`] where limits or a singular posture end the line early.
pub fn line(reach: &Reach, start: &JointVector, offset: [f64; 3]) -> Result<Vec<JointVector>, LineError> {
    line::line(reach, start, &moved(reach, start, offset))
}

/// As `line`, but with the nearest postures only, each solved from the one before.
///
/// # Errors
/// [`LineError`] where limits or a singular posture end the line early.
pub fn line_of_nearest(reach: &Reach, start: &JointVector, offset: [f64; 3]) -> Result<Vec<JointVector>, LineError> {
    line::line_of_nearest(reach, start, &moved(reach, start, offset))
}

/// The tool's pose in `start`, moved by `offset`.
pub(crate) fn moved(reach: &Reach, start: &JointVector, offset: [f64; 3]) -> Pose {
    let tool = reach.pose(start);
    Pose { position: std::array::from_fn(|i| tool.position[i] + offset[i]), ..tool }
}

/// A posture of the vector checks as joint positions, within the arm's limits.
pub fn joints(robot: &Robot, state: &State) -> JointVector {
    robot.clamp(&JointVector::from_fn(robot.arm_joints().len(), |j| f64::from(state[j])))
}
