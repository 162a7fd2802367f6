//! Covers the surface of a mesh with balls of one radius: every point of it is in one of them, and their centres are on the surface, so they stand
//! out by at most their radius.
//!
//! Each triangle is divided by a square grid in its plane. The piece in a square gets a ball about the centre of its bounding rectangle along the
//! grid: a convex piece that touches all four sides of the rectangle contains that centre. If only a part of space matters, the outside parts of
//! triangles are cut off first, so that no ball is wasted on them.

use crate::mesh::Mesh;
use crate::vector::Vector;

/// Approximate maximum number of balls on one mesh, in addition to one per triangle: a mesh that needs more gets larger balls.
pub const MOST_SAMPLES: usize = 300_000;

/// Factor between one tested radius and the next.
const LARGER: f64 = 1.1;

/// An axis-aligned box: minimum and maximum coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) least: [f64; 3],
    pub(crate) greatest: [f64; 3],
}

impl Bounds {
    /// All of space.
    pub(crate) const EVERYWHERE: Bounds = Bounds { least: [f64::NEG_INFINITY; 3], greatest: [f64::INFINITY; 3] };

    /// The bounding box of points; empty without points.
    pub(crate) fn about(points: impl Iterator<Item = [f64; 3]>) -> Bounds {
        let nothing = Bounds { least: [f64::INFINITY; 3], greatest: [f64::NEG_INFINITY; 3] };
        points.fold(nothing, |around, p| Bounds {
            least: std::array::from_fn(|i| around.least[i].min(p[i])),
            greatest: std::array::from_fn(|i| around.greatest[i].max(p[i])),
        })
    }

    /// The intersection; `None` if it is empty.
    pub(crate) fn and(&self, other: &Bounds) -> Option<Bounds> {
        let both = Bounds {
            least: std::array::from_fn(|i| self.least[i].max(other.least[i])),
            greatest: std::array::from_fn(|i| self.greatest[i].min(other.greatest[i])),
        };
        (0..3).all(|i| both.least[i] <= both.greatest[i]).then_some(both)
    }

    /// The box grown on every side.
    pub(crate) fn grown(&self, by: f64) -> Bounds {
        Bounds { least: self.least.map(|c| c - by), greatest: self.greatest.map(|c| c + by) }
    }

    /// The part of a triangle inside of the box, a convex piece; empty if fewer than three corners are left.
    fn cut(&self, triangle: &[[f64; 3]; 3]) -> Vec<[f64; 3]> {
        let around = Bounds::about(triangle.iter().copied());
        let mut piece = triangle.to_vec();
        for axis in 0..3 {
            if around.least[axis] < self.least[axis] {
                piece = cut(&piece, axis, self.least[axis], 1.0);
            }
            if around.greatest[axis] > self.greatest[axis] {
                piece = cut(&piece, axis, self.greatest[axis], -1.0);
            }
        }
        piece
    }
}

/// The radius of the balls for this mesh and a wanted radius, in metres.
pub fn radius(mesh: &Mesh, wanted: f64) -> f64 {
    balls(mesh.triangles(), &Bounds::EVERYWHERE, wanted, MOST_SAMPLES).0
}

/// The radius of the balls for the parts of triangles within bounds, with at most `most` balls in addition to one each, and the approximate number of balls.
pub(crate) fn balls(triangles: &[[[f64; 3]; 3]], within: &Bounds, wanted: f64, most: usize) -> (f64, usize) {
    // The area and the longest extent of each piece.
    let sizes: Vec<[f64; 2]> =
        triangles.iter().filter_map(|t| Piece::new(t, within)).map(|piece| piece.size()).collect();
    let more = |radius: f64| {
        let side = side(radius);
        let beside_first =
            |[area, long]: &[f64; 2]| if *long <= side { 0.0 } else { area / (side * side) + long / side };
        sizes.iter().map(beside_first).sum::<f64>()
    };
    // The radii are always from the same series, so that a part of a mesh has no larger balls than the whole.
    let mut radius = wanted;
    while more(radius) > most as f64 {
        radius *= LARGER;
    }
    (radius, sizes.len() + more(radius) as usize)
}

/// The centres of the balls that cover the parts of triangles within bounds.
pub(crate) fn centres(triangles: &[[[f64; 3]; 3]], within: &Bounds, radius: f64) -> Vec<[f64; 3]> {
    let mut centres = Vec::new();
    for triangle in triangles {
        if let Some(piece) = Piece::new(triangle, within) {
            piece.cover(side(radius), &mut centres);
        }
    }
    centres
}

