//! Inverse kinematics: postures that bring a link of any robot to a target pose, within tolerances.
//!
//! Numeric: damped least squares on the geometric Jacobian, from a given posture or from random ones. Errors within the tolerance count as
//! zero, so the same descent serves exact poses ([`Target::at`]), poses with a free rotation about an axis, and constraints for a whole path,
//! such as "upright" ([`Target::upright`]). Arms of seven joints with a spherical shoulder and wrist (`spherical`, `elbow`) and most arms
//! with six (`closed_form`, `six`) are solved in closed form: every reachable pose is found, and unreachable ones are recognized for certain.
//! Chains with more joints are solved in closed form for fixed values of one or a few joints, where the others allow it. Deterministic: the
//! caller provides the random numbers.

use crate::closed_form::ClosedForm;
use crate::elbow::{self, Arc};
use crate::frame::compose;
use crate::joint_vector::JointVector;
use crate::levers::{Chain, Levers};
use crate::mechanism::{MAX_JOINTS, Mechanism};
use crate::robot_model::{Drive, Joint};
use crate::spherical::Spherical;
use crate::vector::{Vector, position, rotate, unit};
use rand::{Rng, RngExt};
use ratn_model::pose::Pose;
use std::f64::consts::PI;

/// Maximum number of iterations of a descent.
const MAX_ITERATIONS: usize = 80;

/// Maximum change of a joint in one iteration, in radians.
const MAX_STEP: f64 = 0.4;

/// A descent aims at this fraction of the tolerances, so that it does not creep along their edge.
const INNER: f64 = 0.9;

/// Smaller tolerances count as exact, in metres or radians.
const EXACT: f64 = 1e-4;

/// Error of the rotation of a pose that was measured, in radians: 0.3 mm at the end of a finger of 6 cm.
const MEASURED_WITHIN_RAD: f64 = 5e-3;

/// Number of arcs of elbow angles that are tried for the nearest posture.
const ARCS_TRIED: usize = 4;

/// A held joint is tried at this many values across its range, from its present value outwards, while the others are solved.
const STEPS: usize = 64;

/// Number of random values of held joints in an attempt anywhere.
const DRAWS: usize = 8;

/// Number of descents in an attempt anywhere, until one succeeds. With twenty attempts every one of 10,000 random poses is found, for an arm
/// that is not solved in closed form.
const DESCENTS: usize = 2;

/// Maximum elbow rotation between neighbouring postures of a family, in radians; at the edge of an arc they lie inside by this fraction of
/// it.
const FAMILY_TURN: f64 = 0.15;
const ARC_EDGE: f64 = 1e-3;

/// Number of values of a held joint in the postures of a family; shared by several held joints.
const FAMILY_HELD: usize = 48;

/// Two postures closer than this are considered equal, in radians.
const SAME: f64 = 0.05;

/// A row of a Jacobian, with a column per joint.
type Row = [f64; MAX_JOINTS];

/// A target pose of a link, with tolerances.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// The pose in the root's frame.
    pub pose: Pose,
    /// Position tolerance along the axes of that pose, in metres.
    pub tolerance_m: [f64; 3],
    /// Rotation tolerance about these axes, in radians. Half a turn or more about z allows any rotation about z; x and y then bound the
    /// direction of the z axis together.
    pub tolerance_rad: [f64; 3],
    /// The origin and the axes of the position tolerances, where they differ from those of `pose`.
    pub bounds: Option<Pose>,
}

impl Target {
    /// The exact pose, to within a micrometre and a microradian.
    pub fn at(pose: Pose) -> Target {
        Target { pose, tolerance_m: [1e-6; 3], tolerance_rad: [1e-6; 3], bounds: None }
    }

    /// Any position, with the z axis of the frame at most `tolerance_rad` from the z axis of `pose`.
    pub fn upright(pose: Pose, tolerance_rad: f64) -> Target {
        let tolerance_rad = [tolerance_rad, tolerance_rad, PI];
        Target { pose, tolerance_m: [f64::INFINITY; 3], tolerance_rad, bounds: None }
    }

