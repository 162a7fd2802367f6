//! What the clients of one round asked and were told, with times of the machine's monotonic clock, which all processes share.

use super::search::Timed;
use nix::time::{ClockId, clock_gettime};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The client's number.
pub(crate) type Session = usize;
/// Thousandths, by resource.
pub(crate) type Amounts = BTreeMap<String, u64>;

/// A call's end when there is none.
pub(crate) const NEVER: u64 = u64::MAX;

/// What a call was answered.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Done {
    /// The session lives for `ttl` nanoseconds more.
    Pinged { ttl: u64, created: bool },
    /// A lease.
    Granted { request: String, token: u64, held: Amounts },
    /// Whether the lease was released by this.
    Released { token: u64, released: bool },
    /// Whether an acquire was undone by this. `sure` where the call was answered at the first attempt.
    Withdrawn { request: String, withdrawn: bool, sure: bool },
    /// Of `C` so much was consumed for good.
    Consumed { amount: u64 },
    /// A resource of the kind `M`, the session's own.
    Created { resource: String },
    /// Whether it was there.
    Deleted { resource: String, there: bool },
    /// The whole pool at one moment.
    Seen { pool: BTreeMap<String, Shown> },
}

/// A resource as the manager shows it.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Shown {
    pub(crate) free: u64,
    /// What is held, by token.
    pub(crate) held: BTreeMap<u64, u64>,
}

/// A call of a session.
#[derive(Debug, Clone)]
pub(crate) struct Call {
    pub(crate) session: Session,
    pub(crate) done: Done,
}

/// When an acquire may be granted without its client hearing of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asked {
    pub(crate) session: Session,
    pub(crate) begin: u64,
    pub(crate) until: u64,
}

/// A grant, as an answer, a list or a watch shows it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Grant {
    pub(crate) session: String,
    pub(crate) request: String,
    pub(crate) lease: u64,
    pub(crate) held: Amounts,
}

/// A lease of the tool, as its holder knows it.
#[derive(Debug, Clone)]
pub(crate) struct ToolHold {
    pub(crate) session: Session,
    pub(crate) token: u64,
    /// When the answer was there.
    pub(crate) granted: u64,
    /// When its release was first asked for.
    pub(crate) released: u64,
}

/// Everything of one round.
#[derive(Debug, Default)]
pub(crate) struct History {
    pub(crate) threads: Vec<Vec<Timed<Call>>>,
    /// Calls that may have had an effect: each at most once, after its beginning, or never.
    pub(crate) perhaps: Vec<Timed<Call>>,
    /// When each session was pinged without an answer for the first time.
    pub(crate) pinged: BTreeMap<Session, u64>,
    pub(crate) asked: BTreeMap<String, Asked>,
    /// By token.
    pub(crate) grants: BTreeMap<u64, Grant>,
    pub(crate) holds: Vec<ToolHold>,
    /// A watch saw the tool vanish.
    pub(crate) tool_vanished: bool,
    /// What is wrong by itself.
    pub(crate) failures: BTreeSet<String>,
    pub(crate) counts: BTreeMap<&'static str, usize>,
}

/// Shared by the clients of a round.
#[derive(Debug, Default)]
pub(crate) struct Record(Mutex<History>);

impl Record {
    pub(crate) fn open(&self) -> MutexGuard<'_, History> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A call of a thread that has its answer now.
    pub(crate) fn answered(&self, thread: usize, session: Session, begin: u64, done: Done) {
        let timed = Timed { begin, end: now(), call: Call { session, done } };
        self.open().threads[thread].push(timed);
    }

    /// A call that may have been done.
    pub(crate) fn perhaps(&self, session: Session, begin: u64, done: Done) {
        self.open().perhaps.push(Timed { begin, end: NEVER, call: Call { session, done } });
    }

    pub(crate) fn failed(&self, what: String) {
        self.open().failures.insert(what);
    }

    pub(crate) fn count(&self, what: &'static str) {
        *self.open().counts.entry(what).or_default() += 1;
    }

    /// A grant that somebody saw. Two that differ under one token are wrong.
    pub(crate) fn saw(&self, token: u64, seen: Grant) {
        let mut history = self.open();
        let known = history.grants.entry(token).or_insert_with(|| seen.clone());
        let other = known.lease != seen.lease || known.session != seen.session || known.request != seen.request;
        // Of a lease of several resources a watch tells one by one, and of one that lost some a list shows the rest.
        known.held.extend(seen.held.clone());
        if other {
            let known = known.clone();
            history.failures.insert(format!("token {token} is of two grants: {known:?} and {seen:?}"));
        }
    }
}

/// Nanoseconds of the machine.
pub(crate) fn now() -> u64 {
    let time = clock_gettime(ClockId::CLOCK_MONOTONIC).map(|time| (time.tv_sec(), time.tv_nsec()));
    let (seconds, nanoseconds) = time.expect("there is such a clock");
    seconds.unsigned_abs() * 1_000_000_000 + nanoseconds.unsigned_abs()
}
