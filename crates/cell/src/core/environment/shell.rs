//! A mesh of a link as the judge sees it: its triangles as they are, not the convex pieces that the physics engine uses.
//!
//! It touches another shape if a triangle does, or if one is wholly inside the other. The depth is the maximum translation that one triangle, or
//! one corner, needs to be free: so it is never more than the links need. The exact comparisons are bounded (`MAX_PAIRS`), and of two meshes so are
//! the triangles of one that are searched for in the other (`MAX_SEARCHES`). How many triangles are passed over in one search is bounded by the size
//! of the mesh alone.

use super::convex::Convex;
use super::overlap::{Meeting, meeting};
use super::vector::{Vector, direction};
use rapier3d::math::Vector as Vector32;
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::parry::partitioning::{Bvh, BvhBuildStrategy};
use rapier3d::parry::query::PointQuery;
use rapier3d::parry::shape::SharedShape;
use ratn_model::pose::Pose;
use ratn_motion::mesh::{ConvexPiece, Meshed};
use ratn_motion::robot::to_f32;

/// Maximum number of triangles near the other shape in one comparison, or of such pairs for two meshes. What is found by then counts.
const MAX_PAIRS: usize = 4_000;

/// Maximum number of triangles of one mesh for which another mesh is searched in one comparison: those of the mesh with fewer triangles near the
/// other. What is found by then counts.
const MAX_SEARCHES: usize = 10_000;

/// Maximum number of corners of a mesh whose depth in another mesh is computed.
const MAX_CORNERS: usize = 64;

/// Enlargement of the boxes around triangles, which are `f32`, in metres.
const ROUNDED_M: f64 = 1e-5;

/// A mesh, in the frame of its link.
#[derive(Debug, Clone)]
pub(super) struct Surface {
    triangles: Vec<[Vector; 3]>,
    tree: Bvh,
    /// The convex pieces that the physics engine uses.
    hulls: Vec<SharedShape>,
}

impl Surface {
    pub(super) fn of(meshed: &Meshed) -> Surface {
        let corner = |corner: &[f64; 3]| Vector::from(meshed.pose.transform(*corner));
        let point = |at: &[f64; 3]| narrow(corner(at));
        let hull = |piece: &ConvexPiece| SharedShape::convex_hull(&piece.corners.iter().map(point).collect::<Vec<_>>());
        let hulls = meshed.mesh.pieces().hulls.iter().filter_map(hull).collect();
        let triangles: Vec<[Vector; 3]> =
            meshed.mesh.triangles().iter().map(|triangle| triangle.each_ref().map(corner)).collect();
        let boxes = triangles.iter().map(|triangle| around(triangle, 0.0)).enumerate();
        Surface { tree: Bvh::from_iter(BvhBuildStrategy::Binned, boxes), triangles, hulls }
    }

    /// The convex pieces that the physics engine uses, in the frame of the link.
    pub(super) fn hulls(&self) -> &[SharedShape] {
        &self.hulls
    }

    /// Its bounding box at a pose.
    pub(super) fn extent(&self, at: &Pose) -> Aabb {
        moved(&self.tree.root_aabb(), at)
    }

    fn triangle(&self, index: u32, at: &Pose) -> Convex {
        Convex::triangle(self.triangles[index as usize].map(|corner| Vector::from(at.transform(corner.to_array()))))
    }

    /// Its contact with a convex shape, if they are no farther apart than `within_m` metres. A negative `within_m` is a minimum depth.
    pub(super) fn meeting(&self, at: Pose, other: &Convex, within_m: f64) -> Option<Meeting> {
        self.meeting_near(at, other, within_m.max(0.0)).filter(|met| met.depth_m >= -within_m)
    }

