//! The errors of a structured-light camera, as measured on sensors like the first Kinect.
//!
//! - The noise along the ray grows with the square of the distance (Khoshelham and Oude Elberink 2012, equation 10), as for every
//!   sensor that triangulates: here it is added to the inverse of the depth. It is normal, tails included. Part of it is white;
//!   another part is smooth over some pixels, because neighbours share the window of the pattern by which they are matched, and half
//!   of that part's variance stays from frame to frame (Mallick, Das and Majumdar 2014, on spatial and temporal noise). The disparity
//!   is quantized (Konolige and Mihelich 2012: an eighth of a pixel).
//! - Across the ray an edge is located to about a pixel (Nguyen, Izadi and Lovell 2012, lateral noise), and some pixels at it return
//!   a mixture of near and far: flying pixels.
//! - Some pixels return nothing: more of them at edges, on surfaces seen almost edge-on, on dark and mirroring surfaces, and where
//!   something nearer blocks the projector's light.
//!
//! Every sample is a hash of (seed, frame, pixel), so an image does not depend on the order in which it is computed.

pub(crate) mod field;

use crate::camera::{DepthImage, Intrinsics};
use crate::edge;
use crate::noise::MAX_FRAMES;
use crate::render::Rendering;
use field::{along_row, hash, normal, uniform};
use serde::{Deserialize, Serialize};
use std::f64::consts::{PI, TAU};

/// The errors of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sensor {
    /// Standard deviation of the white noise of a depth at one metre, in metres; grows with the square of the distance.
    pub sigma_at_1m: f64,
    /// Standard deviation of the smooth noise, likewise.
    pub smooth_at_1m: f64,
    /// Correlation angle of the smooth noise, in milliradians.
    pub smooth_mrad: f64,
    /// Quantization step of a depth at one metre, in metres; grows likewise. 0 for none.
    pub step_at_1m: f64,
    /// Standard deviation of an edge's position across the ray, in milliradians.
    pub lateral_mrad: f64,
    /// The part of the pixels at an edge that return a mixture of near and far, 0 to 1.
    pub flying: f64,
    /// The part of the pixels that return nothing, 0 to 1.
    pub missing: f64,
    /// The part of the pixels at an edge that return nothing, 0 to 1.
    pub missing_at_edges: f64,
    /// Angle between ray and normal from which pixels get lost, increasing to all of them at 88°; in degrees. 90 for none.
    pub grazing_deg: f64,
    /// Distance of the projector to the right of the camera, in metres: surfaces that it does not light return nothing. 0 for no
    /// shadows.
    pub projector_m: f64,
}

/// The part of the smooth noise's variance that stays from frame to frame.
const LASTING: f64 = 0.5;
/// Maximum number of samples of an edge pixel in an average over frames; other pixels are drawn from the distribution of the mean.
const EDGE_SAMPLES: u32 = 8;
/// From this angle on nothing returns.
const EDGE_ON: f64 = 88.0 * PI / 180.0;

impl Sensor {
    /// A typical structured-light camera: 1.5 mm in total at 1 m. A sensor of 640 columns over 52° has 1.5 mrad per pixel.
    pub const DEFAULT: Sensor = Sensor {
        sigma_at_1m: 0.0013,
        smooth_at_1m: 0.0008,
        smooth_mrad: 10.0,
        step_at_1m: 0.0025,
        lateral_mrad: 1.2,
        flying: 0.25,
        missing: 0.002,
        missing_at_edges: 0.1,
        grazing_deg: 70.0,
        projector_m: 0.075,
    };
    /// No errors at all.
    pub const NONE: Sensor = Sensor {
        sigma_at_1m: 0.0,
        smooth_at_1m: 0.0,
        smooth_mrad: 10.0,
        step_at_1m: 0.0,
        lateral_mrad: 0.0,
        flying: 0.0,
        missing: 0.0,
        missing_at_edges: 0.0,
        grazing_deg: 90.0,
        projector_m: 0.0,
    };
}

impl Default for Sensor {
    fn default() -> Sensor {
        Sensor::DEFAULT
    }
}

