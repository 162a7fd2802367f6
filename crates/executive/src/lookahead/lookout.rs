//! When to look ahead anew: after a good part of what was planned has changed.

use crate::protocol::{Command, Note};

/// It is looked ahead again when as many instances have appeared, ended or gone as this part of those planned.
const PART: usize = 4;

/// Counts what changes in a window since it was looked ahead.
#[derive(Debug, Clone, Default)]
pub struct Lookout {
    planned: usize,
    changes: usize,
}

impl Lookout {
    /// Takes note of what the executive commands.
    pub fn observe(&mut self, commands: &[Command]) {
        let is_change = |command: &&Command| {
            matches!(
                command,
                Command::Note(
                    Note::Expanded { .. }
                        | Note::Decided { .. }
                        | Note::Finished { .. }
                        | Note::Invalidated { .. }
                        | Note::Squashed { .. }
                )
            )
        };
        self.changes += commands.iter().filter(is_change).count();
    }

    /// Whether it is worth looking ahead now.
    pub fn is_due(&self) -> bool {
        self.changes > 0 && self.changes * PART >= self.planned
    }

    /// It is being looked ahead, for so many tasks.
    pub fn looks(&mut self, tasks: usize) {
        self.planned = tasks;
        self.changes = 0;
    }
}
