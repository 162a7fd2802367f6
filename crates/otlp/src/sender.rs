//! The sender of a process: a bounded queue, and a thread that sends its content in batches.
//!
//! Spans that cannot be sent are dropped and counted, without a retry: no work may depend on them.

use super::config::{Fault, OtlpConfig, Target};
use super::post::{PostError, post};
use super::span::Span;
use super::wire;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

/// Maximum number of spans in the queue, …
const QUEUE: usize = 4_096;
/// … and their maximum size in bytes together.
const QUEUE_BYTES: usize = 16 << 20;
/// Maximum number of spans in a request, …
const BATCH: usize = 512;
/// … and maximum size of a request in bytes: collectors accept 4 MiB by default, …
const BATCH_BYTES: usize = 1 << 20;
/// … and maximum time for which spans are collected for a request.
const PAUSE: Duration = Duration::from_millis(500);
/// Time limit for sending the queue at the end of a run, …
pub const END_OF_RUN: Duration = Duration::from_secs(2);
/// … and at the end of a daemon or a worker, for which its manager waits.
pub const END_OF_SERVER: Duration = Duration::from_millis(500);
/// The instrumentation scope of a process's own spans.
const SCOPE: &str = "ratn";

static SENDER: OnceLock<Sender> = OnceLock::new();

/// Sends the spans of this process; clones share the queue.
#[derive(Debug, Clone)]
pub struct Sender {
    queue: mpsc::Sender<Message>,
    /// Number of bytes in the queue.
    bytes: Arc<AtomicUsize>,
    counts: Counts,
    trouble: Arc<Trouble>,
}

/// Reports once that spans are dropped.
struct Trouble {
    collector: String,
    is_said: AtomicBool,
    say: Box<dyn Fn(&str) + Send + Sync>,
}

impl Trouble {
    /// Reports why the collector does not get spans.
    fn say(&self, why: &dyn fmt::Display) {
        if !self.is_said.swap(true, Ordering::Relaxed) {
            (self.say)(&format!(
                "the OTLP collector at {} does not take spans: {why}; what it does not take is dropped and counted, \
                 and not said again: start a collector there, or leave [service.otlp] out",
                self.collector
            ));
        }
    }
}

impl fmt::Debug for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Trouble").field("collector", &self.collector).field("is_said", &self.is_said).finish()
    }
}

/// Numbers of spans sent and dropped. Clones share the counters.
#[derive(Debug, Clone, Default)]
pub struct Counts(Arc<[AtomicU64; 2]>);

#[derive(Debug)]
enum Message {
    Span(Box<Span>),
    Flush(oneshot::Sender<()>),
}

impl Counts {
    /// Number of spans that the collector has accepted.
    pub fn sent(&self) -> u64 {
        self.0[0].load(Ordering::Relaxed)
    }

