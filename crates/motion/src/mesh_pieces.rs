//! Convex decomposition of a mesh: few convex pieces that hold the mesh and fit it closely, for a physics engine, because such engines are fast
//! and reliable with convex bodies only.
//!
//! The hull of the mesh is the first piece. The piece that stands out of the mesh most is cut in two, again and again, until none stands out by
//! more than [`CLOSE_M`] or there are [`MOST_PIECES`]. The volume inside a surface is in the hull of the surface, and its part on one side of a
//! plane is in the hull of the surface's part on that side: so the pieces hold the mesh with its inside. A cut is perpendicular to an axis of the
//! mesh and goes through the point of the surface that is nearest to where the piece stands out most; of the three such cuts the one that leaves
//! the least volume is taken.
//!
//! The hull of a piece with many corners is made of the corners that are farthest along some hundred directions. It falls short of the whole hull
//! by less than 1/200 of the distance from the middle of the piece to its border.

use crate::inside::Inside;
use crate::surface::cut;
use crate::vector::Vector;
use parry3d::math::Vector as Vector32;
use parry3d::shape::SharedShape;
use parry3d::transformation::try_convex_hull;
use std::f64::consts::PI;

/// How far pieces may stand out of a mesh, in metres, unless that takes too many pieces; and the maximum number of pieces.
const CLOSE_M: f64 = 0.002;
const MOST_PIECES: usize = 24;

/// Number of directions whose farthest corners make a hull, if a piece has more corners than that.
const DIRECTIONS: usize = 400;

/// Distance of the points at which a hull is compared with the mesh, in metres, and their maximum number along an edge.
const LOOK_M: f64 = 0.01;
const MOST_ALONG: usize = 8;

/// Faces whose normals, of length 1, differ by less than this count as parts of one face.
const SAME_NORMAL: f64 = 1e-3;

/// Thickness given to a flat piece, in metres.
const THICK_M: f64 = 1e-4;

type Corner = [f64; 3];
type Polygon = Vec<Corner>;

/// Convex pieces that hold a mesh.
#[derive(Debug, Clone)]
pub struct MeshPieces {
    /// The pieces.
    pub hulls: Vec<ConvexPiece>,
    /// How far a piece stands out of the mesh at most, at the points that were compared, in metres.
    pub stands_out_m: f64,
}

/// One of them.
#[derive(Debug, Clone)]
pub struct ConvexPiece {
    /// Its corners.
    pub corners: Vec<Corner>,
    /// Outward normals of its faces, those with the same normal once. A flat piece has none.
    pub(crate) normals: Vec<Vector>,
    /// How far it stands out of the mesh, at the points that were compared, in metres.
    pub(crate) stands_out_m: f64,
}

/// A part of the surface, and its hull.
struct Piece {
    surface: Vec<Polygon>,
    hull: Hull,
    /// How far it stands out, and the nearest point of the surface there.
    out_m: f64,
    below: Corner,
}

struct Hull {
    corners: Vec<Corner>,
    faces: Vec<[Corner; 3]>,
}

/// The whole mesh.
struct Whole<'m> {
    shape: &'m SharedShape,
    inside: &'m Inside,
}

/// The convex pieces of a mesh, given by its triangles, its surface and its inside.
pub(crate) fn pieces(triangles: &[[Corner; 3]], shape: &SharedShape, inside: &Inside) -> MeshPieces {
    let whole = Whole { shape, inside };
    let mut pieces = vec![whole.piece(triangles.iter().map(|triangle| triangle.to_vec()).collect())];
    while pieces.len() < MOST_PIECES {
        let worst = (0..pieces.len()).max_by(|a, b| pieces[*a].out_m.total_cmp(&pieces[*b].out_m));
        let Some(worst) = worst.filter(|worst| pieces[*worst].out_m > CLOSE_M) else { break };
        let Some(halves) = pieces[worst].halves() else { break };
        pieces.swap_remove(worst);
        pieces.extend(halves.map(|surface| whole.piece(surface)));
    }
    let stands_out_m = pieces.iter().map(|piece| piece.out_m).fold(0.0, f64::max);
    let convex = |Piece { hull, out_m, .. }: Piece| {
        let normals = hull.normals();
        ConvexPiece { corners: hull.corners, normals, stands_out_m: out_m }
    };
    MeshPieces { hulls: pieces.into_iter().map(convex).collect(), stands_out_m }
}

impl Whole<'_> {
    fn piece(&self, surface: Vec<Polygon>) -> Piece {
        let hull = Hull::of(&surface);
        let (mut out_m, mut below) = (0.0, [0.0; 3]);
        for at in hull.faces.iter().flat_map(places) {
            if self.inside.contains(at) {
                continue;
            }
            let at = Vector::from(at);
            let nearest = self.shape.project_local_point(at.as_vec3(), false).point.as_dvec3();
            let far = at.distance(nearest);
            if far > out_m {
                (out_m, below) = (far, nearest.to_array());
            }
        }
        Piece { surface, hull, out_m, below }
    }
}

