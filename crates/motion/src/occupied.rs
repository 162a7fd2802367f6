//! Prepares clouds and meshes for the vector kernels: balls within the robot's reach.
//!
//! Parts of a mesh beyond the reach are cut off first, so all work is bounded by the reach and the resolution, whatever the size of the mesh. The
//! grid covers the rest, and the surface, covered by balls ([`surface`](crate::surface)), is marked in the whole grid. So the cells that it does not
//! pass through are solid or free as a whole, and so is each connected part of them. The others are divided into small cells, so narrow that a sphere
//! with its centre in one either touches the surface or is on the same side of it as the centre of the small cell. If the bounds do not allow such
//! narrow small cells, those that the surface passes through are solid.

use crate::cloud::Cloud;
use crate::inside::Inside;
use crate::mesh::Mesh;
use crate::simd::{self, Filling, Isa, Layout};
use crate::surface::{self, Bounds};
use crate::surroundings::MeshObstacle;
use std::ops::RangeInclusive;

/// Maximum growth of a sphere between two postures for which the test is exact, in metres.
const GROWTH_M: f64 = 0.03;

/// Minimum width of small cells, in metres, and their maximum number along a side of a cell.
const LEAST_SPACING_M: f64 = 0.004;
const MOST_PER_SIDE: usize = 32;

/// Maximum number of small cells of one mesh, and of triangle tests to fill them; with the reach, both determine the width of small cells.
const MOST_SMALL_CELLS: usize = 1 << 29;
const MOST_LOOKS: usize = 1 << 26;

/// Number of meshes that may each use the full bounds; if there are more, they share them.
const FULL_SHARES: usize = 8;

/// Divisor of the bounds for each of this number of meshes.
pub(crate) fn share(meshes: usize) -> usize {
    meshes.div_ceil(FULL_SHARES).max(1)
}

/// The spheres of a robot.
#[derive(Debug, Clone)]
pub(crate) struct Reached {
    /// Where they can be: centres and radii of spheres that contain them.
    pub(crate) shells: Vec<([f64; 3], f64)>,
    /// The minimum and maximum radius.
    pub(crate) radii: [f64; 2],
}

impl Reached {
    fn reaches(&self, point: &[f64; 3], radius: f64) -> bool {
        self.shells.iter().any(|(anchor, reach)| {
            let away: f64 = (0..3).map(|i| (point[i] - anchor[i]).powi(2)).sum();
            away <= (reach + radius).powi(2)
        })
    }

    /// A box that contains all shells.
    fn bounds(&self) -> Bounds {
        let corners = |(anchor, reach): &([f64; 3], f64)| [-reach, *reach].map(|by| anchor.map(|c| c + by));
        Bounds::about(self.shells.iter().flat_map(corners))
    }
}

/// The balls of clouds with the same radius that the robot reaches; `None` without any.
pub(crate) fn cloud(clouds: &[&Cloud], robot: &Reached, isa: Isa) -> Option<simd::Cloud> {
    let radius = clouds.first()?.radius_m();
    let reached = |p: &&[f32; 3]| robot.reaches(&p.map(f64::from), radius);
    let points: Vec<[f32; 3]> = clouds.iter().flat_map(|cloud| cloud.points()).filter(reached).copied().collect();
    let reach = (robot.radii[1] + radius + GROWTH_M) as f32;
    let side = |i: usize, pick: fn(f32, f32) -> f32| points.iter().map(|p| p[i]).reduce(pick);
    let (mut least, mut greatest) = ([0.0; 3], [0.0; 3]);
    for i in 0..3 {
        (least[i], greatest[i]) = (side(i, f32::min)?, side(i, f32::max)?);
    }
    let layout = Layout::over(points.len(), least, greatest, reach, 0.0);
    Some(simd::Cloud::new(&points, radius as f32, layout, reach, isa))
}

