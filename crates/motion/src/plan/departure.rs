//! The straight part at the start.

use super::arm_in_scene::{ArmInScene, PADDINGS_M};
use super::contact::half_finger_m;
use super::error::PlanError;
use crate::collision::{CONTACT_TOLERANCE_M, Contact};
use crate::joint_vector::JointVector;
use crate::pace::Pace;

/// Its postures, one where there is no such part; the last of them is free. With as much padding as the start has.
pub(super) fn departure(arm: &mut ArmInScene<'_>, pace: &mut Pace<'_>) -> Result<Vec<JointVector>, PlanError> {
    let mut refused = None;
    for padding_m in PADDINGS_M {
        arm.pad(padding_m);
        match padded_departure(arm, pace) {
            Ok(postures) => return Ok(postures),
            Err(error @ (PlanError::Cancelled | PlanError::TimeUp)) => return Err(error),
            Err(error) => refused = Some(error),
        }
    }
    Err(refused.expect("there is a padding"))
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
    // It is looked at with the most that may be pressed: as on an approach, or what is pressed already.
    let usual_m = half_finger_m(arm.robot());
    let is_deep = arm.collision(&start, Contact::Gripper(usual_m)).is_some();
    let press_m = if is_deep { CONTACT_TOLERANCE_M } else { usual_m };
    let postures = arm.leave(&start, part, press_m, pace)?.map_err(failed)?;
    match arm.collision(&postures[postures.len() - 1], Contact::None) {
        Some(collision) => Err(failed(format!("at its end {collision}"))),
        None => Ok(postures),
    }
}
