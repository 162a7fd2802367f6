//! Rounds a path all along: its limit is the cubic B-spline whose control points are the path's postures, and more of them on
//! long motions, so that a corner is rounded close to itself.
//!
//! The refinement is that of Lane and Riesenfeld (*A theoretical development for the computer generation and display of piecewise
//! polynomial surfaces*, PAMI 1980): in every round each motion gets a posture in its middle, and each posture between two motions
//! goes to an eighth, six eighths and an eighth of its neighbours and itself, which is half the way to the middle of the two new
//! ones beside it. Halves of motions are parts of what is known to be free, so only the two motions at a posture that moves are
//! checked; one that cannot move stays, and may move less far in a later round.

use crate::collision::{between, distance};

/// The longest motion between two control points, in radians.
const SPACING_RAD: f64 = 0.25;

/// Rounds of refinement: motions end up about as short as the steps that a path is timed by.
const ROUNDS: usize = 4;

/// A posture that would move less stays, in radians.
const LEAST_RAD: f64 = 3e-4;

/// The smooth path, with the same ends; `is_free` says whether a straight motion is.
pub(crate) fn smoothed<const N: usize>(
    path: &[[f64; N]],
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Vec<[f64; N]> {
    let mut smooth = divided(path);
    for _ in 0..ROUNDS {
        let (rounded, moved) = round(&smooth, is_free);
        if moved == 0 {
            break;
        }
        smooth = rounded;
    }
    smooth
}

/// The same path with more postures on it.
fn divided<const N: usize>(path: &[[f64; N]]) -> Vec<[f64; N]> {
    let mut divided = vec![path[0]];
    for pair in path.windows(2) {
        let parts = (distance(&pair[0], &pair[1]) / SPACING_RAD).ceil().max(1.0) as usize;
        divided.extend((1..parts).map(|i| between(&pair[0], &pair[1], i as f64 / parts as f64)));
        divided.push(pair[1]);
    }
    divided
}

/// One round, and how many postures it has moved.
fn round<const N: usize>(
    path: &[[f64; N]],
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> (Vec<[f64; N]>, usize) {
    let mut rounded = Vec::with_capacity(2 * path.len());
    let mut moved = 0;
    rounded.push(path[0]);
    for window in path.windows(3) {
        let [before, here, after] = [window[0], window[1], window[2]];
        let (near, far) = (between(&before, &here, 0.5), between(&here, &after, 0.5));
        let there = between(&here, &between(&near, &far, 0.5), 0.5);
        if distance(&here, &there) < LEAST_RAD || !is_free(&near, &there) || !is_free(&there, &far) {
            rounded.push(here);
            continue;
        }
        moved += 1;
        // The posture before may have moved, too: then this one is there.
        if rounded[rounded.len() - 1] != near {
            rounded.push(near);
        }
        rounded.extend([there, far]);
    }
    rounded.push(path[path.len() - 1]);
    (rounded, moved)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collision::length;

    /// Half of the edge of a square that must not be touched.
    const HALF: f64 = 0.4;

    fn is_outside([x, y]: [f64; 2]) -> bool {
        x.abs().max(y.abs()) > HALF
    }

    fn is_free(from: &[f64; 2], to: &[f64; 2]) -> bool {
        (0..=200).all(|i| is_outside(between(from, to, f64::from(i) / 200.0)))
    }

    fn bends(path: &[[f64; 2]]) -> Vec<f64> {
        path.windows(3).map(|w| crate::blend::bend_rad(&w[0], &w[1], &w[2])).collect()
    }

    const DETOUR: [[f64; 2]; 4] = [[-1.0, -1.0], [-0.45, 1.0], [0.5, 0.9], [1.0, -1.0]];

    #[test]
    fn with_room_all_corners_become_a_smooth_curve_that_is_shorter_and_keeps_the_ends() {
        let mut checked = 0;
        let smooth = smoothed(&DETOUR, &mut |_, _| {
            checked += 1;
            true
        });
        assert_eq!((smooth[0], smooth[smooth.len() - 1]), (DETOUR[0], DETOUR[3]));
        assert!(length(&smooth) < length(&DETOUR) * 0.99, "{}", length(&smooth));
        let sharpest = bends(&smooth).into_iter().fold(0.0, f64::max);
        assert!(sharpest < 0.15 && checked > 50, "{sharpest} rad, {checked} checked");
    }

    #[test]
    fn a_posture_that_cannot_move_stays_and_nothing_that_was_not_free_comes_in() {
        // Two corners at the square itself: the curve would cut into it.
        let tight = [[-1.0, -1.0], [-0.41, 0.41], [0.41, 0.41], [1.0, -1.0]];
        for path in [DETOUR, tight] {
            let mut refused = 0;
            let smooth = smoothed(&path, &mut |from, to| {
                let free = is_free(from, to);
                refused += i32::from(!free);
                free
            });
            assert!(smooth.windows(2).all(|pair| is_free(&pair[0], &pair[1])));
            assert!(length(&smooth) <= length(&path) + 1e-9);
            assert_eq!(refused > 0, path == tight);
        }
        let walled = smoothed(&tight, &mut |_, _| false);
        assert_eq!(walled, divided(&tight));
    }

    #[test]
    fn a_path_without_corners_stays_as_it_is() {
        let straight = [[0.0, 0.0], [0.3, 0.4]];
        assert!((length(&smoothed(&straight, &mut |_, _| true)) - 0.5).abs() < 1e-12);
        assert_eq!(smoothed(&[[1.0, 2.0]], &mut |_, _| true), [[1.0, 2.0]]);
    }
}
