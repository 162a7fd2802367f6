//! The sender of a process: a bounded queue, and a thread that sends what is in it in batches.
//!
//! What cannot be sent is dropped and counted, and is not tried again: spans tell what went on, and nobody's work may depend on them.

use super::config::{Fault, OtlpConfig, Target};
use super::post::{PostError, post};
use super::span::Span;
use super::wire;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

/// Spans that were not sent yet.
const QUEUE: usize = 4_096;
/// As many spans are one request, …
const BATCH: usize = 512;
/// … or what came in this time.
const PAUSE: Duration = Duration::from_millis(500);
/// What is queued at the end of a run is sent in this time, …
pub const END_OF_RUN: Duration = Duration::from_secs(2);
/// … and at the end of a daemon or a worker, which its manager waits for, in this.
pub const END_OF_SERVER: Duration = Duration::from_millis(500);
/// The scope of what a process tells of itself.
const SCOPE: &str = "ratn";

static SENDER: OnceLock<Sender> = OnceLock::new();

/// Sends the spans of this process; clones share the queue.
#[derive(Debug, Clone)]
pub struct Sender {
    queue: mpsc::Sender<Message>,
    counts: Counts,
}

/// How many spans were sent, and how many dropped. Clones count together.
#[derive(Debug, Clone, Default)]
pub struct Counts(Arc<[AtomicU64; 2]>);

#[derive(Debug)]
enum Message {
    Span(Box<Span>),
    Flush(oneshot::Sender<()>),
}

impl Counts {
    /// Those that a collector has taken.
    pub fn sent(&self) -> u64 {
        self.0[0].load(Ordering::Relaxed)
    }

    /// Those that no collector has taken, or that found the queue full.
    pub fn dropped(&self) -> u64 {
        self.0[1].load(Ordering::Relaxed)
    }

    fn add(&self, sent: usize, dropped: usize) {
        self.0[0].fetch_add(sent as u64, Ordering::Relaxed);
        self.0[1].fetch_add(dropped as u64, Ordering::Relaxed);
    }
}

/// The sender of this process, if there is one.
pub fn sender() -> Option<&'static Sender> {
    SENDER.get()
}

/// Starts the sender of this process, where the config says so and none was started before. `resource` says which process it is; `say`
/// is told once, on the first trouble, that spans are dropped and why.
///
/// # Errors
/// What is wrong with the config.
pub fn start(
    config: &OtlpConfig,
    resource: Vec<(&'static str, String)>,
    say: impl Fn(&str) + Send + 'static,
) -> Result<Option<&'static Sender>, Fault> {
    let Some(target) = config.target()? else { return Ok(sender()) };
    if let Some(sender) = sender() {
        return Ok(Some(sender));
    }
    let started = Sender::start(target, config.timeout_ms, resource, say);
    Ok(Some(SENDER.get_or_init(|| started)))
}

impl Sender {
    fn start(
        target: Target,
        timeout_ms: u64,
        resource: Vec<(&'static str, String)>,
        say: impl Fn(&str) + Send + 'static,
    ) -> Sender {
        let (queue, spans) = mpsc::channel(QUEUE);
        let sender = Sender { queue, counts: Counts::default() };
        let counts = sender.counts.clone();
        let work = Work { target, timeout_ms, resource, counts, said: false, say };
        let sending = move || match tokio::runtime::Builder::new_current_thread().enable_all().build() {
            Ok(runtime) => runtime.block_on(work.send_all(spans)),
            Err(error) => (work.say)(&format!("OTLP: no spans are sent: {error}")),
        };
        // Without the thread the queue is closed, and everything is dropped.
        let _ = std::thread::Builder::new().name("otlp".to_owned()).spawn(sending);
        sender
    }

    /// Takes a span, or drops it where there is no room; never waits.
    pub fn record(&self, span: Span) {
        if self.queue.try_send(Message::Span(Box::new(span))).is_err() {
            self.counts.add(0, 1);
        }
    }

    /// How many were sent and dropped until now.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Waits until what was recorded before is sent or dropped, for so long at the most.
    pub async fn flush(&self, patience: Duration) {
        let flushing = async {
            let (done, is_done) = oneshot::channel();
            if self.queue.send(Message::Flush(done)).await.is_ok() {
                let _ = is_done.await;
            }
        };
        let _ = tokio::time::timeout(patience, flushing).await;
    }
}

struct Work<S> {
    target: Target,
    timeout_ms: u64,
    resource: Vec<(&'static str, String)>,
    counts: Counts,
    said: bool,
    say: S,
}

impl<S: Fn(&str)> Work<S> {
    async fn send_all(mut self, mut queue: mpsc::Receiver<Message>) {
        let mut batch = Vec::with_capacity(BATCH);
        while let Some(first) = queue.recv().await {
            let mut flushed = match first {
                Message::Flush(done) => Some(done),
                Message::Span(span) => {
                    batch.push(*span);
                    None
                }
            };
            let until = Instant::now() + PAUSE;
            while flushed.is_none() && batch.len() < BATCH {
                match tokio::time::timeout_at(until, queue.recv()).await {
                    Ok(Some(Message::Span(span))) => batch.push(*span),
                    Ok(Some(Message::Flush(done))) => flushed = Some(done),
                    Ok(None) | Err(_) => break,
                }
            }
            if !batch.is_empty() {
                self.send(&batch).await;
                batch.clear();
            }
            if let Some(done) = flushed {
                let _ = done.send(());
            }
        }
    }

    async fn send(&mut self, batch: &[Span]) {
        let body = wire::request(&self.resource, SCOPE, batch);
        let patience = Duration::from_millis(self.timeout_ms);
        let sent = tokio::time::timeout(patience, post(&self.target, body)).await;
        match sent.unwrap_or(Err(PostError::Late(self.timeout_ms))) {
            Ok(()) => self.counts.add(batch.len(), 0),
            Err(why) => {
                self.counts.add(0, batch.len());
                if !self.said {
                    self.said = true;
                    let collector = &self.target.uri;
                    (self.say)(&format!(
                        "the OTLP collector at {collector} does not take spans: {why}; what it does not take is dropped and counted, \
                         and not said again: start a collector there, or leave [service.otlp] out"
                    ));
                }
            }
        }
    }
}
