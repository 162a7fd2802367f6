//! The appearance of a robot: the visuals of its URDF, with their colours.
//!
//! Visuals affect no decision, so they are read separately from the robot, by the code that draws it; a visual that cannot be read is reported and
//! left out. A visual has the colour of its material in the URDF, else the one of its mesh (Collada, or the materials beside an OBJ), else none.
//! Textures are not read.

use crate::description::{DescriptionError, Files};
use crate::geometry::Body;
use crate::mesh::{Colour, MAX_TRIANGLES, Mesh, MeshError};
use crate::robot::Robot;
use crate::urdf;
use ratn_model::pose::Pose;
use std::collections::BTreeMap;
use std::path::Path;

/// Maximum number of visuals of a robot, and maximum number of mesh files for them.
pub const MAX_VISUALS: usize = 4_096;
/// See [`MAX_VISUALS`].
pub const MAX_MESH_FILES: usize = 256;

/// Maximum number of different colours of a file.
const MAX_COLOURS: usize = 32;

/// The visuals of a robot.
#[derive(Debug, Clone, Default)]
pub struct Looks {
    /// In the order of the URDF. A file with several colours makes several visuals.
    pub visuals: Vec<Visual>,
    /// The meshes of the visuals, of one colour each; each file is read once, however many visuals use it.
    pub meshes: Vec<Mesh>,
    /// The visuals that could not be read.
    pub lacks: Vec<Lack>,
}

/// A visible shape of a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Visual {
    /// The name of its link.
    pub link: String,
    /// Its form.
    pub form: VisualForm,
    /// Its colour, if known.
    pub colour: Option<Colour>,
}

/// The form of a visual, in the link's frame.
#[derive(Debug, Clone, PartialEq)]
pub enum VisualForm {
    /// A primitive.
    Primitive(Body),
    /// A mesh.
    Mesh {
        /// Its index in [`Looks::meshes`].
        mesh: usize,
        /// The pose of its origin.
        pose: Pose,
    },
}

/// A visual that could not be read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lack {
    /// The link; empty if it concerns all of them.
    pub link: String,
    /// What is missing, and why.
    pub reason: String,
}

impl Looks {
    /// The visuals of the built-in robot of this name, or of the one that a `robot.toml` describes.
    pub fn named_or_file(robot: &str) -> Looks {
        let read = match Robot::built_in_urdf(robot) {
            Some(urdf) => Ok(Looks::read(urdf, &mut |_| Err(MeshError::Kind))),
            None => {
                Files::read(Path::new(robot)).map(|files| Looks::read(&files.urdf, &mut |name| files.meshes.read(name)))
            }
        };
        read.unwrap_or_else(|error: DescriptionError| Looks::unread(error.to_string()))
    }

    /// The visuals of a URDF; `load` returns the content of a mesh file.
    pub fn read(urdf: &str, load: &mut dyn FnMut(&str) -> Result<Vec<u8>, MeshError>) -> Looks {
        let robot = match urdf::parse(urdf) {
            Ok((robot, _)) => robot,
            Err(error) => return Looks::unread(error.to_string()),
        };
        let materials = materials(&robot);
        let mut reader = Reader { load, files: BTreeMap::new(), triangles: 0, looks: Looks::default() };
        for link in &robot.links {
            for visual in &link.visual {
                if reader.looks.visuals.len() + reader.looks.lacks.len() >= MAX_VISUALS {
                    reader.lacks("", format!("of its visuals the first {MAX_VISUALS} are read"));
                    return reader.looks;
                }
                let material = visual.material.as_ref();
                let colour =
                    material.and_then(|own| own_colour(own).or_else(|| materials.get(own.name.as_str()).copied()));
                reader.visual(&link.name, visual, colour);
            }
        }
        reader.looks
    }

    fn unread(reason: String) -> Looks {
        Looks { lacks: vec![Lack { link: String::new(), reason }], ..Looks::default() }
    }
}

/// The colours of materials by name: first those of the robot, then those defined in visuals.
fn materials(robot: &urdf_rs::Robot) -> BTreeMap<&str, Colour> {
    let of_visuals = robot.links.iter().flat_map(|link| &link.visual).filter_map(|visual| visual.material.as_ref());
    let mut named = BTreeMap::new();
    for material in robot.materials.iter().chain(of_visuals).filter(|material| !material.name.is_empty()) {
        if let Some(colour) = own_colour(material) {
            named.entry(material.name.as_str()).or_insert(colour);
        }
    }
    named
}

