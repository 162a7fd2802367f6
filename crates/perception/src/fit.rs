//! A model fitted to what was measured of one cluster: iterated closest points on the model's surface, with free space.
//!
//! Every measured point pulls the model's surface towards itself (point to surface; Chen and Medioni 1992, with the closest
//! point given by the signed distance instead of a search). Points alone would let a model grow behind its visible faces, so
//! every ray that reached the table beside the cluster pushes out what it would have to pass through. Both are least squares
//! over place, yaw and the model's own dimensions, by Levenberg and Marquardt, with weights that fade beyond a cut-off which
//! shrinks as the fit settles. Objects stand upright: the frame's z = 0 is the surface.

pub(crate) mod start;

use crate::model::{Model, ObjectClass, Symmetry};
use crate::normal::Normal;
use crate::vector::{Vector, length as length_of, sub};

/// What was measured of a cluster and around it, in the frame of the supporting surface.
#[derive(Debug, Clone)]
pub(crate) struct Evidence {
    /// Where the camera is.
    pub(crate) eye: Vector,
    /// Points of the cluster.
    pub(crate) points: Vec<Vector>,
    /// Where rays beside the cluster ended, at or below the surface.
    pub(crate) free: Vec<Vector>,
    /// Below this height points are not counted on: only those that noise has lifted were told from the surface.
    pub(crate) floor: f64,
    /// Standard deviation of a point, in metres.
    pub(crate) sigma: f64,
    /// The distance between neighbouring pixels at the cluster, in metres.
    pub(crate) pitch: f64,
}

/// A model in its place: z = 0 is below it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Fit {
    pub(crate) class: ObjectClass,
    /// x, y, yaw, and then the model's dimensions.
    parameters: Parameters,
}

/// How uncertain a fit is: variances and covariances of x, y, yaw; the variance of its height.
pub(crate) struct Covariance {
    pub(crate) pose: [[f64; 3]; 3],
    pub(crate) height: f64,
}

/// x, y, yaw and at most three dimensions.
type Parameters = [f64; MAX_PARAMETERS];
const MAX_PARAMETERS: usize = 6;
const YAW: usize = 2;
const FIRST_DIMENSION: usize = 3;

/// The step of numeric derivatives, in metres and radians.
const DIFFERENCE: f64 = 1e-4;
/// The cut-off of the first iteration, in metres.
const FIRST_CUT_OFF: f64 = 0.015;
/// How much of it the next has.
const CUT_OFF_FADE: f64 = 0.7;
/// How exactly the deepest place of a ray is found, in metres.
const RESOLUTION: f64 = 0.002;
/// A point this near, or within three deviations, is explained, in metres.
const EXPLAINED: f64 = 0.004;
/// The variance of what the evidence does not determine, in metres² and radians².
const UNKNOWN: f64 = 0.01;
/// A step below which a fit has settled, in metres and radians.
const SETTLED: f64 = 1e-4;
/// The longest step of one iteration, in metres; of yaw in radians, ten times as much.
const LONGEST_STEP: f64 = 0.02;

impl Fit {
    pub(crate) fn new(class: ObjectClass, at: [f64; 2], yaw: f64, dimensions: &[f64]) -> Fit {
        let mut parameters = [at[0], at[1], yaw, 0.0, 0.0, 0.0];
        parameters[FIRST_DIMENSION..FIRST_DIMENSION + dimensions.len()].copy_from_slice(dimensions);
        Fit { class, parameters }.bounded()
    }

    pub(crate) fn at(&self) -> [f64; 2] {
        [self.parameters[0], self.parameters[1]]
    }

    pub(crate) fn yaw(&self) -> f64 {
        self.parameters[YAW]
    }

    pub(crate) fn model(&self) -> Model {
        self.class.model(&self.parameters[FIRST_DIMENSION..FIRST_DIMENSION + self.class.ranges().len()])
    }

