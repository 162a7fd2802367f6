//! When the arm is where: a path becomes a trajectory within the joints' velocity, acceleration and jerk limits.
//!
//! Every part starts and ends at rest. The corners of the free part are rounded in two ways, each by itself (`blend`) and all along
//! (`spline`), and the quicker one is taken. How fast each piece is followed is for a [`Timing`] to say; ours is [`PhasePlane`].

use crate::blend::rounded;
use crate::collision::{between, distance, length};
use crate::robot::{Joint, Joints, Robot};
use crate::spline::smoothed;
use crate::trajectory::{Curve, Knot};
use ratn_model::value::Trajectory;

/// Says when a piece of a path, followed exactly from rest to rest, is where.
pub trait Timing<const N: usize = 7> {
    /// Points in time, the first at 0, along postures close to each other; `speed` is a fraction of the velocity and
    /// acceleration limits, the limits of jerk hold as they are.
    fn time(&self, piece: &[[f64; N]], limits: &[Joint], speed: f64) -> Vec<Knot<N>>;
}

/// The fastest ds/dt along equal steps of path length s that breaks no limit of velocity and acceleration, by one sweep forwards
/// and one backwards over the phase plane (Bobrow, 1985; Kunz and Stilman, 2012), then averaged over a time so long that jerk
/// keeps within its limit (the integral of a box is a ramp), then slowed down by what sampling and bends leave over the limits.
#[derive(Debug, Clone, Copy, Default)]
pub struct PhasePlane;

/// Path length between two points of the phase plane, in radians.
const STEP_RAD: f64 = 0.01;

/// Time between two points of the trajectory, in seconds.
const KNOT_S: f64 = 0.02;

/// The share of the limits that the sweeps use; the rest is for what sampling rounds off.
const RESERVE: f64 = 0.97;

/// A part of a path, from rest to rest.
#[derive(Debug, Clone, PartialEq)]
pub enum Part<const N: usize = 7> {
    /// Corners may be rounded where nothing is touched.
    Free(Vec<[f64; N]>),
    /// Postures close to each other along a straight line of the tool, to be followed as they are.
    Straight(Vec<[f64; N]>),
}

/// The trajectory along the parts at a fraction `speed` of the limits; velocities and accelerations keep within it. Corners are
/// rounded where `is_free` finds the straight motions from point to point of the curve free.
pub fn parameterise(
    robot: &Robot,
    parts: &[Part],
    speed: f64,
    timing: &dyn Timing,
    is_free: &mut dyn FnMut(&Joints, &Joints) -> bool,
) -> Trajectory {
    timed(robot.arm_joints(), parts, speed, timing, is_free).to_model(robot)
}

/// As [`parameterise`], for any joints.
pub fn timed<const N: usize>(
    joints: &[Joint],
    parts: &[Part<N>],
    speed: f64,
    timing: &dyn Timing<N>,
    is_free: &mut dyn FnMut(&[f64; N], &[f64; N]) -> bool,
) -> Curve<N> {
    let first = parts.first().and_then(|part| match part {
        Part::Free(path) | Part::Straight(path) => path.first(),
    });
    let start = first.copied().unwrap_or([0.0; N]);
    let mut knots = vec![Knot { time_s: 0.0, positions: start, velocities: [0.0; N] }];
    for part in parts {
        let follow = |pieces: &[Vec<[f64; N]>]| {
            let mut knots = knots[knots.len() - 1..].to_vec();
            for piece in pieces {
                let offset = knots[knots.len() - 1].time_s;
                let timed = timing.time(piece, joints, speed);
                knots.extend(timed.into_iter().skip(1).map(|knot| Knot { time_s: knot.time_s + offset, ..knot }));
            }
            knots
        };
        let quickest = match part {
            Part::Straight(path) => follow(std::slice::from_ref(path)),
            Part::Free(path) => {
                let by_blends = follow(&rounded(path, is_free));
                let by_spline = match path.len() {
                    // Where there is no corner both are the same.
                    0..3 => None,
                    _ => Some(follow(&rounded(&smoothed(path, is_free), is_free))),
                };
                let end_s = |knots: &[Knot<N>]| knots[knots.len() - 1].time_s;
                by_spline.filter(|spline| end_s(spline) < end_s(&by_blends)).unwrap_or(by_blends)
            }
        };
        knots.extend_from_slice(&quickest[1..]);
    }
    Curve::new(knots)
}