    fn meeting_near(&self, at: Pose, other: &Convex, within_m: f64) -> Option<Meeting> {
        let found = self.nearest_triangle(at, other, within_m, &mut { MAX_PAIRS });
        let middle = other.middle.to_array();
        let seen = Vector::from(at.inverse().transform(middle));
        if found.is_some_and(|found| found.depth_m >= 0.0) || !self.tree.root_aabb().contains_local_point(narrow(seen))
        {
            return found;
        }
        // What has no triangle in it may be wholly inside; then it is as deep as its middle, and more.
        let inside = self.holds(seen).then(|| self.depth_of(seen, &at)).map(Meeting::turned);
        inside.or(found)
    }

    /// The contact of the deepest triangle near the shape. The triangles are checked in the order of an upper bound of their depth, until none can
    /// be deeper than the deepest one found.
    fn nearest_triangle(&self, at: Pose, other: &Convex, within_m: f64, pairs: &mut usize) -> Option<Meeting> {
        let near = extent(other, &at, within_m.max(0.0));
        let ways: Vec<Vector> = other.across().into_iter().filter_map(direction).flat_map(|way| [way, -way]).collect();
        let mut open: Vec<(f64, Convex)> = Vec::new();
        let bounds: Vec<_> = ways.iter().map(|way| bound_along(*way, &at, other, within_m)).collect();
        for index in self.tree.leaves(|node| node.aabb().intersects(&near) && reaches(&node.aabb(), &bounds)) {
            let triangle = self.triangle(index, &at);
            let at_most = deepest_along(&ways, &triangle, other);
            if at_most < -within_m {
                continue;
            }
            let Some(left) = pairs.checked_sub(1) else { break };
            *pairs = left;
            open.push((at_most, triangle));
        }
        open.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        let mut found: Option<Meeting> = None;
        for (at_most, triangle) in open {
            let least = found.map_or(-within_m, |found| found.depth_m);
            if at_most < least {
                break;
            }
            found = found.into_iter().chain(meeting(&triangle, other, -least)).reduce(deeper);
        }
        found
    }

    /// Its contact with another mesh, as [`Surface::meeting`].
    pub(super) fn meeting_surface(&self, at: Pose, other: &Surface, its: Pose, within_m: f64) -> Option<Meeting> {
        self.meeting_near_surface(at, other, its, within_m.max(0.0)).filter(|met| met.depth_m >= -within_m)
    }

    fn meeting_near_surface(&self, at: Pose, other: &Surface, its: Pose, within_m: f64) -> Option<Meeting> {
        let [seen, from_there] = [at.inverse().compose(&its), its.inverse().compose(&at)];
        let (theirs, mine) = (moved(&other.tree.root_aabb(), &seen), moved(&self.tree.root_aabb(), &from_there));
        let near = [self.near_box(&theirs, &from_there, other, within_m), other.near_box(&mine, &seen, self, within_m)];
        let found = if near[0].len() <= near[1].len() {
            self.deepest_of(&near[0], at, other, its, within_m)
        } else {
            other.deepest_of(&near[1], its, self, at, within_m).map(Meeting::turned)
        };
        let do_cross = found.is_some_and(|found| found.depth_m >= 0.0);
        // If no triangles touch, one corner tells whether all are inside.
        let corners = |inside: bool| if do_cross { MAX_CORNERS } else { usize::from(inside) };
        let first = self.deepest_in(&at, other, &its, corners(other.tree.root_aabb().contains(&mine)));
        let second = other.deepest_in(&its, self, &at, corners(self.tree.root_aabb().contains(&theirs)));
        found.into_iter().chain(first).chain(second.map(Meeting::turned)).reduce(deeper)
    }

    /// Some triangles near the box around another mesh: at most so many as are searched for, and one. `theirs` is that box in the frame of this mesh,
    /// and `from_there` the pose of this mesh in the frame of the other: a triangle has to be near in both frames.
    fn near_box(&self, theirs: &Aabb, from_there: &Pose, other: &Surface, within_m: f64) -> Vec<u32> {
        let more_m = (within_m + ROUNDED_M) as f32;
        let (near, room) = (theirs.loosened(more_m), other.tree.root_aabb().loosened(more_m));
        let is_near = |node: &Aabb| node.intersects(&near) && moved(node, from_there).intersects(&room);
        self.tree.leaves(|node| is_near(&node.aabb())).take(MAX_SEARCHES + 1).collect()
    }

