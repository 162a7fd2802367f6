//! A trajectory that a controller follows, and its tracking errors.
//!
//! A controller drives the joints by their positions and those of the trajectory: each joint is a critically damped second-order system with the
//! trajectory's velocity fed forward, a = ω²(x* − x) + 2ω(v* − v). It lags by about x*″ / ω² while the trajectory accelerates. A motion is over when
//! the joints have settled at the trajectory's end, where the brakes close; it breaks off and brakes (`braking`) if they are too far from the
//! trajectory. All of this follows from the trajectory alone, so it is computed when the motion starts.

use super::environment::STEP;
use ratn_motion::joint_vector::{JointVector, PerJoint};
use ratn_motion::trajectory::Curve;
use serde::{Deserialize, Serialize};

/// Joints that follow a trajectory.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    trajectory: Curve,
    /// The joint positions, every [`STEP`] from the start.
    course: Vec<JointVector>,
    /// Which of the joints are prismatic.
    slides: PerJoint<bool>,
    /// When and why the motion ends early, if it does.
    breaks: Option<(f64, String)>,
}

/// The controller of joints.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Controller {
    /// The name of the part that it drives.
    pub(crate) of: &'static str,
    /// Maximum distance of the joints from their trajectory, in radians and in metres.
    pub(crate) stiffness: f64,
    /// Which of the joints are prismatic.
    pub(crate) most_off: f64,
    /// Which of the joints slide.
    pub(crate) slides: PerJoint<bool>,
}

/// Distances of joints from their trajectory while they followed it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Tracking {
    /// Maximum over all revolute joints, in radians.
    pub most_rad: f64,
    /// Root mean square over all revolute joints and the whole time.
    pub rms_rad: f64,
    /// Maximum distance of the prismatic joints, in metres.
    pub most_m: f64,
    /// Root mean square of that distance over the whole time.
    pub rms_m: f64,
}

/// Distance that counts as reached, in radians and in metres: the resolution of an encoder.
const SETTLED: f64 = 1e-5;
/// Speed that counts as standstill, per second.
const STANDING: f64 = 1e-3;
/// Maximum time for joints to settle, in seconds.
const MAX_SETTLING_S: f64 = 5.0;

impl Motion {
    /// The motion from the joints' positions to the trajectory's end, or until it breaks off after this many seconds for this reason.
    pub(crate) fn new(
        trajectory: Curve,
        start: JointVector,
        controller: Controller,
        breaks: Option<(f64, String)>,
    ) -> Motion {
        let dt = STEP.as_secs_f64();
        let duration_s = trajectory.duration_s();
        let mut motion = Motion { trajectory, course: vec![start], slides: controller.slides, breaks };
        let (mut at, mut moving) = (start, JointVector::zeros(start.len()));
        loop {
            let time_s = dt * (motion.course.len() - 1) as f64;
            // After a motion breaks off, the joints continue while they brake.
            let broken = motion.breaks.as_ref().is_some_and(|(breaks_s, _)| *breaks_s <= time_s);
            let wanted = motion.trajectory.sample(time_s);
            let (radians, metres) = motion.off(&at, &wanted.positions);
            if radians > controller.most_off || metres > controller.most_off {
                if broken {
                    return motion;
                }
                motion.breaks = Some((time_s, controller.lost(radians, metres)));
                return motion;
            }
            let still = moving.iter().all(|v| v.abs() <= STANDING);
            if time_s >= duration_s && radians.max(metres) <= SETTLED && still {
                return motion;
            }
            if time_s > duration_s + MAX_SETTLING_S {
                if broken {
                    return motion;
                }
                let reason = format!("the {} did not settle within {MAX_SETTLING_S} s; it holds", controller.of);
                motion.breaks = Some((time_s, reason));
                return motion;
            }
            let stiffness = controller.stiffness;
            for j in 0..at.len() {
                let (off, slow) = (wanted.positions[j] - at[j], wanted.velocities[j] - moving[j]);
                moving[j] += stiffness * (stiffness * off + 2.0 * slow) * dt;
                at[j] += moving[j] * dt;
            }
            motion.course.push(at);
        }
    }

    /// Duration of the motion, in seconds.
    pub(crate) fn lasts_s(&self) -> f64 {
        self.breaks.as_ref().map_or(self.course_s(), |(breaks_s, _)| *breaks_s)
    }

