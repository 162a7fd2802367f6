//! The inside of a mesh: where its closed parts (`closed_parts.rs`) are solid. The orientation of a file's triangles makes no difference to a part by itself,
//! nor where separate parts overlap.
//!
//! A part contains a point if a vertical ray upwards from there leaves the part more often than it enters it (or vice versa). A part by itself is solid. A part
//! wholly inside another is solid if it has the same orientation as the outermost part around it, and a hollow if it has the other one. A part is wholly inside
//! another if its corners and the centres of its triangles are, and if the surfaces do not meet; a part that touches the one around it is solid. Where the file
//! does not tell a part's orientation, it is a hollow inside a solid, and solid inside a hollow. Solid parts count one, hollows minus one: a point is inside
//! where the sum is not zero.
//!
//! The triangles are listed by the cells of a grid below them, so a ray only tests a few of them.

use crate::closed_parts::closed_parts;
use crate::mesh::Mesh;
use parry3d::math::Pose as Pose32;
use parry3d::query;
use parry3d::shape::SharedShape;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// Maximum number of cells along a side of the grid.
const MOST_CELLS: usize = 256;

/// Maximum number of triangles tested to find parts inside others; remaining parts count as solid.
const MOST_LOOKS: usize = 200_000_000;

/// Maximum number of pairs of surfaces that are tested for intersection; remaining parts count as solid.
const MOST_MEETINGS: usize = 20_000;

/// Maximum number of list entries, per triangle and in addition; the grid becomes coarser if there would be more.
const MOST_LISTED: usize = 16;
const MOST_LISTED_MORE: usize = 65_536;

type Corner = [f64; 3];

/// A closed part.
#[derive(Debug, Clone, Copy)]
struct Part {
    /// Whether the winding number tells its inside; otherwise the number of crossings does.
    is_oriented: bool,
    /// Its orientation, as [`ClosedPart::sense`](crate::closed_parts::ClosedPart::sense).
    sense: i32,
    /// 1 for a solid part, -1 for a hollow.
    weight: i32,
}

/// A crossing of a line with the surface.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    z: f64,
    /// 1 or -1 by the triangle's orientation as seen from above.
    turn: i32,
    part: u32,
}

/// The inside of a mesh.
#[derive(Debug, Clone)]
pub struct Inside {
    /// Triangles of closed parts.
    triangles: Vec<[Corner; 3]>,
    /// For each triangle, its part.
    part: Vec<u32>,
    parts: Vec<Part>,
    least: Corner,
    greatest: Corner,
    /// The least and the greatest x and y of the grid.
    grid: [[f64; 2]; 2],
    /// Number of cells along each side.
    side: usize,
    /// For each cell, the index of its first triangle in `listed`.
    starts: Vec<u32>,
    listed: Vec<u32>,
    /// A corner of each part, closed or not.
    corners: Vec<Corner>,
}