    /// The fit near this one that agrees best with the evidence.
    pub(crate) fn refined(self, evidence: &Evidence, iterations: usize) -> Fit {
        let last_cut_off = (3.0 * evidence.sigma).max(EXPLAINED);
        let mut cut_off = FIRST_CUT_OFF.max(last_cut_off);
        let (mut here, mut damping) = (self, 1e-3);
        for _ in 0..iterations {
            let used = here.used(evidence);
            let (normal, cost) = here.linearised(evidence, &used, cut_off);
            let Some(next) = here.stepped(&normal, damping) else { break };
            if next.cost(evidence, &used, cut_off) <= cost {
                let moved = here.parameters.iter().zip(next.parameters).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                here = next;
                damping = (damping * 0.3).max(1e-6);
                if moved < SETTLED && cut_off <= last_cut_off {
                    break;
                }
            } else {
                damping *= 10.0;
            }
            cut_off = (cut_off * CUT_OFF_FADE).max(last_cut_off);
        }
        here
    }

    /// How badly it explains the evidence, per point: 0 is perfect, 1 not at all.
    pub(crate) fn score(&self, evidence: &Evidence) -> f64 {
        let cut_off = (3.0 * evidence.sigma).max(EXPLAINED);
        self.cost(evidence, &evidence.points, cut_off) * 2.0 / cut_off.powi(2) / evidence.points.len().max(1) as f64
    }

    /// How many of the points lie on its surface, 0 to 1.
    pub(crate) fn explains(&self, evidence: &Evidence) -> f64 {
        let placed = Placed::of(self, evidence.eye);
        let near = (3.0 * evidence.sigma).max(EXPLAINED);
        let explained = evidence.points.iter().filter(|p| placed.distance(**p).abs() < near).count();
        explained as f64 / evidence.points.len().max(1) as f64
    }

    /// Whether a place on the surface is below it.
    pub(crate) fn covers(&self, place: [f64; 2]) -> bool {
        let (sin, cos) = self.yaw().sin_cos();
        let (x, y) = (place[0] - self.parameters[0], place[1] - self.parameters[1]);
        let [length, width, _] = self.model().size();
        (cos * x + sin * y).abs() < length / 2.0 && (cos * y - sin * x).abs() < width / 2.0
    }

