//! Rounds a path as a whole: the cubic B-spline whose control points are the path's postures, plus further ones on long motions, so
//! that a corner is rounded only near itself.
//!
//! The knots are as far apart as the control points. A span that touches something gets more control points around it, on the sides
//! of the path, which pulls the curve closer to the path; where that does not help, the path is cut at the corner, and the arm stops
//! there. On a straight side the curve coincides with the side. Also the cubic spline *through* postures, for those that are followed
//! exactly.

use super::STRAIGHT_RAD;
use super::blend::{bend_rad, is_free_along};
use super::path::{Path, Segment, between};
use super::room::Room;
use crate::collision::distance;
use std::collections::BTreeSet;

/// Number of rounds that add control points before the path is cut.
const ROUNDS: usize = 4;

/// A greater kink in postures that are followed exactly makes the arm stop, in radians.
const KINK_RAD: f64 = 0.2;

/// Maximum distance of the curve through some of the postures from the others, in radians.
const OFF_RAD: f64 = 1e-4;

/// What is known about the straight motions of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sides {
    /// They are free.
    Free,
    /// Nothing is known.
    Unknown,
}

/// Smooth pieces with the same ends and with control points at most `spacing` apart; `is_free` tells whether a straight motion is
/// free. `None` where a side of the path turns out not to be free.
pub(crate) fn smoothed<const N: usize>(
    path: &[[f64; N]],
    sides: Sides,
    spacing: f64,
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Option<Vec<Path<N>>> {
    let mut polygons = vec![divided(path, spacing)];
    let mut known = BTreeSet::new();
    let mut pieces = Vec::new();
    while let Some(polygon) = polygons.pop() {
        match curved(polygon, sides, &mut known, room, is_free)? {
            Curved::Whole(piece) => pieces.push(piece),
            // The first of the two is processed next, because pieces are taken from the end.
            Curved::Cut([before, after]) => polygons.extend([after, before]),
        }
    }
    Some(pieces)
}

/// The curve of a polygon, or the two polygons into which it has to be cut.
enum Curved<const N: usize> {
    Whole(Path<N>),
    Cut([Vec<[f64; N]>; 2]),
}

fn curved<const N: usize>(
    mut polygon: Vec<[f64; N]>,
    sides: Sides,
    known: &mut BTreeSet<Vec<u64>>,
    room: &Room<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Option<Curved<N>> {
    let whole = polygon.clone();
    for round in 0..=ROUNDS {
        let last = polygon.len() - 1;
        let bend =
            |i: usize| if i == 0 || i == last { 0.0 } else { bend_rad(&polygon[i - 1], &polygon[i], &polygon[i + 1]) };
        let spans = spans(&polygon);
        let mut is_span_free = |i: usize| {
            let span = &spans[i];
            if sides == Sides::Free && bend(i).max(bend(i + 1)) < STRAIGHT_RAD {
                return true;
            }
            let ends = [span.at(0.0), span.at(span.length / 2.0), span.at(span.length)];
            let key: Vec<u64> = ends.iter().flat_map(|e| e.position.map(f64::to_bits)).collect();
            known.contains(&key) || is_free_along(span, room, is_free) && known.insert(key)
        };
        let blocked: Vec<usize> = (0..last).filter(|i| !is_span_free(*i)).collect();
        let Some(first) = blocked.first() else {
            let mut piece = Path::default();
            spans.into_iter().for_each(|span| piece.push(span));
            return Some(Curved::Whole(piece));
        };
        if round == ROUNDS {
            let corner = if bend(*first) > bend(first + 1) { *first } else { first + 1 };
            let can_be_cut = bend(corner) >= STRAIGHT_RAD;
            // Points added on its sides are not corners.
            let corner = whole.iter().position(|posture| *posture == polygon[corner]).filter(|_| can_be_cut)?;
            return Some(Curved::Cut([whole[..=corner].to_vec(), whole[corner..].to_vec()]));
        }
        let is_near = |edge: usize| blocked.iter().any(|span| edge + 1 >= *span && edge <= span + 1);
        let mut finer = vec![polygon[0]];
        for (i, pair) in polygon.windows(2).enumerate() {
            if is_near(i) {
                finer.push(between(&pair[0], &pair[1], 0.5));
            }
            finer.push(pair[1]);
        }
        polygon = finer;
    }
    None
}

/// The same path with additional postures, and without duplicates.
fn divided<const N: usize>(path: &[[f64; N]], spacing: f64) -> Vec<[f64; N]> {
    let mut divided = vec![path[0]];
    for to in &path[1..] {
        let from = divided[divided.len() - 1];
        let parts = (distance(&from, to) / spacing).ceil().max(1.0) as usize;
        divided.extend((1..parts).map(|i| between(&from, to, i as f64 / parts as f64)));
        divided.push(*to);
    }
    divided
}

/// The spans of the B-spline. It is mirrored at its ends, so that it begins and ends at the polygon's ends with zero curvature.
fn spans<const N: usize>(polygon: &[[f64; N]]) -> Vec<Segment<N>> {
    let last = polygon.len() - 1;
    let mut along = vec![0.0];
    for (i, pair) in polygon.windows(2).enumerate() {
        along.push(along[i] + distance(&pair[0], &pair[1]));
    }
    let whole = along[last];
    // One mirrored point beyond each end, and two knots.
    let mirrored = |end: &[f64; N], inner: &[f64; N]| std::array::from_fn(|j| 2.0 * end[j] - inner[j]);
    let mut points = vec![mirrored(&polygon[0], &polygon[1])];
    points.extend_from_slice(polygon);
    points.push(mirrored(&polygon[last], &polygon[last - 1]));
    let second = along[2.min(last)];
    let before = along[last.saturating_sub(2)];
    let mut knots = vec![-second.max(along[1]), -along[1]];
    knots.extend_from_slice(&along);
    knots.extend([2.0 * whole - along[last - 1], 2.0 * whole - before]);
    if last == 1 {
        return vec![Segment::line(&polygon[0], &polygon[1])];
    }
    (0..last).map(|i| span(&points[i..i + 4], &knots[i..i + 6])).collect()
}

/// A span from its four control points and six knots: its Bézier points are values of the blossom.
fn span<const N: usize>(controls: &[[f64; N]], knots: &[f64]) -> Segment<N> {
    let [a, b] = [knots[2], knots[3]];
    let blossom = |arguments: [f64; 3]| {
        let mut level = [controls[0], controls[1], controls[2], controls[3]];
        for (r, t) in arguments.into_iter().enumerate() {
            for j in 0..3 - r {
                let (low, high) = (knots[j + r], knots[j + 3]);
                level[j] = between(&level[j], &level[j + 1], (t - low) / (high - low));
            }
        }
        level[0]
    };
    Segment::bezier(&[blossom([a, a, a]), blossom([a, a, b]), blossom([a, b, b]), blossom([b, b, b])], b - a)
}

/// The cubic splines through the postures, cut at kinks; through as few postures as keep close to all of them.
pub(crate) fn through<const N: usize>(path: &[[f64; N]]) -> Vec<Path<N>> {
    let mut runs = vec![vec![path[0]]];
    for (i, posture) in path.iter().enumerate().skip(1) {
        let run = runs.len() - 1;
        if distance(&runs[run][runs[run].len() - 1], posture) < 1e-9 {
            continue;
        }
        runs[run].push(*posture);
        if i + 1 < path.len() && bend_rad(&path[i - 1], posture, &path[i + 1]) > KINK_RAD {
            runs.push(vec![*posture]);
        }
    }
    runs.iter()
        .filter(|run| run.len() > 1)
        .map(|run| [16, 8, 4, 2, 1].iter().find_map(|stride| thinned(run, *stride)).unwrap_or_default())
        .collect()
}

/// The natural cubic spline through every `stride`-th posture, if it is close to the others.
fn thinned<const N: usize>(run: &[[f64; N]], stride: usize) -> Option<Path<N>> {
    let last = run.len() - 1;
    let mut along = vec![0.0];
    for (i, pair) in run.windows(2).enumerate() {
        along.push(along[i] + distance(&pair[0], &pair[1]));
    }
    let parts = (last / stride).max(1);
    let kept: Vec<usize> = (0..=parts).map(|i| i * last / parts).collect();
    let h: Vec<f64> = kept.windows(2).map(|k| along[k[1]] - along[k[0]]).collect();
    let bends = natural(&kept.iter().map(|k| run[*k]).collect::<Vec<_>>(), &h);
    let mut path = Path::default();
    for (i, k) in kept.windows(2).enumerate() {
        let cubic = Segment::cubic(&run[k[0]], &run[k[1]], [&bends[i], &bends[i + 1]], h[i]);
        let off = |m: usize| distance(&cubic.at(along[m] - along[k[0]]).position, &run[m]);
        if (k[0] + 1..k[1]).any(|m| off(m) > OFF_RAD) {
            return None;
        }
        path.push(cubic);
    }
    Some(path)
}

/// The second derivatives of the natural cubic spline.
fn natural<const N: usize>(points: &[[f64; N]], h: &[f64]) -> Vec<[f64; N]> {
    let n = h.len();
    let mut on: Vec<f64> = (0..=n).map(|i| if i == 0 || i == n { 1.0 } else { (h[i - 1] + h[i]) / 3.0 }).collect();
    let mut bends = vec![[0.0; N]; n + 1];
    for i in 1..n {
        let slope = |i: usize, j: usize| (points[i + 1][j] - points[i][j]) / h[i];
        bends[i] = std::array::from_fn(|j| slope(i, j) - slope(i - 1, j));
        if i > 1 {
            let factor = h[i - 1] / 6.0 / on[i - 1];
            on[i] -= factor * h[i - 1] / 6.0;
            bends[i] = std::array::from_fn(|j| bends[i][j] - factor * bends[i - 1][j]);
        }
    }
    for i in (1..n).rev() {
        bends[i] = std::array::from_fn(|j| (bends[i][j] - h[i] / 6.0 * bends[i + 1][j]) / on[i]);
    }
    bends
}
