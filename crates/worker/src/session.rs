//! A session with the resource manager: kept alive in the background, continued after a broken connection, made again when the manager has
//! forgotten it. Then everything that the session owned is gone, and [`SessionState::generation`] grows. The client notices that by the
//! number that the manager gives each session that it makes, even if the answer that said `created` was lost with its connection.
//!
//! ```text
//! open ─→ not alive ─ ping answered ─→ alive ─ no answer for a TTL ─→ not alive
//!                                      └─ answer: `created`, or another number ─→ alive, next generation
//! not alive ─ answer: known ─→ alive, the same generation: a manager that was suspended, or away, has kept it
//! ```
//! A session whose id belongs to another caller does not come back ([`Session::taken`]): its client has to use a session of another id.

use crate::boot_clock::{BootClock, BootInstant};
use crate::client::{Channels, fresh_id};
use crate::endpoint::Endpoint;
use crate::panic::exit_on_panic;
use crate::trace::Traced;
use ratn_panic_point::panic_point;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use std::ops::RangeInclusive;
use std::time::{Duration, SystemTime};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tonic_types::StatusExt;

/// Default time to live: how long a session lives without a ping.
pub const DEFAULT_TTL: Duration = Duration::from_secs(3);

/// A manager that is not heard for this many further times to live, after the first, is given up.
pub const GIVEN_UP_AFTER: u32 = 3;
/// A session is pinged this many times per time to live.
const PINGS_PER_TTL: u32 = 4;
/// Pause before a reconnect; it grows from the first value to the second.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(500));
/// The reason code of a refusal because the session belongs to another caller.
const NOT_YOURS: &str = "NOT_YOURS";
/// Time limit for the last ping, which ends the session.
const FAREWELL: Duration = Duration::from_millis(200);

/// A session that is kept alive until this handle is closed or dropped.
#[derive(Debug)]
pub struct Session {
    id: String,
    endpoint: Endpoint,
    ttl: Duration,
    state: watch::Receiver<SessionState>,
    belief: Belief,
    end: CancellationToken,
    task: Option<JoinHandle<()>>,
}

/// The standing of a session's client among others that want the same resources.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Standing {
    /// The client's share, relative to the shares of others: from 0.01 to 100, usually 1.
    pub share: f64,
    /// The deadline of its task, if any.
    pub due: Option<SystemTime>,
}

impl Default for Standing {
    fn default() -> Standing {
        Standing { share: 1.0, due: None }
    }
}

impl Standing {
    /// The allowed shares.
    pub const SHARES: RangeInclusive<f64> = 0.01..=100.0;

    /// Milliseconds until the deadline of its task; negative if it has passed.
    pub fn due_in_ms(&self, now: SystemTime) -> Option<i64> {
        let whole = |time: Duration| i64::try_from(time.as_millis()).unwrap_or(i64::MAX);
        self.due.map(|due| due.duration_since(now).map_or_else(|passed| -whole(passed.duration()), whole))
    }
}

/// The state of a session.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SessionState {
    /// The manager has answered a ping within the time to live.
    pub alive: bool,
    /// How often the manager has made the session. When it grows, everything that the session owned and held is gone.
    pub generation: u64,
    /// When this client found the session to have expired; `None` while the session is alive, or was never alive.
    pub unheard_since: Option<Instant>,
    /// The manager already knew the session at the first ping that was answered: the session goes on with what it has there. Never so for a session
    /// whose id is new ([`Session::open`]), because no process before this one had it.
    pub found: bool,
    /// The session's number at the manager: a session that is made again under the same id has another one. 0 before the session was alive,
    /// and if the manager does not number its sessions.
    pub number: u64,
    /// The manager's last answer was that the id belongs to another caller, who has a session of that id or had the last one
    /// ([`Session::taken`]).
    pub taken: bool,
}

/// Whether a process before this one may have had the session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Predecessor {
    /// None: the id is new.
    None,
    /// It may: the id was given.
    Unknown,
}

