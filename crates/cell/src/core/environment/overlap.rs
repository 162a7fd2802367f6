//! Penetration depth of two convex shapes, or their distance, by a search over all directions.
//!
//! Along a direction n the shapes overlap by `h(n)`: how far the first reaches along n beyond where the second begins. Translated by that much
//! along n, the second shape is free of the first. So the minimum of `h(n)` over all directions is the penetration depth, and if it is negative,
//! its absolute value is the distance. The minimum is found by branch and bound (Land and Doig 1960): the directions are split into ever smaller
//! triangles, and each triangle has a lower bound of its `h(n)`. The search ends when no triangle is left in which `h(n)` could be less by
//! [`PRECISE_M`].
//!
//! The bound. All differences `p` of a point of the first shape and one of the second satisfy `h(n) >= n·p`. Three of them, the farthest along the
//! corners `u` of a triangle, define a matrix game: one player chooses n and wants the greatest of its `n·p` to be as small as possible. The value
//! of that game (von Neumann 1928), with the payoffs `u·p`, is the bound: n is a sum of the corners whose weights add up to at least one.
//!
//! Nothing of this is shared with the planner's distances, which work the other way: from points inwards.

use super::convex::Convex;
use super::polygon::Polygon;
use super::vector::{Vector, direction};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// A contact of two shapes, or their distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Meeting {
    /// Penetration depth in metres; negative: the distance.
    pub(super) depth_m: f64,
    /// Unit vector from the first shape to the second: along it they separate.
    pub(super) normal: Vector,
    /// A point between them.
    pub(super) at: Vector,
}

impl Meeting {
    /// The same with the two shapes exchanged.
    pub(super) fn turned(self) -> Meeting {
        Meeting { normal: -self.normal, ..self }
    }
}

/// Error of a depth in metres, and of the distance of two cores as a fraction of it, so that directions between near cores are precise, too.
const PRECISE_M: f64 = 1e-5;
const PRECISE: f64 = 1e-4;
const SMALLEST_M: f64 = 1e-8;

/// Maximum number of triangles of a search. Most pairs take some hundred; a rod in the middle of a tube takes ten thousand. The value found by
/// then is an upper bound of the depth.
const MAX_TRIANGLES: usize = 20_000;

/// Tolerance for a point to be on a face, in metres: for the position of a contact, and for the proof of a distance.
const FACE_M: f64 = 1e-3;
const EXACT_M: f64 = 1e-8;

/// Points nearer to each other than this count as the same, in metres.
const SAME_M: f64 = 1e-6;

/// Number of steps towards a point between two faces.
const STEPS: usize = 32;

/// The contact of two shapes, if they are no farther apart than `within_m` metres.
pub(super) fn meeting(a: &Convex, b: &Convex, within_m: f64) -> Option<Meeting> {
    let (radii, pair) = (a.radius + b.radius, Pair { a, b });
    let farthest = -within_m - radii;
    let mut least: Option<Corner> = None;
    for way in pair.guesses() {
        let corner = pair.along(way);
        if corner.overlap < farthest {
            return None;
        }
        if least.is_none_or(|least| corner.overlap < least.overlap) {
            least = Some(corner);
        }
    }
    let mut least = least.unwrap_or_else(|| pair.along(Vector::AXES[2]));
    let is_sure = match least.overlap < 0.0 {
        // Proven if two points are as near to each other as the direction proves that no points are nearer.
        true => apart(&across(a, b, least.way, EXACT_M)) <= SAME_M,
        // Overlapping shapes with flat faces separate along the normal of a face of one of them or along the cross product of two edges
        // (separating axes, Gottschalk, Lin and Manocha 1996).
        false => a.is_flat() && b.is_flat(),
    };
    if !is_sure {
        least = pair.search(least, farthest)?;
    }
    Some(Meeting { depth_m: least.overlap + radii, normal: least.way, at: place(a, b, least.way) })
}

struct Pair<'s> {
    a: &'s Convex,
    b: &'s Convex,
}

/// A direction, and the overlap of the cores along it.
#[derive(Debug, Clone, Copy)]
struct Corner {
    way: Vector,
    /// The difference of their points that is farthest along the direction.
    point: Vector,
    overlap: f64,
}

/// All directions between three corners.
#[derive(Debug, Clone, Copy)]
struct Triangle {
    corners: [Corner; 3],
    /// Lower bound of the overlap of the cores within the triangle.
    bound: f64,
}

