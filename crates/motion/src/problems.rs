//! Planning problems from a file: a robot's joints and, by class, scenes with a start and a goal.
//!
//! The format is JSON: `robot`, `joints` (names, the order of all positions) and `problems`, per class a list of `index`, `start`, `goal` (radians,
//! metres for prismatic joints) and `objects` (`name`, `position` in metres, `quat_xyzw`, and by `type` a `box` with `size`, a `cylinder` or
//! `capsule` with `length` and `radius`, a `sphere` with `radius`; a capsule's `length` is between the centres of its ends). `attached` is the number
//! of objects that the robot holds, which must be zero. `state` has the positions of joints that are not planned, by name: of the file for all
//! problems, of a problem for that one. The others are at zero, or at the limit next to it.
//!
//! Clouds (`cloud`), meshes (`mesh`) and heights (`heightfield`) are in separate files, which the caller reads; the points of a small cloud may be in
//! the problem itself.

use crate::cloud::{self, Cloud};
use crate::geometry::Geometry;
use crate::heightfield::Heights;
use crate::mechanism::Mechanism;
use crate::mesh::{self, Mesh};
use crate::point_files;
use crate::space::Obstacle;
use crate::surroundings::{MeshObstacle, OVERHANG_M, Surroundings};
use ratn_model::pose::Pose;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum number of points of all clouds of a file, and of triangles of all its meshes and heightfields: a file may use a large one many times. One
/// problem has at most as many triangles, with each mesh counted for every use.
const MOST_POINTS: usize = 4 * cloud::MAX_POINTS;
const MOST_TRIANGLES: usize = 4 * mesh::MAX_TRIANGLES;

/// The maximum distance from the robot within which a `self_filter` removes points, in metres.
const MOST_SELF_FILTER_M: f64 = 1.0;

/// All problems of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Problems {
    /// The robot's name.
    pub robot: String,
    /// The planned joints.
    pub joints: Vec<String>,
    /// By class, in alphabetical order.
    pub classes: BTreeMap<String, Vec<Problem>>,
}

/// A start and a goal among obstacles.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Problem {
    /// Its number in its class.
    pub index: u64,
    /// Obstacles: primitive shapes.
    pub obstacles: Vec<Obstacle>,
    /// Obstacles: point clouds.
    pub clouds: Vec<Cloud>,
    /// Clouds, by index, that show the robot itself at the start, and the distance from the robot within which their points are removed, in metres.
    pub self_filters: Vec<(usize, f64)>,
    /// Obstacles: meshes, including those of heightfields.
    pub meshes: Vec<MeshObstacle>,
    /// Joint positions.
    pub start: Vec<f64>,
    /// Joint positions.
    pub goal: Vec<f64>,
    /// Positions of joints that are not planned.
    pub state: BTreeMap<String, f64>,
}

impl Problem {
    /// Removes points of the robot itself at the start from the clouds.
    pub fn filter(&mut self, mechanism: &Mechanism) {
        for (cloud, margin_m) in std::mem::take(&mut self.self_filters) {
            if let Ok(others) = self.clouds[cloud].without_robot(mechanism, &self.start, margin_m) {
                self.clouds[cloud] = others;
            }
        }
    }

    /// All obstacles.
    pub fn surroundings(&self) -> Surroundings<'_> {
        Surroundings { obstacles: &self.obstacles, clouds: &self.clouds, meshes: &self.meshes }
    }
}

/// Why a file contains no valid problems.
#[derive(Debug, thiserror::Error)]
pub enum ProblemError {
    /// Not JSON of this form.
    #[error("not a file of planning problems: {0}")]
    Form(#[from] serde_json::Error),
    /// No problem at all.
    #[error("it holds no problems: `problems` is a list of problems for each class")]
    None,
    /// No joint is planned.
    #[error("`joints` is empty: name the joints that are planned for, in the order of the postures' positions")]
    NoJoints,
    /// A joint that is named twice.
    #[error("the joint `{joint}` is named twice in `joints`")]
    Twice {
        /// Its name.
        joint: String,
    },
    /// A value is invalid.
    #[error("problem {index} of class `{class}`: {reason}")]
    Value {
        /// Its class.
        class: String,
        /// Its number.
        index: u64,
        /// The error.
        reason: String,
    },
}

impl Problems {
    /// Reads the text of a file that refers to no other files.
    ///
    /// # Errors
    /// [`ProblemError`] gives the line, or the problem and its error.
    pub fn parse(text: &str) -> Result<Problems, ProblemError> {
        Problems::parse_with_files(text, &mut |_| Err("no folder to look in was named".to_owned()))
    }

