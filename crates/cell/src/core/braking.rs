//! How motions stop and resume: along their path, by slowing down the motion's time, with each joint within its limits.
//!
//! A motion is a function of its own time τ, which normally runs as fast as real time. To stop, its rate r = dτ/dt falls from 1 to 0, step by step,
//! as fast as the joints allow. The acceleration of a joint is then q″r² + q′ṙ (Bobrow, Dubowsky and Gibson, "Time-optimal control of robotic
//! manipulators along specified paths", IJRR 1985); the most negative ṙ is used with which no joint exceeds its limit. Where the motion itself
//! decelerates a joint at its limit, that would be ṙ = 0, and on some motions there is always such a joint. So the rate falls at least as fast as the
//! part `URGENT` of each limit allows, and such a joint exceeds its limit by that part. To resume, the rate rises in the same way. The robot never
//! leaves the path that was checked. The jerk is not limited.
//!
//! A stop on request, a hold and a lost lease brake within the limits that motions are planned with. An emergency stop is of category 1
//! (IEC 60204-1): the joints brake within [`EMERGENCY`] times those limits, then the brakes close. The fingers and the camera's head, which are
//! slow, stop at once.

use super::activity::seconds;
use super::environment::STEP;
use super::motion::{Motion, Tracking};
use super::protocol::{Ending, Ticket};
use ratn_model::time::Timestamp;
use ratn_motion::drive::wrapped;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Joint, Robot};
use std::time::Duration;

/// The acceleration limits of an emergency stop, as a multiple of the limits for planning.
pub const EMERGENCY: f64 = 2.0;
/// The usable part of a limit: between the steps of the course the accelerations are not known.
const USED: f64 = 0.95;
/// The minimum part of a limit that braking uses, in addition to what the motion itself uses. With it, a joint that moves at its maximum speed and
/// already decelerates at its limit stops in 2.3 times the time that braking alone takes.
const URGENT: f64 = 0.2;
/// The maximum number of steps until a motion runs at full rate again: a minute.
const MAX_STEPS: usize = 15_000;

/// The clock of motions: it runs as fast as real time, stands, or changes from one to the other.
#[derive(Debug, Clone)]
pub(super) struct MotionClock {
    pace: Pace,
    /// The motion time when the pace began.
    from: Timestamp,
}

/// A motion that is coming to rest, independently of a hold of all motions.
#[derive(Debug, Clone)]
pub(super) struct Braking {
    pub(super) ticket: Ticket,
    pub(super) ending: Ending,
    way: Way,
    /// Its progress along its course when it began to brake, in seconds.
    from_s: f64,
    pace: Pace,
}

/// A trajectory that the robot follows.
#[derive(Debug, Clone)]
pub(super) enum Way {
    /// For the arm of this number.
    Arm(usize, Motion),
    /// For the base.
    Base(Motion),
}

/// A motion that slows down or resumes.
struct Along<'a> {
    motion: &'a Motion,
    /// Its progress, in seconds of motion time.
    from_s: f64,
    /// The maximum accelerations of its joints.
    limits: JointVector,
}

/// The progress of motion time from a moment on.
#[derive(Debug, Clone)]
struct Pace {
    since: Timestamp,
    /// Seconds of motion time after every [`STEP`], with the rate at that moment; the rate changes linearly in between.
    course: Vec<[f64; 2]>,
}

impl MotionClock {
    /// A clock that runs as fast as real time.
    pub(super) fn new(now: Timestamp) -> MotionClock {
        MotionClock { pace: Pace::at_once(now, 1.0), from: now }
    }

    /// The motion time at `now`, which is not before the last change.
    pub(super) fn motion_time(&self, now: Timestamp) -> Timestamp {
        let (settles, passed) = (self.pace.settles(), self.pace.whole());
        if now < settles {
            return self.from + seconds(self.pace.passed_s(now));
        }
        if self.pace.then() > 0.0 { self.from + passed + now.since(settles) } else { self.from + passed }
    }

