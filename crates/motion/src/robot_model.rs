//! The model of a robot: a tree of links from its URDF, the joints that move them, the shapes that can collide, and the pairs of links that are
//! excepted from checks by the SRDF or, without one, because they are built to touch.
//!
//! A joint that mimics another, also through further mimics, has no position of its own: its link is driven by the joint at the end of the chain,
//! by a factor; the offset is part of the link's origin. A [`RobotState`] has a position for each joint of the model. A [`Mechanism`] is what is
//! planned for: the same links, moved by some of the joints, with the others held where a state has them.

mod srdf;

use crate::frame::compose;
use crate::geometry::{Body, Geometry};
use crate::mechanism::{MAX_JOINTS, Mechanism, MechanismError};
use crate::mesh::{MeshError, Meshed};
use crate::pairs::{self, Checks, Pair};
use crate::robot_state::RobotState;
use crate::spheres::Sphere;
use crate::urdf::{self, Description, Loader, RobotError};
use crate::urdf_tree::JointText;
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

/// Maximum range of a planned joint, in radians (metres for a prismatic joint).
pub(crate) const WIDEST: f64 = 1e4;

/// Maximum number of turns from zero of a continuous joint.
pub(crate) const MOST_TURNS: f64 = 1e4;

const FOR_ENDLESS: &str = "a joint that turns without end is `continuous`";

/// The model of a robot.
#[derive(Debug, Clone)]
pub struct RobotModel {
    /// Name as in the URDF.
    pub name: String,
    /// Every joint that has a position of its own, in the order of the URDF. A joint's index here is its index in a state.
    pub joints: Vec<Joint>,
    /// Parents before children.
    pub links: Vec<Link>,
    /// The names of the joints that mimic others.
    pub(crate) mimics: BTreeSet<String>,
    /// Positions of its joints in the text of the URDF.
    pub(crate) texts: BTreeMap<String, JointText>,
    /// The checks of pairs of links, from the SRDF or, without one, from how the links touch ([`pairs`]).
    pub(crate) checks: Checks,
    /// Whether an SRDF excepts pairs of links from checks.
    has_exceptions: bool,
}

/// A joint and its limits (radians, or metres for prismatic joints).
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Name as in the URDF.
    pub name: String,
    /// Minimum position. For a continuous joint this is where one turn of it begins, and no limit ([`Joint::limits`]).
    pub lower: f64,
    /// Maximum position, or the end of that turn.
    pub upper: f64,
    /// Whether it is continuous, as in the URDF: it turns without end, and after a whole turn everything is where it was.
    pub endless: bool,
    /// Maximum speed, per second.
    pub velocity: f64,
    /// Maximum acceleration, per second squared.
    pub acceleration: f64,
    /// Maximum jerk, per second cubed.
    pub jerk: f64,
}

/// A rigid link.
#[derive(Debug, Clone)]
pub struct Link {
    /// Name as in the URDF.
    pub name: String,
    /// Its parent link.
    pub parent: Option<usize>,
    /// The frame of its joint in the parent's frame.
    pub origin: Pose,
    /// The joint that moves it, if any.
    pub drive: Option<Drive>,
    /// Its exact shapes: primitives,
    pub bodies: Vec<Body>,
    /// and meshes.
    pub meshes: Vec<Meshed>,
    /// Number of bodies, at the end of the list, that are spheres which cover the meshes, for checks that need primitives.
    pub covers: usize,
    /// Padding of its bodies, in metres.
    pub padding_m: f64,
    /// Spheres that hold all of it, including the padding.
    pub spheres: Vec<Sphere>,
}

/// How a joint moves a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive {
    /// Index of the joint.
    pub joint: usize,
    /// Unit vector of the joint's axis.
    pub axis: [f64; 3],
    /// Whether the joint is prismatic: it moves the link along the axis instead of about it.
    pub slides: bool,
    /// Motion of the link for one radian (or metre) of the joint: 1, except for a link whose own joint is a mimic.
    pub factor: f64,
}

