//! Depth discontinuities: edges, at which pixels see a mixture of near and far, and the shadows of the projector beside near
//! objects.

use crate::camera::{DepthImage, Intrinsics};

/// Minimum depth step between neighbouring pixels at an edge or for a shadow, in metres.
const STEP: f32 = 0.02;

/// For each pixel, whether a neighbour is nearer or farther by at least a step.
pub(crate) fn edges(image: &DepthImage) -> Vec<bool> {
    let (width, height) = (image.width, image.height);
    let mut edges = vec![false; image.depth.len()];
    for row in 0..height {
        for column in 0..width {
            let here = row * width + column;
            let right = (column + 1 < width).then_some(here + 1);
            let below = (row + 1 < height).then_some(here + width);
            for next in [right, below].into_iter().flatten() {
                if (image.depth[here] - image.depth[next]).abs() > STEP {
                    edges[here] = true;
                    edges[next] = true;
                }
            }
        }
    }
    edges
}

/// The least and the greatest depth among a pixel and its neighbours, without empty ones; `None` where all are empty.
pub(crate) fn around(image: &DepthImage, pixel: usize) -> Option<[f32; 2]> {
    let (column, row) = (pixel % image.width, pixel / image.width);
    let mut bounds = None;
    for row in row.saturating_sub(1)..(row + 2).min(image.height) {
        for column in column.saturating_sub(1)..(column + 2).min(image.width) {
            let depth = image.depth[row * image.width + column];
            if depth > 0.0 {
                let [near, far] = bounds.unwrap_or([depth; 2]);
                bounds = Some([depth.min(near), depth.max(far)]);
            }
        }
    }
    bounds
}

/// The pixels that the projector does not light because something nearer is in the way, along a row of the projector, which is a
/// row of the image.
pub(crate) fn shadows(image: &DepthImage, optics: &Intrinsics, projector_m: f64) -> Vec<bool> {
    let mut shadows = vec![false; image.depth.len()];
    if projector_m <= 0.0 {
        return shadows;
    }
    // In the projector's image a pixel's column is farther left by the disparity.
    let column = |here: usize, depth: f32| here as f64 - optics.fx * projector_m / f64::from(depth);
    let bins = 2 * image.width;
    let bin = |column: f64| (column + image.width as f64).round().clamp(0.0, bins as f64 - 1.0) as usize;
    let mut nearest = vec![f32::INFINITY; bins];
    for (row, shadowed) in image.depth.chunks(image.width).zip(shadows.chunks_mut(image.width)) {
        nearest.fill(f32::INFINITY);
        for (here, depth) in row.iter().enumerate().filter(|(_, depth)| **depth > 0.0) {
            let slot = &mut nearest[bin(column(here, *depth))];
            *slot = slot.min(*depth);
        }
        for (here, depth) in row.iter().enumerate().filter(|(_, depth)| **depth > 0.0) {
            shadowed[here] = nearest[bin(column(here, *depth))] < depth - STEP;
        }
    }
    shadows
}