    /// The real time at which the motion time is reached; `None` if the clock stops before.
    pub(super) fn real_time(&self, motion_time: Timestamp) -> Option<Timestamp> {
        let whole = self.from + self.pace.whole();
        if motion_time >= whole {
            let goes_on = self.pace.then() > 0.0 || motion_time == whole;
            return goes_on.then(|| self.pace.settles() + motion_time.since(whole));
        }
        Some(self.pace.when(motion_time.since(self.from).as_secs_f64()))
    }

    /// Whether the clock stands.
    pub(super) fn stands(&self, now: Timestamp) -> bool {
        self.pace.then() == 0.0 && now >= self.pace.settles()
    }

    /// When the clock will stand, if it was told to stop.
    pub(super) fn comes_to_stand(&self) -> Option<Timestamp> {
        (self.pace.then() == 0.0).then(|| self.pace.settles())
    }

    /// Whether the clock runs, or was told to run again.
    pub(super) fn goes_on(&self) -> bool {
        self.pace.then() > 0.0
    }

    /// The rate of the clock, 0 to 1.
    pub(super) fn rate(&self, now: Timestamp) -> f64 {
        self.pace.rate(now)
    }

    /// Lets the clock run or stop. It changes as fast as every active motion allows; each motion comes with its progress, in seconds.
    pub(super) fn change(
        &mut self,
        robot: &Robot,
        [now, motion_time]: [Timestamp; 2],
        goes_on: bool,
        ways: &[(&Way, f64)],
    ) {
        let then = if goes_on { 1.0 } else { 0.0 };
        let along: Vec<Along<'_>> = ways.iter().map(|(way, from_s)| way.along(robot, *from_s, 1.0)).collect();
        let pace = match along.is_empty() {
            false => Pace::change(now, [self.rate(now), then], &along),
            true => Pace::at_once(now, then),
        };
        *self = MotionClock { pace, from: motion_time };
    }
}

impl Braking {
    /// Begins to brake now, within `times` the limits of the joints, from the motion's rate and its progress along its course, in seconds.
    pub(super) fn begin(
        robot: &Robot,
        now: Timestamp,
        way: Way,
        [rate, from_s]: [f64; 2],
        times: f64,
        (ticket, ending): (Ticket, Ending),
    ) -> Braking {
        let pace = way.pace(robot, now, [rate, 0.0], from_s, times);
        Braking { ticket, ending, way, from_s, pace }
    }

    /// Brakes within `times` the limits from now on.
    pub(super) fn harder(&mut self, robot: &Robot, now: Timestamp, times: f64) {
        let (rate, from_s) = (self.pace.rate(now), self.from_s + self.pace.passed_s(now));
        (self.pace, self.from_s) = (self.way.pace(robot, now, [rate, 0.0], from_s, times), from_s);
    }

    /// When the motion has come to rest.
    pub(super) fn ends(&self) -> Timestamp {
        self.pace.settles()
    }

    /// Sets the moving joints to their current positions.
    pub(super) fn place(&self, now: Timestamp, configuration: &mut Configuration) {
        let at_s = self.from_s + self.pace.passed_s(now);
        match &self.way {
            Way::Arm(arm, motion) => configuration.set_joints(*arm, motion.at(at_s)),
            Way::Base(motion) => {
                let at = motion.at(at_s);
                configuration.base = [at[0], at[1], wrapped(at[2])];
            }
        }
    }

    /// The joint positions now, at every later [`STEP`] of the course, and at rest.
    pub(super) fn ahead(&self, now: Timestamp) -> Vec<JointVector> {
        let from_s = self.from_s + self.pace.passed_s(now);
        self.way.between(from_s, self.from_s + self.pace.whole().as_secs_f64())
    }

    /// The tracking errors so far.
    pub(super) fn tracking(&self, now: Timestamp) -> Tracking {
        self.way.tracking(self.from_s + self.pace.passed_s(now))
    }
}

impl Way {
    pub(super) fn tracking(&self, time_s: f64) -> Tracking {
        match self {
            Way::Arm(_, motion) => motion.tracking(time_s),
            Way::Base(motion) => motion.tracking(time_s),
        }
    }

