//! The nearest of many configurations: a linear scan over blocks of sixteen, one array per joint. Trees have tens to thousands
//! of nodes here, where a scan beats every index.

use super::lanes::Block;

/// The index and the squared distance of the nearest of `count` points; node `i` is lane `i % 16` of the `dimensions` blocks
/// from `i / 16 * dimensions` on. Unused lanes hold infinity. The first of equals wins.
#[inline(always)]
pub(super) fn nearest(blocks: &[Block], dimensions: usize, count: usize, to: &[f32; 16]) -> (usize, f32) {
    let mut best = [f32::INFINITY; 16];
    let mut found = [0_u32; 16];
    for (row, chunk) in blocks.chunks_exact(dimensions).enumerate() {
        let mut sum = [0.0_f32; 16];
        for (block, goal) in chunk.iter().zip(to) {
            for (sum, value) in sum.iter_mut().zip(&block.0) {
                let difference = value - goal;
                *sum += difference * difference;
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
    nearest
}
