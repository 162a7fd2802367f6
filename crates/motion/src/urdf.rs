//! Reads a URDF: its links, parents first, the joints that move them, and the limits of these.

use crate::geometry::{Body, Geometry};
use crate::mesh::{Mesh, MeshError, Meshed};
use crate::robot_model::{Drive, Joint, Link};
use crate::spheres;
use crate::urdf_faults::{self, Checked, UrdfFault, is_empty_material};
use crate::urdf_tree::JointText;
use crate::xml_text;
use ratn_model::pose::Pose;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Why a URDF does not describe this kind of robot.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// The text is not a valid URDF, with the place of the error.
    #[error("the robot description is not valid URDF: {0}")]
    Fault(UrdfFault),
    /// The text is not a valid URDF for another reason, without a place.
    #[error("the robot description is not valid URDF: {0}")]
    Urdf(String),
    /// There are more links than can be checked in pairs.
    #[error(
        "the robot description has {count} links: at most {MAX_LINKS} are supported; leave out those that do not matter for collisions"
    )]
    TooManyLinks {
        /// Number of links.
        count: usize,
    },
    /// A required joint or link is missing.
    #[error("the robot description has no {what} `{name}`")]
    Missing {
        /// "link" or "joint".
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// The limits of a mimic joint leave no position for the joint that it mimics.
    #[error(
        "the joint `{name}` mimics `{driver}`, but its limits {} to {} leave `{driver}` no position from {} to {}",
        limits[0], limits[1], driver_limits[0], driver_limits[1]
    )]
    Contradicts {
        /// The mimic joint.
        name: String,
        /// The joint that it mimics.
        driver: String,
        /// The limits of the mimic joint in the URDF.
        limits: [f64; 2],
        /// The limits of the other joint, as narrowed by other mimic joints.
        driver_limits: [f64; 2],
    },
    /// A joint cannot be planned.
    #[error("the joint `{name}` cannot be planned for: {reason}")]
    NotPlannable {
        /// Its name.
        name: String,
        /// The reason.
        reason: String,
    },
    /// A mesh cannot be used.
    #[error("the mesh `{file}` of link `{link}`: {error}")]
    Mesh {
        /// The link.
        link: String,
        /// Its file name in the URDF.
        file: String,
        /// The error.
        error: MeshError,
    },
    /// The URDF has something that this model does not support.
    #[error("{what} `{name}` of the robot description is not supported: {reason}")]
    Unsupported {
        /// "link" or "joint".
        what: &'static str,
        /// Its name.
        name: String,
        /// The reason.
        reason: &'static str,
    },
}

// Without `#[from]`, which would make the fault a source and print it twice.
impl From<UrdfFault> for RobotError {
    fn from(fault: UrdfFault) -> RobotError {
        RobotError::Fault(fault)
    }
}

/// Parses a URDF; also returns where its joints are in the text.
///
/// # Errors
/// [`RobotError::Fault`] gives the line.
pub(crate) fn parse(text: &str) -> Result<(urdf_rs::Robot, BTreeMap<String, JointText>), RobotError> {
    let Checked { joints, has_empty_materials } = urdf_faults::check(text)?;
    let unread = |error: &dyn std::fmt::Display| RobotError::Urdf(error.to_string());
    let filled: Cow<'_, str> = match has_empty_materials {
        true => xml_text::without(text, is_empty_material).map_err(|error| unread(&error))?.into(),
        false => text.into(),
    };
    Ok((urdf_rs::read_from_string(&filled).map_err(|error| unread(&error))?, joints))
}

/// The content of a URDF.
#[derive(Clone)]
pub(crate) struct Description {
    pub(crate) name: String,
    /// The joints that mimic no other.
    pub(crate) joints: Vec<Joint>,
    /// Parents before children; a link's drive has the index of a joint.
    pub(crate) links: Vec<Link>,
    /// The names of the mimic joints.
    pub(crate) mimics: BTreeSet<String>,
    /// The places of the joints in the text.
    pub(crate) texts: BTreeMap<String, JointText>,
}

/// The range of a joint without limits is one turn, from minus this to this, in radians.
const ENDLESS_RAD: f64 = std::f64::consts::PI;

/// If a mesh is larger than this and has no `scale`, its unit is assumed to be millimetres, and it is refused.
const PLAUSIBLE_M: f64 = 25.0;

/// Maximum number of links of a robot: every pair of them is checked in many postures.
const MAX_LINKS: usize = 1_024;

/// Time in which the maximum velocity is reached, in seconds, if a URDF gives no acceleration.
const TIME_TO_SPEED_S: f64 = 0.25;

