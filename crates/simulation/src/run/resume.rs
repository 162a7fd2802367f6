//! A run that is resumed: a new executive is told all that happened, says what the old one said, and goes on in its place.

use ratn_executive::executive::Executive;
use ratn_executive::protocol::{Command, LogEntry, LogLine};

/// The executive that stands where the log ends.
///
/// # Errors
/// Where it would have said something else than the log.
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
