//! A model with its pose, prepared for many queries: distances of points, and how deep rays pass through it.

use super::{EDGE_CUT_OFF, Edge, Evidence, Fit};
use crate::model::Model;
use crate::model::form::Form;
use crate::vector::{Vector, length, sub};

/// Resolution of the search for a ray's deepest point, in metres.
const RESOLUTION: f64 = 0.002;
/// A ray that stays farther from the model than this does not matter, in metres.
pub(super) const NEAR: f64 = 0.004;

/// A fit prepared for many queries.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placed {
    model: Model,
    form: Form,
    at: Vector,
    sin: f64,
    cos: f64,
    /// The camera in the model's frame.
    eye: Vector,
}

/// The point of a ray that is deepest within the model, or nearest to it.
pub(super) struct Deepest {
    pub(super) place: Vector,
    /// The signed distance there.
    pub(super) depth: f64,
}

impl Placed {
    pub(super) fn of(fit: &Fit, eye: Vector) -> Placed {
        let model = fit.model();
        let (sin, cos) = fit.yaw().sin_cos();
        let at = [fit.parameters[0], fit.parameters[1], model.size()[2] / 2.0];
        let mut placed = Placed { model, form: fit.form(), at, sin, cos, eye };
        placed.eye = placed.local(eye);
        placed
    }

    /// Distance of a point from the surface that the camera sees.
    pub(super) fn distance(&self, point: Vector) -> f64 {
        self.model.distance(self.form, self.local(point), self.eye)
    }

    /// Distance of a point from the volume that no ray passes.
    pub(super) fn fill_distance(&self, point: Vector) -> f64 {
        self.model.fill_distance(self.form, self.local(point))
    }

    /// A point in the model's frame.
    fn local(&self, p: Vector) -> Vector {
        let (x, y) = (p[0] - self.at[0], p[1] - self.at[1]);
        [self.cos * x + self.sin * y, self.cos * y - self.sin * x, p[2] - self.at[2]]
    }

    /// The nearest point of a ray beside the silhouette; `None` far from the model.
    pub(super) fn at_edge(&self, evidence: &Evidence, edge: &Edge) -> Option<Deepest> {
        self.deepest(evidence, edge.end, edge.beside + EDGE_CUT_OFF * edge.sigma)
    }

    /// The deepest point of the ray from the eye to `end`, above the floor; `None` where the ray stays farther from the model than `near`. By
    /// golden-section search: along a line the distance to a convex body has one minimum.
    pub(super) fn deepest(&self, evidence: &Evidence, end: Vector, near: f64) -> Option<Deepest> {
        let eye = evidence.eye;
        let fall = eye[2] - end[2];
        let [long, width, height] = self.model.size();
        if fall < 1e-3 || eye[2] <= height || height <= end[2].max(evidence.floor) {
            return None;
        }
        let at = |z: f64| -> Vector {
            let t = (eye[2] - z) / fall;
            std::array::from_fn(|i| eye[i] + t * (end[i] - eye[i]))
        };
        // The nearest point of a ray that passes over an edge lies above the edge.
        let (top, bottom) = (at((height + near).min(eye[2])), at(end[2].max(evidence.floor)));
        if self.passes_clear(top, bottom, long.hypot(width) / 2.0 + near) {
            return None;
        }
        let point = |s: f64| -> Vector { std::array::from_fn(|i| top[i] + s * (bottom[i] - top[i])) };
        let depth = |s: f64| self.fill_distance(point(s));
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let (mut low, mut high) = (0.0, 1.0);
        let (mut a, mut b) = (high - GOLDEN * (high - low), low + GOLDEN * (high - low));
        let (mut depth_a, mut depth_b) = (depth(a), depth(b));
        let mut left = length(sub(bottom, top));
        while left > RESOLUTION {
            // A distance changes by no more than the way along the ray, so nothing in the remaining interval comes near.
            if depth_a.min(depth_b) > (1.0 - GOLDEN) * left + near {
                return None;
            }
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
        (px - t * dx).powi(2) + (py - t * dy).powi(2) > radius.powi(2)
    }
}
