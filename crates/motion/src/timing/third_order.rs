//! The fastest way to follow a path within limits of velocity, acceleration *and jerk*.
//!
//! As in the second order (`reachability`), the unknown is x = ṡ² over s, here as a quadratic spline, so that u = s̈ is continuous and
//! s⃛ = u′ √x. With the path's derivatives q′, q″, q‴ a joint's acceleration q′ u + q″ x is linear in x and u, and its jerk is √x (q′
//! u′ + 3 q″ u + q‴ x). So minimising ∫ ds / √x is a convex problem except for the root in 1 / √x ≥ |q′ u′ + 3 q″ u + q‴ x| / J, which
//! is replaced by its tangent in each step: what satisfies the tangent satisfies the root. It is solved by a primal-dual interior-point
//! method (Boyd and Vandenberghe, *Convex Optimization*, section 11.7; Verscheure and others, *Time-Optimal Path Tracking for Robots: a
//! Convex Optimization Approach*, 2009, for the second order). Every step stays within all limits; the matrix has five diagonals, so the
//! time of a step is proportional to the number of points.
//!
//! At rest x is not a polynomial of s: in the first and in the last cell s⃛ is constant instead, s = s⃛ t³ / 6, so x = 1.5 u s.

use super::path::Derivatives;

/// The cells of the mesh: each from one point to the next, inside one segment of the path.
pub(crate) struct Mesh<const N: usize> {
    /// From 0 to the path's length; at least five points.
    pub(crate) s: Vec<f64>,
    /// The path's derivatives at the beginning, in the middle and at the end of each cell, as seen from inside the cell.
    pub(crate) cells: Vec<[Derivatives<N>; 3]>,
    /// x in the middle of each cell, without limits of jerk.
    pub(crate) without_jerk: Vec<f64>,
    /// The number of joints that move; the others, up to `N`, stand still.
    pub(crate) joints: usize,
}