/// A mesh within the robot's reach; `None` if there is nothing. It may use a `share`-th of the bounds.
pub(crate) fn mesh(obstacle: &MeshObstacle, robot: &Reached, isa: Isa, share: usize) -> Option<simd::Cloud> {
    let in_world = |triangle: &[[f64; 3]; 3]| triangle.map(|corner| obstacle.pose.transform(corner));
    let triangles: Vec<[[f64; 3]; 3]> = obstacle.mesh.triangles().iter().map(in_world).collect();
    let near = robot.bounds().and(&Bounds::about(triangles.iter().flatten().copied()))?;
    let margin = |radius: f64| robot.radii[1] + radius + GROWTH_M;
    let wanted = obstacle.overhang_m;
    let (radius, count) =
        surface::balls(&triangles, &near.grown(margin(wanted)), wanted, surface::MOST_SAMPLES / share);
    let reach = margin(radius) as f32;
    let [least, greatest] = [near.least, near.greatest].map(|corner| corner.map(|c| c as f32));
    let layout = Layout::over(count, least, greatest, reach, radius as f32);
    let grid = bounds(&layout);
    let centres = surface::centres(&triangles, &grid, radius);
    let mut crossed = Marks::new(layout);
    for centre in &centres {
        crossed.mark(&centre.map(|c| c as f32), radius as f32);
    }
    let reached = centres.into_iter().filter(|centre| robot.reaches(centre, radius));
    let points: Vec<[f32; 3]> = reached.map(|centre| centre.map(|c| c as f32)).collect();
    let mut cloud = simd::Cloud::new(&points, radius as f32, layout, reach, isa);
    let [least, greatest] = [grid.least, grid.greatest].map(|corner| [corner[0], corner[1]]);
    let inside = Inside::new(&Mesh::placed(triangles)).above([least, greatest]);
    if inside.is_empty() {
        return (!points.is_empty()).then_some(cloud);
    }
    let mut is_solid = !points.is_empty();
    for part in crossed.free_parts() {
        if inside.contains(layout.centre(part[0]).map(f64::from)) {
            is_solid = true;
            part.into_iter().for_each(|cell| cloud.solidify(cell));
        }
    }
    let half_diagonal = f64::from(layout.cell) * 3_f64.sqrt() / 2.0;
    let is_reached = |cell: &usize| robot.reaches(&layout.centre(*cell).map(f64::from), half_diagonal);
    let split: Vec<usize> = crossed.cells().filter(is_reached).collect();
    cloud.fill_with(filling(&inside, &layout, &split, (&points, radius), robot.radii[0], share));
    is_solid.then_some(cloud)
}

fn bounds(layout: &Layout) -> Bounds {
    Bounds { least: layout.least.map(f64::from), greatest: layout.greatest.map(f64::from) }
}

/// The inside of the mesh in the cells that the surface passes through, ordered by number; balls of a radius about `points` cover the surface.
fn filling(
    inside: &Inside,
    layout: &Layout,
    cells: &[usize],
    (points, radius): (&[[f32; 3]], f64),
    least_radius: f64,
    share: usize,
) -> Filling {
    let cell = f64::from(layout.cell);
    // Half of the diagonal of a small cell is less than the smallest sphere's radius.
    let wanted = least_radius * 2.0 / 3_f64.sqrt() * 0.99;
    let mut per_side = ((cell / wanted.max(LEAST_SPACING_M)).ceil() as usize).clamp(1, MOST_PER_SIDE);
    let columns: Vec<&[usize]> = cells.chunk_by(|a, b| a / layout.counts[2] == b / layout.counts[2]).collect();
    let middle = |column: &[usize], [x, y]: [usize; 2], per_side: usize| -> [f64; 2] {
        let at = layout.slots(column[0]);
        let along = |i: usize, small: usize| {
            f64::from(layout.least[i]) + (at[i] as f64 + (small as f64 + 0.5) / per_side as f64) * cell
        };
        [along(0, x), along(1, y)]
    };
    // A few places of each column give an estimate of its cost.
    let loads = columns.iter().map(|column| {
        let places = [[0, 0], [0, 3], [1, 1], [2, 2], [3, 0], [3, 3]].map(|small| middle(column, small, 4));
        places.iter().map(|[x, y]| 1 + inside.load(*x, *y)).max().unwrap_or(1)
    });
    let load: usize = loads.sum();
    // If small cells are too wide, every ball is marked in them.
    let is_too_wide = |per_side: usize| cell / per_side as f64 > wanted;
    let marked = |per_side: usize| {
        let across = (2.0 * radius * per_side as f64 / cell + 2.0) as usize;
        if is_too_wide(per_side) { points.len() * across * across } else { 0 }
    };
    let fits = |per_side: usize| {
        let small_cells = per_side.pow(3) * cells.len();
        small_cells <= MOST_SMALL_CELLS / share && per_side.pow(2) * load + marked(per_side) <= MOST_LOOKS / share
    };
    while per_side > 1 && !fits(per_side) {
        per_side -= 1;
    }
    let spacing = cell / per_side as f64;
    let mut filling = Filling::new(layout, per_side);
    let small = |i: usize, at: f64| ((at - f64::from(layout.least[i])) / spacing).max(0.0);
    for column in columns {
        for small_xy in (0..per_side).flat_map(|x| (0..per_side).map(move |y| [x, y])) {
            let [x, y] = middle(column, small_xy, per_side);
            for [from, to] in inside.column(x, y) {
                // The cells whose centre is inside.
                let (first, end) =
                    ((small(2, from) - 0.5).ceil().max(0.0) as usize, (small(2, to) + 0.5).floor() as usize);
                for &index in column {
                    let base = layout.slots(index)[2] * per_side;
                    if let Some(part) = shared(first, end, base, per_side) {
                        filling.fill(index, small_xy, part);
                    }
                }
            }
        }
    }
    if is_too_wide(per_side) {
        let split = Marks::of(*layout, cells);
        for point in points {
            let range = |i: usize, by: f64| small(i, f64::from(point[i]) + by * 1.01) as usize;
            let [from, to] = [-radius, radius].map(|by| [range(0, by), range(1, by), range(2, by)]);
            for (x, y) in (from[0]..=to[0]).flat_map(|x| (from[1]..=to[1]).map(move |y| (x, y))) {
                for z in from[2] / per_side..=to[2] / per_side {
                    let at = [x / per_side, y / per_side, z];
                    if (0..3).any(|i| at[i] >= layout.counts[i]) || !split.marked[layout.index(at)] {
                        continue;
                    }
                    if let Some(part) = shared(from[2], to[2] + 1, z * per_side, per_side) {
                        filling.fill(layout.index(at), [x % per_side, y % per_side], part);
                    }
                }
            }
        }
    }
    filling
}

