//! The fastest way to follow a path within limits of velocity, acceleration *and jerk*.
//!
//! As in the second order (`reachability`), the unknown is x = ṡ² over s, here as a quadratic spline, so that u = s̈ is continuous and
//! s⃛ = u′ √x. With the path's derivatives q′, q″, q‴ a joint's acceleration q′ u + q″ x is linear in x and u, and its jerk is √x (q′
//! u′ + 3 q″ u + q‴ x). So minimising ∫ ds / √x is a convex problem except for the root in 1 / √x ≥ |q′ u′ + 3 q″ u + q‴ x| / J, which
//! is replaced by its tangent in each step: what satisfies the tangent satisfies the root. It is solved by a logarithmic barrier and
//! Newton's method (Boyd and Vandenberghe, *Convex Optimization*, chapter 11; Verscheure and others, *Time-Optimal Path Tracking for
//! Robots: a Convex Optimization Approach*, 2009, for the second order). Every step stays within all limits; the Hessian has five
//! diagonals, so the time of a step is proportional to the number of points.
//!
//! At rest x is not a polynomial of s: in the first and in the last cell s⃛ is constant instead, s = s⃛ t³ / 6, so x = 1.5 u s.

use super::path::Derivatives;

/// The cells of the mesh: each from one point to the next, inside one segment of the path.
pub(crate) struct Mesh<const N: usize> {
    /// From 0 to the path's length; at least five points.
    pub(crate) s: Vec<f64>,
    /// The path's derivatives at the beginning and at the end of each cell, as seen from inside the cell.
    pub(crate) ends: Vec<[Derivatives<N>; 2]>,
}

/// Limits of the joints in each cell of a mesh.
#[derive(Debug, Clone)]
pub(crate) struct Limits<const N: usize> {
    /// Maximum of ṡ, at both ends of each cell.
    pub(crate) fastest: Vec<[f64; 2]>,
    pub(crate) velocities: Vec<[f64; N]>,
    pub(crate) accelerations: Vec<[f64; N]>,
    pub(crate) jerks: Vec<[f64; N]>,
}

/// x and u at the points of the mesh; at the first and the last both are zero.
pub(crate) struct Profile {
    pub(crate) x: Vec<f64>,
    pub(crate) u: Vec<f64>,
    /// The free coefficients.
    c: Vec<f64>,
}

/// The weight of time grows by this factor, from the first value to the last.
const SHARPEN: f64 = 12.0;
const FIRST_WEIGHT: f64 = 300.0;
/// The loss through the barrier is about the number of active limits divided by this weight, in seconds.
const LAST_WEIGHT: f64 = 1.2e5;
/// Maximum number of Newton steps per weight, and the decrement that ends them.
const STEPS: usize = 14;
const DECREMENT: f64 = 2.0;
/// The part of the limits that the initial profile uses.
const WITHIN: f64 = 0.9;
/// Maximum length of a step, as a part of the distance to the nearest limit.
const SHORT_OF: f64 = 0.97;

/// One end of a cell, with x, u and u′ there as linear functions of the three coefficients before, at and after the cell.
struct Place<const N: usize> {
    /// The index of the first of the three coefficients.
    first: usize,
    x: [f64; 3],
    u: [f64; 3],
    rise: [f64; 3],
    path: [[f64; N]; 3],
    greatest: f64,
    accelerations: [f64; N],
    jerks: [f64; N],
    /// The distance that this end represents: half of the way to its neighbours.
    share: f64,
}

struct Problem<const N: usize> {
    places: Vec<Place<N>>,
    coefficients: usize,
    /// The first and the last coefficient as multiples of their neighbours.
    ties: [f64; 2],
}

/// x, u and u′ at a place.
type Triple = [f64; 3];

