//! Distance of two shapes: the one number that decides whether they touch.
//!
//! parry3d answers that three times (`intersection_test`, `distance`, `contact`), in `f32`, and the answers contradict each other. For cylinders
//! and capsules they are off by up to a centimetre, in both directions: its search stops where rounding keeps it from a nearer point. So the
//! search of Gilbert, Johnson and Keerthi (GJK, 1988) is done here in `f64`. It goes on until a direction proves that the shapes are no nearer. If
//! it has to give up, the result is the largest distance that is proven. Balls and capsules are a point and a segment with a radius, which is
//! exact. Of a mesh only the surface counts; the trees of parry3d find the triangles that matter, for two meshes both at once.

use crate::mesh::ConvexPiece;
use crate::vector::Vector;
use glam::DMat3;
use parry3d::bounding_volume::Aabb;
use parry3d::math::{Pose as Pose32, Vector as Vector32};
use parry3d::partitioning::BvhNode;
use parry3d::query::{self, DefaultQueryDispatcher, PointQuery, QueryDispatcher};
use parry3d::shape::{Shape, TriMesh};
use std::cell::Cell;

/// Maximum number of steps of a search. Shapes whose sizes differ by a factor of a hundred take forty.
const MAX_STEPS: usize = 128;

/// Error of a distance: in metres, and as a fraction of it.
const ROUNDED_M: f64 = 1e-7;
const ROUNDED: f64 = 1e-6;

/// Points nearer to each other than this count as the same, in metres.
const SAME_M: f64 = 1e-10;

/// Error of parry3d's distance for shapes that touch, in metres.
const ROUGH_M: f32 = 0.02;

/// Four corners lie in a plane if their volume is a smaller fraction than this of the volume of a box with their edges.
const FLAT: f64 = 1e-12;

/// Distance of two shapes in metres, or any value greater than `enough_m` if it is more than that. Zero or less if they touch: then [`depth`]
/// returns the penetration. `None` if it cannot be computed.
pub fn gap(a_at: &Pose32, a: &dyn Shape, b_at: &Pose32, b: &dyn Shape, enough_m: f64) -> Option<f64> {
    gap_in_first(&a_at.inv_mul(b_at), a, b, enough_m, &Cell::new(u32::MAX))
}

/// As [`gap`], with at most `left` searches: one for each pair of triangles, or of a triangle and another shape, that is compared. The searches
/// made are subtracted from `left`; if it becomes 0, the gap could not be computed.
pub fn gap_within([a_at, b_at]: [&Pose32; 2], [a, b]: [&dyn Shape; 2], enough_m: f64, left: &mut u32) -> Option<f64> {
    let searches = Cell::new(*left);
    let gap = gap_in_first(&a_at.inv_mul(b_at), a, b, enough_m, &searches);
    *left = searches.get();
    gap.filter(|_| *left > 0)
}

/// Penetration of two shapes that touch, in metres: the shortest translation that separates them. The result may be more than that; it is never
/// less if neither is a mesh. Of a mesh it is the greatest penetration of one of its triangles.
pub fn depth(a_at: &Pose32, a: &dyn Shape, b_at: &Pose32, b: &dyn Shape) -> f64 {
    let pose = a_at.inv_mul(b_at);
    let contact = DefaultQueryDispatcher.contact(&pose, a, b, ROUGH_M).ok().flatten();
    let (Some(first), Some(second)) = (Round::of(a), Round::of(b)) else {
        return contact.map_or(0.0, |contact| f64::from(-contact.dist).max(0.0));
    };
    let second = Turned::new(second, &pose);
    let radii = first.radius + second.round.radius;
    let cores = cores_apart(&first.core, &second, radii);
    if cores > 0.0 {
        return (radii - cores).max(0.0);
    }
    let found = contact.map(|contact| contact.normal1.as_dvec3());
    least_overlap(&first, &second, found).map_or(0.0, |(_, overlap)| overlap.max(0.0))
}