    /// Reads the text of a file; `load` returns the content of a file that it refers to, or why it cannot be read. Each file is loaded once.
    ///
    /// # Errors
    /// [`ProblemError`] gives the line, or the problem, the object, its file and the error.
    pub fn parse_with_files(
        text: &str,
        load: &mut dyn FnMut(&str) -> Result<Vec<u8>, String>,
    ) -> Result<Problems, ProblemError> {
        let mut files = Files { load, loaded: BTreeMap::new(), meshes: BTreeMap::new(), points: 0, triangles: 0 };
        let file: File = serde_json::from_str(text)?;
        if file.joints.is_empty() {
            return Err(ProblemError::NoJoints);
        }
        let twice = file.joints.iter().enumerate().find(|(i, name)| file.joints[..*i].contains(name));
        if let Some((_, joint)) = twice {
            return Err(ProblemError::Twice { joint: joint.clone() });
        }
        if file.problems.values().all(Vec::is_empty) {
            return Err(ProblemError::None);
        }
        let mut classes = BTreeMap::new();
        for (class, entries) in file.problems {
            let mut read = |entry: Entry| {
                let index = entry.index;
                entry.read(&file.joints, &file.state, &mut files).map_err(|reason| ProblemError::Value {
                    class: class.clone(),
                    index,
                    reason,
                })
            };
            let problems = entries.into_iter().map(&mut read).collect::<Result<Vec<_>, _>>()?;
            classes.insert(class, problems);
        }
        Ok(Problems { robot: file.robot, joints: file.joints, classes })
    }
}

#[derive(Deserialize)]
struct File {
    #[serde(default)]
    robot: String,
    joints: Vec<String>,
    #[serde(default)]
    state: BTreeMap<String, f64>,
    problems: BTreeMap<String, Vec<Entry>>,
}

#[derive(Deserialize)]
struct Entry {
    #[serde(default)]
    index: u64,
    objects: Vec<Object>,
    #[serde(default)]
    attached: u64,
    start: Vec<f64>,
    goal: Vec<f64>,
    #[serde(default)]
    state: BTreeMap<String, f64>,
}

#[derive(Deserialize)]
struct Object {
    name: String,
    #[serde(default)]
    position: [f64; 3],
    #[serde(default = "upright")]
    quat_xyzw: [f64; 4],
    #[serde(flatten)]
    shape: Shape,
}

#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Shape {
    Box { size: [f64; 3] },
    Cylinder { length: f64, radius: f64 },
    Capsule { length: f64, radius: f64 },
    Sphere { radius: f64 },
    Cloud(PointsEntry),
    Mesh(MeshEntry),
    Heightfield(HeightsEntry),
}

/// Points in the file itself or in a separate one.
#[derive(Deserialize)]
struct PointsEntry {
    file: Option<String>,
    points: Option<Vec<[f32; 3]>>,
    radius: f64,
    thin: Option<f64>,
    self_filter: Option<f64>,
}

#[derive(Deserialize)]
struct MeshEntry {
    file: String,
    scale: Option<Scale>,
    overhang: Option<f64>,
}

#[derive(Deserialize)]
struct HeightsEntry {
    file: String,
    size: [f64; 2],
    scale: Option<f64>,
    #[serde(default)]
    bottom: f64,
    overhang: Option<f64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Scale {
    All(f64),
    Each([f64; 3]),
}

fn upright() -> [f64; 4] {
    [0.0, 0.0, 0.0, 1.0]
}

/// The files that objects refer to; each is loaded once.
struct Files<'l> {
    load: &'l mut dyn FnMut(&str) -> Result<Vec<u8>, String>,
    loaded: BTreeMap<String, Arc<Vec<u8>>>,
    /// By file name and parameters.
    meshes: BTreeMap<(String, String), Arc<Mesh>>,
    /// Number of points of all clouds, and of triangles of all meshes.
    points: usize,
    triangles: usize,
}

