//! The surface of a mesh held by balls of one radius: every place on it is in one of them, and their centres are on the surface, so they
//! stand out by their radius and no more.
//!
//! Each triangle is cut by a square grid in its plane. What is in one square has the middle of the smallest upright rectangle around it
//! as the centre of its ball: a convex piece that touches all four sides of the rectangle holds that middle.

use crate::mesh::Mesh;

/// Balls on one mesh, about: a mesh of more gets larger ones.
pub const MOST_SAMPLES: usize = 300_000;

/// The radius of the balls for this mesh and a radius wanted, in metres.
pub fn radius(mesh: &Mesh, wanted: f64) -> f64 {
    let area: f64 = mesh.triangles().iter().map(area).sum();
    // A square that a ball holds is twice the square of its radius.
    wanted.max((area / (2.0 * MOST_SAMPLES as f64)).sqrt())
}

/// The centres of the balls.
pub(crate) fn centres(mesh: &Mesh, radius: f64) -> Vec<[f64; 3]> {
    let mut centres = Vec::new();
    for triangle in mesh.triangles() {
        cover(triangle, radius, &mut centres);
    }
    centres
}

fn area([a, b, c]: &[[f64; 3]; 3]) -> f64 {
    let (u, v) = (minus(b, a), minus(c, a));
    length(&cross(&u, &v)) / 2.0
}

fn cover([a, b, c]: &[[f64; 3]; 3], radius: f64, centres: &mut Vec<[f64; 3]>) {
    let sides = [(a, b), (b, c), (c, a)];
    let long = |(from, to): &(&[f64; 3], &[f64; 3])| length(&minus(to, from));
    let Some((from, to)) = sides.into_iter().max_by(|p, q| long(p).total_cmp(&long(q))) else { return };
    let along = minus(to, from);
    let reach = length(&along);
    if reach < 1e-12 {
        centres.push(*a);
        return;
    }
    let x = along.map(|c| c / reach);
    let normal = cross(&minus(b, a), &minus(c, a));
    let tall = length(&normal);
    // A triangle without area is a line: any direction across will do.
    let y = if tall > 1e-18 { cross(&normal.map(|c| c / tall), &x) } else { [0.0; 3] };
    let flat: Vec<[f64; 2]> = [a, b, c].iter().map(|p| [dot(&minus(p, from), &x), dot(&minus(p, from), &y)]).collect();
    // A little less than what the ball just holds, for rounding.
    let side = radius * 2_f64.sqrt() * (1.0 - 1e-6);
    for column in slabs(&flat, 0, side) {
        for piece in slabs(&column, 1, side) {
            let middle: [f64; 2] = std::array::from_fn(|i| {
                let [least, greatest] = range(&piece, i);
                (least + greatest) / 2.0
            });
            centres.push(std::array::from_fn(|i| from[i] + x[i] * middle[0] + y[i] * middle[1]));
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

/// What is on one side (Sutherland and Hodgman).
fn cut(piece: &[[f64; 2]], axis: usize, at: f64, side: f64) -> Vec<[f64; 2]> {
    let beyond = |corner: &[f64; 2]| (corner[axis] - at) * side;
    let mut kept = Vec::with_capacity(piece.len() + 1);
    for (i, corner) in piece.iter().enumerate() {
        let next = &piece[(i + 1) % piece.len()];
        let (here, there) = (beyond(corner), beyond(next));
        if here >= 0.0 {
            kept.push(*corner);
        }
        if (here > 0.0 && there < 0.0) || (here < 0.0 && there > 0.0) {
            let share = here / (here - there);
            kept.push([corner[0] + (next[0] - corner[0]) * share, corner[1] + (next[1] - corner[1]) * share]);
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
