//! The straight part at the start.

use super::arm_in_scene::{ArmInScene, PADDINGS_M};
use super::error::PlanError;
use super::retreat::retreat;
use crate::collision::{CONTACT_TOLERANCE_M, Contact};
use crate::joint_vector::JointVector;
use crate::pace::Pace;

/// The postures of the departure, only the start if none was requested; the last one is free. Planned with the greatest padding that the start
/// allows. If the gripper is inside an object at the start and cannot depart as requested, it retreats.
pub(super) fn departure(arm: &mut ArmInScene<'_>, pace: &mut Pace<'_>) -> Result<Vec<JointVector>, PlanError> {
    match with_paddings(arm, pace, padded_departure)? {
        Ok(postures) => Ok(postures),
        Err(refused) if starts_as_departures_may(arm) => Err(refused),
        Err(refused) => match with_paddings(arm, pace, retreat)? {
            Ok(Some(postures)) => Ok(postures),
            Ok(None) => Err(refused),
            Err(no_retreat) => Err(no_retreat),
        },
    }
}

/// Whether a departure was asked for and the gripper is no deeper in anything than departures may be. Then what refuses it is farther along
/// its way, and another way might carry along what stands on the held object, or drag that over its support.
fn starts_as_departures_may(arm: &mut ArmInScene<'_>) -> bool {
    let start = arm.request().start.arm;
    arm.pad(0.0);
    arm.request().depart.is_some() && arm.collision(&start, Contact::Gripper(CONTACT_TOLERANCE_M)).is_none()
}

/// The result with the greatest padding that allows one, or the error with the smallest padding.
fn with_paddings<'a, T>(
    arm: &mut ArmInScene<'a>,
    pace: &mut Pace<'_>,
    mut find: impl FnMut(&mut ArmInScene<'a>, &mut Pace<'_>) -> Result<T, PlanError>,
) -> Result<Result<T, PlanError>, PlanError> {
    let mut refused = None;
    for padding_m in PADDINGS_M {
        arm.pad(padding_m);
        match find(arm, pace) {
            Ok(found) => return Ok(Ok(found)),
            Err(error @ (PlanError::Cancelled | PlanError::TimeUp)) => return Err(error),
            Err(error) => refused = Some(error),
        }
    }
    Ok(Err(refused.expect("there is a padding")))
}

fn padded_departure(arm: &mut ArmInScene<'_>, pace: &mut Pace<'_>) -> Result<Vec<JointVector>, PlanError> {
    let (start, part) = (arm.request().start.arm, &arm.request().depart);
    if !part.is_some() {
        return match arm.collision(&start, Contact::None) {
            None => Ok(vec![start]),
            Some(collision) => Err(PlanError::StartInCollision { collision }),
        };
    }
    let failed = |reason: String| PlanError::Depart { part: part.to_string(), reason };
    let postures = arm.leave(&start, part, CONTACT_TOLERANCE_M, pace)?.map_err(failed)?;
    match arm.collision(&postures[postures.len() - 1], Contact::None) {
        Some(collision) => Err(failed(format!("at its end {collision}"))),
        None => Ok(postures),
    }
}