    /// The error of a pose beyond the tolerances, as position and rotation vector in the target's frame; zero where the target is reached.
    fn error(&self, have: &Pose, share: f64) -> [f64; 6] {
        let inverse = self.pose.inverse();
        let off = self.off(have);
        let about_z = self.tolerance_rad[2] >= PI;
        let turn = if about_z {
            rotate(&inverse, between_directions(rotate(have, Vector::Z), rotate(&self.pose, Vector::Z)))
        } else {
            rotate(&inverse, rotation_vector(&compose(&self.pose, &have.inverse())))
        };
        let beyond = |value: f64, tolerance: f64| {
            let tolerance = tolerance * share;
            if value.abs() <= tolerance { 0.0 } else { value - value.signum() * tolerance }
        };
        let off = Vector::from_array(std::array::from_fn(|i| beyond(off[i], self.tolerance_m[i])));
        let turn = if about_z {
            let turn = Vector::new(turn.x, turn.y, 0.0);
            let (angle, tolerance) = (turn.length(), self.tolerance_rad[0].min(self.tolerance_rad[1]) * share);
            if angle <= tolerance { Vector::ZERO } else { turn * ((angle - tolerance) / angle) }
        } else {
            Vector::from_array(std::array::from_fn(|i| beyond(turn[i], self.tolerance_rad[i])))
        };
        [off.x, off.y, off.z, turn.x, turn.y, turn.z]
    }

    /// The vector from a pose to the centre of the position tolerances, in their axes.
    fn off(&self, have: &Pose) -> Vector {
        let middle = self.bounds.as_ref().unwrap_or(&self.pose);
        rotate(&middle.inverse(), position(middle) - position(have))
    }

    /// How far the frame may move from a pose, in metres, and rotate, in radians, within the tolerances; negative outside of them.
    pub(crate) fn room(&self, have: &Pose) -> [f64; 2] {
        let off = self.off(have);
        let left_m = (0..3).map(|i| self.tolerance_m[i] - off[i].abs()).fold(f64::INFINITY, f64::min);
        let left_rad = if self.tolerance_rad[2] >= PI {
            let turn = between_directions(rotate(have, Vector::Z), rotate(&self.pose, Vector::Z)).length();
            self.tolerance_rad[0].min(self.tolerance_rad[1]) - turn
        } else {
            let turn = rotate(&self.pose.inverse(), rotation_vector(&compose(&self.pose, &have.inverse())));
            (0..3).map(|i| self.tolerance_rad[i] - turn[i].abs()).fold(f64::INFINITY, f64::min)
        };
        [left_m, left_rad]
    }

    /// The components of an error that a step has to respect; those that are free to change are left out.
    fn minds(&self, error: &[f64; 6]) -> [bool; 6] {
        let tolerance = |i: usize| if i < 3 { self.tolerance_m[i] } else { self.tolerance_rad[i - 3] };
        std::array::from_fn(|i| error[i] != 0.0 || tolerance(i) < EXACT)
    }

    /// Whether a pose is within the tolerances.
    pub fn is_met_by(&self, pose: &Pose) -> bool {
        self.error(pose, 1.0) == [0.0; 6]
    }

    /// Whether the tolerances are negligible.
    fn is_exact(&self) -> bool {
        self.tolerance_m.iter().chain(&self.tolerance_rad).all(|t| *t < EXACT)
    }
}

/// The chain of joints from a robot's root to one of its links.
#[derive(Debug, Clone)]
pub struct Reach {
    /// From the root: for each joint that moves the link, its pose in the frame before it.
    chain: Vec<(Pose, Drive)>,
    /// The pose of the link in the frame of the last joint.
    tip: Pose,
    joints: Vec<Joint>,
    /// Planned joints that do not move the link.
    others: Vec<usize>,
    spherical: Option<Spherical>,
    /// For chains that are not spherical at both ends.
    closed_form: Option<ClosedForm>,
    levers: Levers,
}

