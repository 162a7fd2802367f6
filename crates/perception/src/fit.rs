//! An upright box fitted to one cluster.
//!
//! The least-area rectangle of the visible top face starts it. Then the box is moved, turned and resized until the depths
//! that it would show agree best with those measured in the whole window around it: pixels that should see the plane
//! count as much as those that should see the box, so edges are found to a fraction of a pixel. A coordinate search with
//! halving steps; the error per pixel is bounded, so that what hides the box does not pull at it.

use crate::plane::Plane;
use crate::rectangle;
use crate::vector::{Vector, median, quantile};

/// An upright box on the plane, in the region's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fit {
    pub(crate) centre: [f64; 2],
    pub(crate) yaw: f64,
    pub(crate) size: [f64; 2],
    /// The height of the plane below it.
    pub(crate) base: f64,
    /// How high it is.
    pub(crate) height: f64,
}

/// A pixel of the window: its ray (the point at depth 1, from the eye) and what it measured.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sight {
    pub(crate) direction: Vector,
    pub(crate) depth: f64,
}

/// No pixel is more wrong than this, in metres.
const ERROR_BOUND: f64 = 0.02;
/// A pixel that agrees to this is explained, in metres.
const EXPLAINED: f64 = 0.012;
/// First and last step of the search, in metres; the angle's step is this over a lever of 8 cm.
const FIRST_STEP: f64 = 0.008;
const LAST_STEP: f64 = 0.0004;
const LEVER: f64 = 0.08;
/// Rounds at one step length.
const MAX_ROUNDS: usize = 12;
/// Edges of a box, in metres.
const EDGES: std::ops::Range<f64> = 0.02..0.35;

impl Fit {
    /// The start: the least-area rectangle of the top face.
    pub(crate) fn of_top_face(points: &[Vector], plane: &Plane) -> Option<Fit> {
        let mut heights: Vec<f64> = points.iter().map(|p| plane.above(*p)).collect();
        let highest = quantile(&mut heights, 0.95)?;
        let mut upper: Vec<f64> = heights.into_iter().filter(|h| *h > highest - 0.012).collect();
        let height = median(&mut upper)?;
        let top: Vec<[f64; 2]> =
            points.iter().filter(|p| (plane.above(**p) - height).abs() < 0.01).map(|p| [p[0], p[1]]).collect();
        let rectangle = rectangle::least_area(&top)?;
        Some(Fit {
            centre: rectangle.centre,
            yaw: rectangle.yaw,
            size: rectangle.size,
            base: plane.at(rectangle.centre[0], rectangle.centre[1]),
            height,
        })
    }

    /// The box near this one that agrees best with what was measured.
    pub(crate) fn refined(self, eye: Vector, plane: &Plane, window: &[Sight]) -> Fit {
        let seen: Vec<(Sight, f64)> = window.iter().map(|s| (*s, depth_of_plane(eye, s.direction, plane))).collect();
        let mut best = self.bounded();
        let mut error = best.error(eye, &seen);
        let mut step = FIRST_STEP;
        while step > LAST_STEP {
            for _ in 0..MAX_ROUNDS {
                let before = error;
                for direction in 0..Move::ALL.len() * 2 {
                    let signed = if direction % 2 == 0 { step } else { -step };
                    let candidate = best.moved(Move::ALL[direction / 2], signed);
                    let candidate_error = candidate.error(eye, &seen);
                    if candidate_error < error {
                        (best, error) = (candidate, candidate_error);
                    }
                }
                if error >= before {
                    break;
                }
            }
            step /= 2.0;
        }
        best
    }

    /// Whether a place is below the box.
    pub(crate) fn covers(&self, place: [f64; 2]) -> bool {
        let (sin, cos) = self.yaw.sin_cos();
        let [dx, dy] = [place[0] - self.centre[0], place[1] - self.centre[1]];
        (cos * dx + sin * dy).abs() < self.size[0] / 2.0 && (cos * dy - sin * dx).abs() < self.size[1] / 2.0
    }

    /// How much of what was measured the box explains: the fraction of these pixels whose depth it shows.
    pub(crate) fn explains(&self, eye: Vector, pixels: &[Sight]) -> f64 {
        let (sin, cos) = self.yaw.sin_cos();
        let explained = pixels
            .iter()
            .filter(|s| self.depth(eye, s.direction, sin, cos).is_some_and(|d| (d - s.depth).abs() < EXPLAINED))
            .count();
        explained as f64 / pixels.len().max(1) as f64
    }

    fn error(&self, eye: Vector, seen: &[(Sight, f64)]) -> f64 {
        let (sin, cos) = self.yaw.sin_cos();
        seen.iter()
            .map(|(sight, plane)| {
                let expected = self.depth(eye, sight.direction, sin, cos).unwrap_or(*plane);
                (expected - sight.depth).abs().min(ERROR_BOUND)
            })
            .sum()
    }

    /// Where a ray meets the box (slabs).
    fn depth(&self, eye: Vector, direction: Vector, sin: f64, cos: f64) -> Option<f64> {
        let (dx, dy) = (eye[0] - self.centre[0], eye[1] - self.centre[1]);
        let from = [cos * dx + sin * dy, cos * dy - sin * dx, eye[2] - self.base - self.height / 2.0];
        let along = [cos * direction[0] + sin * direction[1], cos * direction[1] - sin * direction[0], direction[2]];
        let half = [self.size[0] / 2.0, self.size[1] / 2.0, self.height / 2.0];
        let (mut near, mut far) = (0.0_f64, f64::INFINITY);
        for axis in 0..3 {
            let inverse = 1.0 / along[axis];
            let (a, b) = ((-half[axis] - from[axis]) * inverse, (half[axis] - from[axis]) * inverse);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (near <= far).then_some(near)
    }

    fn moved(mut self, step: Move, by: f64) -> Fit {
        let (sin, cos) = self.yaw.sin_cos();
        match step {
            Move::Along => self.centre = [self.centre[0] + cos * by, self.centre[1] + sin * by],
            Move::Across => self.centre = [self.centre[0] - sin * by, self.centre[1] + cos * by],
            Move::Turn => self.yaw += by / LEVER,
            Move::Height => self.height += by,
            Move::Face { axis, side } => {
                self.size[axis] += by;
                let shift = if axis == 0 { Move::Along } else { Move::Across };
                self = self.moved(shift, side * by / 2.0);
            }
        }
        self.bounded()
    }

    fn bounded(mut self) -> Fit {
        self.size = self.size.map(|edge| edge.clamp(EDGES.start, EDGES.end));
        self.height = self.height.clamp(EDGES.start, EDGES.end);
        self
    }
}

#[derive(Debug, Clone, Copy)]
enum Move {
    Along,
    Across,
    Turn,
    Height,
    Face { axis: usize, side: f64 },
}

impl Move {
    const ALL: [Move; 8] = [
        Move::Along,
        Move::Across,
        Move::Turn,
        Move::Height,
        Move::Face { axis: 0, side: 1.0 },
        Move::Face { axis: 0, side: -1.0 },
        Move::Face { axis: 1, side: 1.0 },
        Move::Face { axis: 1, side: -1.0 },
    ];
}

fn depth_of_plane(eye: Vector, direction: Vector, plane: &Plane) -> f64 {
    let slope = direction[2] - plane.slope_x * direction[0] - plane.slope_y * direction[1];
    if slope.abs() < 1e-9 { f64::INFINITY } else { -plane.above(eye) / slope }
}
