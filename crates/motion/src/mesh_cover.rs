//! Covers a mesh with few, tight spheres.
//!
//! The mesh is rasterised to a fine grid: its cells are those that the surface passes through and those that it encloses. The cells are grouped in
//! blocks, and of each block the bounding box of its mesh cells has to be covered. The candidates are spheres about the centre of each box, with a
//! radius of the distance to the nearest cell outside of the mesh, plus the overhang. The candidate that covers the most boxes is chosen repeatedly,
//! until all are covered (greedy set cover). So thick parts get large spheres, and all of the mesh is in a sphere by construction, its inside too if
//! it is closed. The overhang is a share of the mesh's length, and grows if it takes too many spheres.

use crate::spheres::Sphere;
use crate::surface::cut;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};

/// Maximum number of spheres of one mesh.
const MAX_SPHERES: usize = 96;

/// How far a sphere may stand out of the cells, as a share of the mesh's longest side, at first; and the growth factor if that needs too many spheres.
const OVERHANG: f64 = 0.025;
const MORE: f64 = 1.4;

/// Maximum number of blocks along the longest side, maximum number of blocks, and cells along the edge of a block.
const FINEST: usize = 32;
const MOST_BLOCKS: usize = 1_500;
const CELLS: usize = 3;

/// Maximum number of cells that are tested for triangles: a mesh of many triangles that are as large as itself gets a coarser grid.
const MOST_LOOKS: usize = 5_000_000;

/// Surfaces on the border of two cells belong to both, in cells.
const SKIN: f64 = 1e-6;

/// Spheres that contain the triangles.
pub(crate) fn cover(triangles: &[[[f64; 3]; 3]]) -> Vec<Sphere> {
    let mut blocks = FINEST;
    while blocks > 1 && looks(triangles, CELLS * blocks) > MOST_LOOKS {
        blocks = blocks * 4 / 5;
    }
    let (grid, boxes) = loop {
        let grid = Grid::new(triangles, CELLS * blocks);
        if grid.blocks() <= MOST_BLOCKS || blocks == 1 {
            let boxes = grid.boxes();
            break (grid, boxes);
        }
        blocks = blocks * 4 / 5;
    };
    let deep = grid.depths(&boxes);
    let longest = (0..3).map(|i| grid.cell[i] * grid.counts[i] as f64).fold(0.0, f64::max);
    let mut overhang = OVERHANG * longest;
    loop {
        let spheres = held(&boxes, &deep, overhang);
        if spheres.len() <= MAX_SPHERES || overhang > longest {
            return spheres;
        }
        overhang *= MORE;
    }
}

/// The number of cells in the bounding boxes of all triangles, in a grid with `longest` cells along the longest edge.
fn looks(triangles: &[[[f64; 3]; 3]], longest: usize) -> usize {
    let between = |corners: &mut dyn Iterator<Item = f64>| {
        let (least, greatest) = corners.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| (a.min(c), b.max(c)));
        greatest - least
    };
    let extent = (0..3).map(|i| between(&mut triangles.iter().flatten().map(|c| c[i]))).fold(1e-9, f64::max);
    let cell = extent / longest as f64;
    let of = |triangle: &[[f64; 3]; 3]| -> usize {
        (0..3).map(|i| (between(&mut triangle.iter().map(|c| c[i])) / cell) as usize + 1).product()
    };
    triangles.iter().map(of).sum()
}

