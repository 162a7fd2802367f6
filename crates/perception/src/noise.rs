//! The errors of a structured-light camera: noise that grows with the square of the distance, as for every sensor that triangulates (Khoshelham and
//! Oude Elberink 2012, equation 10); pixels without a return, more of them at edges; and shadows beside near objects, where the projector's light
//! does not reach.
//!
//! Every sample is a hash of (seed, frame, pixel), so an image does not depend on the order in which it is computed.

use crate::camera::{DepthImage, Intrinsics};
use crate::edge;
use serde::{Deserialize, Serialize};

/// The noise of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Noise {
    /// Standard deviation of a depth at one metre, in metres; grows with the square of the distance.
    pub sigma_at_1m: f64,
    /// The part of the pixels that return nothing, 0 to 1.
    pub missing: f64,
    /// The part of the pixels at an edge that return nothing, 0 to 1.
    pub missing_at_edges: f64,
    /// Distance of the projector to the right of the camera, in metres: surfaces that it does not light return nothing. 0 for no shadows.
    pub projector_m: f64,
}

/// Maximum number of averaged frames.
pub const MAX_FRAMES: u32 = 1000;
/// Two depths of a pixel are of the same surface where they differ by less than this, in metres, plus this many standard deviations of the noise.
const SURFACE_M: f64 = 0.01;
const NOISE_SIGMAS: f64 = 8.0;

impl Noise {
    /// A typical structured-light camera.
    pub const DEFAULT: Noise = Noise { sigma_at_1m: 0.0015, missing: 0.002, missing_at_edges: 0.1, projector_m: 0.075 };
    /// No noise at all.
    pub const NONE: Noise = Noise { sigma_at_1m: 0.0, missing: 0.0, missing_at_edges: 0.0, projector_m: 0.0 };
}

impl Default for Noise {
    fn default() -> Noise {
        Noise::DEFAULT
    }
}

