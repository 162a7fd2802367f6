//! Riding: objects that stand still on the robot while its base drives.
//!
//! Friction moves objects along with a deck that moves gently. Computing that contact by contact, at every step, is most of what a drive costs,
//! and always has the same result. So an object that has stood still on the deck for a while is placed relative to the deck: as a body at rest is
//! put to sleep, except that its support moves.
//!
//! ```text
//! free ──all that is awake has stood still on the deck for a while──▶ rides ──the base stands──▶ asleep
//!  ▲                                                                    │
//!  └── something else is awake, or would slide or tip: all that rides ──┘ is let go, as fast as it was
//! ```
//! A rider would slide if its acceleration is more than friction gives (Coulomb), and tip if its centre of mass pushes beyond its foot; half of
//! either limit is kept in reserve. An object that stands on a rider does not ride.

use super::object::{Kind, Model};
use super::world::{Environment, GRAVITY, ObjectState, ROBOT_FRICTION, STEP, Support};
use rapier3d::math::Vector;
use rapier3d::prelude::RigidBody;
use ratn_model::pose::Pose;
use ratn_motion::drive::wrapped;
use ratn_motion::robot::{Configuration, Robot, to_f32};

/// Number of steps for which everything has to have stood still on the deck before it rides.
const STILL_STEPS: u32 = 75;
/// Maximum speeds that count as standing still, in metres and in radians per second.
const STILL_M: f32 = 0.005;
const STILL_RAD: f32 = 0.05;
/// Fraction of the limits of friction and foot that is used.
const USED: f64 = 0.5;
/// Maximum lean of a rider, in radians.
const MAX_LEAN_RAD: f64 = 0.05;

/// The riders, and for how long everything has stood still.
#[derive(Debug, Clone, Default)]
pub(super) struct Riding {
    /// Objects, with the pose of each in the frame of the base.
    riders: Vec<(usize, Pose)>,
    /// Steps since an awake object moved on the deck.
    still: u32,
}

impl Riding {
    /// From a saved state.
    pub(super) fn restored(riders: Vec<(usize, Pose)>) -> Riding {
        Riding { riders, still: 0 }
    }

    /// Whether any object rides.
    pub(super) fn is_under_way(&self) -> bool {
        !self.riders.is_empty()
    }

    /// The pose of a rider in the frame of the base.
    pub(super) fn seat(&self, object: usize) -> Option<Pose> {
        self.riders.iter().find(|(rider, _)| *rider == object).map(|(_, seat)| *seat)
    }
}

impl Environment {
    /// Called before a step in which the joints move to `configuration`: the riders move along, or stop riding.
    pub(super) fn take_along(&mut self, robot: &Robot, configuration: &Configuration) {
        if !self.riding.is_under_way() {
            return;
        }
        let (deck, stands) = (base_pose(configuration.base), configuration.base == self.base);
        let goes = |(rider, seat): &(usize, Pose)| {
            let (pose, body) = (deck.compose(seat), self.body(*rider));
            let dt = STEP.as_secs_f64();
            let acceleration: [f64; 2] = std::array::from_fn(|i| {
                let was = f64::from(body.translation()[i]);
                ((pose.position[i] - was) / dt - f64::from(body.linvel()[i])) / dt
            });
            holds(self.model(*rider), &pose, acceleration[0].hypot(acceleration[1]))
        };
        let go = self.awake().next().is_none() && self.riding.riders.iter().all(goes);
        if go && !stands {
            for (rider, seat) in self.riding.riders.clone() {
                self.body_mut(rider).set_next_kinematic_position(to_f32(&deck.compose(&seat)));
            }
            return;
        }
        // The riders fall asleep where they are, or move freely with the velocity that they had.
        let before = Configuration { base: self.base, ..*configuration };
        self.reseat(robot, &before, |_, state| {
            if state.rides.take().is_some() && go {
                *state = ObjectState { at_rest: true, velocity: [0.0; 3], spin: [0.0; 3], ..*state };
            }
        });
    }