/// A small set of spheres about the centres of boxes that covers all boxes; each is larger than the depth of its centre by the overhang.
fn held(boxes: &[Cuboid], deep: &[f64], overhang: f64) -> Vec<Sphere> {
    let sphere = |(cuboid, deep): (&Cuboid, &f64)| Sphere {
        centre: cuboid.centre,
        radius: (deep + overhang).max(cuboid.reach_from(cuboid.centre)) * (1.0 + SKIN),
    };
    let all: Vec<Sphere> = boxes.iter().zip(deep).map(sphere).collect();
    let holds = |sphere: usize, cuboid: usize| boxes[cuboid].reach_from(all[sphere].centre) <= all[sphere].radius;
    let mut open: Vec<usize> = (0..boxes.len()).collect();
    let count = |sphere: usize, open: &[usize]| open.iter().filter(|cuboid| holds(sphere, **cuboid)).count();
    // The number of remaining boxes in a sphere only decreases: the first sphere whose count is still true has the most. Of two, the earlier one.
    let mut counts: BinaryHeap<(usize, Reverse<usize>)> =
        (0..all.len()).map(|i| (count(i, &open), Reverse(i))).collect();
    let mut taken = Vec::new();
    while let Some((before, Reverse(i))) = counts.pop() {
        if open.is_empty() {
            break;
        }
        let now = count(i, &open);
        if now < before {
            counts.push((now, Reverse(i)));
            continue;
        }
        let centre = all[i].centre;
        let (own, left): (Vec<usize>, Vec<usize>) = open.into_iter().partition(|cuboid| holds(i, *cuboid));
        open = left;
        // No larger than necessary.
        let radius = own.iter().map(|cuboid| boxes[*cuboid].reach_from(centre)).fold(0.0, f64::max) * (1.0 + SKIN);
        taken.push(Sphere { centre, radius });
    }
    taken
}

/// An axis-aligned box.
struct Cuboid {
    centre: [f64; 3],
    half: [f64; 3],
}

impl Cuboid {
    /// Distance of its farthest corner from a point.
    fn reach_from(&self, point: [f64; 3]) -> f64 {
        (0..3).map(|i| ((point[i] - self.centre[i]).abs() + self.half[i]).powi(2)).sum::<f64>().sqrt()
    }
}

/// Cells over the bounding box of a mesh.
struct Grid {
    least: [f64; 3],
    cell: [f64; 3],
    counts: [usize; 3],
    taken: Vec<bool>,
}