/// The part of `first..end` in the `count` numbers from `base` on, relative to `base`.
fn shared(first: usize, end: usize, base: usize, count: usize) -> Option<RangeInclusive<usize>> {
    let (from, to) = (first.max(base), end.min(base + count));
    (from < to).then(|| from - base..=to - base - 1)
}

/// Cells of a grid that are marked.
struct Marks {
    layout: Layout,
    marked: Vec<bool>,
}

impl Marks {
    fn new(layout: Layout) -> Marks {
        Marks { layout, marked: vec![false; layout.cells()] }
    }

    /// Marks the cells that a ball may overlap.
    fn mark(&mut self, point: &[f32; 3], radius: f32) {
        let slot = |at: f32, i: usize| self.layout.slot(i, at);
        let from: [usize; 3] = std::array::from_fn(|i| slot(point[i] - radius * 1.01, i));
        let to: [usize; 3] = std::array::from_fn(|i| slot(point[i] + radius * 1.01, i));
        for x in from[0]..=to[0] {
            for y in from[1]..=to[1] {
                for z in from[2]..=to[2] {
                    let index = self.layout.index([x, y, z]);
                    self.marked[index] = true;
                }
            }
        }
    }

    /// A grid in which these cells are marked.
    fn of(layout: Layout, cells: &[usize]) -> Marks {
        let mut marks = Marks::new(layout);
        cells.iter().for_each(|cell| marks.marked[*cell] = true);
        marks
    }

    /// The marked cells, ordered by number.
    fn cells(&self) -> impl Iterator<Item = usize> {
        self.marked.iter().enumerate().filter(|(_, marked)| **marked).map(|(cell, _)| cell)
    }

    /// The unmarked cells, grouped by parts that are connected by sides.
    fn free_parts(&self) -> Vec<Vec<usize>> {
        let mut seen = self.marked.clone();
        let mut parts = Vec::new();
        for first in 0..seen.len() {
            if std::mem::replace(&mut seen[first], true) {
                continue;
            }
            let mut part = vec![first];
            let mut next = 0;
            while next < part.len() {
                let at = self.layout.slots(part[next]);
                next += 1;
                for axis in 0..3 {
                    for step in [-1_isize, 1] {
                        let Some(slot) = at[axis].checked_add_signed(step).filter(|s| *s < self.layout.counts[axis])
                        else {
                            continue;
                        };
                        let mut beside = at;
                        beside[axis] = slot;
                        let index = self.layout.index(beside);
                        if !std::mem::replace(&mut seen[index], true) {
                            part.push(index);
                        }
                    }
                }
            }
            parts.push(part);
        }
        parts
    }
}
