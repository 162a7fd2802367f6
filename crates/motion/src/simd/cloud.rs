//! A point cloud prepared for the query whether spheres touch any of its balls, for as many spheres at once as there are lanes.
//!
//! A grid covers the cloud. Each cell stores the distance of its centre from the nearest point, and a list of the points that are the nearest to
//! some place in the cell. (A place is nearer to q than to p if it is on q's side of the bisecting plane; p is dropped if the whole cell is on q's
//! side.) The lists are made by bisection: a part of the grid passes on to its halves only the points that it has not dropped. So the answer from
//! the list of the cell that a centre is in is exact, for any radius; for most spheres the distances of the cell centres already rule out a
//! contact. Places outside the grid are further from the points than any sphere for which there are lists reaches; a larger sphere there counts as
//! touching unless the distances rule it out.
//!
//! The balls may cover the surface of a solid. A cell that is wholly solid is marked instead of having a list; other cells are divided into small
//! cells, each known to be inside or outside, which decides for a sphere that touches no ball.
//!
//! Nearest neighbours by cells with the sites of their Voronoi diagrams are old (Clarkson, SIAM J. Comput. 1988). Looking up a robot's spheres in
//! a structure laid out for vectors is from Ramsey, Kingston, Thomason, Kavraki: *Collision-Affording Point Trees* (RSS 2024), whose lists have
//! the points within a maximum radius instead.

use super::lanes::{Block, Isa, Lanes};

/// Approximate maximum number of cells of a grid, and number of cells per point.
const MOST_CELLS: f32 = 60_000.0;
const CELLS_PER_POINT: f32 = 10.0;

/// Approximate number of cells of the smallest grid.
const LEAST_CELLS: f32 = 5_000.0;

/// Minimum side of a cell, in metres.
const LEAST_CELL_M: f32 = 0.004;

/// Cells too far away for lists are handled in groups, whose size is at most this fraction of their distance.
const COARSENESS: f32 = 0.3;

/// Added to a whole number below 2^23, this constant leaves the number in the lowest bits.
const TO_BITS: f32 = 8_388_608.0;

/// Adding and subtracting this constant rounds to whole numbers.
const ROUND: f32 = 12_582_912.0;

/// The list of a cell in which every centre touches.
const SOLID: [u32; 2] = [u32::MAX; 2];

/// The start of a cell that has no small cells.
const NOT_FILLED: u32 = u32::MAX;

/// Sixteen points; unused ones are infinitely far away.
type Points = [Block; 3];

/// The mask of a whole block.
const WHOLE: u32 = 0xffff;

const FAR: Points = [Block([f32::INFINITY; 16]); 3];

/// A cloud as the kernel reads it.
#[derive(Debug, Clone)]
pub(crate) struct Cloud {
    /// Radius of the balls.
    pub(crate) radius: f32,
    /// The bounding box of all balls: its minimum, and its maximum with the sign changed.
    least: [f32; 3],
    minus_greatest: [f32; 3],
    layout: Layout,
    /// Per cell, a lower bound of the distance of its centre from the nearest point.
    near: Vec<f32>,
    /// Per cell, the range of its points in `points`; empty if no sphere is large enough to touch.
    lists: Vec<[u32; 2]>,
    points: Vec<Points>,
    /// The check is exact for spheres whose radius plus that of the balls is at most this.
    reach: f32,
    filling: Option<Filling>,
}

/// Cells that are partly solid: each is divided into small cells that are solid or not.
#[derive(Debug, Clone)]
pub(crate) struct Filling {
    /// Number of small cells along a side of a cell.
    pub(crate) per_side: usize,
    /// Per cell, the index of its first word in `bits`; each cell has whole words.
    starts: Vec<u32>,
    bits: Vec<u64>,
}

impl Filling {
    /// A filling in which nothing is solid.
    pub(crate) fn new(layout: &Layout, per_side: usize) -> Filling {
        Filling { per_side, starts: vec![NOT_FILLED; layout.cells()], bits: Vec::new() }
    }

    /// Makes the small cells of a column solid, in a range along z.
    pub(crate) fn fill(&mut self, cell: usize, [x, y]: [usize; 2], z: std::ops::RangeInclusive<usize>) {
        if self.starts[cell] == NOT_FILLED {
            self.starts[cell] = self.bits.len() as u32;
            self.bits.resize(self.bits.len() + self.per_side.pow(3).div_ceil(64), 0);
        }
        let first = self.starts[cell] as usize * 64 + (x * self.per_side + y) * self.per_side;
        for bit in z.map(|z| first + z) {
            self.bits[bit / 64] |= 1 << (bit % 64);
        }
    }

