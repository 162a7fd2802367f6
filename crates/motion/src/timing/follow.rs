//! A path from rest to rest, followed as fast as the limits allow: the knots of its trajectory.
//!
//! A straight line is a double S in closed form. Any other path is first timed within velocity and acceleration limits
//! (`second_order`); where jerk is limited, that gives the mesh (`mesh`) for the third order (`third_order`). A cubic spline interpolates the
//! path at the points of the mesh, at their times. The spline is the trajectory itself, so its cubics are checked against the limits in
//! closed form: where one exceeds a limit, that limit is tightened there, and the path is timed again. The remaining excess slows the
//! whole path, by some thousandths.

use super::cubics;
use super::double_s::{self, double_s};
use super::mesh::mesh;
use super::path::{Derivatives, Path};
use super::second_order::Second;
use super::third_order::{Limits, Mesh, quickest};
use super::{Speed, Tool};
use crate::cubic::Cubic;
use crate::joint_vector::JointVector;
use crate::robot::Joint;
use crate::trajectory::Knot;

/// The joints' limits at the chosen speed.
#[derive(Debug, Clone)]
pub(crate) struct Bounds<const N: usize> {
    pub(crate) velocities: [f64; N],
    pub(crate) accelerations: [f64; N],
    pub(crate) jerks: [f64; N],
    /// Least and greatest positions.
    pub(crate) lower: [f64; N],
    pub(crate) upper: [f64; N],
    tool: Option<Tool>,
    /// How many of the `N` joints the robot has.
    pub(crate) joints: usize,
}

/// Factors of the grid's density, tried where limits are exceeded between its points.
const DENSER: [f64; 3] = [2.0, 4.0, 8.0];

/// Number of points on a straight line at which the tool's speed is checked, in addition to the first.
const LINE_PLACES: usize = 64;

/// Number of knots in the first cell and in the last.
const FIRST_KNOTS: usize = 8;

/// Number of rounds in which exceeded limits are tightened, and an additional factor.
const ROUNDS: usize = 3;
const TIGHTER: f64 = 0.999;
/// A limit that is exceeded by less than this factor is handled by slowing down.
const CLOSE: f64 = 1.003;

impl<const N: usize> Bounds<N> {
    /// The limits of joints; those of velocity and acceleration are multiplied by the speed.
    pub(crate) fn new(joints: &[Joint], Speed { share: speed, tool }: Speed) -> Bounds<N> {
        // Joints beyond the robot's stand still, so their limits do not matter.
        let joint = |j: usize| joints.get(j).unwrap_or(&joints[0]);
        let limits = |j: usize| joints.get(j).map_or([0.0; 2], Joint::limits);
        Bounds {
            velocities: std::array::from_fn(|j| joint(j).velocity * speed),
            accelerations: std::array::from_fn(|j| joint(j).acceleration * speed),
            jerks: std::array::from_fn(|j| joint(j).jerk),
            lower: std::array::from_fn(|j| limits(j)[0]),
            upper: std::array::from_fn(|j| limits(j)[1]),
            tool,
            joints: joints.len(),
        }
    }

    /// Maximum speed along the path at a point, because of the tool's limits.
    pub(crate) fn fastest(&self, at: &Derivatives<N>) -> f64 {
        let of_joints = |padded: &[f64; N]| JointVector::from_fn(self.joints, |j| padded[j]);
        self.tool.as_ref().map_or(f64::INFINITY, |tool| tool.fastest(&of_joints(&at.position), &of_joints(&at.first)))
    }

    /// The limits along a line on which the tool is nowhere too fast.
    fn along_line(&self, path: &Path<N>) -> double_s::Limits {
        let mut limits = self.along(&path.segments()[0].at(0.0).first);
        if self.tool.is_some() {
            let places = (0..=LINE_PLACES).map(|i| path.at(path.length() * i as f64 / LINE_PLACES as f64));
            limits.velocity = places.map(|place| self.fastest(&place)).fold(limits.velocity, f64::min);
        }
        limits
    }

    /// Whether the tool's limits slow down a line.
    fn is_slowed(&self, path: &Path<N>) -> bool {
        self.tool.is_some() && self.along_line(path).velocity < self.along(&path.segments()[0].at(0.0).first).velocity
    }

    /// The limits along a direction.
    pub(crate) fn along(&self, direction: &[f64; N]) -> double_s::Limits {
        let least = |limits: &[f64; N]| {
            let of = |j: usize| limits[j] / direction[j].abs().max(1e-12);
            (0..N).map(of).fold(f64::INFINITY, f64::min)
        };
        double_s::Limits {
            velocity: least(&self.velocities),
            acceleration: least(&self.accelerations),
            jerk: least(&self.jerks),
        }
    }

    fn limits_jerk(&self) -> bool {
        self.jerks.iter().any(|j| j.is_finite())
    }
}