/// Until when a client believes that its session lives: the time to live counted from the last answered ping, including time in which the
/// machine was suspended. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Belief {
    now: watch::Receiver<Believed>,
    clock: BootClock,
}

/// What an answer says: one value, so that nobody sees the renewed time without the loss that came with it.
#[derive(Debug, Clone, Copy)]
struct Believed {
    /// The session lives until then.
    until: BootInstant,
    /// As [`SessionState::generation`].
    generation: u64,
}

/// The session was not alive within the deadline.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the resource manager at {endpoint} opened no session within {waited_s:.1} s; {}", self.next())]
pub struct SessionError {
    /// The resource manager's endpoint.
    pub endpoint: Endpoint,
    /// The session's id, if it belongs to another caller.
    pub taken: Option<String>,
    /// The deadline, in seconds.
    pub waited_s: f64,
}

impl SessionError {
    fn next(&self) -> String {
        match &self.taken {
            Some(id) => {
                format!("the id `{id}` is another caller's: ask as that caller, as an operator, or for another id")
            }
            None => "is it running?".to_owned(),
        }
    }
}

impl Session {
    /// Opens a session with the resource manager at `endpoint` and keeps it alive. `client` is a name for people, `ttl` the time to live:
    /// without a ping for so long, the manager ends the session. Returns at once; [`Session::alive`] waits.
    pub fn open(channels: &Channels, endpoint: &Endpoint, client: &str, ttl: Duration) -> Session {
        let id = (fresh_id(client), Standing::default());
        Session::keep(BootClock::default(), channels, endpoint, id, client, ttl, Predecessor::None)
    }

    /// As [`Session::open`], with an id of the caller's choice. If the client of a session with this id is gone and the session still
    /// lives, it goes on. No other caller may use the id.
    pub fn open_as(channels: &Channels, endpoint: &Endpoint, id: String, client: &str, ttl: Duration) -> Session {
        Session::open_by(BootClock::default(), channels, endpoint, id, client, ttl)
    }

    /// As [`Session::open_as`], with the client's standing among others.
    pub fn open_beside(
        channels: &Channels,
        endpoint: &Endpoint,
        id: String,
        client: &str,
        ttl: Duration,
        standing: Standing,
    ) -> Session {
        Session::keep(BootClock::default(), channels, endpoint, (id, standing), client, ttl, Predecessor::Unknown)
    }

    /// As [`Session::open_as`], with this clock.
    pub fn open_by(
        clock: BootClock,
        channels: &Channels,
        endpoint: &Endpoint,
        id: String,
        client: &str,
        ttl: Duration,
    ) -> Session {
        Session::keep(clock, channels, endpoint, (id, Standing::default()), client, ttl, Predecessor::Unknown)
    }

    fn keep(
        clock: BootClock,
        channels: &Channels,
        endpoint: &Endpoint,
        (id, standing): (String, Standing),
        client: &str,
        ttl: Duration,
        predecessor: Predecessor,
    ) -> Session {
        let end = CancellationToken::new();
        let (tell, state) = watch::channel(SessionState::default());
        let (believes, now) = watch::channel(Believed { until: clock.now(), generation: 0 });
        let belief = Belief { now, clock: clock.clone() };
        let keeper = SessionTask {
            clock,
            number: None,
            channels: channels.clone(),
            endpoint: endpoint.clone(),
            id: id.clone(),
            client: client.to_owned(),
            standing,
            predecessor,
            ttl,
            believes,
            tell,
            end: end.clone(),
        };
        let task = Some(tokio::spawn(exit_on_panic("the task that keeps a session alive", keeper.keep())));
        Session { id, endpoint: endpoint.clone(), ttl, state, belief, end, task }
    }

    /// The session's id.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The state of the session, and every change of it.
    pub fn state(&self) -> watch::Receiver<SessionState> {
        self.state.clone()
    }

    /// The time until which this client trusts its session.
    pub(crate) fn belief(&self) -> Belief {
        self.belief.clone()
    }

