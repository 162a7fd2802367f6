//! The writer's side of a log in etcd: one thread, one transaction at a time.
//!
//! ```text
//!   append ──▶ batch ──take──▶ frame: { leader and head as I know them? put frame, move head } ──▶ durable
//!                                └── no answer: the same again; `head` says whether it was performed
//! ```
//! While etcd does not answer or has no space, appended records wait, and [`Progress::stalled`](crate::Progress) says why. The waiting
//! bytes are bounded: beyond the limit appends are refused, until etcd is back.

use super::chain::Chain;
use super::client::{CallError, Client, FIRST_PAUSE, LONGEST_PAUSE};
use super::compaction::Compaction;
use super::format::{Current, Head, Step, encode_frame, parse, text};
use super::keys::{delete, found_one, get, put};
use super::mark::{Height, Mark};
use super::owner::Owner;
use super::term::{HeldPlace, OTHERS_PATIENCE, PART_OF_A_COPY, RENEW_INTERVAL, Term};
use super::wire::{RequestOp, TxnRequest};
use crate::durable::Durable;
use crate::error::{AppendError, CompactError, CompactionFailure, CopyError, Fault};
use crate::pending::{Batch, Pending, RECORD_HEADER};
use crate::store::{MakeSnapshot, Place, Position, Turns, Writer};
use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// Time limit for a transaction with a whole part; then it is repeated.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);
/// A transaction that takes longer than this is reported as stalled.
const STALLED_AFTER: Duration = Duration::from_millis(500);
/// If several callers waited for a transaction, the next one is delayed for them by this part of its duration …
const LINGER_SHARE: u32 = 8;
/// … and by no more than this.
const LONGEST_LINGER: Duration = Duration::from_millis(2);
/// How long closing waits for an etcd that does not answer.
const CLOSE_PATIENCE: Duration = Duration::from_secs(3);
/// How long a refused call is retried: some refusals are temporary.
const REFUSED_PATIENCE: Duration = Duration::from_secs(5);
/// Pause before a retry if etcd has no space.
const NO_SPACE_PAUSE: Duration = Duration::from_millis(500);

/// The size limits of a log in etcd, in bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bounds {
    /// Maximum size of a record.
    pub record: usize,
    /// Maximum bytes that wait to be written. As many again may be in writing.
    pub buffered: usize,
    /// Maximum size of what one transaction puts: below etcd's `--max-request-bytes` of 1.5 MiB.
    pub part: usize,
}

impl Default for Bounds {
    fn default() -> Bounds {
        Bounds { record: 4 << 20, buffered: 64 << 20, part: 1 << 20 }
    }
}

/// What the writer, its thread and a compaction share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) term: Arc<Term>,
    pub(super) pending: Pending,
    pub(super) bounds: Bounds,
    /// (first, last) record of every existing frame.
    frames: Mutex<VecDeque<(Position, Position)>>,
    /// The chain for everything but frames, and its step count.
    snapshots: Mutex<(Chain, u64)>,
    closing_since: Mutex<Option<Instant>>,
}

#[derive(Debug)]
pub(super) struct EtcdWriter {
    shared: Arc<Shared>,
    writing: Option<JoinHandle<()>>,
    compaction: Option<JoinHandle<()>>,
    renewing: Renewing,
}

impl Shared {
    pub(super) fn new(
        term: Arc<Term>,
        bounds: Bounds,
        last: Position,
        compacted: Position,
        frames: Vec<(Position, Position)>,
        snapshots: Chain,
    ) -> Shared {
        let pending = Pending::new(term.keys.prefix().to_owned(), 0, last, compacted);
        let (frames, snapshots) = (Mutex::new(frames.into()), Mutex::new((snapshots, 0)));
        Shared { term, pending, bounds, frames, snapshots, closing_since: Mutex::default() }
    }

    /// Changes a snapshot, what it replaces, or the marks of the log. Closing the log does not wait for this.
    pub(super) fn change_snapshots(&self, operations: Vec<RequestOp>) -> Result<(), Fault> {
        if self.pending.is_closing() {
            return Err(Fault::Closed);
        }
        let mut snapshots = self.snapshots.lock().unwrap_or_else(PoisonError::into_inner);
        let (chain, step) = &mut *snapshots;
        *step += 1;
        let value = text(&Step { epoch: self.term.epoch.0, step: *step });
        chain.step(&self.term, operations, value, |request| self.perform(request))
    }

    /// Whether the snapshot through this position is the one that counts. After this call, earlier steps that were given up are not
    /// performed any more.
    pub(super) fn counts(&self, through: Position) -> Result<bool, Fault> {
        self.change_snapshots(Vec::new())?;
        let keys = &self.term.keys;
        let answer = self.perform(&self.term.guarded(vec![get(keys.current())]))?;
        if !answer.succeeded {
            return Err(self.term.deposed());
        }
        let Some(found) = found_one(answer.responses.into_iter().next()) else { return Ok(false) };
        let current: Current = parse(&keys.current(), &found.value).map_err(|error| Fault::Remote {
            action: "read from",
            place: keys.prefix().to_owned(),
            what: error.to_string(),
        })?;
        Ok(current.through == through.0)
    }