    /// The motion as an input of braking, at its progress `from_s`, in seconds of motion time.
    fn along<'a>(&'a self, robot: &Robot, from_s: f64, times: f64) -> Along<'a> {
        match self {
            Way::Arm(arm, motion) => Along { motion, from_s, limits: limits(robot.joints_of(*arm), times) },
            Way::Base(motion) => Along { motion, from_s, limits: limits(robot.base_joints(), times) },
        }
    }

    fn pace(&self, robot: &Robot, now: Timestamp, rates: [f64; 2], from_s: f64, times: f64) -> Pace {
        Pace::change(now, rates, &[self.along(robot, from_s, times)])
    }

    /// The joint positions `time_s` after the start, at every later [`STEP`] to the end of the course, and from there until the joints stand: a
    /// controller that has lost its joints brakes beyond that end.
    pub(super) fn ahead(&self, robot: &Robot, time_s: f64) -> Vec<JointVector> {
        let ends_s = self.motion().course_s();
        let brakes = self.pace(robot, Timestamp::default(), [1.0, 0.0], ends_s, 1.0);
        self.between(time_s, ends_s + brakes.whole().as_secs_f64())
    }

    /// The joint positions at one moment of the course, at every later [`STEP`] and at another moment.
    fn between(&self, from_s: f64, to_s: f64) -> Vec<JointVector> {
        let (motion, dt) = (self.motion(), STEP.as_secs_f64());
        let steps = ((to_s - from_s) / dt).ceil().max(0.0) as usize;
        (0..=steps).map(|i| motion.at((from_s + i as f64 * dt).min(to_s.max(from_s)))).collect()
    }

    fn motion(&self) -> &Motion {
        match self {
            Way::Arm(_, motion) | Way::Base(motion) => motion,
        }
    }
}

impl Pace {
    /// A constant rate: real time (1) or standstill (0).
    fn at_once(since: Timestamp, rate: f64) -> Pace {
        Pace { since, course: vec![[0.0, rate]] }
    }

    /// Changes the rate as fast as the joints of all motions allow.
    fn change(since: Timestamp, [mut rate, then]: [f64; 2], along: &[Along<'_>]) -> Pace {
        let (dt, brakes) = (STEP.as_secs_f64(), then < rate);
        let mut passed = 0.0;
        let mut course = vec![[passed, rate]];
        while rate != then {
            // The joint velocities and accelerations in the middle of the step.
            let slope = |one: &Along<'_>| {
                let (velocity, acceleration) = one.motion.derivatives(one.from_s + passed + 0.5 * rate * dt);
                greatest_slope(&velocity, &acceleration, rate, brakes, &one.limits)
            };
            let slope = along.iter().map(slope).fold(f64::INFINITY, f64::min);
            let given_up = course.len() == MAX_STEPS;
            let next = match brakes {
                _ if given_up => then,
                true => (rate - slope * dt).max(then),
                false => (rate + slope * dt).min(then),
            };
            passed += 0.5 * (rate + next) * dt;
            course.push([passed, next]);
            rate = next;
        }
        Pace { since, course }
    }

    /// Seconds of motion time that have passed.
    fn passed_s(&self, now: Timestamp) -> f64 {
        let (index, part_s) = self.step(now);
        let [passed, rate] = self.course[index];
        let slope = self.course.get(index + 1).map_or(0.0, |[_, next]| (next - rate) / STEP.as_secs_f64());
        passed + part_s * (rate + 0.5 * slope * part_s)
    }

    fn rate(&self, now: Timestamp) -> f64 {
        let (index, part_s) = self.step(now);
        let rate = self.course[index][1];
        self.course.get(index + 1).map_or(rate, |[_, next]| rate + (next - rate) * part_s / STEP.as_secs_f64())
    }

