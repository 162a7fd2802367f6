//! The one model of a robot: a tree of links from its URDF, the joints that move them, the shapes that can collide, and the pairs
//! of links that its SRDF excepts from checks, or that are made to touch where there is none.
//!
//! A joint that mimics another, also through further mimics, has no position of its own: its link is driven by the joint at the end of the
//! chain, by a factor; the offset is part of where the link is mounted. A [`RobotState`] has a
//! position for each joint of the model. What is planned for is a [`Mechanism`]: the same links, moved by some of the joints, with the
//! others held where a state has them.

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

/// How far apart the limits of a joint that is planned for may be, in radians (metres for one that slides).
const WIDEST: f64 = 1e4;

/// How many turns from zero a joint that turns without end may be.
pub(crate) const MOST_TURNS: f64 = 1e4;

const FOR_ENDLESS: &str = "a joint that turns without end is `continuous`";

/// A robot.
#[derive(Debug, Clone)]
pub struct RobotModel {
    /// As in the URDF.
    pub name: String,
    /// Every joint that has a position of its own, in the order of the URDF. A joint's index here is its index in a state.
    pub joints: Vec<Joint>,
    /// Parents before children.
    pub links: Vec<Link>,
    /// The names of the joints that mimic others.
    pub(crate) mimics: BTreeSet<String>,
    /// Where its joints are in the URDF.
    pub(crate) texts: BTreeMap<String, JointText>,
    /// What the SRDF says of pairs of links, or, without one, what follows from how they meet ([`pairs`]).
    pub(crate) checks: Checks,
    /// Whether an SRDF excepts pairs of links from checks.
    has_exceptions: bool,
}

/// A joint and its limits (radians, or metres for sliding joints).
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// As in the URDF.
    pub name: String,
    /// Least position; where the joint turns without end, that is where one turn of it begins, and no limit ([`Joint::limits`]).
    pub lower: f64,
    /// Greatest position, or where that turn ends.
    pub upper: f64,
    /// Whether it turns without end (`continuous` in the URDF): after a whole turn of it everything is where it was.
    pub endless: bool,
    /// Greatest speed, per second.
    pub velocity: f64,
    /// Greatest acceleration, per second squared.
    pub acceleration: f64,
    /// Greatest jerk, per second cubed.
    pub jerk: f64,
}

/// A rigid link.
#[derive(Debug, Clone)]
pub struct Link {
    /// As in the URDF.
    pub name: String,
    /// The link it hangs on.
    pub parent: Option<usize>,
    /// Where its joint sits in the parent's frame.
    pub origin: Pose,
    /// The joint that moves it.
    pub drive: Option<Drive>,
    /// What can collide, exactly: primitives,
    pub bodies: Vec<Body>,
    /// and meshes.
    pub meshes: Vec<Meshed>,
    /// How many of the bodies, the last ones, are spheres that stand for the meshes and hold them: all that needs primitives has these.
    pub covers: usize,
    /// How much larger its bodies are taken, in metres.
    pub padding_m: f64,
    /// Spheres that hold all of it, padding included.
    pub spheres: Vec<Sphere>,
}

/// How a joint moves a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive {
    /// Index of the joint.
    pub joint: usize,
    /// Unit vector.
    pub axis: [f64; 3],
    /// Along the axis instead of about it.
    pub slides: bool,
    /// How far the link moves for one radian (or metre) of the joint: 1 but for a link whose own joint mimics.
    pub factor: f64,
}

impl Joint {
    /// The least and the greatest position at which it may be. One that turns without end may be so many turns from zero that numbers still have
    /// the digits that a path needs.
    pub fn limits(&self) -> [f64; 2] {
        if self.endless { [-MOST_TURNS * TAU, MOST_TURNS * TAU] } else { [self.lower, self.upper] }
    }

    /// Whether it may be at a position, or is beyond its limits by no more than `beyond` there.
    pub fn allows(&self, position: f64, beyond: f64) -> bool {
        let [lower, upper] = self.limits();
        (lower - beyond..=upper + beyond).contains(&position)
    }

    /// The nearest position at which it may be.
    pub fn clamp(&self, position: f64) -> f64 {
        let [lower, upper] = self.limits();
        position.clamp(lower, upper)
    }

    /// A position as the joint counts it when it is at another one: in the turn that is nearest, if it turns without end.
    pub fn counted_from(&self, from: f64, position: f64) -> f64 {
        if self.endless { position + TAU * ((from - position) / TAU).round() } else { position }
    }
}