    /// Forgets the frames that hold nothing after this position; returns the range of their first records.
    pub(super) fn superfluous(&self, through: Position) -> Option<(Position, Position)> {
        let mut frames = self.frames.lock().unwrap_or_else(PoisonError::into_inner);
        let (first, _) = *frames.front()?;
        while frames.front().is_some_and(|(_, last)| *last <= through) {
            frames.pop_front();
        }
        let end = frames.front().map_or(through.next(), |(kept, _)| *kept);
        (end > first).then_some((first, end))
    }

    /// Performs an idempotent transaction, until it is performed or never will be.
    pub(super) fn perform(&self, request: &TxnRequest) -> Result<super::wire::TxnResponse, Fault> {
        let (client, began): (&Client, _) = (&self.term.client, Instant::now());
        let mut pause = FIRST_PAUSE;
        loop {
            let patience =
                self.closing_since().map_or(PATIENCE, |since| CLOSE_PATIENCE.saturating_sub(since.elapsed()));
            let error = match client.attempt(request.clone(), patience) {
                Ok(answer) => {
                    self.pending.stalled(None);
                    return Ok(answer);
                }
                Err(error) => error,
            };
            if let Some(fault) = self.pending.fault() {
                return Err(fault);
            }
            // A member of the original cluster may still run, and hold the request without an answer.
            let error = match error {
                CallError::Unknown(_) => client.only_others_for(OTHERS_PATIENCE).unwrap_or(error),
                error => error,
            };
            let over = match &error {
                CallError::Unknown(_) | CallError::NoSpace => false,
                CallError::Refused(_) | CallError::OtherCluster { .. } => began.elapsed() >= REFUSED_PATIENCE,
                CallError::TooLarge(_) | CallError::WentBack { .. } => true,
            };
            if over || self.has_waited_to_close() {
                return Err(self.term.fault("write to", &error));
            }
            if began.elapsed() >= STALLED_AFTER || matches!(error, CallError::NoSpace) {
                self.pending.stalled(Some(error.to_string()));
            }
            thread::sleep(if matches!(error, CallError::NoSpace) { NO_SPACE_PAUSE } else { pause });
            pause = (2 * pause).min(LONGEST_PAUSE);
        }
    }

    fn closing_since(&self) -> Option<Instant> {
        *self.closing_since.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn has_waited_to_close(&self) -> bool {
        self.closing_since().is_some_and(|since| since.elapsed() >= CLOSE_PATIENCE)
    }

    fn close(&self) {
        self.closing_since.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_with(Instant::now);
        self.pending.close();
    }
}

/// The writing thread.
struct Writing {
    shared: Arc<Shared>,
    chain: Chain,
    /// The head's position, and how often `head` was written in this epoch.
    head: Position,
    step: u64,
}

/// Reports that no thread writes any more, in whatever way the thread ended.
pub(super) struct Ended(pub(super) Arc<Shared>);

impl Drop for Ended {
    fn drop(&mut self) {
        if thread::panicking() {
            stop_ended(&self.0);
        }
    }
}

impl Writing {
    fn run(mut self) {
        let shared = self.shared.clone();
        let _ended = Ended(shared.clone());
        let mut linger = Duration::ZERO;
        while let Some((batch, _)) = shared.pending.take(linger) {
            let began = Instant::now();
            ratn_panic_point::panic_point("etcd-writer");
            if let Err(fault) = self.write(&batch) {
                shared.pending.stop(&fault);
                return;
            }
            // The callers of this batch are about to append again: without a short delay the next transaction would serve only the first of
            // them, and all others would wait for two. A single caller causes no delay.
            linger =
                if batch.count > 1 { (began.elapsed() / LINGER_SHARE).min(LONGEST_LINGER) } else { Duration::ZERO };
            shared.pending.give_back(batch);
        }
    }

    /// Writes a batch in as few frames as possible; a record that is larger than a transaction gets a frame of its own.
    fn write(&mut self, batch: &Batch) -> Result<(), Fault> {
        let most = self.shared.bounds.part - super::format::FRAME_HEADER;
        let mut rest = &batch.bytes[..];
        let mut first = batch.first;
        while !rest.is_empty() {
            let (mut bytes, mut count) = (0, 0_u32);
            while let Some(length) = rest[bytes..].first_chunk::<RECORD_HEADER>() {
                let record = RECORD_HEADER + u32::from_le_bytes(*length) as usize;
                if count > 0 && bytes + record > most {
                    break;
                }
                (bytes, count) = (bytes + record, count + 1);
            }
            let (frame, behind) = rest.split_at(bytes);
            let last = Position(first.0 + u64::from(count) - 1);
            self.commit(first, last, frame)?;
            self.shared.pending.synced(last);
            (rest, first) = (behind, last.next());
        }
        Ok(())
    }