    /// Returns when the session is alive.
    ///
    /// # Errors
    /// [`SessionError`] if it is not alive within `deadline`.
    pub async fn alive(&self, deadline: Duration) -> Result<(), SessionError> {
        let mut state = self.state.clone();
        let alive = timeout(deadline, state.wait_for(|state| state.alive)).await;
        if matches!(alive, Ok(Ok(_))) {
            return Ok(());
        }
        let taken = self.state.borrow().taken.then(|| self.id.clone());
        Err(SessionError { endpoint: self.endpoint.clone(), taken, waited_s: deadline.as_secs_f64() })
    }

    /// Returns when everything that the session owned or held may belong to another client: the manager has not answered for the time to
    /// live, or has made the session again since the call. A session that was never alive is waited for first. For a client that has to
    /// stop then; the manager may still know the session ([`Session::gone`]).
    pub async fn lost(&self) {
        let mut state = self.state.clone();
        if state.borrow().unheard_since.is_some() {
            return;
        }
        let Ok(generation) = state.wait_for(|s| s.alive).await.map(|s| s.generation) else { return };
        let _ = state.wait_for(|s| !s.alive || s.generation != generation).await;
    }

    /// Returns when everything that the session owned or held is gone for good: the manager has made the session again, or has not answered
    /// for [`GIVEN_UP_AFTER`] further times to live after the session had expired here. Counts from the session's beginning.
    pub async fn gone(&self) {
        gone(self.state.clone(), self.ttl).await;
    }

    /// A handle that tells whether the session still has what it had: for a separate task that does what only the holder of its leases may
    /// do.
    pub fn trust(&self) -> Trust {
        Trust { state: self.state.clone(), belief: self.belief.clone(), ttl: self.ttl }
    }

    /// Returns when the manager says that the session's id belongs to another caller. Everything that the session owned or held is gone, or
    /// ends with its time to live, and a retry does not help. For a client that can go on with a session of another id. A client that
    /// provides resources must not conclude that they stand still: it has to start its provider anew
    /// ([`crate::provider::Provider::start_at_rest`]).
    pub async fn taken(&self) {
        if self.state.clone().wait_for(|state| state.taken).await.is_err() {
            // The session has been closed.
            std::future::pending().await
        }
    }

    /// As [`Session::lost`], but returns `margin` before the manager may end the session: in time to end what only the holder of its leases
    /// may do.
    pub async fn nearly_lost(&self, margin: Duration) {
        let nearly = async {
            let mut state = self.state.clone();
            if state.wait_for(|state| state.alive).await.is_ok() {
                self.belief().nearly_ended(margin).await;
            }
        };
        tokio::select! {
            () = nearly => {}
            () = self.lost() => {}
        }
    }

    /// Stops pinging without telling the manager: the session keeps what it owns and holds until its time to live has passed.
    pub async fn abandon(mut self) {
        if let Some(task) = self.task.take() {
            task.abort();
            let _ = task.await;
        }
    }

    /// Ends the session at the manager: everything that it holds is free at once.
    pub async fn close(mut self) {
        self.end.cancel();
        if let Some(task) = self.task.take() {
            let _ = task.await;
        }
    }
}

/// Tells whether a session still has what it had. Clones share everything.
#[derive(Debug, Clone)]
pub struct Trust {
    state: watch::Receiver<SessionState>,
    belief: Belief,
    ttl: Duration,
}

impl Trust {
    /// Whether everything that the session owned and held is still its own. While that is unknown (the manager is not heard, or this
    /// process was suspended), it waits. What counts as gone is defined at [`Session::gone`].
    pub async fn is_kept(&mut self) -> bool {
        loop {
            let Believed { until, generation } = *self.belief.now.borrow_and_update();
            if self.belief.clock.now() < until {
                return generation <= 1;
            }
            tokio::select! {
                changed = self.belief.now.changed() => if changed.is_err() {
                    return false;
                },
                () = gone(self.state.clone(), self.ttl) => return false,
            }
        }
    }

