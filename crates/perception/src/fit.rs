//! Fits a model to the measurements of one cluster: iterated closest points on the model's surface, with free space.
//!
//! Every measured point pulls the model's surface towards itself (point to surface; Chen and Medioni 1992, with the closest point given by
//! the signed distance instead of a search). With points alone a model could grow behind its visible faces, so every ray that reached the
//! table beside the cluster pushes away the parts of the model that it would pass through. Both are least squares over position, yaw and
//! the model's dimensions, by Levenberg and Marquardt, with weights that fade to zero at a cut-off, which shrinks as the fit settles.
//! Objects stand upright: the frame's z = 0 is the surface.

mod placed;
pub(crate) mod relief;
pub(crate) mod start;

use crate::model::form::Form;
use crate::model::{Model, ObjectClass, Symmetry};
use crate::normal::{Blocks, N as MAX_PARAMETERS, Normal};
use crate::vector::Vector;
use placed::{Deepest, NEAR, Placed};

/// The measurements of a cluster and around it, in the frame of the supporting surface.
#[derive(Debug, Clone)]
pub(crate) struct Evidence {
    /// Position of the camera.
    pub(crate) eye: Vector,
    /// Points of the cluster.
    pub(crate) points: Vec<Vector>,
    /// End points of the rays beside the cluster, at or below the surface.
    pub(crate) free: Vec<Vector>,
    /// Rays along the cluster's silhouette.
    pub(crate) edges: Vec<Edge>,
    /// Points below this height are not used: only those that noise has lifted were separated from the surface.
    pub(crate) floor: f64,
    /// Standard deviation of a point, in metres.
    pub(crate) sigma: f64,
    /// Standard deviation of the noise that neighbouring points share, in metres.
    pub(crate) shared: f64,
    /// The distance between neighbouring pixels at the cluster, in metres.
    pub(crate) pitch: f64,
}

/// A ray a little outside of the silhouette, which lies half-way between a pixel that sees the cluster and one that sees far past it.
/// Inside a corner, a ray's depth in the model is less than its distance from the silhouette; outside, the two distances are equal.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Edge {
    /// The point at which the ray reaches the surface.
    pub(crate) end: Vector,
    /// Distance of the ray from the silhouette, in metres.
    pub(crate) beside: f64,
    /// Standard deviation of the silhouette's position across the ray, in metres.
    pub(crate) sigma: f64,
}

/// A model with its pose: z = 0 is its underside.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Fit {
    pub(crate) class: ObjectClass,
    /// x, y, yaw, the model's dimensions and its form.
    parameters: Parameters,
}

impl Evidence {
    /// Standard deviation of a point from a model, in metres: objects differ a little from their models.
    fn spread(&self) -> f64 {
        self.sigma.hypot(UNLIKE)
    }

    /// A point farther away than this does not belong to the model, in metres.
    fn cut_off(&self) -> f64 {
        (3.0 * self.spread()).max(EXPLAINED)
    }
}

/// Uncertainty of a fit: variances and covariances of x, y, yaw; the variance of its height.
pub(crate) struct Covariance {
    pub(crate) pose: [[f64; 3]; 3],
    pub(crate) height: f64,
}

/// x, y, yaw, at most three dimensions, and the form.
type Parameters = [f64; MAX_PARAMETERS];
const YAW: usize = 2;
const FIRST_DIMENSION: usize = 3;
const FIRST_FORM: usize = 6;

/// The step of numeric derivatives, in metres and radians.
const DIFFERENCE: f64 = 1e-4;
/// The cut-off of the first iteration, in metres.
const FIRST_CUT_OFF: f64 = 0.015;
/// Factor of the cut-off from one iteration to the next.
const CUT_OFF_FADE: f64 = 0.7;
/// A point nearer than this, or within three standard deviations, is explained, in metres.
const EXPLAINED: f64 = 0.004;
/// Standard deviations of objects from their models, in metres: of a point, and of a silhouette.
const UNLIKE: f64 = 0.0015;
pub(crate) const UNLIKE_AT_EDGES: f64 = 0.001;
/// The same for neighbouring points, which deviate together.
const UNLIKE_AROUND: f64 = 0.0003;
/// A silhouette edge that deviates by more standard deviations than this does not belong to the model: it is a handle's, for example.
const EDGE_CUT_OFF: f64 = 3.5;
/// Size of a block in metres: points in one block share noise and the deviation from the model.
const BLOCK: f64 = 0.02;
/// Variance of parameters that the evidence does not determine, in metres² and radians².
const UNKNOWN: f64 = 0.01;
/// A fit has settled when a step is below this, in metres and radians.
const SETTLED: f64 = 1e-4;
/// Maximum step of one iteration, in metres; ten times as much for yaw, in radians.
const LONGEST_STEP: f64 = 0.02;