impl<const N: usize> Timing<N> for PhasePlane {
    fn time(&self, piece: &[[f64; N]], limits: &[Joint], speed: f64) -> Vec<Knot<N>> {
        let whole = length(piece);
        if whole < 1e-6 {
            return vec![Knot { time_s: 0.0, positions: piece[0], velocities: [0.0; N] }];
        }
        let count = ((whole / STEP_RAD).ceil() as usize).max(8);
        let step = whole / count as f64;
        let points = resampled(piece, count, step);
        let phase = Phase::of(&points, step, limits, speed * RESERVE);
        // From full acceleration to full deceleration within the limit of jerk.
        let windows = limits.iter().map(|joint| 2.0 * speed * joint.acceleration / joint.jerk);
        let knots = phase.knots(&points, step, windows.fold(KNOT_S, f64::max));
        stretched(knots, limits, speed)
    }
}

/// `count + 1` points at equal path lengths.
fn resampled<const N: usize>(piece: &[[f64; N]], count: usize, step: f64) -> Vec<[f64; N]> {
    let mut points = vec![piece[0]];
    let (mut i, mut passed) = (0, 0.0);
    for k in 1..count {
        let along = k as f64 * step;
        while i + 2 < piece.len() && passed + distance(&piece[i], &piece[i + 1]) < along {
            passed += distance(&piece[i], &piece[i + 1]);
            i += 1;
        }
        let edge = distance(&piece[i], &piece[i + 1]).max(f64::MIN_POSITIVE);
        points.push(between(&piece[i], &piece[i + 1], ((along - passed) / edge).min(1.0)));
    }
    points.push(piece[piece.len() - 1]);
    points
}

/// The phase plane over path length: direction and squared path velocity at every point.
struct Phase<const N: usize> {
    directions: Vec<[f64; N]>,
    squares: Vec<f64>,
}

impl<const N: usize> Phase<N> {
    fn of(points: &[[f64; N]], step: f64, joints: &[Joint], scale: f64) -> Phase<N> {
        let last = points.len() - 1;
        let directions: Vec<[f64; N]> = (0..=last)
            .map(|i| {
                let (a, b) = (i.saturating_sub(1), (i + 1).min(last));
                std::array::from_fn(|j| (points[b][j] - points[a][j]) / ((b - a) as f64 * step))
            })
            .collect();
        let bends: Vec<[f64; N]> = (0..=last)
            .map(|i| {
                let i = i.clamp(1, last - 1);
                std::array::from_fn(|j| (points[i - 1][j] - 2.0 * points[i][j] + points[i + 1][j]) / (step * step))
            })
            .collect();
        let mut squares: Vec<f64> = (0..=last)
            .map(|i| {
                let limit = |j: usize| {
                    let by_velocity = (joints[j].velocity * scale / directions[i][j].abs().max(1e-9)).powi(2);
                    let by_bend = joints[j].acceleration * scale / bends[i][j].abs().max(1e-9);
                    by_velocity.min(by_bend)
                };
                (0..N).map(limit).fold(f64::INFINITY, f64::min)
            })
            .collect();
        // How much the square may grow in one step from point i when it is `square` there.
        let growth = |i: usize, square: f64| {
            let room = |j: usize| {
                let left = joints[j].acceleration * scale - bends[i][j].abs() * square;
                left.max(0.0) / directions[i][j].abs().max(1e-9)
            };
            2.0 * step * (0..N).map(room).fold(f64::INFINITY, f64::min)
        };
        squares[0] = 0.0;
        squares[last] = 0.0;
        for i in 0..last {
            squares[i + 1] = squares[i + 1].min(squares[i] + growth(i, squares[i]));
        }
        for i in (0..last).rev() {
            squares[i] = squares[i].min(squares[i + 1] + growth(i + 1, squares[i + 1]));
        }
        Phase { directions, squares }
    }

    /// Points at equal times of the path length averaged over a window of time.
    fn knots(&self, points: &[[f64; N]], step: f64, window_s: f64) -> Vec<Knot<N>> {
        let course = Course::of(&self.squares, step);
        let duration = course.end_s() + window_s;
        let count = ((duration / KNOT_S).ceil() as usize).max(2);
        let last = points.len() - 1;
        let knot = |k: usize| {
            let time_s = duration * k as f64 / count as f64;
            let (now, then) = (course.at(time_s), course.at(time_s - window_s));
            let along = ((now.sum - then.sum) / window_s / step).clamp(0.0, last as f64);
            let velocity = (now.along - then.along) / window_s;
            let i = (along as usize).min(last - 1);
            let fraction = along - i as f64;
            let direction = between(&self.directions[i], &self.directions[i + 1], fraction);
            Knot {
                time_s,
                positions: between(&points[i], &points[i + 1], fraction),
                velocities: direction.map(|d| d * velocity),
            }
        };
        let mut knots: Vec<Knot<N>> = (0..=count).map(knot).collect();
        for (end, point) in [(0, 0), (count, last)] {
            knots[end].positions = points[point];
            knots[end].velocities = [0.0; N];
        }
        knots
    }
}

