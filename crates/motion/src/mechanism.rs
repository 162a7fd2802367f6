//! Any robot, from its URDF and SRDF: a tree of links moved by the joints that are planned for, bounding spheres for the fast
//! checks, the exact shapes for the others, and the pairs of links that may meet.
//!
//! Joints that are not planned for stay at zero, or at the limit next to it. Without an SRDF, links that are neighbours or
//! that meet at the middle of all limits are taken as made so.

use crate::frame::compose;
use crate::geometry::Body;
use crate::mesh::{MeshError, Meshed};
use crate::robot::{Joint, jerk};
use crate::spheres::{self, Sphere};
use crate::urdf::{self, Loader, RobotError};
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Joints that can be planned for at once.
pub const MAX_JOINTS: usize = 16;

/// How far beyond a limit a position is taken as rounded, in radians (metres for a joint that slides).
pub const ROUNDED: f64 = 1e-4;

/// Limits of a joint that has none, in radians: a whole turn.
const ENDLESS_RAD: f64 = std::f64::consts::PI;

/// Where a URDF names no acceleration, the speed is reached in this time, in seconds.
const TIME_TO_SPEED_S: f64 = 0.25;

/// A robot.
#[derive(Debug, Clone)]
pub struct Mechanism {
    /// As in the URDF.
    pub name: String,
    /// What is planned for, in the caller's order.
    pub joints: Vec<Joint>,
    /// Parents before children.
    pub links: Vec<Part>,
    /// Pairs of links, the lower index first, that are never checked against each other.
    pub disabled: BTreeSet<(usize, usize)>,
    /// Links and the names of obstacles that they may touch.
    pub allowed: BTreeSet<(usize, String)>,
}

/// A position that is beyond a limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Beyond {
    /// The joint's name.
    pub joint: String,
    /// As given, in radians (metres for one that slides).
    pub position: f64,
    /// How far beyond.
    pub by: f64,
}

impl fmt::Display for Beyond {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Beyond { joint, position, by } = self;
        write!(f, "{joint} is at {position}, beyond the limit by {by:.2e}; taken as the limit")
    }
}

/// A rigid link.
#[derive(Debug, Clone)]
pub struct Part {
    /// As in the URDF.
    pub name: String,
    /// The link it hangs on.
    pub parent: Option<usize>,
    /// Where its joint sits in the parent's frame.
    pub origin: Pose,
    /// The planned joint that moves it.
    pub drive: Option<Drive>,
    /// What can collide, exactly: primitives,
    pub bodies: Vec<Body>,
    /// and meshes.
    pub meshes: Vec<Meshed>,
    /// How much larger its bodies are taken, in metres.
    pub padding_m: f64,
    /// Spheres that hold all of it, padding included.
    pub spheres: Vec<Sphere>,
}

/// How a planned joint moves a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive {
    /// Index of the joint.
    pub joint: usize,
    /// Unit vector.
    pub axis: [f64; 3],
    /// Along the axis instead of about it.
    pub slides: bool,
}

/// Why there is no robot.
#[derive(Debug, thiserror::Error)]
pub enum MechanismError {
    /// The URDF says nothing that can be used.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// The SRDF is not XML.
    #[error("the SRDF is not valid XML: {0}")]
    Srdf(String),
    /// A joint that is named twice.
    #[error("the joint `{joint}` is named twice among those to be planned for")]
    Twice {
        /// Its name.
        joint: String,
    },
    /// Too many joints.
    #[error("{count} joints are to be planned for: at most {MAX_JOINTS} are supported")]
    TooMany {
        /// How many.
        count: usize,
    },
}

impl Mechanism {
    /// Reads a robot without meshes; `joints` are planned for, without any all that move and follow no other.
    ///
    /// # Errors
    /// [`MechanismError`] names the joint or link that is missing or not supported.
    pub fn read(urdf: &str, srdf: Option<&str>, joints: &[String]) -> Result<Mechanism, MechanismError> {
        let nowhere = |_: &str| Err(MeshError::Read { reason: "no folder to look in was named".to_owned() });
        Mechanism::read_with_meshes(urdf, srdf, joints, &mut { nowhere })
    }