    /// The joint positions after this many seconds: a smooth curve through the course (Catmull and Rom). Beyond its end they continue at their last velocity.
    pub(crate) fn at(&self, time_s: f64) -> JointVector {
        let steps = (time_s / STEP.as_secs_f64()).max(0.0);
        let (index, t) = (steps as usize, steps.fract());
        let points =
            [self.point(index.saturating_sub(1)), self.point(index), self.point(index + 1), self.point(index + 2)];
        let [p, a, b, q] = points;
        JointVector::from_fn(a.len(), |j| {
            let (bend, slope) = (2.0 * p[j] - 5.0 * a[j] + 4.0 * b[j] - q[j], 3.0 * (a[j] - b[j]) + q[j] - p[j]);
            a[j] + 0.5 * t * (b[j] - p[j] + t * (bend + t * slope))
        })
    }

    /// How long the joint positions are known, in seconds: longer than the motion lasts if it breaks off.
    pub(crate) fn course_s(&self) -> f64 {
        STEP.as_secs_f64() * (self.course.len() - 1) as f64
    }

    /// Joint velocities and accelerations after this many seconds, per second and per second squared.
    pub(crate) fn derivatives(&self, time_s: f64) -> (JointVector, JointVector) {
        let dt = STEP.as_secs_f64();
        let time_s = time_s.max(dt);
        let [before, at, after] = [-dt, 0.0, dt].map(|off| self.at(time_s + off));
        let velocity = JointVector::from_fn(at.len(), |j| (after[j] - before[j]) / (2.0 * dt));
        let acceleration = JointVector::from_fn(at.len(), |j| (after[j] - 2.0 * at[j] + before[j]) / (dt * dt));
        (velocity, acceleration)
    }

    fn point(&self, index: usize) -> JointVector {
        let last = self.course.len() - 1;
        let Some(beyond) = index.checked_sub(last).filter(|_| last > 0) else { return self.course[index.min(last)] };
        let (end, before) = (&self.course[last], &self.course[last - 1]);
        JointVector::from_fn(end.len(), |j| end[j] + (end[j] - before[j]) * beyond as f64)
    }

    /// The positions of the joints at rest at the end.
    ///
    /// # Errors
    /// Why the motion breaks off: the joints still move then, and have to brake.
    pub(crate) fn end(&self) -> Result<JointVector, &str> {
        match &self.breaks {
            Some((_, reason)) => Err(reason),
            None => Ok(self.trajectory.end()),
        }
    }

    /// The tracking errors of the first `time_s` seconds.
    pub(crate) fn tracking(&self, time_s: f64) -> Tracking {
        let dt = STEP.as_secs_f64();
        let turning: Vec<usize> = (0..self.course[0].len()).filter(|j| !self.slides[*j]).collect();
        let mut tracking = Tracking::default();
        let passed = self.course.iter().enumerate().take_while(|(i, _)| *i as f64 * dt <= time_s);
        let mut count = 0.0;
        for (i, at) in passed {
            let wanted = self.trajectory.sample(i as f64 * dt).positions;
            let (radians, metres) = self.off(at, &wanted);
            tracking.most_rad = tracking.most_rad.max(radians);
            tracking.most_m = tracking.most_m.max(metres);
            tracking.rms_m += metres.powi(2);
            let squares: f64 = turning.iter().map(|j| (at[*j] - wanted[*j]).powi(2)).sum();
            tracking.rms_rad += squares / turning.len().max(1) as f64;
            count += 1.0;
        }
        let root = |sum: f64| (sum / f64::max(count, 1.0)).sqrt();
        Tracking { rms_rad: root(tracking.rms_rad), rms_m: root(tracking.rms_m), ..tracking }
    }

    /// Distance of the joints from their trajectory: the maximum of the revolute joints, and the Euclidean distance of the prismatic ones.
    fn off(&self, at: &JointVector, wanted: &JointVector) -> (f64, f64) {
        let off = |j: usize| (at[j] - wanted[j]).abs();
        let (sliding, turning): (Vec<usize>, Vec<usize>) = (0..at.len()).partition(|j| self.slides[*j]);
        let metres = sliding.into_iter().map(|j| off(j).powi(2)).sum::<f64>().sqrt();
        (turning.into_iter().map(off).fold(0.0, f64::max), metres)
    }
}

impl Controller {
    /// Which joints of a base are prismatic: x and y.
    pub(crate) fn base_slides() -> PerJoint<bool> {
        PerJoint::from_fn(3, |j| j < 2)
    }

