//! Joint positions as commanded: at the points of a trajectory, linear between two of them.

use crate::wire::foxglove::JointState;
use ratn_executive::protocol::LogLine;
use ratn_model::id::InstanceId;
use ratn_report::motions::{Change, Motions, Way, place};
use std::collections::BTreeMap;

/// Minimum time between two messages; a planner's points may be closer.
const PERIOD_S: f64 = 0.02;

/// The motions under way.
#[derive(Debug, Default)]
pub(super) struct Joints {
    motions: Motions,
    /// For each motion along a trajectory, the time of the next message.
    next_s: BTreeMap<InstanceId, f64>,
    due: Vec<(f64, Vec<JointState>)>,
}

impl Joints {
    /// Applies a line.
    pub(super) fn follow(&mut self, line: &LogLine) {
        match self.motions.follow(line) {
            Some(Change::Begins(instance, motion)) => {
                self.next_s.insert(instance, motion.from_s);
            }
            Some(Change::Ends(instance, motion, end)) => {
                self.next_s.remove(&instance);
                // Joint names come from the trajectory.
                if let (Way::Along(trajectory), Some(positions)) = (&motion.way, end)
                    && trajectory.joints.len() == positions.len()
                {
                    self.due.push((line.at.seconds(), states(&trajectory.joints, positions, &[])));
                }
            }
            // Without a trajectory there are no joint names.
            Some(Change::Stands { .. } | Change::Looks { .. } | Change::Fingers { .. }) | None => {}
        }
    }

    /// Every position up to `at_s` that was not returned yet, in order.
    pub(super) fn until(&mut self, at_s: f64) -> Vec<(f64, Vec<JointState>)> {
        let mut all = std::mem::take(&mut self.due);
        for (instance, motion) in self.motions.under_way() {
            let (Way::Along(trajectory), Some(next_s)) = (&motion.way, self.next_s.get_mut(&instance)) else {
                continue;
            };
            let end_s = motion.from_s + trajectory.duration_s();
            while *next_s <= at_s.min(end_s) {
                let (positions, velocities) = place(trajectory, *next_s - motion.from_s);
                all.push((*next_s, states(&trajectory.joints, &positions, &velocities)));
                *next_s += PERIOD_S;
            }
        }
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all
    }
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