    /// As [`Mechanism::read`]; `load` gives what is in the mesh file that the URDF names so
    /// ([`MeshFiles::read`](crate::mesh_files::MeshFiles::read)).
    ///
    /// # Errors
    /// [`MechanismError`]; for meshes [`RobotError::Mesh`] names the link and the file.
    pub fn read_with_meshes(
        urdf: &str,
        srdf: Option<&str>,
        joints: &[String],
        load: &mut dyn FnMut(&str) -> Result<Vec<u8>, MeshError>,
    ) -> Result<Mechanism, MechanismError> {
        let description = urdf::parse(urdf)?;
        let moves = |j: &&urdf_rs::Joint| j.joint_type != urdf_rs::JointType::Fixed && j.mimic.is_none();
        let names: Vec<String> = if joints.is_empty() {
            description.joints.iter().filter(moves).map(|j| j.name.clone()).collect()
        } else {
            joints.to_vec()
        };
        if names.len() > MAX_JOINTS {
            return Err(MechanismError::TooMany { count: names.len() });
        }
        if let Some(joint) = names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name)) {
            return Err(MechanismError::Twice { joint: joint.clone() });
        }
        let joints = names.iter().map(|name| limits(&description, name)).collect::<Result<Vec<_>, _>>()?;
        let links = links(&description, &names, load)?;
        let mut mechanism = Mechanism {
            name: description.name.clone(),
            joints,
            links,
            disabled: BTreeSet::new(),
            allowed: BTreeSet::new(),
        };
        mechanism.disabled = match srdf {
            Some(text) => mechanism.listed(text)?,
            None => mechanism.touching(),
        };
        Ok(mechanism)
    }

    /// Poses of all links, in their order; `positions` in the order of the joints.
    pub fn poses(&self, positions: &[f64]) -> Vec<Pose> {
        let mut poses: Vec<Pose> = Vec::with_capacity(self.links.len());
        for link in &self.links {
            let moved = match link.drive {
                None => link.origin,
                Some(Drive { joint, axis, slides: true }) => {
                    let [x, y, z] = axis.map(|c| c * positions[joint]);
                    compose(&link.origin, &Pose::at(x, y, z))
                }
                Some(Drive { joint, axis, slides: false }) => compose(&link.origin, &turn(axis, positions[joint])),
            };
            poses.push(link.parent.map_or(moved, |parent| compose(&poses[parent], &moved)));
        }
        poses
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// Takes a link's bodies `padding_m` metres larger on every side, in every check.
    pub fn pad(&mut self, link: usize, padding_m: f64) {
        let part = &mut self.links[link];
        part.padding_m = padding_m;
        let grown = |body: &Body| Body { geometry: body.geometry.grown(padding_m), ..*body };
        part.spheres = part.bodies.iter().flat_map(|body| spheres::cover(&grown(body))).collect();
        part.spheres.extend(part.meshes.iter().flat_map(|meshed| meshed.cover(padding_m)));
    }

    /// As [`Mechanism::pad`], for all links.
    pub fn pad_all(&mut self, padding_m: f64) {
        for link in 0..self.links.len() {
            self.pad(link, padding_m);
        }
    }

    /// Fixes something to a link, as a link of its own, which is given back; bodies in the frame of the link that holds it. It
    /// may touch that link and those that are listed.
    pub fn attach(&mut self, name: &str, link: usize, bodies: Vec<Body>, touching: &[usize]) -> usize {
        let index = self.links.len();
        let spheres = bodies.iter().flat_map(spheres::cover).collect();
        self.links.push(Part {
            name: name.to_owned(),
            parent: Some(link),
            origin: Pose::IDENTITY,
            drive: None,
            bodies,
            meshes: Vec::new(),
            padding_m: 0.0,
            spheres,
        });
        self.disabled.extend(touching.iter().chain([&link]).map(|other| (*other, index)));
        index
    }

    /// Lets a link touch an obstacle.
    pub fn allow(&mut self, link: usize, obstacle: &str) {
        self.allowed.insert((link, obstacle.to_owned()));
    }

    /// Whether a link is to be kept away from an obstacle.
    pub fn is_kept_from(&self, link: usize, obstacle: &str) -> bool {
        self.allowed.is_empty() || !self.allowed.contains(&(link, obstacle.to_owned()))
    }

    /// Whether two links are to be kept apart: not where the SRDF disables the pair, nor where no planned joint moves one against the other.
    pub fn is_checked(&self, a: usize, b: usize) -> bool {
        self.carrier(a) != self.carrier(b) && !self.disabled.contains(&(a.min(b), a.max(b)))
    }

    /// The link nearest to a link towards the root, itself included, that a planned joint moves.
    fn carrier(&self, link: usize) -> Option<usize> {
        let mut next = Some(link);
        while let Some(here) = next.filter(|here| self.links[*here].drive.is_none()) {
            next = self.links[here].parent;
        }
        next
    }

    /// All pairs of links with shapes that are to be kept apart, the lower index first.
    pub fn pairs(&self) -> Vec<(usize, usize)> {
        let solid: Vec<usize> = (0..self.links.len()).filter(|l| !self.links[*l].spheres.is_empty()).collect();
        let pairs = solid.iter().flat_map(|b| solid.iter().take_while(move |a| *a < b).map(move |a| (*a, *b)));
        pairs.filter(|(a, b)| self.is_checked(*a, *b)).collect()
    }

    /// Positions, of which those that are beyond a limit by no more than [`ROUNDED`] are at the limit, and which were.
    pub fn clamped(&self, positions: &[f64]) -> (Vec<f64>, Vec<Beyond>) {
        let mut beyond = Vec::new();
        let clamp = |(joint, position): (&Joint, &f64)| {
            let limit = position.clamp(joint.lower, joint.upper);
            let by = (position - limit).abs();
            if by == 0.0 || by > ROUNDED {
                return *position;
            }
            beyond.push(Beyond { joint: joint.name.clone(), position: *position, by });
            limit
        };
        (self.joints.iter().zip(positions).map(clamp).collect(), beyond)
    }

    fn listed(&self, srdf: &str) -> Result<BTreeSet<(usize, usize)>, MechanismError> {
        let index: BTreeMap<&str, usize> = self.links.iter().enumerate().map(|(i, l)| (l.name.as_str(), i)).collect();
        let mut pairs = BTreeSet::new();
        for event in xml::EventReader::from_str(srdf) {
            let event = event.map_err(|error| MechanismError::Srdf(error.to_string()))?;
            let xml::reader::XmlEvent::StartElement { name, attributes, .. } = event else { continue };
            if name.local_name != "disable_collisions" {
                continue;
            }
            let link = |key: &str| attributes.iter().find(|a| a.name.local_name == key).map(|a| a.value.as_str());
            // An SRDF may speak of links that this variant of the robot does not have.
            let pair = (link("link1").and_then(|l| index.get(l)), link("link2").and_then(|l| index.get(l)));
            if let (Some(&a), Some(&b)) = pair {
                pairs.insert((a.min(b), a.max(b)));
            }
        }
        Ok(pairs)
    }

    /// Pairs that the robot is made to have in touch.
    fn touching(&self) -> BTreeSet<(usize, usize)> {
        let middle: Vec<f64> = self.joints.iter().map(|j| (j.lower + j.upper) / 2.0).collect();
        let poses = self.poses(&middle);
        let meet = |a: usize, b: usize| {
            self.links[a].spheres.iter().any(|s| {
                let at = poses[a].transform(s.centre);
                self.links[b].spheres.iter().any(|o| {
                    let gap: f64 = (0..3).map(|i| (at[i] - poses[b].transform(o.centre)[i]).powi(2)).sum();
                    gap < (s.radius + o.radius).powi(2)
                })
            })
        };
        let mut pairs = BTreeSet::new();
        for b in 0..self.links.len() {
            for a in 0..b {
                if self.solid_parent(b) == Some(a) || self.solid_parent(a) == Some(b) || meet(a, b) {
                    pairs.insert((a, b));
                }
            }
        }
        pairs
    }

    /// The next link towards the root that has a shape.
    fn solid_parent(&self, link: usize) -> Option<usize> {
        let mut next = self.links[link].parent;
        while let Some(parent) = next.filter(|p| self.links[*p].spheres.is_empty()) {
            next = self.links[parent].parent;
        }
        next
    }
}

