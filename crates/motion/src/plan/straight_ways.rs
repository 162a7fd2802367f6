//! Motions whose tool moves in straight lines all the way: timed with rounded corners, then with a stop at each corner; the quicker one is taken.

use super::Plan;
use super::arm_in_scene::ArmInScene;
use super::error::PlanError;
use crate::collision::length;
use crate::joint_vector::JointVector;
use crate::pace::{Control, Pace, Progress, Stop};
use crate::timing::Section;
use crate::way_points::WayPoints;

/// Plans the motion after a departure.
pub(super) fn plan_straight(
    arm: &mut ArmInScene<'_>,
    way: &WayPoints,
    depart: &[JointVector],
    pace: &mut Pace<'_>,
) -> Result<Plan, PlanError> {
    let start = depart[depart.len() - 1];
    let mut leaving = arm.with_open_fingers();
    let mut best: Option<Plan> = None;
    let mut failed = None;
    // With jerk limits, a corner rounded with a small radius may take longer than a stop.
    let blends = [way.blend_m, 0.0];
    for blend_m in blends.into_iter().take(if way.blend_m > 0.0 { 2 } else { 1 }) {
        let way = WayPoints { blend_m, ..way.clone() };
        let followed = match arm.follow(&start, &way, leaving.as_mut(), pace) {
            Ok(followed) => followed,
            Err(error @ PlanError::NoStraightWay { .. }) => {
                failed = failed.or(Some(error));
                continue;
            }
            Err(PlanError::TimeUp) if best.is_some() => {
                best = best.map(|plan| Plan { time_up: true, ..plan });
                break;
            }
            Err(error) => return Err(error),
        };
        let length_rad = length(depart) + followed.length_rad();
        if best.is_none() && pace.report(Progress::FirstPath { length_rad }) == Err(Stop::Cancelled) {
            return Err(PlanError::Cancelled);
        }
        let end = followed.approach[followed.approach.len() - 1];
        let sections = [depart.to_vec(), followed.lines, followed.approach].map(Section::AsGiven);
        let curve = arm.timed(&sections, &mut || pace.answer() != Control::Cancelled)?;
        if pace.answer() == Control::Cancelled {
            return Err(PlanError::Cancelled);
        }
        if best.as_ref().is_none_or(|best| curve.duration_s() < best.trajectory.duration_s()) {
            best = Some(Plan {
                trajectory: curve.named(arm.robot().arm_joints()),
                first_duration_s: curve.duration_s(),
                end,
                end_pose: arm.tool_pose(&end),
                first_length_rad: length_rad,
                length_rad,
                iterations: 0,
                time_up: false,
            });
        }
    }
    best.ok_or_else(|| failed.unwrap_or_else(|| PlanError::no_straight_way(Vec::new())))
}
