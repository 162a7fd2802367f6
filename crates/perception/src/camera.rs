//! The camera model: a pinhole without distortion, and the depth images it makes.
//!
//! The optical frame has z forward, x right and y down, as in image processing. A depth is the z coordinate of the point
//! seen, in metres; 0 means no return.

use ratn_model::pose::Pose;
use serde::{Deserialize, Serialize};

/// The parameters of a pinhole camera, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Column of the optical axis.
    pub cx: f64,
    /// Row of the optical axis.
    pub cy: f64,
}

/// A camera with its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Its optics.
    pub intrinsics: Intrinsics,
    /// The pose of its optical frame in the world.
    pub pose: Pose,
}

/// A depth image.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Depths along the optical axis in metres, row by row from the upper left; 0 is no return.
    pub depth: Vec<f32>,
}

/// Why bytes are not a depth image.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// The wrong number of bytes.
    #[error("a depth image of {width} × {height} has {expected} bytes (f32, row by row), not {found}")]
    Length {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
        /// The expected number of bytes.
        expected: usize,
        /// The actual number of bytes.
        found: usize,
    },
    /// The image is larger than any supported camera's.
    #[error("an image of {width} × {height} is larger than {MAX_SIDE} × {MAX_SIDE}")]
    TooLarge {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
    },
}

/// The largest side of an image that is accepted.
pub const MAX_SIDE: usize = 4096;

impl Intrinsics {
    /// 320 × 240 pixels and 52° × 40°: modest, so that a frame costs milliseconds, and wide enough for the table.
    pub const DEFAULT: Intrinsics = Intrinsics { width: 320, height: 240, fx: 330.0, fy: 330.0, cx: 159.5, cy: 119.5 };

    /// The direction of a pixel's ray in the optical frame, with z = 1: multiplied by the depth, it is the point.
    pub fn ray(&self, column: usize, row: usize) -> [f64; 3] {
        [(column as f64 - self.cx) / self.fx, (row as f64 - self.cy) / self.fy, 1.0]
    }

    /// Column and row at which a point of the optical frame appears; `None` behind the camera.
    pub fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        (point[2] > 1e-6).then(|| [self.fx * point[0] / point[2] + self.cx, self.fy * point[1] / point[2] + self.cy])
    }
}

impl Camera {
    /// A camera without roll at one point that looks at another; both in the world, z up.
    pub fn looking(eye: [f64; 3], target: [f64; 3], intrinsics: Intrinsics) -> Camera {
        let way = [0, 1, 2].map(|i| target[i] - eye[i]);
        let (yaw, pitch) = (way[1].atan2(way[0]), (-way[2]).atan2(way[0].hypot(way[1])));
        let head = Pose::from_rpy(eye, 0.0, pitch, yaw);
        // The optical axis is the head's x, right is its -y.
        let optical = Pose { position: [0.0; 3], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5] };
        Camera { intrinsics, pose: head.compose(&optical) }
    }
}

impl DepthImage {
    /// The image as little-endian f32.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.depth.iter().flat_map(|d| d.to_le_bytes()).collect()
    }

    /// The image from little-endian f32.
    ///
    /// # Errors
    /// [`ImageError`] when the size and the bytes do not fit together.
    pub fn from_bytes(width: usize, height: usize, bytes: &[u8]) -> Result<DepthImage, ImageError> {
        if width > MAX_SIDE || height > MAX_SIDE {
            return Err(ImageError::TooLarge { width, height });
        }
        let expected = width * height * size_of::<f32>();
        if bytes.len() != expected {
            return Err(ImageError::Length { width, height, expected, found: bytes.len() });
        }
        let depth = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Ok(DepthImage { width, height, depth })
    }

    /// The depth of a pixel; `None` for no return.
    pub fn at(&self, column: usize, row: usize) -> Option<f64> {
        let depth = *self.depth.get(row * self.width + column)?;
        (depth.is_finite() && depth > 0.0).then_some(f64::from(depth))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn an_image_reads_back_from_its_bytes() {
        let image = DepthImage { width: 2, height: 2, depth: vec![0.0, 1.5, 2.25, 0.125] };
        assert_eq!(DepthImage::from_bytes(2, 2, &image.to_bytes()).unwrap(), image);
        assert!(DepthImage::from_bytes(2, 3, &image.to_bytes()).is_err());
        assert!(DepthImage::from_bytes(1 << 40, 1 << 40, &[]).is_err());
    }

    #[test]
    fn a_camera_sees_what_it_looks_at_in_its_middle_and_what_is_above_it_higher() {
        let camera = Camera::looking([1.0, -2.0, 1.5], [0.0, 0.3, 0.7], Intrinsics::DEFAULT);
        let seen = |point| camera.intrinsics.project(camera.pose.inverse().transform(point)).unwrap();
        let [column, row] = seen([0.0, 0.3, 0.7]);
        assert!((column - camera.intrinsics.cx).abs() < 1e-6 && (row - camera.intrinsics.cy).abs() < 1e-6);
        let [above, higher] = seen([0.0, 0.3, 0.9]);
        assert!((above - column).abs() < 1e-6 && higher < row);
    }

    #[test]
    fn a_pixel_projects_to_itself() {
        let camera = Intrinsics::DEFAULT;
        let ray = camera.ray(17, 230);
        let back = camera.project([ray[0] * 1.7, ray[1] * 1.7, 1.7]).unwrap();
        assert!((back[0] - 17.0).abs() < 1e-9 && (back[1] - 230.0).abs() < 1e-9);
    }
}
