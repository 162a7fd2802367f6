//! What a core can use during a turn: the time, the callers to answer, the watches, and whether changes are allowed.

use super::Core;
use super::clock::Clock;
use super::may_speak::{MaySpeak, Speech};
use super::outbox::{MOST_HELD, SendAnswer, send_answer};
use super::watchers::{Watcher, Watchers};
use ratn_model::time::Timestamp;
use std::time::Instant;
use tokio::sync::{mpsc, oneshot};
use tonic::Status;

/// Something that leaves when the records of what it tells of are on the disk.
pub(super) enum Outgoing<C: Core> {
    /// To one who asked.
    Answer(SendAnswer),
    /// From here on it sees every update that it wants.
    Watcher(Watcher<C::Update>),
    /// What the state has to say.
    Said(C::Said),
}

/// Why nothing changes any more.
#[derive(Debug)]
pub(crate) struct Stopped {
    /// What who asks for a change is told.
    pub(crate) status: Status,
    /// Nor is anything shown: it is not known what is on the disk.
    pub(super) unreadable: bool,
}

/// See the module.
pub(crate) struct TurnContext<C: Core> {
    /// Everybody who watches.
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

    /// The time since the start, without pauses of the process, and without the time in which it might say nothing.
    pub(crate) fn now(&self) -> Timestamp {
        self.clock.at(Instant::now())
    }

    /// Whether anything may be said at all ([`super::may_speak`]).
    pub(crate) fn may_speak(&self) -> bool {
        matches!(self.may_speak.now(), Speech::Allowed)
    }

    /// Why nothing may change any more; nothing as long as it may.
    pub(crate) fn stopped(&self) -> Option<&Stopped> {
        self.stopped.as_ref()
    }

    /// Answers when what the answer tells of is on the disk.
    pub(crate) fn reply<T: Send + 'static>(
        &mut self,
        answer: oneshot::Sender<Result<T, Status>>,
        result: Result<T, Status>,
    ) {
        self.outgoing.push(Outgoing::Answer(send_answer(answer, result)));
    }

    /// As [`TurnContext::reply`], of what has been on the disk for long: it leaves at once, past what waits.
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

    /// As [`TurnContext::reply`], to one who only looks; without an answer they ask again.
    pub(crate) fn tell<T: Send + 'static>(&mut self, answer: oneshot::Sender<T>, told: T) {
        self.outgoing.push(Outgoing::Answer(Box::new(move |stopped| {
            if stopped.is_none() {
                let _ = answer.send(told);
            }
        })));
    }

    /// What the state has to say, behind what was to be said before.
    pub(crate) fn say(&mut self, said: C::Said) {
        self.outgoing.push(Outgoing::Said(said));
    }

    /// Begins a watch with what is known now. What waits for the disk is in that; what comes later follows.
    ///
    /// # Errors
    /// Where so many watch already.
    pub(crate) fn watch(&mut self, first: Vec<C::Update>) -> Result<mpsc::Receiver<C::Update>, Status> {
        self.watch_where(first, |_| true)
    }

    /// As [`TurnContext::watch`], of the updates that are wanted.
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
