//! Triangle meshes as collision shapes: read from STL, OBJ and Collada, and held by spheres.
//!
//! For the cover the mesh is put into a grid; the cells that the surface passes through and those that it closes in get a sphere
//! around each. So everything of the mesh is in a sphere by construction, its inside too where it is closed. Files are found and
//! read by `mesh_files` or by whoever uses the crate.

use crate::frame::norm;
use crate::inside::Inside;
use crate::spheres::Sphere;
use crate::{collada, obj, stl};
use parry3d::math::Vector;
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::sync::{Arc, OnceLock};

/// Triangles of a mesh at the most.
pub const MAX_TRIANGLES: usize = 1_000_000;

/// Spheres that hold one mesh at the most, and cells along its longest edge in the first, finest grid.
const MAX_SPHERES: usize = 96;
const FINEST: usize = 24;

/// Cells that the triangles are looked for in: a mesh of many that are all as large as itself is put into a coarser grid.
const MOST_LOOKS: usize = 5_000_000;

/// Surfaces that lie between two cells belong to both, in cells.
const SKIN: f64 = 1e-6;

/// Why there is no mesh.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// Of another kind.
    #[error("only STL, OBJ and Collada (.dae) meshes are supported; convert it")]
    Kind,
    /// Something in a file of text that cannot be read.
    #[error("line {line}: {reason}")]
    Text {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// It ends too early, or has no triangles, or too many.
    #[error("{triangles} triangles announced, {bytes} bytes there: expected 1 to {MAX_TRIANGLES} whole triangles")]
    Triangles {
        /// As the file says.
        triangles: usize,
        /// How long the file is.
        bytes: usize,
    },
    /// No triangles, or too many.
    #[error("it has {triangles} triangles: expected 1 to {MAX_TRIANGLES}; simplify it")]
    Count {
        /// How many.
        triangles: usize,
    },
    /// A text that is no STL.
    #[error("line {line} is no vertex of three numbers, or comes too early or too late for a triangle")]
    Line {
        /// Counted from 1.
        line: usize,
    },
    /// A scale that leaves no volume.
    #[error("its scale is {scale:?}: each number is finite and not zero; a negative one mirrors")]
    Scale {
        /// Along x, y, z.
        scale: [f64; 3],
    },
    /// So large that its numbers are hardly metres.
    #[error(
        "it is {extent_m:.0} m long: where its numbers are millimetres, give it `scale=\"0.001 0.001 0.001\"`; where it is as large as that, \
         `scale=\"1 1 1\"`"
    )]
    Large {
        /// Along the longest side of the box that holds it, in metres.
        extent_m: f64,
    },
    /// Not finite.
    #[error("a corner of triangle {triangle} is not finite, or it is beyond a kilometre")]
    NotFinite {
        /// Counted from 0.
        triangle: usize,
    },
    /// It cannot be read.
    #[error("cannot be read: {reason}")]
    Read {
        /// Why not.
        reason: String,
    },
}

/// Triangles, in metres.
#[derive(Debug, Clone)]
pub struct Mesh {
    triangles: Vec<[[f64; 3]; 3]>,
    /// As the exact checks want it, made when it is first asked for.
    solid: OnceLock<(SharedShape, Arc<Inside>)>,
}

impl PartialEq for Mesh {
    fn eq(&self, other: &Mesh) -> bool {
        self.triangles == other.triangles
    }
}

/// Red, green and blue, each from 0 to 1.
pub type Colour = [f64; 3];

/// Triangles of a file that follow each other and have one colour, if the file says which.
pub(crate) struct Part {
    pub(crate) colour: Option<Colour>,
    pub(crate) triangles: Vec<[[f64; 3]; 3]>,
}

/// A mesh fixed to a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Meshed {
    /// In the link's frame.
    pub pose: Pose,
    /// What it is.
    pub mesh: Arc<Mesh>,
}

impl Mesh {
    /// A mesh of triangles, in metres.
    ///
    /// # Errors
    /// [`MeshError`] where there are none, too many, or one that is not finite.
    pub fn new(triangles: Vec<[[f64; 3]; 3]>) -> Result<Mesh, MeshError> {
        if triangles.is_empty() || triangles.len() > MAX_TRIANGLES {
            return Err(MeshError::Count { triangles: triangles.len() });
        }
        let is_wild = |c: &f64| c.is_nan() || c.abs() > 1e3;
        match triangles.iter().position(|triangle| triangle.iter().flatten().any(is_wild)) {
            Some(triangle) => Err(MeshError::NotFinite { triangle }),
            None => Ok(Mesh::placed(triangles)),
        }
    }

    /// Triangles of a mesh, or some of them, that were moved.
    pub(crate) fn placed(triangles: Vec<[[f64; 3]; 3]>) -> Mesh {
        Mesh { triangles, solid: OnceLock::new() }
    }

