//! Inverse kinematics: arm postures that bring the tool to a pose.
//!
//! Damped least squares on the geometric Jacobian. The arm has one joint more than a pose needs, so during the first
//! iterations the step is also drawn towards a preferred posture within the null space. Restarts from random postures give
//! further solutions. Deterministic: the randomness comes from the caller.

use crate::collision::distance;
use crate::frame::{compose, cross, difference, norm, rotate};
use crate::reach::{rotation_vector, solve};
use crate::robot::{Configuration, Joints, Motion, Robot};
use rand::{Rng, RngExt};
use ratn_model::pose::Pose;

/// A solution is at most this far off, in metres.
pub const POSITION_TOLERANCE_M: f64 = 1e-6;

/// A solution is turned at most by this much, in radians.
pub const ROTATION_TOLERANCE_RAD: f64 = 1e-6;

/// Iterations of one descent.
const MAX_ITERATIONS: usize = 80;

/// Iterations during which the preferred posture draws.
const DRAWN_ITERATIONS: usize = 30;

/// Two solutions closer than this are the same one, in radians.
const SAME_RAD: f64 = 0.05;

/// The greatest change of a joint in one iteration, in radians.
const MAX_STEP_RAD: f64 = 0.4;

type Vector6 = [f64; 6];

/// Solves for one robot with its base at one place.
#[derive(Debug, Clone)]
pub struct Solver<'a> {
    robot: &'a Robot,
    poses: Vec<Pose>,
}

impl<'a> Solver<'a> {
    /// A solver for the robot with its base at `base` in the world frame.
    pub fn new(robot: &'a Robot, base: &Pose) -> Solver<'a> {
        let configuration = Configuration::ZERO.with_base(base);
        Solver { robot, poses: robot.poses(&configuration) }
    }

    /// The tool frame in the world frame.
    pub fn tool(&mut self, arm: &Joints) -> Pose {
        self.robot.update_arm(arm, 0.0, &mut self.poses);
        self.poses[self.robot.tool]
    }

    /// Descends from `seed` to a posture within limits whose tool is at `target`; with `drawn_to`, prefers postures near it.
    pub fn descend(&mut self, target: &Pose, seed: &Joints, drawn_to: Option<&Joints>) -> Option<Joints> {
        let mut arm = self.robot.clamp(seed);
        for iteration in 0..MAX_ITERATIONS {
            let tool = self.tool(&arm);
            let error = pose_error(&tool, target);
            let off = norm([error[0], error[1], error[2]]);
            let turned = norm([error[3], error[4], error[5]]);
            let drawing = drawn_to.filter(|_| iteration < DRAWN_ITERATIONS);
            if drawing.is_none() && off < POSITION_TOLERANCE_M && turned < ROTATION_TOLERANCE_RAD {
                return Some(arm);
            }
            let jacobian = self.jacobian(&tool);
            // Far away a heavily damped step keeps the descent steady; close by it is nearly Newton's.
            let damping = f64::clamp(1e-3 * (off + turned), 1e-9, 1e-3);
            let mut step = damped_step(&jacobian, &error, damping)?;
            if let Some(preferred) = drawing {
                let pull: Joints = std::array::from_fn(|j| 0.2 * (preferred[j] - arm[j]));
                let moved: Vector6 = std::array::from_fn(|row| (0..7).map(|j| jacobian[row][j] * pull[j]).sum());
                let visible = damped_step(&jacobian, &moved, 1e-6)?;
                for j in 0..7 {
                    step[j] += pull[j] - visible[j];
                }
            }
            let largest = step.iter().fold(0.0_f64, |m, s| m.max(s.abs()));
            let scale = if largest > MAX_STEP_RAD { MAX_STEP_RAD / largest } else { 1.0 };
            for j in 0..7 {
                arm[j] += scale * step[j];
            }
            arm = self.robot.clamp(&arm);
        }
        None
    }

    /// A random posture within limits.
    pub fn random(&self, random: &mut impl Rng) -> Joints {
        let joints = self.robot.arm_joints();
        std::array::from_fn(|j| random.random_range(joints[j].lower..joints[j].upper))
    }

    /// Up to `wanted` different postures for one pose from at most `attempts` descents, nearest to `near` first.
    pub fn solutions(
        &mut self,
        target: &Pose,
        near: &Joints,
        wanted: usize,
        attempts: usize,
        random: &mut impl Rng,
    ) -> Vec<Joints> {
        let mut found: Vec<Joints> = Vec::new();
        for attempt in 0..attempts {
            if let Some(solution) = self.attempt(target, near, attempt, random)
                && found.iter().all(|other| !is_same(other, &solution))
            {
                found.push(solution);
                if found.len() == wanted {
                    break;
                }
            }
        }
        found.sort_by(|a, b| distance(a, near).total_cmp(&distance(b, near)));
        found
    }

    /// One attempt at a pose: the first from `near`, further ones from random postures, all drawn to `near`.
    pub fn attempt(&mut self, target: &Pose, near: &Joints, attempt: usize, random: &mut impl Rng) -> Option<Joints> {
        let seed = if attempt == 0 { *near } else { self.random(random) };
        self.descend(target, &seed, Some(near)).or_else(|| self.descend(target, &seed, None))
    }

    /// Rows: the tool's velocity and angular velocity per joint.
    fn jacobian(&self, tool: &Pose) -> [[f64; 7]; 6] {
        let mut rows = [[0.0; 7]; 6];
        for (j, &link) in self.robot.arm_joint_links.iter().enumerate() {
            if let Motion::Turn { axis, .. } = self.robot.links[link].motion {
                let axis = rotate(&self.poses[link], axis);
                let linear = cross(axis, difference(tool.position, self.poses[link].position));
                for (i, value) in linear.into_iter().chain(axis).enumerate() {
                    rows[i][j] = value;
                }
            }
        }
        rows
    }
}

/// Whether two solutions are the same one.
pub(crate) fn is_same(a: &Joints, b: &Joints) -> bool {
    distance(a, b) < SAME_RAD
}

/// Position and rotation vector from `have` to `want`, in the world frame.
fn pose_error(have: &Pose, want: &Pose) -> Vector6 {
    let [x, y, z] = difference(want.position, have.position);
    let [i, j, k] = rotation_vector(&compose(want, &have.inverse()));
    [x, y, z, i, j, k]
}

/// Jᵀ (J Jᵀ + λ I)⁻¹ e; `None` where the system is singular.
fn damped_step(jacobian: &[[f64; 7]; 6], error: &Vector6, damping: f64) -> Option<Joints> {
    let mut system = [[0.0; 7]; 6];
    for row in 0..6 {
        for column in 0..6 {
            system[row][column] = (0..7).map(|j| jacobian[row][j] * jacobian[column][j]).sum();
        }
        system[row][row] += damping;
        system[row][6] = error[row];
    }
    let solved = solve(&mut system)?;
    Some(std::array::from_fn(|j| (0..6).map(|row| jacobian[row][j] * solved[row]).sum()))
}
