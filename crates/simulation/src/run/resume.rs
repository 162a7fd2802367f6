//! Resumes a run: a new executive handles all events of the log, must give the logged commands, and replaces the old
//! executive.

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, LogEntry, LogLine};

/// The executive in the state at the end of the log.
///
/// # Errors
/// The executive gave another command than the log has.
pub(super) fn resumed(mut fresh: Executive, log: &[LogLine]) -> Result<Executive, String> {
    let mut said: Vec<Command> = Vec::new();
    for line in log {
        match &line.entry {
            LogEntry::Event(event) => {
                if let Some(more) = said.first() {
                    return Err(format!("resumed, it says {more:?} at {}, which it had not said", line.at.seconds()));
                }
                said = fresh.handle(line.at, event.clone());
                said.reverse();
            }
            LogEntry::Command(command) => {
                let again = said.pop();
                if again.as_ref() != Some(command) {
                    return Err(format!("resumed, it says {again:?} instead of {command:?}"));
                }
            }
        }
    }
    match said.first() {
        Some(more) => Err(format!("resumed, it says {more:?}, which it had not said")),
        None => Ok(fresh),
    }
}