/// The fastest profile; `None` without a feasible start. The search starts from `wider`, the profile for wider limits, where there is
/// one. `goes_on` is asked in every step; `None` where it returns false.
pub(crate) fn quickest<const N: usize>(
    mesh: &Mesh<N>,
    limits: &Limits<N>,
    wider: Option<&Profile>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Profile> {
    let problem = Problem::new(mesh, limits);
    let n = mesh.s.len() - 1;
    let (mut c, mut weight) = match wider {
        Some(profile) => (problem.within(profile.c.clone())?, LAST_WEIGHT / SHARPEN),
        None => (problem.within(slow(mesh))?, FIRST_WEIGHT),
    };
    loop {
        problem.centre(&mut c, weight, goes_on)?;
        if weight >= LAST_WEIGHT {
            break;
        }
        weight *= SHARPEN;
    }
    let full = problem.full(&c);
    let mut profile = Profile { x: vec![0.0; n + 1], u: vec![0.0; n + 1], c };
    for k in 1..n - 1 {
        for end in 0..2 {
            let [x, u, _] = problem.places[2 * (k - 1) + end].triple(&full);
            (profile.x[k + end], profile.u[k + end]) = (x, u);
        }
    }
    Some(profile)
}

/// The shape of an initial profile, apart from its scale.
fn slow<const N: usize>(mesh: &Mesh<N>) -> Vec<f64> {
    let n = mesh.s.len() - 1;
    let whole = mesh.s[n];
    let shape = |k: usize| {
        let s = (mesh.s[k] + mesh.s[k + 1]) / 2.0;
        (4.0 * s * (whole - s) / (whole * whole)).powf(4.0 / 3.0)
    };
    (1..n - 1).map(shape).collect()
}

impl<const N: usize> Problem<N> {
    fn new(mesh: &Mesh<N>, limits: &Limits<N>) -> Problem<N> {
        let s = &mesh.s;
        let n = s.len() - 1;
        let cell = |k: usize| s[k + 1] - s[k];
        // The cells beside the two special ones end at a knot with full multiplicity.
        let width = |k: usize| if k == 0 || k == n - 1 { 0.0 } else { cell(k) };
        let first = cell(0);
        let last = cell(n - 1);
        let ties = [1.0 / (1.0 + cell(1) / (1.5 * first)), 1.0 / (1.0 + cell(n - 2) / (1.5 * last))];
        let mut places = Vec::with_capacity(2 * n);
        for k in 1..n - 1 {
            // Over the coefficients k − 1, k, k + 1.
            let node = |i: usize| {
                let (before, after) = (width(i - 1), width(i));
                let whole = before + after;
                let (x, u) = ([after / whole, before / whole], [-1.0 / whole, 1.0 / whole]);
                if i == k { ([x[0], x[1], 0.0], [u[0], u[1], 0.0]) } else { ([0.0, x[0], x[1]], [0.0, u[0], u[1]]) }
            };
            let nodes = [node(k), node(k + 1)];
            let rise = std::array::from_fn(|c| (nodes[1].1[c] - nodes[0].1[c]) / cell(k));
            for (end, (x, u)) in nodes.into_iter().enumerate() {
                let path = &mesh.ends[k][end];
                let mut greatest = limits.fastest[k][end].powi(2);
                for j in 0..N {
                    greatest = greatest.min((limits.velocities[k][j] / path.first[j].abs().max(1e-12)).powi(2));
                }
                // Starting from rest the jerk is about q′ s⃛, and x there follows from s⃛ and the distance.
                for (edge, at, way) in [(1, 0, first), (n - 1, n - 1, last)] {
                    if k + end == edge {
                        let slope = &mesh.ends[at][usize::from(at > 0)].first;
                        let hardest = (0..N).map(|j| limits.jerks[at][j] / slope[j].abs().max(1e-12));
                        let hardest = hardest.fold(f64::INFINITY, f64::min);
                        greatest = greatest.min(1.5 * way * (6.0 * way * hardest * hardest).cbrt());
                    }
                }
                places.push(Place {
                    first: k - 1,
                    x,
                    u,
                    rise,
                    path: [path.first, path.second, path.third],
                    greatest,
                    accelerations: limits.accelerations[k],
                    jerks: limits.jerks[k],
                    share: cell(k) / 2.0,
                });
            }
        }
        Problem { places, coefficients: n, ties }
    }

    /// All coefficients from the free ones.
    fn full(&self, free: &[f64]) -> Vec<f64> {
        let mut full = Vec::with_capacity(self.coefficients);
        full.push(self.ties[0] * free[0]);
        full.extend_from_slice(free);
        full.push(self.ties[1] * free[free.len() - 1]);
        full
    }

    /// Scales a profile down until it is well within all limits.
    fn within(&self, mut free: Vec<f64>) -> Option<Vec<f64>> {
        let full = self.full(&free);
        let mut scale = f64::INFINITY;
        for place in &self.places {
            let triple = place.triple(&full);
            let x = triple[0];
            scale = scale.min(place.greatest / x);
            for j in 0..N {
                scale = scale.min(place.accelerations[j] / place.acceleration(&triple, j).abs().max(1e-12));
                let jerk = x.sqrt() * place.jerk(&triple, j).abs();
                scale = scale.min((place.jerks[j] / jerk.max(1e-12)).powi(2).cbrt());
            }
        }
        free.iter_mut().for_each(|c| *c *= (scale * WITHIN).min(1.0));
        (scale > 0.0 && scale.is_finite()).then_some(free)
    }

    /// Newton's method for one weight of time.
    fn centre(&self, free: &mut [f64], weight: f64, goes_on: &mut dyn FnMut() -> bool) -> Option<()> {
        let mut full = self.full(free);
        let mut merit = self.merit(&full, weight);
        for _ in 0..STEPS {
            if !goes_on() {
                return None;
            }
            let (gradient, bands) = self.model(&full, weight);
            let Some(step) = solved(&gradient, bands) else { break };
            let decrement: f64 = -step.iter().zip(&gradient).map(|(d, g)| d * g).sum::<f64>();
            if decrement < DECREMENT {
                break;
            }
            let way = self.full(&step);
            let mut share = SHORT_OF * self.room(&full, &way);
            let mut moved = false;
            for _ in 0..12 {
                let trial: Vec<f64> = full.iter().zip(&way).map(|(c, d)| c + share * d).collect();
                let value = self.merit(&trial, weight);
                if value < merit - 1e-4 * share * decrement {
                    for (c, d) in free.iter_mut().zip(&step) {
                        *c += share * d;
                    }
                    (full, merit, moved) = (trial, value, true);
                    break;
                }
                share /= 3.0;
            }
            if !moved {
                break;
            }
        }
        Some(())
    }

    /// How far along a step the linear limits allow to go, at most 1.
    fn room(&self, full: &[f64], way: &[f64]) -> f64 {
        let mut room = 1.0 / SHORT_OF;
        for (c, d) in full.iter().zip(way) {
            if c + room * d < 0.0 {
                room = -c / d;
            }
        }
        for place in &self.places {
            let (at, by) = (place.triple(full), place.triple(way));
            if at[0] + room * by[0] > place.greatest {
                room = (place.greatest - at[0]) / by[0];
            }
            for j in 0..N {
                let (a, d) = (place.acceleration(&at, j), place.acceleration(&by, j));
                if (a + room * d).abs() > place.accelerations[j] {
                    room = (place.accelerations[j] - a * d.signum()) / d.abs();
                }
            }
        }
        room.max(0.0)
    }

    /// Weighted time plus barriers; infinite where a limit is broken.
    fn merit(&self, full: &[f64], weight: f64) -> f64 {
        let mut sum = 0.0;
        for c in full {
            if *c <= 0.0 {
                return f64::INFINITY;
            }
            sum -= c.ln();
        }
        for place in &self.places {
            let triple = place.triple(full);
            let x = triple[0];
            if x <= 0.0 {
                return f64::INFINITY;
            }
            let root = 1.0 / x.sqrt();
            sum += weight * place.share * root;
            let mut slack = 1.0 - x / place.greatest;
            if slack <= 0.0 {
                return f64::INFINITY;
            }
            for j in 0..N {
                let a = place.acceleration(&triple, j) / place.accelerations[j];
                let jerk = place.jerk(&triple, j) / place.jerks[j];
                let (hard, harder) = (1.0 - a * a, root * root - jerk * jerk);
                if hard <= 0.0 || harder <= 0.0 {
                    return f64::INFINITY;
                }
                slack *= hard * harder;
            }
            sum -= slack.ln();
        }
        sum
    }

    /// The gradient with respect to the free coefficients, and the diagonals of the convex part of the Hessian: the main one, the
    /// first and the second beside it.
    fn model(&self, full: &[f64], weight: f64) -> (Vec<f64>, Vec<[f64; 3]>) {
        let count = self.coefficients;
        let mut gradient = vec![0.0; count];
        let mut bands = vec![[0.0; 3]; count];
        for (i, c) in full.iter().enumerate() {
            gradient[i] -= 1.0 / c;
            bands[i][0] += 1.0 / (c * c);
        }
        for place in &self.places {
            let triple = place.triple(full);
            let (g, h) = place.model(&triple, weight);
            // From x, u, u′ to the three coefficients.
            let rows = [&place.x, &place.u, &place.rise];
            for a in 0..3 {
                let mut mapped = [0.0; 3];
                for r in 0..3 {
                    gradient[place.first + a] += rows[r][a] * g[r];
                    for q in 0..3 {
                        mapped[q] += rows[r][a] * h[r][q];
                    }
                }
                for b in a..3 {
                    let value: f64 = (0..3).map(|q| mapped[q] * rows[q][b]).sum();
                    bands[place.first + a][b - a] += value;
                }
            }
        }
        self.fold(&gradient, &bands)
    }

    /// Eliminates the first and the last coefficient, which depend on their neighbours.
    fn fold(&self, gradient: &[f64], bands: &[[f64; 3]]) -> (Vec<f64>, Vec<[f64; 3]>) {
        let n = self.coefficients;
        let mut g = gradient[1..n - 1].to_vec();
        let mut b = bands[1..n - 1].to_vec();
        let m = g.len();
        let [t, e] = self.ties;
        g[0] += t * gradient[0];
        b[0][0] += 2.0 * t * bands[0][1] + t * t * bands[0][0];
        b[0][1] += t * bands[0][2];
        g[m - 1] += e * gradient[n - 1];
        b[m - 1][0] += 2.0 * e * bands[n - 2][1] + e * e * bands[n - 1][0];
        b[m - 2][1] += e * bands[n - 3][2];
        b[m - 1][1] = 0.0;
        b[m - 1][2] = 0.0;
        b[m - 2][2] = 0.0;
        (g, b)
    }
}

impl<const N: usize> Place<N> {
    fn triple(&self, full: &[f64]) -> Triple {
        let c = &full[self.first..self.first + 3];
        let of = |w: &[f64; 3]| w[0] * c[0] + w[1] * c[1] + w[2] * c[2];
        [of(&self.x), of(&self.u), of(&self.rise)]
    }

    fn acceleration(&self, [x, u, _]: &Triple, j: usize) -> f64 {
        self.path[0][j] * u + self.path[1][j] * x
    }

    /// Jerk divided by √x.
    fn jerk(&self, [x, u, rise]: &Triple, j: usize) -> f64 {
        self.path[0][j] * rise + 3.0 * self.path[1][j] * u + self.path[2][j] * x
    }

    /// Gradient and Hessian of weighted time and barriers with respect to x, u, u′.
    fn model(&self, triple: &Triple, weight: f64) -> (Triple, [Triple; 3]) {
        let x = triple[0];
        let root = 1.0 / x.sqrt();
        let mut g = [-0.5 * weight * self.share * root / x, 0.0, 0.0];
        let mut h = [[0.0; 3]; 3];
        h[0][0] = 0.75 * weight * self.share * root / (x * x);
        let slack = 1.0 / (self.greatest - x);
        g[0] += slack;
        h[0][0] += slack * slack;
        for j in 0..N {
            let [p1, p2, p3] = [self.path[0][j], self.path[1][j], self.path[2][j]];
            let (a, limit) = (self.acceleration(triple, j), self.accelerations[j]);
            let (above, below) = (1.0 / (limit - a), 1.0 / (limit + a));
            let (slope, bend) = (above - below, above * above + below * below);
            g[0] += slope * p2;
            g[1] += slope * p1;
            h[0][0] += bend * p2 * p2;
            h[0][1] += bend * p1 * p2;
            h[1][1] += bend * p1 * p1;
            let (y, limit) = (self.jerk(triple, j), self.jerks[j]);
            let tangent = 0.5 * limit * root / x;
            for (sign, slack) in [(1.0, limit * root - y), (-1.0, limit * root + y)] {
                // −∇ of the slack, divided by it.
                let by = 1.0 / slack;
                let d = [(tangent + sign * p3) * by, 3.0 * sign * p2 * by, sign * p1 * by];
                for r in 0..3 {
                    g[r] += d[r];
                    for q in r..3 {
                        h[r][q] += d[r] * d[q];
                    }
                }
            }
        }
        h[1][0] = h[0][1];
        h[2][0] = h[0][2];
        h[2][1] = h[1][2];
        (g, h)
    }
}

/// −H⁻¹ g by L D Lᵀ; `None` where H is not positive definite.
fn solved(gradient: &[f64], mut bands: Vec<[f64; 3]>) -> Option<Vec<f64>> {
    let n = gradient.len();
    let mut step: Vec<f64> = gradient.iter().map(|g| -g).collect();
    for i in 0..n {
        let [d, one, two] = bands[i];
        if d <= 0.0 || !d.is_finite() {
            return None;
        }
        let (l1, l2) = (one / d, two / d);
        if i + 1 < n {
            bands[i + 1][0] -= l1 * one;
            bands[i + 1][1] -= l1 * two;
            step[i + 1] -= l1 * step[i];
        }
        if i + 2 < n {
            bands[i + 2][0] -= l2 * two;
            step[i + 2] -= l2 * step[i];
        }
        bands[i] = [d, l1, l2];
    }
    for i in (0..n).rev() {
        let [d, l1, l2] = bands[i];
        step[i] /= d;
        if i + 1 < n {
            step[i] -= l1 * step[i + 1];
        }
        if i + 2 < n {
            step[i] -= l2 * step[i + 2];
        }
    }
    Some(step)
}