/// All postures that meet a target, in closed form where the arm allows it.
#[derive(Debug, Clone)]
pub struct Postures {
    target: Target,
    form: Form,
}

/// How the postures are found.
#[derive(Debug, Clone)]
enum Form {
    /// By numeric descent only.
    Numeric,
    /// By the elbow angles within the joint limits.
    Arcs(Vec<Arc>),
    /// By holding some joints of the chain.
    Held,
    /// There are none for certain.
    OutOfReach,
}

impl Postures {
    /// Whether there are no postures for certain.
    pub fn is_empty(&self) -> bool {
        match &self.form {
            Form::Arcs(arcs) => arcs.is_empty(),
            Form::OutOfReach => true,
            Form::Numeric | Form::Held => false,
        }
    }
}

/// A joint's axis in the root's frame.
struct Axis {
    direction: Vector,
    point: Vector,
    drive: Drive,
}

impl Reach {
    /// The chain to the link with this index, extended by a frame fixed to that link.
    pub fn new(mechanism: &Mechanism, link: usize, frame: Pose) -> Reach {
        let Chain { joints: chain, tip } = Chain::to(link, &mechanism.links, |link| (link.origin, link.drive));
        let tip = tip.compose(&frame);
        let spherical = Spherical::of(&chain, &tip);
        let joints = mechanism.joints.clone();
        let closed_form = if spherical.is_some() { None } else { ClosedForm::of(&chain, &joints) };
        let is_other = |joint: &usize| chain.iter().all(|(_, drive)| drive.joint != *joint);
        let others = (0..joints.len()).filter(is_other).collect();
        let levers = Levers::new(&chain, tip.distance(&Pose::IDENTITY), &joints);
        Reach { chain, tip, joints, others, spherical, closed_form, levers }
    }

    /// The target of a pose. An arm with fewer than six joints cannot turn its tool as it likes: it takes any rotation within the error of poses
    /// that were measured, and the position as exactly as other arms.
    pub fn target(&self, pose: Pose) -> Target {
        let exact = Target::at(pose);
        match self.joints.len() - self.others.len() {
            6.. => exact,
            _ => Target { tolerance_rad: [MEASURED_WITHIN_RAD; 3], ..exact },
        }
    }

    /// The joints, in the order of the positions.
    pub(crate) fn limits(&self) -> &[Joint] {
        &self.joints
    }

    /// Bounds of the frame's motion by joint motion.
    pub(crate) fn levers(&self) -> &Levers {
        &self.levers
    }

    /// Number of joints of the robot.
    pub fn joints(&self) -> usize {
        self.joints.len()
    }

    /// The pose of the frame in the root's frame.
    pub fn pose(&self, positions: &JointVector) -> Pose {
        let place = |pose: &Pose, (origin, drive): &(Pose, Drive)| {
            compose(&compose(pose, origin), &drive.moved(positions[drive.joint]))
        };
        compose(&self.chain.iter().fold(Pose::IDENTITY, |pose, link| place(&pose, link)), &self.tip)
    }

    /// The frame's speed, in metres per second, and angular speed, in radians per second, at these joint velocities.
    pub(crate) fn speeds(&self, positions: &JointVector, velocities: &JointVector) -> [f64; 2] {
        let (axes, tip) = self.axes(positions);
        let rows = jacobian(&axes, &tip, &[Pose::IDENTITY; 2], [true; 6]);
        let along = |row: usize| (0..self.joints.len()).map(|j| rows[row][j] * velocities[j]).sum::<f64>();
        [0, 3].map(|first| Vector::new(along(first), along(first + 1), along(first + 2)).length())
    }

    /// The nearest positions within the limits.
    pub fn clamp(&self, positions: &JointVector) -> JointVector {
        let mut clamped = *positions;
        for (q, joint) in clamped.iter_mut().zip(&self.joints) {
            *q = q.clamp(joint.lower, joint.upper);
        }
        clamped
    }