    /// Reads a file, by the end of its name: `.stl`, `.obj` or `.dae`; its numbers are multiplied by `scale` along x, y, z to be metres.
    /// Where a scale mirrors, triangles are turned, so that the same side is outside.
    ///
    /// # Errors
    /// [`MeshError`] says what is wrong with it.
    pub fn read(name: &str, bytes: &[u8], scale: [f64; 3]) -> Result<Mesh, MeshError> {
        let mut triangles = Vec::new();
        for mut part in Mesh::parts(name, bytes, scale, &mut |_| None)? {
            triangles.append(&mut part.triangles);
        }
        Mesh::new(triangles)
    }

    /// Reads a file, as [`Mesh::read`], with its colours; in the order of the file. `beside` gives what is in a file that it names.
    pub(crate) fn parts(
        name: &str,
        bytes: &[u8],
        scale: [f64; 3],
        beside: &mut dyn FnMut(&str) -> Option<Vec<u8>>,
    ) -> Result<Vec<Part>, MeshError> {
        if scale.iter().any(|s| *s == 0.0 || !s.is_finite()) {
            return Err(MeshError::Scale { scale });
        }
        let plain = |triangles| vec![Part { colour: None, triangles }];
        let name = name.to_ascii_lowercase();
        let mut parts = match name.rsplit_once('.') {
            Some((_, "stl")) => plain(stl::triangles(bytes)?),
            Some((_, "obj")) => obj::parts(bytes, beside)?,
            Some((_, "dae")) => collada::parts(bytes)?,
            _ => return Err(MeshError::Kind),
        };
        let is_mirrored = scale.iter().product::<f64>() < 0.0;
        for triangle in parts.iter_mut().flat_map(|part| &mut part.triangles) {
            *triangle = triangle.map(|corner| std::array::from_fn(|i| corner[i] * scale[i]));
            if is_mirrored {
                triangle.swap(1, 2);
            }
        }
        Ok(parts)
    }

    /// Reads an STL, as [`Mesh::read`].
    ///
    /// # Errors
    /// [`MeshError`] says what is wrong with it.
    pub fn stl(bytes: &[u8], scale: [f64; 3]) -> Result<Mesh, MeshError> {
        Mesh::read(".stl", bytes, scale)
    }

    /// Corners of the triangles.
    pub fn triangles(&self) -> &[[[f64; 3]; 3]] {
        &self.triangles
    }