    /// The contact of the deepest of some of its triangles in another mesh.
    fn deepest_of(&self, triangles: &[u32], at: Pose, other: &Surface, its: Pose, within_m: f64) -> Option<Meeting> {
        let mut pairs = MAX_PAIRS;
        let mut found: Option<Meeting> = None;
        for index in triangles.iter().take(MAX_SEARCHES) {
            if pairs == 0 {
                break;
            }
            let within_m = found.map_or(within_m, |found| -found.depth_m);
            let met = other.nearest_triangle(its, &self.triangle(*index, &at), within_m, &mut pairs);
            let met = met.map(Meeting::turned);
            found = found.into_iter().chain(met).reduce(deeper);
        }
        found
    }

    /// The deepest contact among some of its corners in another mesh.
    fn deepest_in(&self, at: &Pose, other: &Surface, its: &Pose, most: usize) -> Option<Meeting> {
        if most == 0 {
            return None;
        }
        let from_there = its.inverse().compose(at);
        let seen = |index: u32| {
            self.triangles[index as usize].map(|corner| Vector::from(from_there.transform(corner.to_array())))
        };
        let room = other.tree.root_aabb();
        let near = moved(&room, &from_there.inverse());
        let corners = self.tree.intersect_aabb(&near).flat_map(seen);
        let corners: Vec<Vector> = corners.filter(|corner| room.contains_local_point(narrow(*corner))).collect();
        let some = corners.iter().step_by(corners.len().div_ceil(most).max(1));
        some.filter(|corner| other.holds(**corner)).map(|corner| other.depth_of(*corner, its)).reduce(deeper)
    }

    /// The contact of an inner point, in the frame of the link, with the surface; the point is the first of the two.
    fn depth_of(&self, point: Vector, at: &Pose) -> Meeting {
        let aside = narrow(point);
        let near = self.tree.find_best(
            f32::MAX,
            |node, _| node.aabb().distance_to_local_point(aside, true),
            |index, _| Some((nearest(&self.triangles[index as usize], point) - point).length() as f32),
        );
        let nearest = near.map_or(point, |(index, _)| nearest(&self.triangles[index as usize], point));
        let inwards = direction(point - nearest).unwrap_or(Vector::AXES[2]);
        Meeting {
            depth_m: (point - nearest).length(),
            normal: Vector::from(at.rotate(inwards.to_array())),
            at: Vector::from(at.transform(point.to_array())),
        }
    }

    /// Whether a point, in the frame of the link, is inside: a ray upwards from it does not leave the surface as often as it enters it.
    fn holds(&self, point: Vector) -> bool {
        let (from, room) = (narrow(point), self.tree.root_aabb());
        let top = Vector32::new(from.x, from.y, room.maxs.z.max(from.z));
        let line = Aabb::new(from, top).loosened(ROUNDED_M as f32);
        self.tree.intersect_aabb(&line).map(|index| crossed(&self.triangles[index as usize], point)).sum::<i32>() != 0
    }
}

/// Whether a ray upwards from a point crosses a triangle: 1 from below, -1 from above. A ray along a common edge crosses one of two triangles.
fn crossed(triangle: &[Vector; 3], Vector { x, y, z }: Vector) -> i32 {
    let edges = [[0, 1], [1, 2], [2, 0]].map(|edge| edge.map(|corner: usize| triangle[corner]));
    // An edge counts if exactly one of its ends is beyond y.
    let beyond = |[a, b]: &[Vector; 2]| {
        let (a, b) = if a[1] <= b[1] { (a, b) } else { (b, a) };
        a[1] <= y && y < b[1] && x < a[0] + (b[0] - a[0]) * ((y - a[1]) / (b[1] - a[1]))
    };
    if edges.iter().filter(|edge| beyond(edge)).count() != 1 {
        return 0;
    }
    let across = (triangle[1] - triangle[0]).cross(triangle[2] - triangle[0]);
    let Vector { x: a, y: b, z: c } = triangle[0];
    // The height of the triangle's plane there.
    let height = c - (across[0] * (x - a) + across[1] * (y - b)) / across[2];
    if across[2] == 0.0 || height < z { 0 } else { across[2].signum() as i32 }
}