impl Pair<'_> {
    fn along(&self, way: Vector) -> Corner {
        let point = self.a.farthest(way) - self.b.farthest(-way);
        Corner { way, point, overlap: point.dot(way) }
    }

    /// Directions along which shapes often separate.
    fn guesses(&self) -> impl Iterator<Item = Vector> {
        let (faces, others) = (self.a.across(), self.b.across());
        let (edges, its) = (self.a.edges(), self.b.edges());
        let between = self.b.middle - self.a.middle;
        let aside = |line: &Vector| Some(between.reject_from_normalized(direction(*line)?));
        let aside: Vec<Vector> = edges.iter().chain(&its).filter_map(aside).collect();
        let crossing =
            edges.into_iter().flat_map(move |edge| its.clone().into_iter().map(move |other| edge.cross(other)));
        let guesses = [between].into_iter().chain(faces).chain(others).chain(crossing).chain(aside);
        guesses.filter_map(direction).flat_map(|way| [way, -way])
    }

    /// The direction along which the cores overlap least; `None` if that is less than `farthest`.
    fn search(&self, mut least: Corner, farthest: f64) -> Option<Corner> {
        let [x, y, z] = Vector::AXES.map(|axis| [self.along(axis), self.along(-axis)]);
        let eighth = |i: usize| Triangle::new([x[i & 1], y[i >> 1 & 1], z[i >> 2]]);
        let mut open: BinaryHeap<Triangle> = (0..8).map(eighth).collect();
        for _ in 0..MAX_TRIANGLES {
            let Some(triangle) = open.pop() else { break };
            if triangle.bound >= least.low_enough() {
                break;
            }
            let middle = self.along(triangle.middle_of_longest());
            let across = triangle.across().map(|way| self.along(way));
            for corner in triangle.corners.into_iter().chain([middle]).chain(across) {
                if corner.overlap < least.overlap {
                    least = corner;
                }
            }
            if least.overlap < farthest {
                return None;
            }
            open.extend(triangle.halves(middle).into_iter().filter(|half| half.bound < least.low_enough()));
        }
        Some(least)
    }
}

impl Corner {
    /// Bounds at or above this need not be searched: they could improve the overlap only within the wanted precision.
    fn low_enough(&self) -> f64 {
        let precise = if self.overlap < 0.0 { (-PRECISE * self.overlap).max(SMALLEST_M) } else { PRECISE_M };
        self.overlap - precise.min(PRECISE_M)
    }
}

impl Triangle {
    fn new(corners: [Corner; 3]) -> Triangle {
        let value = value(&corners.map(|row| corners.map(|column| row.way.dot(column.point))));
        let [a, b, c] = corners.map(|corner| corner.way);
        // The weights of a direction between the corners add up to one at a corner, and to no more than `most()` anywhere.
        let most = || direction((b - a).cross(c - a)).map_or(f64::INFINITY, |across| 1.0 / across.dot(a).abs());
        Triangle { corners, bound: if value < 0.0 { value * most() } else { value } }
    }

    /// Index of the corner where its longest edge begins; the edge leads to the next corner.
    fn longest(&self) -> usize {
        let length = |i: &usize| (self.corners[*i].way - self.corners[(*i + 1) % 3].way).length();
        (0..3).max_by(|i, j| length(i).total_cmp(&length(j))).unwrap_or_default()
    }

    fn middle_of_longest(&self) -> Vector {
        let i = self.longest();
        let middle = self.corners[i].way + self.corners[(i + 1) % 3].way;
        direction(middle).unwrap_or(self.corners[i].way)
    }

    fn halves(&self, middle: Corner) -> [Triangle; 2] {
        let i = self.longest();
        let [a, b, c] = [0, 1, 2].map(|j| self.corners[(i + j) % 3]);
        [Triangle::new([a, middle, c]), Triangle::new([middle, b, c])]
    }

    /// The normal of the plane through its points, on the triangle's side: the normal of a face if the points are on one.
    fn across(&self) -> Option<Vector> {
        let [a, b, c] = self.corners.map(|corner| corner.point);
        let way = direction((b - a).cross(c - a))?;
        Some(if way.dot(self.corners[0].way) < 0.0 { -way } else { way })
    }
}

// The triangle with the lowest bound is split first.
impl Ord for Triangle {
    fn cmp(&self, other: &Triangle) -> Ordering {
        other.bound.total_cmp(&self.bound)
    }
}

