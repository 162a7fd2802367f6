//! When to look ahead again: after a good part of the plan has changed, or when a duration differed from its estimate.

use crate::protocol::{Command, Note};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;

/// Look-ahead is due again when the instances that appeared, ended or left reach this part (1/4) of the planned ones.
const PART: usize = 4;
/// A duration that differs from its estimate by less than this share is no surprise.
const SURPRISE: f64 = 0.02;

/// Counts the changes of a window since the last look-ahead.
#[derive(Debug, Clone, Default)]
pub struct Lookout {
    planned: usize,
    changes: usize,
    /// Goals under way: since when, and how long they were estimated to take, in seconds.
    under_way: BTreeMap<InstanceId, (Timestamp, f64)>,
    is_surprised: bool,
}

impl Lookout {
    /// Counts the commands of the executive.
    pub fn observe(&mut self, now: Timestamp, commands: &[Command]) {
        for command in commands {
            match command {
                Command::Start { instance, goal, .. } => {
                    if let Some(expected_s) = goal.expected_s {
                        self.under_way.insert(*instance, (now, expected_s));
                    }
                }
                Command::Cancel { instance, .. } => drop(self.under_way.remove(instance)),
                Command::Note(Note::Finished { instance, .. }) => {
                    self.changes += 1;
                    if let Some((since, expected_s)) = self.under_way.remove(instance) {
                        let took_s = now.since(since).as_secs_f64();
                        self.is_surprised |= (took_s - expected_s).abs() > SURPRISE * expected_s;
                    }
                }
                Command::Note(
                    Note::Expanded { .. } | Note::Decided { .. } | Note::Invalidated { .. } | Note::Squashed { .. },
                ) => self.changes += 1,
                _ => {}
            }
        }
    }

    /// Whether so much has changed that a full look-ahead is worthwhile.
    pub fn is_due(&self) -> bool {
        self.changes > 0 && self.changes * PART >= self.planned
    }

    /// Whether a goal ended earlier or later than planned: worth a short look-ahead.
    pub fn is_surprised(&self) -> bool {
        self.is_surprised
    }

    /// A full look-ahead begins, for so many tasks.
    pub fn looks(&mut self, tasks: usize) {
        self.planned = tasks;
        self.changes = 0;
        self.is_surprised = false;
    }

    /// A short look-ahead begins.
    pub fn glances(&mut self) {
        self.is_surprised = false;
    }
}