/// Penetration of a convex piece of a mesh in a primitive, in metres: the overlap along the direction, of those across faces of either and away from
/// the axes of the primitive, along which it is least. It may be more than the shortest translation that separates them. 0 or less if they are
/// apart, `None` if the other shape is no primitive.
pub(crate) fn depth_of_piece(a_at: &Pose32, piece: &ConvexPiece, b_at: &Pose32, b: &dyn Shape) -> Option<f64> {
    let second = Turned::new(Round::of(b)?, &a_at.inv_mul(b_at));
    let extent = |way: Vector| {
        piece.corners.iter().map(|corner| way.dot(Vector::from(*corner))).fold(f64::NEG_INFINITY, f64::max)
    };
    let middle = piece.corners.iter().map(|corner| Vector::from(*corner)).sum::<Vector>() / piece.corners.len() as f64;
    let faces = second.round.core.axes().into_iter().map(|axis| second.rotate(axis));
    let away = second.round.core.lines().into_iter().map(|line| aside(second.at - middle, second.rotate(line)));
    let ways = faces.chain(away).chain([second.at - middle]).flat_map(|way| [way, -way]);
    let overlap = |way: Vector| {
        let way = direction(way)?;
        Some(extent(way) + second.along(-way))
    };
    ways.chain(piece.normals.iter().copied()).filter_map(overlap).min_by(f64::total_cmp)
}

/// Direction of the shortest known translation that moves the first of two touching shapes out of the other, a unit vector in the world frame.
/// `None` if none is known.
pub fn way_out(a_at: &Pose32, a: &dyn Shape, b_at: &Pose32, b: &dyn Shape) -> Option<[f64; 3]> {
    let pose = a_at.inv_mul(b_at);
    let contact = DefaultQueryDispatcher.contact(&pose, a, b, ROUGH_M).ok().flatten();
    let found = contact.map(|contact| contact.normal1.as_dvec3());
    let to_second = match (Round::of(a), Round::of(b)) {
        (Some(first), Some(second)) => least_overlap(&first, &Turned::new(second, &pose), found)?.0,
        _ => found?,
    };
    direction((a_at.rotation * -to_second.as_vec3()).as_dvec3()).map(|way| way.to_array())
}

/// The direction along which two shapes overlap least, and the overlap: the second shape leaves the first that way. The direction is a unit vector
/// in the frame of the first shape. All directions that can be it are tried, and `found`.
fn least_overlap(first: &Round, second: &Turned, found: Option<Vector>) -> Option<(Vector, f64)> {
    let turned = |axes: Vec<Vector>| axes.into_iter().map(|axis| second.rotate(axis)).collect::<Vec<Vector>>();
    let (lines, its) = (first.core.lines(), turned(second.round.core.lines()));
    // Across faces, across pairs of edges or axes of both, away from an axis, and from middle to middle. Along any direction the overlap is an
    // upper bound of the penetration.
    let faces = [first.core.axes(), turned(second.round.core.axes())].concat();
    let across = lines.iter().flat_map(|line| its.iter().map(|other| line.cross(*other)));
    let away = lines.iter().chain(&its).map(|line| aside(second.at, *line));
    let ways = faces.into_iter().chain(across).chain(away).chain([second.at, Vector::X]).chain(found);
    let ways = ways.flat_map(|way| [way, -way]);
    let overlap = |way: Vector| {
        let way = direction(way)?;
        Some((way, first.along(way) + second.along(-way)))
    };
    ways.filter_map(overlap).min_by(|(_, a), (_, b)| a.total_cmp(b))
}

/// The part of a vector that is perpendicular to a line.
fn aside(vector: Vector, line: Vector) -> Vector {
    vector - line * (vector.dot(line) / line.length_squared().max(f64::MIN_POSITIVE))
}

/// The unit vector of a direction; `None` where the vector is too short to have one.
fn direction(way: Vector) -> Option<Vector> {
    let length = way.length();
    (length > SAME_M).then(|| way / length)
}

/// As [`gap`], with the pose of the second shape in the frame of the first.
fn gap_in_first(pose: &Pose32, a: &dyn Shape, b: &dyn Shape, enough_m: f64, searches: &Cell<u32>) -> Option<f64> {
    if let (Some(first), Some(second)) = (Round::of(a), Round::of(b)) {
        searches.set(searches.get().checked_sub(1)?);
        return Some(between(&first, &Turned::new(second, pose), enough_m));
    }
    match (a.as_trimesh(), b.as_trimesh()) {
        (Some(first), Some(second)) => Some(gap_of_meshes(pose, first, second, enough_m, searches)),
        (Some(mesh), None) => Some(gap_to_mesh(pose, mesh, b, enough_m, searches)),
        (None, Some(mesh)) => Some(gap_to_mesh(&pose.inverse(), mesh, a, enough_m, searches)),
        (None, None) => query::distance(&Pose32::IDENTITY, a, pose, b).ok().map(|apart| f64::from(apart.distance)),
    }
}