impl Inside {
    /// The inside of a mesh.
    pub fn new(mesh: &Mesh) -> Inside {
        let (mut triangles, mut part, mut parts) = (Vec::new(), Vec::new(), Vec::new());
        let (closed, corners_of_parts) = closed_parts(mesh);
        for (index, closed) in closed.into_iter().enumerate() {
            part.extend(std::iter::repeat_n(index as u32, closed.triangles.len()));
            parts.push(Part { is_oriented: closed.is_oriented, sense: closed.sense, weight: 1 });
            triangles.extend(closed.triangles);
        }
        let corners = || triangles.iter().flatten();
        let least: Corner = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::INFINITY, f64::min));
        let greatest: Corner = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::NEG_INFINITY, f64::max));
        let grid = [least, greatest].map(|corner| [corner[0], corner[1]]);
        let mut inside = Inside {
            part,
            parts,
            least,
            greatest,
            grid,
            side: 0,
            starts: Vec::new(),
            listed: Vec::new(),
            corners: corners_of_parts,
            triangles,
        };
        inside.list();
        inside.find_hollows();
        inside
    }

    /// The same, prepared only for points with x and y from `least` to `greatest`: other points count as outside.
    pub(crate) fn above(mut self, [least, greatest]: [[f64; 2]; 2]) -> Inside {
        self.grid = [[0, 1].map(|i| self.grid[0][i].max(least[i])), [0, 1].map(|i| self.grid[1][i].min(greatest[i]))];
        self.list();
        self
    }

    /// Whether there is no inside.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// The least and the greatest coordinates of the closed parts; infinite where there are none.
    pub fn extents(&self) -> (Corner, Corner) {
        (self.least, self.greatest)
    }

    /// A corner of each part of the mesh, closed or not: where surfaces do not meet, a part is inside something if its corner is.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Whether a point is inside.
    pub fn contains(&self, point: Corner) -> bool {
        let within = (0..3).all(|i| self.least[i] <= point[i] && point[i] <= self.greatest[i]);
        if !within {
            return false;
        }
        self.holding(point).iter().map(|part| self.parts[*part as usize].weight).sum::<i32>() != 0
    }

    /// The intervals of z in which the vertical line at (x, y) is inside.
    pub fn column(&self, x: f64, y: f64) -> Vec<[f64; 2]> {
        let mut crossings = self.crossings(x, y);
        // From the top.
        crossings.sort_by(|a, b| b.z.total_cmp(&a.z));
        let mut parts: Vec<u32> = crossings.iter().map(|crossing| crossing.part).collect();
        parts.sort_unstable();
        parts.dedup();
        let mut tallies: Vec<Tally> = parts.iter().map(|part| Tally { part: *part, count: 0, sum: 0 }).collect();
        let (mut sum, mut intervals) = (0, Vec::new());
        for pair in crossings.windows(2) {
            let here = pair[0];
            let weight =
                |tally: &Tally| if tally.holds(&self.parts) { self.parts[tally.part as usize].weight } else { 0 };
            let known = parts.partition_point(|part| *part < here.part);
            sum -= weight(&tallies[known]);
            tallies[known].add(here.turn);
            sum += weight(&tallies[known]);
            if sum != 0 {
                intervals.push([pair[1].z, here.z]);
            }
        }
        intervals.reverse();
        intervals
    }

    /// The parts that contain a point, sorted.
    fn holding(&self, [x, y, z]: Corner) -> Vec<u32> {
        let mut above: Vec<Crossing> = self.crossings(x, y).into_iter().filter(|crossing| crossing.z > z).collect();
        above.sort_unstable_by_key(|crossing| crossing.part);
        let tally = |same: &[Crossing]| {
            let mut tally = Tally { part: same[0].part, count: 0, sum: 0 };
            same.iter().for_each(|crossing| tally.add(crossing.turn));
            tally
        };
        let tallies = above.chunk_by(|a, b| a.part == b.part).map(tally);
        tallies.filter(|tally| tally.holds(&self.parts)).map(|tally| tally.part).collect()
    }

    /// The crossings of the vertical line at (x, y) with the surface.
    fn crossings(&self, x: f64, y: f64) -> Vec<Crossing> {
        let Some(cell) = self.cell(x, y) else { return Vec::new() };
        let crossing = |triangle: &u32| {
            let (z, turn) = crossing(&self.triangles[*triangle as usize], x, y)?;
            Some(Crossing { z, turn, part: self.part[*triangle as usize] })
        };
        self.listed(cell).iter().filter_map(crossing).collect()
    }

    /// The triangles above a cell.
    fn listed(&self, cell: usize) -> &[u32] {
        &self.listed[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// Finds the parts that are hollows of others, largest first.
    fn find_hollows(&mut self) {
        let first = self.parts.first().map_or(0, |part| part.sense);
        if first != 0 && self.parts.iter().all(|part| part.sense == first) {
            return;
        }
        // The triangles of a part are consecutive.
        let ranges: Vec<Range<usize>> = self
            .part
            .chunk_by(|a, b| a == b)
            .scan(0, |end, same| {
                let start = *end;
                *end += same.len();
                Some(start..*end)
            })
            .collect();
        let size = |range: &Range<usize>| -> f64 {
            let corners = || self.triangles[range.clone()].iter().flatten();
            let side = |i: usize| {
                let [least, greatest] =
                    [f64::min, f64::max].map(|pick| corners().map(|c| c[i]).reduce(pick).unwrap_or(0.0));
                greatest - least
            };
            side(0) * side(1) * side(2)
        };
        let sizes: Vec<f64> = ranges.iter().map(size).collect();
        let mut order: Vec<usize> = (0..sizes.len()).collect();
        order.sort_by(|a, b| sizes[*b].total_cmp(&sizes[*a]));
        let (mut looks, mut surfaces) = (0, Surfaces::default());
        for part in order {
            let mut around = self.around(part, &ranges[part], &mut looks);
            around.retain(|other| !surfaces.meet(&self.triangles, &ranges[part], &ranges[*other]));
            let outermost = around.iter().copied().filter(|other| self.parts[*other].sense != 0);
            let outermost = outermost.max_by(|a, b| sizes[*a].total_cmp(&sizes[*b]));
            let solid: i32 = around.iter().map(|other| self.parts[*other].weight).sum();
            let sense = self.parts[part].sense;
            let is_hollow = match outermost.filter(|_| sense != 0) {
                Some(outermost) => self.parts[outermost].sense != sense,
                None => sense == 0 && solid > 0,
            };
            self.parts[part].weight = if is_hollow { -1 } else { 1 };
        }
    }

    /// The parts that contain all corners and all triangle centres of a part.
    fn around(&self, part: usize, range: &Range<usize>, looks: &mut usize) -> Vec<usize> {
        let mut around: Option<BTreeSet<u32>> = None;
        for triangle in &self.triangles[range.clone()] {
            let [a, b, c] = *triangle;
            let middle = std::array::from_fn(|i| (a[i] + b[i] + c[i]) / 3.0);
            for point in [a, b, c, middle] {
                *looks += self.cell(point[0], point[1]).map_or(0, |cell| self.listed(cell).len());
                if *looks > MOST_LOOKS {
                    return Vec::new();
                }
                let mut holding = self.holding(point);
                holding.retain(|other| {
                    *other as usize != part && around.as_ref().is_none_or(|around| around.contains(other))
                });
                if holding.is_empty() {
                    return Vec::new();
                }
                around = Some(holding.into_iter().collect());
            }
        }
        around.into_iter().flatten().map(|other| other as usize).collect()
    }

    /// Number of triangles tested for a vertical line at (x, y).
    pub(crate) fn load(&self, x: f64, y: f64) -> usize {
        self.cell(x, y).map_or(0, |cell| self.listed(cell).len())
    }

    fn cell(&self, x: f64, y: f64) -> Option<usize> {
        let [least, greatest] = self.grid;
        let along = |i: usize, at: f64| (least[i] <= at && at <= greatest[i]).then(|| self.slot(i, at));
        Some(along(0, x)? * self.side + along(1, y)?)
    }

    fn slot(&self, i: usize, at: f64) -> usize {
        let [least, greatest] = self.grid.map(|side| side[i]);
        let extent = (greatest - least).max(1e-12);
        (((at - least) / extent * self.side as f64) as usize).min(self.side - 1)
    }

    /// The first and the last cell along x, then along y, below a triangle.
    fn beneath(&self, triangle: &[Corner; 3]) -> Option<[[usize; 2]; 2]> {
        let range = |i: usize| {
            let along = triangle.map(|c| c[i]);
            let least = along.into_iter().fold(f64::INFINITY, f64::min);
            let greatest = along.into_iter().fold(f64::NEG_INFINITY, f64::max);
            let is_there = greatest >= self.grid[0][i] && least <= self.grid[1][i];
            is_there.then(|| [self.slot(i, least), self.slot(i, greatest)])
        };
        Some([range(0)?, range(1)?])
    }

    /// Counts first, then fills; as fine as the limit on the lists allows.
    fn list(&mut self) {
        let most = MOST_LISTED * self.triangles.len() + MOST_LISTED_MORE;
        self.side = ((self.triangles.len() as f64).sqrt().ceil() as usize).clamp(1, MOST_CELLS);
        loop {
            let beneath = self.triangles.iter().filter_map(|triangle| self.beneath(triangle));
            let count: usize = beneath.map(|[x, y]| (x[1] - x[0] + 1) * (y[1] - y[0] + 1)).sum();
            if count <= most || self.side == 1 {
                break;
            }
            self.side = self.side.div_ceil(2);
        }
        let mut starts = vec![0_u32; self.side * self.side + 1];
        self.visit(&mut |cell, _| starts[cell + 1] += 1);
        for cell in 0..starts.len() - 1 {
            starts[cell + 1] += starts[cell];
        }
        let mut next = starts.clone();
        let mut listed = vec![0; starts.last().map_or(0, |end| *end as usize)];
        self.visit(&mut |cell, triangle| {
            listed[next[cell] as usize] = triangle;
            next[cell] += 1;
        });
        (self.starts, self.listed) = (starts, listed);
    }

    /// Passes each cell with each triangle above it to `show`.
    fn visit(&self, show: &mut dyn FnMut(usize, u32)) {
        for (number, triangle) in self.triangles.iter().enumerate() {
            let Some([x, y]) = self.beneath(triangle) else { continue };
            for row in x[0]..=x[1] {
                (y[0]..=y[1]).for_each(|column| show(row * self.side + column, number as u32));
            }
        }
    }
}

/// The surfaces of parts, by the index of their first triangle.
#[derive(Default)]
struct Surfaces {
    shapes: BTreeMap<usize, SharedShape>,
    looks: usize,
}

impl Surfaces {
    /// Whether the surfaces of two parts meet; true where that is unknown.
    fn meet(&mut self, triangles: &[[Corner; 3]], a: &Range<usize>, b: &Range<usize>) -> bool {
        self.looks += 1;
        if self.looks > MOST_MEETINGS {
            return true;
        }
        for range in [a, b] {
            let shape = || Mesh::placed(triangles[range.clone()].to_vec()).shape();
            self.shapes.entry(range.start).or_insert_with(shape);
        }
        let here = Pose32::IDENTITY;
        query::intersection_test(&here, &*self.shapes[&a.start], &here, &*self.shapes[&b.start])
            .map_or(true, |found| found.intersecting)
    }
}

/// Crossings of a line with a part.
#[derive(Debug)]
struct Tally {
    part: u32,
    count: u32,
    sum: i32,
}

impl Tally {
    fn add(&mut self, turn: i32) {
        self.count += 1;
        self.sum += turn;
    }

    fn holds(&self, parts: &[Part]) -> bool {
        if parts[self.part as usize].is_oriented { self.sum != 0 } else { self.count % 2 == 1 }
    }
}

/// The crossing of a vertical line with a triangle. A line through an edge or a corner crosses exactly one of the adjacent triangles: both evaluate the edge in
/// the same direction, and a point on the edge belongs to one side.
fn crossing(triangle: &[Corner; 3], x: f64, y: f64) -> Option<(f64, i32)> {
    let mut beyond = 0;
    for i in 0..3 {
        let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
        // Half-open: of two edges at a corner one counts.
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::*;

    /// A box with two triangles per side.
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
            // Some triangles are flipped: only the number of crossings tells.
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

    fn turned(triangles: &[[Corner; 3]]) -> Vec<[Corner; 3]> {
        triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect()
    }

    /// Compares the inside with `expected`, by columns and by points.
    fn agree(inside: &Inside, expected: impl Fn(Corner) -> bool, what: &str) {
        for i in 0..17 * 17 * 17 {
            // Not on corners and faces, which belong to neither side.
            let at = [i % 17, i / 17 % 17, i / 289].map(|i| f64::from(i) * 0.31 - 0.487);
            assert_eq!(inside.contains(at), expected(at), "{what}: {at:?}");
            let column = inside.column(at[0], at[1]).iter().any(|[low, high]| *low <= at[2] && at[2] <= *high);
            assert_eq!(column, expected(at), "{what}, column: {at:?}");
        }
    }

    fn within(at: Corner, least: f64, greatest: f64) -> bool {
        at.iter().all(|c| least < *c && *c < greatest)
    }

    #[test]
    fn what_is_there_from_both_sides_is_solid_like_what_is_there_once() {
        let one = block([0.0; 3], [3.0; 3]);
        let sides = [one.clone(), turned(&one)].concat();
        agree(&inside(sides.clone()), |at| within(at, 0.0, 3.0), "both sides");
        agree(&inside([one.clone(), one.clone()].concat()), |at| within(at, 0.0, 3.0), "twice");
        agree(&inside([sides.clone(), one.clone()].concat()), |at| within(at, 0.0, 3.0), "three times");
        let mut mixed: Vec<_> = turned(&one)
            .into_iter()
            .enumerate()
            .map(|(i, t)| if i % 3 == 0 { [t[1], t[0], t[2]] } else { t })
            .collect();
        mixed.extend(one.clone());
        agree(&inside(mixed), |at| within(at, 0.0, 3.0), "both sides, some of them twice");
        // Some of the triangles occur from both sides.
        let some = [one.clone(), turned(&one[..3])].concat();
        agree(&inside(some), |at| within(at, 0.0, 3.0), "some from both sides");
        // A room: the walls between two blocks, with the inner block from both sides.
        let room = [sides, block([1.0; 3], [2.0; 3]), turned(&block([1.0; 3], [2.0; 3]))].concat();
        agree(&inside(room), |at| within(at, 0.0, 3.0) && !within(at, 1.0, 2.0), "a room");
    }

    #[test]
    fn a_wall_that_two_blocks_share_is_none_of_the_outside() {
        let (left, right) = (block([0.0; 3], [1.5, 3.0, 3.0]), block([1.5, 0.0, 0.0], [3.0; 3]));
        for (left, right) in [(left.clone(), right.clone()), (turned(&left), right.clone()), (left, turned(&right))] {
            let both = inside([left.clone(), right].concat());
            agree(&both, |at| within(at, 0.0, 3.0), "two blocks with a wall");
        }
    }

    #[test]
    fn parts_that_overlap_are_solid_however_each_is_turned() {
        let (first, second) = (block([0.0; 3], [3.0; 3]), block([2.0; 3], [4.0; 3]));
        let third = block([1.0, 1.0, -0.4], [2.5, 2.5, 4.2]);
        for turns in 0..8 {
            let turn =
                |bit: usize, part: &[[Corner; 3]]| if turns >> bit & 1 == 1 { turned(part) } else { part.to_vec() };
            let all = inside([turn(0, &first), turn(1, &second), turn(2, &third)].concat());
            let through = |at: Corner| (0..2).all(|i| 1.0 < at[i] && at[i] < 2.5) && -0.4 < at[2] && at[2] < 4.2;
            agree(&all, |at| within(at, 0.0, 3.0) || within(at, 2.0, 4.0) || through(at), &format!("turns {turns:b}"));
        }
    }

    #[test]
    fn a_hollow_stays_one_when_all_is_mirrored_and_an_island_in_it_is_solid() {
        let part = |least: f64, greatest: f64, is_turned: bool| {
            let block = block([least; 3], [greatest; 3]);
            if is_turned { turned(&block) } else { block }
        };
        for is_mirrored in [false, true] {
            let all = [part(0.0, 4.0, is_mirrored), part(0.5, 3.5, !is_mirrored), part(1.5, 2.5, is_mirrored)].concat();
            let expected = |at: Corner| within(at, 0.0, 4.0) && (!within(at, 0.5, 3.5) || within(at, 1.5, 2.5));
            agree(&inside(all), expected, "an island");
            // With the same orientation, two nested parts are one solid.
            let nested = [part(0.0, 4.0, is_mirrored), part(0.5, 3.5, is_mirrored)].concat();
            agree(&inside(nested), |at| within(at, 0.0, 4.0), "nested");
        }
    }
}
