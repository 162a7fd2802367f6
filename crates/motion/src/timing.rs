//! When the arm is where: a path becomes a trajectory within the joints' velocity and acceleration limits.
//!
//! Every part starts and ends at rest. The corners of the free part are rounded (a quadratic Bézier curve per corner, as wide
//! as the neighbours and the obstacles leave room for; without room the arm stops there). Each piece is then cut into equal
//! steps of path length s, and the fastest ds/dt that breaks no limit is found by one sweep forwards and one backwards over
//! the phase plane, as in time-optimal path parameterisation (Bobrow, 1985; Kunz and Stilman, 2012).

use crate::collision::{between, distance, length};
use crate::robot::{Joint, Joints, Robot};
use crate::trajectory::{ArmTrajectory, Knot};
use ratn_model::value::Trajectory;

/// The widest that a corner is cut on each side, in radians.
const BLEND_RAD: f64 = 0.5;

/// How often a blend that touches something is halved before the arm stops at the corner instead.
const BLEND_HALVINGS: usize = 4;

/// Points of a Bézier curve.
const BLEND_POINTS: usize = 96;

/// Path length between two points of the phase plane, in radians.
const STEP_RAD: f64 = 0.01;

/// Time between two points of the trajectory, in seconds.
const KNOT_S: f64 = 0.04;

/// The share of the limits that the sweeps use; the rest is for what sampling rounds off.
const RESERVE: f64 = 0.97;

/// A part of a path, from rest to rest.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// Corners may be rounded where nothing is touched.
    Free(Vec<Joints>),
    /// Postures close to each other along a straight line of the tool, to be followed as they are.
    Straight(Vec<Joints>),
}

/// The trajectory along the parts at a fraction `speed` of the limits; velocities and accelerations keep within it. Corners are
/// rounded where `is_free` finds the straight motions from point to point of the curve free.
pub fn parameterise(
    robot: &Robot,
    parts: &[Part],
    speed: f64,
    is_free: &mut dyn FnMut(&Joints, &Joints) -> bool,
) -> Trajectory {
    let mut pieces = Vec::new();
    for part in parts {
        match part {
            Part::Free(path) => pieces.extend(rounded(path, is_free)),
            Part::Straight(path) => pieces.push(path.clone()),
        }
    }
    let start = pieces.first().and_then(|piece| piece.first()).copied().unwrap_or_default();
    let mut knots = vec![Knot { time_s: 0.0, positions: start, velocities: [0.0; 7] }];
    for piece in pieces {
        let offset = knots[knots.len() - 1].time_s;
        let timed = time(robot, &piece, speed);
        knots.extend(timed.into_iter().skip(1).map(|knot| Knot { time_s: knot.time_s + offset, ..knot }));
    }
    ArmTrajectory::new(knots).to_model(robot)
}

/// The path with rounded corners, cut where the arm has to stop.
fn rounded(path: &[Joints], is_free: &mut dyn FnMut(&Joints, &Joints) -> bool) -> Vec<Vec<Joints>> {
    let mut pieces = Vec::new();
    let mut piece = vec![path[0]];
    for window in path.windows(3) {
        let [before, corner, after] = [window[0], window[1], window[2]];
        let (near, far) = (distance(&before, &corner), distance(&corner, &after));
        let mut width = BLEND_RAD.min(near / 2.0).min(far / 2.0);
        let mut curve = None;
        for _ in 0..=BLEND_HALVINGS {
            if width < STEP_RAD {
                break;
            }
            let from = between(&corner, &before, width / near);
            let to = between(&corner, &after, width / far);
            let points = bezier(&from, &corner, &to);
            if is_free_along(&points, is_free) {
                curve = Some(points);
                break;
            }
            width /= 2.0;
        }
        match curve {
            Some(points) => piece.extend(points),
            None => {
                piece.push(corner);
                pieces.push(std::mem::replace(&mut piece, vec![corner]));
            }
        }
    }
    piece.push(path[path.len() - 1]);
    pieces.push(piece);
    pieces
}

fn bezier(from: &Joints, corner: &Joints, to: &Joints) -> Vec<Joints> {
    let point = |i: usize| {
        let t = i as f64 / BLEND_POINTS as f64;
        between(&between(from, corner, t), &between(corner, to, t), t)
    };
    (0..=BLEND_POINTS).map(point).collect()
}

fn is_free_along(curve: &[Joints], is_free: &mut dyn FnMut(&Joints, &Joints) -> bool) -> bool {
    // Every eighth point: the chords between them stay within a fraction of a milliradian of the curve.
    let points: Vec<&Joints> = curve.iter().step_by(8).collect();
    points.windows(2).all(|pair| is_free(pair[0], pair[1]))
}