    fn lost(&self, radians: f64, metres: f64) -> String {
        let (off, unit) = if radians > self.most_off { (radians, "rad") } else { (metres, "m") };
        format!(
            "the {} is {off:.3} {unit} from its trajectory, {} {unit} are allowed; it holds; move slower, or have its controller \
             looked at",
            self.of, self.most_off
        )
    }
}

impl Tracking {
    /// The larger value of both, for each field.
    pub fn or_worse(self, other: Tracking) -> Tracking {
        Tracking {
            most_rad: self.most_rad.max(other.most_rad),
            rms_rad: self.rms_rad.max(other.rms_rad),
            most_m: self.most_m.max(other.most_m),
            rms_m: self.rms_m.max(other.rms_m),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::value::{Trajectory, TrajectoryPoint};
    use ratn_motion::robot::Robot;

    fn controller() -> Controller {
        Controller { of: "base", stiffness: 20.0, most_off: 0.05, slides: Controller::base_slides() }
    }

    /// Moves along x with an acceleration of 0.5 m/s² for two seconds, then decelerates as much.
    fn straight(robot: &Robot) -> Curve {
        let point = |time_s: f64, x: f64, v: f64| TrajectoryPoint {
            time_s,
            positions: vec![x, 0.0, 0.0],
            velocities: vec![v, 0.0, 0.0],
        };
        let joints = robot.base_joints();
        let points = vec![point(0.0, 0.0, 0.0), point(2.0, 1.0, 1.0), point(4.0, 2.0, 0.0)];
        let trajectory = Trajectory { joints: joints.iter().map(|j| j.name.clone()).collect(), points };
        #[expect(clippy::expect_used, reason = "a test may panic")]
        Curve::of(joints, &trajectory).expect("a trajectory of the base")
    }

    #[test]
    fn the_lag_is_that_of_the_model_and_a_stiffer_controller_lags_less() {
        let motion = Motion::new(straight(&Robot::aimm()), JointVector::zeros(3), controller(), None);
        // 0.5 / 20² m.
        let tracking = motion.tracking(f64::INFINITY);
        assert!((tracking.most_m - 0.00125).abs() < 2e-4, "{tracking:?}");
        assert!(tracking.rms_m > 0.5 * tracking.most_m && tracking.rms_m < tracking.most_m, "{tracking:?}");
        assert_eq!((tracking.most_rad, tracking.rms_rad), (0.0, 0.0));
        let stiffer = Controller { stiffness: 40.0, ..controller() };
        let stiffer =
            Motion::new(straight(&Robot::aimm()), JointVector::zeros(3), stiffer, None).tracking(f64::INFINITY);
        assert!(stiffer.most_m < 0.3 * tracking.most_m, "{stiffer:?}");
    }

    #[test]
    fn it_waits_until_the_joints_have_settled_and_then_stands_where_it_should() {
        let motion = Motion::new(straight(&Robot::aimm()), JointVector::zeros(3), controller(), None);
        let over = motion.lasts_s() - 4.0;
        assert!(over > 0.1 && over < 1.0, "{over} s");
        assert!((motion.at(4.0)[0] - 2.0).abs() > SETTLED && (motion.at(motion.lasts_s())[0] - 2.0).abs() <= SETTLED);
        assert_eq!(motion.end(), Ok(JointVector::of([2.0, 0.0, 0.0])));
    }

    #[test]
    fn what_is_too_far_off_breaks_off_there_and_says_how_far() {
        let weak = Controller { stiffness: 3.0, ..controller() };
        let motion = Motion::new(straight(&Robot::aimm()), JointVector::zeros(3), weak, None);
        let reason = motion.end();
        assert!(motion.lasts_s() < 3.0 && motion.at(motion.lasts_s())[0] < 2.0);
        assert!(reason.is_err_and(|r| r.contains("m from its trajectory, 0.05 m are allowed")), "{reason:?}");
        assert!((motion.tracking(f64::INFINITY).most_m - 0.05).abs() < 0.002);
    }

    #[test]
    fn a_motion_that_starts_beside_its_trajectory_comes_to_it() {
        let motion = Motion::new(straight(&Robot::aimm()), JointVector::of([0.0, 0.01, 0.01]), controller(), None);
        let tracking = motion.tracking(f64::INFINITY);
        assert!((tracking.most_rad - 0.01).abs() < 1e-9 && tracking.rms_rad < 0.002, "{tracking:?}");
        assert_eq!(motion.end(), Ok(JointVector::of([2.0, 0.0, 0.0])));
    }
}
