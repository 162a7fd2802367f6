//! Reading a robot's description: its links, parents first, what moves them, and the limits of its joints.

use crate::geometry::{Body, Geometry};
use crate::mesh::{Mesh, MeshError, Meshed};
use crate::robot_model::{Drive, Joint, Link};
use crate::spheres;
use crate::urdf_faults;
use crate::urdf_faults::UrdfFault;
use ratn_model::pose::Pose;
use std::collections::BTreeSet;
use std::sync::Arc;

/// A URDF that does not describe this kind of robot.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// Not a URDF, and where.
    #[error("the robot description is not valid URDF: {0}")]
    Fault(#[from] UrdfFault),
    /// Not a URDF for another reason.
    #[error("the robot description is not valid URDF")]
    Urdf(#[from] urdf_rs::UrdfError),
    /// A joint or link that must be there is not.
    #[error("the robot description has no {what} `{name}`")]
    Missing {
        /// Link or joint.
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// A mesh that cannot be used.
    #[error("the mesh `{file}` of link `{link}`: {source}")]
    Mesh {
        /// The link.
        link: String,
        /// As the description names it.
        file: String,
        /// What is wrong.
        #[source]
        source: MeshError,
    },
    /// Something this model does not support.
    #[error("{what} `{name}` of the robot description is not supported: {reason}")]
    Unsupported {
        /// Link or joint.
        what: &'static str,
        /// Its name.
        name: String,
        /// Why not.
        reason: &'static str,
    },
}

/// What a text describes.
///
/// # Errors
/// [`RobotError::Fault`] names the line.
fn parse(text: &str) -> Result<urdf_rs::Robot, RobotError> {
    urdf_faults::check(text)?;
    Ok(urdf_rs::read_from_string(text)?)
}

/// What a URDF describes.
pub(crate) struct Description {
    pub(crate) name: String,
    /// Those with a position of their own.
    pub(crate) joints: Vec<Joint>,
    /// Parents before children; each driven by the index of a joint.
    pub(crate) links: Vec<Link>,
    /// The names of the joints that mimic others.
    pub(crate) mimics: BTreeSet<String>,
}

/// Limits of a joint that has none, in radians: a whole turn.
const ENDLESS_RAD: f64 = std::f64::consts::PI;

/// Where a URDF names no acceleration, the speed is reached in this time, in seconds.
const TIME_TO_SPEED_S: f64 = 0.25;

/// Where a URDF names no jerk, the full acceleration is reached in this time, in seconds.
const TIME_TO_ACCELERATION_S: f64 = 0.1;

/// Reads a description; `load` gives what is in a mesh file.
///
/// # Errors
/// [`RobotError`] names the link or joint.
pub(crate) fn read(text: &str, load: &mut Loader<'_>) -> Result<Description, RobotError> {
    let urdf = parse(text)?;
    let moves = |j: &&urdf_rs::Joint| j.joint_type != urdf_rs::JointType::Fixed && j.mimic.is_none();
    let joints: Vec<Joint> = urdf.joints.iter().filter(moves).map(joint).collect();
    let links = links(&urdf, &joints, load)?;
    let mimics = urdf.joints.iter().filter(|j| j.mimic.is_some()).map(|j| j.name.clone()).collect();
    Ok(Description { name: urdf.name, joints, links, mimics })
}

/// A joint with its limits; what is not given is taken from what is.
fn joint(joint: &urdf_rs::Joint) -> Joint {
    let limit = &joint.limit;
    let endless = joint.joint_type == urdf_rs::JointType::Continuous;
    let (lower, upper) = if endless { (-ENDLESS_RAD, ENDLESS_RAD) } else { (limit.lower, limit.upper) };
    let proper = |given: f64| given > 0.0 && given.is_finite();
    let velocity = if limit.velocity > 0.0 { limit.velocity } else { 1.0 };
    let acceleration = if proper(limit.acceleration) { limit.acceleration } else { velocity / TIME_TO_SPEED_S };
    let jerk = if proper(limit.jerk) { limit.jerk } else { acceleration / TIME_TO_ACCELERATION_S };
    Joint { name: joint.name.clone(), lower, upper, velocity, acceleration, jerk }
}

/// All links, breadth first from the root: parents come before children.
fn links(urdf: &urdf_rs::Robot, joints: &[Joint], load: &mut Loader<'_>) -> Result<Vec<Link>, RobotError> {
    let children: BTreeSet<&str> = urdf.joints.iter().map(|j| j.child.link.as_str()).collect();
    let root = urdf.links.iter().find(|l| !children.contains(l.name.as_str()));
    let root = root.ok_or_else(|| RobotError::Missing { what: "link", name: "without a parent".to_owned() })?;
    let mut links = vec![link(root, None, Pose::IDENTITY, None, load)?];
    let mut next = 0;
    while next < links.len() {
        let parent = links[next].name.clone();
        for joint in urdf.joints.iter().filter(|j| j.parent.link == parent) {
            let name = &joint.child.link;
            let child = urdf.links.iter().find(|l| l.name == *name);
            let child = child.ok_or_else(|| RobotError::Missing { what: "link", name: name.clone() })?;
            if links.iter().any(|l| l.name == *name) {
                let reason = "a link has two parents";
                return Err(RobotError::Unsupported { what: "link", name: name.clone(), reason });
            }
            let (origin, drive) = drive(urdf, joints, joint)?;
            links.push(link(child, Some(next), origin, drive, load)?);
        }
        next += 1;
    }
    Ok(links)
}

fn link(
    link: &urdf_rs::Link,
    parent: Option<usize>,
    origin: Pose,
    drive: Option<Drive>,
    load: &mut Loader<'_>,
) -> Result<Link, RobotError> {
    let (bodies, meshes) = shapes(link, load)?;
    let spheres = bodies.iter().flat_map(spheres::cover).chain(meshes.iter().flat_map(|m| m.cover(0.0))).collect();
    Ok(Link { bodies, meshes, spheres, ..Link::bare(&link.name, parent, origin, drive) })
}

/// Where a joint is, and what moves it.
fn drive(urdf: &urdf_rs::Robot, joints: &[Joint], joint: &urdf_rs::Joint) -> Result<(Pose, Option<Drive>), RobotError> {
    let origin = origin(&joint.origin);
    let unsupported = |reason| RobotError::Unsupported { what: "joint", name: joint.name.clone(), reason };
    let slides = match joint.joint_type {
        urdf_rs::JointType::Fixed => return Ok((origin, None)),
        urdf_rs::JointType::Prismatic => true,
        urdf_rs::JointType::Revolute | urdf_rs::JointType::Continuous => false,
        _ => return Err(unsupported("only fixed, revolute, continuous and prismatic joints are known")),
    };
    let length = joint.axis.xyz.0.iter().map(|c| c * c).sum::<f64>().sqrt();
    if length < 1e-9 {
        return Err(unsupported("its axis has no length"));
    }
    let axis = joint.axis.xyz.0.map(|c| c / length);
    let Followed { driver, factor, offset } = followed(urdf, joint)?;
    let still = Drive { joint: 0, axis, slides, factor: 1.0 };
    let origin = if offset == 0.0 { origin } else { origin.compose(&still.moved(offset)) };
    let index = joints.iter().position(|joint| joint.name == driver.name);
    Ok((origin, index.map(|joint| Drive { joint, factor, ..still })))
}

/// What a joint's position is made of: that of a joint that mimics none, times a factor, and an offset.
struct Followed<'u> {
    driver: &'u urdf_rs::Joint,
    factor: f64,
    offset: f64,
}

/// Follows mimics to the joint at the end of their chain.
fn followed<'u>(urdf: &'u urdf_rs::Robot, joint: &'u urdf_rs::Joint) -> Result<Followed<'u>, RobotError> {
    let mut followed = Followed { driver: joint, factor: 1.0, offset: 0.0 };
    for _ in 0..=urdf.joints.len() {
        let Some(mimic) = &followed.driver.mimic else { return Ok(followed) };
        let missing = || RobotError::Missing { what: "joint", name: mimic.joint.clone() };
        followed.driver = urdf.joints.iter().find(|j| j.name == mimic.joint).ok_or_else(missing)?;
        followed.offset += followed.factor * mimic.offset.unwrap_or(0.0);
        followed.factor *= mimic.multiplier.unwrap_or(1.0);
    }
    let reason = "it mimics itself, directly or through other joints";
    Err(RobotError::Unsupported { what: "joint", name: joint.name.clone(), reason })
}

/// The primitives and the meshes of a link; `load` gives what is in the file of a name.
fn shapes(link: &urdf_rs::Link, load: &mut Loader<'_>) -> Result<(Vec<Body>, Vec<Meshed>), RobotError> {
    let (mut bodies, mut meshes) = (Vec::new(), Vec::new());
    for collision in &link.collision {
        let pose = origin(&collision.origin);
        if let Some(geometry) = primitive(&collision.geometry) {
            bodies.push(geometry.at(pose));
        } else if let urdf_rs::Geometry::Mesh { filename, scale } = &collision.geometry {
            let failed = |source| RobotError::Mesh { link: link.name.clone(), file: filename.clone(), source };
            let scale = scale.map_or([1.0; 3], |scale| scale.0);
            let mesh = load(filename).and_then(|bytes| Mesh::read(filename, &bytes, scale)).map_err(failed)?;
            meshes.push(Meshed { pose, mesh: Arc::new(mesh) });
        }
    }
    Ok((bodies, meshes))
}

/// What is in a mesh file.
pub(crate) type Loader<'l> = dyn FnMut(&str) -> Result<Vec<u8>, MeshError> + 'l;

fn primitive(geometry: &urdf_rs::Geometry) -> Option<Geometry> {
    Some(match geometry {
        urdf_rs::Geometry::Box { size } => Geometry::Box { half: size.0.map(|s| s / 2.0) },
        urdf_rs::Geometry::Cylinder { radius, length } => {
            Geometry::Cylinder { radius: *radius, half_length: length / 2.0 }
        }
        urdf_rs::Geometry::Capsule { radius, length } => {
            Geometry::Capsule { radius: *radius, half_length: length / 2.0 }
        }
        urdf_rs::Geometry::Sphere { radius } => Geometry::Sphere { radius: *radius },
        urdf_rs::Geometry::Mesh { .. } => return None,
    })
}

fn origin(pose: &urdf_rs::Pose) -> Pose {
    let [roll, pitch, yaw] = pose.rpy.0;
    Pose::from_rpy(pose.xyz.0, roll, pitch, yaw)
}