impl Joint {
    /// Minimum and maximum position. A continuous joint may be so many turns from zero that numbers still have the digits that a path needs.
    pub fn limits(&self) -> [f64; 2] {
        if self.endless { [-MOST_TURNS * TAU, MOST_TURNS * TAU] } else { [self.lower, self.upper] }
    }

    /// Whether a position is within the limits, or exceeds them by no more than `beyond`.
    pub fn allows(&self, position: f64, beyond: f64) -> bool {
        let [lower, upper] = self.limits();
        (lower - beyond..=upper + beyond).contains(&position)
    }

    /// The nearest position within the limits.
    pub fn clamp(&self, position: f64) -> f64 {
        let [lower, upper] = self.limits();
        position.clamp(lower, upper)
    }

    /// The equivalent of a position in the turn nearest to `from`, if the joint is continuous; otherwise the position itself.
    pub fn counted_from(&self, from: f64, position: f64) -> f64 {
        if self.endless { position + TAU * ((from - position) / TAU).round() } else { position }
    }
}

impl Drive {
    /// The pose of the link relative to its origin at a position of the joint.
    #[inline]
    pub fn moved(&self, position: f64) -> Pose {
        let position = self.factor * position;
        if self.slides {
            return Pose { position: self.axis.map(|c| c * position), ..Pose::IDENTITY };
        }
        let (sin, cos) = (position / 2.0).sin_cos();
        let [x, y, z] = self.axis;
        Pose { position: [0.0; 3], quaternion_xyzw: [x * sin, y * sin, z * sin, cos] }
    }
}

impl Link {
    /// A link without shapes.
    pub(crate) fn bare(name: &str, parent: Option<usize>, origin: Pose, drive: Option<Drive>) -> Link {
        Link {
            name: name.to_owned(),
            parent,
            origin,
            drive,
            bodies: Vec::new(),
            meshes: Vec::new(),
            covers: 0,
            padding_m: 0.0,
            spheres: Vec::new(),
        }
    }

    /// Its primitives without the spheres that cover its meshes. Together with the meshes they are its exact shape.
    pub fn own_bodies(&self) -> &[Body] {
        &self.bodies[..self.bodies.len() - self.covers]
    }

    /// Adds spheres that cover its meshes.
    fn cover_meshes(&mut self) {
        let spheres = self
            .meshes
            .iter()
            .flat_map(|mesh| mesh.cover(0.0))
            .map(|Sphere { centre: [x, y, z], radius }| Geometry::Sphere { radius }.at(Pose::at(x, y, z)));
        let before = self.bodies.len();
        self.bodies.extend(spheres);
        self.covers = self.bodies.len() - before;
    }

    /// Its origin in its parent's frame, and its drive, if only the joints `moving` move and the others stay at `positions`. The joint's index is
    /// that among the moving ones.
    pub(crate) fn moved_by(&self, moving: &[usize], positions: &[f64]) -> (Pose, Option<Drive>) {
        let Some(drive) = self.drive else { return (self.origin, None) };
        match moving.iter().position(|joint| *joint == drive.joint) {
            Some(joint) => (self.origin, Some(Drive { joint, ..drive })),
            None => (self.origin.compose(&drive.moved(positions[drive.joint])), None),
        }
    }

    /// Its pose in its parent's frame.
    #[inline]
    pub(crate) fn in_parent(&self, positions: &[f64]) -> Pose {
        match self.drive {
            None => self.origin,
            Some(drive) => compose(&self.origin, &drive.moved(positions[drive.joint])),
        }
    }
}

/// Poses of links, parents before children, in the frame of the root; `positions` in the order of the joints.
pub(crate) fn poses(links: &[Link], positions: &[f64]) -> Vec<Pose> {
    let mut poses: Vec<Pose> = Vec::with_capacity(links.len());
    for link in links {
        let moved = link.in_parent(positions);
        poses.push(link.parent.map_or(moved, |parent| compose(&poses[parent], &moved)));
    }
    poses
}