    /// Random positions within the limits.
    pub fn random(&self, random: &mut impl Rng) -> JointVector {
        JointVector::from_fn(self.joints.len(), |j| random.random_range(self.joints[j].lower..self.joints[j].upper))
    }

    /// Descends from `seed` to positions within the limits that meet the target.
    pub fn descend(&self, target: &Target, seed: &JointVector) -> Option<JointVector> {
        let mut positions = self.clamp(seed);
        for _ in 0..MAX_ITERATIONS {
            let (axes, tip) = self.axes(&positions);
            if target.is_met_by(&tip) {
                return Some(positions);
            }
            let error = target.error(&tip, INNER);
            let views = [target.bounds.as_ref().unwrap_or(&target.pose), &target.pose].map(Pose::inverse);
            let mut rows = jacobian(&axes, &tip, &views, target.minds(&error));
            let [off, turned] = [0, 3].map(|first| Vector::from_slice(&error[first..]).length());
            // Far from the target, heavy damping keeps the descent steady; close to it the step is nearly Newton's.
            let damping = f64::clamp(1e-3 * (off + turned), 1e-9, 1e-3);
            let mut step = damped_step(&rows, &error, damping, self.joints.len())?;
            // The other joints have to replace the motion of a joint at its limit.
            while self.stop_at_limits(&positions, &step, &mut rows) {
                step = damped_step(&rows, &error, damping, self.joints.len())?;
            }
            let largest = step.iter().fold(0.0_f64, |m, s| m.max(s.abs()));
            let scale = if largest > MAX_STEP { MAX_STEP / largest } else { 1.0 };
            for (q, step) in positions.iter_mut().zip(step) {
                *q += scale * step;
            }
            positions = self.clamp(&positions);
        }
        None
    }

    /// Removes from a Jacobian the joints that are at a limit and that a step would move beyond it; returns whether there were any.
    fn stop_at_limits(&self, positions: &JointVector, step: &Row, rows: &mut [Row; 6]) -> bool {
        let mut stopped = false;
        for (j, joint) in self.joints.iter().enumerate() {
            let leaves =
                (step[j] < 0.0 && positions[j] <= joint.lower) || (step[j] > 0.0 && positions[j] >= joint.upper);
            if leaves && rows.iter().any(|row| row[j] != 0.0) {
                rows.iter_mut().for_each(|row| row[j] = 0.0);
                stopped = true;
            }
        }
        stopped
    }

    /// The postures that meet a target, to be drawn by [`Reach::nearest`] and [`Reach::anywhere`].
    pub fn postures(&self, target: &Target) -> Postures {
        let form = match (&self.spherical, &self.closed_form) {
            (Some(arm), _) if target.is_exact() => Form::Arcs(elbow::arcs(arm, &target.pose, &self.joints)),
            (None, Some(form)) if target.is_exact() => {
                let here = JointVector::zeros(self.joints.len());
                let solved = form.solve(&self.chain, &self.tip, &self.joints, &target.pose, &here);
                if solved.is_complete && solved.postures.is_empty() { Form::OutOfReach } else { Form::Held }
            }
            _ => Form::Numeric,
        };
        Postures { target: *target, form }
    }

    /// Up to `wanted` different postures from at most `attempts` attempts, nearest to `near` first.
    pub fn solutions(
        &self,
        target: &Target,
        near: &JointVector,
        wanted: usize,
        attempts: usize,
        random: &mut impl Rng,
    ) -> Vec<JointVector> {
        let mut found: Vec<JointVector> = Vec::new();
        let postures = self.postures(target);
        for attempt in 0..attempts {
            for posture in self.attempt(&postures, near, attempt, random) {
                if found.len() < wanted && is_new(&found, &posture) {
                    found.push(posture);
                }
            }
            if found.len() == wanted || postures.is_empty() {
                break;
            }
        }
        sorted(found, near)
    }