    /// Number of spans that the collector did not accept, or that found the queue full.
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

/// Starts the sender of this process, if the config asks for it and none was started before. `resource` describes the process; `say` is
/// called once, at the first failure, with the reason why spans are dropped.
///
/// # Errors
/// The fault in the config.
pub fn start(
    config: &OtlpConfig,
    resource: Vec<(&'static str, String)>,
    say: impl Fn(&str) + Send + Sync + 'static,
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
        say: impl Fn(&str) + Send + Sync + 'static,
    ) -> Sender {
        let (queue, spans) = mpsc::channel(QUEUE);
        let trouble =
            Trouble { collector: target.uri.to_string(), is_said: AtomicBool::new(false), say: Box::new(say) };
        let sender = Sender { queue, bytes: Arc::default(), counts: Counts::default(), trouble: Arc::new(trouble) };
        let (queued, counts, trouble) = (Arc::clone(&sender.bytes), sender.counts.clone(), Arc::clone(&sender.trouble));
        let work = Work { target, timeout_ms, resource, queued, counts, trouble };
        let sending = move || match tokio::runtime::Builder::new_current_thread().enable_all().build() {
            Ok(runtime) => runtime.block_on(work.send_all(spans)),
            Err(error) => work.trouble.say(&format_args!("this process cannot send any: {error}")),
        };
        // If the thread cannot be started, the queue is closed, and everything is dropped.
        let _ = std::thread::Builder::new().name("otlp".to_owned()).spawn(sending);
        sender
    }

    /// Queues a span, or drops it if there is no room; never waits.
    pub fn record(&self, span: Span) {
        let span = span.cut();
        let bytes = span.bytes();
        let has_room = self.bytes.fetch_add(bytes, Ordering::Relaxed) + bytes <= QUEUE_BYTES;
        if !has_room || self.queue.try_send(Message::Span(Box::new(span))).is_err() {
            self.bytes.fetch_sub(bytes, Ordering::Relaxed);
            self.counts.add(0, 1);
            self.trouble.say(&format_args!(
                "{QUEUE} of them, or {QUEUE_BYTES} bytes, wait to be sent, and more come than it takes"
            ));
        }
    }

    /// The numbers of spans sent and dropped so far.
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Waits until everything recorded before is sent or dropped, at most for `patience`.
    pub async fn flush(&self, patience: Duration) {
        let flushing = async {
            let (done, is_done) = oneshot::channel();
            if self.queue.send(Message::Flush(done)).await.is_ok() {
                let _ = is_done.await;
            }
        };
        if tokio::time::timeout(patience, flushing).await.is_err() {
            let patience_s = patience.as_secs_f64();
            self.trouble.say(&format_args!("the last ones were not taken within {patience_s} s of the end"));
        }
    }
}

struct Work {
    target: Target,
    timeout_ms: u64,
    resource: Vec<(&'static str, String)>,
    /// Number of bytes in the queue.
    queued: Arc<AtomicUsize>,
    counts: Counts,
    trouble: Arc<Trouble>,
}

impl Work {
    async fn send_all(self, mut queue: mpsc::Receiver<Message>) {
        let mut batch = Vec::with_capacity(BATCH);
        let take = |batch: &mut Vec<Span>, span: Box<Span>| {
            let bytes = span.bytes();
            self.queued.fetch_sub(bytes, Ordering::Relaxed);
            batch.push(*span);
            bytes
        };
        while let Some(first) = queue.recv().await {
            let (mut flushed, mut bytes) = match first {
                Message::Flush(done) => (Some(done), 0),
                Message::Span(span) => (None, take(&mut batch, span)),
            };
            let until = Instant::now() + PAUSE;
            while flushed.is_none() && batch.len() < BATCH && bytes < BATCH_BYTES {
                match tokio::time::timeout_at(until, queue.recv()).await {
                    Ok(Some(Message::Span(span))) => bytes += take(&mut batch, span),
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

    async fn send(&self, batch: &[Span]) {
        let body = wire::request(&self.resource, SCOPE, batch);
        let patience = Duration::from_millis(self.timeout_ms);
        let sent = tokio::time::timeout(patience, post(&self.target, body)).await;
        match sent.unwrap_or(Err(PostError::Late(self.timeout_ms))) {
            Ok(()) => self.counts.add(batch.len(), 0),
            Err(why) => {
                self.counts.add(0, batch.len());
                self.trouble.say(&why);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::{Kind, decode};
    use std::sync::Mutex;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;

    fn span(id: u64) -> Span {
        Span {
            trace: 7,
            id,
            parent: Some(1),
            name: "work".to_owned(),
            kind: Kind::Server,
            from_unix_ns: 1,
            to_unix_ns: 2,
            attributes: vec![("said", "yes".to_owned()), ("unsaid", String::new())],
            links: vec![crate::Link { to: 3, waited_for: "result" }],
            error: None,
        }
    }

    fn to(port: u16, timeout_ms: u64) -> (Sender, Arc<Mutex<Vec<String>>>) {
        let endpoint = Some(format!("http://127.0.0.1:{port}"));
        let config = OtlpConfig { endpoint, timeout_ms, ..OtlpConfig::default() };
        let heard: Arc<Mutex<Vec<String>>> = Arc::default();
        let say = {
            let heard = Arc::clone(&heard);
            move |said: &str| heard.lock().unwrap().push(said.to_owned())
        };
        let resource = vec![("service.name", "test".to_owned())];
        (Sender::start(config.target().unwrap().unwrap(), timeout_ms, resource, say), heard)
    }

    /// Answers one request; returns its head and its body.
    async fn answer(listener: &TcpListener, status: &str) -> (String, Vec<u8>) {
        let (mut connection, _) = listener.accept().await.unwrap();
        let mut read = Vec::new();
        loop {
            let mut some = [0; 4096];
            let count = connection.read(&mut some).await.unwrap();
            read.extend(&some[..count]);
            let Some(end) = read.windows(4).position(|four| four == b"\r\n\r\n") else { continue };
            let head = String::from_utf8(read[..end].to_vec()).unwrap().to_lowercase();
            let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")).unwrap();
            let body = read[end + 4..].to_vec();
            if body.len() == length.parse::<usize>().unwrap() {
                let answer = format!("HTTP/1.1 {status}\r\ncontent-length: 0\r\n\r\n");
                connection.write_all(answer.as_bytes()).await.unwrap();
                return (head, body);
            }
        }
    }

    #[tokio::test]
    async fn a_span_arrives_as_it_was_recorded() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, heard) = to(listener.local_addr().unwrap().port(), 2_000);
        sender.record(span(2));
        let (answered, ()) = tokio::join!(answer(&listener, "200 OK"), sender.flush(END_OF_RUN));
        let (head, body) = answered;
        assert!(head.starts_with("post /v1/traces http/1.1"), "{head}");
        assert!(head.contains("content-type: application/x-protobuf"), "{head}");
        let [there] = &decode(&body).unwrap()[..] else { panic!("not one span") };
        assert_eq!((there.service.as_str(), there.name.as_str()), ("test", "work"));
        assert_eq!(there.trace, format!("{:032x}", 7));
        assert_eq!((there.id.as_str(), there.parent.as_str()), ("0000000000000002", "0000000000000001"));
        assert_eq!(there.attributes, [("said".to_owned(), "yes".to_owned())]);
        assert_eq!(there.links, ["0000000000000003"]);
        assert_eq!((sender.counts().sent(), sender.counts().dropped()), (1, 0));
        assert!(heard.lock().unwrap().is_empty());
    }

    #[tokio::test]
    async fn an_answer_that_is_an_error_is_said_once_and_its_spans_are_counted() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, heard) = to(listener.local_addr().unwrap().port(), 2_000);
        for round in 1..=3 {
            sender.record(span(round));
            tokio::join!(answer(&listener, "503 Service Unavailable"), sender.flush(END_OF_RUN));
            assert_eq!((sender.counts().sent(), sender.counts().dropped()), (0, round));
        }
        let heard = heard.lock().unwrap();
        assert!(heard.len() == 1 && heard[0].contains("503") && heard[0].contains("/v1/traces"), "{heard:?}");
    }

    #[tokio::test]
    async fn one_that_is_away_is_said_once() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        drop(listener);
        let (sender, heard) = to(port, 2_000);
        for round in 1..=3 {
            sender.record(span(round));
            sender.flush(END_OF_RUN).await;
            assert_eq!(sender.counts().dropped(), round);
        }
        let heard = heard.lock().unwrap();
        assert!(heard.len() == 1 && heard[0].contains("cannot connect"), "{heard:?}");
    }

    #[tokio::test]
    async fn one_that_hangs_keeps_nobody_waiting_and_what_has_no_room_is_dropped() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, heard) = to(listener.local_addr().unwrap().port(), 60_000);
        let began = Instant::now();
        // Spans that are being sent are no longer in the queue.
        let most = (QUEUE + 2 * BATCH) as u64;
        for id in 1..=2 * most {
            sender.record(span(id));
        }
        assert!(began.elapsed() < Duration::from_secs(1), "{:?}", began.elapsed());
        assert!(sender.counts().dropped() >= most, "{}", sender.counts().dropped());
        let patience = Duration::from_millis(100);
        let began = Instant::now();
        sender.flush(patience).await;
        assert!((patience..patience * 10).contains(&began.elapsed()), "{:?}", began.elapsed());
        assert_eq!(sender.counts().sent(), 0);
        let heard = heard.lock().unwrap();
        assert!(heard.len() == 1 && heard[0].contains("4096 of them, or 16777216 bytes, wait to be sent"), "{heard:?}");
    }

