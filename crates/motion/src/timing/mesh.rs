//! The cells in which the third order is solved: short where acceleration changes, in sharp turns and near rest, long in a cruise.

use super::follow::Bounds;
use super::path::{Path, Segment, norm};
use super::second_order::Second;
use super::third_order::Mesh;

/// Maximum change of direction in a cell, in radians, and minimum number of cells per segment.
const TURN: f64 = 0.25;
const CELLS: f64 = 2.0;

/// Maximum length of a cell as a part of the distance from the start, and likewise to the end.
const GROWTH: f64 = 0.35;

/// The first cell takes this part of the time in which the acceleration is reached.
const FIRST: f64 = 0.35;

/// The mesh for a path that was timed within limits of velocity and acceleration; a cell ends at the end of each segment.
pub(crate) fn mesh<const N: usize>(path: &Path<N>, bounds: &Bounds<N>, second: &Second<N>) -> Mesh<N> {
    let whole = path.length();
    let segments = path.segments();
    let first_way = |slope: &[f64; N], room: f64| {
        let limits = bounds.along(slope);
        let by_way = (whole / (2.0 * limits.jerk)).cbrt();
        let jerking = (limits.acceleration / limits.jerk).min(by_way).min((limits.velocity / limits.jerk).sqrt());
        (limits.jerk * (FIRST * jerking).powi(3) / 6.0).min(room / 3.0)
    };
    let last = &segments[segments.len() - 1];
    let first = first_way(&segments[0].at(0.0).first, segments[0].length);
    let end = first_way(&last.at(last.length).first, last.length);
    // No other cell has to be shorter than those after the first or before the last.
    let least = GROWTH * first.min(end);
    let mut s = vec![0.0];
    let in_cell = |segment: &Segment<N>, from: f64, to: f64| [from, (from + to) / 2.0, to].map(|at| segment.at(at));
    let mut cells = vec![in_cell(&segments[0], 0.0, first)];
    let (steps_s, mut cursor) = (second.steps_s(bounds), second.cursor());
    let mut reach = |at: f64| {
        let [square, step_s] = cursor.at(at, [&second.squares, &steps_s]);
        square.sqrt() * step_s
    };
    for (i, (segment, start)) in segments.iter().zip(path.breaks()).enumerate() {
        let from = if i == 0 { first } else { start };
        let to = if i + 1 == segments.len() { whole - end } else { start + segment.length };
        // The number of cells up to each of many points.
        let mut counted = vec![(from, 0.0)];
        let (mut at, mut sum) = (from, 0.0);
        while at < to {
            let near = GROWTH * at.min((whole - at).max(end));
            let here = segment.at(at - start);
            let near = near.min(TURN * norm(&here.first) / norm(&here.second).max(1e-9));
            let cell = near.min(reach(at)).min(segment.length / CELLS).max(least);
            let step = (cell / 6.0).min(to - at).max(whole * 1e-9);
            at = (at + step).min(to);
            sum += step / cell;
            counted.push((at, sum));
        }
        let count = sum.ceil().max(2.0) as usize;
        let mut k = 0;
        let mut before = from;
        for c in 1..=count {
            let wanted = sum * c as f64 / count as f64;
            while k + 2 < counted.len() && counted[k + 1].1 < wanted {
                k += 1;
            }
            let (a, b) = (counted[k], counted[k + 1]);
            let here = if c == count { to } else { a.0 + (b.0 - a.0) * (wanted - a.1) / (b.1 - a.1) };
            s.push(before);
            cells.push(in_cell(segment, before - start, here - start));
            before = here;
        }
    }
    s.extend([whole - end, whole]);
    cells.push(in_cell(last, last.length - end, last.length));
    let mut cursor = second.cursor();
    let without_jerk = s.windows(2).map(|pair| cursor.at((pair[0] + pair[1]) / 2.0, [&second.squares])[0]).collect();
    Mesh { s, cells, without_jerk, joints: bounds.joints }
}