impl Fit {
    pub(crate) fn new(class: ObjectClass, at: [f64; 2], yaw: f64, dimensions: &[f64]) -> Fit {
        let mut parameters = [0.0; MAX_PARAMETERS];
        parameters[..FIRST_DIMENSION].copy_from_slice(&[at[0], at[1], yaw]);
        for (form, usual) in parameters[FIRST_FORM..].iter_mut().zip(class.usual()) {
            *form = usual.mean;
        }
        parameters[FIRST_DIMENSION..FIRST_DIMENSION + dimensions.len()].copy_from_slice(dimensions);
        Fit { class, parameters }.bounded()
    }

    pub(crate) fn at(&self) -> [f64; 2] {
        [self.parameters[0], self.parameters[1]]
    }

    pub(crate) fn yaw(&self) -> f64 {
        self.parameters[YAW]
    }

    /// Turns it about its upright axis, in radians.
    pub(crate) fn turned(&self, by: f64) -> Fit {
        let mut turned = self.clone();
        turned.parameters[YAW] += by;
        turned
    }

    pub(crate) fn model(&self) -> Model {
        self.class.model(&self.parameters[FIRST_DIMENSION..FIRST_DIMENSION + self.class.ranges().len()])
    }

    fn form(&self) -> Form {
        std::array::from_fn(|i| self.parameters[FIRST_FORM + i])
    }