impl PartialOrd for Triangle {
    fn partial_cmp(&self, other: &Triangle) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Triangle {
    fn eq(&self, other: &Triangle) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Triangle {}

/// Lower bound of a matrix game for the player who chooses columns, while the other chooses rows to make it small: the best guarantee of one
/// column, a mixture of two, or one of three.
fn value(payoffs: &[[f64; 3]; 3]) -> f64 {
    let sure = |weights: [f64; 3]| {
        let of = |row: &[f64; 3]| row[0] * weights[0] + row[1] * weights[1] + row[2] * weights[2];
        payoffs.iter().map(of).fold(f64::INFINITY, f64::min)
    };
    let mut best = f64::NEG_INFINITY;
    for j in 0..3 {
        let k = (j + 1) % 3;
        best = best.max(sure(std::array::from_fn(|i| if i == j { 1.0 } else { 0.0 })));
        for row in 0..3 {
            // The mixture for which two rows give the same.
            let [first, second] = [payoffs[row], payoffs[(row + 1) % 3]].map(|row| (row[j] - row[k], row[k]));
            let share = (second.1 - first.1) / (first.0 - second.0);
            if share > 0.0 && share < 1.0 {
                let weight = |i| {
                    if i == j {
                        share
                    } else if i == k {
                        1.0 - share
                    } else {
                        0.0
                    }
                };
                best = best.max(sure(std::array::from_fn(weight)));
            }
        }
    }
    // The mixture for which all three rows give the same.
    let [a, b, c] = payoffs.map(Vector::from);
    let weights = (a - b).cross(a - c);
    let shares = (weights / weights.element_sum()).to_array();
    if shares.iter().all(|share| *share >= 0.0) { best.max(sure(shares)) } else { best }
}

/// A point between two shapes that separate along a direction: in both contact faces, seen along it, or between their nearest points.
fn place(a: &Convex, b: &Convex, way: Vector) -> Vector {
    let (x, y) = way.any_orthonormal_pair();
    let at = across(a, b, way, FACE_M);
    let along = a.farthest(way).dot(way) + a.radius + b.farthest(-way).dot(way) - b.radius;
    (x * (at[0][0] + at[1][0]) + y * (at[0][1] + at[1][1]) + way * along) * 0.5
}

/// A point of each of the two contact faces, seen along a direction, near to each other; corners up to `within_m` behind count as on the face.
fn across(a: &Convex, b: &Convex, way: Vector, within_m: f64) -> [[f64; 2]; 2] {
    let (x, y) = way.any_orthonormal_pair();
    let seen = |face: Vec<Vector>| Polygon::around(face.iter().map(|p| [p.dot(x), p.dot(y)]).collect());
    let [mine, its] = [a.face(way, within_m), b.face(-way, within_m)].map(seen);
    let mut at = [mine.middle(); 2];
    for _ in 0..STEPS {
        at[1] = its.nearest(at[0]);
        at[0] = mine.nearest(at[1]);
    }
    at
}

fn apart([[ax, ay], [bx, by]]: &[[f64; 2]; 2]) -> f64 {
    (ax - bx).hypot(ay - by)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use rand::{Rng, RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rapier3d::math::{Pose as Pose32, Rotation, Vector as Vector32};
    use rapier3d::parry::shape::SharedShape;
    use std::f64::consts::PI;

    /// Shapes as in parry3d, given by their half extents.
    #[derive(Debug, Clone, Copy)]
    enum Form {
        Ball(f64),
        Box([f64; 3]),
        /// Along y: radius and half length.
        Cylinder(f64, f64),
        /// The same, with round ends.
        Capsule(f64, f64),
    }

    /// A form with a rotation about three axes and a position. Brute force uses only the distance of a point from it.
    #[derive(Debug, Clone, Copy)]
    struct Thing {
        form: Form,
        turn: [f64; 3],
        at: [f64; 3],
    }

    impl Thing {
        fn random(random: &mut impl Rng) -> Thing {
            let mut size = || *[0.004, 0.02, 0.05, 0.1, 0.3].get(random.random_range(0..5)).unwrap();
            let (a, b, c) = (size(), size(), size());
            let form = match random.random_range(0..7) {
                0 => Form::Ball(a),
                1 | 2 => Form::Box([a, b, c]),
                3 | 4 => Form::Cylinder(a, b),
                _ => Form::Capsule(a, b),
            };
            // Upright forms often touch in faces, lines and rims that coincide.
            let turn = match random.random_range(0..3) {
                0 => [0.0, 0.0, PI / 2.0].map(|c| c * f64::from(random.random_range(0..2))),
                _ => std::array::from_fn(|_| random.random_range(-PI..PI)),
            };
            Thing { form, turn, at: [0.0; 3] }
        }

        fn size(&self) -> f64 {
            match self.form {
                Form::Ball(radius) => radius,
                Form::Box([x, y, z]) => (x * x + y * y + z * z).sqrt(),
                Form::Cylinder(radius, half) => radius.hypot(half),
                Form::Capsule(radius, half) => radius + half,
            }
        }

        fn moved(&self, by: [f64; 3]) -> Thing {
            Thing { at: std::array::from_fn(|i| self.at[i] + by[i]), ..*self }
        }

        fn pose(&self) -> Pose32 {
            let [x, y, z] = self.turn.map(|c| c as f32);
            let axis = |axis: Vector32, by: f32| Rotation::from_axis_angle(axis, by);
            let turn = axis(Vector32::Z, z) * axis(Vector32::Y, y) * axis(Vector32::X, x);
            Pose32::from_parts(Vector32::from_array(self.at.map(|c| c as f32)), turn)
        }

        fn shape(&self) -> SharedShape {
            match self.form {
                Form::Ball(radius) => SharedShape::ball(radius as f32),
                Form::Box(half) => SharedShape::cuboid(half[0] as f32, half[1] as f32, half[2] as f32),
                Form::Cylinder(radius, half) => SharedShape::cylinder(half as f32, radius as f32),
                Form::Capsule(radius, half) => SharedShape::capsule_y(half as f32, radius as f32),
            }
        }

        fn convex(&self) -> Convex {
            Convex::of(&*self.shape(), &self.pose()).unwrap()
        }

        /// Converts a point to the frame of the form, or back.
        fn turned(&self, [x, y, z]: [f64; 3], back: bool) -> [f64; 3] {
            let about = |[x, y]: [f64; 2], by: f64| [x * by.cos() - y * by.sin(), x * by.sin() + y * by.cos()];
            let [rx, ry, rz] = self.turn;
            if back {
                let [y, z] = about([y, z], rx);
                let [z, x] = about([z, x], ry);
                let [x, y] = about([x, y], rz);
                return std::array::from_fn(|i| [x, y, z][i] + self.at[i]);
            }
            let [x, y, z] = [x - self.at[0], y - self.at[1], z - self.at[2]];
            let [x, y] = about([x, y], -rz);
            let [z, x] = about([z, x], -ry);
            let [y, z] = about([y, z], -rx);
            [x, y, z]
        }

        /// Signed distance of a point from its surface; negative inside.
        fn distance(&self, point: [f64; 3]) -> f64 {
            let [x, y, z] = self.turned(point, false);
            let beyond = |sides: &[f64]| {
                let out = sides.iter().map(|side| side.max(0.0).powi(2)).sum::<f64>().sqrt();
                out + sides.iter().copied().fold(f64::NEG_INFINITY, f64::max).min(0.0)
            };
            match self.form {
                Form::Ball(radius) => (x * x + y * y + z * z).sqrt() - radius,
                Form::Box([a, b, c]) => beyond(&[x.abs() - a, y.abs() - b, z.abs() - c]),
                Form::Cylinder(radius, half) => beyond(&[x.hypot(z) - radius, y.abs() - half]),
                Form::Capsule(radius, half) => {
                    let y = y - y.clamp(-half, half);
                    (x * x + y * y + z * z).sqrt() - radius
                }
            }
        }

        /// The nearest of its points to another point.
        fn nearest(&self, point: [f64; 3]) -> [f64; 3] {
            let [x, y, z] = self.turned(point, false);
            let within = |[x, y, z]: [f64; 3], radius: f64| {
                let far = (x * x + y * y + z * z).sqrt();
                [x, y, z].map(|c| if far > radius { c * radius / far } else { c })
            };
            let near = match self.form {
                Form::Ball(radius) => within([x, y, z], radius),
                Form::Box([a, b, c]) => [x.clamp(-a, a), y.clamp(-b, b), z.clamp(-c, c)],
                Form::Cylinder(radius, half) => {
                    let [x, _, z] = within([x, 0.0, z], radius);
                    [x, y.clamp(-half, half), z]
                }
                Form::Capsule(radius, half) => {
                    let on = y.clamp(-half, half);
                    let [x, y, z] = within([x, y - on, z], radius);
                    [x, y + on, z]
                }
            };
            self.turned(near, true)
        }

        /// The least signed distance of its points, found by random search, from the surface of another form; stops at the first that is `enough`.
        fn least(&self, other: &Thing, enough: f64, random: &mut impl Rng) -> f64 {
            // Alternating projections approach it slowly; random steps do the rest.
            let mut best = self.nearest(other.at);
            for _ in 0..2000 {
                let beside = other.nearest(best);
                let next = self.nearest(beside);
                let is_there = (Vector::from(next) - Vector::from(best)).length() < 1e-10;
                best = next;
                if is_there {
                    break;
                }
            }
            let mut step = self.size();
            let mut least = other.distance(best);
            while step > 1e-7 && least > enough {
                let mut is_better = false;
                for _ in 0..16 {
                    let tried = self.nearest(best.map(|c| c + step * random.random_range(-1.0..1.0)));
                    let far = other.distance(tried);
                    if far < least {
                        (best, least, is_better) = (tried, far, true);
                    }
                }
                step *= if is_better { 1.2 } else { 0.7 };
            }
            least
        }
    }

    fn away(way: [f64; 3], by: f64) -> [f64; 3] {
        way.map(|c| c * by)
    }

    fn direction(random: &mut impl Rng) -> [f64; 3] {
        loop {
            let way = Vector::from(std::array::from_fn(|_| random.random_range(-1.0..1.0)));
            if let Some(way) = super::direction(way).map(|way| way.to_array()).filter(|_| way.length() < 1.0) {
                return way;
            }
        }
    }

    /// Two forms near each other.
    fn pair(random: &mut impl Rng) -> [Thing; 2] {
        let (a, b) = (Thing::random(random), Thing::random(random));
        let mut b = b.moved(away(direction(random), random.random_range(0.0..a.size() + b.size())));
        // Most pairs hardly touch.
        let apart = a.least(&b, f64::NEG_INFINITY, random);
        if apart > 0.0 && random.random_range(0..4) > 0 {
            let way = meeting(&a.convex(), &b.convex(), f64::INFINITY).unwrap().normal.to_array();
            let wanted = *[1e-2, 1e-3, 2e-4, -2e-4, -1e-3, -1e-2].get(random.random_range(0..6)).unwrap();
            b = b.moved(away(way, wanted - apart));
        }
        // The shapes of the engine are `f32`.
        let rounded = |c: f64| f64::from(c as f32);
        [a, Thing { at: b.at.map(rounded), ..b }]
    }

    #[test]
    fn shapes_are_as_far_apart_or_as_deep_in_each_other_as_brute_force_finds() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let (mut apart, mut deep) = (0, 0);
        for _ in 0..PAIRS {
            let [a, b] = pair(&mut random);
            let found = meeting(&a.convex(), &b.convex(), f64::INFINITY).unwrap();
            let normal = found.normal.to_array();
            let off = [&a, &b].map(|thing| thing.distance(found.at.to_array()) - found.depth_m.abs() / 2.0);
            assert!(off.iter().all(|off| *off < 1e-2), "{found:?} is beside: {off:?} {a:?} {b:?}");
            // Moved by the depth that was found, the shapes are just free of each other.
            let freed = a.least(&b.moved(away(normal, found.depth_m + OFF_M)), f64::NEG_INFINITY, &mut random);
            assert!(freed > 0.0, "{found:?} is not enough: {freed} {a:?} {b:?}");
            if found.depth_m < 0.0 {
                apart += 1;
                let least = a.least(&b, f64::NEG_INFINITY, &mut random);
                assert!((least + found.depth_m).abs() < OFF_M, "{found:?} instead of {least}: {a:?} {b:?}");
                continue;
            }
            // No shorter translation separates them.
            let less = found.depth_m - OFF_M;
            if less > 0.0 {
                deep += 1;
                let ways: Vec<[f64; 3]> = (0..WAYS).map(|_| direction(&mut random)).chain([normal]).collect();
                for way in ways {
                    let still = a.least(&b.moved(away(way, less)), 0.0, &mut random);
                    assert!(still < OFF_M / 2.0, "{found:?}, and they are {still} apart along {way:?}: {a:?} {b:?}");
                }
            }
        }
        assert!(apart > PAIRS / 8 && deep > PAIRS / 4, "{apart} {deep}");
    }

    const PAIRS: usize = 400;
    const WAYS: usize = 20;
    /// Error of the random search, in metres.
    const OFF_M: f64 = 1e-4;
}
