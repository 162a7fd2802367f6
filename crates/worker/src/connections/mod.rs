//! The connections of a server: their number, their owners, and how long they may be idle.
//!
//! ```text
//!   accepted ── first call ──▶ in use ── no call under way ──▶ idle
//!      │ none in FIRST_CALL_DEADLINE                             │ none in IDLE_DEADLINE
//!      └──────────────────────────▶ closed ◀─────────────────────┘
//! ```
//! A connection whose handshake does not end counts as one without a call. Connections are limited in four ways:
//!
//! - Each user or host may open a limited number per second (`rates`). Connections are accepted in a thread of its own (`accepting`), so
//!   that a client that connects all the time delays no client that is connected.
//! - The number of connections with calls under way is bounded per caller, and for all callers that are not operators together. The rest
//!   ([`ConnectionLimits::for_operators`]) is reserved for operators, and for connections without a first call.
//! - If the maximum number is reached, a connection without a call under way is closed for a new one (`State::gives_way`).
//! - A connection without a call is closed at its deadline, and so is one whose client takes nothing of the answers that wait for it.

pub(crate) mod accepting;
mod authority;
mod limits;
mod origin;
mod rates;
mod stream;
#[cfg(test)]
mod tests;

pub use limits::{ConnectionLimits, OutOfConnections};
pub use origin::Origin;
pub(crate) use origin::Peer;
pub(crate) use stream::{Connection, LinkInfo};

use crate::access::Caller;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use stream::Registered;
use tokio_util::sync::CancellationToken;

/// Interval between two searches for connections whose deadline has passed.
const SWEEP_INTERVAL: Duration = Duration::from_millis(250);
/// The connections of one server. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Connections {
    limits: ConnectionLimits,
    state: Arc<Mutex<State>>,
}

#[derive(Debug, Default)]
struct State {
    next: u64,
    open: BTreeMap<u64, Open>,
    /// Connections with calls under way, by the name of their caller.
    in_use: BTreeMap<Arc<str>, usize>,
    /// Connections with calls under way of callers that are not operators.
    in_use_of_others: usize,
}

#[derive(Debug)]
struct Open {
    close: CancellationToken,
    peer: Peer,
    /// Since when no call is under way.
    quiet_since: Instant,
    had_a_call: bool,
    calls: usize,
    /// Parts of answers that wait for the client.
    unread: usize,
    /// Since when the client has taken nothing of them.
    unread_since: Instant,
    /// The caller for whom the connection is counted while it is in use.
    caller: Option<Caller>,
}

impl Connections {
    pub(crate) fn new(limits: ConnectionLimits) -> Connections {
        Connections { limits, state: Arc::default() }
    }

    /// Adds a connection; if there are too many, closes one without a call under way for it. If all have calls under way, the new stream is
    /// returned as the error.
    pub(crate) fn accept<S>(&self, stream: S, peer: Peer) -> Result<Connection<S>, S> {
        let mut state = self.state();
        let there = state.open.values().filter(|open| !open.close.is_cancelled()).count();
        if there >= self.limits.connections {
            let Some(close) = state.gives_way(self.limits.for_operators) else { return Err(stream) };
            tracing::debug!(connections = there, "a connection that says nothing is closed for a new one");
            close.cancel();
        }
        let (id, close) = (state.next, CancellationToken::new());
        state.next += 1;
        let now = Instant::now();
        let open = Open {
            close: close.clone(),
            peer,
            quiet_since: now,
            had_a_call: false,
            calls: 0,
            unread: 0,
            unread_since: now,
            caller: None,
        };
        state.open.insert(id, open);
        drop(state);
        let link = Link { id, connections: self.clone() };
        let closed = Box::pin(close.cancelled_owned());
        Ok(Connection { stream, closed, registered: Registered(link), authority: None })
    }

    /// Closes all open connections.
    pub(crate) fn close_all(&self) {
        self.state().open.values().for_each(|open| open.close.cancel());
    }

