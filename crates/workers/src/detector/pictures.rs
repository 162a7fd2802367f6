//! Saves pictures with their detections as PNG files, for people; the oldest are overwritten.

use ratn_perception::camera::{Camera, DepthImage};
use ratn_perception::detection::Detection;
use ratn_perception::picture::Picture;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Maximum number of pictures that a detector keeps.
const MAX_PICTURES: usize = 500;

/// The folder for pictures, if any.
#[derive(Debug, Clone, Default)]
pub(super) struct Pictures(Option<Arc<Folder>>);

#[derive(Debug)]
struct Folder {
    path: PathBuf,
    taken: AtomicUsize,
}

impl Pictures {
    pub(super) fn into(folder: Option<PathBuf>) -> Pictures {
        Pictures(folder.map(|path| Arc::new(Folder { path, taken: AtomicUsize::new(0) })))
    }

    /// Saves a picture with its detections. A full disk does not make the detection fail.
    pub(super) fn keep(&self, image: &DepthImage, camera: &Camera, found: &[Detection]) {
        let Some(folder) = &self.0 else { return };
        let number = folder.taken.fetch_add(1, Ordering::Relaxed) % MAX_PICTURES;
        let path = folder.path.join(format!("detector-{}-{number:03}.png", std::process::id()));
        let mut picture = Picture::of_depth(image);
        found.iter().for_each(|object| picture.draw(camera, object));
        if let Err(reason) = write(&path, &picture) {
            tracing::warn!("no picture at {}: {reason:#}", path.display());
        }
    }
}

fn write(path: &Path, picture: &Picture) -> anyhow::Result<()> {
    Ok(std::fs::write(path, picture.to_png()?)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::pose::Pose;
    use ratn_perception::camera::Intrinsics;

    #[test]
    fn pictures_are_kept_where_they_shall_and_a_folder_that_is_not_there_is_no_failure() {
        let folder = tempfile::tempdir().unwrap();
        let camera = Camera { intrinsics: Intrinsics::DEFAULT, pose: Pose::IDENTITY };
        let image = DepthImage { width: 4, height: 4, depth: vec![1.0; 16] };
        let pictures = Pictures::into(Some(folder.path().to_owned()));
        pictures.keep(&image, &camera, &[]);
        pictures.keep(&image, &camera, &[]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
        Pictures::into(Some(folder.path().join("none"))).keep(&image, &camera, &[]);
        Pictures::default().keep(&image, &camera, &[]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