/// The side of a square that a ball covers, slightly reduced for rounding.
fn side(radius: f64) -> f64 {
    radius * 2_f64.sqrt() * (1.0 - 1e-6)
}

/// The part of a triangle within bounds, in a frame of its plane with x along the triangle's longest side.
struct Piece {
    from: Vector,
    x: Vector,
    y: Vector,
    flat: Vec<[f64; 2]>,
}

impl Piece {
    fn new(triangle: &[[f64; 3]; 3], within: &Bounds) -> Option<Piece> {
        Bounds::about(triangle.iter().copied()).and(within)?;
        let [a, b, c] = triangle.map(Vector::from);
        let long = |(from, to): &(Vector, Vector)| from.distance(*to);
        let (from, to) = [(a, b), (b, c), (c, a)].into_iter().max_by(|p, q| long(p).total_cmp(&long(q)))?;
        let reach = from.distance(to);
        if reach < 1e-12 {
            return Some(Piece { from: a, x: Vector::ZERO, y: Vector::ZERO, flat: vec![[0.0; 2]] });
        }
        let x = (to - from) / reach;
        let normal = (b - a).cross(c - a);
        let tall = normal.length();
        // A triangle without area is a line: any perpendicular direction will do.
        let y = if tall > 1e-18 { (normal / tall).cross(x) } else { Vector::ZERO };
        let corners = within.cut(triangle).into_iter().map(|corner| Vector::from(corner) - from);
        let flat: Vec<[f64; 2]> = corners.map(|corner| [corner.dot(x), corner.dot(y)]).collect();
        (!flat.is_empty()).then_some(Piece { from, x, y, flat })
    }

    /// The area and the longest extent.
    fn size(&self) -> [f64; 2] {
        let twice: f64 = (0..self.flat.len())
            .map(|i| (self.flat[i], self.flat[(i + 1) % self.flat.len()]))
            .map(|([x, y], [next_x, next_y])| x * next_y - next_x * y)
            .sum();
        let extents = [0, 1].map(|i| range(&self.flat, i)).map(|[least, greatest]| greatest - least);
        [twice.abs() / 2.0, extents[0].max(extents[1])]
    }

    fn cover(&self, side: f64, centres: &mut Vec<[f64; 3]>) {
        for column in slabs(&self.flat, 0, side) {
            for piece in slabs(&column, 1, side) {
                let [u, v] = [0, 1].map(|axis| range(&piece, axis).iter().sum::<f64>() / 2.0);
                centres.push((self.from + self.x * u + self.y * v).to_array());
            }
        }
    }
}

/// Cuts a convex piece into slabs of at most this width.
fn slabs(piece: &[[f64; 2]], axis: usize, width: f64) -> Vec<Vec<[f64; 2]>> {
    let [least, greatest] = range(piece, axis);
    let count = ((greatest - least) / width).ceil().max(1.0) as usize;
    let step = (greatest - least) / count as f64;
    if count == 1 {
        return vec![piece.to_vec()];
    }
    let slab = |i: usize| {
        let low = cut(piece, axis, least + step * i as f64, 1.0);
        cut(&low, axis, least + step * (i + 1) as f64, -1.0)
    };
    (0..count).map(slab).filter(|piece| !piece.is_empty()).collect()
}

/// The part of a polygon on one side of a plane, or of a line (Sutherland and Hodgman, CACM 1974): where the coordinate along the axis minus `at`,
/// times `side`, is 0 or more.
pub(crate) fn cut<const N: usize>(piece: &[[f64; N]], axis: usize, at: f64, side: f64) -> Vec<[f64; N]> {
    let beyond = |corner: &[f64; N]| (corner[axis] - at) * side;
    let mut kept = Vec::with_capacity(piece.len() + 1);
    for (i, corner) in piece.iter().enumerate() {
        let next = &piece[(i + 1) % piece.len()];
        let (here, there) = (beyond(corner), beyond(next));
        if here >= 0.0 {
            kept.push(*corner);
        }
        if (here > 0.0 && there < 0.0) || (here < 0.0 && there > 0.0) {
            let share = here / (here - there);
            kept.push(std::array::from_fn(|i| corner[i] + (next[i] - corner[i]) * share));
        }
    }
    kept
}

fn range(piece: &[[f64; 2]], axis: usize) -> [f64; 2] {
    let along = || piece.iter().map(|c| c[axis]);
    [along().fold(f64::INFINITY, f64::min), along().fold(f64::NEG_INFINITY, f64::max)]
}
