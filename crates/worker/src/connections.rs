//! The connections of a server: how many there are, whose, and how long one may say nothing.
//!
//! ```text
//!   accepted ── first call ──▶ in use ── no call under way ──▶ idle
//!      │ none in FIRST_CALL_DEADLINE                             │ none in IDLE_DEADLINE
//!      └──────────────────────────▶ closed ◀─────────────────────┘
//! ```
//! A handshake that does not end is a connection without a call. Connections are shared out in three ways:
//!
//! - Connections with calls under way are bounded for each caller, and for all callers that are no operators together. The rest
//!   ([`ConnectionLimits::for_operators`]) is kept for operators, and for connections that have not had a call yet.
//! - Where there are as many connections as may be, one without a call under way is closed for a new one (`State::gives_way`).
//! - A connection without a call is closed at its deadline.

use crate::access::Caller;
use crate::gate::Identity;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fmt;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::server::Connected;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Bounds of the connections of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// At once, whoever has them.
    pub connections: usize,
    /// Of one caller with calls under way.
    pub of_one_caller: usize,
    /// So many of `connections` never have calls under way of callers that are no operators. They are for operators, and for new
    /// connections.
    pub for_operators: usize,
    /// From being accepted to the first call, the handshake of TLS included.
    pub first_call: Duration,
    /// Without a call under way.
    pub idle: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> ConnectionLimits {
        ConnectionLimits {
            connections: 768,
            of_one_caller: 512,
            for_operators: 128,
            first_call: Duration::from_secs(10),
            idle: Duration::from_secs(600),
        }
    }
}

/// Why somebody has no connection more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OutOfConnections {
    /// All have calls under way: a new connection was closed.
    All,
    /// A caller has calls under way on as many as one may: the call was refused.
    OfOneCaller {
        /// Who.
        caller: Arc<str>,
        /// How many are allowed.
        most: usize,
    },
    /// All who are no operators have calls under way on as many as they may: the call was refused.
    OfOthers {
        /// How many are allowed.
        most: usize,
    },
}

/// How often it is looked for connections whose time is over.
const SWEEP_INTERVAL: Duration = Duration::from_millis(250);
/// When a caller with too many connections may try again.
const RETRY_DELAY: Duration = Duration::from_secs(1);

/// Those of one server. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Connections {
    limits: ConnectionLimits,
    state: Arc<Mutex<State>>,
}

/// What is known of the other end of a connection when it is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Peer {
    origin: Origin,
    /// Over a Unix socket the kernel says who it is; otherwise the first call does.
    is_operator: bool,
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Origin {
    User(u32),
    /// Of IPv6 the network, for a host has all of its addresses.
    Host(IpAddr),
    Unknown,
}

#[derive(Debug, Default)]
struct State {
    next: u64,
    open: BTreeMap<u64, Open>,
    /// Connections with calls under way, by the name of their caller.
    in_use: BTreeMap<Arc<str>, usize>,
    /// Connections with calls under way of callers that are no operators.
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
    /// Whom it is counted for while it is in use.
    caller: Option<Caller>,
}

impl OutOfConnections {
    /// In one word, for programs.
    pub fn reason(&self) -> &'static str {
        match self {
            OutOfConnections::All => "CONNECTIONS",
            OutOfConnections::OfOneCaller { .. } => "QUOTA_CONNECTIONS",
            OutOfConnections::OfOthers { .. } => "QUOTA_CONNECTIONS_OF_ALL",
        }
    }

    /// What the caller is told.
    pub(crate) fn status(&self) -> Status {
        let mut details = ErrorDetails::with_error_info(self.reason(), "ratn", []);
        details.set_retry_info(Some(RETRY_DELAY));
        Status::with_error_details(Code::ResourceExhausted, self.to_string(), details)
    }
}

impl fmt::Display for OutOfConnections {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (whose, most, key) = match self {
            OutOfConnections::All => return f.write_str("all connections have calls under way"),
            OutOfConnections::OfOneCaller { caller, most } => (&**caller, most, "connections_in_use"),
            OutOfConnections::OfOthers { most } => ("all who are no operators", most, "connections_for_operators"),
        };
        write!(f, "connections of {whose}: the quota of {most} with calls under way is reached (service.quotas.{key})")
    }
}