impl Drive {
    /// Where the link is, as seen from its origin, when the joint is at a position.
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

    /// Its primitives without the spheres that stand for its meshes. With the meshes they are its exact shape.
    pub fn own_bodies(&self) -> &[Body] {
        &self.bodies[..self.bodies.len() - self.covers]
    }

    /// Has spheres stand for its meshes from now on.
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

    /// Where it sits in its parent's frame, and what moves it there, where some joints move and the others stay where `positions` has them;
    /// the joint's index is that among those that move.
    pub(crate) fn moved_by(&self, moving: &[usize], positions: &[f64]) -> (Pose, Option<Drive>) {
        let Some(drive) = self.drive else { return (self.origin, None) };
        match moving.iter().position(|joint| *joint == drive.joint) {
            Some(joint) => (self.origin, Some(Drive { joint, ..drive })),
            None => (self.origin.compose(&drive.moved(positions[drive.joint])), None),
        }
    }

    /// Where it is in its parent's frame.
    #[inline]
    pub(crate) fn in_parent(&self, positions: &[f64]) -> Pose {
        match self.drive {
            None => self.origin,
            Some(drive) => compose(&self.origin, &drive.moved(positions[drive.joint])),
        }
    }
}

/// Poses of links, of which parents come before children, in the frame of the root; `positions` in the order of the joints.
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

    /// As [`RobotModel::read`]; `load` gives what is in the mesh file that the URDF names so
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

    /// As [`RobotModel::read_with_meshes`], with spheres that hold each mesh beside it, for whatever knows primitives alone. Which pairs are checked
    /// is what the meshes say.
    pub(crate) fn read_with_covers(
        urdf: &str,
        srdf: Option<&str>,
        load: &mut Loader<'_>,
    ) -> Result<RobotModel, MechanismError> {
        let mut model = RobotModel::read_with_meshes(urdf, srdf, load)?;
        if !model.has_exceptions {
            // Such spheres forbid no more than they did, and the search sees them: of pairs with meshes only those go by their shapes of which spheres
            // leave hardly anything.
            let undecided = pairs::undecided(&model, &model.checks.excepted);
            let has_mesh = |(a, b): &Pair| [*a, *b].iter().any(|link| !model.links[*link].meshes.is_empty());
            model.checks.by_shapes.retain(|pair| !has_mesh(pair) || undecided.contains(pair));
        }
        model.links.iter_mut().for_each(Link::cover_meshes);
        Ok(model)
    }

    /// Links and joints without shapes, and nothing of what is checked: all that can be said before a mesh is read.
    ///
    /// # Errors
    /// As [`RobotModel::read_with_meshes`], but for what is wrong with meshes.
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
        // An SRDF may say nothing but groups of joints and postures.
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

    /// Poses of all links in the frame of the root; a position for each joint.
    pub fn poses(&self, positions: &[f64]) -> Vec<Pose> {
        poses(&self.links, positions)
    }

    /// Recomputes in place the poses of some links, parents before children; those of their parents hold.
    #[inline]
    pub fn update(&self, links: &[usize], positions: &[f64], poses: &mut [Pose]) {
        for &index in links {
            let link = &self.links[index];
            let moved = link.in_parent(positions);
            poses[index] = link.parent.map_or(moved, |parent| compose(&poses[parent], &moved));
        }
    }

    /// What is checked of pairs of links.
    pub fn checks(&self) -> &Checks {
        &self.checks
    }

    /// Whether an SRDF excepts pairs of its links from checks. Without any, [`pairs`] finds out.
    pub fn has_exceptions(&self) -> bool {
        self.has_exceptions
    }

    /// Whether two links are excepted from checks. A link is never checked against itself.
    pub fn is_excepted(&self, a: usize, b: usize) -> bool {
        a == b || self.checks.excepted.contains(&(a.min(b), a.max(b)))
    }

    /// Whether two links are told apart by their exact shapes, because the spheres that hold them say nothing of them.
    pub fn is_by_shapes(&self, a: usize, b: usize) -> bool {
        self.checks.by_shapes.contains(&(a.min(b), a.max(b)))
    }

    /// What is planned for: `joints`, in this order, without any all of them; the others stay where `state` has them.
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

    /// As [`RobotModel::planned`], of joints that can be, by their indices.
    pub(crate) fn restricted(&self, planned: &[usize], positions: &[f64]) -> Mechanism {
        self.moved_by(planned, positions, self.checks.clone())
    }

    /// The links moved by some joints, the others where `positions` has them.
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
