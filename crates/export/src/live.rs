//! The spans of a running run: the same as in its log's export, each as soon as its instance has left the window.
//!
//! Times are wall time, as in the spans of the daemons that the run calls: at a speed of `speed`, a second of robot time lasts 1/`speed` s.

use super::otlp::{about, root, spans_of};
use super::{KEPT, otlp};
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::time::Timestamp;
use ratn_otlp::Span;
use ratn_report::timeline::{Instance, Timeline};

/// A run that is followed.
#[derive(Debug)]
pub struct Live {
    run: Timeline,
    from_unix_ns: u64,
    speed: f64,
}

impl Live {
    /// Follows a run that began at this wall time, with a robot that is `speed` times as fast.
    pub fn new(from_unix_ns: u64, speed: f64) -> Live {
        Live { run: Timeline::following(KEPT), from_unix_ns, speed }
    }

    /// The spans that are complete after an event and the commands decided on it.
    pub fn follow(&mut self, at: Timestamp, event: &Event, commands: &[Command]) -> Vec<Span> {
        let event = LogEntry::Event(event.clone());
        let entries = std::iter::once(event).chain(commands.iter().cloned().map(LogEntry::Command));
        let mut spans = Vec::new();
        for entry in entries {
            spans.extend(self.line(&LogLine { at, entry }));
        }
        spans
    }

    /// The spans that are complete after a line of the run's log.
    pub fn line(&mut self, line: &LogLine) -> Vec<Span> {
        let changed = self.run.apply(line);
        let mut spans = Vec::new();
        self.add(&changed.left, &mut spans);
        spans
    }

    /// The spans of what was still open at the end, and of the run itself.
    pub fn end(&mut self) -> Vec<Span> {
        let changed = self.run.close();
        let mut spans = Vec::new();
        self.add(&changed.left, &mut spans);
        let (from_unix_ns, speed) = (self.from_unix_ns, self.speed);
        let mut whole = root(&self.run, &|at_s| laid(from_unix_ns, speed, at_s));
        whole.attributes.extend(about(&self.run));
        spans.push(whole);
        spans
    }

    fn add(&self, left: &[Instance], spans: &mut Vec<Span>) {
        let (from_unix_ns, speed) = (self.from_unix_ns, self.speed);
        let laid: otlp::Laid<'_> = &|at_s| laid(from_unix_ns, speed, at_s);
        left.iter().for_each(|instance| spans_of(&self.run, laid, instance, spans));
    }
}

fn laid(from_unix_ns: u64, speed: f64, at_s: f64) -> u64 {
    from_unix_ns.saturating_add((at_s.max(0.0) / speed * 1e9).round() as u64)
}