    /// Returns when everything is gone for good, as [`Session::gone`] does.
    pub async fn gone(&self) {
        gone(self.state.clone(), self.ttl).await;
    }
}

/// As [`Session::gone`].
async fn gone(mut state: watch::Receiver<SessionState>, ttl: Duration) {
    loop {
        let now = *state.borrow_and_update();
        if now.generation > 1 {
            return;
        }
        let given_up = async {
            match now.unheard_since {
                Some(since) => tokio::time::sleep_until(since + ttl * GIVEN_UP_AFTER).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            changed = state.changed() => if changed.is_err() {
                return;
            },
            () = given_up => return,
        }
    }
}

impl Belief {
    /// Whether the session is believed to live now. For code that cannot rely on a timer, which stands still while the machine is
    /// suspended.
    pub(crate) fn holds(&self) -> bool {
        self.clock.now() < self.now.borrow().until
    }

    /// Returns `margin` before the belief ends, unless it is renewed before.
    async fn nearly_ended(mut self, margin: Duration) {
        loop {
            let at = self.now.borrow_and_update().until.saturating_sub(margin);
            tokio::select! {
                biased;
                changed = self.now.changed() => if changed.is_err() { return },
                () = self.clock.sleep_until(at) => return,
            }
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // The task sends the last ping, if the runtime still lets it.
        self.end.cancel();
    }
}

struct SessionTask {
    channels: Channels,
    endpoint: Endpoint,
    id: String,
    client: String,
    standing: Standing,
    predecessor: Predecessor,
    ttl: Duration,
    clock: BootClock,
    believes: watch::Sender<Believed>,
    tell: watch::Sender<SessionState>,
    end: CancellationToken,
    /// The session's number at the manager, from its last answer.
    number: Option<u64>,
}

impl SessionTask {
    async fn keep(mut self) {
        let mut backoff = BACKOFF.0;
        loop {
            let before = self.tell.borrow().generation;
            let (end, mut state) = (self.end.clone(), self.tell.subscribe());
            let belief = Belief { now: self.believes.subscribe(), clock: self.clock.clone() };
            let ran_out = async {
                // Counts only once the session is alive; the sender is in this task.
                let _ = state.wait_for(|state| state.alive).await;
                belief.clone().nearly_ended(Duration::ZERO).await;
            };
            tokio::select! {
                biased;
                () = end.cancelled() => break,
                () = ran_out => {}
                () = self.stream() => {}
            }
            if self.tell.borrow().generation != before || belief.holds() {
                backoff = BACKOFF.0;
            }
            if !belief.holds() {
                self.tell.send_if_modified(|state| {
                    let ran_out = std::mem::take(&mut state.alive);
                    if ran_out {
                        state.unheard_since = Some(Instant::now());
                    }
                    ran_out
                });
            }
            tokio::select! {
                biased;
                () = end.cancelled() => break,
                // The pause is bounded, so that the end of the session is reported in time.
                () = tokio::time::sleep(backoff.min(self.patience())) => {}
            }
            backoff = (backoff * 2).min(BACKOFF.1);
        }
        // The stream of pings is gone; a last ping tells the manager to end the session now.
        let _ = timeout(FAREWELL, self.farewell()).await;
        self.tell.send_if_modified(|state| std::mem::take(&mut state.alive));
    }

    /// Pings over one stream until the stream breaks.
    async fn stream(&mut self) {
        let Some(mut client) = self.connect() else { return };
        let (pings, outgoing) = mpsc::channel(1);
        let mut asked = self.clock.now();
        if pings.send(self.ping(self.ttl)).await.is_err() {
            return;
        }
        let opening = timeout(self.patience(), client.keep_alive(ReceiverStream::new(outgoing))).await;
        let mut answers = match opening {
            Ok(Ok(answer)) => answer.into_inner(),
            Ok(Err(status)) => return self.refused(&status),
            Err(_) => return,
        };
        loop {
            let answer = match timeout(self.patience(), answers.message()).await {
                Ok(Ok(Some(answer))) => answer,
                Ok(Err(status)) => return self.refused(&status),
                Ok(Ok(None)) | Err(_) => return,
            };
            let ttl = Duration::from_millis(answer.ttl_ms);
            // A manager that does not number its sessions answers 0. An answer that is read long after its question, as after a suspension
            // of the machine, no longer keeps the session alive.
            let holds = self.clock.now() < asked + ttl;
            let is_another = self.number.replace(answer.number).is_some_and(|before| before != answer.number);
            let before = *self.tell.borrow();
            let generation = before.generation + u64::from(answer.created || is_another || before.generation == 0);
            // Counted from the question, so that the session never lives longer here than at the manager.
            self.believes.send_replace(Believed { until: asked + ttl, generation });
            self.tell.send_if_modified(|state| {
                // The answer that said `created` may have been lost with its stream.
                let is_first = before.generation == 0 && !answer.created;
                state.found |= is_first && self.predecessor == Predecessor::Unknown;
                state.number = answer.number;
                state.generation = generation;
                state.alive |= holds;
                state.taken = false;
                if holds {
                    state.unheard_since = None;
                }
                *state != before
            });
            tokio::select! {
                () = tokio::time::sleep(ttl.min(self.ttl) / PINGS_PER_TTL) => {}
                // No answer is due: the stream broke, or the manager ended it.
                _ = answers.message() => return,
            }
            panic_point("session");
            asked = self.clock.now();
            if pings.send(self.ping(self.ttl)).await.is_err() {
                return;
            }
        }
    }

    fn refused(&self, status: &Status) {
        let is_anothers = status.get_details_error_info().is_some_and(|info| info.reason == NOT_YOURS);
        if !is_anothers {
            return tracing::debug!(endpoint = %self.endpoint, %status, "no session yet");
        }
        if self.tell.send_if_modified(|state| !std::mem::replace(&mut state.taken, true)) {
            tracing::warn!(endpoint = %self.endpoint, reason = status.message(), "the session's id is another caller's");
        }
    }

    async fn farewell(&self) {
        let Some(mut client) = self.connect() else { return };
        let ping = tokio_stream::once(self.ping(Duration::ZERO));
        if let Ok(answer) = client.keep_alive(ping).await {
            let _ = answer.into_inner().message().await;
        }
    }

    fn connect(&self) -> Option<ResourceServiceClient<Traced>> {
        self.channels.get(&self.endpoint).ok().map(ResourceServiceClient::new)
    }

    #[expect(clippy::disallowed_methods, reason = "a due time is a moment of the wall clock")]
    fn ping(&self, ttl: Duration) -> v1::KeepAliveRequest {
        let ttl_ms = u64::try_from(ttl.as_millis()).unwrap_or(u64::MAX);
        v1::KeepAliveRequest {
            session_id: self.id.clone(),
            ttl_ms,
            client: self.client.clone(),
            share: self.standing.share,
            due_in_ms: self.standing.due_in_ms(SystemTime::now()),
        }
    }

    /// Time limit for an answer: until the session expires; after that, the time to live.
    fn patience(&self) -> Duration {
        let left = self.believes.borrow().until.saturating_duration_since(self.clock.now());
        if left.is_zero() { self.ttl } else { left }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn who_asks_between_the_two_reports_of_an_answer_is_not_told_that_what_is_lost_is_kept() {
        let (ttl, clock) = (Duration::from_secs(60), BootClock::default());
        // The manager has made the session again; of that only the renewed belief has been reported.
        let (_tell, state) = watch::channel(SessionState { alive: true, generation: 1, ..SessionState::default() });
        let (_believes, now) = watch::channel(Believed { until: clock.now() + ttl, generation: 2 });
        let mut trust = Trust { state, belief: Belief { now, clock }, ttl };
        assert!(!trust.is_kept().await);
    }
}
