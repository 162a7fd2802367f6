//! What is inside a mesh: where its parts are closed, a straight line upwards from inside leaves it once more than it enters it.
//!
//! A part is what hangs together by common corners. It is closed where every edge belongs to as many triangles in one direction as
//! in the other, or at least to an even number; what is not closed has no inside. The triangles are listed by the cells of a grid that
//! they lie above, so a line looks at a few of them.

use crate::mesh::Mesh;
use std::collections::BTreeMap;

/// Cells along one side of the grid at the most.
const MOST_CELLS: usize = 256;

type Corner = [f64; 3];

/// The inside of a mesh.
#[derive(Debug, Clone)]
pub struct Inside {
    /// Of parts that are closed.
    triangles: Vec<[Corner; 3]>,
    /// Whether triangles that are seen from outside turn to the left, or all to the right; else only their number tells.
    oriented: bool,
    least: Corner,
    greatest: Corner,
    counts: [usize; 2],
    /// Per cell, where its triangles begin in `listed`.
    starts: Vec<u32>,
    listed: Vec<u32>,
    /// A corner of each part, closed or not.
    corners: Vec<Corner>,
}

impl Inside {
    /// The inside of a mesh.
    pub fn new(mesh: &Mesh) -> Inside {
        let parts = Parts::new(mesh);
        let triangles: Vec<[Corner; 3]> = parts.closed(mesh);
        let corners = || triangles.iter().flatten();
        let least: Corner = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::INFINITY, f64::min));
        let greatest: Corner = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::NEG_INFINITY, f64::max));
        let side = ((triangles.len() as f64).sqrt().ceil() as usize).clamp(1, MOST_CELLS);
        let mut inside = Inside {
            oriented: parts.oriented,
            least,
            greatest,
            counts: [side; 2],
            starts: vec![0; side * side + 1],
            listed: Vec::new(),
            corners: parts.corners,
            triangles,
        };
        inside.list();
        inside
    }

    /// Whether there is any.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// The least and the greatest coordinates of closed parts; infinite where there are none.
    pub fn extents(&self) -> (Corner, Corner) {
        (self.least, self.greatest)
    }

    /// A corner of each part of the mesh, closed or not: where no surfaces meet, a part is inside something if its corner is.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Whether a point is inside.
    pub fn contains(&self, point: Corner) -> bool {
        let within = (0..3).all(|i| self.least[i] <= point[i] && point[i] <= self.greatest[i]);
        if !within {
            return false;
        }
        let above = self.crossings(point[0], point[1]).into_iter().filter(|(z, _)| *z > point[2]);
        self.is_inside(above.map(|(_, turn)| turn))
    }

    /// The intervals of z in which the vertical line at (x, y) is inside.
    pub fn column(&self, x: f64, y: f64) -> Vec<[f64; 2]> {
        let mut crossings = self.crossings(x, y);
        crossings.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut intervals: Vec<[f64; 2]> = Vec::new();
        for i in 1..crossings.len() {
            if self.is_inside(crossings[i..].iter().map(|(_, turn)| *turn)) {
                intervals.push([crossings[i - 1].0, crossings[i].0]);
            }
        }
        intervals
    }

    /// From what a line upwards crosses.
    fn is_inside(&self, turns: impl Iterator<Item = i32>) -> bool {
        let (count, sum) = turns.fold((0, 0), |(count, sum), turn| (count + 1, sum + turn));
        if self.oriented { sum != 0 } else { count % 2 == 1 }
    }

    /// Where the vertical line at (x, y) crosses the surface, and whether it is seen there from above or from below.
    fn crossings(&self, x: f64, y: f64) -> Vec<(f64, i32)> {
        let Some(cell) = self.cell(x, y) else { return Vec::new() };
        let listed = &self.listed[self.starts[cell] as usize..self.starts[cell + 1] as usize];
        listed.iter().filter_map(|t| crossing(&self.triangles[*t as usize], x, y)).collect()
    }

    fn cell(&self, x: f64, y: f64) -> Option<usize> {
        let along = |i: usize, at: f64| {
            let inside = self.least[i] <= at && at <= self.greatest[i];
            inside.then(|| self.slot(i, at))
        };
        Some(along(0, x)? * self.counts[1] + along(1, y)?)
    }

    fn slot(&self, i: usize, at: f64) -> usize {
        let extent = (self.greatest[i] - self.least[i]).max(1e-12);
        (((at - self.least[i]) / extent * self.counts[i] as f64) as usize).min(self.counts[i] - 1)
    }

    /// Counts first, then fills.
    fn list(&mut self) {
        let cells = |inside: &Inside, triangle: &[Corner; 3]| -> Vec<usize> {
            let range = |i: usize| {
                let along = triangle.map(|c| c[i]);
                let least = along.into_iter().fold(f64::INFINITY, f64::min);
                let greatest = along.into_iter().fold(f64::NEG_INFINITY, f64::max);
                inside.slot(i, least)..=inside.slot(i, greatest)
            };
            let columns = range(1);
            range(0).flat_map(|x| columns.clone().map(move |y| (x, y))).map(|(x, y)| x * inside.counts[1] + y).collect()
        };
        let all: Vec<Vec<usize>> = self.triangles.iter().map(|t| cells(self, t)).collect();
        for cell in all.iter().flatten() {
            self.starts[cell + 1] += 1;
        }
        for cell in 0..self.starts.len() - 1 {
            self.starts[cell + 1] += self.starts[cell];
        }
        let mut next = self.starts.clone();
        self.listed = vec![0; all.iter().map(Vec::len).sum()];
        for (triangle, cells) in all.iter().enumerate() {
            for cell in cells {
                self.listed[next[*cell] as usize] = triangle as u32;
                next[*cell] += 1;
            }
        }
    }
}