    /// Whether the small cell of a centre is solid; `None` for a cell without small cells.
    #[inline]
    fn is_solid(&self, layout: &Layout, cell: usize, centre: [f32; 3]) -> Option<bool> {
        let start = self.starts[cell];
        if start == NOT_FILLED {
            return None;
        }
        let at = layout.slots(cell);
        let [x, y, z]: [usize; 3] = std::array::from_fn(|i| {
            let along = (centre[i] - layout.least[i]) / layout.cell - at[i] as f32;
            ((along * self.per_side as f32).max(0.0) as usize).min(self.per_side - 1)
        });
        let bit = start as usize * 64 + (x * self.per_side + y) * self.per_side + z;
        Some(self.bits[bit / 64] >> (bit % 64) & 1 == 1)
    }
}

/// The grid of cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Layout {
    pub(crate) least: [f32; 3],
    pub(crate) greatest: [f32; 3],
    pub(crate) cell: f32,
    pub(crate) counts: [usize; 3],
}

impl Layout {
    /// A grid over the bounding box of `points` points, with a `margin` around it and cells of at least `least_cell`.
    pub(crate) fn over(points: usize, least: [f32; 3], greatest: [f32; 3], margin: f32, least_cell: f32) -> Layout {
        let most = (points as f32 * CELLS_PER_POINT).clamp(LEAST_CELLS, MOST_CELLS);
        let extents: [f32; 3] = std::array::from_fn(|i| greatest[i] - least[i] + 2.0 * margin);
        let volume = extents.iter().map(|e| e.max(LEAST_CELL_M)).product::<f32>();
        let mut cell = (volume / most).cbrt().max(LEAST_CELL_M).max(least_cell);
        loop {
            let counts = extents.map(|e| (e / cell).ceil().max(1.0) as usize);
            if counts.iter().product::<usize>() as f32 <= 2.0 * most {
                let least: [f32; 3] = std::array::from_fn(|i| least[i] - margin);
                let greatest = std::array::from_fn(|i| least[i] + counts[i] as f32 * cell);
                return Layout { least, greatest, cell, counts };
            }
            cell *= 1.1;
        }
    }

    /// The index of a cell.
    pub(crate) fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.counts[1] + y) * self.counts[2] + z
    }

    /// The position of a cell in the grid, by its index.
    pub(crate) fn slots(&self, index: usize) -> [usize; 3] {
        let [_, y, z] = self.counts;
        [index / (y * z), index / z % y, index % z]
    }

    /// The position of a coordinate along an axis; outside the grid that of its nearest cell.
    pub(crate) fn slot(&self, axis: usize, at: f32) -> usize {
        (((at - self.least[axis]) / self.cell).max(0.0) as usize).min(self.counts[axis] - 1)
    }

    /// The centre of a cell, by its index.
    pub(crate) fn centre(&self, index: usize) -> [f32; 3] {
        let at = self.slots(index);
        std::array::from_fn(|i| self.least[i] + (at[i] as f32 + 0.5) * self.cell)
    }

    /// Number of cells.
    pub(crate) fn cells(&self) -> usize {
        self.counts.iter().product()
    }
}

impl Cloud {
    /// A cloud of balls. The check is exact for spheres whose radius plus that of the balls is at most `reach`; for larger ones it may report a
    /// contact that is none. The layout's margin must be at least `reach`.
    pub(crate) fn new(points: &[[f32; 3]], radius: f32, layout: Layout, reach: f32, isa: Isa) -> Cloud {
        let cells = layout.cells();
        let (near, lists) = (vec![f32::INFINITY; cells], vec![[0; 2]; cells]);
        let side = |i: usize, sign: f32| points.iter().map(|p| p[i] * sign).fold(f32::INFINITY, f32::min) - radius;
        let (least, minus_greatest) = (std::array::from_fn(|i| side(i, 1.0)), std::array::from_fn(|i| side(i, -1.0)));
        let (listed, filling) = (Vec::new(), None);
        let mut cloud = Cloud { radius, least, minus_greatest, layout, near, lists, points: listed, reach, filling };
        let mut blocks: Vec<Points> = Vec::with_capacity(points.len().div_ceil(16));
        for sixteen in points.chunks(16) {
            let mut block = FAR;
            for (lane, point) in sixteen.iter().enumerate() {
                for axis in 0..3 {
                    block[axis].0[lane] = point[axis];
                }
            }
            blocks.push(block);
        }
        if !points.is_empty() {
            isa.fill_cloud(&mut cloud, &blocks, reach);
        }
        cloud
    }

