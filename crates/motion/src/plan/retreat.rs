//! A start in contact: the straight way out of it.
//!
//! `leaving` decides which contacts are allowed on the way. Three ways are tried: the whole departure that was requested; back along the tool's
//! axis; and the shortest way out of the deepest contact. The last two end at the first free posture.

use super::arm_in_scene::{ArmInScene, Extent};
use super::error::PlanError;
use crate::joint_vector::JointVector;
use crate::leaving::Leaving;
use crate::pace::Pace;
use crate::straight::{Frame, MAX_STRAIGHT_M, Straight};

/// The postures of a retreat; `None` if the gripper touches nothing at the start.
///
/// # Errors
/// Why no way out can be followed.
pub(super) fn retreat(arm: &mut ArmInScene<'_>, pace: &mut Pace<'_>) -> Result<Option<Vec<JointVector>>, PlanError> {
    let start = arm.request().start.arm;
    let Some(leaving) = arm.leaving(&start) else { return Ok(None) };
    let mut reasons = Vec::new();
    for (name, part, extent) in ways(arm, &leaving) {
        match arm.retreat(&start, &leaving, &part, extent, pace)? {
            Ok(postures) => return Ok(Some(postures)),
            Err(reason) => reasons.push(format!("{name} {reason}")),
        }
    }
    Err(PlanError::NoRetreat { collision: leaving.told(), reasons })
}

/// The ways that are tried, the requested one first, each with its name in messages.
fn ways(arm: &ArmInScene<'_>, leaving: &Leaving) -> Vec<(String, Straight, Extent)> {
    let asked = &arm.request().depart;
    let asked = asked.is_some().then(|| (format!("{asked}"), asked.clone(), Extent::Whole));
    let far = |direction, frame| Straight { direction, frame, length_m: MAX_STRAIGHT_M };
    // Along the tool a held object may slide over what it stands on.
    let back = (!leaving.is_of_held())
        .then(|| ("back along the tool".to_owned(), far([0.0, 0.0, -1.0], Frame::Tool), Extent::UntilFree));
    let out = leaving.shortest_way_out();
    let out = out.map(|way| ("the shortest way out".to_owned(), far(way, Frame::World), Extent::UntilFree));
    asked.into_iter().chain(back).chain(out).collect()
}