    #[tokio::test]
    async fn long_spans_that_nobody_takes_have_a_bound_in_bytes_and_there_is_room_again_once_they_are_taken() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, _) = to(listener.local_addr().unwrap().port(), 60_000);
        let attributes: Vec<_> = (0..16).map(|_| ("said", "ä".repeat(10_000))).collect();
        let long = |id| Span { attributes: attributes.clone(), ..span(id) };
        let most = QUEUE_BYTES / long(1).cut().bytes();
        (0..2 * most as u64).for_each(|id| sender.record(long(id)));
        let dropped = sender.counts().dropped();
        // Spans that are being sent are no longer in the queue.
        assert!(dropped + 40 >= most as u64 && dropped <= most as u64, "{dropped} of {most}");
        let flushing = {
            let sender = sender.clone();
            tokio::spawn(async move { sender.flush(Duration::from_secs(60)).await })
        };
        while !flushing.is_finished() {
            tokio::select! {
                _ = answer(&listener, "200 OK") => {}
                () = tokio::time::sleep(Duration::from_millis(20)) => {}
            }
        }
        assert_eq!(sender.bytes.load(Ordering::Relaxed), 0);
    }

    #[tokio::test]
    async fn one_that_answers_what_is_no_answer_or_does_not_end_is_given_up_in_time() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        for (begins, goes_on) in [
            ("SSH-2.0-x\r\n", "garbage\r\n"),
            ("HTTP/1.1 200 OK\r\n", "x: y\r\n"),
            ("", "HTTP/1.1 100 Continue\r\n\r\n"),
            ("", ""),
        ] {
            let (sender, _) = to(listener.local_addr().unwrap().port(), 300);
            sender.record(span(1));
            let chatter = async {
                let (mut connection, _) = listener.accept().await.unwrap();
                let mut said = connection.write_all(begins.as_bytes()).await;
                while said.is_ok() {
                    said = connection.write_all(goes_on.as_bytes()).await;
                    tokio::task::yield_now().await;
                }
            };
            let patience = Duration::from_secs(30);
            let began = Instant::now();
            tokio::select! {
                () = async { chatter.await; std::future::pending().await } => {}
                () = sender.flush(patience) => {}
            }
            assert!(began.elapsed() < patience, "{begins}{goes_on}");
            assert_eq!((sender.counts().sent(), sender.counts().dropped()), (0, 1), "{begins}{goes_on}");
        }
    }

    #[tokio::test]
    async fn requests_are_bounded_in_bytes_and_long_texts_are_cut() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, heard) = to(listener.local_addr().unwrap().port(), 60_000);
        let long = "ä".repeat(10_000);
        let attributes: Vec<_> = (0..16).map(|_| ("said", long.clone())).collect();
        let links = (0..100_000).map(|to| crate::Link { to, waited_for: "result" }).collect();
        sender.record(Span { error: Some("ä".repeat(1 << 20)), name: long, links, ..span(1) });
        (2..100).for_each(|id| sender.record(Span { attributes: attributes.clone(), ..span(id) }));
        let flushing = {
            let sender = sender.clone();
            tokio::spawn(async move { sender.flush(Duration::from_secs(60)).await })
        };
        let (mut spans, mut requests) = (Vec::new(), 0);
        while spans.len() < 99 {
            let (_, body) = answer(&listener, "200 OK").await;
            assert!(body.len() < 2 * BATCH_BYTES, "{}", body.len());
            spans.extend(decode(&body).unwrap());
            requests += 1;
        }
        flushing.await.unwrap();
        assert!(requests >= 6, "{requests}");
        let error = spans[0].error.as_deref().unwrap();
        assert!(error.len() < 4_200 && error.ends_with("ä…"), "{}", error.len());
        assert!(spans[0].name.len() < 4_200 && spans[0].links.len() == 128);
        assert!(heard.lock().unwrap().is_empty());
    }

    #[tokio::test]
    async fn what_is_not_taken_by_the_end_is_said() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (sender, heard) = to(listener.local_addr().unwrap().port(), 60_000);
        sender.record(span(1));
        sender.flush(Duration::from_millis(50)).await;
        let heard = heard.lock().unwrap();
        assert!(heard.len() == 1 && heard[0].contains("within 0.05 s of the end"), "{heard:?}");
    }
}
