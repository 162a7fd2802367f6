//! Replays a run from its log: the same events must give the same commands, because resuming after a crash depends on that.

use ratn_executive::executive::Executive;
use ratn_executive::protocol::LogEntry;
use ratn_model::program::Program;
use ratn_model::tolerance::Tolerance;
use ratn_simulation::run::Run;
use std::sync::Arc;

/// The first command in which a new executive differs from the log.
pub(super) fn replayed(program: &Arc<Program>, run: &Run) -> Option<String> {
    let mut executive = Executive::new(program.clone(), Tolerance::EXACT);
    let mut again = Vec::new().into_iter();
    let mut last = None;
    for line in &run.log {
        match &line.entry {
            LogEntry::Event(event) => {
                if let Some(more) = again.next() {
                    return Some(format!("replayed, {last:?} gives {more:?} besides"));
                }
                again = executive.handle(line.at, event.clone()).into_iter();
                last = Some(event);
            }
            LogEntry::Command(command) => {
                let other = again.next();
                if other.as_ref() != Some(command) {
                    return Some(format!("replayed, {last:?} gives {other:?}, not {command:?}"));
                }
            }
        }
    }
    again.next().map(|more| format!("replayed, {last:?} gives {more:?} besides"))
}