impl Files<'_> {
    fn bytes(&mut self, name: &str) -> Result<Arc<Vec<u8>>, String> {
        if let Some(bytes) = self.loaded.get(name) {
            return Ok(Arc::clone(bytes));
        }
        let bytes = Arc::new((self.load)(name)?);
        self.loaded.insert(name.to_owned(), Arc::clone(&bytes));
        Ok(bytes)
    }

    /// The mesh that `make` creates from a file; `how` distinguishes different meshes from the same file.
    fn mesh(
        &mut self,
        name: &str,
        how: String,
        make: impl FnOnce(&[u8]) -> Result<Mesh, String>,
    ) -> Result<Arc<Mesh>, String> {
        let key = (name.to_owned(), how);
        if let Some(mesh) = self.meshes.get(&key) {
            return Ok(Arc::clone(mesh));
        }
        let mesh = Arc::new(make(&self.bytes(name)?)?);
        self.triangles += mesh.triangles().len();
        if self.triangles > MOST_TRIANGLES {
            let sum = self.triangles;
            return Err(format!(
                "with it all meshes have {sum} triangles, at most {MOST_TRIANGLES} in one file of problems: simplify them"
            ));
        }
        self.meshes.insert(key, Arc::clone(&mesh));
        Ok(mesh)
    }

    /// Counts the points of a cloud.
    fn count(&mut self, cloud: &Cloud) -> Result<(), String> {
        self.points += cloud.points().len();
        let sum = self.points;
        match sum > MOST_POINTS {
            true => Err(format!(
                "with it all clouds have {sum} points, at most {MOST_POINTS} in one file of problems: thin them"
            )),
            false => Ok(()),
        }
    }
}

impl Entry {
    fn read(
        self,
        names: &[String],
        everywhere: &BTreeMap<String, f64>,
        files: &mut Files<'_>,
    ) -> Result<Problem, String> {
        let joints = names.len();
        for (what, positions) in [("start", &self.start), ("goal", &self.goal)] {
            if positions.len() != joints {
                return Err(format!("its {what} has {} positions, the robot has {joints} joints", positions.len()));
            }
            if !positions.iter().all(|p| p.is_finite()) {
                return Err(format!("its {what} is not finite"));
            }
        }
        if self.attached > 0 {
            return Err("attached objects are not supported".to_owned());
        }
        let mut state = everywhere.clone();
        state.extend(self.state);
        if let Some(joint) = state.keys().find(|joint| names.contains(joint)) {
            return Err(format!(
                "its `state` names the joint `{joint}`, which is planned for: `start` and `goal` say where it is"
            ));
        }
        let (index, start, goal) = (self.index, self.start, self.goal);
        let mut problem = Problem { index, start, goal, state, ..Problem::default() };
        for object in self.objects {
            object.read(&mut problem, files)?;
        }
        Ok(problem)
    }
}

impl Object {
    /// Adds the object to the obstacles.
    fn read(self, problem: &mut Problem, files: &mut Files<'_>) -> Result<(), String> {
        let name = self.name;
        let improper = format!("object `{name}` has no proper size, place or rotation");
        let norm = self.quat_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        if !self.position.iter().all(|c| c.is_finite()) || !norm.is_finite() || norm < 1e-6 {
            return Err(improper);
        }
        let pose = Pose { position: self.position, quaternion_xyzw: self.quat_xyzw.map(|c| c / norm) };
        let (geometry, extents) = match self.shape {
            Shape::Box { size } => (Geometry::Box { half: size.map(|s| s / 2.0) }, size.to_vec()),
            Shape::Cylinder { length, radius } => {
                (Geometry::Cylinder { radius, half_length: length / 2.0 }, vec![length, radius])
            }
            Shape::Capsule { length, radius } => {
                (Geometry::Capsule { radius, half_length: length / 2.0 }, vec![length, radius])
            }
            Shape::Sphere { radius } => (Geometry::Sphere { radius }, vec![radius]),
            Shape::Cloud(entry) => {
                let filter = entry.self_filter;
                let cloud = entry.read(&name, &pose, files)?;
                problem.self_filters.extend(filter.map(|margin_m| (problem.clouds.len(), margin_m)));
                problem.clouds.push(cloud);
                return Ok(());
            }
            Shape::Mesh(entry) => {
                let (file, overhang) = (entry.file.clone(), entry.overhang);
                let read = entry.read(files).and_then(|mesh| Ok((mesh, overhang_m(overhang)?)));
                return add_mesh(problem, name, pose, &file, read);
            }
            Shape::Heightfield(entry) => {
                let (file, overhang) = (entry.file.clone(), entry.overhang);
                let read = entry.read(files).and_then(|mesh| Ok((mesh, overhang_m(overhang)?)));
                return add_mesh(problem, name, pose, &file, read);
            }
        };
        if !extents.iter().all(|e| *e > 0.0 && e.is_finite()) {
            return Err(improper);
        }
        problem.obstacles.push(Obstacle { name, pose, geometry });
        Ok(())
    }
}

