//! Where the joints are, from what was commanded: along a trajectory at its own points, straight between two of them.

use crate::wire::foxglove::JointState;
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::id::InstanceId;
use ratn_model::value::{Trajectory, Value};
use std::collections::BTreeMap;

/// How far apart two messages are at the least; a planner's points may be closer.
const PERIOD_S: f64 = 0.02;
/// The port in which a driver says where its joints ended.
const END: &str = "end";

/// The motions under way.
#[derive(Debug, Default)]
pub(super) struct Joints {
    motions: BTreeMap<InstanceId, Motion>,
    /// Names, of what was last given a trajectory with as many joints.
    names: BTreeMap<usize, Vec<String>>,
    due: Vec<(f64, Vec<JointState>)>,
}

#[derive(Debug)]
struct Motion {
    from_s: f64,
    next_s: f64,
    trajectory: Trajectory,
}

impl Joints {
    /// What a line says of motions.
    pub(super) fn follow(&mut self, line: &LogLine) {
        let at_s = line.at.seconds();
        match &line.entry {
            LogEntry::Command(Command::Start { instance, goal, .. }) => {
                let trajectory = goal.inputs.values().find_map(|value| match value {
                    Value::Trajectory(trajectory) if goal.projection.is_none() => Some(trajectory.clone()),
                    _ => None,
                });
                if let Some(trajectory) = trajectory.filter(|one| !one.points.is_empty()) {
                    self.names.insert(trajectory.joints.len(), trajectory.joints.clone());
                    self.motions.insert(*instance, Motion { from_s: at_s, next_s: at_s, trajectory });
                }
            }
            LogEntry::Event(Event::Finished { instance, outputs, .. }) => {
                let moved = self.motions.remove(instance).is_some();
                // What plans says where it would end, too.
                let positions = match outputs.get(END) {
                    Some(Value::Joints(positions)) if moved => positions,
                    _ => return,
                };
                if let Some(names) = self.names.get(&positions.len()) {
                    self.due.push((at_s, states(names, positions, &[])));
                }
            }
            LogEntry::Event(Event::Crashed { instance, .. }) | LogEntry::Command(Command::Cancel { instance, .. }) => {
                self.motions.remove(instance);
            }
            _ => {}
        }
    }

    /// Every position up to a moment that was not told yet, in order.
    pub(super) fn until(&mut self, at_s: f64) -> Vec<(f64, Vec<JointState>)> {
        let mut all = std::mem::take(&mut self.due);
        for motion in self.motions.values_mut() {
            let end_s = motion.from_s + motion.trajectory.duration_s();
            while motion.next_s <= at_s.min(end_s) {
                let (positions, velocities) = place(&motion.trajectory, motion.next_s - motion.from_s);
                all.push((motion.next_s, states(&motion.trajectory.joints, &positions, &velocities)));
                motion.next_s += PERIOD_S;
            }
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all
    }
}

/// Positions and velocities after so many seconds.
fn place(trajectory: &Trajectory, after_s: f64) -> (Vec<f64>, Vec<f64>) {
    let next = trajectory.points.partition_point(|point| point.time_s <= after_s);
    let Some(before) = trajectory.points.get(next.saturating_sub(1)) else { return Default::default() };
    let Some(behind) = trajectory.points.get(next) else {
        return (before.positions.clone(), before.velocities.clone());
    };
    let share = ((after_s - before.time_s) / (behind.time_s - before.time_s)).clamp(0.0, 1.0);
    let between = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect();
    (between(&before.positions, &behind.positions), between(&before.velocities, &behind.velocities))
}

fn states(names: &[String], positions: &[f64], velocities: &[f64]) -> Vec<JointState> {
    let one = |(i, (name, position)): (usize, (&String, &f64))| JointState {
        name: name.clone(),
        position: Some(*position),
        velocity: velocities.get(i).copied(),
        acceleration: None,
        effort: None,
    };
    names.iter().zip(positions).enumerate().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::value::TrajectoryPoint;

    #[test]
    fn between_two_points_of_a_trajectory_the_way_is_straight() {
        let point = |time_s, at: f64| TrajectoryPoint { time_s, positions: vec![at], velocities: vec![0.5] };
        let trajectory = Trajectory { joints: vec!["j".to_owned()], points: vec![point(0.0, 1.0), point(2.0, 3.0)] };
        assert_eq!(place(&trajectory, 0.5), (vec![1.5], vec![0.5]));
        assert_eq!(place(&trajectory, 9.0).0, [3.0]);
    }
}