    /// The fit near this one that agrees best with the evidence.
    pub(crate) fn refined(self, evidence: &Evidence, iterations: usize) -> Fit {
        let last_cut_off = evidence.cut_off();
        let mut cut_off = FIRST_CUT_OFF.max(last_cut_off);
        let (mut here, mut damping) = (self, 1e-3);
        let mut residuals = here.residuals(evidence);
        for _ in 0..iterations {
            let used = residuals.used(evidence);
            let normal = here.linearised(evidence, &residuals, &used, cut_off);
            let Some(next) = here.stepped(&normal, damping) else { break };
            let next_residuals = next.residuals(evidence);
            let cost = |fit: &Fit, residuals: &Residuals| {
                residuals.cost(&used, cut_off) + residuals.edge_cost(evidence, cut_off) + fit.unusual(evidence)
            };
            if cost(&next, &next_residuals) <= cost(&here, &residuals) {
                let moved = here.parameters.iter().zip(next.parameters).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                (here, residuals) = (next, next_residuals);
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
        let cut_off = evidence.cut_off();
        let all = vec![true; evidence.points.len()];
        self.residuals(evidence).cost(&all, cut_off) * 2.0 / cut_off.powi(2) / all.len().max(1) as f64
    }

    /// With its score.
    pub(crate) fn scored(self, evidence: &Evidence) -> (Fit, f64) {
        let score = self.score(evidence);
        (self, score)
    }

    /// The part of the points that lie on its surface, 0 to 1.
    pub(crate) fn explains(&self, evidence: &Evidence) -> f64 {
        let placed = Placed::of(self, evidence.eye);
        let near = evidence.cut_off();
        let explained = evidence.points.iter().filter(|p| placed.distance(**p).abs() < near).count();
        explained as f64 / evidence.points.len().max(1) as f64
    }

    /// Whether it stands above a place on the surface.
    pub(crate) fn covers(&self, place: [f64; 2]) -> bool {
        let (sin, cos) = self.yaw().sin_cos();
        let (x, y) = (place[0] - self.parameters[0], place[1] - self.parameters[1]);
        let [length, width, _] = self.model().size();
        (cos * x + sin * y).abs() < length / 2.0 && (cos * y - sin * x).abs() < width / 2.0
    }

    /// How well the evidence determines it, given the noise and the pixel size.
    pub(crate) fn covariance(&self, evidence: &Evidence) -> Covariance {
        let cut_off = evidence.cut_off();
        let (mut normal, mut blocks) = (Normal::default(), Blocks::default());
        let placed = Placed::of(self, evidence.eye);
        let moved = self.neighbours(evidence.eye);
        let block = |place: Vector| place.map(|c| (c / BLOCK).floor() as i32);
        for point in &evidence.points {
            let residual = placed.distance(*point);
            if residual.abs() < cut_off {
                let slope = self.slope(&moved, residual, |p| p.distance(*point));
                normal.add(&slope, residual, evidence.sigma.powi(-2));
                blocks.add(block(*point), &slope, residual, evidence.sigma.powi(-2));
            }
        }
        // A ray that passes within a pixel determines the edge to about a pixel.
        for ray in evidence.free.iter().filter_map(|end| placed.deepest(evidence, *end, NEAR)) {
            if ray.depth.abs() < evidence.pitch / 2.0 {
                let slope = self.slope(&moved, ray.depth, |p| p.fill_distance(ray.place));
                normal.add(&slope, ray.depth, evidence.pitch.powi(-2));
            }
        }
        for edge in &evidence.edges {
            if let Some(ray) = placed.at_edge(evidence, edge)
                && (ray.depth - edge.beside).abs() < EDGE_CUT_OFF * edge.sigma
            {
                let slope = self.slope(&moved, ray.depth, |p| p.fill_distance(ray.place));
                normal.add(&slope, ray.depth - edge.beside, edge.sigma.powi(-2));
                blocks.add(block(ray.place), &slope, ray.depth - edge.beside, edge.sigma.powi(-2));
            }
        }
        for (i, usual) in self.class.usual().iter().enumerate().filter(|(_, usual)| usual.is_free()) {
            normal.expect(FIRST_FORM + i, 0.0, usual.deviation.powi(-2));
        }
        let unknown = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { UNKNOWN } else { 0.0 }));
        let fixed = self.fixed();
        let shared = evidence.shared.powi(2) + UNLIKE_AROUND.powi(2);
        let covariance = normal.with_shared(&blocks, shared).inverse(&fixed).unwrap_or(unknown);
        let pose = std::array::from_fn(|row| std::array::from_fn(|column| covariance[row][column]));
        // A fork's height follows from its length.
        let last = FIRST_DIMENSION + self.class.ranges().len() - 1;
        let height = if self.class == ObjectClass::Fork { 0.0 } else { covariance[last][last] };
        Covariance { pose, height }
    }

    /// The parameters that do not exist or have no effect.
    fn fixed(&self) -> [bool; MAX_PARAMETERS] {
        let dimensions = self.class.ranges().len();
        std::array::from_fn(|i| match i {
            YAW => self.class.symmetry() == Symmetry::Round,
            ..FIRST_DIMENSION => false,
            FIRST_FORM.. => self.class == ObjectClass::Fork || !self.class.usual()[i - FIRST_FORM].is_free(),
            _ => i >= FIRST_DIMENSION + dimensions,
        })
    }

    /// This fit with each parameter increased a little.
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

    fn residuals(&self, evidence: &Evidence) -> Residuals {
        let placed = Placed::of(self, evidence.eye);
        Residuals {
            points: evidence.points.iter().map(|p| placed.distance(*p)).collect(),
            edges: evidence.edges.iter().map(|edge| placed.at_edge(evidence, edge)).collect(),
            rays: evidence.free.iter().filter_map(|end| placed.deepest(evidence, *end, NEAR)).collect(),
        }
    }