impl Peer {
    /// At a Unix socket.
    pub(crate) fn of_user(identity: &Identity, is_operator: bool) -> Peer {
        let origin = match identity {
            Identity::User { uid, .. } => Origin::User(*uid),
            Identity::Certificate { .. } | Identity::Anonymous => Origin::Unknown,
        };
        Peer { origin, is_operator }
    }

    /// At a TCP port; nothing where the connection has ended already.
    pub(crate) fn of_host(address: Option<IpAddr>) -> Peer {
        let origin = match address.map(|address| address.to_canonical()) {
            Some(IpAddr::V6(address)) => Origin::Host(IpAddr::V6((address.to_bits() & NETWORK_BITS).into())),
            Some(address) => Origin::Host(address),
            None => Origin::Unknown,
        };
        Peer { origin, is_operator: false }
    }
}

/// The part of an IPv6 address that names a network.
const NETWORK_BITS: u128 = !(u64::MAX as u128);

impl Connections {
    pub(crate) fn new(limits: ConnectionLimits) -> Connections {
        Connections { limits, state: Arc::default() }
    }

    /// One more; where there are too many, one without a call under way is closed for it. `None` where all have calls under way.
    pub(crate) fn accept<S>(&self, stream: S, peer: Peer) -> Option<Connection<S>> {
        let mut state = self.state();
        let there = state.open.values().filter(|open| !open.close.is_cancelled()).count();
        if there >= self.limits.connections {
            let close = state.gives_way(self.limits.for_operators)?;
            tracing::debug!(connections = there, "a connection that says nothing is closed for a new one");
            close.cancel();
        }
        let (id, close) = (state.next, CancellationToken::new());
        state.next += 1;
        let quiet_since = Instant::now();
        let open = Open { close: close.clone(), peer, quiet_since, had_a_call: false, calls: 0, caller: None };
        state.open.insert(id, open);
        drop(state);
        let link = Link { id, connections: self.clone() };
        let closed = Box::pin(close.cancelled_owned());
        Some(Connection { stream, closed, registered: Registered(link) })
    }

    /// Closes all that are still open.
    pub(crate) fn close_all(&self) {
        self.state().open.values().for_each(|open| open.close.cancel());
    }