/// Distance of the surface of a mesh from another shape.
fn gap_to_mesh(pose: &Pose32, mesh: &TriMesh, other: &dyn Shape, enough_m: f64, searches: &Cell<u32>) -> f64 {
    // The tree rounds to `f32`.
    let beyond = (enough_m * (1.0 + ROUNDED) + ROUNDED_M) as f32;
    let around = other.compute_aabb(pose);
    let (middle, half) = (around.center(), around.half_extents());
    let nearest = mesh.bvh().find_best(
        beyond,
        |node, _| Aabb { mins: node.mins() - middle - half, maxs: node.maxs() - middle + half }.distance_to_origin(),
        // If the distance of a triangle cannot be computed it counts as touching; then no other triangle is tried.
        |triangle, best| {
            let gap = gap_in_first(pose, &mesh.triangle(triangle), other, f64::from(best), searches);
            Some(gap.unwrap_or(0.0) as f32)
        },
    );
    f64::from(nearest.map_or(beyond, |(_, gap)| gap))
}

/// Distance of the surfaces of two meshes, with the pose of the second in the frame of the first.
fn gap_of_meshes(pose: &Pose32, first: &TriMesh, second: &TriMesh, enough_m: f64, searches: &Cell<u32>) -> f64 {
    // The trees round to `f32`.
    let beyond = (enough_m * (1.0 + ROUNDED) + ROUNDED_M) as f32;
    let best = Cell::new(beyond.min(some_gap(pose, first, second)));
    let axes = [Vector32::X, Vector32::Y, Vector32::Z].map(|axis| pose.rotation * axis);
    let are_near = |a: &BvhNode, b: &BvhNode| {
        let (mine, its) = (a.aabb(), b.aabb());
        let half = its.half_extents();
        let around = axes[0].abs() * half.x + axes[1].abs() * half.y + axes[2].abs() * half.z;
        let middle = pose.transform_point(its.center()) - mine.center();
        let between = (middle.abs() - around - mine.half_extents()).max(Vector32::ZERO);
        between.length() <= best.get() + ROUNDED_M as f32
    };
    for (a, b) in first.bvh().leaf_pairs(second.bvh(), are_near) {
        let enough_m = f64::from(best.get());
        // If the distance of two triangles cannot be computed they count as touching; then no others are tried.
        let gap = gap_in_first(pose, &first.triangle(a), &second.triangle(b), enough_m, searches).unwrap_or(0.0) as f32;
        best.set(best.get().min(gap));
        if best.get() <= 0.0 {
            break;
        }
    }
    f64::from(best.get())
}

/// Upper bound of the distance of two meshes: the distance of two of their points, each near the other mesh.
fn some_gap(pose: &Pose32, first: &TriMesh, second: &TriMesh) -> f32 {
    let middle = pose.transform_point(second.local_aabb().center());
    let on_first = first.project_local_point(middle, false).point;
    let on_second = second.project_local_point(pose.inverse_transform_point(on_first), false).point;
    let on_second = pose.transform_point(on_second);
    let on_first = first.project_local_point(on_second, false).point;
    (on_first - on_second).length() * (1.0 + ROUNDED as f32) + ROUNDED_M as f32
}

/// The core of a rounded shape.
#[derive(Debug, Clone, Copy)]
enum Core {
    Point,
    Segment([Vector; 2]),
    Triangle([Vector; 3]),
    /// Half extents.
    Box(Vector),
    /// Along y: radius and half length.
    Cylinder(f64, f64),
}

/// All points within a radius of a core.
#[derive(Debug, Clone, Copy)]
struct Round {
    core: Core,
    radius: f64,
}

/// A rounded shape in the frame of another one.
#[derive(Debug, Clone, Copy)]
struct Turned {
    round: Round,
    /// Its columns are the axes of its frame.
    axes: DMat3,
    at: Vector,
}