/// The average of frames `first_frame ..` of a static scene; a pixel is averaged over the frames that returned it.
pub fn sense(
    seen: &Rendering,
    optics: &Intrinsics,
    sensor: &Sensor,
    seed: u64,
    first_frame: u64,
    frames: u32,
) -> DepthImage {
    let clean = &seen.depth;
    let (edges, shadows) = (edge::edges(clean), edge::shadows(clean, optics, sensor.projector_m));
    let frames = frames.clamp(1, MAX_FRAMES);
    let of_frames = hash(seed ^ hash(first_frame));
    let mut depth = vec![0.0; clean.depth.len()];
    for (row, out) in depth.chunks_mut(clean.width).enumerate() {
        let smooth = smooth_row(optics, sensor, seed, of_frames, row, frames);
        for (column, (out, smooth)) in out.iter_mut().zip(smooth).enumerate() {
            let pixel = row * clean.width + column;
            if clean.depth[pixel] <= 0.0 || shadows[pixel] {
                continue;
            }
            let missing = if edges[pixel] { sensor.missing_at_edges } else { sensor.missing };
            let bits = hash(of_frames ^ (pixel as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
            let lost = f64::from(seen.lost[pixel]);
            let kept = (1.0 - missing) * (1.0 - lost) * (1.0 - grazing(sensor, f64::from(seen.facing[pixel])));
            *out = if edges[pixel] {
                at_edge(clean, optics, sensor, pixel, smooth, kept, bits, frames)
            } else {
                let returned = returned(kept, frames, bits);
                if returned > 0.0 {
                    measured(clean.depth[pixel], sensor, smooth, returned, hash(bits ^ 2))
                } else {
                    0.0
                }
            };
        }
    }
    DepthImage { width: clean.width, height: clean.height, depth }
}

/// The smooth noise of the inverse depth in a row, averaged over the frames.
fn smooth_row(optics: &Intrinsics, sensor: &Sensor, seed: u64, of_frames: u64, row: usize, frames: u32) -> Vec<f64> {
    if sensor.smooth_at_1m == 0.0 || sensor.smooth_mrad == 0.0 {
        return vec![0.0; optics.width];
    }
    let [step, y] =
        [1.0 / optics.fx, (row as f64 - optics.cy) / optics.fy].map(|angle| 1e3 * angle / sensor.smooth_mrad);
    let of = |seed: u64| along_row(seed, -optics.cx * step, step, optics.width, y);
    let (lasting, passing) =
        (sensor.smooth_at_1m * LASTING.sqrt(), sensor.smooth_at_1m * ((1.0 - LASTING) / f64::from(frames)).sqrt());
    of(hash(seed ^ 0x51))
        .into_iter()
        .zip(of(hash(of_frames ^ 0x52)))
        .map(|(stays, passes)| lasting * stays + passing * passes)
        .collect()
}

/// The number of frames in which a pixel returned; for several frames a normal distribution with the binomial's mean and variance.
fn returned(kept: f64, frames: u32, bits: u64) -> f64 {
    if frames == 1 {
        return f64::from(u8::from(uniform(hash(bits ^ 1)) < kept));
    }
    let frames = f64::from(frames);
    (frames * kept + (frames * kept * (1.0 - kept)).sqrt() * normal(hash(bits ^ 1))).round().clamp(0.0, frames)
}

/// The mean of `count` measurements of a depth. White noise and quantization act on its inverse; the bias of the mean of rounded
/// values is the series of the rounding error with each term damped by the noise (Widrow and Kollár 2008, chapter 5).
fn measured(truth: f32, sensor: &Sensor, smooth: f64, count: f64, bits: u64) -> f32 {
    let (inverse, sigma, step) = (1.0 / f64::from(truth) + smooth, sensor.sigma_at_1m, sensor.step_at_1m);
    let inverse = if step <= 0.0 {
        inverse + sigma / count.sqrt() * normal(bits)
    } else if count <= 1.0 {
        ((inverse + sigma * normal(bits)) / step).round() * step
    } else {
        let (at, damping) = (inverse / step, (-2.0 * (PI * sigma / step).powi(2)).exp());
        let term = |k: f64, sign: f64| sign / (PI * k) * (TAU * k * at).sin() * damping.powf(k * k);
        let bias = step * (term(1.0, -1.0) + term(2.0, 1.0) + term(3.0, -1.0));
        inverse + bias + ((sigma * sigma + step * step / 12.0) / count).sqrt() * normal(bits)
    };
    if inverse > 0.0 { (1.0 / inverse) as f32 } else { 0.0 }
}

/// The mean of the returns of a pixel at an edge: each is the depth at a point close by, or a mixture.
#[expect(clippy::too_many_arguments, reason = "a pixel, what it sees, and the sensor's state there")]
fn at_edge(
    clean: &DepthImage,
    optics: &Intrinsics,
    sensor: &Sensor,
    pixel: usize,
    smooth: f64,
    kept: f64,
    bits: u64,
    frames: u32,
) -> f32 {
    let Some([near, far]) = edge::around(clean, pixel) else { return 0.0 };
    let (column, row) = ((pixel % clean.width) as f64, (pixel / clean.width) as f64);
    let samples = frames.min(EDGE_SAMPLES);
    // Each sample stands for several frames.
    let stands_for = f64::from(frames) / f64::from(samples);
    let (mut sum, mut count) = (0.0, 0.0);
    for sample in 0..samples {
        let own = hash(bits ^ (u64::from(sample) << 8));
        if uniform(hash(own ^ 1)) >= kept {
            continue;
        }
        let truth = if uniform(hash(own ^ 2)) < sensor.flying {
            near + (far - near) * uniform(hash(own ^ 3)) as f32
        } else {
            let off = |focal: f64, salt: u64| 1e-3 * sensor.lateral_mrad * focal * normal(hash(own ^ salt));
            let (x, y) = ((column + off(optics.fx, 4)).round(), (row + off(optics.fy, 5)).round());
            clean
                .at(x.clamp(0.0, clean.width as f64 - 1.0) as usize, y.clamp(0.0, clean.height as f64 - 1.0) as usize)
                .unwrap_or(0.0) as f32
        };
        if truth > 0.0 {
            sum += f64::from(measured(truth, sensor, smooth, stands_for, hash(own ^ 6)));
            count += 1.0;
        }
    }
    if count > 0.0 { (sum / count) as f32 } else { 0.0 }
}

/// The part of the pixels that are lost where the surface is seen under this cosine.
fn grazing(sensor: &Sensor, facing: f64) -> f64 {
    let (begins, angle) = (sensor.grazing_deg.to_radians(), facing.clamp(0.0, 1.0).acos());
    if begins >= EDGE_ON || angle <= begins { 0.0 } else { ((angle - begins) / (EDGE_ON - begins)).min(1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall(distance: f32) -> Rendering {
        let depth = DepthImage { width: 100, height: 100, depth: vec![distance; 10_000] };
        Rendering { depth, facing: vec![1.0; 10_000], lost: vec![0.0; 10_000] }
    }

    /// A wall whose columns from `columns` on are at half the distance.
    fn step(columns: usize) -> Rendering {
        let mut step = wall(2.0);
        for row in step.depth.depth.chunks_mut(100) {
            row[columns..].fill(1.0);
        }
        step
    }

    /// 100 × 100 pixels of 1.5 milliradians.
    const OPTICS: Intrinsics = Intrinsics { width: 100, height: 100, fx: 660.0, fy: 660.0, cx: 49.5, cy: 49.5 };

    fn look(distance: f32, sensor: &Sensor, seed: u64, first_frame: u64, frames: u32) -> DepthImage {
        sense(&wall(distance), &OPTICS, sensor, seed, first_frame, frames)
    }

    fn deviation(image: &DepthImage, truth: f64) -> f64 {
        let seen: Vec<f64> = image.depth.iter().filter(|d| **d > 0.0).map(|d| f64::from(*d) - truth).collect();
        (seen.iter().map(|e| e * e).sum::<f64>() / seen.len() as f64).sqrt()
    }

    #[test]
    fn noise_grows_with_the_square_of_the_distance() {
        let near = deviation(&look(1.0, &Sensor::DEFAULT, 1, 0, 1), 1.0);
        let far = deviation(&look(2.0, &Sensor::DEFAULT, 1, 0, 1), 2.0);
        // White noise, smooth noise and rounding together.
        let expected = (1.3_f64.powi(2) + 0.8_f64.powi(2) + 2.5_f64.powi(2) / 12.0).sqrt() * 1e-3;
        assert!((near / expected - 1.0).abs() < 0.1, "{near}");
        assert!((far / near - 4.0).abs() < 0.5, "{far}");
    }

    #[test]
    fn white_noise_falls_with_frames_and_half_of_the_smooth_one_stays() {
        let white = Sensor { smooth_at_1m: 0.0, step_at_1m: 0.0, ..Sensor::DEFAULT };
        let of = |sensor: &Sensor, frames| deviation(&look(1.0, sensor, 1, 0, frames), 1.0);
        assert!((of(&white, 1) / of(&white, 16) - 4.0).abs() < 0.3);
        let smooth = Sensor { sigma_at_1m: 0.0, step_at_1m: 0.0, ..Sensor::DEFAULT };
        let many = |seed| deviation(&look(1.0, &smooth, seed, 0, 1000), 1.0);
        let lasting = ((0..20).map(|seed| many(seed).powi(2)).sum::<f64>() / 20.0).sqrt();
        assert!((lasting / 0.0008 - LASTING.sqrt()).abs() < 0.07, "{lasting}");
    }

    #[test]
    fn neighbours_share_the_smooth_part_and_pixels_apart_do_not() {
        let smooth = Sensor { sigma_at_1m: 0.0, step_at_1m: 0.0, missing: 0.0, ..Sensor::DEFAULT };
        let product = |apart: usize| {
            let of = |seed| {
                let image = look(1.0, &smooth, seed, 0, 1);
                let off = |column: usize, row: usize| f64::from(image.depth[row * 100 + column]) - 1.0;
                (0..100).map(|row| off(30, row) * off(30 + apart, row)).sum::<f64>() / 100.0
            };
            (0..40).map(of).sum::<f64>() / 40.0 / 0.0008_f64.powi(2)
        };
        assert!(product(1) > 0.9 && product(25).abs() < 0.2, "{} {}", product(1), product(25));
    }

    #[test]
    fn a_frame_has_steps_and_the_mean_of_many_hardly_any() {
        let steps = Sensor { smooth_at_1m: 0.0, ..Sensor::DEFAULT };
        let one = look(1.0, &steps, 1, 0, 1);
        assert!(one.depth.iter().filter(|d| **d > 0.0).all(|d| {
            let at = 1.0 / f64::from(*d) / steps.step_at_1m;
            (at - at.round()).abs() < 1e-3
        }));
        // The mean by the series equals the mean of single frames.
        for truth in [1.0, 1.0006, 1.0013] {
            let mean = |frames, looks: u64| {
                let of = |look_no| {
                    let image = sense(&wall(truth), &OPTICS, &steps, 9, look_no, frames);
                    let seen = image.depth.iter().filter(|d| **d > 0.0);
                    seen.clone().map(|d| f64::from(*d)).sum::<f64>() / seen.count() as f64
                };
                (0..looks).map(of).sum::<f64>() / looks as f64
            };
            assert!((mean(1, 8) - mean(8, 8)).abs() < 3e-5, "{truth}: {} {}", mean(1, 8), mean(8, 8));
        }
    }

    #[test]
    fn at_an_edge_some_pixels_fly_between_near_and_far() {
        let seen = sense(&step(50), &OPTICS, &Sensor { projector_m: 0.0, ..Sensor::DEFAULT }, 3, 0, 1);
        let flying = |columns: std::ops::Range<usize>| {
            let between = |d: &&f32| (1.1..1.9).contains(*d);
            seen.depth.chunks(100).flat_map(|row| row[columns.clone()].iter()).filter(between).count()
        };
        // Of 200 pixels a quarter fly, nine tenths of these return, and four fifths of those are far from either side.
        assert!((20..60).contains(&flying(49..51)), "{}", flying(49..51));
        assert_eq!(flying(0..48) + flying(52..100), 0);
    }

    #[test]
    fn what_is_seen_edge_on_or_swallows_light_does_not_return() {
        let returned = |facing: f32, lost: f32| {
            let scene = Rendering { facing: vec![facing; 10_000], lost: vec![lost; 10_000], ..wall(1.0) };
            let image = sense(&scene, &OPTICS, &Sensor::DEFAULT, 1, 0, 1);
            image.depth.iter().filter(|d| **d > 0.0).count()
        };
        assert!(returned(0.5, 0.0) > 9900 && returned(0.02, 0.0) == 0);
        assert!((4000..6000).contains(&returned(79.0_f32.to_radians().cos(), 0.0)));
        assert!((900..1100).contains(&returned(1.0, 0.9)));
    }

    #[test]
    fn the_same_seed_sees_the_same_and_another_does_not() {
        let one = look(1.0, &Sensor::DEFAULT, 7, 3, 2);
        assert_eq!(one, look(1.0, &Sensor::DEFAULT, 7, 3, 2));
        assert_ne!(one, look(1.0, &Sensor::DEFAULT, 8, 3, 2));
        assert_ne!(one, look(1.0, &Sensor::DEFAULT, 7, 4, 2));
    }

    #[test]
    fn beside_what_is_near_the_projector_lights_nothing() {
        let step = step(50);
        let optics = Intrinsics { fx: 400.0, ..OPTICS };
        let noise = Sensor { projector_m: 0.05, ..Sensor::NONE };
        let seen = sense(&step, &optics, &noise, 1, 0, 1);
        // To the projector the near half is shifted by 20 columns, the far half by 10: the last ten columns of the far half are in
        // the shadow.
        let dark: Vec<usize> = (0..100).filter(|column| seen.depth[*column] == 0.0).collect();
        assert_eq!(dark, (40..50).collect::<Vec<_>>());
        assert!(sense(&step, &optics, &Sensor::NONE, 1, 0, 1).depth.iter().all(|d| *d > 0.0));
    }

    #[test]
    fn a_few_pixels_are_missing() {
        let image = look(1.0, &Sensor { missing: 0.1, ..Sensor::DEFAULT }, 7, 0, 1);
        let missing = image.depth.iter().filter(|d| **d == 0.0).count();
        assert!((800..1200).contains(&missing), "{missing}");
    }
}
