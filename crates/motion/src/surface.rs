//! The surface of a mesh held by balls of one radius: every place on it is in one of them, and their centres are on the surface, so they
//! stand out by their radius and no more.
//!
//! Each triangle is cut by a square grid in its plane. What is in one square has the middle of the smallest upright rectangle around it
//! as the centre of its ball: a convex piece that touches all four sides of the rectangle holds that middle. Where only a part of space
//! matters, what of a triangle is outside is cut off first: a ball is spent only on what is within.

use crate::mesh::Mesh;

/// Balls on one mesh, about, beside one for each triangle: a mesh that needs more gets larger ones.
pub const MOST_SAMPLES: usize = 300_000;

/// From one radius that is tried to the next.
const LARGER: f64 = 1.1;

/// A part of space: least and greatest coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) least: [f64; 3],
    pub(crate) greatest: [f64; 3],
}

impl Bounds {
    /// All of space.
    pub(crate) const EVERYWHERE: Bounds = Bounds { least: [f64::NEG_INFINITY; 3], greatest: [f64::INFINITY; 3] };

    /// About points; nothing where there are none.
    pub(crate) fn about(points: impl Iterator<Item = [f64; 3]>) -> Bounds {
        let nothing = Bounds { least: [f64::INFINITY; 3], greatest: [f64::NEG_INFINITY; 3] };
        points.fold(nothing, |around, p| Bounds {
            least: std::array::from_fn(|i| around.least[i].min(p[i])),
            greatest: std::array::from_fn(|i| around.greatest[i].max(p[i])),
        })
    }

    /// What is in both; `None` where nothing is.
    pub(crate) fn and(&self, other: &Bounds) -> Option<Bounds> {
        let both = Bounds {
            least: std::array::from_fn(|i| self.least[i].max(other.least[i])),
            greatest: std::array::from_fn(|i| self.greatest[i].min(other.greatest[i])),
        };
        (0..3).all(|i| both.least[i] <= both.greatest[i]).then_some(both)
    }

    /// Larger on every side.
    pub(crate) fn grown(&self, by: f64) -> Bounds {
        Bounds { least: self.least.map(|c| c - by), greatest: self.greatest.map(|c| c + by) }
    }

    /// What of a triangle is within, a convex piece; nothing where less than three corners are left.
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

/// The radius of the balls for this mesh and a radius wanted, in metres.
pub fn radius(mesh: &Mesh, wanted: f64) -> f64 {
    balls(mesh.triangles(), &Bounds::EVERYWHERE, wanted, MOST_SAMPLES).0
}

/// The radius of the balls for what of some triangles is within bounds, `most` of them beside one for each, and about how many they are.
pub(crate) fn balls(triangles: &[[[f64; 3]; 3]], within: &Bounds, wanted: f64, most: usize) -> (f64, usize) {
    // Of each piece, its area and its longest extent.
    let sizes: Vec<[f64; 2]> =
        triangles.iter().filter_map(|t| Piece::new(t, within)).map(|piece| piece.size()).collect();
    let more = |radius: f64| {
        let side = side(radius);
        let beside_first =
            |[area, long]: &[f64; 2]| if *long <= side { 0.0 } else { area / (side * side) + long / side };
        sizes.iter().map(beside_first).sum::<f64>()
    };
    // Always of the same series, so that less of a mesh has no larger balls.
    let mut radius = wanted;
    while more(radius) > most as f64 {
        radius *= LARGER;
    }
    (radius, sizes.len() + more(radius) as usize)
}

/// The centres of the balls that hold what of some triangles is within bounds.
pub(crate) fn centres(triangles: &[[[f64; 3]; 3]], within: &Bounds, radius: f64) -> Vec<[f64; 3]> {
    let mut centres = Vec::new();
    for triangle in triangles {
        if let Some(piece) = Piece::new(triangle, within) {
            piece.cover(side(radius), &mut centres);
        }
    }
    centres
}

/// The side of a square that a ball holds, a little less for rounding.
fn side(radius: f64) -> f64 {
    radius * 2_f64.sqrt() * (1.0 - 1e-6)
}

/// What of a triangle is within bounds, in a frame of its plane with x along the triangle's longest side.
struct Piece {
    from: [f64; 3],
    x: [f64; 3],
    y: [f64; 3],
    flat: Vec<[f64; 2]>,
}

impl Piece {
    fn new(triangle @ [a, b, c]: &[[f64; 3]; 3], within: &Bounds) -> Option<Piece> {
        Bounds::about(triangle.iter().copied()).and(within)?;
        let sides = [(a, b), (b, c), (c, a)];
        let long = |(from, to): &(&[f64; 3], &[f64; 3])| length(&minus(to, from));
        let (from, to) = sides.into_iter().max_by(|p, q| long(p).total_cmp(&long(q)))?;
        let along = minus(to, from);
        let reach = length(&along);
        if reach < 1e-12 {
            return Some(Piece { from: *a, x: [0.0; 3], y: [0.0; 3], flat: vec![[0.0; 2]] });
        }
        let x = along.map(|c| c / reach);
        let normal = cross(&minus(b, a), &minus(c, a));
        let tall = length(&normal);
        // A triangle without area is a line: any direction across will do.
        let y = if tall > 1e-18 { cross(&normal.map(|c| c / tall), &x) } else { [0.0; 3] };
        let corners = within.cut(triangle);
        let flat: Vec<[f64; 2]> = corners.iter().map(|p| minus(p, from)).map(|p| [dot(&p, &x), dot(&p, &y)]).collect();
        (!flat.is_empty()).then_some(Piece { from: *from, x, y, flat })
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
                let middle: [f64; 2] = std::array::from_fn(|i| {
                    let [least, greatest] = range(&piece, i);
                    (least + greatest) / 2.0
                });
                centres.push(std::array::from_fn(|i| self.from[i] + self.x[i] * middle[0] + self.y[i] * middle[1]));
            }
        }
    }
}

/// A convex piece cut into slabs of a width.
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

/// The part of a polygon on one side of a plane, or of a line (Sutherland and Hodgman, CACM 1974): where `side` times what the corners have along the
/// axis beyond `at` is 0 or more.
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

fn minus(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn length(a: &[f64; 3]) -> f64 {
    dot(a, a).sqrt()
}
