//! When to look ahead anew: after a good part of what was planned has changed, or something took another time than was planned with.

use crate::protocol::{Command, Note};
use ratn_model::id::InstanceId;
use ratn_model::time::Timestamp;
use std::collections::BTreeMap;

/// It is looked ahead again when as many instances have appeared, ended or gone as this part of those planned.
const PART: usize = 4;
/// What differs from its estimate by less than this share of it is no surprise.
const SURPRISE: f64 = 0.02;

/// Counts what changes in a window since it was looked ahead.
#[derive(Debug, Clone, Default)]
pub struct Lookout {
    planned: usize,
    changes: usize,
    /// Goals under way: since when, and how long they were estimated to take, in seconds.
    under_way: BTreeMap<InstanceId, (Timestamp, f64)>,
    is_surprised: bool,
}

impl Lookout {
    /// Takes note of what the executive commands.
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

    /// Whether so much has changed that it is worth looking ahead as if for the first time.
    pub fn is_due(&self) -> bool {
        self.changes > 0 && self.changes * PART >= self.planned
    }

    /// Whether something ended earlier or later than it was planned with: worth a short look.
    pub fn is_surprised(&self) -> bool {
        self.is_surprised
    }

    /// It is being looked ahead, for so many tasks.
    pub fn looks(&mut self, tasks: usize) {
        self.planned = tasks;
        self.changes = 0;
        self.is_surprised = false;
    }

    /// It is being looked ahead shortly.
    pub fn glances(&mut self) {
        self.is_surprised = false;
    }
}