impl Core {
    /// The support point: the farthest along a direction.
    fn farthest(&self, way: Vector) -> Vector {
        let farthest = |corners: &[Vector]| {
            corners.iter().copied().max_by(|a, b| a.dot(way).total_cmp(&b.dot(way))).unwrap_or_default()
        };
        match self {
            Core::Point => Vector::ZERO,
            Core::Segment(ends) => farthest(ends),
            Core::Triangle(corners) => farthest(corners),
            Core::Box(half) => half.copysign(way),
            Core::Cylinder(radius, half_length) => {
                let aside = way.x.hypot(way.z);
                let out = if aside > 0.0 { radius / aside } else { 0.0 };
                Vector::new(way.x * out, half_length.copysign(way.y), way.z * out)
            }
        }
    }

    /// Directions of its edges, or its axis.
    fn lines(&self) -> Vec<Vector> {
        match self {
            Core::Point => Vec::new(),
            Core::Segment([a, b]) => vec![*b - *a],
            Core::Triangle([a, b, c]) => vec![*b - *a, *c - *b, *a - *c],
            Core::Box(_) => Vector::AXES.to_vec(),
            Core::Cylinder(..) => vec![Vector::Y],
        }
    }

    /// Normals of its faces.
    fn axes(&self) -> Vec<Vector> {
        match self {
            Core::Point | Core::Segment(_) => Vec::new(),
            Core::Triangle([a, b, c]) => vec![(*b - *a).cross(*c - *a)],
            Core::Box(_) => Vector::AXES.to_vec(),
            Core::Cylinder(..) => vec![Vector::Y],
        }
    }
}

impl Round {
    fn of(shape: &dyn Shape) -> Option<Round> {
        let sharp = |core: Core| Some(Round { core, radius: 0.0 });
        if let Some(ball) = shape.as_ball() {
            return Some(Round { core: Core::Point, radius: f64::from(ball.radius) });
        }
        if let Some(capsule) = shape.as_capsule() {
            let core = Core::Segment([capsule.segment.a, capsule.segment.b].map(Vector32::as_dvec3));
            return Some(Round { core, radius: f64::from(capsule.radius) });
        }
        if let Some(cuboid) = shape.as_cuboid() {
            return sharp(Core::Box(cuboid.half_extents.as_dvec3()));
        }
        if let Some(cylinder) = shape.as_cylinder() {
            return sharp(Core::Cylinder(f64::from(cylinder.radius), f64::from(cylinder.half_height)));
        }
        let triangle = shape.as_triangle()?;
        sharp(Core::Triangle([triangle.a, triangle.b, triangle.c].map(Vector32::as_dvec3)))
    }

    /// Extent of the shape along a unit vector.
    fn along(&self, way: Vector) -> f64 {
        self.core.farthest(way).dot(way) + self.radius
    }
}

impl Turned {
    fn new(round: Round, pose: &Pose32) -> Turned {
        // After rounding to `f32` the quaternion is not exactly of length 1.
        let axes = DMat3::from_quat(pose.rotation.as_dquat().normalize());
        Turned { round, axes, at: pose.translation.as_dvec3() }
    }

    fn rotate(&self, vector: Vector) -> Vector {
        self.axes * vector
    }

    /// The support point of the core: the farthest along a direction.
    fn farthest(&self, way: Vector) -> Vector {
        self.rotate(self.round.core.farthest(self.axes.mul_transpose_vec3(way))) + self.at
    }

    fn along(&self, way: Vector) -> f64 {
        self.farthest(way).dot(way) + self.round.radius
    }
}

/// Distance of two rounded shapes, or more than `enough_m`: that of their cores minus the radii.
fn between(a: &Round, b: &Turned, enough_m: f64) -> f64 {
    let radii = a.radius + b.round.radius;
    cores_apart(&a.core, b, enough_m + radii) - radii
}