/// A turn about a unit vector.
fn turn(axis: [f64; 3], angle: f64) -> Pose {
    let (s, c) = (angle / 2.0).sin_cos();
    Pose { position: [0.0; 3], quaternion_xyzw: [axis[0] * s, axis[1] * s, axis[2] * s, c] }
}

fn joint<'u>(urdf: &'u urdf_rs::Robot, name: &str) -> Result<&'u urdf_rs::Joint, RobotError> {
    let found = urdf.joints.iter().find(|j| j.name == name);
    found.ok_or_else(|| RobotError::Missing { what: "joint", name: name.to_owned() })
}

fn limits(urdf: &urdf_rs::Robot, name: &str) -> Result<Joint, RobotError> {
    let joint = joint(urdf, name)?;
    let limit = &joint.limit;
    let endless = joint.joint_type == urdf_rs::JointType::Continuous;
    let (lower, upper) = if endless { (-ENDLESS_RAD, ENDLESS_RAD) } else { (limit.lower, limit.upper) };
    let reason = if joint.mimic.is_some() {
        "it follows another joint and cannot be planned for"
    } else if !(lower < upper && lower.is_finite() && upper.is_finite()) {
        "its lower limit is not below its upper limit"
    } else {
        let velocity = if limit.velocity > 0.0 { limit.velocity } else { 1.0 };
        let given = limit.acceleration;
        let acceleration = if given > 0.0 && given.is_finite() { given } else { velocity / TIME_TO_SPEED_S };
        let jerk = jerk(limit.jerk, acceleration);
        return Ok(Joint { name: name.to_owned(), lower, upper, velocity, acceleration, jerk });
    };
    Err(RobotError::Unsupported { what: "joint", name: name.to_owned(), reason })
}

