//! The nearest of many configurations: a linear scan over blocks of sixteen, one array per joint. Trees have tens to thousands
//! of nodes here, where a scan beats every index.
//!
//! What is compared is half of the squared length of a node less its inner product with the goal: half of the squared distance, but for what is the
//! same for all nodes. That is one instruction per joint and block.

use super::lanes::Block;

/// The index of the nearest of `count` points; node `i` is lane `i % 16` of the `dimensions + 1` blocks from `i / 16 * (dimensions + 1)` on, of
/// which the last has half of the squared lengths. Unused lanes hold infinity there. The first of equals wins. `FUSED` where the
/// processor multiplies and adds at once.
#[inline(always)]
pub(super) fn nearest<const FUSED: bool>(blocks: &[Block], dimensions: usize, count: usize, to: &[f32; 16]) -> usize {
    let mut best = [f32::INFINITY; 16];
    let mut found = [0_u32; 16];
    for (row, chunk) in blocks.chunks_exact(dimensions + 1).enumerate() {
        let mut sum = chunk[dimensions].0;
        for (block, goal) in chunk[..dimensions].iter().zip(to) {
            for (sum, value) in sum.iter_mut().zip(&block.0) {
                *sum = if FUSED { value.mul_add(-goal, *sum) } else { *sum - value * goal };
            }
        }
        for lane in 0..16 {
            let nearer = sum[lane] < best[lane];
            best[lane] = if nearer { sum[lane] } else { best[lane] };
            found[lane] = if nearer { row as u32 } else { found[lane] };
        }
    }
    let mut nearest = (0, f32::INFINITY);
    for lane in 0..16 {
        let index = found[lane] as usize * 16 + lane;
        if index < count && (best[lane], index) < (nearest.1, nearest.0) {
            nearest = (index, best[lane]);
        }
    }
    nearest.0
}