    /// Makes every centre in a cell touch.
    pub(crate) fn solidify(&mut self, cell: usize) {
        self.near[cell] = f32::NEG_INFINITY;
        self.lists[cell] = SOLID;
        self.hold(cell);
    }

    /// Makes centres in solid small cells touch. A sphere that touches no ball is wholly on one side of the surface.
    pub(crate) fn fill_with(&mut self, filling: Filling) {
        for cell in (0..filling.starts.len()).filter(|cell| filling.starts[*cell] != NOT_FILLED) {
            self.near[cell] = f32::NEG_INFINITY;
            self.hold(cell);
        }
        self.filling = Some(filling);
    }

    /// Extends the bounding box of all balls by a cell.
    fn hold(&mut self, cell: usize) {
        let (centre, half) = (self.layout.centre(cell), self.layout.cell * 0.501);
        self.least = std::array::from_fn(|i| self.least[i].min(centre[i] - half));
        self.minus_greatest = std::array::from_fn(|i| self.minus_greatest[i].min(-centre[i] - half));
    }

    /// Whether one sphere touches a ball.
    pub(crate) fn touches_sphere(&self, centre: [f32; 3], radius: f32) -> bool {
        self.touching::<[f32; 8]>(centre.map(|c| [c; 8]), radius + self.radius, 1, true) != 0
    }

    /// Whether a ball is within about a distance of a place, in metres.
    pub(crate) fn is_within(&self, place: [f64; 3], reach: f64) -> bool {
        let beside = |i: usize| {
            let (least, greatest) = (f64::from(self.least[i]), -f64::from(self.minus_greatest[i]));
            (least - place[i]).max(place[i] - greatest).max(0.0).powi(2)
        };
        (0..3).map(beside).sum::<f64>() <= reach * reach
    }

    /// Whether spheres that are all in this box (the minimum with its sign changed) are outside the bounding box of all balls.
    #[inline(always)]
    pub(super) fn is_beside(&self, bounds: &[f32; 6]) -> bool {
        (0..3).any(|i| bounds[i] < self.least[i] || bounds[3 + i] < self.minus_greatest[i])
    }

    /// The lanes whose spheres may touch something; for all others it is certain that they do not.
    #[inline(always)]
    pub(super) fn may_touch<V: Lanes>(&self, centre: [V; 3], radius: f32, lanes: u32, cells: &mut Block) -> u32 {
        let layout = &self.layout;
        let inverse = 1.0 / layout.cell;
        let mut index = V::splat(0.0);
        let (mut off, mut out) = (V::splat(0.0), V::splat(0.0));
        let mut inside = centre;
        for i in 0..3 {
            // The nearest place in the grid: it is nearer to all points than a centre outside.
            let (least, greatest) = (V::splat(layout.least[i]), V::splat(layout.greatest[i]));
            inside[i] = inside[i].max(least).min(greatest);
            let beyond = centre[i].sub(inside[i]);
            let along = inside[i].sub(least).mul_add(V::splat(inverse), V::splat(-0.5));
            let last = V::splat((layout.counts[i] - 1) as f32);
            let slot = along.add(V::splat(ROUND)).sub(V::splat(ROUND)).max(V::splat(0.0)).min(last);
            let beside = along.sub(slot).mul(V::splat(layout.cell));
            off = beside.mul_add(beside, off);
            out = beyond.mul_add(beyond, out);
            index = index.mul_add(V::splat(layout.counts[i] as f32), slot);
        }
        index.add(V::splat(TO_BITS)).store(cells);
        let mut near = Block([f32::INFINITY; 16]);
        let mut left = lanes;
        while left != 0 {
            let lane = left.trailing_zeros() as usize & 15;
            left &= left - 1;
            near.0[lane] = self.near[slot_of(cells.0[lane])];
        }
        let gap = V::load(&near).sub(off.sqrt()).max(V::splat(0.0));
        lanes & gap.mul_add(gap, out).below(V::splat(radius * radius))
    }