impl RobotModel {
    /// Reads a robot without meshes.
    ///
    /// # Errors
    /// [`MechanismError`] names the joint or link that is missing or not supported.
    pub fn read(urdf: &str, srdf: Option<&str>) -> Result<RobotModel, MechanismError> {
        let nowhere = |_: &str| Err(MeshError::Read { reason: "no folder to look in was named".to_owned() });
        RobotModel::read_with_meshes(urdf, srdf, &mut { nowhere })
    }

    /// As [`RobotModel::read`]; `load` returns the content of a mesh file by the name in the URDF
    /// ([`MeshFiles::read`](crate::mesh_files::MeshFiles::read)).
    ///
    /// # Errors
    /// [`MechanismError`]; for meshes [`RobotError::Mesh`] names the link and the file.
    pub fn read_with_meshes(
        urdf: &str,
        srdf: Option<&str>,
        load: &mut Loader<'_>,
    ) -> Result<RobotModel, MechanismError> {
        RobotModel::of(urdf::read(urdf, load)?, srdf)
    }

    /// As [`RobotModel::read_with_meshes`], with spheres that cover each mesh in addition, for code that handles only primitives. The meshes
    /// decide which pairs are checked.
    pub(crate) fn read_with_covers(
        urdf: &str,
        srdf: Option<&str>,
        load: &mut Loader<'_>,
    ) -> Result<RobotModel, MechanismError> {
        let mut model = RobotModel::read_with_meshes(urdf, srdf, load)?;
        if !model.has_exceptions {
            // The spheres are no larger than before, and the search sees them: so of the pairs with meshes only those are checked by their shapes
            // that the spheres block almost everywhere.
            let undecided = pairs::undecided(&model, &model.checks.excepted);
            let has_mesh = |(a, b): &Pair| [*a, *b].iter().any(|link| !model.links[*link].meshes.is_empty());
            model.checks.by_shapes.retain(|pair| !has_mesh(pair) || undecided.contains(pair));
        }
        model.links.iter_mut().for_each(Link::cover_meshes);
        Ok(model)
    }

    /// Links and joints without shapes and without checks: all that is known before a mesh is read.
    ///
    /// # Errors
    /// As [`RobotModel::read_with_meshes`], except for errors of meshes.
    pub(crate) fn outline(urdf: &str, srdf: Option<&str>) -> Result<RobotModel, MechanismError> {
        let Description { name, joints, links, mimics, texts } = urdf::read_outline(urdf)?;
        let excepted = srdf.map_or_else(|| Ok(BTreeSet::new()), |text| srdf::excepted(text, &links))?;
        let has_exceptions = !excepted.is_empty();
        Ok(RobotModel { name, joints, links, mimics, texts, checks: Checks::default(), has_exceptions })
    }