/// Time in which the maximum acceleration is reached, in seconds, if a URDF gives no jerk.
const TIME_TO_ACCELERATION_S: f64 = 0.1;

/// Reads a URDF; `load` returns the content of a mesh file.
///
/// # Errors
/// [`RobotError`] gives the link or joint.
pub(crate) fn read(text: &str, load: &mut Loader<'_>) -> Result<Description, RobotError> {
    described(parse(text)?, load)
}

/// Reads links and joints without shapes: no mesh file is read.
///
/// # Errors
/// As [`read`], except those of meshes.
pub(crate) fn read_outline(text: &str) -> Result<Description, RobotError> {
    let (mut urdf, texts) = parse(text)?;
    urdf.links.iter_mut().for_each(|link| link.collision.clear());
    described((urdf, texts), &mut |_| Err(MeshError::Kind))
}

fn described(
    (urdf, texts): (urdf_rs::Robot, BTreeMap<String, JointText>),
    load: &mut Loader<'_>,
) -> Result<Description, RobotError> {
    if urdf.links.len() > MAX_LINKS {
        return Err(RobotError::TooManyLinks { count: urdf.links.len() });
    }
    let moves = |j: &&urdf_rs::Joint| j.joint_type != urdf_rs::JointType::Fixed && j.mimic.is_none();
    let mut driving: Vec<(&str, Limits)> =
        urdf.joints.iter().filter(moves).map(|joint| (joint.name.as_str(), Limits::of(joint))).collect();
    let follows = |j: &&urdf_rs::Joint| j.joint_type != urdf_rs::JointType::Fixed && j.mimic.is_some();
    for joint in urdf.joints.iter().filter(follows) {
        let followed = followed(&urdf, joint)?;
        if let Some((_, limits)) = driving.iter_mut().find(|(name, _)| *name == followed.driver.name) {
            limits.narrow(joint, &followed)?;
        }
    }
    // A mimic joint may be elsewhere after a whole turn of the joint that it mimics, so that joint is not treated as continuous.
    let followed: BTreeSet<&str> = urdf.joints.iter().filter_map(|j| Some(j.mimic.as_ref()?.joint.as_str())).collect();
    let turns_on = |j: &&urdf_rs::Joint| j.joint_type == urdf_rs::JointType::Continuous && !followed.contains(&*j.name);
    let endless: BTreeSet<&str> = urdf.joints.iter().filter(turns_on).map(|j| j.name.as_str()).collect();
    let joint = |(name, limits): &(&str, Limits)| Joint { endless: endless.contains(name), ..limits.joint(name) };
    let joints: Vec<Joint> = driving.iter().map(joint).collect();
    let links = links(&urdf, &joints, load)?;
    let mimics = urdf.joints.iter().filter(|j| j.mimic.is_some()).map(|j| j.name.clone()).collect();
    Ok(Description { name: urdf.name, joints, links, mimics, texts })
}

/// The limits of a joint in a URDF.
#[derive(Debug, Clone, Copy)]
struct Limits {
    lower: f64,
    upper: f64,
    velocity: Option<f64>,
    acceleration: Option<f64>,
    jerk: Option<f64>,
}

impl Limits {
    fn of(joint: &urdf_rs::Joint) -> Limits {
        let limit = &joint.limit;
        let proper = |given: f64| Some(given).filter(|given| *given > 0.0 && given.is_finite());
        let endless = joint.joint_type == urdf_rs::JointType::Continuous;
        let (lower, upper) = if endless { (-ENDLESS_RAD, ENDLESS_RAD) } else { (limit.lower, limit.upper) };
        let (velocity, acceleration, jerk) = (proper(limit.velocity), proper(limit.acceleration), proper(limit.jerk));
        Limits { lower, upper, velocity, acceleration, jerk }
    }