    /// The postures of one attempt, nearest to `near` first: the first attempt finds those close to `near`, later ones any.
    pub fn attempt(
        &self,
        postures: &Postures,
        near: &JointVector,
        attempt: usize,
        random: &mut impl Rng,
    ) -> Vec<JointVector> {
        if attempt == 0 { self.nearest(postures, near) } else { self.anywhere(postures, near, random) }
    }

    /// Postures close to `near`, nearest first. Joints that do not move the link keep their values.
    pub fn nearest(&self, postures: &Postures, near: &JointVector) -> Vec<JointVector> {
        match (&postures.form, &self.spherical, &self.closed_form) {
            (Form::Arcs(arcs), Some(arm), _) => {
                let turn = arm.turn(near);
                let mut closest: Vec<(f64, f64, f64)> = Vec::new();
                for arc in arcs {
                    let (turn, away) = arc.nearest(turn);
                    closest.push((away, turn, arc.bend));
                }
                closest.sort_by(|a, b| a.0.total_cmp(&b.0));
                let closest = closest.into_iter().take(ARCS_TRIED);
                sorted(closest.flat_map(|(_, turn, bend)| self.solve(postures, bend, turn, near)).collect(), near)
            }
            (Form::Held, _, Some(form)) => {
                let found = self.nearest_held(form, &postures.target, &self.clamp(near));
                if found.is_empty() { self.descend(&postures.target, near).into_iter().collect() } else { found }
            }
            (Form::OutOfReach, ..) => Vec::new(),
            _ => self.descend(&postures.target, near).into_iter().collect(),
        }
    }

    /// Postures anywhere, nearest to `near` first. Joints that do not move the link keep their values half of the time: with other values
    /// they may be out of everything's way.
    pub fn anywhere(&self, postures: &Postures, near: &JointVector, random: &mut impl Rng) -> Vec<JointVector> {
        let stays = self.others.is_empty() || random.random_bool(0.5);
        let others = if stays { *near } else { self.random(random) };
        let mut seed = || {
            let mut seed = self.random(random);
            self.others.iter().for_each(|joint| seed[*joint] = others[*joint]);
            seed
        };
        match (&postures.form, &self.closed_form) {
            (Form::Arcs(arcs), _) => {
                let mut along = random.random_range(0.0..1.0) * arcs.iter().map(|arc| arc.width).sum::<f64>();
                let chosen = arcs.iter().find(|arc| {
                    let here = along < arc.width;
                    if !here {
                        along -= arc.width;
                    }
                    here
                });
                let found = chosen.map(|arc| self.solve(postures, arc.bend, arc.from + along, &others));
                sorted(found.unwrap_or_default(), near)
            }
            (Form::Held, Some(form)) => {
                let draws = if form.held.is_empty() { 1 } else { DRAWS };
                let found = (0..draws).map(|_| self.solve_held(form, &postures.target, &seed()));
                match found.into_iter().find(|found| !found.is_empty()) {
                    Some(found) => sorted(found, near),
                    None => (0..DESCENTS).find_map(|_| self.descend(&postures.target, &seed())).into_iter().collect(),
                }
            }
            (Form::OutOfReach, _) => Vec::new(),
            _ => (0..DESCENTS).find_map(|_| self.descend(&postures.target, &seed())).into_iter().collect(),
        }
    }

    /// Whether poses have whole families of known postures: the chain is redundant and solved in closed form.
    pub(crate) fn has_families(&self) -> bool {
        self.spherical.is_some() || self.closed_form.as_ref().is_some_and(|form| !form.held.is_empty())
    }

