//! Euclidean clusters: points belong together when a chain of close points joins them.
//!
//! The points come from an image, so the neighbours of a point are looked for among the pixels around it, not in a tree:
//! close points of one surface are close in the image.

use crate::vector::{Vector, length, sub};
use std::collections::VecDeque;

/// The label of a pixel that is in no cluster.
pub(crate) const NONE: u32 = u32::MAX;

/// How far apart two points of a chain may be, in metres.
const LINK: f64 = 0.025;
/// How far apart they may be in the image, in pixels: bridges pixels that did not return.
const REACH: usize = 2;
/// More clusters than this are not looked at.
const MAX_CLUSTERS: usize = 256;

/// The clusters of at least `min_size` points, each a list of pixels, and every pixel's label.
pub(crate) fn clusters(
    width: usize,
    height: usize,
    points: &[Option<Vector>],
    min_size: usize,
) -> (Vec<Vec<usize>>, Vec<u32>) {
    let mut labels = vec![NONE; points.len()];
    let mut found: Vec<Vec<usize>> = Vec::new();
    let mut visited = vec![false; points.len()];
    let mut queue = VecDeque::new();
    for start in 0..points.len() {
        if visited[start] || points[start].is_none() {
            continue;
        }
        if found.len() == MAX_CLUSTERS {
            break;
        }
        let mut members = Vec::new();
        visited[start] = true;
        queue.push_back(start);
        while let Some(pixel) = queue.pop_front() {
            members.push(pixel);
            let Some(here) = points[pixel] else { continue };
            let (column, row) = (pixel % width, pixel / width);
            for near_row in row.saturating_sub(REACH)..(row + REACH + 1).min(height) {
                for near_column in column.saturating_sub(REACH)..(column + REACH + 1).min(width) {
                    let near = near_row * width + near_column;
                    if !visited[near]
                        && let Some(point) = points[near]
                        && length(sub(point, here)) < LINK
                    {
                        visited[near] = true;
                        queue.push_back(near);
                    }
                }
            }
        }
        if members.len() >= min_size {
            for pixel in &members {
                labels[*pixel] = found.len() as u32;
            }
            found.push(members);
        }
    }
    (found, labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_in_space_parts_what_is_adjacent_in_the_image() {
        // One row: four points, a step of 10 cm in depth, a missing pixel, three points.
        let points: Vec<Option<Vector>> = [1.0, 1.0, 1.0, 1.0, 1.1, 0.0, 1.1, 1.1]
            .iter()
            .enumerate()
            .map(|(i, z)| (*z > 0.0).then_some([i as f64 * 0.005, 0.0, *z]))
            .collect();
        let (found, labels) = clusters(8, 1, &points, 2);
        assert_eq!(found, vec![vec![0, 1, 2, 3], vec![4, 6, 7]]);
        assert_eq!(labels, vec![0, 0, 0, 0, 1, NONE, 1, 1]);
    }

    #[test]
    fn small_clusters_are_dropped() {
        assert!(clusters(1, 1, &[Some([0.0; 3])], 2).0.is_empty());
    }
}