impl Piece {
    /// The surface on both sides of the best cut.
    fn halves(&self) -> Option<[Vec<Polygon>; 2]> {
        let sides = |axis: usize, at: f64| {
            let side = |side: f64| -> Vec<Polygon> {
                let kept = self.surface.iter().map(|polygon| cut(polygon, axis, at, side));
                kept.filter(|polygon| polygon.len() > 2).collect()
            };
            [side(1.0), side(-1.0)]
        };
        let below = (0..3).map(|axis| (axis, self.below[axis]));
        // If the surface point is at the end of the piece, a cut through the middle makes the piece smaller.
        let middle = (0..3).map(|axis| (axis, self.hull.range(axis).iter().sum::<f64>() / 2.0));
        let mut best: Option<(f64, [Vec<Polygon>; 2])> = None;
        for (axis, at) in below.chain(middle) {
            let [least, greatest] = self.hull.range(axis);
            if at - least < CLOSE_M || greatest - at < CLOSE_M {
                continue;
            }
            let halves = sides(axis, at);
            let volume = halves.iter().map(|half| Hull::of(half).volume()).sum();
            if halves.iter().all(|half| !half.is_empty()) && best.as_ref().is_none_or(|(least, _)| volume < *least) {
                best = Some((volume, halves));
            }
        }
        best.map(|(_, halves)| halves)
    }
}

impl Hull {
    fn of(surface: &[Polygon]) -> Hull {
        let corners = farthest(surface);
        let points: Vec<Vector32> = corners.iter().map(|corner| Vector::from(*corner).as_vec3()).collect();
        match try_convex_hull(&points) {
            Ok((points, faces)) if faces.len() > 3 => {
                let corners: Vec<Corner> = points.iter().map(|point| point.as_dvec3().to_array()).collect();
                let faces = faces.iter().map(|face| face.map(|corner| corners[corner as usize])).collect();
                Hull { corners, faces }
            }
            // A flat piece, or a line.
            _ => Hull { corners: thickened(&corners), faces: Vec::new() },
        }
    }

    fn normals(&self) -> Vec<Vector> {
        let mut normals: Vec<Vector> = Vec::new();
        for face in &self.faces {
            let [a, b, c] = face.map(Vector::from);
            let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
            if normals.iter().all(|known| known.distance(normal) > SAME_NORMAL) {
                normals.push(normal);
            }
        }
        normals
    }

    fn volume(&self) -> f64 {
        let Some([origin, ..]) = self.faces.first() else { return 0.0 };
        let part = |face: &[Corner; 3]| {
            let [a, b, c] = face.map(|corner| Vector::from(corner) - Vector::from(*origin));
            a.cross(b).dot(c) / 6.0
        };
        self.faces.iter().map(part).sum::<f64>().abs()
    }

    fn range(&self, axis: usize) -> [f64; 2] {
        let along = || self.corners.iter().map(|corner| corner[axis]);
        [along().fold(f64::INFINITY, f64::min), along().fold(f64::NEG_INFINITY, f64::max)]
    }
}

/// Corners whose hull is that of all; if there are too many, only those that are the farthest along many directions.
fn farthest(surface: &[Polygon]) -> Vec<Corner> {
    let mut all: Vec<Corner> = surface.iter().flatten().copied().collect();
    all.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(a[2].total_cmp(&b[2])));
    all.dedup();
    if all.len() <= DIRECTIONS {
        return all;
    }
    // Points evenly spread on a sphere by the golden angle.
    let golden = PI * (3.0 - 5.0_f64.sqrt());
    let direction = |i: usize| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let aside = (1.0 - z * z).sqrt();
        Vector::new(aside * cos, aside * sin, z)
    };
    let mut taken: Vec<usize> = Vec::with_capacity(DIRECTIONS);
    for way in (0..DIRECTIONS).map(direction) {
        let along = |corner: &Corner| way.dot(Vector::from(*corner));
        let mut best = (f64::NEG_INFINITY, 0);
        for (i, corner) in all.iter().enumerate() {
            let far = along(corner);
            if far > best.0 {
                best = (far, i);
            }
        }
        taken.push(best.1);
    }
    taken.sort_unstable();
    taken.dedup();
    taken.into_iter().map(|i| all[i]).collect()
}

/// Points around each corner, which give a flat piece a thickness.
fn thickened(corners: &[Corner]) -> Vec<Corner> {
    let beside = |corner: &Corner| {
        let corner = *corner;
        (0..3).flat_map(move |axis| {
            [-THICK_M, THICK_M].map(|by| {
                let mut beside = corner;
                beside[axis] += by;
                beside
            })
        })
    };
    corners.iter().flat_map(beside).collect()
}

