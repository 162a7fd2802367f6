//! The spans that a run sends while it is under way, if its process has a sender ([`ratn_otlp::start`]).
//!
//! ```text
//!   begins ─────────────────────────────────────────▶ Following ──▶ end: what is left, and the run's own span
//!   goes on ──▶ CatchingUp: a thread reads the log; ──▶ Following
//!               what happens meanwhile is kept
//! ```
//! A resumed run does not wait until its log has been read: its checkpoint made that unnecessary.

use super::messages::Messages;
use ratn_event_log::{Lines, LogError};
use ratn_executive::protocol::{Command, Event};
use ratn_export::live::Live;
use ratn_model::time::Timestamp;
use ratn_otlp::{END_OF_RUN, Sender, Span, ids};
use ratn_worker::trace::TraceContext;
use std::path::PathBuf;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::sync::oneshot::{self, error::TryRecvError};
use tokio::time::Instant;

/// Maximum number of events that are kept while the log is read. If more happen, the run sends no further spans.
const MOST_KEPT: usize = 16_384;
/// Spans that a killed process recorded in its last moments may not have been sent: they are sent again. A collector that has received them gets the
/// same ids twice.
const SENT_AGAIN: Duration = Duration::from_secs(3);

/// The reading thread has ended without a result.
const UNREAD: &str = "its log is not read";

/// The trace context of a run, which is the same in an export of its log.
pub(super) fn trace_of(run: &str, task: &str, seed: u64, began_unix_ms: u64) -> TraceContext {
    TraceContext::of(ids::trace(run, task, seed, began_unix_ms), ids::ROOT)
}

/// The spans of a run.
#[derive(Debug)]
pub(super) struct Spans {
    sender: &'static Sender,
    stage: Stage,
}

#[derive(Debug)]
enum Stage {
    Following(Box<Live>),
    CatchingUp {
        read: oneshot::Receiver<Result<CaughtUp, LogError>>,
        kept: Vec<Step>,
        messages: Messages,
    },
    /// The earlier part of the run is unknown.
    GivenUp,
}

/// An event of the executive, and the commands that it gave.
type Step = (Timestamp, Event, Vec<Command>);

/// The result of reading a log.
#[derive(Debug)]
struct CaughtUp {
    live: Box<Live>,
    /// Spans that may not have been sent.
    again: Vec<Span>,
}

/// The log of a resumed run, up to the resumption.
#[derive(Debug)]
pub(super) struct Before {
    /// Path of the log.
    pub(super) log: PathBuf,
    /// Length of the log before the resumption, in bytes.
    pub(super) bytes: u64,
    /// The time of the last event in it.
    pub(super) last: Timestamp,
}

impl Spans {
    /// For a run that begins now; `None` if the process has no sender.
    pub(super) fn of_a_run_that_begins(speed: f64) -> Option<Spans> {
        let sender = ratn_otlp::sender()?;
        Some(Spans { sender, stage: Stage::Following(Box::new(Live::new(unix_ns(), speed))) })
    }

    /// For a resumed run, whose clock shows `now`.
    pub(super) fn of_a_run_that_goes_on(
        before: Before,
        now: Timestamp,
        speed: f64,
        messages: &Messages,
    ) -> Option<Spans> {
        let sender = ratn_otlp::sender()?;
        let since_ns = (now.seconds() / speed * 1e9).round() as u64;
        let live = Box::new(Live::new(unix_ns().saturating_sub(since_ns), speed));
        let (told, read) = oneshot::channel();
        let reading = move || {
            // The receiver may have been dropped.
            let _ = told.send(caught_up(live, &before, speed));
        };
        // If the thread cannot be started, the sender is dropped, and the spans are given up.
        let _ = std::thread::Builder::new().name("spans".to_owned()).spawn(reading);
        Some(Spans { sender, stage: Stage::CatchingUp { read, kept: Vec::new(), messages: messages.clone() } })
    }

    pub(super) fn follow(&mut self, at: Timestamp, event: &Event, commands: &[Command]) {
        if let Stage::CatchingUp { read, kept, .. } = &mut self.stage {
            match read.try_recv() {
                Err(TryRecvError::Empty) if kept.len() < MOST_KEPT => {
                    return kept.push((at, event.clone(), commands.to_vec()));
                }
                Err(TryRecvError::Empty) => self.give_up(&"too much happened while its log was read"),
                Err(TryRecvError::Closed) => self.give_up(&UNREAD),
                Ok(read) => self.catch_up(read),
            }
        }
        if let Stage::Following(live) = &mut self.stage {
            live.follow(at, event, commands).into_iter().for_each(|span| self.sender.record(span));
        }
    }

    /// Sends the remaining spans, and the run's own span; waits at most [`END_OF_RUN`].
    pub(super) async fn end(spans: Option<Spans>) {
        let Some(mut spans) = spans else { return };
        let (sender, until) = (spans.sender, Instant::now() + END_OF_RUN);
        if let Stage::CatchingUp { read, .. } = &mut spans.stage {
            match tokio::time::timeout_at(until, read).await {
                Ok(Ok(read)) => spans.catch_up(read),
                Ok(Err(_)) => spans.give_up(&UNREAD),
                Err(_) => spans.give_up(&"its log was not read to where it went on before it ended"),
            }
        }
        if let Stage::Following(live) = &mut spans.stage {
            live.end().into_iter().for_each(|span| sender.record(span));
        }
        sender.flush(until.saturating_duration_since(Instant::now())).await;
    }

    fn catch_up(&mut self, read: Result<CaughtUp, LogError>) {
        let CaughtUp { mut live, again } = match read {
            Ok(caught_up) => caught_up,
            Err(error) => return self.give_up(&error),
        };
        again.into_iter().for_each(|span| self.sender.record(span));
        if let Stage::CatchingUp { kept, .. } = &mut self.stage {
            for (at, event, commands) in kept.drain(..) {
                live.follow(at, &event, &commands).into_iter().for_each(|span| self.sender.record(span));
            }
        }
        self.stage = Stage::Following(live);
    }

    fn give_up(&mut self, why: &dyn std::fmt::Display) {
        if let Stage::CatchingUp { messages, .. } = &self.stage {
            messages.say(format_args!("no spans of its nodes are sent to the OTLP collector any more: {why}"));
        }
        self.stage = Stage::GivenUp;
    }
}

/// Reads the log up to the resumption.
fn caught_up(mut live: Box<Live>, before: &Before, speed: f64) -> Result<CaughtUp, LogError> {
    let from_s = before.last.seconds() - SENT_AGAIN.as_secs_f64() * speed;
    let mut again = Vec::new();
    let mut lines = Lines::of(&before.log)?;
    while lines.position().0 < before.bytes
        && let Some(line) = lines.next()
    {
        let line = line?;
        let spans = live.line(&line);
        if line.at.seconds() >= from_s {
            again.extend(spans);
        }
    }
    Ok(CaughtUp { live, again })
}

#[allow(
    clippy::disallowed_methods,
    reason = "a span is at a moment of the wall clock; how long it took is measured otherwise"
)]
fn unix_ns() -> u64 {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since_1970.as_nanos()).unwrap_or(u64::MAX)
}
