//! Nearest neighbour of a configuration: a linear scan over blocks of sixteen nodes, one array per joint. Trees have tens to thousands of nodes
//! here, for which a scan is faster than every index.
//!
//! Nodes are compared by half of their squared length minus their inner product with the goal: half of the squared distance without the term that
//! is the same for all nodes. That takes one instruction per joint and block.

use super::lanes::{Block, Lanes};

/// Number of sums that are computed side by side, because each instruction waits for the one before it in its sum, and a coordinate of the goal is
/// loaded once for all of them.
const CHAINS: usize = 4;

/// The index of the nearest node. Node `i` is lane `i % 16` of the `dimensions + 1` blocks from `i / 16 * (dimensions + 1)` on; the last of these
/// has half of the squared lengths, and infinity in unused lanes. Among equals the first wins.
#[inline(always)]
pub(super) fn nearest<V: Lanes>(blocks: &[Block], dimensions: usize, to: &[f32; 16]) -> usize {
    let parts = 16 / V::WIDTH;
    let rows = CHAINS / parts;
    let mut best = Best { sums: [V::splat(f32::INFINITY); CHAINS], rows: [V::splat(0.0); CHAINS] };
    let mut row = 0;
    let mut chunks = blocks.chunks_exact((dimensions + 1) * rows);
    for chunk in &mut chunks {
        best.look::<CHAINS>(chunk, dimensions, to, row);
        row += rows;
    }
    for chunk in chunks.remainder().chunks_exact(dimensions + 1) {
        if parts == 1 {
            best.look::<1>(chunk, dimensions, to, row);
        } else {
            best.look::<2>(chunk, dimensions, to, row);
        }
        row += 1;
    }
    best.first()
}

/// As [`nearest`], for sixteen goals at once, given as one block per joint. Here the nodes are stored one after the other in `states`; `blocks`
/// has only half of their squared lengths.
#[inline(always)]
pub(super) fn nearest_each<V: Lanes>(blocks: &[Block], states: &[[f32; 16]], to: &[Block], found: &mut [u32; 16]) {
    let size = to.len() + 1;
    for part in 0..16 / V::WIDTH {
        let (mut sums, mut indices) = (V::splat(f32::INFINITY), V::splat(0.0));
        for (row, nodes) in states.chunks(16).enumerate() {
            let halves = &blocks[row * size + size - 1].0;
            for (lane, (node, half)) in nodes.iter().zip(halves).enumerate() {
                let mut sum = V::splat(*half);
                for (goal, along) in to.iter().zip(node) {
                    sum = V::splat(-*along).mul_add(V::load_part(goal, part), sum);
                }
                indices = sum.choose_below(sums, V::splat((row * 16 + lane) as f32), indices);
                sums = sum.min(sums);
            }
        }
        let mut whole = Block([0.0; 16]);
        indices.store(&mut whole);
        for (to, index) in found[part * V::WIDTH..].iter_mut().zip(&whole.0[..V::WIDTH]) {
            *to = *index as u32;
        }
    }
}

/// Per lane of each chain, the minimum sum and its row, which is a whole number.
struct Best<V> {
    sums: [V; CHAINS],
    rows: [V; CHAINS],
}

impl<V: Lanes> Best<V> {
    /// Adds some chains of nodes, the first of them in row `row`.
    #[inline(always)]
    fn look<const COUNT: usize>(&mut self, chunk: &[Block], dimensions: usize, to: &[f32; 16], row: usize) {
        let parts = 16 / V::WIDTH;
        let size = dimensions + 1;
        let mut sums = [V::splat(0.0); COUNT];
        for (chain, sum) in sums.iter_mut().enumerate() {
            *sum = V::load_part(&chunk[chain / parts * size + dimensions], chain % parts);
        }
        for (dimension, goal) in to[..dimensions].iter().enumerate() {
            let minus = V::splat(-goal);
            for (chain, sum) in sums.iter_mut().enumerate() {
                let along = V::load_part(&chunk[chain / parts * size + dimension], chain % parts);
                *sum = along.mul_add(minus, *sum);
            }
        }
        for (chain, sum) in sums.into_iter().enumerate() {
            let here = V::splat((row + chain / parts) as f32);
            self.rows[chain] = sum.choose_below(self.sums[chain], here, self.rows[chain]);
            self.sums[chain] = sum.min(self.sums[chain]);
        }
    }

    /// The first node with the minimum sum.
    #[inline(always)]
    fn first(&self) -> usize {
        let parts = 16 / V::WIDTH;
        let mut least = self.sums[0];
        for sum in &self.sums[1..] {
            least = least.min(*sum);
        }
        let least = V::splat(-V::splat(0.0).sub(least).peak());
        let mut first = usize::MAX;
        for chain in 0..CHAINS {
            let mut lanes = V::ALL & !least.below(self.sums[chain]);
            let mut rows = Block([0.0; 16]);
            if lanes != 0 {
                self.rows[chain].store(&mut rows);
            }
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize & 15;
                lanes &= lanes - 1;
                first = first.min(rows.0[lane] as usize * 16 + chain % parts * V::WIDTH + lane);
            }
        }
        first
    }
}

#[cfg(test)]
mod tests {
    use super::super::Isa;
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_nearest_node_is_found_in_trees_of_all_sizes_and_the_first_of_equals() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for dimensions in [1, 6, 7, 8, 15, 16] {
            // Whole numbers, few for each joint: sums without rounding errors, and many equal ones.
            let mut posture = || -> [f32; 16] {
                std::array::from_fn(|j| if j < dimensions { random.random_range(-2..=2) as f32 } else { 0.0 })
            };
            let (mut blocks, mut nodes) = (Vec::new(), Vec::new());
            for count in 1..=200 {
                let node = posture();
                if (count - 1) % 16 == 0 {
                    blocks.extend(std::iter::repeat_n(Block([0.0; 16]), dimensions));
                    blocks.push(Block([f32::INFINITY; 16]));
                }
                let row = (count - 1) / 16 * (dimensions + 1);
                for j in 0..dimensions {
                    blocks[row + j].0[(count - 1) % 16] = node[j];
                }
                blocks[row + dimensions].0[(count - 1) % 16] = 0.5 * node.iter().map(|q| q * q).sum::<f32>();
                nodes.push(node);
                let to = posture();
                let square = |node: &[f32; 16]| (0..16).map(|j| (node[j] - to[j]).powi(2)).sum::<f32>();
                let least = nodes.iter().map(square).fold(f32::INFINITY, f32::min);
                let first = nodes.iter().position(|node| square(node) == least);
                for isa in Isa::available() {
                    assert_eq!(Some(isa.nearest(&blocks, dimensions, &to)), first, "{isa:?} {dimensions} {count}");
                    // All other goals are at the first node.
                    let goal = |lane, j| if lane == count % 16 { to[j] } else { nodes[0][j] };
                    let goals: Vec<Block> =
                        (0..dimensions).map(|j| Block(std::array::from_fn(|lane| goal(lane, j)))).collect();
                    let each = isa.nearest_each(&blocks, &nodes, &goals);
                    assert_eq!(Some(each[count % 16] as usize), first, "{isa:?} {dimensions} {count}");
                    assert_eq!(each[(count + 1) % 16], 0, "{isa:?} {dimensions} {count}");
                }
            }
        }
    }
}
