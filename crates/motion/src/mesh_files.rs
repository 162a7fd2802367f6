//! Finds the mesh files that a URDF names: `package://NAME/rest` below a folder of packages, `file:///path`, and paths relative to the folder of the URDF.

use crate::mesh::MeshError;
use std::path::PathBuf;

/// Maximum size of a mesh file, in bytes.
const MAX_FILE: usize = 64 << 20;

/// The folders in which files are looked for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MeshFiles {
    /// The folder of the URDF.
    pub beside: PathBuf,
    /// Folders that contain packages, or are one.
    pub packages: Vec<PathBuf>,
}

impl MeshFiles {
    /// The path of a file that a URDF names.
    ///
    /// # Errors
    /// [`MeshError::Read`] says where it was looked for.
    pub fn path(&self, name: &str) -> Result<PathBuf, MeshError> {
        let places: Vec<PathBuf> = if let Some(rest) = name.strip_prefix("package://") {
            let (package, inside) = rest.split_once('/').unwrap_or((rest, ""));
            let place = |root: &PathBuf| {
                let is_package = root.file_name().is_some_and(|folder| folder == package);
                if is_package { root.join(inside) } else { root.join(package).join(inside) }
            };
            self.packages.iter().map(place).collect()
        } else if let Some(path) = name.strip_prefix("file://") {
            vec![PathBuf::from(path)]
        } else if let Some((kind, _)) = name.split_once("://") {
            return Err(MeshError::Read { reason: format!("`{kind}:` is neither `package:` nor `file:`") });
        } else {
            vec![self.beside.join(name)]
        };
        places.iter().find(|place| place.is_file()).cloned().ok_or_else(|| {
            let all: Vec<String> = places.iter().map(|place| place.display().to_string()).collect();
            let reason = match all.is_empty() {
                true => "no folder with packages was named".to_owned(),
                false => format!("no file at {}", all.join(" or ")),
            };
            MeshError::Read { reason }
        })
    }

    /// The content of a file that a URDF names.
    ///
    /// # Errors
    /// [`MeshError::Read`] gives the reason.
    pub fn read(&self, name: &str) -> Result<Vec<u8>, MeshError> {
        let path = self.path(name)?;
        ratn_regular_file::read(&path, MAX_FILE)
            .map_err(|error| MeshError::Read { reason: format!("{}: {error}", path.display()) })
    }
}