fn add_mesh(
    problem: &mut Problem,
    name: String,
    pose: Pose,
    file: &str,
    read: Result<(Arc<Mesh>, f64), String>,
) -> Result<(), String> {
    let wrong = |reason: String| format!("object `{name}`, file `{file}`: {reason}");
    let (mesh, overhang_m) = read.map_err(wrong)?;
    let sum = mesh.triangles().len() + problem.meshes.iter().map(|m| m.mesh.triangles().len()).sum::<usize>();
    if sum > MOST_TRIANGLES {
        return Err(wrong(format!(
            "with it the meshes of this problem have {sum} triangles, each as often as it stands there, at most {MOST_TRIANGLES}: simplify them"
        )));
    }
    problem.meshes.push(MeshObstacle { name, pose, mesh, overhang_m });
    Ok(())
}

impl PointsEntry {
    fn read(self, name: &str, pose: &Pose, files: &mut Files<'_>) -> Result<Cloud, String> {
        let points = match (self.file, self.points) {
            (Some(file), None) => {
                let wrong = |reason: String| format!("object `{name}`, file `{file}`: {reason}");
                let bytes = files.bytes(&file).map_err(wrong)?;
                point_files::points(&file, &bytes).map_err(|error| wrong(error.to_string()))?
            }
            (None, Some(points)) => points,
            _ => return Err(format!("object `{name}` has either a `file` or `points`")),
        };
        let cloud = Cloud::new(name, &points, self.radius).and_then(|cloud| cloud.moved(pose));
        let thinned = cloud.and_then(|cloud| cloud.thinned(self.thin.unwrap_or(0.0)));
        let wrong = |reason: String| format!("object `{name}`: {reason}");
        if let Some(margin_m) = self.self_filter
            && !(0.0..=MOST_SELF_FILTER_M).contains(&margin_m)
        {
            return Err(wrong(format!("its `self_filter` is {margin_m} m: expected 0 to {MOST_SELF_FILTER_M}")));
        }
        let thinned = thinned.map_err(|error| wrong(error.to_string()))?;
        files.count(&thinned).map_err(wrong)?;
        Ok(thinned)
    }
}

impl MeshEntry {
    fn read(self, files: &mut Files<'_>) -> Result<Arc<Mesh>, String> {
        let scale = match self.scale {
            None => [1.0; 3],
            Some(Scale::All(scale)) => [scale; 3],
            Some(Scale::Each(scale)) => scale,
        };
        let read = |bytes: &[u8]| Mesh::read(&self.file, bytes, scale).map_err(|error| error.to_string());
        files.mesh(&self.file, format!("{scale:?}"), read)
    }
}

impl HeightsEntry {
    fn read(self, files: &mut Files<'_>) -> Result<Arc<Mesh>, String> {
        if !self.size.iter().all(|s| *s > 0.0 && s.is_finite()) {
            return Err("its `size` is two lengths in metres".to_owned());
        }
        let HeightsEntry { size, scale, bottom, .. } = self;
        let scale = scale.unwrap_or(1.0);
        let read = |bytes: &[u8]| {
            let solid = Heights::read(bytes, scale).and_then(|heights| heights.solid(size, bottom));
            solid.map_err(|error| error.to_string())
        };
        files.mesh(&self.file, format!("{size:?} {scale} {bottom}"), read)
    }
}

fn overhang_m(overhang: Option<f64>) -> Result<f64, String> {
    let overhang = overhang.unwrap_or(OVERHANG_M);
    let fits = (0.001..=0.1).contains(&overhang);
    if fits { Ok(overhang) } else { Err(format!("its `overhang` is {overhang} m: expected 0.001 to 0.1")) }
}