/// Limits of the joints in each cell of a mesh.
#[derive(Debug, Clone)]
pub(crate) struct Limits<const N: usize> {
    /// Maximum of ṡ, at the beginning, in the middle and at the end of each cell.
    pub(crate) fastest: Vec<[f64; 3]>,
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

/// The part of the duration that may be lost because the search ends.
const LOSS: f64 = 2e-4;
/// The duality gap at the beginning, as a part of the duration: of a first search, and of one that starts from another profile.
const GAPS: [f64; 2] = [1.0, 0.01];
/// Maximum number of Newton steps.
const STEPS: usize = 60;
/// The part of the gap that a step aims at: in the first one, and at least and at most in others, where short steps call for more of it.
const CENTRING: [f64; 3] = [0.3, 0.05, 0.8];
/// The part of the limits that the initial profile uses.
const WITHIN: f64 = 0.9;
/// Maximum length of a step, as a part of the distance to the nearest limit.
const SHORT_OF: f64 = 0.95;

/// A point at which ṡ is limited and time is counted, with x there as a linear function of three coefficients.
struct Speed {
    /// The index of the first of the three coefficients.
    first: usize,
    x: [f64; 3],
    greatest: f64,
    /// The distance that this point represents, by Simpson's rule.
    share: f64,
}

/// One end of a cell, with x, u and u′ there as linear functions of the three coefficients before, at and after the cell.
struct Place<const N: usize> {
    /// The index of the first of the three coefficients.
    first: usize,
    x: [f64; 3],
    u: [f64; 3],
    rise: [f64; 3],
    /// The path's derivatives over the limits of acceleration, and over those of jerk.
    by_acceleration: [[f64; N]; 2],
    by_jerk: [[f64; N]; 3],
}

struct Problem<const N: usize> {
    speeds: Vec<Speed>,
    places: Vec<Place<N>>,
    coefficients: usize,
    /// The first and the last coefficient as multiples of their neighbours.
    ties: [f64; 2],
    joints: usize,
}

/// One value for each limit: its slack, its multiplier, or how fast that changes.
struct PerLimit<const N: usize> {
    /// Of the coefficients, which are positive.
    positive: Vec<f64>,
    speeds: Vec<f64>,
    /// Of the acceleration from above and below, and of the jerk.
    places: Vec<[[f64; 4]; N]>,
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
    let start = wider.map_or(&mesh.without_jerk[1..n - 1], |profile| &profile.c);
    let mut c = problem.within(start.to_vec())?;
    problem.solve(&mut c, GAPS[usize::from(wider.is_some())], goes_on)?;
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
        // Starting from rest the jerk is about q′ s⃛, and x there follows from s⃛ and the distance.
        let from_rest = |k: usize, slope: &Derivatives<N>| {
            let hardest = (0..mesh.joints).map(|j| limits.jerks[k][j] / slope.first[j].abs().max(1e-12));
            1.5 * cell(k) * (6.0 * cell(k) * hardest.fold(f64::INFINITY, f64::min).powi(2)).cbrt()
        };
        let mut speeds: Vec<Speed> = Vec::with_capacity(3 * n);
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
            let middle = std::array::from_fn(|c| nodes[0].0[c] + cell(k) * (3.0 * nodes[0].1[c] + nodes[1].1[c]) / 4.0);
            for (i, x) in [nodes[0].0, middle, nodes[1].0].into_iter().enumerate() {
                let of = |j: usize| limits.velocities[k][j] / mesh.cells[k][i].first[j].abs().max(1e-12);
                let mut greatest = (0..mesh.joints).map(of).fold(limits.fastest[k][i], f64::min).powi(2);
                if (k, i) == (1, 0) {
                    greatest = greatest.min(from_rest(0, &mesh.cells[0][0]));
                }
                if (k, i) == (n - 2, 2) {
                    greatest = greatest.min(from_rest(n - 1, &mesh.cells[n - 1][2]));
                }
                speeds.push(Speed { first: k - 1, x, greatest, share: cell(k) * [1.0, 4.0, 1.0][i] / 6.0 });
            }
            for (end, (x, u)) in nodes.into_iter().enumerate() {
                let path = &mesh.cells[k][2 * end];
                let over =
                    |derivative: &[f64; N], limits: &[f64; N]| std::array::from_fn(|j| derivative[j] / limits[j]);
                let (accelerations, jerks) = (&limits.accelerations[k], &limits.jerks[k]);
                let by_acceleration = [&path.first, &path.second].map(|d| over(d, accelerations));
                let by_jerk = [&path.first, &path.second, &path.third].map(|d| over(d, jerks));
                places.push(Place { first: k - 1, x, u, rise, by_acceleration, by_jerk });
            }
        }
        Problem { speeds, places, coefficients: n, ties, joints: mesh.joints }
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
        for speed in &self.speeds {
            scale = scale.min(speed.greatest / speed.x(&full));
        }
        for place in &self.places {
            let triple = place.triple(&full);
            for j in 0..self.joints {
                scale = scale.min(1.0 / place.acceleration(&triple, j).abs().max(1e-12));
                let jerk = triple[0].sqrt() * place.jerk(&triple, j).abs();
                scale = scale.min((1.0 / jerk.max(1e-12)).powi(2).cbrt());
            }
        }
        free.iter_mut().for_each(|c| *c *= (scale * WITHIN).min(1.0));
        (scale > 0.0 && scale.is_finite()).then_some(free)
    }

    /// The duration, except for the first and the last cell.
    fn lasts_s(&self, full: &[f64]) -> f64 {
        self.speeds.iter().map(|speed| speed.share / speed.x(full).sqrt()).sum()
    }

    /// Newton's method for the optimality conditions, whose complementarity is relaxed less from step to step; from a duality gap that is
    /// this part of the duration.
    fn solve(&self, free: &mut [f64], gap: f64, goes_on: &mut dyn FnMut() -> bool) -> Option<()> {
        let mut full = self.full(free);
        let count = (full.len() + self.speeds.len() + 4 * self.joints * self.places.len()) as f64;
        let relaxed = gap * self.lasts_s(&full) / count;
        let mut multipliers = self.slacks(&full, |slack| relaxed / slack);
        let mut centring = CENTRING[0];
        for _ in 0..STEPS {
            if !goes_on() {
                return None;
            }
            let system = self.system(&full, &multipliers);
            let lasts_s = self.lasts_s(&full);
            let relaxed = centring * system.gap / count;
            let gradient: Vec<f64> = system.time.iter().zip(&system.barrier).map(|(t, b)| t + relaxed * b).collect();
            let (gradient, bands) = self.fold(&gradient, &system.bands);
            let Some(step) = solved(&gradient, bands) else { break };
            let decrement: f64 = -step.iter().zip(&gradient).map(|(d, g)| d * g).sum::<f64>();
            if system.gap + decrement < LOSS * lasts_s {
                break;
            }
            let way = self.full(&step);
            let (changes, shares) = self.changes(&full, &way, &multipliers, relaxed);
            let [share, of_multipliers] = shares.map(|room| (SHORT_OF * room).min(1.0));
            for (c, d) in free.iter_mut().zip(&step) {
                *c += share * d;
            }
            for (c, d) in full.iter_mut().zip(&way) {
                *c += share * d;
            }
            multipliers.add(of_multipliers, &changes);
            centring = (1.0 - share.min(of_multipliers)).powi(2).clamp(CENTRING[1], CENTRING[2]);
        }
        Some(())
    }

    /// A value for each limit from its slack.
    fn slacks(&self, full: &[f64], value: impl Fn(f64) -> f64) -> PerLimit<N> {
        let of = |place: &Place<N>| {
            let triple = place.triple(full);
            std::array::from_fn(|j| place.slacks(&triple, j).map(&value))
        };
        PerLimit {
            positive: full.iter().map(|c| value(*c)).collect(),
            speeds: self.speeds.iter().map(|speed| value(1.0 - speed.x(full) / speed.greatest)).collect(),
            places: self.places.iter().map(of).collect(),
        }
    }

    /// The optimality conditions, made linear.
    fn system(&self, full: &[f64], multipliers: &PerLimit<N>) -> System {
        let count = self.coefficients;
        let mut system =
            System { time: vec![0.0; count], barrier: vec![0.0; count], bands: vec![[0.0; 3]; count], gap: 0.0 };
        for (i, (c, multiplier)) in full.iter().zip(&multipliers.positive).enumerate() {
            system.barrier[i] -= 1.0 / c;
            system.bands[i][0] += multiplier / c;
            system.gap += multiplier * c;
        }
        for (speed, multiplier) in self.speeds.iter().zip(&multipliers.speeds) {
            let x = speed.x(full);
            let slack = 1.0 - x / speed.greatest;
            let time = speed.share / (x * x * x.sqrt());
            let bend = multiplier / slack / speed.greatest.powi(2) + 0.75 * time;
            for a in 0..3 {
                system.time[speed.first + a] -= speed.x[a] * 0.5 * time * x;
                system.barrier[speed.first + a] += speed.x[a] / (slack * speed.greatest);
                for b in a..3 {
                    system.bands[speed.first + a][b - a] += speed.x[a] * speed.x[b] * bend;
                }
            }
            system.gap += multiplier * slack;
        }
        for (place, multipliers) in self.places.iter().zip(&multipliers.places) {
            let (g, h, gap) = place.model(full, &multipliers[..self.joints]);
            system.gap += gap;
            // From x, u, u′ to the three coefficients.
            let rows = [&place.x, &place.u, &place.rise];
            for a in 0..3 {
                let mut mapped = [0.0; 3];
                for r in 0..3 {
                    system.barrier[place.first + a] += rows[r][a] * g[r];
                    for q in 0..3 {
                        mapped[q] += rows[r][a] * h[r][q];
                    }
                }
                for (band, b) in system.bands[place.first + a].iter_mut().zip(a..3) {
                    *band += rows.iter().zip(mapped).map(|(row, mapped)| mapped * row[b]).sum::<f64>();
                }
            }
        }
        system
    }

    /// How the multipliers change along a step, and how much of the step the limits and the multipliers, which are positive, allow.
    fn changes(&self, full: &[f64], way: &[f64], multipliers: &PerLimit<N>, relaxed: f64) -> (PerLimit<N>, [f64; 2]) {
        let mut rooms = [f64::INFINITY; 2];
        let mut change = |slack: f64, by: f64, multiplier: f64| {
            let change = (relaxed - multiplier * by) / slack - multiplier;
            rooms = [rooms[0].min(room(slack, by)), rooms[1].min(room(multiplier, change))];
            change
        };
        let positive = (0..full.len()).map(|i| change(full[i], way[i], multipliers.positive[i])).collect();
        let of_speed = |(speed, multiplier): (&Speed, &f64)| {
            change(1.0 - speed.x(full) / speed.greatest, -speed.x(way) / speed.greatest, *multiplier)
        };
        let speeds = self.speeds.iter().zip(&multipliers.speeds).map(of_speed).collect();
        let mut places = vec![[[0.0; 4]; N]; self.places.len()];
        for (i, place) in self.places.iter().enumerate() {
            let (at, by) = (place.triple(full), place.triple(way));
            // Along the tangent of the root.
            let falls = 0.5 * by[0] / (at[0] * at[0].sqrt());
            for (j, changes) in places[i].iter_mut().enumerate().take(self.joints) {
                let slacks = place.slacks(&at, j);
                let (a, y) = (place.acceleration(&by, j), place.jerk(&by, j));
                let steps = [-a, a, -falls - y, y - falls];
                *changes = std::array::from_fn(|k| change(slacks[k], steps[k], multipliers.places[i][j][k]));
            }
        }
        (PerLimit { positive, speeds, places }, rooms)
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

/// What a Newton step is made of.
struct System {
    /// The gradients of the time and of the logarithmic barrier.
    time: Vec<f64>,
    barrier: Vec<f64>,
    /// The diagonals of the matrix: the main one, the first and the second beside it.
    bands: Vec<[f64; 3]>,
    /// The sum of slacks times multipliers.
    gap: f64,
}

/// How much of a change a positive value allows.
fn room(value: f64, change: f64) -> f64 {
    if change < 0.0 { -value / change } else { f64::INFINITY }
}

impl<const N: usize> PerLimit<N> {
    fn add(&mut self, share: f64, changes: &PerLimit<N>) {
        let pairs = self.positive.iter_mut().zip(&changes.positive).chain(self.speeds.iter_mut().zip(&changes.speeds));
        let places = self.places.as_flattened_mut().as_flattened_mut().iter_mut();
        let pairs = pairs.chain(places.zip(changes.places.as_flattened().as_flattened()));
        pairs.for_each(|(value, change)| *value += share * change);
    }
}

/// A linear function of three coefficients.
fn linear(weights: &[f64; 3], c: &[f64]) -> f64 {
    weights[0] * c[0] + weights[1] * c[1] + weights[2] * c[2]
}

impl Speed {
    fn x(&self, full: &[f64]) -> f64 {
        linear(&self.x, &full[self.first..])
    }
}

impl<const N: usize> Place<N> {
    fn triple(&self, full: &[f64]) -> Triple {
        let c = &full[self.first..self.first + 3];
        [linear(&self.x, c), linear(&self.u, c), linear(&self.rise, c)]
    }

    /// Acceleration over its limit.
    fn acceleration(&self, [x, u, _]: &Triple, j: usize) -> f64 {
        self.by_acceleration[0][j] * u + self.by_acceleration[1][j] * x
    }

    /// Jerk over its limit and √x.
    fn jerk(&self, [x, u, rise]: &Triple, j: usize) -> f64 {
        self.by_jerk[0][j] * rise + 3.0 * self.by_jerk[1][j] * u + self.by_jerk[2][j] * x
    }

    /// What is left of the limits of acceleration, from above and below, and of jerk.
    fn slacks(&self, triple: &Triple, j: usize) -> [f64; 4] {
        let root = 1.0 / triple[0].sqrt();
        let (a, y) = (self.acceleration(triple, j), self.jerk(triple, j));
        [1.0 - a, 1.0 + a, root - y, root + y]
    }

    /// The barrier's gradient with respect to x, u, u′, the part of the matrix, and the gap.
    fn model(&self, full: &[f64], multipliers: &[[f64; 4]]) -> (Triple, [Triple; 3], f64) {
        let triple = self.triple(full);
        let tangent = 0.5 / (triple[0] * triple[0].sqrt());
        let mut g = [0.0; 3];
        let mut h = [[0.0; 3]; 3];
        let mut gap = 0.0;
        for (j, multipliers) in multipliers.iter().enumerate() {
            let slacks = self.slacks(&triple, j);
            let b = slacks.map(|slack| 1.0 / slack);
            let w: [f64; 4] = std::array::from_fn(|k| multipliers[k] * b[k]);
            gap += (0..4).map(|k| multipliers[k] * slacks[k]).sum::<f64>();
            let [p1, p2] = self.by_acceleration.each_ref().map(|d| d[j]);
            g[0] += (b[0] - b[1]) * p2;
            g[1] += (b[0] - b[1]) * p1;
            let bend = w[0] + w[1];
            h[0][0] += bend * p2 * p2;
            h[0][1] += bend * p1 * p2;
            h[1][1] += bend * p1 * p1;
            let [p1, p2, p3] = self.by_jerk.each_ref().map(|d| d[j]);
            let v = [p3, 3.0 * p2, p1];
            g[0] += (b[2] + b[3]) * tangent;
            let (both, apart) = (w[2] + w[3], (w[2] - w[3]) * tangent);
            h[0][0] += both * tangent * tangent + 2.0 * apart * v[0];
            h[0][1] += apart * v[1];
            h[0][2] += apart * v[2];
            for r in 0..3 {
                g[r] += (b[2] - b[3]) * v[r];
                for q in r..3 {
                    h[r][q] += both * v[r] * v[q];
                }
            }
        }
        h[1][0] = h[0][1];
        h[2][0] = h[0][2];
        h[2][1] = h[1][2];
        (g, h, gap)
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
