//! The constraints of a motion, from the inputs of a goal: `keep_axis`, `keep_direction`, `keep_rad` and `inside` (constraints of the
//! tool); `velocity_scale`, `acceleration_scale`, `jerk_scale` (fractions of the joints' limits: a number for all, or one per joint);
//! `tool_speed_m_s`, `tool_turning_rad_s`; `keep_out` (boxes that no moving part may enter, though they are empty).

use ratn_model::value::Value;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::keep::{Keep, KeptAxis, Region};
use ratn_motion::tool_speed::ToolSpeed;
use ratn_worker::action::{ActionFailure, GoalContext, Port};

/// The constraint that the tool keeps.
pub(super) fn keep(goal: &GoalContext) -> Result<Keep, ActionFailure> {
    let vector = |name: &str| goal.port(name).optional().map(|port| port.vector3()).transpose();
    let (axis, direction, tolerance) =
        (vector("keep_axis")?, vector("keep_direction")?, goal.optional_float("keep_rad")?);
    let axis = match (axis, tolerance) {
        (Some(axis), Some(tolerance_rad)) => Some(KeptAxis { axis, direction, tolerance_rad }),
        (None, None) if direction.is_none() => None,
        _ => {
            return Err(ActionFailure::aborted(
                "of the inputs `keep_axis`, `keep_direction` and `keep_rad` some are missing: say which axis of the tool stays how near its direction",
            ));
        }
    };
    let inside = goal.port("inside").optional().as_ref().map(region).transpose()?;
    Ok(Keep { axis, inside })
}

/// The boxes `{pose, size}` of `keep_out`.
pub(super) fn kept_out(goal: &GoalContext) -> Result<Vec<Region>, ActionFailure> {
    let Some(port) = goal.port("keep_out").optional() else { return Ok(Vec::new()) };
    port.list()?.iter().map(region).collect()
}

fn region(port: &Port<'_>) -> Result<Region, ActionFailure> {
    Ok(Region { pose: port.field("pose").pose()?, size: port.field("size").vector3()? })
}

/// Fractions of the limits of velocity, acceleration and jerk, for this number of joints.
pub(super) fn scales(goal: &GoalContext, joints: usize) -> Result<[JointVector; 3], ActionFailure> {
    let scale = |name| scale(goal, name, joints);
    Ok([scale("velocity_scale")?, scale("acceleration_scale")?, scale("jerk_scale")?])
}

fn scale(goal: &GoalContext, name: &str, joints: usize) -> Result<JointVector, ActionFailure> {
    let Some(port) = goal.port(name).optional() else { return Ok(JointVector::all(joints, 1.0)) };
    if let Some(all) = port.any()?.as_number() {
        return Ok(JointVector::all(joints, all));
    }
    let wrong = |found: String| {
        ActionFailure::aborted(format!("input `{name}` {found}: expected a number, or one for each of {joints} joints"))
    };
    let Value::List(values) = port.any()? else { return Err(wrong(format!("is a {}", port.any()?.type_name()))) };
    let numbers: Option<Vec<f64>> = values.iter().map(Value::as_number).collect();
    let numbers = numbers.ok_or_else(|| wrong("has an element that is no number".to_owned()))?;
    let count = numbers.len();
    let vector = JointVector::read(&numbers).ok().filter(|vector| vector.len() == joints);
    vector.ok_or_else(|| wrong(format!("has {count} numbers")))
}

/// The limits of the tool's speed.
pub(super) fn tool_speed(goal: &GoalContext) -> Result<ToolSpeed, ActionFailure> {
    let m_per_s = goal.optional_float("tool_speed_m_s")?;
    Ok(ToolSpeed { m_per_s, rad_per_s: goal.optional_float("tool_turning_rad_s")? })
}