    /// Closely spaced postures from all families of a pose. Joints that do not move the link are as in `near`, and joints with several turns
    /// use the turn nearest to it.
    pub(crate) fn family(&self, target: &Target, near: &JointVector) -> Vec<JointVector> {
        let postures = self.postures(target);
        match (&postures.form, &self.closed_form) {
            (Form::Arcs(arcs), _) => {
                let mut all = Vec::new();
                for arc in arcs {
                    let parts = (arc.width / FAMILY_TURN).ceil().max(1.0);
                    let inside = arc.width * ARC_EDGE;
                    for i in 0..=parts as usize {
                        let along = inside + (arc.width - 2.0 * inside) * i as f64 / parts;
                        all.extend(self.solve(&postures, arc.bend, arc.from + along, near));
                    }
                }
                all
            }
            (Form::Held, Some(form)) => {
                let mut held = vec![*near];
                let each = (FAMILY_HELD as f64).powf(1.0 / form.held.len().max(1) as f64).floor().max(2.0) as usize;
                for joint in &form.held {
                    let Joint { lower, upper, .. } = self.joints[*joint];
                    let at = |i: usize| lower + (upper - lower) * i as f64 / (each - 1) as f64;
                    let moved = |posture: &JointVector, i: usize| {
                        let mut moved = *posture;
                        moved[*joint] = at(i);
                        moved
                    };
                    held = held.iter().flat_map(|posture| (0..each).map(|i| moved(posture, i))).collect();
                }
                held.iter().flat_map(|held| self.solve_held(form, &postures.target, held)).collect()
            }
            _ => Vec::new(),
        }
    }

    /// The postures whose held joints are closest to `near`, each solved joint in the turn nearest to it.
    fn nearest_held(&self, form: &ClosedForm, target: &Target, near: &JointVector) -> Vec<JointVector> {
        let here = self.solve_held(form, target, near);
        if !here.is_empty() {
            return here;
        }
        for step in 1..=STEPS {
            let mut found = Vec::new();
            for joint in &form.held {
                let Joint { lower, upper, .. } = self.joints[*joint];
                let by = (upper - lower) * step as f64 / STEPS as f64;
                for place in [near[*joint] - by, near[*joint] + by] {
                    if (lower..=upper).contains(&place) {
                        let mut held = *near;
                        held[*joint] = place;
                        found.extend(self.solve_held(form, target, &held));
                    }
                }
            }
            if !found.is_empty() {
                return sorted(found, near);
            }
        }
        Vec::new()
    }

    /// The postures with the held joints as in `others`, nearest to them first.
    fn solve_held(&self, form: &ClosedForm, target: &Target, others: &JointVector) -> Vec<JointVector> {
        let solved = form.solve(&self.chain, &self.tip, &self.joints, &target.pose, others);
        // Rounded axes in the URDF, and limits, need a small correction.
        sorted(solved.postures.iter().filter_map(|posture| self.descend(target, posture)).collect(), others)
    }

    /// The postures within the limits with the elbow at this bend and turn, in closed form, and the other joints as in `others`.
    fn solve(&self, postures: &Postures, bend: f64, turn: f64, others: &JointVector) -> Vec<JointVector> {
        let target = &postures.target;
        let Some(arm) = &self.spherical else { return Vec::new() };
        // At the end of an arc a joint is at its limit, up to rounding.
        let clamped =
            arm.solve(&target.pose, bend, turn, &self.joints, others).into_iter().map(|posture| self.clamp(&posture));
        clamped.filter(|posture| target.is_met_by(&self.pose(posture))).collect()
    }

    /// Each joint's axis with a point on it, in the root's frame; and the frame's pose.
    fn axes(&self, positions: &JointVector) -> (Vec<Axis>, Pose) {
        let mut axes = Vec::with_capacity(self.chain.len());
        let mut pose = Pose::IDENTITY;
        for (origin, drive) in &self.chain {
            pose = compose(&pose, origin);
            axes.push(Axis { direction: rotate(&pose, drive.axis), point: position(&pose), drive: *drive });
            pose = compose(&pose, &drive.moved(positions[drive.joint]));
        }
        (axes, compose(&pose, &self.tip))
    }
}