    /// Closes connections whose deadline has passed, for as long as it is polled.
    pub(crate) async fn sweep(&self) -> Infallible {
        let mut interval = tokio::time::interval(SWEEP_INTERVAL);
        loop {
            interval.tick().await;
            let state = self.state();
            for open in state.open.values().filter(|open| !open.close.is_cancelled()) {
                let patience = if open.had_a_call { self.limits.idle } else { self.limits.first_call };
                if open.calls == 0 && open.quiet_since.elapsed() >= patience {
                    open.close.cancel();
                } else if open.unread > 0 && open.unread_since.elapsed() >= self.limits.unread {
                    let who = open.caller.as_ref().map_or("", |caller| &*caller.name);
                    tracing::info!(
                        who,
                        parts = open.unread,
                        "a connection is closed: its client does not read its answers"
                    );
                    open.close.cancel();
                }
            }
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// The token that closes the connection that gives way to a new one.
    ///
    /// Operators' connections give way last. As long as fewer than `share` connections have not had a call yet, an idle connection gives
    /// way, so that a new client has time for its first call; otherwise a connection that has not had a call. Among equals it is a
    /// connection of the user or host with the most of them, and among those the one without a call for the longest time.
    fn gives_way(&self, share: usize) -> Option<CancellationToken> {
        let quiet = || self.open.values().filter(|open| open.calls == 0 && !open.close.is_cancelled());
        let mut of_origin = BTreeMap::<_, usize>::new();
        for open in quiet() {
            *of_origin.entry((open.had_a_call, open.peer.origin)).or_default() += 1;
        }
        let silent: usize = of_origin.iter().filter(|((had_a_call, _), _)| !had_a_call).map(|(_, count)| count).sum();
        let idle_first = silent < share;
        let order = |open: &&Open| {
            let count = of_origin.get(&(open.had_a_call, open.peer.origin));
            (open.peer.is_operator, open.had_a_call != idle_first, Reverse(count.copied()), open.quiet_since)
        };
        quiet().min_by_key(order).map(|open| open.close.clone())
    }
}

/// The connection that a request came over; stored in the request's extensions.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    id: u64,
    connections: Connections,
}

impl Link {
    /// A call begins: the connection counts as in use until the returned value is dropped.
    pub(crate) fn begin(&self, caller: &Caller) -> Result<InUse, OutOfConnections> {
        let limits = &self.connections.limits;
        let mut state = self.connections.state();
        let State { open, in_use, in_use_of_others, .. } = &mut *state;
        // The connection is being closed, and its calls end with it.
        let Some(open) = open.get_mut(&self.id) else { return Ok(InUse(self.clone())) };
        if open.calls == 0 {
            let of_others = limits.connections.saturating_sub(limits.for_operators);
            let of_this = in_use.get(&caller.name).copied().unwrap_or_default();
            if of_this >= limits.of_one_caller {
                return Err(OutOfConnections::OfOneCaller { caller: caller.name.clone(), most: limits.of_one_caller });
            }
            if !caller.is_operator() && *in_use_of_others >= of_others {
                return Err(OutOfConnections::OfOthers { most: of_others });
            }
            in_use.insert(caller.name.clone(), of_this + 1);
            *in_use_of_others += usize::from(!caller.is_operator());
            open.peer.is_operator = caller.is_operator();
            open.caller = Some(caller.clone());
        }
        open.calls += 1;
        open.had_a_call = true;
        Ok(InUse(self.clone()))
    }

    /// Records a call that does not count as use of the connection: the idle time starts anew.
    pub(crate) fn touch(&self) {
        if let Some(open) = self.connections.state().open.get_mut(&self.id) {
            (open.quiet_since, open.had_a_call) = (Instant::now(), true);
        }
    }

    /// A part of an answer waits for the client until the returned value is dropped.
    pub(crate) fn waits(&self) -> Waits {
        if let Some(open) = self.connections.state().open.get_mut(&self.id) {
            if open.unread == 0 {
                open.unread_since = Instant::now();
            }
            open.unread += 1;
        }
        Waits(self.clone())
    }

    /// The client takes something of what waits for it.
    pub(crate) fn takes(&self) {
        if let Some(open) = self.connections.state().open.get_mut(&self.id) {
            open.unread_since = Instant::now();
        }
    }

    /// How many parts wait, and since when the client has taken nothing.
    #[cfg(test)]
    pub(crate) fn unread(&self) -> Option<(usize, Instant)> {
        self.connections.state().open.get(&self.id).map(|open| (open.unread, open.unread_since))
    }

    fn taken(&self) {
        if let Some(open) = self.connections.state().open.get_mut(&self.id) {
            (open.unread, open.unread_since) = (open.unread.saturating_sub(1), Instant::now());
        }
    }

    fn end(&self, all: bool) {
        let mut state = self.connections.state();
        let State { open, in_use, in_use_of_others, .. } = &mut *state;
        let Some(known) = open.get_mut(&self.id) else { return };
        known.calls = if all { 0 } else { known.calls.saturating_sub(1) };
        if known.calls == 0 {
            known.quiet_since = Instant::now();
            if let Some(caller) = known.caller.take() {
                *in_use_of_others -= usize::from(!caller.is_operator());
                if let Some(count) = in_use.get_mut(&caller.name) {
                    *count = count.saturating_sub(1);
                    if *count == 0 {
                        in_use.remove(&caller.name);
                    }
                }
            }
        }
        if all {
            open.remove(&self.id);
        }
    }
}

/// Marks a call as under way on a connection.
#[derive(Debug)]
pub(crate) struct InUse(Link);

impl Drop for InUse {
    fn drop(&mut self) {
        self.0.end(false);
    }
}

/// Marks a part of an answer that waits for the client of a connection.
#[derive(Debug)]
pub(crate) struct Waits(Link);

impl Drop for Waits {
    fn drop(&mut self) {
        self.0.taken();
    }
}