    /// The shape for parry3d: the surface.
    pub(crate) fn shape(&self) -> SharedShape {
        let corners = self.triangles.iter().flatten().map(|[x, y, z]| Vector::new(*x as f32, *y as f32, *z as f32));
        let indices = (0..self.triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let ball = || SharedShape::ball(0.0);
        // It refuses meshes without triangles only, and there are none.
        SharedShape::trimesh(corners.collect(), indices).unwrap_or_else(|_| ball())
    }

    /// The surface, for parry3d; the same one whenever it is asked for.
    pub fn surface(&self) -> SharedShape {
        self.solid().0
    }

    /// The surface and the inside; the same ones whenever it is asked for.
    pub(crate) fn solid(&self) -> (SharedShape, Arc<Inside>) {
        self.solid.get_or_init(|| (self.shape(), Arc::new(Inside::new(self)))).clone()
    }

    /// The longest side of the box along its axes that holds it, in metres.
    pub(crate) fn extent_m(&self) -> f64 {
        let corners = || self.triangles.iter().flatten();
        let along = |i: usize| {
            let least = corners().map(|corner| corner[i]).fold(f64::INFINITY, f64::min);
            corners().map(|corner| corner[i]).fold(f64::NEG_INFINITY, f64::max) - least
        };
        (0..3).map(along).fold(0.0, f64::max)
    }

    /// The farthest of its corners from its origin.
    pub(crate) fn radius(&self) -> f64 {
        self.triangles.iter().flatten().map(|corner| norm(*corner)).fold(0.0, f64::max)
    }

    /// Spheres that hold it, `padding` metres larger.
    pub fn cover(&self, padding: f64) -> Vec<Sphere> {
        let mut cells = FINEST;
        while cells > 1 && self.looks(cells) > MOST_LOOKS {
            cells = cells * 4 / 5;
        }
        loop {
            let grid = Grid::new(self, cells);
            let spheres = grid.spheres(padding);
            if spheres.len() <= MAX_SPHERES || cells == 1 {
                return spheres;
            }
            cells = cells * 4 / 5;
        }
    }
}

impl Mesh {
    /// In how many cells the triangles may be, of a grid with so many along the longest edge.
    fn looks(&self, longest: usize) -> usize {
        let cell = self.extent_m().max(1e-9) / longest as f64;
        let of = |triangle: &[[f64; 3]; 3]| -> usize {
            let along = |i: usize| {
                let least = triangle.iter().map(|corner| corner[i]).fold(f64::INFINITY, f64::min);
                let greatest = triangle.iter().map(|corner| corner[i]).fold(f64::NEG_INFINITY, f64::max);
                ((greatest - least) / cell) as usize + 1
            };
            (0..3).map(along).product()
        };
        self.triangles.iter().map(of).sum()
    }
}

impl Meshed {
    /// Spheres, in the link's frame, that hold it and `padding` metres around.
    pub fn cover(&self, padding: f64) -> Vec<Sphere> {
        let spheres = self.mesh.cover(padding).into_iter();
        spheres.map(|s| Sphere { centre: self.pose.transform(s.centre), ..s }).collect()
    }
}

/// Cells over the box that holds a mesh.
struct Grid {
    least: [f64; 3],
    cell: [f64; 3],
    counts: [usize; 3],
    taken: Vec<bool>,
}

impl Grid {
    /// With so many cells along the longest edge.
    fn new(mesh: &Mesh, longest: usize) -> Grid {
        let corners = || mesh.triangles.iter().flatten();
        let least: [f64; 3] = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::INFINITY, f64::min));
        let greatest: [f64; 3] = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::NEG_INFINITY, f64::max));
        let extents: [f64; 3] = std::array::from_fn(|i| greatest[i] - least[i]);
        let wanted = extents.into_iter().fold(1e-9, f64::max) / longest as f64;
        let counts = extents.map(|extent| ((extent / wanted).ceil() as usize).clamp(1, longest));
        let cell = std::array::from_fn(|i| (extents[i] / counts[i] as f64).max(1e-9));
        let mut grid = Grid { least, cell, counts, taken: vec![false; counts.iter().product()] };
        for triangle in &mesh.triangles {
            let polygon = triangle.iter().map(|c| std::array::from_fn(|i| (c[i] - least[i]) / cell[i])).collect();
            grid.take(polygon, 0, [0; 3]);
        }
        grid.fill();
        grid
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.counts[1] + y) * self.counts[2] + z
    }

    /// Marks the cells of a polygon, in cells, slab by slab along one axis after the other.
    fn take(&mut self, polygon: Vec<[f64; 3]>, axis: usize, at: [usize; 3]) {
        if polygon.is_empty() {
            return;
        }
        if axis == 3 {
            let index = self.index(at);
            self.taken[index] = true;
            return;
        }
        let least = polygon.iter().map(|c| c[axis]).fold(f64::INFINITY, f64::min);
        let greatest = polygon.iter().map(|c| c[axis]).fold(f64::NEG_INFINITY, f64::max);
        let last = self.counts[axis] - 1;
        let first = ((least - SKIN).floor().max(0.0) as usize).min(last);
        for slab in first..=((greatest + SKIN).floor().max(0.0) as usize).min(last) {
            let mut at = at;
            at[axis] = slab;
            let (low, high) = (slab as f64 - SKIN, (slab + 1) as f64 + SKIN);
            self.take(cut(&cut(&polygon, axis, low, 1.0), axis, high, -1.0), axis + 1, at);
        }
    }

    /// Marks what the surface closes in: all that cannot be reached from outside.
    fn fill(&mut self) {
        let mut outside = vec![false; self.taken.len()];
        let mut open = Vec::new();
        for index in 0..self.taken.len() {
            let at = self.place(index);
            if (0..3).any(|i| at[i] == 0 || at[i] + 1 == self.counts[i]) {
                open.push(at);
            }
        }
        while let Some(at) = open.pop() {
            let index = self.index(at);
            if self.taken[index] || outside[index] {
                continue;
            }
            outside[index] = true;
            for axis in 0..3 {
                let mut beside = at;
                if at[axis] > 0 {
                    beside[axis] = at[axis] - 1;
                    open.push(beside);
                }
                if at[axis] + 1 < self.counts[axis] {
                    beside[axis] = at[axis] + 1;
                    open.push(beside);
                }
            }
        }
        self.taken = outside.into_iter().map(|outside| !outside).collect();
    }

    fn place(&self, index: usize) -> [usize; 3] {
        let [_, y, z] = self.counts;
        [index / (y * z), index / z % y, index % z]
    }

    fn spheres(&self, padding: f64) -> Vec<Sphere> {
        // A little for the surfaces that lie between two cells.
        let radius = self.cell.iter().map(|c| (c * (0.5 + SKIN)).powi(2)).sum::<f64>().sqrt() + padding.max(0.0);
        let sphere = |index| {
            let at = self.place(index);
            let centre = std::array::from_fn(|i| self.least[i] + (at[i] as f64 + 0.5) * self.cell[i]);
            Sphere { centre, radius }
        };
        (0..self.taken.len()).filter(|index| self.taken[*index]).map(sphere).collect()
    }
}

/// The part of a polygon on one side of a plane (Sutherland and Hodgman, CACM 1974).
fn cut(polygon: &[[f64; 3]], axis: usize, at: f64, side: f64) -> Vec<[f64; 3]> {
    let beyond = |corner: &[f64; 3]| (corner[axis] - at) * side;
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, corner) in polygon.iter().enumerate() {
        let next = &polygon[(i + 1) % polygon.len()];
        let (here, there) = (beyond(corner), beyond(next));
        if here >= 0.0 {
            kept.push(*corner);
        }
        if (here > 0.0 && there < 0.0) || (here < 0.0 && there > 0.0) {
            let share = here / (here - there);
            kept.push(std::array::from_fn(|j| corner[j] + (next[j] - corner[j]) * share));
        }
    }
    kept
}