/// A smooth piece from rest to rest; the first knot is at time 0.
fn time(robot: &Robot, piece: &[Joints], speed: f64) -> Vec<Knot> {
    let whole = length(piece);
    let rest = |positions: &Joints, time_s: f64| Knot { time_s, positions: *positions, velocities: [0.0; 7] };
    if whole < 1e-6 {
        return vec![rest(&piece[0], 0.0)];
    }
    let count = ((whole / STEP_RAD).ceil() as usize).max(8);
    let step = whole / count as f64;
    let points = resampled(piece, count, step);
    let phase = Phase::of(&points, step, robot.arm_joints(), speed * RESERVE);
    let knots = phase.knots(&points, step);
    stretched(knots, robot.arm_joints(), speed)
}

/// `count + 1` points at equal path lengths.
fn resampled(piece: &[Joints], count: usize, step: f64) -> Vec<Joints> {
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
struct Phase {
    directions: Vec<Joints>,
    squares: Vec<f64>,
}

impl Phase {
    fn of(points: &[Joints], step: f64, joints: &[Joint], scale: f64) -> Phase {
        let last = points.len() - 1;
        let directions: Vec<Joints> = (0..=last)
            .map(|i| {
                let (a, b) = (i.saturating_sub(1), (i + 1).min(last));
                std::array::from_fn(|j| (points[b][j] - points[a][j]) / ((b - a) as f64 * step))
            })
            .collect();
        let bends: Vec<Joints> = (0..=last)
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
                (0..7).map(limit).fold(f64::INFINITY, f64::min)
            })
            .collect();
        // How much the square may grow in one step from point i when it is `square` there.
        let growth = |i: usize, square: f64| {
            let room = |j: usize| {
                let left = joints[j].acceleration * scale - bends[i][j].abs() * square;
                left.max(0.0) / directions[i][j].abs().max(1e-9)
            };
            2.0 * step * (0..7).map(room).fold(f64::INFINITY, f64::min)
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

    /// Points at equal times.
    fn knots(&self, points: &[Joints], step: f64) -> Vec<Knot> {
        let mut times = vec![0.0];
        for pair in self.squares.windows(2) {
            let dt = 2.0 * step / (pair[0].sqrt() + pair[1].sqrt()).max(1e-6);
            times.push(times[times.len() - 1] + dt);
        }
        let duration = times[times.len() - 1];
        let count = ((duration / KNOT_S).ceil() as usize).max(2);
        let mut knots = Vec::with_capacity(count + 1);
        let mut i = 0;
        for k in 0..=count {
            let time_s = duration * k as f64 / count as f64;
            while i + 2 < times.len() && times[i + 1] < time_s {
                i += 1;
            }
            // Within a step the path acceleration is constant.
            let (v0, v1) = (self.squares[i].sqrt(), self.squares[i + 1].sqrt());
            let (elapsed, whole) = (time_s - times[i], times[i + 1] - times[i]);
            let velocity = v0 + (v1 - v0) * elapsed / whole;
            let fraction = ((v0 + velocity) / 2.0 * elapsed / step).clamp(0.0, 1.0);
            let direction = between(&self.directions[i], &self.directions[i + 1], fraction);
            knots.push(Knot {
                time_s,
                positions: between(&points[i], &points[i + 1], fraction),
                velocities: direction.map(|d| d * velocity),
            });
        }
        let last = knots.len() - 1;
        knots[0].velocities = [0.0; 7];
        knots[last].velocities = [0.0; 7];
        knots[last].positions = points[points.len() - 1];
        knots
    }
}

/// Slows the whole piece down by what its interpolation breaks the limits by, if it does.
fn stretched(knots: Vec<Knot>, joints: &[Joint], speed: f64) -> Vec<Knot> {
    let (mut by_velocity, mut by_acceleration) = (0.0_f64, 0.0_f64);
    let trajectory = ArmTrajectory::new(knots);
    for (velocities, accelerations) in trajectory.extremes() {
        for j in 0..7 {
            by_velocity = by_velocity.max(velocities[j] / (joints[j].velocity * speed));
            by_acceleration = by_acceleration.max(accelerations[j] / (joints[j].acceleration * speed));
        }
    }
    let factor = by_velocity.max(by_acceleration.sqrt()).max(1.0);
    let slow = |knot: &Knot| Knot {
        time_s: knot.time_s * factor,
        positions: knot.positions,
        velocities: knot.velocities.map(|v| v / factor),
    };
    trajectory.knots().iter().map(slow).collect()
}
