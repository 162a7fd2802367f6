//! Providers in virtual time: each action takes its estimated duration and returns what the real one would, for a table
//! with a given number of boxes. No geometry: a trajectory is only its two ends.

use crate::run::{Answer, Oracle, Performance};
use ratn_executive::protocol::Goal;
use ratn_model::pose::Pose;
use ratn_model::program::SUCCESS;
use ratn_model::value::{Trajectory, TrajectoryPoint, Value};
use ratn_world::world::World;
use std::collections::BTreeMap;

/// Duration of an action whose state declares none, in seconds.
const UNDECLARED_S: f64 = 1.0;

/// The providers of the paper's scenarios.
pub struct TimedProviders {
    /// Number of boxes on the table.
    pub boxes: usize,
}

impl Oracle for TimedProviders {
    fn perform(&mut self, _path: &str, _attempt: u32, goal: &Goal, _world: &World) -> Performance {
        Performance {
            duration_s: goal.expected_s.unwrap_or(UNDECLARED_S),
            answer: Answer::Finished { outcome: SUCCESS.to_owned(), outputs: self.outputs(goal), measured: Vec::new() },
        }
    }
}

impl TimedProviders {
    pub(crate) fn outputs(&self, goal: &Goal) -> BTreeMap<String, Value> {
        let outputs = match (&*goal.provider, &*goal.action) {
            ("detector", "segment") => {
                vec![("boxes", Value::List((0..self.boxes).map(box_on_table).collect()))]
            }
            ("detector", "locate") => {
                let object = goal.inputs.get("object");
                let field = |name: &str| object.and_then(|o| o.field(name)).cloned();
                vec![
                    ("pose", field("pose").unwrap_or(Value::Pose(Pose::IDENTITY))),
                    ("size", field("size").unwrap_or_else(|| Value::List(vec![Value::Float(0.08); 3].into()))),
                    ("class", Value::String("Box".to_owned())),
                    ("confidence", Value::Float(1.0)),
                    ("covariance", Value::List(vec![Value::Float(0.0); 36].into())),
                ]
            }
            ("path_planner", "plan") => plan(goal),
            ("arm", "follow") => followed(Value::Joints(end_of(goal.inputs.get("trajectory")))),
            ("arm", "move_to") => followed(goal.inputs.get("joints").cloned().unwrap_or(Value::Joints(vec![0.0; 7]))),
            ("pan_tilt", "look_at") => vec![("pan", Value::Float(0.0)), ("tilt", Value::Float(0.5))],
            ("gripper", "grasp") => vec![("width_m", Value::Float(0.08))],
            _ => Vec::new(),
        };
        outputs.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }
}

fn box_on_table(index: usize) -> Value {
    Value::map([
        ("id", Value::String(format!("box_{}", index + 1))),
        ("pose", Value::Pose(Pose::at(0.75, -0.4 + 0.1 * index as f64, 0.75))),
        ("size", Value::List(vec![Value::Float(0.08), Value::Float(0.12), Value::Float(0.1)].into())),
        ("class", Value::String("Box".to_owned())),
        ("confidence", Value::Float(1.0)),
        ("covariance", Value::List(vec![Value::Float(0.0); 36].into())),
    ])
}

fn plan(goal: &Goal) -> Vec<(&'static str, Value)> {
    let start = match goal.inputs.get("start") {
        Some(Value::Joints(start)) => start.clone(),
        _ => vec![0.0; 7],
    };
    let first = |value: &Value| match value {
        Value::List(alternatives) => alternatives.first().cloned().unwrap_or(Value::Null),
        other => other.clone(),
    };
    let (end, end_pose) = match goal.inputs.get("goal").map(first) {
        Some(Value::Joints(end)) => (end, Pose::IDENTITY),
        Some(Value::Pose(pose)) => (pose.position.iter().copied().chain([0.0; 4]).collect(), pose),
        _ => (start.clone(), Pose::IDENTITY),
    };
    let point = |time_s: f64, positions: &[f64]| TrajectoryPoint {
        time_s,
        positions: positions.to_vec(),
        velocities: vec![0.0; positions.len()],
    };
    let trajectory = Trajectory {
        joints: (1..=start.len()).map(|joint| format!("arm_{joint}")).collect(),
        points: vec![point(0.0, &start), point(1.0, &end)],
    };
    vec![
        ("trajectory", Value::Trajectory(trajectory)),
        ("end", Value::Joints(end)),
        ("end_pose", Value::Pose(end_pose)),
        ("first_path_s", Value::Float(0.1)),
        ("first_length_rad", Value::Float(1.0)),
        ("length_rad", Value::Float(1.0)),
        ("planning_s", Value::Float(goal.expected_s.unwrap_or(UNDECLARED_S))),
        ("iterations", Value::Int(1)),
    ]
}

/// The outputs of a motion that followed its trajectory exactly.
fn followed(end: Value) -> Vec<(&'static str, Value)> {
    vec![("end", end), ("tracking_max_rad", Value::Float(0.0)), ("tracking_rms_rad", Value::Float(0.0))]
}

fn end_of(trajectory: Option<&Value>) -> Vec<f64> {
    match trajectory {
        Some(Value::Trajectory(trajectory)) => {
            trajectory.points.last().map(|p| p.positions.clone()).unwrap_or_default()
        }
        _ => Vec::new(),
    }
}