    /// Narrows these limits to positions that a mimic joint can follow. An empty range or one with a single position is ignored: some writers leave
    /// the range out, because a mimic joint has no position of its own.
    fn narrow(&mut self, joint: &urdf_rs::Joint, followed: &Followed<'_>) -> Result<(), RobotError> {
        let Followed { driver, factor, offset } = *followed;
        if factor == 0.0 {
            return Ok(());
        }
        let own = Limits::of(joint);
        if joint.joint_type != urdf_rs::JointType::Continuous && own.lower < own.upper {
            let [a, b] = [own.lower, own.upper].map(|limit| (limit - offset) / factor);
            // Adding zero turns -0 into 0.
            let (lower, upper) = (self.lower.max(a.min(b)) + 0.0, self.upper.min(a.max(b)) + 0.0);
            if lower > upper {
                let (name, driver) = (joint.name.clone(), driver.name.clone());
                let (limits, driver_limits) = ([own.lower, own.upper], [self.lower, self.upper]);
                return Err(RobotError::Contradicts { name, driver, limits, driver_limits });
            }
            (self.lower, self.upper) = (lower, upper);
        }
        let least = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b.map(|b| b / factor.abs())).reduce(f64::min);
        self.velocity = least(self.velocity, own.velocity);
        self.acceleration = least(self.acceleration, own.acceleration);
        self.jerk = least(self.jerk, own.jerk);
        Ok(())
    }

    /// A joint with these limits; missing ones are derived from the others.
    fn joint(&self, name: &str) -> Joint {
        let Limits { lower, upper, velocity, acceleration, jerk } = *self;
        let velocity = velocity.unwrap_or(1.0);
        let acceleration = acceleration.unwrap_or(velocity / TIME_TO_SPEED_S);
        let jerk = jerk.unwrap_or(acceleration / TIME_TO_ACCELERATION_S);
        Joint { name: name.to_owned(), lower, upper, endless: false, velocity, acceleration, jerk }
    }
}

/// All links, breadth first from the root, so parents come before children. They are one tree ([`urdf_faults`]).
fn links(urdf: &urdf_rs::Robot, joints: &[Joint], load: &mut Loader<'_>) -> Result<Vec<Link>, RobotError> {
    let named: BTreeMap<&str, &urdf_rs::Link> = urdf.links.iter().map(|link| (link.name.as_str(), link)).collect();
    let mut below: BTreeMap<&str, Vec<&urdf_rs::Joint>> = BTreeMap::new();
    let mut children = BTreeSet::new();
    for joint in &urdf.joints {
        below.entry(&joint.parent.link).or_default().push(joint);
        children.insert(joint.child.link.as_str());
    }
    let missing = |name: &str| RobotError::Missing { what: "link", name: name.to_owned() };
    let root = urdf.links.iter().find(|l| !children.contains(l.name.as_str()));
    let mut links = vec![link(root.ok_or_else(|| missing("without a parent"))?, None, Pose::IDENTITY, None, load)?];
    let mut next = 0;
    while next < links.len() {
        for joint in below.remove(links[next].name.as_str()).into_iter().flatten() {
            let name = joint.child.link.as_str();
            let child = named.get(name).ok_or_else(|| missing(name))?;
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

/// The pose of a joint in its parent link's frame, and its drive.
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

/// A joint's position as that of the joint at the end of its mimic chain, times a factor, plus an offset.
struct Followed<'u> {
    driver: &'u urdf_rs::Joint,
    factor: f64,
    offset: f64,
}

/// Follows a chain of mimic joints to its end.
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

/// The primitives and the meshes of a link; `load` returns the content of a file.
fn shapes(link: &urdf_rs::Link, load: &mut Loader<'_>) -> Result<(Vec<Body>, Vec<Meshed>), RobotError> {
    let (mut bodies, mut meshes) = (Vec::new(), Vec::new());
    for collision in &link.collision {
        let pose = origin(&collision.origin);
        if let Some(geometry) = primitive(&collision.geometry) {
            bodies.push(geometry.at(pose));
        } else if let urdf_rs::Geometry::Mesh { filename, scale } = &collision.geometry {
            let failed = |error| RobotError::Mesh { link: link.name.clone(), file: filename.clone(), error };
            let factors = scale.map_or([1.0; 3], |scale| scale.0);
            let mesh = load(filename).and_then(|bytes| Mesh::read(filename, &bytes, factors)).map_err(failed)?;
            if scale.is_none() && mesh.extent_m() > PLAUSIBLE_M {
                return Err(failed(MeshError::Large { extent_m: mesh.extent_m() }));
            }
            meshes.push(Meshed { pose, mesh: Arc::new(mesh) });
        }
    }
    Ok((bodies, meshes))
}

/// Returns the content of a mesh file.
pub(crate) type Loader<'l> = dyn FnMut(&str) -> Result<Vec<u8>, MeshError> + 'l;

pub(crate) fn primitive(geometry: &urdf_rs::Geometry) -> Option<Geometry> {
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

pub(crate) fn origin(pose: &urdf_rs::Pose) -> Pose {
    let [roll, pitch, yaw] = pose.rpy.0;
    Pose::from_rpy(pose.xyz.0, roll, pitch, yaw)
}