    /// The lanes, among `lanes`, whose spheres touch a ball; one of them is enough unless `all` is set.
    #[inline(always)]
    pub(super) fn touching<V: Lanes>(&self, centre: [V; 3], radius: f32, lanes: u32, all: bool) -> u32 {
        let mut cells = Block([0.0; 16]);
        let mut doubtful = self.may_touch(centre, radius, lanes, &mut cells);
        if doubtful == 0 {
            return 0;
        }
        let mut at = FAR;
        for i in 0..3 {
            centre[i].store(&mut at[i]);
        }
        let mut found = 0;
        while doubtful != 0 {
            let lane = doubtful.trailing_zeros() as usize & 15;
            doubtful &= doubtful - 1;
            let cell = slot_of(cells.0[lane]);
            if self.touches::<V>([at[0].0[lane], at[1].0[lane], at[2].0[lane]], radius, cell) {
                found |= 1 << lane;
                if !all {
                    return found;
                }
            }
        }
        found
    }

    #[inline(always)]
    fn touches<V: Lanes>(&self, centre: [f32; 3], radius: f32, cell: usize) -> bool {
        let [first, end] = self.lists[cell];
        let is_filled = || self.filling.as_ref().and_then(|filling| filling.is_solid(&self.layout, cell, centre));
        if radius > self.reach && (first == end || self.is_off_the_grid(&centre)) {
            // The sphere is larger than `reach`: lists cover only centres in the grid, and only places up to a distance from all points.
            return true;
        }
        if first == end {
            // The cell is solid, wholly or in part.
            return is_filled().unwrap_or(true);
        }
        let reach = V::splat(radius * radius);
        for points in &self.points[first as usize..end as usize] {
            for part in 0..16 / V::WIDTH {
                if squares::<V>(points, &centre, part).below(reach) != 0 {
                    return true;
                }
            }
        }
        is_filled().unwrap_or(false)
    }

    fn is_off_the_grid(&self, centre: &[f32; 3]) -> bool {
        (0..3).any(|i| centre[i] < self.layout.least[i] || centre[i] > self.layout.greatest[i])
    }
}

/// The cell index that was added to `TO_BITS`.
#[inline(always)]
fn slot_of(number: f32) -> usize {
    (number.to_bits() & 0x7f_ffff) as usize
}

/// Squared distances of points from a place; `part` selects which of the sixteen points if there are fewer lanes.
#[inline(always)]
fn squares<V: Lanes>(points: &Points, from: &[f32; 3], part: usize) -> V {
    let mut sum = V::splat(0.0);
    for i in 0..3 {
        let along = V::load_part(&points[i], part).sub(V::splat(from[i]));
        sum = along.mul_add(along, sum);
    }
    sum
}

/// A part of a grid: a range of cells along each axis.
#[derive(Clone, Copy)]
struct Cells {
    from: [usize; 3],
    to: [usize; 3],
}

/// Computes the cells of a cloud.
#[inline(always)]
pub(super) fn fill<V: Lanes>(cloud: &mut Cloud, points: &[Points], reach: f32) {
    let whole = Cells { from: [0; 3], to: cloud.layout.counts };
    // One list per depth, used again and again.
    let mut rooms: Vec<Vec<Points>> = vec![Vec::new(); 3 * usize::BITS as usize];
    let mut todo: Vec<(Cells, usize)> = vec![(whole, 0)];
    rooms[0] = points.to_vec();
    while let Some((part, depth)) = todo.pop() {
        // Depth first: the list of a depth is that of the part that was bisected last.
        let (above, below) = rooms.split_at_mut(depth + 1);
        let (parent, room) = (&above[depth], &mut below[0]);
        let layout = cloud.layout;
        let half: [f32; 3] = std::array::from_fn(|i| (part.to[i] - part.from[i]) as f32 * layout.cell * 0.5);
        let middle: [f32; 3] = std::array::from_fn(|i| layout.least[i] + part.from[i] as f32 * layout.cell + half[i]);
        let (nearest, distance) = nearest::<V>(parent, &middle);
        let diagonal = (half[0] * half[0] + half[1] * half[1] + half[2] * half[2]).sqrt();
        let is_cell = (0..3).all(|i| part.to[i] - part.from[i] == 1);
        let is_far = distance - diagonal > reach;
        if is_far && (is_cell || 2.0 * diagonal < COARSENESS * (distance - diagonal)) {
            fill_far(cloud, part, &middle, distance);
            continue;
        }
        room.clear();
        keep::<V>(parent, &middle, &nearest, half.map(|h| 2.0 * h), room);
        thin::<V>(room, &middle, half.map(|h| 2.0 * h));
        if is_cell {
            let index = layout.index(part.from);
            let first = cloud.points.len() as u32;
            cloud.points.extend_from_slice(room);
            cloud.near[index] = distance;
            cloud.lists[index] = [first, cloud.points.len() as u32];
            continue;
        }
        let cuts: [usize; 3] = std::array::from_fn(|i| (part.from[i] + part.to[i]).div_ceil(2));
        for corner in 0..8 {
            let upper: [bool; 3] = std::array::from_fn(|i| corner >> i & 1 == 1);
            let from = std::array::from_fn(|i| if upper[i] { cuts[i] } else { part.from[i] });
            let to = std::array::from_fn(|i| if upper[i] { part.to[i] } else { cuts[i] });
            if (0..3).all(|i| from[i] < to[i]) {
                todo.push((Cells { from, to }, depth + 1));
            }
        }
    }
}