/// The rows are the linear and angular velocity of the tip per joint, in frames rotated by `views`; rows that are not minded are zero.
fn jacobian(axes: &[Axis], tip: &Pose, views: &[Pose; 2], minded: [bool; 6]) -> [Row; 6] {
    let mut rows = [[0.0; MAX_JOINTS]; 6];
    for Axis { direction, point, drive } in axes {
        let (linear, angular) = match drive.slides {
            true => (*direction, Vector::ZERO),
            false => (direction.cross(position(tip) - *point), *direction),
        };
        let values =
            [rotate(&views[0], linear), rotate(&views[1], angular)].map(<[f64; 3]>::from).into_iter().flatten();
        for ((row, value), _) in rows.iter_mut().zip(values).zip(minded).filter(|(_, minded)| *minded) {
            // A joint may move several links of a chain.
            row[drive.joint] += value * drive.factor;
        }
    }
    rows
}

/// Whether a posture differs from all of these.
pub(crate) fn is_new(found: &[JointVector], posture: &JointVector) -> bool {
    found.iter().all(|other| distance(other, posture) > SAME)
}

fn sorted(mut postures: Vec<JointVector>, near: &JointVector) -> Vec<JointVector> {
    postures.sort_by(|a, b| distance(a, near).total_cmp(&distance(b, near)));
    postures
}

/// The Euclidean distance.
pub fn distance(a: &JointVector, b: &JointVector) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// The axis of a rotation times its angle, at most half a turn.
pub(crate) fn rotation_vector(rotation: &Pose) -> Vector {
    let turn = rotation.quaternion_xyzw;
    let [i, j, k, w] = if turn[3] < 0.0 { turn.map(|c| -c) } else { turn };
    let axis = Vector::new(i, j, k);
    let sine = axis.length();
    // Near zero the angle is about twice the sine of its half.
    let scale = if sine > 1e-9 { 2.0 * sine.atan2(w) / sine } else { 2.0 };
    axis * scale
}

/// The shortest rotation from one direction to another, as a rotation vector; for opposite directions about any axis.
fn between_directions(from: Vector, to: Vector) -> Vector {
    let axis = from.cross(to);
    let (sine, cosine) = (axis.length(), from.dot(to));
    if sine > 1e-12 {
        return axis * (sine.atan2(cosine) / sine);
    }
    if cosine > 0.0 {
        return Vector::ZERO;
    }
    let aside = if from.x.abs() < 0.9 { Vector::X } else { Vector::Y };
    unit(from.cross(aside)) * PI
}

/// Jᵀ (J Jᵀ + λ I)⁻¹ e; `None` where the system is singular.
fn damped_step(jacobian: &[Row; 6], error: &[f64; 6], damping: f64, joints: usize) -> Option<Row> {
    let mut system = [[0.0; 7]; 6];
    for row in 0..6 {
        for column in 0..6 {
            system[row][column] = (0..joints).map(|j| jacobian[row][j] * jacobian[column][j]).sum();
        }
        system[row][row] += damping;
        system[row][6] = error[row];
    }
    let solved = solve(&mut system)?;
    Some(std::array::from_fn(|j| (0..6).map(|row| jacobian[row][j] * solved[row]).sum()))
}

/// Gaussian elimination with partial pivoting; the last column is the right-hand side.
pub(crate) fn solve(system: &mut [[f64; 7]; 6]) -> Option<[f64; 6]> {
    for column in 0..6 {
        let pivot = (column..6).max_by(|a, b| system[*a][column].abs().total_cmp(&system[*b][column].abs()))?;
        system.swap(column, pivot);
        if system[column][column].abs() < 1e-15 {
            return None;
        }
        for row in column + 1..6 {
            let factor = system[row][column] / system[column][column];
            let above = system[column];
            for (value, other) in system[row].iter_mut().zip(above).skip(column) {
                *value -= factor * other;
            }
        }
    }
    let mut solution = [0.0; 6];
    for row in (0..6).rev() {
        let known: f64 = (row + 1..6).map(|k| system[row][k] * solution[k]).sum();
        solution[row] = (system[row][6] - known) / system[row][row];
    }
    Some(solution)
}