impl Grid {
    /// A grid with `longest` cells along the longest edge.
    fn new(triangles: &[[[f64; 3]; 3]], longest: usize) -> Grid {
        let corners = || triangles.iter().flatten();
        let least: [f64; 3] = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::INFINITY, f64::min));
        let greatest: [f64; 3] = std::array::from_fn(|i| corners().map(|c| c[i]).fold(f64::NEG_INFINITY, f64::max));
        let extents: [f64; 3] = std::array::from_fn(|i| greatest[i] - least[i]);
        let wanted = extents.into_iter().fold(1e-9, f64::max) / longest as f64;
        let counts = extents.map(|extent| ((extent / wanted).ceil() as usize).clamp(1, longest));
        let cell = std::array::from_fn(|i| (extents[i] / counts[i] as f64).max(1e-9));
        let mut grid = Grid { least, cell, counts, taken: vec![false; counts.iter().product()] };
        for triangle in triangles {
            let polygon = triangle.iter().map(|c| std::array::from_fn(|i| (c[i] - least[i]) / cell[i])).collect();
            grid.take(polygon, 0, [0; 3]);
        }
        grid.fill();
        grid
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.counts[1] + y) * self.counts[2] + z
    }

    /// Marks the cells of a polygon, whose unit is cells, slab by slab along one axis after the other.
    fn take(&mut self, polygon: Vec<[f64; 3]>, axis: usize, at: [usize; 3]) {
        if polygon.is_empty() {
            return;
        }
        if axis == 3 {
            let index = self.index(at);
            self.taken[index] = true;
            return;
        }
        let least = polygon.iter().map(|c| c[axis]).fold(f64::INFINITY, f64::min);
        let greatest = polygon.iter().map(|c| c[axis]).fold(f64::NEG_INFINITY, f64::max);
        let last = self.counts[axis] - 1;
        let first = ((least - SKIN).floor().max(0.0) as usize).min(last);
        for slab in first..=((greatest + SKIN).floor().max(0.0) as usize).min(last) {
            let mut at = at;
            at[axis] = slab;
            let (low, high) = (slab as f64 - SKIN, (slab + 1) as f64 + SKIN);
            self.take(cut(&cut(&polygon, axis, low, 1.0), axis, high, -1.0), axis + 1, at);
        }
    }

    /// Marks the enclosed cells: all that cannot be reached from outside.
    fn fill(&mut self) {
        let mut outside = vec![false; self.taken.len()];
        // From the sides of the grid inwards, layer by layer, so that the queue stays short.
        let mut open: VecDeque<[usize; 3]> = VecDeque::new();
        let mut reach = |at: [usize; 3], open: &mut VecDeque<[usize; 3]>| {
            let index = self.index(at);
            if !self.taken[index] && !std::mem::replace(&mut outside[index], true) {
                open.push_back(at);
            }
        };
        for index in 0..self.taken.len() {
            let at = self.place(index);
            if (0..3).any(|i| at[i] == 0 || at[i] + 1 == self.counts[i]) {
                reach(at, &mut open);
            }
        }
        while let Some(at) = open.pop_front() {
            for axis in 0..3 {
                let mut beside = at;
                if at[axis] > 0 {
                    beside[axis] = at[axis] - 1;
                    reach(beside, &mut open);
                }
                if at[axis] + 1 < self.counts[axis] {
                    beside[axis] = at[axis] + 1;
                    reach(beside, &mut open);
                }
            }
        }
        self.taken = outside.into_iter().map(|outside| !outside).collect();
    }

    /// Number of blocks with mesh cells.
    fn blocks(&self) -> usize {
        let counts = self.counts.map(|count| count.div_ceil(CELLS));
        let mut is_its = vec![false; counts.iter().product()];
        for index in (0..self.taken.len()).filter(|index| self.taken[*index]) {
            let [x, y, z] = self.place(index).map(|c| c / CELLS);
            is_its[(x * counts[1] + y) * counts[2] + z] = true;
        }
        is_its.into_iter().filter(|is_its| *is_its).count()
    }

    /// For each block with mesh cells, the box around them.
    fn boxes(&self) -> Vec<Cuboid> {
        let mut bounds: BTreeMap<[usize; 3], [[usize; 3]; 2]> = BTreeMap::new();
        for at in (0..self.taken.len()).filter(|index| self.taken[*index]).map(|index| self.place(index)) {
            let [least, greatest] = bounds.entry(at.map(|c| c / CELLS)).or_insert([at, at]);
            for i in 0..3 {
                least[i] = least[i].min(at[i]);
                greatest[i] = greatest[i].max(at[i]);
            }
        }
        let cuboid = |[least, greatest]: [[usize; 3]; 2]| Cuboid {
            centre: std::array::from_fn(|i| self.least[i] + self.cell[i] * (least[i] + greatest[i] + 1) as f64 / 2.0),
            half: std::array::from_fn(|i| self.cell[i] * ((greatest[i] + 1 - least[i]) as f64 / 2.0 + SKIN)),
        };
        bounds.into_values().map(cuboid).collect()
    }

    /// Distance of each box's centre from the nearest cell outside of the mesh.
    fn depths(&self, boxes: &[Cuboid]) -> Vec<f64> {
        let is_beside = |index: &usize| {
            let at = self.place(*index);
            (0..3).any(|i| {
                let mut beside = at;
                let before = at[i] > 0 && {
                    beside[i] = at[i] - 1;
                    self.taken[self.index(beside)]
                };
                before
                    || at[i] + 1 < self.counts[i] && {
                        beside[i] = at[i] + 1;
                        self.taken[self.index(beside)]
                    }
            })
        };
        let free = (0..self.taken.len()).filter(|index| !self.taken[*index] && is_beside(index));
        let free: Vec<[f64; 3]> = free
            .map(|index| {
                let at = self.place(index);
                std::array::from_fn(|i| self.least[i] + (at[i] as f64 + 0.5) * self.cell[i])
            })
            .collect();
        let square = |centre: [f64; 3], cell: &[f64; 3]| -> f64 {
            (0..3).map(|i| ((centre[i] - cell[i]).abs() - self.cell[i] / 2.0).max(0.0).powi(2)).sum()
        };
        let depth = |cuboid: &Cuboid| {
            let centre = cuboid.centre;
            let around = (0..3).map(|i| {
                let beyond = centre[i] - self.least[i];
                beyond.min(self.cell[i] * self.counts[i] as f64 - beyond)
            });
            let near = free.iter().map(|cell| square(centre, cell)).fold(f64::INFINITY, f64::min).sqrt();
            around.fold(near, f64::min).max(0.0)
        };
        boxes.iter().map(depth).collect()
    }

    fn place(&self, index: usize) -> [usize; 3] {
        let [_, y, z] = self.counts;
        [index / (y * z), index / z % y, index % z]
    }
}
