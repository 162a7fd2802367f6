//! What a core can use during a turn: the time, answers to callers, watches, and whether changes are allowed.

use super::Core;
use super::clock::Clock;
use super::may_speak::{MaySpeak, Speech};
use super::outbox::{MOST_HELD, SendAnswer, send_answer};
use super::watchers::{Watcher, Watchers};
use ratn_model::time::Timestamp;
use std::time::Instant;
use tokio::sync::{mpsc, oneshot};
use tonic::Status;

/// Something that is sent when the records that it depends on are on the disk.
pub(super) enum Outgoing<C: Core> {
    /// An answer to a request.
    Answer(SendAnswer),
    /// A new watcher; from here on it receives every update that it wants.
    Watcher(Watcher<C::Update>),
    /// What the state sends by itself.
    Said(C::Said),
}

/// Why changes are no longer possible.
#[derive(Debug)]
pub(crate) struct Stopped {
    /// The answer to requests that would change something.
    pub(crate) status: Status,
    /// Reads are refused as well: it is not known what is on the disk.
    pub(super) unreadable: bool,
}

/// See the module.
pub(crate) struct TurnContext<C: Core> {
    /// All watchers.
    pub(crate) watchers: Watchers<C::Update>,
    outgoing: Vec<Outgoing<C>>,
    stopped: Option<Stopped>,
    clock: Clock,
    may_speak: MaySpeak,
}

impl<C: Core> TurnContext<C> {
    pub(super) fn new(may_speak: MaySpeak) -> TurnContext<C> {
        let clock = Clock::start(Instant::now());
        TurnContext { watchers: Watchers::default(), outgoing: Vec::new(), stopped: None, clock, may_speak }
    }

    /// The time since the start, without the time in which the process was paused or was not allowed to send.
    pub(crate) fn now(&self) -> Timestamp {
        self.clock.at(Instant::now())
    }

    /// Whether sending is allowed at all ([`super::may_speak`]).
    pub(crate) fn may_speak(&self) -> bool {
        matches!(self.may_speak.now(), Speech::Allowed)
    }

    /// Why changes are no longer possible; `None` as long as they are.
    pub(crate) fn stopped(&self) -> Option<&Stopped> {
        self.stopped.as_ref()
    }

    /// Answers when the records that the answer depends on are on the disk.
    pub(crate) fn reply<T: Send + 'static>(
        &mut self,
        answer: oneshot::Sender<Result<T, Status>>,
        result: Result<T, Status>,
    ) {
        self.outgoing.push(Outgoing::Answer(send_answer(answer, result)));
    }

    /// As [`TurnContext::reply`], for an answer whose records have been on the disk for long: it is sent at once,
    /// before others that wait.
    pub(crate) fn reply_now<T: Send + 'static>(
        &mut self,
        answer: oneshot::Sender<Result<T, Status>>,
        result: Result<T, Status>,
    ) {
        if self.may_speak() {
            let _ = answer.send(result);
        } else {
            self.reply(answer, result);
        }
    }

    /// As [`TurnContext::reply`], for a request that only reads; where it gets no answer, its caller asks again.
    pub(crate) fn tell<T: Send + 'static>(&mut self, answer: oneshot::Sender<T>, told: T) {
        self.outgoing.push(Outgoing::Answer(Box::new(move |stopped| {
            if stopped.is_none() {
                let _ = answer.send(told);
            }
        })));
    }

    /// Queues what the state sends, behind everything that is queued already.
    pub(crate) fn say(&mut self, said: C::Said) {
        self.outgoing.push(Outgoing::Said(said));
    }

    /// Begins a watch with the current state, including changes that still wait for the disk; later updates follow.
    ///
    /// # Errors
    /// Where there are too many watches already.
    pub(crate) fn watch(&mut self, first: Vec<C::Update>) -> Result<mpsc::Receiver<C::Update>, Status> {
        self.watch_where(first, |_| true)
    }

    /// As [`TurnContext::watch`], limited to the updates that `wants` accepts.
    ///
    /// # Errors
    /// As [`TurnContext::watch`].
    pub(crate) fn watch_where(
        &mut self,
        first: Vec<C::Update>,
        wants: impl Fn(&C::Update) -> bool + Send + 'static,
    ) -> Result<mpsc::Receiver<C::Update>, Status> {
        let (watcher, updates) = Watcher::begin(first, wants)?;
        self.outgoing.push(Outgoing::Watcher(watcher));
        Ok(updates)
    }

    pub(super) fn instant(&self, at: Timestamp) -> Option<Instant> {
        self.clock.instant(at)
    }

    pub(super) fn is_full(&self) -> bool {
        self.outgoing.len() >= MOST_HELD
    }

    pub(super) fn begin_turn(&mut self) {
        let may_speak = self.may_speak();
        self.clock.look(Instant::now(), may_speak);
    }

    pub(super) fn speech(&mut self) -> &mut MaySpeak {
        &mut self.may_speak
    }

    pub(super) fn take_outgoing(&mut self) -> Vec<Outgoing<C>> {
        std::mem::take(&mut self.outgoing)
    }

    pub(super) fn stop(&mut self, stopped: Stopped) {
        self.stopped = Some(stopped);
    }

    pub(super) fn set_unreadable(&mut self) {
        if let Some(stopped) = &mut self.stopped {
            stopped.unreadable = true;
        }
    }
}