    fn linearised(&self, evidence: &Evidence, residuals: &Residuals, used: &[bool], cut_off: f64) -> Normal {
        let moved = self.neighbours(evidence.eye);
        let mut normal = Normal::default();
        for ((point, residual), used) in evidence.points.iter().zip(&residuals.points).zip(used) {
            let weight = weight(*residual, cut_off);
            if *used && weight > 0.0 {
                normal.add(&self.slope(&moved, *residual, |p| p.distance(*point)), *residual, weight);
            }
        }
        for ray in residuals.rays.iter().filter(|ray| ray.depth < 0.0) {
            let slope = self.slope(&moved, ray.depth, |p| p.fill_distance(ray.place));
            normal.add(&slope, ray.depth, weight(ray.depth, cut_off).max(RAY_WEIGHT));
        }
        let spread = evidence.spread();
        for (edge, ray) in evidence.edges.iter().zip(&residuals.edges) {
            let Some(ray) = ray else { continue };
            let off = ray.depth - edge.beside;
            let weight = weight(off, (EDGE_CUT_OFF * edge.sigma).max(cut_off)) * (spread / edge.sigma).powi(2);
            if weight > 0.0 {
                normal.add(&self.slope(&moved, ray.depth, |p| p.fill_distance(ray.place)), off, weight);
            }
        }
        for (i, usual) in self.class.usual().iter().enumerate().filter(|(_, usual)| usual.is_free()) {
            let off = self.parameters[FIRST_FORM + i] - usual.mean;
            normal.expect(FIRST_FORM + i, off, weight(0.0, 1.0) * (spread / usual.deviation).powi(2));
        }
        normal
    }

    /// The cost of an unusual form.
    fn unusual(&self, evidence: &Evidence) -> f64 {
        let usual = self.class.usual().iter().zip(&self.parameters[FIRST_FORM..]);
        let off = usual.filter(|(usual, _)| usual.is_free()).map(|(usual, form)| (form - usual.mean) / usual.deviation);
        0.5 * weight(0.0, 1.0) * evidence.spread().powi(2) * off.map(|off| off * off).sum::<f64>()
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
        for (form, usual) in self.parameters[FIRST_FORM..].iter_mut().zip(self.class.usual()) {
            *form = form.clamp(*usual.range.start(), *usual.range.end());
        }
        self
    }
}

/// The differences between the evidence and a fit.
struct Residuals {
    /// Of each point, in metres.
    points: Vec<f64>,
    /// Of each edge, where its ray passes close by.
    edges: Vec<Option<Deepest>>,
    /// Of the free rays that pass close by.
    rays: Vec<Deepest>,
}

impl Residuals {
    /// The points that the model has above the floor: selected by the model's surface, not by the noisy points.
    fn used(&self, evidence: &Evidence) -> Vec<bool> {
        self.points.iter().zip(&evidence.points).map(|(residual, p)| p[2] - residual > evidence.floor).collect()
    }

    fn cost(&self, used: &[bool], cut_off: f64) -> f64 {
        let points = self.points.iter().zip(used).filter(|(_, used)| **used).map(|(r, _)| robust(*r, cut_off));
        let rays = self.rays.iter().map(|ray| robust(ray.depth.min(0.0), cut_off));
        points.sum::<f64>() + rays.sum::<f64>()
    }

    fn edge_cost(&self, evidence: &Evidence, cut_off: f64) -> f64 {
        let spread = evidence.spread();
        let of = |(edge, ray): (&Edge, &Option<Deepest>)| {
            let cut_off = (EDGE_CUT_OFF * edge.sigma).max(cut_off);
            let cost = ray.as_ref().map_or(cut_off * cut_off / 2.0, |ray| robust(ray.depth - edge.beside, cut_off));
            cost * (spread / edge.sigma).powi(2)
        };
        evidence.edges.iter().zip(&self.edges).map(of).sum()
    }
}

/// Minimum weight of a ray through the model, however deep it passes: it is no outlier.
const RAY_WEIGHT: f64 = 0.2;

/// Half the square for small residuals, saturating at the cut-off (Tukey's biweight, scaled to half the cut-off's square).
fn robust(residual: f64, cut_off: f64) -> f64 {
    let part = (residual / cut_off).powi(2).min(1.0);
    cut_off * cut_off / 2.0 * (1.0 - (1.0 - part).powi(3))
}

fn weight(residual: f64, cut_off: f64) -> f64 {
    let part = (residual / cut_off).powi(2).min(1.0);
    3.0 * (1.0 - part).powi(2)
}
