//! What a link is without the spheres that the engine has in place of its meshes: its primitives and the meshes themselves.
//!
//! Two such links touch where a triangle of one meets a triangle or a primitive of the other, or where one is wholly inside the other. How deep is the
//! most that one triangle, or one corner, has to be moved: so it is never more than the links have to be. The work of a look has a bound.

use super::convex::Convex;
use super::overlap::{Meeting, meeting};
use super::vector::Vector;
use rapier3d::math::Vector as Vector32;
use rapier3d::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier3d::parry::partitioning::{Bvh, BvhBuildStrategy};
use rapier3d::parry::shape::SharedShape;
use ratn_model::pose::Pose;
use ratn_motion::mesh::Meshed;
use ratn_motion::robot::{Link, to_f32};
use ratn_motion::solid::Form;
use std::f64::consts::PI;

/// Triangles of one link that are held against those of the other in one look, at the most. What is found by then counts.
const MAX_PAIRS: usize = 4_000;

/// Corners of a mesh of which it is asked how deep they are in another one, at the most.
const MAX_CORNERS: usize = 64;

/// The boxes around triangles are in `f32`: by how much they are larger, in metres.
const ROUNDED_M: f64 = 1e-5;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Shell {
    primitives: Vec<(Pose, SharedShape)>,
    surfaces: Vec<Surface>,
}

/// A mesh, in the frame of its link.
#[derive(Debug, Clone)]
struct Surface {
    triangles: Vec<[Vector; 3]>,
    tree: Bvh,
}

/// A link that is being looked at.
#[derive(Clone, Copy)]
struct Placed<'s> {
    shell: &'s Shell,
    at: Pose,
}

impl Shell {
    pub(super) fn of(link: &Link) -> Shell {
        let own = link.forms().filter(|(form, _)| *form == Form::Own);
        let primitives = own.map(|(_, body)| (body.pose, body.geometry.shape(0.0))).collect();
        Shell { primitives, surfaces: link.meshes.iter().map(Surface::of).collect() }
    }

    /// How this link, in its place, meets another one in its own, if they are no farther apart than `within_m` metres.
    pub(super) fn meeting(&self, at: Pose, other: &Shell, its: Pose, within_m: f64) -> Option<Meeting> {
        let (a, b) = (Placed { shell: self, at }, Placed { shell: other, at: its });
        let mut pairs = MAX_PAIRS;
        let mut found = Vec::new();
        for first in a.primitives() {
            found.extend(b.primitives().filter_map(|second| meeting(&first, &second, within_m)));
            let of_surface = |surface: &Surface| surface.meeting(b.at, &first, within_m, &mut pairs);
            found.extend(other.surfaces.iter().filter_map(of_surface).map(turned));
        }
        for second in b.primitives() {
            let of_surface = |surface: &Surface| surface.meeting(a.at, &second, within_m, &mut pairs);
            found.extend(self.surfaces.iter().filter_map(of_surface));
        }
        for first in &self.surfaces {
            for second in &other.surfaces {
                found.extend(first.meeting_surface(a.at, second, b.at, within_m, &mut pairs));
            }
        }
        found.into_iter().reduce(deeper)
    }
}

impl Placed<'_> {
    fn primitives(self) -> impl Iterator<Item = Convex> {
        let placed = move |(pose, shape): &(Pose, SharedShape)| Convex::of(&**shape, &to_f32(&self.at.compose(pose)));
        self.shell.primitives.iter().filter_map(placed)
    }
}

impl Surface {
    fn of(meshed: &Meshed) -> Surface {
        let corner = |corner: &[f64; 3]| Vector(meshed.pose.transform(*corner));
        let triangles: Vec<[Vector; 3]> =
            meshed.mesh.triangles().iter().map(|triangle| triangle.each_ref().map(corner)).collect();
        let boxes = triangles.iter().map(|triangle| around(triangle, 0.0)).enumerate();
        Surface { tree: Bvh::from_iter(BvhBuildStrategy::Binned, boxes), triangles }
    }

    fn triangle(&self, index: u32, at: &Pose) -> Convex {
        Convex::triangle(self.triangles[index as usize].map(|Vector(corner)| Vector(at.transform(corner))))
    }

    /// How it meets something convex.
    fn meeting(&self, at: Pose, other: &Convex, within_m: f64, pairs: &mut usize) -> Option<Meeting> {
        let found = self.nearest_triangle(at, other, within_m, pairs);
        let Vector(middle) = other.middle;
        let seen = Vector(at.inverse().transform(middle));
        if found.is_some_and(|found| found.depth_m >= 0.0) || !self.tree.root_aabb().contains_local_point(narrow(seen))
        {
            return found;
        }
        // What has no triangle in it may be wholly inside; then it is as deep as its middle, and more.
        let inside = self.holds(seen).then(|| self.depth_of(seen, &at)).map(turned);
        inside.or(found)
    }

    /// The same of what is near by: the deepest that a triangle is in it.
    fn nearest_triangle(&self, at: Pose, other: &Convex, within_m: f64, pairs: &mut usize) -> Option<Meeting> {
        let near = extent(other, &at, within_m);
        let mut found = None;
        for index in self.tree.intersect_aabb(&near) {
            let Some(left) = pairs.checked_sub(1) else { break };
            *pairs = left;
            let met = meeting(&self.triangle(index, &at), other, within_m);
            found = found.into_iter().chain(met).reduce(deeper);
        }
        found
    }