/// The average of frames `first_frame ..` of a static scene; a pixel is averaged over the frames that returned it.
pub fn observe(
    clean: &DepthImage,
    optics: &Intrinsics,
    noise: &Noise,
    seed: u64,
    first_frame: u64,
    frames: u32,
) -> DepthImage {
    let (edges, shadows) = (edge::edges(clean), edge::shadows(clean, optics, noise.projector_m));
    let frames = f64::from(frames.clamp(1, MAX_FRAMES));
    let mut depth = vec![0.0; clean.depth.len()];
    for (pixel, (out, truth)) in depth.iter_mut().zip(&clean.depth).enumerate() {
        if *truth <= 0.0 || shadows[pixel] {
            continue;
        }
        let truth = f64::from(*truth);
        let missing = if edges[pixel] { noise.missing_at_edges } else { noise.missing };
        let bits = hash(seed ^ hash(first_frame) ^ (pixel as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        // The number of frames that returned it; for several frames a normal distribution with the binomial's mean and variance.
        let returned = if frames == 1.0 {
            f64::from(u8::from(uniform(hash(bits ^ 1)) >= missing))
        } else {
            let spread = (frames * missing * (1.0 - missing)).sqrt();
            (frames * (1.0 - missing) + spread * normal(hash(bits ^ 1))).round().clamp(0.0, frames)
        };
        if returned > 0.0 {
            *out = (truth + noise.sigma_at_1m * truth * truth * normal(bits) / returned.sqrt()) as f32;
        }
    }
    DepthImage { width: clean.width, height: clean.height, depth }
}

/// The average of pictures that are themselves averages of several frames; a pixel is averaged over the pictures that returned it. The camera stood
/// still, but something may have moved through the scene: where both were seen, only the background counts, because an average would lie between the
/// two surfaces, where nothing is. So among depths that differ by more than the noise the farthest counts: a moving arm hides nothing that any frame
/// shows.
pub fn average(
    width: usize,
    height: usize,
    noise: &Noise,
    pictures: impl Iterator<Item = (DepthImage, u32)>,
) -> DepthImage {
    let mut seen = vec![Pixel::default(); width * height];
    for (picture, frames) in pictures {
        for (pixel, depth) in seen.iter_mut().zip(&picture.depth) {
            pixel.add(f64::from(*depth), f64::from(frames), noise);
        }
    }
    let depth = seen.into_iter().map(|pixel| if pixel.frames > 0.0 { (pixel.sum / pixel.frames) as f32 } else { 0.0 });
    DepthImage { width, height, depth: depth.collect() }
}

/// The depths of a pixel over several pictures.
#[derive(Debug, Clone, Copy, Default)]
struct Pixel {
    farthest: f64,
    sum: f64,
    frames: f64,
}

impl Pixel {
    /// Adds a depth in metres (0 for none) that is the average of `frames` frames.
    fn add(&mut self, depth: f64, frames: f64, noise: &Noise) {
        let alike = SURFACE_M + NOISE_SIGMAS * noise.sigma_at_1m * depth * depth;
        if depth <= 0.0 || depth < self.farthest - alike {
            return;
        }
        if depth > self.farthest + alike {
            *self = Pixel::default();
        }
        self.farthest = self.farthest.max(depth);
        self.sum += depth * frames;
        self.frames += frames;
    }
}

/// About standard normal: the sum of three uniforms has variance 1/4, so twice the centred sum has variance 1.
fn normal(bits: u64) -> f64 {
    let [a, b, c] = [bits, bits >> 21, bits >> 42].map(|b| (b & 0x1F_FFFF) as f64 / f64::from(0x20_0000));
    2.0 * (a + b + c - 1.5)
}

fn uniform(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

/// The finaliser of SplitMix64 (Steele, Lea, Flood 2014): every input bit affects every output bit.
fn hash(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall(distance: f32) -> DepthImage {
        DepthImage { width: 100, height: 100, depth: vec![distance; 10_000] }
    }

    fn look(distance: f32, noise: &Noise, seed: u64, first_frame: u64, frames: u32) -> DepthImage {
        observe(&wall(distance), &Intrinsics::DEFAULT, noise, seed, first_frame, frames)
    }

    fn deviation(image: &DepthImage, truth: f64) -> f64 {
        let seen: Vec<f64> = image.depth.iter().filter(|d| **d > 0.0).map(|d| f64::from(*d) - truth).collect();
        (seen.iter().map(|e| e * e).sum::<f64>() / seen.len() as f64).sqrt()
    }

    #[test]
    fn noise_grows_with_the_square_of_the_distance_and_falls_with_frames() {
        let near = deviation(&look(1.0, &Noise::DEFAULT, 1, 0, 1), 1.0);
        let far = deviation(&look(2.0, &Noise::DEFAULT, 1, 0, 1), 2.0);
        let averaged = deviation(&look(2.0, &Noise::DEFAULT, 1, 0, 16), 2.0);
        assert!((near / 0.0015 - 1.0).abs() < 0.05, "{near}");
        assert!((far / near - 4.0).abs() < 0.3, "{far}");
        assert!((far / averaged - 4.0).abs() < 0.3, "{averaged}");
    }

    #[test]
    fn the_same_seed_sees_the_same_and_another_does_not() {
        let one = look(1.0, &Noise::DEFAULT, 7, 3, 2);
        assert_eq!(one, look(1.0, &Noise::DEFAULT, 7, 3, 2));
        assert_ne!(one, look(1.0, &Noise::DEFAULT, 8, 3, 2));
        assert_ne!(one, look(1.0, &Noise::DEFAULT, 7, 4, 2));
    }

    #[test]
    fn an_average_weighs_by_frames_and_skips_what_did_not_return() {
        let picture = |depth: [f32; 2], frames| (DepthImage { width: 2, height: 1, depth: depth.to_vec() }, frames);
        let pictures = [picture([1.0, 0.0], 3), picture([1.008, 2.0], 1)];
        assert_eq!(average(2, 1, &Noise::NONE, pictures.into_iter()).depth, vec![1.002, 2.0]);
    }

    #[test]
    fn what_passes_before_a_wall_is_not_mixed_with_it() {
        let noise = &Noise { missing: 0.0, missing_at_edges: 0.0, projector_m: 0.0, ..Noise::DEFAULT };
        // A bar of 20 columns, half a metre in front of the wall, moves by ten columns from frame to frame; the last ten columns are covered all the
        // time.
        let frame = |number: u64, from: usize| {
            let mut clean = wall(1.5);
            for row in clean.depth.chunks_mut(100) {
                row[from..from + 20].fill(1.0);
                row[90..].fill(1.0);
            }
            (observe(&clean, &Intrinsics::DEFAULT, noise, 3, number, 1), 1)
        };
        let frames: Vec<_> = (0..8_u64).map(|number| frame(number, 10 * number as usize)).collect();
        let seen = average(100, 100, noise, frames.clone().into_iter());
        let backwards = average(100, 100, noise, frames.into_iter().rev());
        for (pixel, depth) in seen.depth.iter().enumerate() {
            let (truth, sigma) = if pixel % 100 < 90 { (1.5, 0.0034) } else { (1.0, 0.0015) };
            // At most two of the eight frames had the bar in this place.
            assert!((depth - truth).abs() < 5.0 * sigma / 6.0_f32.sqrt(), "{pixel}: {depth}");
            assert!((depth - backwards.depth[pixel]).abs() < 1e-6, "{pixel}: the order does not count");
        }
    }

    #[test]
    fn beside_what_is_near_the_projector_lights_nothing() {
        let mut step = wall(2.0);
        for row in step.depth.chunks_mut(100) {
            row[50..].fill(1.0);
        }
        let optics = Intrinsics { fx: 400.0, ..Intrinsics::DEFAULT };
        let noise = Noise { projector_m: 0.05, ..Noise::NONE };
        let seen = observe(&step, &optics, &noise, 1, 0, 1);
        // To the projector the near half is shifted by 20 columns, the far half by 10: the last ten columns of the far half are in the shadow.
        let dark: Vec<usize> = (0..100).filter(|column| seen.depth[*column] == 0.0).collect();
        assert_eq!(dark, (40..50).collect::<Vec<_>>());
        assert!(observe(&step, &optics, &Noise::NONE, 1, 0, 1).depth.iter().all(|d| *d > 0.0));
    }

    #[test]
    fn a_few_pixels_are_missing() {
        let image = look(1.0, &Noise { missing: 0.1, ..Noise::DEFAULT }, 7, 0, 1);
        let missing = image.depth.iter().filter(|d| **d == 0.0).count();
        assert!((800..1200).contains(&missing), "{missing}");
    }
}