    /// Puts a part, together with the new head.
    fn put(&mut self, part: RequestOp, head: Position) -> Result<(), Fault> {
        self.step += 1;
        self.head = head;
        let term = &self.shared.term;
        let value = text(&Head { position: head.0, epoch: term.epoch.0, step: self.step });
        self.chain.step(term, vec![part], value, |request| self.shared.perform(request))
    }

    fn commit(&mut self, first: Position, last: Position, records: &[u8]) -> Result<(), Fault> {
        let shared = self.shared.clone();
        let (term, keys) = (&shared.term, &shared.term.keys);
        let count = u32::try_from(last.0 - first.0 + 1).unwrap_or(u32::MAX);
        let parts = encode_frame(term.store, first, count, records, shared.bounds.part);
        let mut puts: Vec<RequestOp> =
            (0..).zip(parts).map(|(number, part)| put(keys.frame(first, number), part)).collect();
        let begin = puts.remove(0);
        // Parts after the head do not count until the head has moved.
        for part in puts {
            self.put(part, self.head)?;
        }
        self.put(begin, last)?;
        self.shared.frames.lock().unwrap_or_else(PoisonError::into_inner).push_back((first, last));
        Ok(())
    }
}

/// Renews the place from the moment it was taken, because reading a long log may take longer than the silence limit. Gives the place up at
/// the end.
pub(super) struct Renewing {
    term: Arc<Term>,
    /// The writer, once there is one: it is stopped if the place is lost.
    writer: Arc<OnceLock<Arc<Shared>>>,
    panicked: Arc<AtomicBool>,
    /// The number of turns the owner has taken, if the owner reports it.
    turns: Arc<OnceLock<Turns>>,
    /// Ends the thread; `None` after the end.
    thread: Option<(mpsc::Sender<()>, JoinHandle<()>)>,
}

impl Renewing {
    pub(super) fn start(term: Arc<Term>, mark: Mark) -> io::Result<Renewing> {
        let (end, ended) = mpsc::channel::<()>();
        let writer = Arc::new(OnceLock::<Arc<Shared>>::new());
        let (renewed, tell, kept) = (term.clone(), writer.clone(), mark);
        let turns = Arc::new(OnceLock::<Turns>::new());
        let (taken, mut owner) = (turns.clone(), Owner::since(Instant::now()));
        let panicked = Arc::new(AtomicBool::new(false));
        let unrenewed = Unrenewed { writer: writer.clone(), panicked: panicked.clone() };
        let renew = move || {
            let _unrenewed = unrenewed;
            while let Err(mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(RENEW_INTERVAL) {
                ratn_panic_point::panic_point("etcd-renewer");
                renewed.owner_hangs(owner.hangs(taken.get().and_then(|taken| taken()), Instant::now()));
                let over = match renewed.renew() {
                    Err(fault @ Fault::Deposed { .. }) => Some(fault),
                    Err(_) => renewed.is_gone(),
                    Ok(()) => None,
                };
                keep(&kept, &tell);
                // If the loss is found before there is a writer, it will be found again.
                if let (Some(fault), Some(writer)) = (over, tell.get()) {
                    writer.pending.stop(&fault);
                    return;
                }
            }
            keep(&kept, &tell);
        };
        let thread = thread::Builder::new().name("etcd-renewer".to_owned()).spawn(renew)?;
        Ok(Renewing { term, writer, panicked, turns, thread: Some((end, thread)) })
    }

    fn watched_by(&self, writer: &Arc<Shared>) {
        let _ = self.writer.set(writer.clone());
        if self.panicked.load(Ordering::SeqCst) {
            stop_ended(writer);
        }
    }

    fn end(&mut self) {
        if let Some((end, thread)) = self.thread.take() {
            drop(end);
            // Whatever the thread is still asking: it will be refused from now on.
            self.term.give_up();
            let _ = thread.join();
        }
    }
}

/// Reports that the place is not renewed any more, if the renewing thread panicked. Writes are then refused soon, but until then the
/// process would not know.
struct Unrenewed {
    writer: Arc<OnceLock<Arc<Shared>>>,
    panicked: Arc<AtomicBool>,
}

impl Drop for Unrenewed {
    fn drop(&mut self) {
        if thread::panicking() {
            // A writer that comes later checks this.
            self.panicked.store(true, Ordering::SeqCst);
            self.writer.get().into_iter().for_each(stop_ended);
        }
    }
}

fn stop_ended(shared: &Arc<Shared>) {
    shared.pending.stop(&Fault::Ended { place: shared.pending.place.clone() });
}

/// Records for this host how far the log is durable.
fn keep(mark: &Mark, writer: &OnceLock<Arc<Shared>>) {
    if let Some(writer) = writer.get() {
        let position = writer.pending.watch().borrow().durable.0;
        let Term { store, generation, epoch, .. } = &*writer.term;
        mark.keep(Height { store: *store, generation: *generation, epoch: epoch.0, position });
        if writer.term.client.has_gone_back() {
            mark.doubt();
        }
    }
}

impl fmt::Debug for Renewing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Renewing").field("term", &self.term).finish_non_exhaustive()
    }
}