fn links(urdf: &urdf_rs::Robot, names: &[String], load: &mut Loader<'_>) -> Result<Vec<Part>, RobotError> {
    let children: BTreeSet<&str> = urdf.joints.iter().map(|j| j.child.link.as_str()).collect();
    let root = urdf.links.iter().find(|l| !children.contains(l.name.as_str()));
    let root = root.ok_or_else(|| RobotError::Missing { what: "link", name: "without a parent".to_owned() })?;
    let mut links = vec![part(root, None, Pose::IDENTITY, None, load)?];
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
            let (origin, drive) = drive(urdf, joint, names)?;
            links.push(part(child, Some(next), origin, drive, load)?);
        }
        next += 1;
    }
    Ok(links)
}

fn part(
    link: &urdf_rs::Link,
    parent: Option<usize>,
    origin: Pose,
    drive: Option<Drive>,
    load: &mut Loader<'_>,
) -> Result<Part, RobotError> {
    let (bodies, meshes) = urdf::shapes(link, load)?;
    let spheres = bodies.iter().flat_map(spheres::cover).chain(meshes.iter().flat_map(|m| m.cover(0.0))).collect();
    Ok(Part { name: link.name.clone(), parent, origin, drive, bodies, meshes, padding_m: 0.0, spheres })
}

/// Where a joint is, and what moves it.
fn drive(urdf: &urdf_rs::Robot, joint: &urdf_rs::Joint, names: &[String]) -> Result<(Pose, Option<Drive>), RobotError> {
    let origin = urdf::origin(&joint.origin);
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
    let (driver, factor, offset) = match &joint.mimic {
        None => (&joint.name, 1.0, 0.0),
        Some(mimic) => (&mimic.joint, mimic.multiplier.unwrap_or(1.0), mimic.offset.unwrap_or(0.0)),
    };
    if let Some(index) = names.iter().position(|name| name == driver) {
        if factor != 1.0 || offset != 0.0 {
            return Err(unsupported("it mimics a planned joint by a factor or an offset"));
        }
        return Ok((origin, Some(Drive { joint: index, axis, slides })));
    }
    let resting = self::joint(urdf, driver)?;
    let rest = match resting.joint_type {
        urdf_rs::JointType::Continuous => 0.0,
        _ => 0.0_f64.max(resting.limit.lower).min(resting.limit.upper),
    };
    let position = factor * rest + offset;
    let moved = if slides {
        let [x, y, z] = axis.map(|c| c * position);
        Pose::at(x, y, z)
    } else {
        turn(axis, position)
    };
    Ok((origin.compose(&moved), None))
}
