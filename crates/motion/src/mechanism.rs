//! The robot as the planner sees it: links moved by the planned joints, bounding spheres for the fast checks, exact shapes for the others, and the
//! pairs of links that are excepted from checks.
//!
//! The joints that are not planned are held where a [`RobotState`] has them.

use crate::geometry::Body;
use crate::mesh::MeshError;
use crate::pairs::Checks;
use crate::robot_model::{self, Drive, Joint, Link, RobotModel};
use crate::robot_state::RobotState;
use crate::spheres;
use crate::urdf::RobotError;
use ratn_model::pose::Pose;
use std::collections::BTreeSet;
use std::fmt;

/// Maximum number of planned joints.
pub const MAX_JOINTS: usize = 16;

/// Tolerance by which a position may exceed a limit, for rounding, in radians (metres for a prismatic joint).
pub const ROUNDED: f64 = 1e-4;

/// A robot with its planned joints.
#[derive(Debug, Clone)]
pub struct Mechanism {
    /// Name as in the URDF.
    pub name: String,
    /// The planned joints, in the caller's order.
    pub joints: Vec<Joint>,
    /// Parents before children.
    pub links: Vec<Link>,
    /// Pairs of links, the lower index first, that are never checked against each other.
    pub excepted: BTreeSet<(usize, usize)>,
    /// Pairs that are checked by their exact shapes only, because their spheres decide nothing ([`pairs`](crate::pairs)).
    pub by_shapes: BTreeSet<(usize, usize)>,
    /// Links and the names of obstacles that each may touch.
    pub allowed: BTreeSet<(usize, String)>,
}

/// A position that exceeds a limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Beyond {
    /// The joint's name.
    pub joint: String,
    /// The given position, in radians (metres for a prismatic joint).
    pub position: f64,
    /// By how much it exceeds the limit.
    pub by: f64,
}

impl fmt::Display for Beyond {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Beyond { joint, position, by } = self;
        write!(f, "{joint} is at {position}, beyond the limit by {by:.2e}; taken as the limit")
    }
}

/// Why a robot cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum MechanismError {
    /// The URDF is invalid.
    #[error(transparent)]
    Robot(#[from] RobotError),
    /// The SRDF is not XML.
    #[error("the SRDF is not valid XML: {0}")]
    Srdf(String),
    /// A joint is named twice.
    #[error("the joint `{joint}` is named twice among those to be planned for")]
    Twice {
        /// Its name.
        joint: String,
    },
    /// Too many joints are to be planned for.
    #[error("{count} joints are to be planned for: at most {MAX_JOINTS} are supported")]
    TooMany {
        /// How many.
        count: usize,
    },
}

impl Mechanism {
    /// Reads a robot without meshes. `joints` are planned for; if there are none, all joints that move and mimic no other. The other joints stay
    /// at zero, or at the limit next to it; [`RobotModel::planned`] holds them elsewhere.
    ///
    /// # Errors
    /// [`MechanismError`] names the joint or link that is missing or not supported.
    pub fn read(urdf: &str, srdf: Option<&str>, joints: &[String]) -> Result<Mechanism, MechanismError> {
        let model = RobotModel::read(urdf, srdf)?;
        model.planned(joints, &RobotState::neutral(&model))
    }