    /// How it meets another one.
    fn meeting_surface(
        &self,
        at: Pose,
        other: &Surface,
        its: Pose,
        within_m: f64,
        pairs: &mut usize,
    ) -> Option<Meeting> {
        let [seen, from_there] = [at.inverse().compose(&its), its.inverse().compose(&at)];
        let (theirs, mine) = (moved(&other.tree.root_aabb(), &seen), moved(&self.tree.root_aabb(), &from_there));
        let near = theirs.loosened((within_m + ROUNDED_M) as f32);
        let mut found: Option<Meeting> = None;
        for index in self.tree.intersect_aabb(&near) {
            if *pairs == 0 {
                break;
            }
            let met = other.nearest_triangle(its, &self.triangle(index, &at), within_m, pairs).map(turned);
            found = found.into_iter().chain(met).reduce(deeper);
        }
        let do_cross = found.is_some_and(|found| found.depth_m >= 0.0);
        // Where no triangles meet, one corner says whether all are inside.
        let corners = |inside: bool| if do_cross { MAX_CORNERS } else { usize::from(inside) };
        let first = self.deepest_in(&at, other, &its, corners(other.tree.root_aabb().contains(&mine)));
        let second = other.deepest_in(&its, self, &at, corners(self.tree.root_aabb().contains(&theirs)));
        found.into_iter().chain(first).chain(second.map(turned)).reduce(deeper)
    }

    /// How deep the deepest of some of its corners is in another one.
    fn deepest_in(&self, at: &Pose, other: &Surface, its: &Pose, most: usize) -> Option<Meeting> {
        if most == 0 {
            return None;
        }
        let from_there = its.inverse().compose(at);
        let seen =
            |index: u32| self.triangles[index as usize].map(|Vector(corner)| Vector(from_there.transform(corner)));
        let room = other.tree.root_aabb();
        let near = moved(&room, &from_there.inverse());
        let corners = self.tree.intersect_aabb(&near).flat_map(seen);
        let corners: Vec<Vector> = corners.filter(|corner| room.contains_local_point(narrow(*corner))).collect();
        let some = corners.iter().step_by(corners.len().div_ceil(most).max(1));
        some.filter(|corner| other.holds(**corner)).map(|corner| other.depth_of(*corner, its)).reduce(deeper)
    }

    /// How a point of something else that is inside, in the frame of the link, meets the surface: the point comes first.
    fn depth_of(&self, point: Vector, at: &Pose) -> Meeting {
        let nearest = self.triangles.iter().map(|triangle| nearest(triangle, point));
        let nearest = nearest.min_by(|a, b| (*a - point).length().total_cmp(&(*b - point).length())).unwrap_or(point);
        let inwards = (point - nearest).direction().unwrap_or(Vector::AXES[2]);
        Meeting {
            depth_m: (point - nearest).length(),
            normal: Vector(at.rotate(inwards.0)),
            at: Vector(at.transform(point.0)),
        }
    }

    /// Whether a point is inside, in the frame of the link: the surface takes the whole of what is seen from there (Van Oosterom and Strackee 1983).
    fn holds(&self, point: Vector) -> bool {
        let seen = |triangle: &[Vector; 3]| {
            let [a, b, c] = triangle.map(|corner| corner - point);
            let (x, y, z) = (a.length(), b.length(), c.length());
            let below = x * y * z + a.dot(b) * z + b.dot(c) * x + c.dot(a) * y;
            2.0 * a.dot(b.cross(c)).atan2(below)
        };
        self.triangles.iter().map(seen).sum::<f64>().abs() > 2.0 * PI
    }
}

/// The same, with the other one first.
fn turned(meeting: Meeting) -> Meeting {
    Meeting { normal: -meeting.normal, ..meeting }
}

fn deeper(a: Meeting, b: Meeting) -> Meeting {
    if b.depth_m > a.depth_m { b } else { a }
}

fn narrow(Vector(v): Vector) -> Vector32 {
    Vector32::from_array(v.map(|c| c as f32))
}

/// The box around points.
fn around(points: &[Vector], more_m: f64) -> Aabb {
    Aabb::from_points(points.iter().map(|point| narrow(*point))).loosened((more_m + ROUNDED_M) as f32)
}

/// A box as seen from another frame, by its pose there, with a box around it.
fn moved(aabb: &Aabb, pose: &Pose) -> Aabb {
    aabb.transform_by(&to_f32(pose)).loosened(ROUNDED_M as f32)
}

/// The box in a frame that holds something convex and `more_m` metres around it.
fn extent(convex: &Convex, frame: &Pose, more_m: f64) -> Aabb {
    let reach = |way: Vector| {
        let along = Vector(frame.rotate(way.0));
        (convex.farthest(along) - Vector(frame.position)).dot(along) + convex.radius
    };
    let most = Vector(Vector::AXES.map(reach));
    let least = Vector(Vector::AXES.map(|axis| -reach(-axis)));
    around(&[least, most], more_m)
}

/// The point of a triangle that is nearest to another.
fn nearest(triangle: &[Vector; 3], to: Vector) -> Vector {
    let [a, b, c] = *triangle;
    let edges = [[a, b], [b, c], [c, a]];
    if let Some(across) = (b - a).cross(c - a).direction() {
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
