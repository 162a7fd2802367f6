//! Constraints on the tool along a motion: an axis of it stays near a direction of the world, its position stays in a box. Also boxes that
//! everything that moves stays out of.
//!
//! The free path is searched among postures that satisfy the constraint (`constrained`). The timed trajectory is checked again: either the
//! executed curve satisfies the constraint between all samples (`along`), or corners are followed more closely until it does.

use crate::along::first_breach;
use crate::collision::between;
use crate::constrained::{Constraint, LEAST_TOLERANCE};
use crate::joint_vector::JointVector;
use crate::mechanism::Mechanism;
use crate::plan::PlanError;
use crate::reach::{Reach, Target};
use crate::robot_model::Joint;
use crate::space::align;
use crate::timing::{Section, Speed, timed_while};
use crate::trajectory::Curve;
use crate::vector::{Vector, rotate, unit};
use ratn_model::pose::Pose;
use std::f64::consts::{FRAC_PI_2, PI};

/// Shorter vectors have no direction.
const LEAST_DIRECTION: f64 = 1e-6;

/// Maximum edge of a box, in metres.
const MAX_SIZE_M: f64 = 100.0;

/// Number of parts into which each motion of a path is divided to be followed closely.
const DIVIDED: usize = 4;

/// An axis of the tool that stays near a direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeptAxis {
    /// The axis in the tool's frame, of any length but zero.
    pub axis: [f64; 3],
    /// The direction in the world, of any length but zero; by default the axis's direction at the start.
    pub direction: Option<[f64; 3]>,
    /// Maximum angle between the two, in radians.
    pub tolerance_rad: f64,
}

/// A box in the world: the origin of the tool frame stays inside, or everything that moves stays outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Its centre and its axes, in the world.
    pub pose: Pose,
    /// Its edges, in metres.
    pub size: [f64; 3],
}

/// The constraints on the tool; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Keep {
    /// The constraint on its direction.
    pub axis: Option<KeptAxis>,
    /// The constraint on its position.
    pub inside: Option<Region>,
}

impl Region {
    /// Refuses values that make no sense.
    pub(crate) fn check(&self, input: &str) -> Result<(), PlanError> {
        let malformed = |part: &str, value: String, expected: String| {
            Err(PlanError::Malformed { what: format!("the {part} of `{input}`"), value, expected })
        };
        let Region { pose, size } = self;
        if !pose.position.iter().chain(&pose.quaternion_xyzw).all(|c| c.is_finite()) {
            return malformed("pose", format!("{pose:?}"), "finite numbers".to_owned());
        }
        if !size.iter().all(|edge| (2.0 * LEAST_TOLERANCE..=MAX_SIZE_M).contains(edge)) {
            let expected = format!("edges of {} to {MAX_SIZE_M} m", 2.0 * LEAST_TOLERANCE);
            return malformed("size", format!("{size:?}"), expected);
        }
        Ok(())
    }
}

impl Keep {
    /// Refuses values that make no sense.
    pub(crate) fn check(&self) -> Result<(), PlanError> {
        let malformed = |what: &str, value: String, expected: String| {
            Err(PlanError::Malformed { what: what.to_owned(), value, expected })
        };
        if let Some(KeptAxis { axis, direction, tolerance_rad }) = self.axis {
            for (what, vector) in [("keep_axis", Some(axis)), ("keep_direction", direction)] {
                let has_none = |length: f64| !length.is_finite() || length < LEAST_DIRECTION;
                if let Some(vector) = vector.filter(|v| has_none(Vector::from(*v).length())) {
                    let expected = format!("finite numbers, and a length of more than {LEAST_DIRECTION}");
                    return malformed(what, format!("{vector:?}"), expected);
                }
            }
            if !(LEAST_TOLERANCE..=FRAC_PI_2).contains(&tolerance_rad) {
                let expected = format!("{LEAST_TOLERANCE} to {FRAC_PI_2:.3} rad");
                return malformed("keep_rad", tolerance_rad.to_string(), expected);
            }
        }
        self.inside.iter().try_for_each(|region| region.check("inside"))
    }

    /// The constraint on the frame of a link, for a frame that is at `start` at the beginning. Constraint and `start` are in the root's frame,
    /// which is at `base` in the world.
    pub fn constraint(&self, mechanism: &Mechanism, link: usize, base: &Pose, start: &Pose) -> Option<Constraint> {
        if *self == Keep::default() {
            return None;
        }
        let from_world = base.inverse();
        let mut target = Target { tolerance_m: [f64::INFINITY; 3], ..Target::upright(Pose::IDENTITY, f64::INFINITY) };
        let mut frame = Pose::IDENTITY;
        if let Some(KeptAxis { axis, direction, tolerance_rad }) = self.axis {
            let axis = unit(axis.into());
            let direction = direction.map_or_else(|| rotate(start, axis), |d| rotate(&from_world, unit(d.into())));
            frame = align(axis.to_array());
            target.pose = align(unit(direction).to_array());
            target.tolerance_rad = [tolerance_rad, tolerance_rad, PI];
        }
        if let Some(Region { pose, size }) = self.inside {
            target.bounds = Some(from_world.compose(&pose));
            target.tolerance_m = size.map(|edge| edge / 2.0);
        }
        Some(Constraint::new(Reach::new(mechanism, link, frame), target))
    }
}

/// The fastest trajectory along sections that satisfies a constraint everywhere; `None` where even the straight motions from posture to posture
/// violate it. Otherwise as [`timed_while`].
pub fn timed_keeping(
    joints: &[Joint],
    sections: &[Section],
    speed: impl Into<Speed>,
    constraint: &Constraint,
    is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool,
    goes_on: &mut dyn FnMut() -> bool,
) -> Option<Curve> {
    let speed: Speed = speed.into();
    let keeps = |curve: &Curve| {
        let room = &mut |positions: &JointVector| constraint.room(positions);
        first_breach(curve, constraint.levers(), room).is_none()
    };
    let curve = timed_while(joints, sections, speed.clone(), is_free, goes_on);
    if keeps(&curve) {
        return Some(curve);
    }
    // First through the postures themselves, then with a stop at each of them.
    let closely = |section: &Section| match section {
        Section::Blended(path) => Section::AsGiven(divided(path)),
        given => given.clone(),
    };
    let closer: Vec<Section> = sections.iter().map(closely).collect();
    let curve = timed_while(joints, &closer, speed.clone(), is_free, goes_on);
    if keeps(&curve) {
        return Some(curve);
    }
    let curve = timed_while(joints, sections, speed, &mut |_, _| false, goes_on);
    keeps(&curve).then_some(curve)
}

fn divided(path: &[JointVector]) -> Vec<JointVector> {
    let parts =
        path.windows(2).flat_map(|pair| (0..DIVIDED).map(|i| between(&pair[0], &pair[1], i as f64 / DIVIDED as f64)));
    parts.chain(path.last().copied()).collect()
}
