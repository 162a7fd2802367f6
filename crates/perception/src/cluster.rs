//! Euclidean clusters (Rusu 2009, section 6.2): points belong together when a chain of close points joins them.
//!
//! Points are first gathered in cells, so that near surfaces with many points do not cost more than far ones. The centroids of
//! the cells go into a k-d tree, and clusters grow along its neighbours.

use crate::vector::Vector;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// The edge of a cell, in metres.
const CELL: f64 = 0.007;
/// Maximum distance between neighbouring cells of a cluster, in metres.
const LINK: f64 = 0.016;
/// A cell with fewer neighbours than this is a stray point.
const MIN_NEIGHBOURS: usize = 3;
/// Maximum number of clusters.
const MAX_CLUSTERS: usize = 256;
/// Maximum number of points that are gathered: more are clutter.
const MAX_POINTS: usize = 1 << 20;

/// Clusters of at least `min_size` points, each a list of indices of `points`, the largest first.
pub(crate) fn clusters(points: &[Vector], min_size: usize) -> Vec<Vec<u32>> {
    let mut keyed: Vec<(u64, u32)> =
        points.iter().take(MAX_POINTS).enumerate().map(|(i, p)| (key(p), i as u32)).collect();
    keyed.sort_unstable();
    let cells: Vec<&[(u64, u32)]> = keyed.chunk_by(|a, b| a.0 == b.0).collect();
    let middles: Vec<Vector> = cells.iter().map(|cell| middle(cell.iter().map(|(_, i)| points[*i as usize]))).collect();
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&middles) else { return Vec::new() };
    let near =
        |cell: usize| tree.query(&middles[cell]).within::<SquaredEuclidean<f64>>(LINK * LINK).unsorted().execute();
    let mut visited = vec![false; cells.len()];
    let mut found: Vec<Vec<u32>> = Vec::new();
    for start in 0..cells.len() {
        if visited[start] || found.len() == MAX_CLUSTERS {
            continue;
        }
        visited[start] = true;
        let (mut members, mut open) = (Vec::new(), vec![start]);
        while let Some(cell) = open.pop() {
            let neighbours = near(cell);
            // The cell itself is among its neighbours. A stray cell joins nothing.
            if neighbours.len() <= MIN_NEIGHBOURS {
                continue;
            }
            members.extend(cells[cell].iter().map(|(_, i)| *i));
            for neighbour in neighbours {
                let next = neighbour.item as usize;
                if !visited[next] {
                    visited[next] = true;
                    open.push(next);
                }
            }
        }
        if members.len() >= min_size {
            members.sort_unstable();
            found.push(members);
        }
    }
    found.sort_by_key(|members| (std::cmp::Reverse(members.len()), members[0]));
    found
}

/// The cell of a point, 21 bits per axis.
fn key(point: &Vector) -> u64 {
    point.iter().fold(0, |key, c| (key << 21) | (((c / CELL).floor() as i64 + (1 << 20)) as u64 & 0x1F_FFFF))
}

fn middle(points: impl Iterator<Item = Vector>) -> Vector {
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    for p in points {
        count += 1.0;
        for axis in 0..3 {
            sum[axis] += p[axis];
        }
    }
    sum.map(|s| s / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A patch of 20 × 20 points, 2 mm apart.
    fn patch(x: f64) -> Vec<Vector> {
        (0..400).map(|i| [x + f64::from(i % 20) * 0.002, f64::from(i / 20) * 0.002, 0.1]).collect()
    }

    #[test]
    fn a_gap_parts_clusters_and_a_narrow_one_does_not() {
        let apart: Vec<Vector> = patch(0.0).into_iter().chain(patch(0.070)).collect();
        let found = clusters(&apart, 100);
        assert_eq!(found.iter().map(Vec::len).collect::<Vec<_>>(), vec![400, 400]);
        assert_eq!(found[0], (0..400).collect::<Vec<u32>>());
        let joined: Vec<Vector> = patch(0.0).into_iter().chain(patch(0.046)).collect();
        assert_eq!(clusters(&joined, 100).len(), 1);
    }

    #[test]
    fn strays_and_small_clusters_are_dropped() {
        let mut points = patch(0.0);
        points.push([0.3, 0.3, 0.3]);
        assert_eq!(clusters(&points, 1).iter().map(Vec::len).collect::<Vec<_>>(), vec![400]);
        assert!(clusters(&points, 401).is_empty());
        assert!(clusters(&[], 1).is_empty());
    }
}
