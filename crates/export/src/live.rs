//! The spans of a run while it goes on: those of its log's export, each as soon as its instance has left the window.
//!
//! They are laid on wall time, as those of the daemons are that the run calls: a second of a robot that goes `speed` times as fast is
//! so much shorter.

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
    /// Of a run whose first moment was then, on a robot that goes `speed` times as fast.
    pub fn new(from_unix_ns: u64, speed: f64) -> Live {
        Live { run: Timeline::following(KEPT), from_unix_ns, speed }
    }

    /// What has ended by an event, and by what was decided then.
    pub fn follow(&mut self, at: Timestamp, event: &Event, commands: &[Command]) -> Vec<Span> {
        let event = LogEntry::Event(event.clone());
        let entries = std::iter::once(event).chain(commands.iter().cloned().map(LogEntry::Command));
        let mut spans = Vec::new();
        for entry in entries {
            spans.extend(self.line(&LogLine { at, entry }));
        }
        spans
    }

    /// What has ended by a line of the run's log.
    pub fn line(&mut self, line: &LogLine) -> Vec<Span> {
        let changed = self.run.apply(line);
        let mut spans = Vec::new();
        self.add(&changed.left, &mut spans);
        spans
    }

    /// What was still there at the end, and the run itself.
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