    fn of(description: Description, srdf: Option<&str>) -> Result<RobotModel, MechanismError> {
        let Description { name, joints, links, mimics, texts } = description;
        let excepted = srdf.map_or_else(|| Ok(BTreeSet::new()), |text| srdf::excepted(text, &links))?;
        let has_exceptions = !excepted.is_empty();
        let mut model = RobotModel { name, joints, links, mimics, texts, checks: Checks::default(), has_exceptions };
        // An SRDF may have only groups of joints and postures.
        model.checks = if has_exceptions { pairs::beside_srdf(&model, excepted) } else { pairs::checks(&model) };
        Ok(model)
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// The index of a joint that has a position of its own.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Poses of all links in the frame of the root; `positions` has one for each joint.
    pub fn poses(&self, positions: &[f64]) -> Vec<Pose> {
        poses(&self.links, positions)
    }

    /// Recomputes in place the poses of some links, parents before children; the poses of their parents must be current.
    #[inline]
    pub fn update(&self, links: &[usize], positions: &[f64], poses: &mut [Pose]) {
        for &index in links {
            let link = &self.links[index];
            let moved = link.in_parent(positions);
            poses[index] = link.parent.map_or(moved, |parent| compose(&poses[parent], &moved));
        }
    }

    /// The checks of pairs of links.
    pub fn checks(&self) -> &Checks {
        &self.checks
    }

    /// Whether an SRDF excepts pairs of links from checks. If not, [`pairs`] finds the exceptions.
    pub fn has_exceptions(&self) -> bool {
        self.has_exceptions
    }

    /// Whether two links are excepted from checks. A link is never checked against itself.
    pub fn is_excepted(&self, a: usize, b: usize) -> bool {
        a == b || self.checks.excepted.contains(&(a.min(b), a.max(b)))
    }

    /// Whether two links are checked by their exact shapes, because the spheres that hold them cannot decide.
    pub fn is_by_shapes(&self, a: usize, b: usize) -> bool {
        self.checks.by_shapes.contains(&(a.min(b), a.max(b)))
    }

    /// The mechanism of the planned `joints`, in this order, or of all joints if there are none given; the others stay at `state`.
    ///
    /// # Errors
    /// [`MechanismError`] names a joint that cannot be planned for.
    pub fn planned(&self, joints: &[String], state: &RobotState) -> Result<Mechanism, MechanismError> {
        let all: Vec<String>;
        let names = if joints.is_empty() {
            all = self.joints.iter().map(|joint| joint.name.clone()).collect();
            &all
        } else {
            joints
        };
        if names.len() > MAX_JOINTS {
            return Err(MechanismError::TooMany { count: names.len() });
        }
        if let Some(joint) = names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name)) {
            return Err(MechanismError::Twice { joint: joint.clone() });
        }
        let planned = names.iter().map(|name| self.plannable(name)).collect::<Result<Vec<_>, _>>()?;
        Ok(self.restricted(&planned, state.positions()))
    }

    /// As [`RobotModel::planned`], for plannable joints given by their indices.
    pub(crate) fn restricted(&self, planned: &[usize], positions: &[f64]) -> Mechanism {
        self.moved_by(planned, positions, self.checks.clone())
    }

    /// The mechanism of the links moved by the joints `planned`, with the others at `positions`.
    pub(crate) fn moved_by(&self, planned: &[usize], positions: &[f64], checks: Checks) -> Mechanism {
        let held = |link: &Link| {
            let (origin, drive) = link.moved_by(planned, positions);
            Link { origin, drive, ..link.clone() }
        };
        let joints = planned.iter().map(|joint| self.joints[*joint].clone()).collect();
        Mechanism::new(&self.name, joints, self.links.iter().map(held).collect(), checks)
    }

    /// The index of a joint that can be planned for.
    pub(crate) fn plannable(&self, name: &str) -> Result<usize, RobotError> {
        let text = self.texts.get(name);
        let refused = |reason: String| {
            let place = text.map_or_else(String::new, |text| format!(" (line {} of the URDF)", text.line));
            Err(RobotError::NotPlannable { name: name.to_owned(), reason: reason + &place })
        };
        if self.mimics.contains(name) {
            return refused("it mimics another joint; name that one".to_owned());
        }
        let missing = || RobotError::Missing { what: "joint", name: name.to_owned() };
        let index = self.joint(name).ok_or_else(missing)?;
        let Joint { lower, upper, endless, .. } = self.joints[index];
        if lower >= upper && text.is_some_and(|text| !text.has_limit) && !endless {
            return refused("it has no `<limit>`; add one with `lower`, `upper` and `velocity`".to_owned());
        }
        if !(lower.is_finite() && upper.is_finite()) {
            return refused(format!("its limits are {lower} to {upper}: planning needs finite ones; {FOR_ENDLESS}"));
        }
        if lower >= upper {
            return refused(format!("its limits, and those of joints that mimic it, are {lower} to {upper}"));
        }
        if upper - lower > WIDEST {
            return refused(format!("its limits {lower} to {upper} are more than {WIDEST} apart; {FOR_ENDLESS}"));
        }
        Ok(index)
    }
}