/// Distance of two cores: that of the origin from their Minkowski difference, all `p - q` with `p` in one and `q` in the other.
fn cores_apart(a: &Core, b: &Turned, enough_m: f64) -> f64 {
    let farthest = |way: Vector| a.farthest(way) - b.farthest(-way);
    let mut simplex = Simplex::default();
    let mut nearest = farthest(if b.at.length() > SAME_M { b.at } else { Vector::X });
    simplex.add(nearest);
    // Lower bound of the distance of the difference from the origin.
    let mut least: f64 = 0.0;
    for _ in 0..MAX_STEPS {
        let far = nearest.length();
        if far <= SAME_M {
            return 0.0;
        }
        let corner = farthest(-nearest);
        least = least.max(corner.dot(nearest) / far);
        if least > enough_m || far - least <= ROUNDED_M + ROUNDED * far || simplex.has(&corner) {
            return least;
        }
        simplex.add(corner);
        nearest = simplex.reduce();
        if simplex.count == 4 {
            return 0.0;
        }
        if nearest.length() >= far {
            return least;
        }
    }
    least
}

/// Up to four points whose hull approaches the origin.
#[derive(Debug, Clone, Copy, Default)]
struct Simplex {
    corners: [Vector; 4],
    count: usize,
}

impl Simplex {
    fn corners(&self) -> &[Vector] {
        &self.corners[..self.count]
    }

    fn add(&mut self, corner: Vector) {
        self.corners[self.count] = corner;
        self.count += 1;
    }

    fn has(&self, corner: &Vector) -> bool {
        self.corners().contains(corner)
    }

    /// Returns the point of the hull that is nearest to the origin, and keeps only the corners of the smallest face that it is on; all four if the
    /// origin is inside.
    fn reduce(&mut self) -> Vector {
        let (mut nearest, mut least, mut face) = (Vector::ZERO, f64::INFINITY, 0);
        for chosen in 1..1_usize << self.count {
            let point = match nearest_on(&self.chosen(chosen)) {
                Some(point) => point,
                None => continue,
            };
            let far = point.length_squared();
            if far < least {
                (nearest, least, face) = (point, far, chosen);
            }
        }
        *self = self.chosen(face);
        nearest
    }

    /// The corners of the set bits.
    fn chosen(&self, bits: usize) -> Simplex {
        let mut chosen = Simplex::default();
        (0..self.count).filter(|i| bits >> i & 1 == 1).for_each(|i| chosen.add(self.corners[i]));
        chosen
    }
}