    /// Called after a step in which the joints moved to `configuration` and the base moved from `before`: objects that move with it may begin to
    /// ride.
    pub(super) fn board(&mut self, robot: &Robot, configuration: &Configuration, before: [f64; 3]) {
        if before == self.base || self.riding.is_under_way() {
            self.riding.still = 0;
            return;
        }
        let dt = STEP.as_secs_f64();
        let [x, y, turned] = std::array::from_fn(|i| self.base[i] - before[i]);
        let spin = (wrapped(turned) / dt) as f32;
        let still = |object: usize| {
            let body = self.body(object);
            let [rx, ry] = [0, 1].map(|i| body.translation()[i] - self.base[i] as f32);
            let deck = Vector::new((x / dt) as f32 - spin * ry, (y / dt) as f32 + spin * rx, 0.0);
            let turns = body.angvel() - Vector::new(0.0, 0.0, spin);
            (body.linvel() - deck).length() < STILL_M && turns.length() < STILL_RAD
        };
        let awake: Vec<usize> = self.awake().collect();
        self.riding.still = if awake.iter().all(|object| still(*object)) { self.riding.still + 1 } else { 0 };
        if self.riding.still < STILL_STEPS {
            return;
        }
        self.riding.still = 0;
        let deck = base_pose(self.base).inverse();
        let seats: Vec<(usize, Pose)> = awake.iter().map(|i| (*i, deck.compose(&self.state(*i).pose))).collect();
        let stands = |(object, _): &(usize, Pose)| {
            let aboard = matches!(self.rests_on(*object), Some(Support::Named(name)) if self.is_of_robot(name));
            aboard && holds(self.model(*object), &self.state(*object).pose, 0.0)
        };
        if seats.iter().all(stands) {
            self.reseat(robot, configuration, |object, state| {
                state.rides = seats.iter().find(|(rider, _)| *rider == object).map(|(_, seat)| *seat);
            });
        }
    }

    /// An object stops riding, because it is carried or moves freely from now on.
    pub(super) fn alight(&mut self, object: usize) {
        self.riding.riders.retain(|(rider, _)| *rider != object);
    }

    /// Makes all bodies anew, as `change` modifies them: the solver remembers contacts of the motion before.
    fn reseat(&mut self, robot: &Robot, configuration: &Configuration, change: impl Fn(usize, &mut ObjectState)) {
        let mut saved = self.saved();
        saved.objects.iter_mut().enumerate().for_each(|(i, (_, state))| change(i, state));
        self.make_again(robot, configuration, &saved);
    }

    /// The objects that move by themselves.
    fn awake(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.len()).filter(|object| self.moves(self.body(*object)))
    }

    /// Whether a body moves by itself.
    pub(super) fn moves(&self, body: &RigidBody) -> bool {
        body.is_dynamic() && !body.is_sleeping() && body.translation().z >= super::world::LOST_M
    }
}

/// Whether friction and its foot hold an object on a deck with this acceleration, in m/s².
fn holds(model: &Model, pose: &Pose, acceleration: f64) -> bool {
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| pose.rotate(axis)[2].abs());
    let Some(up) = (0..3).max_by(|a, b| axes[*a].total_cmp(&axes[*b])) else { return false };
    let across = (0..3).filter(|axis| *axis != up).map(|axis| model.size[axis] / 2.0).fold(f64::INFINITY, f64::min);
    let foot = if matches!(model.kind, Kind::Plate | Kind::Bowl) { super::object::FOOT * across } else { across };
    let friction = model.kind.friction().min(f64::from(ROBOT_FRICTION));
    let bears = USED * GRAVITY * friction.min(foot / (model.size[up] / 2.0));
    axes[up] >= MAX_LEAN_RAD.cos() && acceleration <= bears
}

pub(super) fn base_pose([x, y, heading]: [f64; 3]) -> Pose {
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, heading)
}