/// Upper bound of the depth of two shapes: their overlap along any of these directions, or from middle to middle.
fn deepest_along(ways: &[Vector], a: &Convex, b: &Convex) -> f64 {
    let between = direction(b.middle - a.middle);
    let overlap = |way: &Vector| (a.farthest(*way) - b.farthest(-*way)).dot(*way) + a.radius + b.radius;
    ways.iter().chain(&between).map(overlap).fold(f64::INFINITY, f64::min)
}

/// A direction in the frame of a mesh, and what is to be added to how far a part of the mesh reaches along it: if the sum is negative, the part is
/// farther from the shape than `within_m` metres.
fn bound_along(way: Vector, at: &Pose, other: &Convex, within_m: f64) -> (Vector32, f64) {
    let beyond = (Vector::from(at.position) - other.farthest(-way)).dot(way) + other.radius + within_m + ROUNDED_M;
    (narrow(Vector::from(at.inverse().rotate(way.to_array()))), beyond)
}

/// Whether a box of the tree is near the shape along each of these directions.
fn reaches(aabb: &Aabb, bounds: &[(Vector32, f64)]) -> bool {
    let (middle, half) = (aabb.center(), aabb.half_extents());
    bounds.iter().all(|(way, beyond)| f64::from(middle.dot(*way) + half.dot(way.abs())) + beyond >= 0.0)
}

fn deeper(a: Meeting, b: Meeting) -> Meeting {
    if b.depth_m > a.depth_m { b } else { a }
}

fn narrow(v: Vector) -> Vector32 {
    v.as_vec3()
}

/// The bounding box of points, `more_m` metres larger.
fn around(points: &[Vector], more_m: f64) -> Aabb {
    Aabb::from_points(points.iter().map(|point| narrow(*point))).loosened((more_m + ROUNDED_M) as f32)
}

/// The bounding box of a box in another frame, given its pose there.
fn moved(aabb: &Aabb, pose: &Pose) -> Aabb {
    aabb.transform_by(&to_f32(pose)).loosened(ROUNDED_M as f32)
}

/// The bounding box of a convex shape in a frame, `more_m` metres larger.
fn extent(convex: &Convex, frame: &Pose, more_m: f64) -> Aabb {
    let reach = |way: Vector| {
        let along = Vector::from(frame.rotate(way.to_array()));
        (convex.farthest(along) - Vector::from(frame.position)).dot(along) + convex.radius
    };
    let most = Vector::from(Vector::AXES.map(reach));
    let least = Vector::from(Vector::AXES.map(|axis| -reach(-axis)));
    around(&[least, most], more_m)
}

/// The nearest point of a triangle to another point.
fn nearest(triangle: &[Vector; 3], to: Vector) -> Vector {
    let [a, b, c] = *triangle;
    let edges = [[a, b], [b, c], [c, a]];
    if let Some(across) = direction((b - a).cross(c - a)) {
        let on_plane = to - across * (to - a).dot(across);
        if edges.iter().all(|[from, end]| (*end - *from).cross(on_plane - *from).dot(across) >= 0.0) {
            return on_plane;
        }
    }
    let on_edge = |[from, end]: [Vector; 2]| {
        let edge = end - from;
        from + edge * ((to - from).dot(edge) / edge.dot(edge).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
    };
    let [first, second, third] = edges.map(on_edge);
    let nearer = |p: Vector, q: Vector| if (q - to).length() < (p - to).length() { q } else { p };
    nearer(nearer(first, second), third)
}
