//! Rounds the corners of a path, each by itself: a quintic Bézier curve per corner, straight at both ends, as wide as the neighbours
//! and the obstacles leave room for; without room the path is cut there, for the arm to stop.

use crate::collision::{between, distance};

/// A corner that turns by less is followed as it is, in radians: a step of the phase plane leaves half a milliradian there.
const SMOOTH_RAD: f64 = 0.2;

/// The widest that a corner is cut on each side, and the least, in radians.
const BLEND_RAD: f64 = 0.5;
const LEAST_RAD: f64 = 0.01;

/// How often a blend that touches something is halved before the arm stops at the corner instead.
const BLEND_HALVINGS: usize = 4;

/// Where its control points are on each side, from its end to the corner.
const CONTROLS: [f64; 3] = [0.0, 0.4, 0.8];

/// Points of a Bézier curve.
const BLEND_POINTS: usize = 96;

/// The path with rounded corners, cut where the arm has to stop.
pub(crate) fn rounded<const N: usize>(
    path: &[[f64; N]],
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Vec<Vec<[f64; N]>> {
    let mut pieces = Vec::new();
    let mut piece = vec![path[0]];
    for window in path.windows(3) {
        let [before, corner, after] = [window[0], window[1], window[2]];
        if bend_rad(&before, &corner, &after) < SMOOTH_RAD {
            piece.push(corner);
            continue;
        }
        let (near, far) = (distance(&before, &corner), distance(&corner, &after));
        let mut width = BLEND_RAD.min(near / 2.0).min(far / 2.0);
        let mut curve = None;
        for _ in 0..=BLEND_HALVINGS {
            if width < LEAST_RAD {
                break;
            }
            let from = between(&corner, &before, width / near);
            let to = between(&corner, &after, width / far);
            let points = bezier(&from, &corner, &to);
            if is_free_along(&points, is_free) {
                curve = Some(points);
                break;
            }
            width /= 2.0;
        }
        match curve {
            Some(points) => piece.extend(points),
            None => {
                piece.push(corner);
                pieces.push(std::mem::replace(&mut piece, vec![corner]));
            }
        }
    }
    piece.push(path[path.len() - 1]);
    pieces.push(piece);
    pieces
}

/// How far the direction turns at a corner.
pub(crate) fn bend_rad<const N: usize>(before: &[f64; N], corner: &[f64; N], after: &[f64; N]) -> f64 {
    let (near, far) = (distance(before, corner), distance(corner, after));
    let dot: f64 = (0..N).map(|j| (corner[j] - before[j]) * (after[j] - corner[j])).sum();
    (dot / (near * far).max(f64::MIN_POSITIVE)).clamp(-1.0, 1.0).acos()
}

/// The curve whose control points are on the two sides: without bend where it begins and ends.
fn bezier<const N: usize>(from: &[f64; N], corner: &[f64; N], to: &[f64; N]) -> Vec<[f64; N]> {
    let before = CONTROLS.map(|share| between(from, corner, share));
    let after = CONTROLS.map(|share| between(to, corner, share));
    let controls = [before[0], before[1], before[2], after[2], after[1], after[0]];
    let point = |i: usize| {
        let t = i as f64 / BLEND_POINTS as f64;
        let mut level = controls;
        for count in (1..controls.len()).rev() {
            for k in 0..count {
                level[k] = between(&level[k], &level[k + 1], t);
            }
        }
        level[0]
    };
    (0..=BLEND_POINTS).map(point).collect()
}

fn is_free_along<const N: usize>(curve: &[[f64; N]], is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool) -> bool {
    // Every eighth point: the chords between them stay within a fraction of a milliradian of the curve.
    let points: Vec<&[f64; N]> = curve.iter().step_by(8).collect();
    points.windows(2).all(|pair| is_free(pair[0], pair[1]))
}
