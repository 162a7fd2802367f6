//! What a robot looks like: the visuals of its URDF, with their colours.
//!
//! Nothing is decided by them, so they are read apart from the robot, by whoever draws it, and a visual that cannot be read is named and
//! left out. A visual has the colour of its material in the URDF, else the one of its mesh (Collada, or the
//! materials beside an OBJ), else none. Textures are not read.

use crate::description::{DescriptionError, Files};
use crate::geometry::Body;
use crate::mesh::{Colour, MAX_TRIANGLES, Mesh, MeshError};
use crate::robot::Robot;
use crate::urdf;
use ratn_model::pose::Pose;
use std::collections::BTreeMap;
use std::path::Path;

/// Visuals of a robot at the most, and files of meshes that are read for them.
pub const MAX_VISUALS: usize = 4_096;
/// See [`MAX_VISUALS`].
pub const MAX_MESH_FILES: usize = 256;

/// Colours of a file that are told apart.
const MAX_COLOURS: usize = 32;

/// What a robot looks like.
#[derive(Debug, Clone, Default)]
pub struct Looks {
    /// In the order of the URDF. A file of several colours makes several.
    pub visuals: Vec<Visual>,
    /// The meshes of the visuals, of one colour each; those of a file once, however many visuals show it.
    pub meshes: Vec<Mesh>,
    /// What is not read.
    pub lacks: Vec<Lack>,
}

/// A shape that is seen of a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Visual {
    /// The name of its link.
    pub link: String,
    /// What it is.
    pub form: VisualForm,
    /// Its colour, where it has one.
    pub colour: Option<Colour>,
}

/// The form of a visual, in the link's frame.
#[derive(Debug, Clone, PartialEq)]
pub enum VisualForm {
    /// A primitive.
    Primitive(Body),
    /// A mesh.
    Mesh {
        /// Its number among the robot's.
        mesh: usize,
        /// Where its origin is.
        pose: Pose,
    },
}

/// Something that is not seen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lack {
    /// The link; empty where it is of all of them.
    pub link: String,
    /// What, and why.
    pub reason: String,
}

impl Looks {
    /// Those of the robot of this name that we ship, or of the one that a `robot.toml` describes.
    pub fn named_or_file(robot: &str) -> Looks {
        let read = match Robot::built_in_urdf(robot) {
            Some(urdf) => Ok(Looks::read(urdf, &mut |_| Err(MeshError::Kind))),
            None => {
                Files::read(Path::new(robot)).map(|files| Looks::read(&files.urdf, &mut |name| files.meshes.read(name)))
            }
        };
        read.unwrap_or_else(|error: DescriptionError| Looks::unread(error.to_string()))
    }

    /// Those that a URDF describes; `load` gives what is in the file of a mesh.
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

/// The colours of materials by name: those of the robot, then those that visuals say.
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

/// What is not a number is dark.
fn proper(colour: Colour) -> Colour {
    colour.map(|part| if part.is_nan() { 0.0 } else { part.clamp(0.0, 1.0) })
}

/// What came of a file: its meshes by their numbers, with their colours, or why there are none.
type FileRead = Result<Vec<(usize, Option<Colour>)>, String>;
/// The corners of a triangle.
type Corners = [[f64; 3]; 3];

struct Reader<'l> {
    load: &'l mut dyn FnMut(&str) -> Result<Vec<u8>, MeshError>,
    /// By name and scale, the numbers of the meshes of a file with their colours, or why there are none.
    files: BTreeMap<(String, [u64; 3]), FileRead>,
    /// Of all meshes so far.
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
        // Materials are looked for beside their mesh, and nowhere else.
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
        // Triangles of one colour are one mesh, wherever they stand.
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