/// Where a vertical line crosses a triangle. A line through an edge or a corner crosses exactly one of the triangles beside it: edges are
/// looked at in one direction for both, and what is on an edge belongs to one side.
fn crossing(triangle: &[Corner; 3], x: f64, y: f64) -> Option<(f64, i32)> {
    let mut beyond = 0;
    for i in 0..3 {
        let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
        // Half open: of two edges at a corner one counts.
        if (a[1] > y) == (b[1] > y) {
            continue;
        }
        let (low, high) = if a[1] < b[1] { (a, b) } else { (b, a) };
        let cross = (high[0] - low[0]) * (y - low[1]) - (x - low[0]) * (high[1] - low[1]);
        if cross > 0.0 {
            beyond += if a[1] < b[1] { 1 } else { -1 };
        }
    }
    if beyond == 0 {
        return None;
    }
    let [a, b, c] = triangle;
    let (u, v): (Corner, Corner) = (std::array::from_fn(|i| b[i] - a[i]), std::array::from_fn(|i| c[i] - a[i]));
    let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let z = a[2] - (normal[0] * (x - a[0]) + normal[1] * (y - a[1])) / normal[2];
    let [least, greatest] = [f64::min, f64::max].map(|pick| triangle.iter().map(|c| c[2]).reduce(pick).unwrap_or(a[2]));
    Some((if z.is_finite() { z.clamp(least, greatest) } else { a[2] }, beyond))
}

/// Which triangles hang together.
struct Parts {
    /// Per triangle, its part.
    part: Vec<usize>,
    /// Per part.
    is_closed: Vec<bool>,
    oriented: bool,
    corners: Vec<Corner>,
}

impl Parts {
    fn new(mesh: &Mesh) -> Parts {
        let mut numbers: BTreeMap<[u64; 3], usize> = BTreeMap::new();
        // Minus zero is zero.
        let key = |corner: &Corner| corner.map(|c| (c + 0.0).to_bits());
        let mut indices: Vec<[usize; 3]> = Vec::with_capacity(mesh.triangles().len());
        for triangle in mesh.triangles() {
            let mut number = |i: usize| {
                let next = numbers.len();
                *numbers.entry(key(&triangle[i])).or_insert(next)
            };
            indices.push([number(0), number(1), number(2)]);
        }
        let mut joined: Vec<usize> = (0..numbers.len()).collect();
        for [a, b, c] in &indices {
            for other in [b, c] {
                let (first, second) = (root(&mut joined, *a), root(&mut joined, *other));
                joined[first] = second;
            }
        }
        // Per edge, from the lower corner to the higher: how often it is walked, and how much more often upwards.
        let mut edges: BTreeMap<(usize, usize), (u32, i32)> = BTreeMap::new();
        for triangle in &indices {
            for i in 0..3 {
                let (from, to) = (triangle[i], triangle[(i + 1) % 3]);
                if from != to {
                    let edge = edges.entry((from.min(to), from.max(to))).or_default();
                    edge.0 += 1;
                    edge.1 += if from < to { 1 } else { -1 };
                }
            }
        }
        let mut order: BTreeMap<usize, usize> = BTreeMap::new();
        let (mut part, mut corners) = (Vec::with_capacity(indices.len()), Vec::new());
        for (triangle, corner) in indices.iter().zip(mesh.triangles()) {
            let next = order.len();
            let index = *order.entry(root(&mut joined, triangle[0])).or_insert(next);
            if index == next {
                corners.push(corner[0]);
            }
            part.push(index);
        }
        let mut is_closed = vec![true; corners.len()];
        let mut turned = vec![false; corners.len()];
        for ((from, _), (count, sum)) in &edges {
            let index = order[&root(&mut joined, *from)];
            is_closed[index] &= count % 2 == 0;
            turned[index] |= *sum != 0;
        }
        let oriented = is_closed.iter().zip(&turned).all(|(closed, turned)| !(*closed && *turned));
        Parts { part, is_closed, oriented, corners }
    }