/// A lower bound of the distance is enough for cells that no sphere with lists reaches.
fn fill_far(cloud: &mut Cloud, part: Cells, middle: &[f32; 3], distance: f32) {
    let layout = cloud.layout;
    let along = |i: usize, slot: usize| layout.least[i] + (slot as f32 + 0.5) * layout.cell - middle[i];
    for x in part.from[0]..part.to[0] {
        for y in part.from[1]..part.to[1] {
            let flat = along(0, x).powi(2) + along(1, y).powi(2);
            let first = layout.index([x, y, 0]);
            for z in part.from[2]..part.to[2] {
                cloud.near[first + z] = distance - (flat + along(2, z).powi(2)).sqrt();
            }
        }
    }
}

/// The nearest point to a place, and its distance.
#[inline(always)]
fn nearest<V: Lanes>(points: &[Points], to: &[f32; 3]) -> ([f32; 3], f32) {
    let mut least = V::splat(f32::INFINITY);
    for block in points {
        for part in 0..16 / V::WIDTH {
            least = least.min(squares(block, to, part));
        }
    }
    let best = -V::splat(0.0).sub(least).peak();
    let mut at = [f32::INFINITY; 3];
    for block in points {
        for part in 0..16 / V::WIDTH {
            let others = V::splat(best).below(squares(block, to, part));
            if others != V::ALL {
                let lane = part * V::WIDTH + (!others).trailing_zeros() as usize;
                at = std::array::from_fn(|i| block[i].0[lane & 15]);
                return (at, best.sqrt());
            }
        }
    }
    (at, best.sqrt())
}

/// The mask of the points of a block that may be nearer than `nearest` to some place in a box.
#[inline(always)]
fn stays<V: Lanes>(block: &Points, middle: &[f32; 3], nearest: &[f32; 3], size: [f32; 3], best: f32) -> u32 {
    let mut stays = 0;
    for part in 0..16 / V::WIDTH {
        let mut room = V::splat(best);
        for i in 0..3 {
            let aside = V::load_part(&block[i], part).sub(V::splat(nearest[i])).abs();
            room = aside.mul_add(V::splat(size[i]), room);
        }
        // Infinitely far points are not below; rounding up keeps the nearest point itself.
        let room = room.mul(V::splat(1.0 + 1e-6)).add(V::splat(1e-9));
        stays |= squares::<V>(block, middle, part).below(room) << (part * V::WIDTH);
    }
    stays
}

/// The squared distance of two places.
fn square(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum()
}

/// Appends the points that may be nearer than `nearest` to some place in a box, in whole blocks.
#[inline(always)]
fn keep<V: Lanes>(points: &[Points], middle: &[f32; 3], nearest: &[f32; 3], size: [f32; 3], kept: &mut Vec<Points>) {
    let best = square(nearest, middle);
    let mut open = FAR;
    let mut filled = 0;
    for block in points {
        let mut stays = stays::<V>(block, middle, nearest, size, best);
        if stays == WHOLE && filled == 0 {
            kept.push(*block);
            continue;
        }
        while stays != 0 {
            let lane = stays.trailing_zeros() as usize & 15;
            stays &= stays - 1;
            for i in 0..3 {
                open[i].0[filled] = block[i].0[lane];
            }
            filled += 1;
            if filled == 16 {
                kept.push(open);
                open = FAR;
                filled = 0;
            }
        }
    }
    if filled > 0 {
        kept.push(open);
    }
}