    /// The last step that has begun, and the time since then, in seconds.
    fn step(&self, now: Timestamp) -> (usize, f64) {
        let since = now.since(self.since);
        let steps = usize::try_from(since.as_nanos() / STEP.as_nanos()).unwrap_or(usize::MAX);
        let index = steps.min(self.course.len() - 1);
        (index, since.as_secs_f64() - index as f64 * STEP.as_secs_f64())
    }

    /// When this many seconds of motion time will have passed, before the rate is constant.
    fn when(&self, passed_s: f64) -> Timestamp {
        let last = self.course.len() - 1;
        let next = self.course.partition_point(|[passed, _]| *passed < passed_s).clamp(1, last.max(1));
        let Some([after, _]) = self.course.get(next) else { return self.since };
        let [before, _] = self.course[next - 1];
        let part = if *after > before { (passed_s - before) / (after - before) } else { 1.0 };
        self.since + seconds(((next - 1) as f64 + part) * STEP.as_secs_f64())
    }

    /// The final rate: 0 or 1.
    fn then(&self) -> f64 {
        self.course[self.course.len() - 1][1]
    }

    /// When the rate becomes constant.
    fn settles(&self) -> Timestamp {
        self.since + STEP * u32::try_from(self.course.len() - 1).unwrap_or(u32::MAX)
    }

    /// The motion time that has passed by then.
    fn whole(&self) -> Duration {
        seconds(self.course[self.course.len() - 1][0])
    }
}

/// The maximum accelerations of joints, `times` those that motions are planned with.
fn limits(joints: &[Joint], times: f64) -> JointVector {
    JointVector::from_fn(joints.len(), |j| joints[j].acceleration * times * USED)
}