    /// Closes those whose time is over, for as long as it is polled.
    pub(crate) async fn sweep(&self) -> Infallible {
        let mut interval = tokio::time::interval(SWEEP_INTERVAL);
        loop {
            interval.tick().await;
            let state = self.state();
            for open in state.open.values().filter(|open| open.calls == 0) {
                let patience = if open.had_a_call { self.limits.idle } else { self.limits.first_call };
                if open.quiet_since.elapsed() >= patience {
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
    /// What closes the connection that gives way to a new one.
    ///
    /// Operators' connections are the last to give way. As long as fewer than `share` connections have not had a call yet, an idle
    /// connection gives way, so that who connects has time to speak; otherwise one that has not had a call. Among equals it is one
    /// of the user or host with most of them, and of those the one that has said nothing for longest.
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

/// Which connection a request came over; among its extensions.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    id: u64,
    connections: Connections,
}

impl Link {
    /// A call begins: the connection is in use until what is returned is dropped.
    pub(crate) fn begin(&self, caller: &Caller) -> Result<InUse, OutOfConnections> {
        let limits = &self.connections.limits;
        let mut state = self.connections.state();
        let State { open, in_use, in_use_of_others, .. } = &mut *state;
        // One that is being closed: its calls end with it.
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

    /// A call that takes no share of the connections: the connection counts as idle from now on.
    pub(crate) fn touch(&self) {
        if let Some(open) = self.connections.state().open.get_mut(&self.id) {
            (open.quiet_since, open.had_a_call) = (Instant::now(), true);
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

/// A call is under way on a connection.
#[derive(Debug)]
pub(crate) struct InUse(Link);

impl Drop for InUse {
    fn drop(&mut self) {
        self.0.end(false);
    }
}

/// A connection that ends when its time is over.
#[derive(Debug)]
pub(crate) struct Connection<S> {
    stream: S,
    closed: Pin<Box<WaitForCancellationFutureOwned>>,
    registered: Registered,
}

#[derive(Debug)]
struct Registered(Link);

impl Drop for Registered {
    fn drop(&mut self) {
        self.0.end(true);
    }
}

/// What is known of a connection: what the system says, and which it is.
#[derive(Debug, Clone)]
pub(crate) struct LinkInfo<I> {
    pub(crate) info: I,
    pub(crate) link: Link,
}

impl<S: Connected> Connected for Connection<S> {
    type ConnectInfo = LinkInfo<S::ConnectInfo>;

    fn connect_info(&self) -> Self::ConnectInfo {
        LinkInfo { info: self.stream.connect_info(), link: self.registered.0.clone() }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.closed.as_mut().poll(context).is_ready() {
            return Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "nothing was asked for too long")));
        }
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;
    use tokio::io::{AsyncReadExt, DuplexStream, duplex};

    fn limits() -> ConnectionLimits {
        ConnectionLimits { connections: 3, of_one_caller: 2, for_operators: 0, ..ConnectionLimits::default() }
    }

    fn link(connection: &Connection<DuplexStream>) -> Link {
        connection.registered.0.clone()
    }

    fn user(uid: u32, role: Role) -> Caller {
        Caller { name: format!("uid {uid}").into(), roles: [role].as_slice().into() }
    }

    fn host(number: u8) -> Peer {
        Peer::of_host(Some([10, 0, 0, number].into()))
    }

    /// An open connection with its other end.
    fn accept(connections: &Connections, peer: Peer) -> Option<(Connection<DuplexStream>, DuplexStream)> {
        let (near, far) = duplex(1);
        connections.accept(near, peer).map(|near| (near, far))
    }

    async fn is_closed((connection, _far): &mut (Connection<DuplexStream>, DuplexStream)) -> bool {
        let mut byte = [0];
        let read = tokio::time::timeout(Duration::from_millis(1), connection.read(&mut byte)).await;
        read.is_ok_and(|read| read.is_err())
    }

    #[tokio::test]
    async fn who_says_nothing_gives_way_the_longest_first_and_who_has_a_call_stays() {
        let connections = Connections::new(limits());
        let mut open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
        let users = [1, 2, 3].map(|uid| user(uid, Role::Viewer));
        let call = link(&open[0].0).begin(&users[0]).unwrap();
        assert!(!is_closed(&mut open[1]).await, "as many as may be");
        open.push(accept(&connections, host(1)).unwrap());
        assert!(is_closed(&mut open[1]).await && !is_closed(&mut open[0]).await && !is_closed(&mut open[2]).await);
        let others = [link(&open[2].0).begin(&users[1]).unwrap(), link(&open[3].0).begin(&users[2]).unwrap()];
        drop(open.remove(1));
        assert!(accept(&connections, host(1)).is_none(), "all have something to do");
        drop((call, others));
        assert!(accept(&connections, host(1)).is_some());
    }

    #[tokio::test]
    async fn one_caller_has_its_share_of_connections_and_the_refusal_says_whose() {
        let connections = Connections::new(limits());
        let (caller, other) = (user(7, Role::Task), user(8, Role::Task));
        let open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
        let first = link(&open[0].0).begin(&caller).unwrap();
        let again = link(&open[0].0).begin(&caller).unwrap();
        let _second = link(&open[1].0).begin(&caller).unwrap();
        let refused = link(&open[2].0).begin(&caller).unwrap_err();
        assert!(refused.to_string().contains("connections of uid 7: the quota of 2"), "{refused}");
        assert!(link(&open[2].0).begin(&other).is_ok());
        drop(first);
        assert!(link(&open[2].0).begin(&caller).is_err(), "one call is left on the first");
        drop(again);
        assert!(link(&open[2].0).begin(&caller).is_ok());
    }

    #[tokio::test]
    async fn callers_that_are_no_operators_leave_the_operators_share() {
        let limits = ConnectionLimits { connections: 8, of_one_caller: 3, for_operators: 4, ..limits() };
        let connections = Connections::new(limits);
        let mut calls = Vec::new();
        let mut open = Vec::new();
        for uid in [1, 1, 1, 2] {
            open.push(accept(&connections, host(1)).unwrap());
            calls.push(link(&open[open.len() - 1].0).begin(&user(uid, Role::Task)).unwrap());
        }
        open.push(accept(&connections, host(1)).unwrap());
        let refused = link(&open[4].0).begin(&user(2, Role::Task)).unwrap_err();
        assert!(refused.to_string().contains("all who are no operators: the quota of 4"), "{refused}");
        assert!(link(&open[4].0).begin(&user(0, Role::Operator)).is_ok());
        // However many more connect.
        for _ in 0..50 {
            open.push(accept(&connections, host(1)).unwrap());
        }
        open.push(accept(&connections, host(2)).unwrap());
        open.push(accept(&connections, host(1)).unwrap());
        let operators = open.len() - 2;
        assert!(!is_closed(&mut open[operators]).await, "the host with most connections gives way");
        assert!(link(&open[operators].0).begin(&user(0, Role::Operator)).is_ok());
        calls.pop();
        let last = open.len() - 1;
        assert!(link(&open[last].0).begin(&user(2, Role::Task)).is_ok());
    }

    #[tokio::test]
    async fn idle_connections_leave_a_share_to_those_that_have_not_spoken_yet() {
        let connections = Connections::new(ConnectionLimits { connections: 4, for_operators: 2, ..limits() });
        let mut open: Vec<_> = (0..4).map(|_| accept(&connections, host(1)).unwrap()).collect();
        for (connection, _) in &open {
            drop(link(connection).begin(&user(1, Role::Task)).unwrap());
        }
        open.extend((0..2).map(|_| accept(&connections, host(2)).unwrap()));
        assert!(is_closed(&mut open[0]).await && is_closed(&mut open[1]).await && !is_closed(&mut open[4]).await);
        open.push(accept(&connections, host(2)).unwrap());
        assert!(is_closed(&mut open[4]).await && !is_closed(&mut open[2]).await, "the share is used up");
    }

    #[tokio::test]
    async fn a_connection_that_the_kernel_names_as_an_operators_gives_way_last() {
        let connections = Connections::new(limits());
        let peer = |uid, is_operator| Peer::of_user(&Identity::User { uid, pid: None }, is_operator);
        let mut operators = accept(&connections, peer(0, true)).unwrap();
        let mut others = Vec::new();
        for _ in 0..20 {
            others.push(accept(&connections, peer(7, false)).unwrap());
        }
        assert!(!is_closed(&mut operators).await);
        assert!(is_closed(&mut others[0]).await);
    }

    #[test]
    fn a_host_is_known_by_its_address_and_of_ipv6_by_its_network() {
        let peer = |text: &str| Peer::of_host(Some(text.parse().unwrap()));
        assert_eq!(peer("fd00:1:2:3::1"), peer("fd00:1:2:3:ffff::9"));
        assert_ne!(peer("fd00:1:2:3::1"), peer("fd00:1:2:4::1"));
        assert_eq!(peer("::ffff:10.0.0.1"), peer("10.0.0.1"));
        assert_ne!(peer("10.0.0.2"), peer("10.0.0.1"));
    }

    #[tokio::test]
    async fn a_connection_without_a_call_is_closed_at_its_deadline() {
        let connections = Connections::new(ConnectionLimits {
            first_call: Duration::ZERO,
            idle: Duration::from_secs(3_600),
            ..limits()
        });
        let mut open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
        drop(link(&open[1].0).begin(&user(1, Role::Viewer)).unwrap());
        link(&open[2].0).touch();
        let _ = tokio::time::timeout(SWEEP_INTERVAL, connections.sweep()).await;
        assert!(is_closed(&mut open[0]).await);
        assert!(!is_closed(&mut open[1]).await && !is_closed(&mut open[2]).await, "they have longer");
    }
}