fn own_colour(material: &urdf_rs::Material) -> Option<Colour> {
    let [red, green, blue, _] = material.color.as_ref()?.rgba.0;
    Some([red, green, blue])
}

/// Clamps a colour; NaN becomes 0.
fn proper(colour: Colour) -> Colour {
    colour.map(|part| if part.is_nan() { 0.0 } else { part.clamp(0.0, 1.0) })
}

/// The result for a file: its meshes by index, with their colours, or the reason why there are none.
type FileRead = Result<Vec<(usize, Option<Colour>)>, String>;
/// The corners of a triangle.
type Corners = [[f64; 3]; 3];

struct Reader<'l> {
    load: &'l mut dyn FnMut(&str) -> Result<Vec<u8>, MeshError>,
    /// The results by file name and scale.
    files: BTreeMap<(String, [u64; 3]), FileRead>,
    /// Number of triangles of all meshes so far.
    triangles: usize,
    looks: Looks,
}

impl Reader<'_> {
    fn visual(&mut self, link: &str, visual: &urdf_rs::Visual, colour: Option<Colour>) {
        let pose = urdf::origin(&visual.origin);
        let seen = |form, colour: Option<Colour>| Visual { link: link.to_owned(), form, colour: colour.map(proper) };
        if let Some(geometry) = urdf::primitive(&visual.geometry) {
            let form = VisualForm::Primitive(geometry.at(pose));
            self.looks.visuals.push(seen(form, colour));
        } else if let urdf_rs::Geometry::Mesh { filename, scale } = &visual.geometry {
            let scale = scale.map_or([1.0; 3], |scale| scale.0);
            let key = (filename.clone(), scale.map(f64::to_bits));
            let read = match self.files.get(&key) {
                Some(read) => read.clone(),
                None => {
                    let read = self.file(filename, scale);
                    self.files.insert(key, read.clone());
                    read
                }
            };
            match read {
                Ok(meshes) => self.looks.visuals.extend(
                    meshes.into_iter().map(|(mesh, own)| seen(VisualForm::Mesh { mesh, pose }, colour.or(own))),
                ),
                Err(reason) => self.lacks(link, format!("the mesh `{filename}`: {reason}")),
            }
        }
    }

    /// Reads the meshes of a file.
    fn file(&mut self, name: &str, scale: [f64; 3]) -> Result<Vec<(usize, Option<Colour>)>, String> {
        if self.files.len() >= MAX_MESH_FILES {
            return Err(format!("at most {MAX_MESH_FILES} files are read"));
        }
        let bytes = (self.load)(name).map_err(|error| error.to_string())?;
        // Materials are looked for only in the folder of their mesh.
        let folder = name.rfind('/').map_or("", |end| &name[..=end]);
        let beside = &mut |file: &str| {
            let file = file.rsplit(['/', '\\']).next().unwrap_or(file);
            (self.load)(&format!("{folder}{file}")).ok()
        };
        let parts = Mesh::parts(name, &bytes, scale, beside).map_err(|error| error.to_string())?;
        let count: usize = parts.iter().map(|part| part.triangles.len()).sum();
        if count == 0 || self.triangles + count > MAX_TRIANGLES {
            let all = self.triangles;
            return Err(format!(
                "it has {count} triangles, behind {all} of other files: expected 1 to {MAX_TRIANGLES} in all"
            ));
        }
        // All triangles of one colour are one mesh.
        let mut by_colour: Vec<(Option<Colour>, Vec<Corners>)> = Vec::new();
        for mut part in parts {
            let known = by_colour.iter().position(|(colour, _)| *colour == part.colour);
            match known.or((by_colour.len() == MAX_COLOURS).then_some(MAX_COLOURS - 1)) {
                Some(place) => by_colour[place].1.append(&mut part.triangles),
                None => by_colour.push((part.colour, part.triangles)),
            }
        }
        by_colour.retain(|(_, triangles)| !triangles.is_empty());
        let made = by_colour.into_iter().map(|(colour, triangles)| Ok((Mesh::new(triangles)?, colour)));
        let made: Vec<(Mesh, Option<Colour>)> =
            made.collect::<Result<_, MeshError>>().map_err(|error| error.to_string())?;
        self.triangles += count;
        let first = self.looks.meshes.len();
        let numbers = made.iter().enumerate().map(|(index, (_, colour))| (first + index, *colour)).collect();
        self.looks.meshes.extend(made.into_iter().map(|(mesh, _)| mesh));
        Ok(numbers)
    }

    fn lacks(&mut self, link: &str, reason: String) {
        self.looks.lacks.push(Lack { link: link.to_owned(), reason });
    }
}