    /// As [`Mechanism::read`]; `load` returns the content of a mesh file by the name in the URDF
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
        let model = RobotModel::read_with_meshes(urdf, srdf, load)?;
        model.planned(joints, &RobotState::neutral(&model))
    }

    /// Links moved by the planned joints, with the pairs to check.
    pub(crate) fn new(name: &str, joints: Vec<Joint>, links: Vec<Link>, checks: Checks) -> Mechanism {
        let Checks { excepted, by_shapes, .. } = checks;
        Mechanism { name: name.to_owned(), joints, links, excepted, by_shapes, allowed: BTreeSet::new() }
    }

    /// Poses of all links, in their order; `positions` in the order of the joints.
    pub fn poses(&self, positions: &[f64]) -> Vec<Pose> {
        robot_model::poses(&self.links, positions)
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// Grows a link's bodies by `padding_m` metres on every side, in every check.
    pub fn pad(&mut self, link: usize, padding_m: f64) {
        let link = &mut self.links[link];
        link.padding_m = padding_m;
        let grown = |body: &Body| Body { geometry: body.geometry.grown(padding_m), ..*body };
        link.spheres = link.own_bodies().iter().flat_map(|body| spheres::cover(&grown(body))).collect();
        link.spheres.extend(link.meshes.iter().flat_map(|meshed| meshed.cover(padding_m)));
    }

    /// As [`Mechanism::pad`], for all links.
    pub fn pad_all(&mut self, padding_m: f64) {
        for link in 0..self.links.len() {
            self.pad(link, padding_m);
        }
    }

    /// Attaches something to a link, as a link of its own, and returns its index. The bodies are in the frame of the link that holds it. It may
    /// touch that link and those in `touching`.
    pub fn attach(&mut self, name: &str, link: usize, bodies: Vec<Body>, touching: &[usize]) -> usize {
        let index = self.links.len();
        let spheres = bodies.iter().flat_map(spheres::cover).collect();
        self.links.push(Link { bodies, spheres, ..Link::bare(name, Some(link), Pose::IDENTITY, None) });
        self.excepted.extend(touching.iter().chain([&link]).map(|other| (*other, index)));
        index
    }

    /// Allows a link to touch an obstacle.
    pub fn allow(&mut self, link: usize, obstacle: &str) {
        self.allowed.insert((link, obstacle.to_owned()));
    }

    /// Whether a link is to be kept apart from an obstacle.
    pub fn is_kept_from(&self, link: usize, obstacle: &str) -> bool {
        self.allowed.is_empty() || !self.allowed.contains(&(link, obstacle.to_owned()))
    }

    /// Whether two links are to be kept apart: not if the pair is excepted, nor if no planned joint moves one relative to the other.
    pub fn is_checked(&self, a: usize, b: usize) -> bool {
        self.carrier(a) != self.carrier(b) && !self.excepted.contains(&(a.min(b), a.max(b)))
    }

    /// As [`Mechanism::is_checked`], with the carriers of all links, for callers that ask for many pairs.
    pub(crate) fn is_checked_among(&self, carriers: &[Option<usize>], a: usize, b: usize) -> bool {
        carriers[a] != carriers[b] && !self.excepted.contains(&(a.min(b), a.max(b)))
    }

    /// The [`Mechanism::carrier`] of each link.
    pub(crate) fn carriers(&self) -> Vec<Option<usize>> {
        let mut carriers: Vec<Option<usize>> = Vec::with_capacity(self.links.len());
        for (index, link) in self.links.iter().enumerate() {
            // Parents come before children.
            let carrier =
                if link.drive.is_some() { Some(index) } else { link.parent.and_then(|parent| carriers[parent]) };
            carriers.push(carrier);
        }
        carriers
    }

    /// Whether two links are checked by their exact shapes only.
    pub fn is_by_shapes(&self, a: usize, b: usize) -> bool {
        self.by_shapes.contains(&(a.min(b), a.max(b)))
    }

    /// Whether two links are checked so and at least one has meshes covered by spheres: such links may be built to run close to each other.
    pub(crate) fn is_by_meshes(&self, a: usize, b: usize) -> bool {
        self.is_by_shapes(a, b) && [a, b].iter().any(|link| self.links[*link].covers > 0)
    }

    /// The first link from a link towards the root, itself included, that a planned joint moves.
    pub(crate) fn carrier(&self, link: usize) -> Option<usize> {
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
        let carriers = self.carriers();
        pairs.filter(|(a, b)| self.is_checked_among(&carriers, *a, *b)).collect()
    }

    /// Factor by which the motions of each joint are checked more closely: above 1 if a link that mimics the joint turns or slides several times
    /// as far. A link near its axis does not move far: for a rotation the factor is multiplied by the reach of the shapes in metres, at most 1.
    pub(crate) fn fineness(&self) -> Vec<f64> {
        let mut fineness = vec![1.0_f64; self.joints.len()];
        for (index, link) in self.links.iter().enumerate().filter(|(_, link)| !link.spheres.is_empty()) {
            let length = |[x, y, z]: [f64; 3]| x.hypot(y).hypot(z);
            let mut reach = link.spheres.iter().map(|s| length(s.centre) + s.radius).fold(0.0, f64::max);
            let mut next = Some(index);
            while let Some(here) = next.map(|here| &self.links[here]) {
                if let Some(Drive { joint, slides, factor, .. }) = here.drive {
                    let joint_limits = &self.joints[joint];
                    let far = if slides { 1.0 } else { reach.min(1.0) };
                    if factor.abs() > 1.0 {
                        fineness[joint] = fineness[joint].max(factor.abs() * far);
                    }
                    if slides {
                        reach += joint_limits.lower.abs().max(joint_limits.upper.abs()) * factor.abs();
                    }
                }
                reach += length(here.origin.position);
                next = here.parent;
            }
        }
        fineness
    }

    /// The positions, with those that exceed a limit by no more than [`ROUNDED`] moved to the limit; and which these are.
    pub fn clamped(&self, positions: &[f64]) -> (Vec<f64>, Vec<Beyond>) {
        let mut beyond = Vec::new();
        let clamp = |(joint, position): (&Joint, &f64)| {
            let limit = joint.clamp(*position);
            let by = (position - limit).abs();
            if by == 0.0 || by > ROUNDED {
                return *position;
            }
            beyond.push(Beyond { joint: joint.name.clone(), position: *position, by });
            limit
        };
        (self.joints.iter().zip(positions).map(clamp).collect(), beyond)
    }

    /// Whether no link with a shape is between two links.
    pub(crate) fn are_neighbours(&self, a: usize, b: usize) -> bool {
        self.solid_parent(b) == Some(a) || self.solid_parent(a) == Some(b)
    }

    /// The first link towards the root that has a shape.
    fn solid_parent(&self, link: usize) -> Option<usize> {
        let mut next = self.links[link].parent;
        while let Some(parent) = next.filter(|p| self.links[*p].spheres.is_empty()) {
            next = self.links[parent].parent;
        }
        next
    }
}
