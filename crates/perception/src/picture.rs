//! PNG files to look at: a depth image in colours, with detections drawn into it.

use crate::camera::{Camera, DepthImage};
use crate::detection::{Detection, Symmetry};
use ratn_model::pose::Pose;
use std::f64::consts::TAU;

/// A picture, three bytes per pixel, row by row from the upper left.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Red, green and blue of every pixel.
    pub rgb: Vec<u8>,
}

/// Why a picture cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("a picture of {width} × {height} cannot be written as PNG")]
pub struct PictureError {
    width: usize,
    height: usize,
    source: png::EncodingError,
}

/// The colours of outlines and of x axes.
const OUTLINE: [u8; 3] = [255, 255, 255];
const AXIS: [u8; 3] = [255, 255, 0];
/// Number of segments of a circle.
const SIDES: u32 = 48;
/// Number of points of a line.
const STROKES: usize = 160;
/// Edges of a box; its corners are numbered by bits.
const EDGES: [(usize, usize); 12] =
    [(0, 1), (0, 2), (1, 3), (2, 3), (4, 5), (4, 6), (5, 7), (6, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

impl Picture {
    /// A depth image in colours: near is red, far is blue, shaded by slope; black is no return.
    pub fn of_depth(image: &DepthImage) -> Picture {
        let seen: Vec<f32> = image.depth.iter().copied().filter(|d| *d > 0.0).collect();
        let (near, far) = seen.iter().fold((f32::INFINITY, 0.0_f32), |(near, far), d| (near.min(*d), far.max(*d)));
        let mut rgb = Vec::with_capacity(3 * image.depth.len());
        for (pixel, depth) in image.depth.iter().enumerate() {
            if *depth <= 0.0 {
                rgb.extend([0, 0, 0]);
                continue;
            }
            let part = f64::from((depth - near) / (far - near).max(1e-6));
            let shade = 0.75 + 0.25 * (40.0 * f64::from(slope(image, pixel))).clamp(-1.0, 1.0);
            rgb.extend(hue(part).map(|c| (255.0 * shade * c) as u8));
        }
        Picture { width: image.width, height: image.height, rgb }
    }

    /// Draws the outline of a detection: for round objects the circles at the top and the bottom, for all others the bounding box and
    /// the x axis from the centre.
    pub fn draw(&mut self, camera: &Camera, found: &Detection) {
        let half = found.model.size().map(|edge| edge / 2.0);
        if found.model.class().symmetry() == Symmetry::Round {
            for side in 0..SIDES {
                let [here, next] = [side, side + 1].map(|side| {
                    let (sin, cos) = (TAU * f64::from(side) / f64::from(SIDES)).sin_cos();
                    [half[0] * cos, half[0] * sin]
                });
                for z in [-half[2], half[2]] {
                    self.line(camera, &found.pose, [here[0], here[1], z], [next[0], next[1], z], OUTLINE);
                }
                if side % (SIDES / 4) == 0 {
                    self.line(camera, &found.pose, [here[0], here[1], -half[2]], [here[0], here[1], half[2]], OUTLINE);
                }
            }
            return;
        }
        let corner = |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { -half[axis] } else { half[axis] });
        for (a, b) in EDGES {
            self.line(camera, &found.pose, corner(a), corner(b), OUTLINE);
        }
        self.line(camera, &found.pose, [0.0, 0.0, half[2]], [half[0], 0.0, half[2]], AXIS);
    }

    /// The picture as a PNG file.
    ///
    /// # Errors
    /// [`PictureError`] for a picture without pixels.
    pub fn to_png(&self) -> Result<Vec<u8>, PictureError> {
        let failed = |source| PictureError { width: self.width, height: self.height, source };
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(failed)?;
        writer.write_image_data(&self.rgb).map_err(failed)?;
        writer.finish().map_err(failed)?;
        Ok(file)
    }

    fn line(&mut self, camera: &Camera, pose: &Pose, from: [f64; 3], to: [f64; 3], colour: [u8; 3]) {
        let to_camera = camera.pose.inverse().compose(pose);
        for stroke in 0..=STROKES {
            let part = stroke as f64 / STROKES as f64;
            let point = [0, 1, 2].map(|i| from[i] + part * (to[i] - from[i]));
            let Some([column, row]) = camera.intrinsics.project(to_camera.transform(point)) else { continue };
            let (column, row) = (column.round(), row.round());
            if column >= 0.0 && row >= 0.0 && column < self.width as f64 && row < self.height as f64 {
                let pixel = 3 * (row as usize * self.width + column as usize);
                self.rgb[pixel..pixel + 3].copy_from_slice(&colour);
            }
        }
    }
}

/// How much the depth decreases from the pixel above, in metres; 0 where unknown.
fn slope(image: &DepthImage, pixel: usize) -> f32 {
    let above = pixel.checked_sub(image.width).map_or(0.0, |above| image.depth[above]);
    if above > 0.0 { above - image.depth[pixel] } else { 0.0 }
}

/// From red over yellow, green and cyan to blue.
fn hue(part: f64) -> [f64; 3] {
    let turn = 4.0 * part.clamp(0.0, 1.0);
    [2.0 - turn, if turn < 2.0 { turn } else { 4.0 - turn }, turn - 2.0].map(|c| c.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::camera::Intrinsics;
    use crate::model::ObjectClass;

    #[test]
    fn a_picture_is_a_png_of_its_size_that_reads_back() {
        let image = DepthImage { width: 3, height: 2, depth: vec![0.0, 1.0, 1.1, 1.2, 1.3, 2.0] };
        let picture = Picture::of_depth(&image);
        assert_eq!(&picture.rgb[..6], &[0, 0, 0, 191, 0, 0]);
        let file = picture.to_png().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut rgb).unwrap();
        assert_eq!((info.width, info.height, rgb), (3, 2, picture.rgb));
        assert!(Picture { width: 0, height: 0, rgb: vec![] }.to_png().is_err());
    }

    #[test]
    fn what_was_found_is_drawn_where_it_is_seen_and_nothing_is_drawn_beside_the_image() {
        let camera = Camera { intrinsics: Intrinsics::DEFAULT, pose: Pose::IDENTITY };
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let blank = Picture { width, height, rgb: vec![0; 3 * width * height] };
        let at = |x: f64| Detection {
            model: ObjectClass::Box.model(&[0.2, 0.2, 0.2]),
            pose: Pose::at(x, 0.0, 1.5),
            covariance: [[0.0; 6]; 6],
            confidence: 1.0,
        };
        let mut drawn = blank.clone();
        drawn.draw(&camera, &at(0.0));
        let [column, row] = camera.intrinsics.project([0.1, 0.1, 1.4]).unwrap();
        let pixel = 3 * (row.round() as usize * width + column.round() as usize);
        assert_eq!(&drawn.rgb[pixel..pixel + 3], &[255, 255, 255]);
        // A bowl is round: its rim is drawn, the corners of its bounding box are not.
        let bowl = Detection { model: ObjectClass::Bowl.model(&[0.08, 0.06]), ..at(0.0) };
        let mut round = blank.clone();
        round.draw(&camera, &bowl);
        let is_drawn = |point: [f64; 3]| {
            let [column, row] = camera.intrinsics.project(point).unwrap();
            let pixel = 3 * (row.round() as usize * width + column.round() as usize);
            round.rgb[pixel..pixel + 3] == [255, 255, 255]
        };
        assert!(is_drawn([0.08, 0.0, 1.47]) && is_drawn([0.0, 0.08, 1.53]) && !is_drawn([0.08, 0.08, 1.47]));
        let mut beside = blank.clone();
        beside.draw(&camera, &at(20.0));
        assert_eq!(beside, blank);
    }
}