/// Keeps only the points that may be nearer than `nearest` to some place in a box. Points that stay in their place, most in the end, are not
/// copied.
#[inline(always)]
fn retain<V: Lanes>(points: &mut Vec<Points>, middle: &[f32; 3], nearest: &[f32; 3], size: [f32; 3]) {
    let best = square(nearest, middle);
    let mut filled = 0;
    for number in 0..points.len() {
        let mut stays = stays::<V>(&points[number], middle, nearest, size, best);
        if stays == WHOLE && filled == number * 16 {
            filled += 16;
            continue;
        }
        let block = points[number];
        while stays != 0 {
            let lane = stays.trailing_zeros() as usize & 15;
            stays &= stays - 1;
            for i in 0..3 {
                points[filled / 16][i].0[filled % 16] = block[i].0[lane];
            }
            filled += 1;
        }
    }
    points.truncate(filled.div_ceil(16));
    if let Some(last) = points.last_mut().filter(|_| filled % 16 > 0) {
        last.iter_mut().for_each(|along| along.0[filled % 16..].fill(f32::INFINITY));
    }
}

/// Drops the points that are nowhere in a box nearer than the points nearest to its corners.
#[inline(always)]
fn thin<V: Lanes>(points: &mut Vec<Points>, middle: &[f32; 3], size: [f32; 3]) {
    // In this order opposite corners follow each other.
    for corner in [0, 7, 1, 6, 2, 5, 3, 4] {
        if points.len() <= 1 {
            return;
        }
        let at = std::array::from_fn(|i| middle[i] + size[i] * if corner >> i & 1 == 1 { 0.5 } else { -0.5 });
        let (nearest, _) = nearest::<V>(points, &at);
        retain::<V>(points, middle, &nearest, size);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_sphere_of_any_size_anywhere_is_never_missed_and_judged_exactly_where_it_was_announced() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (radius, reach) = (0.005, 0.05);
        let mut exact = 0;
        for _ in 0..30 {
            let mut place = |half: f32| -> [f32; 3] { std::array::from_fn(|_| random.random_range(-half..half)) };
            let points: Vec<[f32; 3]> = (0..40).map(|_| place(0.5)).collect();
            let layout = Layout::over(points.len(), [-0.5; 3], [0.5; 3], reach, 0.0);
            let cloud = Cloud::new(&points, radius, layout, reach, Isa::detect());
            for case in 0..400 {
                let centre = place(if case % 2 == 0 { 0.6 } else { 1.5 });
                let away = |p: &[f32; 3]| (0..3).map(|i| (p[i] - centre[i]).powi(2)).sum::<f32>().sqrt();
                let nearest = points.iter().map(away).fold(f32::INFINITY, f32::min);
                assert!(cloud.touches_sphere(centre, nearest - radius + 1e-4), "{nearest} from {centre:?} is missed");
                if nearest - 1e-4 <= reach {
                    exact += 1;
                    assert!(!cloud.touches_sphere(centre, nearest - radius - 1e-4), "{nearest} from {centre:?}");
                }
            }
        }
        assert!(exact > 50, "{exact}");
    }

    #[test]
    fn what_is_filled_is_solid_small_cell_by_small_cell_and_free_beside_it() {
        let layout = Layout::over(1, [0.0; 3], [1.0; 3], 0.1, 0.0);
        let mut filling = Filling::new(&layout, 5);
        let cell = layout.index([3, 4, 5]);
        filling.fill(cell, [1, 2], 2..=3);
        let mut cloud = Cloud::new(&[], 0.005, layout, 0.1, Isa::detect());
        cloud.fill_with(filling);
        let corner = layout.centre(cell).map(|c| c - layout.cell / 2.0);
        for small in 0..125 {
            let [x, y, z] = [small / 25, small / 5 % 5, small % 5];
            let at = [x, y, z].map(|s| (s as f32 + 0.5) / 5.0 * layout.cell);
            let touches = cloud.touches_sphere(std::array::from_fn(|i| corner[i] + at[i]), 0.001);
            assert_eq!(touches, x == 1 && y == 2 && (2..=3).contains(&z), "{x} {y} {z}");
        }
    }
}
