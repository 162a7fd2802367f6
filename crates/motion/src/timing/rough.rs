//! The approximate duration of a path of straight motions after its corners are rounded: the cost by which paths are compared while they
//! are improved. It takes about a microsecond; the exact duration takes thousands.
//!
//! A corner is passed at the speed that its blend allows in the middle, where the curvature is greatest; the blend is as wide as `blend`
//! would make it. Between corners the motion is the fastest within the limits along that side. Jerk takes additional time wherever the
//! acceleration changes, as in a double S.

use super::blend::{BLEND_HALVINGS, BLEND_RAD, LEAST_RAD, SHARPEST_RAD};
use crate::mechanism::MAX_JOINTS;
use crate::robot::Joint;
use crate::space::{State, difference, length};
use std::collections::VecDeque;

/// The part of each half of a blend that counts as its middle. The ends of a blend are nearly straight, so the speed changes there as on
/// the sides.
const MIDDLE: f64 = 0.5;

/// A posture closer to the last one than this is skipped, in radians: dense paths are smoothed, without a corner at each posture.
const STEP_RAD: f32 = 0.15;

/// Maximum second and third derivative of a blend of half-width 1, per change of direction.
const BEND: f64 = 0.75;
const JOLT: f64 = 1.5;

/// Distance between the middle of such a blend and the corner.
const OFF: f32 = 0.1875;

/// Number of corners whose blend width is cached: more than a path has.
const REMEMBERED: usize = 64;

/// The joints' limits in the form that estimates need.
#[derive(Debug, Clone)]
pub struct Rough {
    joints: usize,
    /// Reciprocals of the limits.
    per_velocity: State,
    per_acceleration: State,
    per_jerk: State,
    /// Buffers for the sides of a path, and for the corners between them.
    sides: Vec<Side>,
    corners: Vec<Corner>,
    /// Cache of corners: position, the directions before and after, the maximum width of the blend, and its possible width.
    known: VecDeque<([State; 3], [f64; 2])>,
}

/// A straight motion with its limits along the path.
#[derive(Debug, Clone, Copy)]
struct Side {
    from: State,
    direction: State,
    length: f64,
    velocity: f64,
    acceleration: f64,
    jerk: f64,
}

/// The speed at a corner, and the distance on either side over which it holds. The ends of a path are corners, too.
#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    speed: f64,
    half: f64,
}

impl Rough {
    /// For joints at a fraction of their limits of velocity and acceleration.
    pub fn new(joints: &[Joint], speed: f64) -> Rough {
        let per = |limit: &dyn Fn(&Joint) -> f64| -> State {
            std::array::from_fn(|j| joints.get(j).map_or(0.0, |joint| (1.0 / limit(joint)) as f32))
        };
        Rough {
            joints: joints.len().min(MAX_JOINTS),
            per_velocity: per(&|joint| joint.velocity * speed),
            per_acceleration: per(&|joint| joint.acceleration * speed),
            per_jerk: per(&|joint| joint.jerk),
            sides: Vec::new(),
            corners: Vec::new(),
            known: VecDeque::new(),
        }
    }

    /// The approximate duration of a path from rest to rest, in seconds, if every blend has room.
    pub fn duration_s(&mut self, path: &[State]) -> f64 {
        self.read(path);
        self.limit_corners(&mut |_, _, width| width);
        self.lasts_s()
    }

    /// The same with blends so narrow that `is_free` finds the straight motions along them free.
    pub fn duration_among_s(&mut self, path: &[State], is_free: &mut dyn FnMut(&State, &State) -> bool) -> f64 {
        self.read(path);
        let mut known = std::mem::take(&mut self.known);
        self.limit_corners(&mut |before, after, most| {
            let key = [after.from, before.direction, after.direction];
            if let Some((_, [_, width])) = known.iter().find(|(k, [of, _])| *k == key && *of == most) {
                return *width;
            }
            let width = width(before, after, most, is_free);
            if known.len() == REMEMBERED {
                known.pop_front();
            }
            known.push_back((key, [most, width]));
            width
        });
        self.known = known;
        self.lasts_s()
    }

    fn lasts_s(&self) -> f64 {
        // A change of speed in a double S begins and ends with a change of acceleration, which takes time, too.
        let (mut lasts, mut pressed) = (0.0, 0.0);
        let mut press = |to: f64, jerk: f64| {
            let changes = (to - pressed).abs() / (2.0 * jerk);
            pressed = to;
            changes
        };
        for (side, ends) in self.sides.iter().zip(self.corners.windows(2)) {
            let (from, to) = (ends[0].speed, ends[1].speed);
            let run = side.run(ends);
            let peak = side.peak(from, to, run, side.acceleration);
            // With jerk limits a change of speed takes as long as with less acceleration.
            let change = peak - from.min(to);
            let mean = side.acceleration.min(change / side.changes_in(change).max(1e-12)).max(1e-12);
            let peak = side.peak(from, to, run, mean);
            let cruise = (run - (2.0 * peak * peak - from * from - to * to) / (2.0 * mean)).max(0.0) / peak.max(1e-12);
            let rise = side.hardest(peak - from);
            if rise > 0.0 {
                lasts += (peak - from) / rise + press(rise, side.jerk);
            }
            if cruise * side.jerk > side.acceleration {
                lasts += press(0.0, side.jerk);
            }
            let fall = side.hardest(peak - to);
            if fall > 0.0 {
                lasts += (peak - to) / fall + press(-fall, side.jerk);
            }
            lasts += cruise + ends.iter().map(|corner| corner.half / corner.speed.max(1e-12)).sum::<f64>();
        }
        lasts + self.sides.last().map_or(0.0, |side| press(0.0, side.jerk))
    }