/// Path length over time, and its integral.
struct Course {
    /// Per point of the phase plane.
    instants: Vec<Instant>,
}

#[derive(Clone, Copy)]
struct Instant {
    time_s: f64,
    velocity: f64,
    along: f64,
    /// Of the path length over time.
    sum: f64,
}

impl Course {
    fn of(squares: &[f64], step: f64) -> Course {
        let mut instants = vec![Instant { time_s: 0.0, velocity: 0.0, along: 0.0, sum: 0.0 }];
        for (i, pair) in squares.windows(2).enumerate() {
            let (v0, v1) = (pair[0].sqrt(), pair[1].sqrt());
            let dt = 2.0 * step / (v0 + v1).max(1e-6);
            let before = instants[i];
            // Within a step the path acceleration is constant.
            let sum = before.sum + dt * (before.along + dt * (v0 / 2.0 + (v1 - v0) / 6.0));
            let along = step * (i + 1) as f64;
            instants.push(Instant { time_s: before.time_s + dt, velocity: v1, along, sum });
        }
        Course { instants }
    }

    fn end_s(&self) -> f64 {
        self.instants[self.instants.len() - 1].time_s
    }

    /// Before the start and after the end it stands.
    fn at(&self, time_s: f64) -> Instant {
        let last = self.instants[self.instants.len() - 1];
        if time_s <= 0.0 {
            return Instant { time_s, ..self.instants[0] };
        }
        if time_s >= last.time_s {
            return Instant { time_s, velocity: 0.0, sum: last.sum + last.along * (time_s - last.time_s), ..last };
        }
        let next = self.instants.partition_point(|i| i.time_s <= time_s);
        let (a, b) = (self.instants[next - 1], self.instants[next]);
        let (t, acceleration) = (time_s - a.time_s, (b.velocity - a.velocity) / (b.time_s - a.time_s));
        Instant {
            time_s,
            velocity: a.velocity + acceleration * t,
            along: a.along + t * (a.velocity + acceleration * t / 2.0),
            sum: a.sum + t * (a.along + t * (a.velocity / 2.0 + acceleration * t / 6.0)),
        }
    }
}

/// The greatest absolute change of the mean acceleration from one step of time to the next, per joint and second.
fn jerks<const N: usize>(knots: &[Knot<N>]) -> [f64; N] {
    let mut jerks = [0.0_f64; N];
    let step = |i: usize| knots[i + 1].time_s - knots[i].time_s;
    let mean = |i: usize, j: usize| (knots[i + 1].velocities[j] - knots[i].velocities[j]) / step(i);
    for i in 1..knots.len() - 1 {
        for (j, jerk) in jerks.iter_mut().enumerate() {
            *jerk = jerk.max((mean(i, j) - mean(i - 1, j)).abs() / step(i));
        }
    }
    jerks
}

/// Slows the whole piece down by what its interpolation breaks the limits by, if it does.
fn stretched<const N: usize>(knots: Vec<Knot<N>>, joints: &[Joint], speed: f64) -> Vec<Knot<N>> {
    let (mut by_velocity, mut by_acceleration) = (0.0_f64, 0.0_f64);
    let jerks = jerks(&knots);
    let by_jerk = (0..N).map(|j| jerks[j] / joints[j].jerk).fold(0.0, f64::max);
    let trajectory = Curve::new(knots);
    for (velocities, accelerations) in trajectory.extremes() {
        for j in 0..N {
            by_velocity = by_velocity.max(velocities[j] / (joints[j].velocity * speed));
            by_acceleration = by_acceleration.max(accelerations[j] / (joints[j].acceleration * speed));
        }
    }
    let factor = by_velocity.max(by_acceleration.sqrt()).max(by_jerk.cbrt()).max(1.0);
    let slow = |knot: &Knot<N>| Knot {
        time_s: knot.time_s * factor,
        positions: knot.positions,
        velocities: knot.velocities.map(|v| v / factor),
    };
    trajectory.knots().iter().map(slow).collect()
}
