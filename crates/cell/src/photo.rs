//! A photograph of the cell's initial scene from any viewpoint: for people who want to see what a configuration means.

use crate::config::CellConfig;
use crate::core::cell::Cell;
use anyhow::{Context as _, ensure};
use ratn_motion::robot::Configuration;
use ratn_perception::camera::{Camera, Intrinsics};

/// 1280 × 960 pixels, 65° × 51°.
const OPTICS: Intrinsics = Intrinsics { width: 1280, height: 960, fx: 1000.0, fy: 1000.0, cx: 639.5, cy: 479.5 };

/// A PNG photograph of the cell from one point towards another, in metres, in the world; without `from`, by a camera at the pose of the robot's own.
///
/// # Errors
/// If the config is invalid, no table can be laid, or both points are the same.
pub fn photo(config: CellConfig, from: Option<[f64; 3]>, towards: [f64; 3]) -> anyhow::Result<Vec<u8>> {
    config.check()?;
    let cell = Cell::new(config)?;
    let camera = match from {
        Some(eye) => {
            let way: f64 = (0..3).map(|i| (eye[i] - towards[i]).powi(2)).sum();
            ensure!(way > 1e-6, "the picture is taken from where it looks to: name another place");
            Camera::looking(eye, towards, OPTICS)
        }
        None => {
            let (pan, tilt) = cell.robot().look_at(&cell.configuration(), towards);
            let looking = Configuration { pan, tilt, ..cell.configuration() };
            let pose = cell.robot().camera_pose(&looking).context("the robot has no camera: say from where")?;
            Camera { intrinsics: OPTICS, pose }
        }
    };
    Ok(cell.scenery().photograph(cell.robot(), &camera).to_png()?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn the_cell_is_photographed_from_anywhere_but_not_from_where_it_looks_to() {
        let photo = |from| photo(CellConfig::default(), from, [0.8, 0.0, 0.7]);
        let (aside, own) = (photo(Some([2.6, -2.2, 2.2])).unwrap(), photo(None).unwrap());
        assert!(aside.starts_with(b"\x89PNG") && own.starts_with(b"\x89PNG") && aside != own);
        assert!(photo(Some([0.8, 0.0, 0.7])).is_err());
    }
}