/// Sample points of a face, without its corners.
fn places(face: &[Corner; 3]) -> Vec<Corner> {
    let [a, b, c] = face.map(Vector::from);
    let longest = [[a, b], [b, c], [c, a]].iter().map(|[p, q]| p.distance(*q)).fold(0.0, f64::max);
    // No point of a small face is farther than `CLOSE_M` from its corners, which are points of the mesh.
    if longest < CLOSE_M {
        return Vec::new();
    }
    let along = ((longest / LOOK_M).ceil() as usize).clamp(1, MOST_ALONG);
    let mut places = Vec::new();
    for i in 0..along {
        for j in 0..along - i {
            let [u, v] = [i, j].map(|k| (k as f64 + 1.0 / 3.0) / along as f64);
            places.push((a + u * (b - a) + v * (c - a)).to_array());
        }
    }
    places
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::mesh::Mesh;

    /// A prism over a counterclockwise outline; `faces` has the triangles of its end faces.
    fn prism(outline: &[[f64; 2]], faces: &[[usize; 3]], height: f64) -> Mesh {
        let at = |i: usize, z: f64| [outline[i][0], outline[i][1], z];
        let mut triangles = Vec::new();
        for [a, b, c] in faces {
            triangles.push([at(*a, height), at(*b, height), at(*c, height)]);
            triangles.push([at(*a, 0.0), at(*c, 0.0), at(*b, 0.0)]);
        }
        for i in 0..outline.len() {
            let next = (i + 1) % outline.len();
            triangles.push([at(i, 0.0), at(next, 0.0), at(next, height)]);
            triangles.push([at(i, 0.0), at(next, height), at(i, height)]);
        }
        Mesh::new(triangles).unwrap()
    }

    /// A `U` that is open at the top, with legs 2 cm thick.
    fn u() -> Mesh {
        let outline =
            [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.08, 0.1], [0.08, 0.02], [0.02, 0.02], [0.02, 0.1], [0.0, 0.1]];
        prism(&outline, &[[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4], [5, 6, 7], [0, 5, 7]], 0.03)
    }

    #[test]
    fn what_is_convex_is_one_piece_and_a_u_is_few_that_leave_it_open() {
        let cube = prism(&[[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]], &[[0, 1, 2], [0, 2, 3]], 0.1);
        let one = cube.pieces();
        let [cube] = &one.hulls[..] else { panic!("{one:?}") };
        assert_eq!((cube.corners.len(), cube.normals.len()), (8, 6));
        // Its hull stands out of it by 3 cm.
        let few = u().pieces().clone();
        assert!(few.hulls.len() < 8 && few.stands_out_m <= CLOSE_M, "{few:?}");
    }

    #[test]
    fn every_point_of_a_curved_mesh_is_in_a_piece_and_the_pieces_stay_close() {
        // A half ring whose surface has many corners.
        let (inner, outer, steps) = (0.06, 0.1, 60);
        let on = |radius: f64, i: usize| {
            let (sin, cos) = (PI * i as f64 / steps as f64).sin_cos();
            [radius * cos, radius * sin]
        };
        let outline: Vec<[f64; 2]> =
            (0..=steps).map(|i| on(outer, i)).chain((0..=steps).rev().map(|i| on(inner, i))).collect();
        let last = outline.len() - 1;
        let faces: Vec<[usize; 3]> =
            (0..steps).flat_map(|i| [[i, i + 1, last - i - 1], [i, last - i - 1, last - i]]).collect();
        let mesh = prism(&outline, &faces, 0.04);
        let MeshPieces { hulls, stands_out_m } = mesh.pieces();
        assert!(
            hulls.len() > 4 && hulls.len() <= MOST_PIECES && *stands_out_m <= CLOSE_M,
            "{} {stands_out_m}",
            hulls.len()
        );
        let shapes: Vec<SharedShape> = hulls
            .iter()
            .map(|hull| {
                let points: Vec<Vector32> = hull.corners.iter().map(|corner| Vector::from(*corner).as_vec3()).collect();
                SharedShape::convex_hull(&points).unwrap()
            })
            .collect();
        for triangle in mesh.triangles() {
            let middle: Corner = std::array::from_fn(|i| triangle.iter().map(|corner| corner[i]).sum::<f64>() / 3.0);
            let middle = Vector::from(middle);
            let near = shapes.iter().map(|shape| shape.distance_to_local_point(middle.as_vec3(), true));
            assert!(near.fold(f32::INFINITY, f32::min) < 5e-4, "{middle:?}");
        }
    }
}
