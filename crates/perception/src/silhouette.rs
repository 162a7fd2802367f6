//! The silhouette of a cluster: where a pixel sees it and one beside that sees far past it.
//!
//! Along rows and columns, from each pixel of the cluster outwards: over pixels that fly, whose mixtures say that the edge is among them,
//! to one that sees the surface. What a camera with a projector loses beside something near is surface in its shadow, so an edge is before
//! what is missing. Where the cluster meets the surface there is no edge: only what is high enough to hide something counts.

/// What a pixel says of the surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sight {
    /// Nothing came back.
    Missing,
    /// The surface, or what is behind and below it: nothing stands in the way.
    Free,
    /// A mixture of near and far.
    Flying,
    /// Something that stands on the surface, or hides it.
    Standing,
}

/// Where an edge is in the image, in pixels, and within how many.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crossing {
    pub(crate) column: f64,
    pub(crate) row: f64,
    pub(crate) sigma: f64,
}

/// Not more pixels than this are between something and the surface behind it: shadows are as wide.
const WIDEST: isize = 6;
/// Not more of them fly.
const MOST_FLYING: i32 = 4;
/// Within how many pixels an edge is seen where none flies: sensors find it to about a pixel.
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

/// How far around an edge its direction is told from, in pixels.
const AROUND: f64 = 2.6;

/// The direction across an edge, outwards: along columns and rows. `None` where as much is outside on either side.
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