/// How fast the rate may fall or rise, in 1/s.
fn greatest_slope(
    velocity: &JointVector,
    acceleration: &JointVector,
    rate: f64,
    brakes: bool,
    limits: &JointVector,
) -> f64 {
    let slope = |j: usize| {
        // The change of the rate accelerates a joint along its velocity or against it.
        let (v, a) = (if brakes { -velocity[j] } else { velocity[j] }, acceleration[j] * rate * rate);
        let room = if v >= 0.0 { limits[j] - a } else { limits[j] + a };
        let least = if brakes { URGENT * limits[j] } else { 0.0 };
        if v == 0.0 { f64::INFINITY } else { room.max(least) / v.abs() }
    };
    (0..limits.len()).map(slope).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests {
    use super::super::motion::Controller;
    use super::*;
    use ratn_model::value::{Trajectory, TrajectoryPoint};
    use ratn_motion::trajectory::Curve;

    /// Each joint swings at its maximum acceleration, a third of a swing behind the joint before it: one of them always decelerates at its limit.
    fn swings(robot: &Robot, period_s: f64) -> Motion {
        let joints = robot.base_joints();
        let (quarter_s, swings) = (period_s / 4.0, 20);
        let velocity = |j: usize, time_s: f64| {
            let phase = (time_s / period_s + j as f64 / 6.0).rem_euclid(1.0) * 4.0;
            let shape = if phase < 1.0 {
                phase
            } else if phase < 3.0 {
                2.0 - phase
            } else {
                phase - 4.0
            };
            joints[j].acceleration * quarter_s * shape
        };
        let mut at = [0.0; 3];
        let steps = swings * 24;
        let dt = period_s / 24.0;
        let mut points = Vec::new();
        for step in 0..=steps {
            let time_s = f64::from(step) * dt;
            let velocities: Vec<f64> = (0..3).map(|j| velocity(j, time_s)).collect();
            points.push(TrajectoryPoint { time_s, positions: at.to_vec(), velocities });
            at = std::array::from_fn(|j| at[j] + 0.5 * (velocity(j, time_s) + velocity(j, time_s + dt)) * dt);
        }
        let trajectory = Trajectory { joints: joints.iter().map(|j| j.name.clone()).collect(), points };
        let stiff = Controller { of: "base", stiffness: 100.0, most_off: 10.0, slides: Controller::base_slides() };
        Motion::new(
            Curve::of(joints, &trajectory).unwrap(),
            JointVector::zeros(3),
            stiff,
            Some((f64::from(steps) * dt, String::new())),
        )
    }

    #[test]
    fn what_always_slows_down_somewhere_comes_to_rest_soon_and_nearly_within_its_limits() {
        let robot = Robot::aimm();
        let joints = robot.base_joints();
        let fastest = (0..3).map(|j| joints[j].velocity / joints[j].acceleration).fold(f64::INFINITY, f64::min);
        let motion = swings(&robot, 4.0 * fastest);
        // A controller overshoots: at some places the joints exceed their limits even without braking.
        let steps = (motion.lasts_s() / STEP.as_secs_f64()) as u32;
        let anyway: Vec<JointVector> =
            (0..steps).map(|i| motion.derivatives(f64::from(i) * STEP.as_secs_f64()).1).collect();
        let most: [f64; 3] =
            std::array::from_fn(|j| anyway.iter().fold(joints[j].acceleration, |most, a| most.max(a[j].abs())));
        for from_s in (0..24).map(|i| 5.0 + f64::from(i) * fastest / 6.0) {
            let limits = limits(joints, 1.0);
            let pace = Pace::change(Timestamp::default(), [1.0, 0.0], &[Along { motion: &motion, from_s, limits }]);
            let lasts_s = pace.settles().since(Timestamp::default()).as_secs_f64();
            assert!(lasts_s < 3.0 * fastest, "{lasts_s} s from {from_s} s on");
            let dt = STEP.as_secs_f64();
            for pair in pace.course.windows(2) {
                let ([passed, rate], slope) = (pair[0], (pair[1][1] - pair[0][1]) / dt);
                let (velocity, acceleration) = motion.derivatives(from_s + passed + 0.5 * rate * dt);
                for j in 0..3 {
                    let does = acceleration[j] * rate * rate + velocity[j] * slope;
                    assert!(does.abs() < most[j] + URGENT * joints[j].acceleration, "{does} of joint {j}");
                }
            }
        }
    }

    #[test]
    fn the_way_ahead_reaches_to_where_a_motion_that_was_lost_comes_to_rest() {
        let robot = Robot::aimm();
        let joints = robot.base_joints();
        let point = |time_s: f64, x: f64, v: f64| TrajectoryPoint {
            time_s,
            positions: vec![x, 0.0, 0.0],
            velocities: vec![v, 0.0, 0.0],
        };
        let points = vec![point(0.0, 0.0, 0.0), point(2.0, 1.0, 1.0), point(4.0, 2.0, 0.0)];
        let trajectory = Trajectory { joints: joints.iter().map(|j| j.name.clone()).collect(), points };
        let weak = Controller { of: "base", stiffness: 3.0, most_off: 0.05, slides: Controller::base_slides() };
        let motion = Motion::new(Curve::of(joints, &trajectory).unwrap(), JointVector::zeros(3), weak, None);
        assert!(motion.end().is_err());
        let (lasts_s, now) = (motion.lasts_s(), Timestamp::default());
        let way = Way::Base(motion);
        let ahead = way.ahead(&robot, 0.0);
        let ending = Ending::Aborted(String::new());
        let braking = Braking::begin(&robot, now, way, [1.0, lasts_s], 1.0, (Ticket(1), ending));
        let mut stands = robot.at_zero();
        braking.place(braking.ends(), &mut stands);
        let lost_at = braking.way.motion().at(lasts_s)[0];
        assert!(stands.base[0] > lost_at + 0.01, "it brakes over {} m", stands.base[0] - lost_at);
        assert!((ahead[ahead.len() - 1][0] - stands.base[0]).abs() < 1e-6, "{} {stands:?}", ahead[ahead.len() - 1][0]);
        // While it brakes, the motion ahead ends at the same place.
        let brakes = braking.ahead(now);
        assert!((brakes[0][0] - lost_at).abs() < 1e-9 && brakes.len() > 10 && brakes.len() < ahead.len());
        assert!((brakes[brakes.len() - 1][0] - stands.base[0]).abs() < 1e-6);
    }
}