/// The point of the plane through all corners that is nearest to the origin, if it is between them; the origin itself if it is inside of four.
fn nearest_on(simplex: &Simplex) -> Option<Vector> {
    let corners = simplex.corners();
    let first = *corners.first()?;
    let edge = |i: usize| corners[i] - first;
    match simplex.count {
        1 => Some(first),
        2 => {
            let a = edge(1);
            let u = -first.dot(a) / a.length_squared();
            (u > 0.0 && u < 1.0).then(|| first + a * u)
        }
        3 => {
            let (a, b) = (edge(1), edge(2));
            let normal = a.cross(b);
            let square = normal.length_squared();
            // Cramer's rule in the plane of the triangle.
            let u = -first.cross(b).dot(normal) / square;
            let v = first.cross(a).dot(normal) / square;
            let is_between = u > 0.0 && v > 0.0 && u + v < 1.0;
            is_between.then(|| normal * (first.dot(normal) / square))
        }
        _ => {
            let (a, b, c) = (edge(1), edge(2), edge(3));
            let volume = a.dot(b.cross(c));
            if volume.abs() < FLAT * a.length() * b.length() * c.length() {
                return None;
            }
            let share = |x: Vector, y: Vector| -first.dot(x.cross(y)) / volume;
            let (u, v, w) = (share(b, c), share(c, a), share(a, b));
            (u > 0.0 && v > 0.0 && w > 0.0 && u + v + w < 1.0).then_some(Vector::ZERO)
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::{depth, gap, gap_within};
    use crate::geometry::Geometry;
    use crate::mesh::Mesh;
    use crate::robot::to_f32;
    use rand::{Rng, RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use ratn_model::pose::Pose;

    type Point = [f64; 3];

    fn plus(a: Point, b: Point, by: f64) -> Point {
        std::array::from_fn(|i| a[i] + by * b[i])
    }

    fn dot(a: Point, b: Point) -> f64 {
        (0..3).map(|i| a[i] * b[i]).sum()
    }

    #[derive(Debug, Clone, Copy)]
    struct Solid {
        geometry: Geometry,
        /// Its axis along z.
        pose: Pose,
    }

    impl Solid {
        /// The point of the solid that is nearest to `to`.
        fn nearest(&self, to: Point) -> Point {
            let [x, y, z] = self.pose.inverse().transform(to);
            let about = |middle: Point, radius: f64, at: Point| {
                let off = plus(at, middle, -1.0);
                let far = dot(off, off).sqrt();
                if far <= radius { at } else { plus(middle, off, radius / far) }
            };
            let local = match self.geometry {
                Geometry::Box { half: [a, b, c] } => [x.clamp(-a, a), y.clamp(-b, b), z.clamp(-c, c)],
                Geometry::Cylinder { radius, half_length } => {
                    let [x, y, _] = about([0.0; 3], radius, [x, y, 0.0]);
                    [x, y, z.clamp(-half_length, half_length)]
                }
                Geometry::Capsule { radius, half_length } => {
                    about([0.0, 0.0, z.clamp(-half_length, half_length)], radius, [x, y, z])
                }
                Geometry::Sphere { radius } => about([0.0; 3], radius, [x, y, z]),
            };
            self.pose.transform(local)
        }

        /// Extent of the solid along a direction.
        fn along(&self, way: Point) -> f64 {
            let [x, y, z] = self.pose.inverse().rotate(way);
            let local = match self.geometry {
                Geometry::Box { half: [a, b, c] } => a * x.abs() + b * y.abs() + c * z.abs(),
                Geometry::Cylinder { radius, half_length } => radius * x.hypot(y) + half_length * z.abs(),
                Geometry::Capsule { radius, half_length } => radius + half_length * z.abs(),
                Geometry::Sphere { radius } => radius,
            };
            local + dot(self.pose.position, way)
        }

        fn grown(&self, by: f64) -> Solid {
            Solid { geometry: self.geometry.grown(by), ..*self }
        }

        fn random(random: &mut impl Rng) -> Solid {
            let mut length = || 10_f64.powf(random.random_range(-2.3..-0.4));
            let (a, b, c) = (length(), length(), length());
            let geometry = match random.random_range(0..4) {
                0 => Geometry::Box { half: [a, b, c] },
                1 => Geometry::Cylinder { radius: a, half_length: b },
                2 => Geometry::Capsule { radius: a, half_length: b },
                _ => Geometry::Sphere { radius: a },
            };
            let mut angle = || random.random_range(-3.2..3.2);
            let (roll, pitch, yaw) = (angle(), angle(), angle());
            let position = std::array::from_fn(|_| random.random_range(-1.0..1.0));
            Solid { geometry, pose: Pose::from_rpy(position, roll, pitch, yaw) }
        }
    }

    /// Points of two solids, as near to each other as alternating projections bring them.
    fn near(a: &Solid, b: &Solid, times: usize) -> [Point; 2] {
        let (mut p, mut q) = (a.pose.position, b.pose.position);
        for _ in 0..times {
            q = b.nearest(p);
            p = a.nearest(q);
        }
        [p, q]
    }

    #[test]
    fn shapes_are_as_far_apart_as_they_were_put_and_those_that_overlap_touch() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (mut apart, mut touching) = (0, 0);
        for _ in 0..40_000 {
            let (a, mut b) = (Solid::random(&mut random), Solid::random(&mut random));
            let [p, q] = near(&a, &b, 200);
            let way = plus(q, p, -1.0);
            let far = dot(way, way).sqrt();
            let way = way.map(|c| c / far);
            // A plane across the direction between them proves a minimum distance.
            let sure = -b.along(way.map(|c| -c)) - a.along(way);
            if far < 1e-3 || far - sure > 1e-7 {
                continue;
            }
            let wanted = [1e-2, 1e-3, 1e-4, 1e-5, 2e-6, -2e-6, -1e-5, -1e-4, -1e-3, -1e-2][random.random_range(0..10)];
            b.pose.position = plus(b.pose.position, way, wanted - far);
            let (body, other) = (a.geometry.at(a.pose), b.geometry.at(b.pose));
            let (at, of) = (to_f32(&body.pose), to_f32(&other.pose));
            let (shape, its) = (body.geometry.shape(0.0), other.geometry.shape(0.0));
            let found = gap(&at, &*shape, &of, &*its, 0.1).unwrap();
            let is_least = |m: f64| gap(&at, &*shape, &of, &*its, m).unwrap();
            if wanted > 0.0 {
                apart += 1;
                assert!((found - wanted).abs() < 2e-6, "{found} instead of {wanted}: {a:?} {b:?}");
                assert!(is_least(wanted / 2.0) > wanted / 2.0 && is_least(0.0) > 0.0, "{wanted}: {a:?} {b:?}");
            } else if let [p, q] = near(&a.grown(wanted / 4.0), &b.grown(wanted / 4.0), 400)
                && dot(plus(q, p, -1.0), plus(q, p, -1.0)).sqrt() < 1e-9
            {
                touching += 1;
                assert!(found <= 0.0, "{found} instead of {wanted}: {a:?} {b:?}");
                let deep = depth(&at, &*shape, &of, &*its);
                // Both shapes were made smaller by a quarter of it: no separating translation is shorter than two quarters.
                assert!(deep > -0.4 * wanted, "{deep} instead of {wanted}: {a:?} {b:?}");
            }
        }
        assert!(apart > 5_000 && touching > 2_000, "{apart} {touching}");
    }

    #[test]
    fn the_work_of_two_meshes_has_a_bound() {
        // Two wavy surfaces whose waves run parallel.
        let height = |i: u32| f64::from(i % 2) * 1e-3;
        let at = |i: u32, j: u32| [f64::from(i) * 0.01, f64::from(j) * 0.01, height(i)];
        let cells = (0..20).flat_map(|i| (0..20).map(move |j| (i, j)));
        let triangles = cells.flat_map(|(i, j)| {
            [[at(i, j), at(i + 1, j), at(i, j + 1)], [at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)]]
        });
        let surface = Mesh::new(triangles.collect()).unwrap().surface();
        let (here, above) = (to_f32(&Pose::IDENTITY), to_f32(&Pose::at(0.0, 0.0, 0.002)));
        let within = |left: &mut u32| gap_within([&here, &above], [&*surface, &*surface], 0.1, left);
        let mut left = 1_000_000;
        let found = within(&mut left).unwrap();
        assert_eq!(Some(found), gap(&here, &*surface, &above, &*surface, 0.1));
        let made = 1_000_000 - left;
        assert!(made > 100, "{made}");
        let mut left = made / 2;
        assert_eq!((within(&mut left), left), (None, 0));
    }

    #[test]
    fn shapes_that_hardly_overlap_are_hardly_deep_in_each_other() {
        let at = |x: f64, y: f64, z: f64, roll: f64| Pose::from_rpy([x, y, z], roll, 0.0, 0.0);
        let deep = |a: Geometry, a_at: Pose, b: Geometry, b_at: Pose| {
            let (a, b) = (a.at(a_at), b.at(b_at));
            depth(&to_f32(&a.pose), &*a.geometry.shape(0.0), &to_f32(&b.pose), &*b.geometry.shape(0.0))
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        let bottle = Geometry::Cylinder { radius: 0.03, half_length: 0.1 };
        let side_by_side = deep(bottle, at(0.0, 0.0, 0.0, 0.0), bottle, at(0.055, 0.0, 0.05, 0.0));
        assert!((side_by_side - 0.005).abs() < 1e-4, "{side_by_side}");
        let bar = Geometry::Capsule { radius: 0.005, half_length: 0.1 };
        let crossing = deep(bar, at(0.0, 0.0, 0.0, 0.0), bar, at(0.0, 0.0, 0.0, quarter));
        assert!((crossing - 0.01).abs() < 1e-4, "{crossing}");
        let same = deep(bar, at(0.0, 0.0, 0.0, 0.0), bar, at(0.0, 0.0, 0.0, 0.0));
        assert!((same - 0.01).abs() < 1e-4, "{same}");
        let beam = Geometry::Box { half: [0.02, 0.02, 0.1] };
        let edges = deep(beam, at(0.0, 0.0, 0.0, 0.0), beam, at(0.039, 0.0, 0.0, quarter));
        assert!((edges - 0.001).abs() < 1e-4, "{edges}");
    }
}