    /// How well the evidence determines it, by its noise and the size of pixels.
    pub(crate) fn covariance(&self, evidence: &Evidence) -> Covariance {
        let cut_off = (3.0 * evidence.sigma).max(EXPLAINED);
        let mut normal = Normal::default();
        let placed = Placed::of(self, evidence.eye);
        let moved = self.neighbours(evidence.eye);
        let (mut squares, mut count) = (0.0, 0.0);
        for point in &evidence.points {
            let residual = placed.distance(*point);
            if residual.abs() < cut_off {
                squares += residual * residual;
                count += 1.0;
                normal.add(&self.slope(&moved, residual, |p| p.distance(*point)), residual, evidence.sigma.powi(-2));
            }
        }
        // A ray that passes within a pixel says where the edge is, to about a pixel.
        for ray in evidence.free.iter().filter_map(|end| placed.deepest(evidence, *end)) {
            if ray.depth.abs() < evidence.pitch / 2.0 {
                let slope = self.slope(&moved, ray.depth, |p| p.model.fill_distance(p.local(ray.place)));
                normal.add(&slope, ray.depth, evidence.pitch.powi(-2));
            }
        }
        // More scattered than the noise says: the model is not quite the thing.
        let inflation = (squares / f64::max(count, 1.0) / evidence.sigma.powi(2)).max(1.0);
        let unknown = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { UNKNOWN } else { 0.0 }));
        let inverse = normal.inverse(&self.fixed()).unwrap_or(unknown);
        let pose = std::array::from_fn(|row| std::array::from_fn(|column| inverse[row][column] * inflation));
        // A fork's height follows its length.
        let last = FIRST_DIMENSION + self.class.ranges().len() - 1;
        let height = if self.class == ObjectClass::Fork { 0.0 } else { inverse[last][last] * inflation };
        Covariance { pose, height }
    }

    /// The parameters that do not exist or change nothing.
    fn fixed(&self) -> [bool; MAX_PARAMETERS] {
        let dimensions = self.class.ranges().len();
        std::array::from_fn(|i| {
            (i == YAW && self.class.symmetry() == Symmetry::Round) || i >= FIRST_DIMENSION + dimensions
        })
    }

    /// This fit with each parameter a little greater.
    fn neighbours(&self, eye: Vector) -> [Option<Placed>; MAX_PARAMETERS] {
        let fixed = self.fixed();
        std::array::from_fn(|i| {
            (!fixed[i]).then(|| {
                let mut next = self.clone();
                next.parameters[i] += DIFFERENCE;
                Placed::of(&next, eye)
            })
        })
    }

    fn slope(
        &self,
        moved: &[Option<Placed>; MAX_PARAMETERS],
        here: f64,
        distance: impl Fn(&Placed) -> f64,
    ) -> Parameters {
        std::array::from_fn(|i| moved[i].as_ref().map_or(0.0, |p| (distance(p) - here) / DIFFERENCE))
    }

    /// The points that the model has above the floor: chosen by where the model is, not by where noise has put them.
    fn used(&self, evidence: &Evidence) -> Vec<Vector> {
        let placed = Placed::of(self, evidence.eye);
        let above = |p: &&Vector| p[2] - placed.distance(**p) > evidence.floor;
        evidence.points.iter().filter(above).copied().collect()
    }

    fn linearised(&self, evidence: &Evidence, used: &[Vector], cut_off: f64) -> (Normal, f64) {
        let (placed, moved) = (Placed::of(self, evidence.eye), self.neighbours(evidence.eye));
        let (mut normal, mut cost) = (Normal::default(), 0.0);
        for point in used {
            let residual = placed.distance(*point);
            cost += robust(residual, cut_off);
            let weight = weight(residual, cut_off);
            if weight > 0.0 {
                normal.add(&self.slope(&moved, residual, |p| p.distance(*point)), residual, weight);
            }
        }
        for end in &evidence.free {
            let Some(ray) = placed.deepest(evidence, *end) else { continue };
            if ray.depth < 0.0 {
                cost += robust(ray.depth, cut_off);
                let slope = self.slope(&moved, ray.depth, |p| p.model.fill_distance(p.local(ray.place)));
                normal.add(&slope, ray.depth, weight(ray.depth, cut_off).max(RAY_WEIGHT));
            }
        }
        (normal, cost)
    }

    fn cost(&self, evidence: &Evidence, points: &[Vector], cut_off: f64) -> f64 {
        let placed = Placed::of(self, evidence.eye);
        let on_surface = points.iter().map(|p| robust(placed.distance(*p), cut_off));
        let free = evidence.free.iter().filter_map(|end| placed.deepest(evidence, *end));
        on_surface.sum::<f64>() + free.map(|ray| robust(ray.depth.min(0.0), cut_off)).sum::<f64>()
    }

    fn stepped(&self, normal: &Normal, damping: f64) -> Option<Fit> {
        let step = normal.step(&self.fixed(), damping)?;
        let mut next = self.clone();
        for (i, (parameter, step)) in next.parameters.iter_mut().zip(step).enumerate() {
            let longest = if i == YAW { 10.0 * LONGEST_STEP } else { LONGEST_STEP };
            *parameter -= step.clamp(-longest, longest);
        }
        Some(next.bounded())
    }

    fn bounded(mut self) -> Fit {
        for (parameter, range) in self.parameters[FIRST_DIMENSION..].iter_mut().zip(self.class.ranges()) {
            *parameter = parameter.clamp(*range.start(), *range.end());
        }
        self
    }
}

/// What a ray through the model keeps at least of its weight, however deep: it is no stray.
const RAY_WEIGHT: f64 = 0.2;

/// Half the square up to the cut-off, fading to a bound (Tukey's biweight, scaled to half the cut-off's square).
fn robust(residual: f64, cut_off: f64) -> f64 {
    let part = (residual / cut_off).powi(2).min(1.0);
    cut_off * cut_off / 2.0 * (1.0 - (1.0 - part).powi(3))
}