    /// The speed at each corner: limited by the blend, and by the sides from corner to corner.
    fn limit_corners(&mut self, width_at: &mut dyn FnMut(&Side, &Side, f64) -> f64) {
        let (sides, corners) = (&self.sides, &mut self.corners);
        corners.clear();
        corners.push(Corner::default());
        for pair in sides.windows(2) {
            let turn = difference(&pair[1].direction, &pair[0].direction);
            if f64::from(length(&turn)) > 2.0 * (SHARPEST_RAD / 2.0).sin() {
                corners.push(Corner::default());
                continue;
            }
            let width = width_at(&pair[0], &pair[1], BLEND_RAD.min(pair[0].length / 2.0).min(pair[1].length / 2.0));
            let by_bend = (width / (BEND * most(&turn, &self.per_acceleration, self.joints)).max(1e-12)).sqrt();
            let by_jolt = (width * width / (JOLT * most(&turn, &self.per_jerk, self.joints)).max(1e-12)).cbrt();
            let speed = by_bend.min(by_jolt).min(pair[0].velocity).min(pair[1].velocity);
            corners.push(Corner { speed, half: MIDDLE * width });
        }
        corners.push(Corner::default());
        for (i, side) in sides.iter().enumerate() {
            corners[i + 1].speed = corners[i + 1].speed.min(side.reached_from(corners[i].speed, &corners[i..i + 2]));
        }
        for (i, side) in sides.iter().enumerate().rev() {
            corners[i].speed = corners[i].speed.min(side.reached_from(corners[i + 1].speed, &corners[i..i + 2]));
        }
    }

    fn read(&mut self, path: &[State]) {
        self.sides.clear();
        let Some((mut last, end)) = path.first().zip(path.last()) else { return };
        for (i, posture) in path.iter().enumerate().skip(1) {
            let delta = difference(posture, last);
            let way = length(&delta);
            let is_end = i + 1 == path.len();
            if way < if is_end { 1e-6 } else { STEP_RAD } || !is_end && length(&difference(end, posture)) < 1e-6 {
                continue;
            }
            let from = *last;
            last = posture;
            let direction = delta.map(|d| d / way);
            let along = |per: &State| 1.0 / most(&direction, per, self.joints).max(1e-12);
            self.sides.push(Side {
                from,
                direction,
                length: f64::from(way),
                velocity: along(&self.per_velocity),
                acceleration: along(&self.per_acceleration),
                jerk: along(&self.per_jerk),
            });
        }
    }
}

impl Side {
    /// Its length between the middles of its corners.
    fn run(&self, ends: &[Corner]) -> f64 {
        self.length - ends[0].half - ends[1].half
    }

    /// The maximum speed at its other end.
    fn reached_from(&self, speed: f64, ends: &[Corner]) -> f64 {
        (speed * speed + 2.0 * self.acceleration * self.run(ends)).sqrt()
    }

    /// The maximum speed between two given speeds at its ends.
    fn peak(&self, from: f64, to: f64, run: f64, acceleration: f64) -> f64 {
        let reached = (acceleration * run + (from * from + to * to) / 2.0).sqrt();
        reached.min(self.velocity).max(from).max(to)
    }

    /// The maximum acceleration during a change of speed.
    fn hardest(&self, change: f64) -> f64 {
        self.acceleration.min((change.max(0.0) * self.jerk).sqrt())
    }

    /// Duration of a change of speed, from zero acceleration to zero acceleration.
    fn changes_in(&self, change: f64) -> f64 {
        let hardest = self.hardest(change);
        change / hardest.max(1e-12) + hardest / self.jerk
    }
}

/// The possible width of a corner's blend, by halving; zero where there is no room.
fn width(before: &Side, after: &Side, most: f64, is_free: &mut dyn FnMut(&State, &State) -> bool) -> f64 {
    let mut width = most;
    for _ in 0..=BLEND_HALVINGS {
        if width < LEAST_RAD {
            break;
        }
        let w = width as f32;
        let at = |a: f32, b: f32| -> State {
            std::array::from_fn(|j| after.from[j] + w * (b * after.direction[j] - a * before.direction[j]))
        };
        let (from, middle, to) = (at(1.0, 0.0), at(OFF, OFF), at(0.0, 1.0));
        if is_free(&from, &middle) && is_free(&middle, &to) {
            return width;
        }
        width /= 2.0;
    }
    0.0
}

fn most(values: &State, per: &State, joints: usize) -> f64 {
    f64::from((0..joints).map(|j| values[j].abs() * per[j]).fold(0.0_f32, f32::max))
}