/// The knots, the first at 0; `None` where `goes_on`, which is asked often, returns false.
pub(crate) fn follow<const N: usize>(
    path: &Path<N>,
    bounds: &Bounds<N>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<[f64; N]>>> {
    if !path.is_line() {
        return curved(path, bounds, goes_on);
    }
    let straight = straight(path, bounds);
    // A tool that would be too fast somewhere on the line need not be slow elsewhere.
    let other = if bounds.is_slowed(path) { curved(path, bounds, goes_on) } else { None };
    let lasts_s = |knots: &[Knot<[f64; N]>]| knots[knots.len() - 1].time_s;
    Some(other.filter(|other| lasts_s(other) < lasts_s(&straight)).unwrap_or(straight))
}

/// Follows any path, as [`follow`].
fn curved<const N: usize>(
    path: &Path<N>,
    bounds: &Bounds<N>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<[f64; N]>>> {
    let second = Second::of(path, bounds, 1.0);
    let knots = match bounds.limits_jerk() {
        true => third(path, bounds, &second.refined(path, bounds), goes_on),
        false => Some(second_order(path, bounds, second)),
    };
    knots.map(|knots| slowed(knots, bounds))
}

/// The approximate duration of a path, computed faster than by [`follow`].
pub(crate) fn estimate<const N: usize>(path: &Path<N>, bounds: &Bounds<N>) -> f64 {
    if path.is_line() {
        let instants = double_s(path.length(), bounds.along_line(path));
        return instants[instants.len() - 1].time_s;
    }
    let second = Second::of(path, bounds, 1.0);
    let limits = bounds.along(&path.segments()[0].at(0.0).first);
    second.lasts_s() + (limits.acceleration / limits.jerk).min((limits.velocity / limits.jerk).sqrt())
}

fn straight<const N: usize>(path: &Path<N>, bounds: &Bounds<N>) -> Vec<Knot<[f64; N]>> {
    let line = &path.segments()[0];
    let direction = line.at(0.0).first;
    let instants = double_s(path.length(), bounds.along_line(path));
    let knot = |i: &double_s::Instant| Knot {
        time_s: i.time_s,
        positions: line.at(i.way).position,
        velocities: direction.map(|d| d * i.velocity),
    };
    instants.iter().map(knot).collect()
}

/// The knots on a grid so dense that the limits hold between its points as well, except for a small excess.
fn second_order<const N: usize>(path: &Path<N>, bounds: &Bounds<N>, second: Second<N>) -> Vec<Knot<[f64; N]>> {
    let mut knots = second.knots();
    let excess = |knots: &[Knot<[f64; N]>]| knots.windows(2).map(|pair| slower(used(pair, bounds))).fold(1.0, f64::max);
    for density in DENSER {
        if excess(&knots) < CLOSE {
            break;
        }
        let denser = Second::of(path, bounds, density).knots();
        let lasts = |knots: &[Knot<[f64; N]>]| knots[knots.len() - 1].time_s * excess(knots);
        if lasts(&denser) < lasts(&knots) {
            knots = denser;
        }
    }
    knots
}

/// The path timed within limits of jerk, too; `None` where no profile was found.
fn third<const N: usize>(
    path: &Path<N>,
    bounds: &Bounds<N>,
    second: &Second<N>,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Vec<Knot<[f64; N]>>> {
    let mesh = mesh(path, bounds, second);
    let cells = mesh.s.len() - 1;
    let mut limits = Limits {
        fastest: mesh.cells.iter().map(|cell| cell.each_ref().map(|at| bounds.fastest(at))).collect(),
        velocities: vec![bounds.velocities; cells],
        accelerations: vec![bounds.accelerations; cells],
        jerks: vec![bounds.jerks; cells],
    };
    let mut best: Option<(f64, Vec<Knot<[f64; N]>>)> = None;
    let mut last = None;
    for _ in 0..ROUNDS {
        let Some(profile) = quickest(&mesh, &limits, last.as_ref(), goes_on) else { break };
        let (times, positions) = timed(path, &mesh, &profile.x, &profile.u);
        let knots = cubics::through(&times, &positions);
        let excess = tighten(&knots, bounds, &mut limits);
        let lasts = knots[knots.len() - 1].time_s * excess;
        if best.as_ref().is_none_or(|(least, _)| lasts < *least) {
            best = Some((lasts, knots));
        }
        if excess < CLOSE {
            break;
        }
        last = Some(profile);
    }
    best.map(|(_, knots)| knots)
}

/// Times and positions of the knots: all points of the mesh, and additional ones in the first and the last cell.
fn timed<const N: usize>(path: &Path<N>, mesh: &Mesh<N>, x: &[f64], u: &[f64]) -> (Vec<f64>, Vec<[f64; N]>) {
    let n = mesh.s.len() - 1;
    let cell = |k: usize| mesh.s[k + 1] - mesh.s[k];
    let (from_rest, to_rest) = ((6.0 * cell(0) / u[1]).sqrt(), (6.0 * cell(n - 1) / -u[n - 1]).sqrt());
    let segments = path.segments();
    let (first, last) = (&segments[0], &segments[segments.len() - 1]);
    let (mut times, mut positions) = (Vec::with_capacity(n + 20), Vec::with_capacity(n + 20));
    for i in 0..=FIRST_KNOTS {
        let share = i as f64 / FIRST_KNOTS as f64;
        times.push(from_rest * share);
        positions.push(first.at(cell(0) * share.powi(3)).position);
    }
    for k in 1..n - 1 {
        times.push(times[times.len() - 1] + lasts(cell(k), [x[k], x[k + 1]], [u[k], u[k + 1]]));
        positions.push(mesh.cells[k][2].position);
    }
    let begins = times[times.len() - 1];
    for i in 1..=FIRST_KNOTS {
        let share = i as f64 / FIRST_KNOTS as f64;
        times.push(begins + to_rest * share);
        positions.push(last.at(last.length - cell(n - 1) * (1.0 - share).powi(3)).position);
    }
    (times, positions)
}

/// ∫ ds / √x over a cell in which x is quadratic, by the Gauss-Legendre rule with five points.
fn lasts(cell: f64, x: [f64; 2], u: [f64; 2]) -> f64 {
    const RULE: [(f64, f64); 5] = [
        (0.046_910_077_030_668, 0.118_463_442_528_095),
        (0.230_765_344_947_158, 0.239_314_335_249_683),
        (0.5, 0.284_444_444_444_444),
        (0.769_234_655_052_842, 0.239_314_335_249_683),
        (0.953_089_922_969_332, 0.118_463_442_528_095),
    ];
    let square = |share: f64| {
        let way = share * cell;
        x[0] + way * (2.0 * u[0] + share * (u[1] - u[0]))
    };
    cell * RULE.iter().map(|(share, weight)| weight / square(*share).sqrt()).sum::<f64>()
}

/// The part of its limits that a cubic uses: velocity, acceleration and jerk.
fn used<const N: usize>(pair: &[Knot<[f64; N]>], bounds: &Bounds<N>) -> [f64; 3] {
    let mut used = [0.0_f64; 3];
    for j in 0..N {
        let cubic = Cubic::between(&pair[0], &pair[1], j);
        used[0] = used[0].max(cubic.greatest_velocity() / bounds.velocities[j]);
        used[1] = used[1].max(cubic.greatest_acceleration() / bounds.accelerations[j]);
        used[2] = used[2].max(cubic.jerk.abs() / bounds.jerks[j]);
    }
    used
}

/// The time scaling that brings this use of the limits within them.
fn slower([velocity, acceleration, jerk]: [f64; 3]) -> f64 {
    velocity.max(acceleration.sqrt()).max(jerk.cbrt()).max(1.0)
}

/// Tightens limits in the cells where the knots exceed them; returns the time scaling that the knots would need.
fn tighten<const N: usize>(knots: &[Knot<[f64; N]>], bounds: &Bounds<N>, limits: &mut Limits<N>) -> f64 {
    let cells = limits.jerks.len();
    let mut excess = 1.0_f64;
    let mut broken = vec![[1.0_f64; 3]; cells];
    for (i, pair) in knots.windows(2).enumerate() {
        let used = used(pair, bounds);
        excess = excess.max(slower(used));
        let cell = (i + 1).saturating_sub(FIRST_KNOTS).min(cells - 1);
        for near in &mut broken[cell.saturating_sub(1)..=(cell + 1).min(cells - 1)] {
            for (most, used) in near.iter_mut().zip(used) {
                *most = most.max(used);
            }
        }
    }
    for (k, [velocity, acceleration, jerk]) in broken.into_iter().enumerate() {
        let tighter = |limits: &mut [f64; N], used: f64| {
            if used > 1.0 {
                limits.iter_mut().for_each(|l| *l *= TIGHTER / used);
            }
        };
        tighter(&mut limits.velocities[k], velocity);
        tighter(&mut limits.accelerations[k], acceleration);
        tighter(&mut limits.jerks[k], jerk);
    }
    excess
}

/// Slows the motion down by the excess of its cubics over the limits, if there is any.
fn slowed<const N: usize>(mut knots: Vec<Knot<[f64; N]>>, bounds: &Bounds<N>) -> Vec<Knot<[f64; N]>> {
    let factor = knots.windows(2).map(|pair| slower(used(pair, bounds))).fold(1.0, f64::max);
    if factor > 1.0 {
        for knot in &mut knots {
            knot.time_s *= factor * (1.0 + 1e-12);
            knot.velocities = knot.velocities.map(|v| v / factor);
        }
    }
    knots
}