    fn closed(&self, mesh: &Mesh) -> Vec<[Corner; 3]> {
        let triangles = mesh.triangles().iter().zip(&self.part);
        triangles.filter(|(_, part)| self.is_closed[**part]).map(|(triangle, _)| *triangle).collect()
    }
}

fn root(joined: &mut [usize], mut corner: usize) -> usize {
    while joined[corner] != corner {
        joined[corner] = joined[joined[corner]];
        corner = joined[corner];
    }
    corner
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    /// Two triangles per side.
    fn block(least: Corner, greatest: Corner) -> Vec<[Corner; 3]> {
        let corner =
            |i: usize| std::array::from_fn(|axis| if i >> axis & 1 == 0 { least[axis] } else { greatest[axis] });
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).map(|t| t.map(corner)).collect()
    }

    fn inside(triangles: Vec<[Corner; 3]>) -> Inside {
        Inside::new(&Mesh::new(triangles).unwrap())
    }

    #[test]
    fn a_hollow_block_has_no_inside_in_its_hollow_and_two_that_overlap_are_one() {
        let outer = block([0.0; 3], [3.0; 3]);
        let hollow: Vec<_> = block([1.0; 3], [2.0; 3]).into_iter().map(|[a, b, c]| [a, c, b]).collect();
        let shell = inside([outer.clone(), hollow].concat());
        assert!(shell.contains([0.5, 1.5, 1.5]) && !shell.contains([1.5; 3]) && !shell.contains([3.5, 1.0, 1.0]));
        let both = inside([outer, block([2.0; 3], [4.0; 3])].concat());
        assert!(both.contains([2.5; 3]) && both.contains([1.0; 3]) && both.contains([3.5; 3]));
        assert!(!both.contains([3.5, 3.5, 1.0]));
        assert_eq!(both.corners().len(), 2);
    }

    #[test]
    fn a_line_through_edges_and_corners_is_counted_once_and_order_does_not_matter() {
        let mut triangles = block([-1.0; 3], [1.0; 3]);
        for turned in [false, true] {
            let inside = inside(triangles.clone());
            for x in [-1.5, -1.0, -0.5, 0.0, 0.5, 1.5] {
                for y in [-0.5, 0.0, 0.5] {
                    let expected = f64::abs(x) < 1.0 || (x == -1.0);
                    assert_eq!(inside.contains([x, y, 0.3]), expected, "({x}, {y}), {turned}");
                    assert_eq!(inside.column(x, y), if expected { vec![[-1.0, 1.0]] } else { Vec::new() });
                }
            }
            // Some triangles the other way round: only their number tells.
            triangles[0].swap(0, 1);
            triangles[5].swap(0, 1);
        }
    }

    #[test]
    fn a_sheet_beside_a_block_takes_nothing_from_the_inside_of_the_block() {
        let mut triangles = block([0.0; 3], [1.0; 3]);
        triangles.push([[2.0, 0.0, 0.0], [3.0, 0.0, 0.0], [2.0, 1.0, 5.0]]);
        let inside = inside(triangles);
        assert!(inside.contains([0.5; 3]) && !inside.contains([2.2, 0.2, 0.1]));
        assert!(super::tests::inside(vec![[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]).is_empty());
    }
}