fn weight(residual: f64, cut_off: f64) -> f64 {
    let part = (residual / cut_off).powi(2).min(1.0);
    3.0 * (1.0 - part).powi(2)
}

/// A fit ready for many questions.
#[derive(Debug, Clone, Copy)]
struct Placed {
    model: Model,
    at: Vector,
    sin: f64,
    cos: f64,
    /// The camera in its frame.
    eye: Vector,
}

/// The place of a ray that is deepest within the model, or nearest to it.
struct Deepest {
    place: Vector,
    /// Signed distance there.
    depth: f64,
}

impl Placed {
    fn of(fit: &Fit, eye: Vector) -> Placed {
        let model = fit.model();
        let (sin, cos) = fit.yaw().sin_cos();
        let at = [fit.parameters[0], fit.parameters[1], model.size()[2] / 2.0];
        let mut placed = Placed { model, at, sin, cos, eye };
        placed.eye = placed.local(eye);
        placed
    }

    /// How far a point is from the surface that the camera sees.
    fn distance(&self, point: Vector) -> f64 {
        self.model.distance(self.local(point), self.eye)
    }

    /// A point in the model's frame.
    fn local(&self, p: Vector) -> Vector {
        let (x, y) = (p[0] - self.at[0], p[1] - self.at[1]);
        [self.cos * x + self.sin * y, self.cos * y - self.sin * x, p[2] - self.at[2]]
    }

    /// Where the ray from the eye to `end` is deepest, above the floor; `None` where it passes well clear. Golden section: along
    /// a line the distance to a convex body has one minimum.
    fn deepest(&self, evidence: &Evidence, end: Vector) -> Option<Deepest> {
        let eye = evidence.eye;
        let fall = eye[2] - end[2];
        let [length, width, height] = self.model.size();
        if fall < 1e-3 || eye[2] <= height || height <= evidence.floor {
            return None;
        }
        let at = |z: f64| -> Vector {
            let t = (eye[2] - z) / fall;
            std::array::from_fn(|i| eye[i] + t * (end[i] - eye[i]))
        };
        let (top, bottom) = (at(height), at(evidence.floor));
        if self.passes_clear(top, bottom, length.hypot(width) / 2.0) {
            return None;
        }
        let point = |s: f64| -> Vector { std::array::from_fn(|i| top[i] + s * (bottom[i] - top[i])) };
        let depth = |s: f64| self.model.fill_distance(self.local(point(s)));
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let (mut low, mut high) = (0.0, 1.0);
        let (mut a, mut b) = (high - GOLDEN * (high - low), low + GOLDEN * (high - low));
        let (mut depth_a, mut depth_b) = (depth(a), depth(b));
        let mut left = length_of(sub(bottom, top));
        while left > RESOLUTION {
            left *= GOLDEN;
            if depth_a < depth_b {
                (high, b, depth_b) = (b, a, depth_a);
                a = high - GOLDEN * (high - low);
                depth_a = depth(a);
            } else {
                (low, a, depth_a) = (a, b, depth_b);
                b = low + GOLDEN * (high - low);
                depth_b = depth(b);
            }
        }
        let (s, depth) = if depth_a < depth_b { (a, depth_a) } else { (b, depth_b) };
        Some(Deepest { place: point(s), depth })
    }

    /// Whether a segment seen from above stays outside a circle around the model.
    fn passes_clear(&self, top: Vector, bottom: Vector, radius: f64) -> bool {
        let (dx, dy) = (bottom[0] - top[0], bottom[1] - top[1]);
        let (px, py) = (self.at[0] - top[0], self.at[1] - top[1]);
        let t = ((px * dx + py * dy) / (dx * dx + dy * dy).max(1e-12)).clamp(0.0, 1.0);
        (px - t * dx).powi(2) + (py - t * dy).powi(2) > (radius + 0.004).powi(2)
    }
}
