//! Converts depth images to points: images of a pinhole camera, with the distance along its axis per pixel, for a given camera pose.
//!
//! Pixels without a value, too near or too far are left out. At the edge of an object a camera often returns pixels that lie between the object and
//! the background: flying pixels. They are far from their neighbours along the line of sight, and are left out on request.

use ratn_model::pose::Pose;

/// A pinhole camera. It looks along z, x is to the right in the image, y is down; lengths in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Columns and rows.
    pub size: [usize; 2],
    /// Focal lengths along x and y.
    pub focal: [f64; 2],
    /// The principal point, where the axis meets the image; the centre of the first pixel is (0, 0).
    pub centre: [f64; 2],
}

/// Which pixels are used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Filter {
    /// Minimum depth, in metres.
    pub least_m: f64,
    /// Maximum depth, in metres.
    pub most_m: f64,
    /// A pixel is flying if fewer than two of its eight neighbours are within this share of its depth; `None` keeps all.
    pub flying: Option<f64>,
    /// Only every n-th column and row; 1 for all.
    pub every: usize,
}

impl Default for Filter {
    fn default() -> Filter {
        Filter { least_m: 0.1, most_m: 10.0, flying: None, every: 1 }
    }
}

/// Why there are no points.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DepthError {
    /// The numbers of pixels of image and camera differ.
    #[error("the image has {pixels} pixels, the camera {columns} × {rows}")]
    Pixels {
        /// Pixels of the image.
        pixels: usize,
        /// Columns of the camera.
        columns: usize,
        /// Rows of the camera.
        rows: usize,
    },
    /// An invalid value of the camera or the filter.
    #[error("{what} is {value}: expected {expected}")]
    Value {
        /// The name of the value.
        what: &'static str,
        /// The value.
        value: f64,
        /// The allowed values.
        expected: &'static str,
    },
}

/// The points of an image, row by row, in the frame of `camera`'s pose; depths in metres, zero or NaN for none.
///
/// # Errors
/// [`DepthError`] says what is invalid.
pub fn points(
    depths: &[f32],
    intrinsics: &Intrinsics,
    camera: &Pose,
    filter: &Filter,
) -> Result<Vec<[f32; 3]>, DepthError> {
    let Intrinsics { size: [columns, rows], focal, centre } = *intrinsics;
    if columns.checked_mul(rows) != Some(depths.len()) {
        return Err(DepthError::Pixels { pixels: depths.len(), columns, rows });
    }
    let check = |what, value: f64, fits: bool, expected| {
        if fits { Ok(()) } else { Err(DepthError::Value { what, value, expected }) }
    };
    for length in focal {
        check("a focal length", length, length > 0.0 && length.is_finite(), "more than 0 pixels")?;
    }
    for at in centre {
        check("the centre of the image", at, at.is_finite(), "a pixel")?;
    }
    check("the least depth", filter.least_m, filter.least_m >= 0.0, "0 m or more")?;
    let most = filter.most_m;
    check("the greatest depth", most, most > filter.least_m && most.is_finite(), "more than the least, in metres")?;
    check("the number of columns and rows from pixel to pixel", filter.every as f64, filter.every > 0, "1 or more")?;
    let depth = |column: usize, row: usize| {
        let depth = f64::from(depths[row * columns + column]);
        (depth > 0.0 && depth >= filter.least_m && depth <= filter.most_m).then_some(depth)
    };
    let flies = |column: usize, row: usize, here: f64| {
        let Some(part) = filter.flying else { return false };
        let around = |at: usize, count: usize| at.saturating_sub(1)..=(at + 1).min(count - 1);
        let pixels = around(row, rows).flat_map(|y| around(column, columns).map(move |x| (x, y)));
        let close = |(x, y): &(usize, usize)| depth(*x, *y).is_some_and(|d| (d - here).abs() <= part * here);
        // The pixel itself counts as well.
        pixels.filter(close).count() < 3
    };
    let mut points = Vec::new();
    for row in (0..rows).step_by(filter.every) {
        for column in (0..columns).step_by(filter.every) {
            let Some(z) = depth(column, row) else { continue };
            if !flies(column, row, z) {
                let at = [(column as f64 - centre[0]) / focal[0] * z, (row as f64 - centre[1]) / focal[1] * z, z];
                points.push(camera.transform(at).map(|c| c as f32));
            }
        }
    }
    Ok(points)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { size: [8, 6], focal: [10.0, 12.0], centre: [3.5, 2.5] };

    #[test]
    fn a_wall_seen_straight_is_a_wall_where_it_is() {
        // One metre up, looking along the world's x axis: the camera's z is the world's x, its x the world's -y.
        let camera = Pose::from_rpy([0.0, 0.0, 1.0], -std::f64::consts::FRAC_PI_2, 0.0, -std::f64::consts::FRAC_PI_2);
        let seen = points(&[2.0; 48], &CAMERA, &camera, &Filter::default()).unwrap();
        assert_eq!(seen.len(), 48);
        assert!(seen.iter().all(|[x, _, _]| (x - 2.0).abs() < 1e-6));
        // The first pixel is at the upper left.
        let [_, y, z] = seen[0];
        assert!((y - 0.7).abs() < 1e-6 && (z - (1.0 + 2.5 / 12.0 * 2.0)).abs() < 1e-6, "{y} {z}");
    }

    #[test]
    fn pixels_without_a_value_too_near_too_far_and_flying_are_left_out() {
        let mut depths = [2.0_f32; 48];
        depths[0] = 0.0;
        depths[1] = f32::NAN;
        depths[2] = f32::INFINITY;
        depths[3] = 0.05;
        depths[4] = 11.0;
        depths[5] = -1.0;
        depths[27] = 1.5;
        let keep = Filter::default();
        let count = |filter: Filter| points(&depths, &CAMERA, &Pose::IDENTITY, &filter).unwrap().len();
        assert_eq!(count(keep), 42);
        let without = Filter { flying: Some(0.02), ..keep };
        let seen = points(&depths, &CAMERA, &Pose::IDENTITY, &without).unwrap();
        assert!(seen.len() == 41 && seen.iter().all(|[_, _, z]| *z == 2.0));
        assert_eq!(count(Filter { every: 2, ..keep }), 9);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let refused = |depths: &[f32], camera: Intrinsics, filter: Filter| {
            points(depths, &camera, &Pose::IDENTITY, &filter).unwrap_err().to_string()
        };
        let good = Filter::default();
        assert_eq!(refused(&[1.0; 7], CAMERA, good), "the image has 7 pixels, the camera 8 × 6");
        let flat = Intrinsics { focal: [0.0, 1.0], ..CAMERA };
        assert_eq!(refused(&[1.0; 48], flat, good), "a focal length is 0: expected more than 0 pixels");
        let empty = Filter { least_m: 2.0, most_m: 1.0, ..good };
        assert!(
            refused(&[1.0; 48], CAMERA, empty).starts_with("the greatest depth is 1: expected more than the least")
        );
        assert!(refused(&[1.0; 48], CAMERA, Filter { every: 0, ..good }).contains("from pixel to pixel is 0"));
    }
}