impl Drop for Renewing {
    fn drop(&mut self) {
        self.end();
    }
}

impl EtcdWriter {
    pub(super) fn start(shared: Arc<Shared>, chain: Chain, renewing: Renewing) -> io::Result<EtcdWriter> {
        let head = shared.pending.appended();
        // The first step removed what is after the head.
        let writing = Writing { shared: shared.clone(), chain, head, step: 1 };
        let writing = thread::Builder::new().name("etcd-writer".to_owned()).spawn(move || writing.run())?;
        renewing.watched_by(&shared);
        Ok(EtcdWriter { shared, writing: Some(writing), compaction: None, renewing })
    }

    /// Writes what waits, gives up the place, and ends every thread. A compaction is abandoned: the next writer makes another one.
    fn end(&mut self) {
        self.shared.close();
        // A panic of a thread has stopped the log already, with a fault.
        let _ = self.writing.take().map(JoinHandle::join);
        self.renewing.end();
        let _ = self.compaction.take().map(JoinHandle::join);
        self.shared.pending.stop(&Fault::Closed);
    }
}

impl Writer for EtcdWriter {
    fn append(&mut self, record: &[u8]) -> Result<Position, AppendError> {
        let most = self.shared.bounds.record;
        if record.len() > most {
            return Err(AppendError::TooLarge { bytes: record.len(), most });
        }
        self.shared.pending.append(record, self.shared.bounds.buffered, false)
    }

    fn durable(&self) -> Durable {
        Durable::new(self.shared.pending.watch())
    }

    fn compact(&mut self, through: Position, snapshot: MakeSnapshot) -> Result<(), CompactError> {
        self.shared.pending.begin_compaction(through)?;
        if let Some(ended) = self.compaction.take() {
            // The thread has reported its end, so this waits only for its last instructions.
            let _ = ended.join();
        }
        let compaction = Compaction { shared: self.shared.clone(), through };
        let started = thread::Builder::new().name("etcd-compaction".to_owned()).spawn(move || compaction.run(snapshot));
        match started {
            Ok(thread) => self.compaction = Some(thread),
            Err(error) => {
                let place = self.shared.pending.place.clone();
                let source = Arc::new(error);
                let failure = CompactionFailure { through, action: "start a thread for", place, source };
                self.shared.pending.end_compaction(Err(Some(failure)));
            }
        }
        Ok(())
    }

    fn place(&self) -> Box<dyn Place> {
        Box::new(HeldPlace(self.shared.term.clone()))
    }

    fn attend(&mut self, turns: Turns) {
        let _ = self.renewing.turns.set(turns);
    }

    fn mark_unfinished(&mut self) -> Result<(), CopyError> {
        let term = &self.shared.term;
        let unfinished = put(term.keys.unfinished(), PART_OF_A_COPY);
        Ok(self.shared.change_snapshots(vec![unfinished, put(term.keys.meta(), text(&term.meta_of_a_copy()))])?)
    }

    fn mark_complete(&mut self, moved: &str) -> Result<(), CopyError> {
        let complete = put(self.shared.term.keys.unfinished(), moved.to_owned());
        Ok(self.shared.change_snapshots(vec![complete])?)
    }

    fn mark_whole(&mut self) -> Result<(), CopyError> {
        Ok(self.shared.change_snapshots(vec![delete(self.shared.term.keys.unfinished())])?)
    }

    fn mark_moved(&mut self, to: &str) -> Result<(), CopyError> {
        let moved = put(self.shared.term.keys.moved(), to.to_owned());
        self.shared.change_snapshots(vec![moved]).map_err(CopyError::SourceLost)
    }

    fn waiting_bytes(&self) -> usize {
        self.shared.pending.waiting_bytes()
    }

    fn close(mut self: Box<Self>) -> Result<Position, Fault> {
        let appended = self.shared.pending.appended();
        self.shared.close();
        if let Some(writing) = self.writing.take() {
            let _ = writing.join();
        }
        let fault = self.shared.pending.fault();
        self.end();
        fault.map_or(Ok(appended), Err)
    }
}

impl Drop for EtcdWriter {
    fn drop(&mut self) {
        self.end();
    }
}
