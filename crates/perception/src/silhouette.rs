//! The silhouette of a cluster: where one pixel sees the cluster and the next sees far past it.
//!
//! The search goes outwards along rows and columns from each pixel of the cluster: over flying pixels, among whose mixtures the edge lies,
//! to a pixel that sees the surface. Missing pixels beside a near object are surface in the projector's shadow, so the edge comes before
//! them. Where the cluster meets the surface there is no edge: only points high enough to hide something count.

/// What a pixel tells about the surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sight {
    /// No return.
    Missing,
    /// It sees the surface, or something behind and below it: nothing stands in the way.
    Free,
    /// A mixture of near and far.
    Flying,
    /// It sees something that stands on the surface, or hides it.
    Standing,
}

/// Position of an edge in the image, and its standard deviation, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crossing {
    pub(crate) column: f64,
    pub(crate) row: f64,
    pub(crate) sigma: f64,
}

/// Maximum number of pixels between an object and the surface behind it: the width of shadows.
const WIDEST: isize = 6;
/// Maximum number of flying pixels among them.
const MOST_FLYING: i32 = 4;
/// Standard deviation of an edge without flying pixels, in pixels: sensors locate it to about a pixel.
const EDGE: f64 = 0.7;

/// The edges beside a pixel of a cluster. `sights` are row by row.
pub(crate) fn beside(sights: &[Sight], width: usize, pixel: usize) -> impl Iterator<Item = Crossing> {
    let rows = (sights.len() / width) as isize;
    let (column, row) = ((pixel % width) as isize, (pixel / width) as isize);
    [(0, 1), (0, -1), (1, 0), (-1, 0)].into_iter().filter_map(move |(down, right)| {
        let (mut flying, mut lost) = (0, 0);
        for step in 1..=WIDEST {
            let (column_there, row_there) = (column + step * right, row + step * down);
            if !(0..width as isize).contains(&column_there) || !(0..rows).contains(&row_there) {
                return None;
            }
            match sights[row_there as usize * width + column_there as usize] {
                Sight::Standing => return None,
                Sight::Missing => lost += 1,
                Sight::Flying if lost == 0 => flying += 1,
                Sight::Flying => {}
                Sight::Free if flying > MOST_FLYING => return None,
                Sight::Free => {
                    let off = 0.5 + f64::from(flying) / 2.0;
                    return Some(Crossing {
                        column: column as f64 + off * right as f64,
                        row: row as f64 + off * down as f64,
                        sigma: EDGE.hypot(f64::from(flying + lost) / 12.0_f64.sqrt()),
                    });
                }
            }
        }
        None
    })
}

/// Radius around an edge from which its direction is estimated, in pixels.
const AROUND: f64 = 2.6;

/// The outward direction across an edge, in columns and rows. `None` where both sides have as much outside.
pub(crate) fn outwards(sights: &[Sight], width: usize, at: &Crossing) -> Option<[f64; 2]> {
    let rows = sights.len() / width;
    let (mut right, mut down) = (0.0, 0.0);
    let around = |at: f64, size: usize| (at - AROUND).ceil().max(0.0) as usize..((at + AROUND) as usize + 1).min(size);
    for row in around(at.row, rows) {
        for column in around(at.column, width) {
            let off = [column as f64 - at.column, row as f64 - at.row];
            if sights[row * width + column] == Sight::Standing && off[0].hypot(off[1]) < AROUND {
                right -= off[0];
                down -= off[1];
            }
        }
    }
    let long = right.hypot(down);
    (long > 1.0).then(|| [right / long, down / long])
}
