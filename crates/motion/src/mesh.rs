//! Triangle meshes as collision shapes: read from STL, OBJ and Collada, and covered by spheres (`mesh_cover`). Files are found and read
//! by `mesh_files` or by the user of the crate.

use crate::inside::Inside;
use crate::mesh_pieces;
pub use crate::mesh_pieces::{ConvexPiece, MeshPieces};
use crate::spheres::Sphere;
use crate::{collada, mesh_cover, obj, stl};
use parry3d::math::Vector;
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::sync::{Arc, OnceLock};

/// Maximum number of triangles in a mesh.
pub const MAX_TRIANGLES: usize = 1_000_000;

/// Why a mesh cannot be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// The format is not supported.
    #[error("only STL, OBJ and Collada (.dae) meshes are supported; convert it")]
    Kind,
    /// A text file has an error.
    #[error("line {line}: {reason}")]
    Text {
        /// Line number, from 1.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// The file ends too early, or has no triangles or too many.
    #[error("{triangles} triangles announced, {bytes} bytes there: expected 1 to {MAX_TRIANGLES} whole triangles")]
    Triangles {
        /// Number of triangles according to the file.
        triangles: usize,
        /// Length of the file.
        bytes: usize,
    },
    /// No triangles, or too many.
    #[error("it has {triangles} triangles: expected 1 to {MAX_TRIANGLES}; simplify it")]
    Count {
        /// Their number.
        triangles: usize,
    },
    /// A text is not valid STL.
    #[error("line {line} is no vertex of three numbers, or comes too early or too late for a triangle")]
    Line {
        /// Line number, from 1.
        line: usize,
    },
    /// The scale is zero or not finite.
    #[error("its scale is {scale:?}: each number is finite and not zero; a negative one mirrors")]
    Scale {
        /// Scale along x, y, z.
        scale: [f64; 3],
    },
    /// The mesh is so large that its numbers are hardly in metres.
    #[error(
        "it is {extent_m:.0} m long: where its numbers are millimetres, give it `scale=\"0.001 0.001 0.001\"`; where it is as large as that, \
         `scale=\"1 1 1\"`"
    )]
    Large {
        /// Longest side of its bounding box, in metres.
        extent_m: f64,
    },
    /// A corner is not finite or too far away.
    #[error("a corner of triangle {triangle} is not finite, or it is beyond a kilometre")]
    NotFinite {
        /// Index of the triangle, from 0.
        triangle: usize,
    },
    /// The file cannot be read.
    #[error("cannot be read: {reason}")]
    Read {
        /// The reason.
        reason: String,
    },
}

/// Triangles, in metres.
#[derive(Debug, Clone)]
pub struct Mesh {
    triangles: Vec<[[f64; 3]; 3]>,
    /// Surface and inside for the exact checks, computed when first needed.
    solid: OnceLock<(SharedShape, Arc<Inside>)>,
    /// Spheres that cover it, computed when first needed.
    cover: OnceLock<Vec<Sphere>>,
    /// Convex pieces that hold it, computed when first needed.
    pieces: OnceLock<MeshPieces>,
}

impl PartialEq for Mesh {
    fn eq(&self, other: &Mesh) -> bool {
        self.triangles == other.triangles
    }
}

/// Red, green and blue, each from 0 to 1.
pub type Colour = [f64; 3];

/// Consecutive triangles of a file that have one colour, if the file gives one.
pub(crate) struct Part {
    pub(crate) colour: Option<Colour>,
    pub(crate) triangles: Vec<[[f64; 3]; 3]>,
}

/// A mesh fixed to a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Meshed {
    /// Its pose in the link's frame.
    pub pose: Pose,
    /// The mesh.
    pub mesh: Arc<Mesh>,
}

impl Mesh {
    /// A mesh of triangles, in metres.
    ///
    /// # Errors
    /// [`MeshError`] where there are no triangles, too many, or one that is not finite.
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

    /// Makes a mesh of triangles of another mesh, moved or selected.
    pub(crate) fn placed(triangles: Vec<[[f64; 3]; 3]>) -> Mesh {
        Mesh { triangles, solid: OnceLock::new(), cover: OnceLock::new(), pieces: OnceLock::new() }
    }

    /// Reads a file by its extension: `.stl`, `.obj` or `.dae`; `scale` converts its numbers along x, y, z to metres. Where a scale
    /// mirrors, the order of corners is reversed, so that the same side is outside.
    ///
    /// # Errors
    /// [`MeshError`] names the problem.
    pub fn read(name: &str, bytes: &[u8], scale: [f64; 3]) -> Result<Mesh, MeshError> {
        let mut triangles = Vec::new();
        for mut part in Mesh::parts(name, bytes, scale, &mut |_| None)? {
            triangles.append(&mut part.triangles);
        }
        Mesh::new(triangles)
    }

    /// Reads a file, as [`Mesh::read`], with its colours; in the order of the file. `beside` returns the content of a file that it
    /// refers to.
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
    /// [`MeshError`] names the problem.
    pub fn stl(bytes: &[u8], scale: [f64; 3]) -> Result<Mesh, MeshError> {
        Mesh::read(".stl", bytes, scale)
    }

    /// The corners of the triangles.
    pub fn triangles(&self) -> &[[[f64; 3]; 3]] {
        &self.triangles
    }

    /// The surface as a shape for parry3d.
    pub(crate) fn shape(&self) -> SharedShape {
        let corners = self.triangles.iter().flatten().map(|[x, y, z]| Vector::new(*x as f32, *y as f32, *z as f32));
        let indices = (0..self.triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let ball = || SharedShape::ball(0.0);
        // parry3d refuses only a mesh without triangles, and no such mesh exists.
        SharedShape::trimesh(corners.collect(), indices).unwrap_or_else(|_| ball())
    }

    /// The surface, for parry3d; shared by all calls.
    pub fn surface(&self) -> SharedShape {
        self.solid().0
    }

    /// The surface and the inside; shared by all calls.
    pub(crate) fn solid(&self) -> (SharedShape, Arc<Inside>) {
        self.solid.get_or_init(|| (self.shape(), Arc::new(Inside::new(self)))).clone()
    }

    /// The longest side of its axis-aligned bounding box, in metres.
    pub(crate) fn extent_m(&self) -> f64 {
        let corners = || self.triangles.iter().flatten();
        let along = |i: usize| {
            let least = corners().map(|corner| corner[i]).fold(f64::INFINITY, f64::min);
            corners().map(|corner| corner[i]).fold(f64::NEG_INFINITY, f64::max) - least
        };
        (0..3).map(along).fold(0.0, f64::max)
    }

    /// Convex pieces that hold it; the same ones at every call.
    pub fn pieces(&self) -> &MeshPieces {
        self.pieces.get_or_init(|| {
            let (shape, inside) = self.solid();
            mesh_pieces::pieces(&self.triangles, &shape, &inside)
        })
    }

    /// Spheres that cover it, each `padding` metres larger.
    pub fn cover(&self, padding: f64) -> Vec<Sphere> {
        let spheres = self.cover.get_or_init(|| mesh_cover::cover(&self.triangles));
        spheres.iter().map(|sphere| Sphere { radius: sphere.radius + padding.max(0.0), ..*sphere }).collect()
    }
}

impl Meshed {
    /// Spheres in the link's frame that cover it, each `padding` metres larger.
    pub fn cover(&self, padding: f64) -> Vec<Sphere> {
        let spheres = self.mesh.cover(padding).into_iter();
        spheres.map(|s| Sphere { centre: self.pose.transform(s.centre), ..s }).collect()
    }
}
