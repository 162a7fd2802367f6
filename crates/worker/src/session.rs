//! A session with the resource manager: kept alive in the background, continued after a broken connection, opened again
//! when the manager has forgotten it. What it owned is then gone; [`SessionState::generation`] tells, by the number that the manager gives
//! every session that it makes: also where the answer that said `created` was lost with its connection.
//!
//! ```text
//! open ─→ not alive ─ ping answered ─→ alive ─ no answer for a TTL ─→ not alive
//!                                      └─ answer says `created`, or another number ─→ alive, next generation
//! not alive ─ answer says that it is known ─→ alive, the same generation: a manager that was suspended, or away, has kept it
//! ```
//! A session whose id is another caller's does not come back ([`Session::taken`]): its client goes on with a session of another id.

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

/// How long a session lives without a ping, where the client does not choose a time.
pub const DEFAULT_TTL: Duration = Duration::from_secs(3);

/// A manager that is not heard for so many times to live, after the first, is not waited for any more.
pub const GIVEN_UP_AFTER: u32 = 3;
/// A session is pinged this many times per time to live.
const PINGS_PER_TTL: u32 = 4;
/// The pause before a reconnect; grows from the first to the second.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(20), Duration::from_millis(500));
/// The reason of a refusal to speak for a session of another caller.
const NOT_YOURS: &str = "NOT_YOURS";
/// So soon after the time to live of an answer the rest of what it says is known, too.
const MOMENT: Duration = Duration::from_millis(5);
/// The last ping, which ends the session, is given this long.
const FAREWELL: Duration = Duration::from_millis(200);

/// A session that is kept alive until this is closed or dropped.
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

/// What the client of a session is beside others that want the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Standing {
    /// How much of it the client is to have, beside the shares of the others: from 0.01 to 100, and 1 as usual.
    pub share: f64,
    /// When its task is due, if it is.
    pub due: Option<SystemTime>,
}

impl Default for Standing {
    fn default() -> Standing {
        Standing { share: 1.0, due: None }
    }
}

impl Standing {
    /// The shares that there are.
    pub const SHARES: RangeInclusive<f64> = 0.01..=100.0;

    /// How many milliseconds are left until its task is due; negative where that has passed.
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
    /// When the session was found to have expired on this side; `None` while it is alive, or was never alive.
    pub unheard_since: Option<Instant>,
    /// The manager knew it from before when it was pinged for the first time: it goes on with what it has there.
    pub found: bool,
    /// Its number at the manager: one that is made anew under the same id has another. 0 until it was alive, and where the manager does not
    /// number its sessions.
    pub number: u64,
    /// The manager has said last that the id is another caller's, who has a session of it or had the last one ([`Session::taken`]).
    pub taken: bool,
}

/// Until when a client believes in its session: from its last answered ping on for its time to live, the time included in which the
/// machine was suspended. A handle: clones share everything.
#[derive(Debug, Clone)]
pub(crate) struct Belief {
    until: watch::Receiver<BootInstant>,
    clock: BootClock,
}

/// The session was not alive within the deadline.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the resource manager at {endpoint} opened no session within {waited_s:.1} s; {}", self.next())]
pub struct SessionError {
    /// The resource manager's endpoint.
    pub endpoint: Endpoint,
    /// The session's id, where it belongs to another caller.
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
    /// Opens a session with the resource manager at `endpoint` and keeps it alive. `client` is a name for people, `ttl` the time after which
    /// the manager ends a session that it does not hear of. Returns at once; [`Session::alive`] waits.
    pub fn open(channels: &Channels, endpoint: &Endpoint, client: &str, ttl: Duration) -> Session {
        Session::open_as(channels, endpoint, fresh_id(client), client, ttl)
    }

    /// As [`Session::open`], with an id of the caller's choice. With the id of a session whose client is gone, that session goes on if it
    /// still lives. No other caller may use the id.
    pub fn open_as(channels: &Channels, endpoint: &Endpoint, id: String, client: &str, ttl: Duration) -> Session {
        Session::open_by(BootClock::default(), channels, endpoint, id, client, ttl)
    }

    /// As [`Session::open_as`], of a client that says what it is beside others.
    pub fn open_beside(
        channels: &Channels,
        endpoint: &Endpoint,
        id: String,
        client: &str,
        ttl: Duration,
        standing: Standing,
    ) -> Session {
        Session::keep(BootClock::default(), channels, endpoint, (id, standing), client, ttl)
    }

    /// As [`Session::open_as`], measured by this clock.
    pub fn open_by(
        clock: BootClock,
        channels: &Channels,
        endpoint: &Endpoint,
        id: String,
        client: &str,
        ttl: Duration,
    ) -> Session {
        Session::keep(clock, channels, endpoint, (id, Standing::default()), client, ttl)
    }

    fn keep(
        clock: BootClock,
        channels: &Channels,
        endpoint: &Endpoint,
        (id, standing): (String, Standing),
        client: &str,
        ttl: Duration,
    ) -> Session {
        let end = CancellationToken::new();
        let (tell, state) = watch::channel(SessionState::default());
        let (expires, until) = watch::channel(clock.now());
        let belief = Belief { until, clock: clock.clone() };
        let keeper = SessionTask {
            clock,
            number: None,
            channels: channels.clone(),
            endpoint: endpoint.clone(),
            id: id.clone(),
            client: client.to_owned(),
            standing,
            ttl,
            expires,
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

    /// Returns once the session is alive.
    ///
    /// # Errors
    /// [`SessionError`] when it is not alive within `deadline`.
    pub async fn alive(&self, deadline: Duration) -> Result<(), SessionError> {
        let mut state = self.state.clone();
        let alive = timeout(deadline, state.wait_for(|state| state.alive)).await;
        if matches!(alive, Ok(Ok(_))) {
            return Ok(());
        }
        let taken = self.state.borrow().taken.then(|| self.id.clone());
        Err(SessionError { endpoint: self.endpoint.clone(), taken, waited_s: deadline.as_secs_f64() })
    }

    /// Returns once everything that the session owned or held may belong to somebody else: the manager has not answered for the time to
    /// live, or has made the session anew since the call. A session that was never alive is waited for first. For a client that has to stop
    /// then; the manager may still know the session ([`Session::gone`]).
    pub async fn lost(&self) {
        let mut state = self.state.clone();
        if state.borrow().unheard_since.is_some() {
            return;
        }
        let Ok(generation) = state.wait_for(|s| s.alive).await.map(|s| s.generation) else { return };
        let _ = state.wait_for(|s| !s.alive || s.generation != generation).await;
    }

    /// Returns once everything that the session owned or held is gone for good: the manager has made the session anew, or has not answered
    /// for [`GIVEN_UP_AFTER`] further times to live after the session had expired here. Counts from the session's beginning.
    pub async fn gone(&self) {
        gone(self.state.clone(), self.ttl).await;
    }

    /// A handle that says whether the session still has what it had: for a task of its own that does what only the holder of its leases may do.
    pub fn trust(&self) -> Trust {
        Trust { state: self.state.clone(), belief: self.belief.clone(), ttl: self.ttl }
    }

    /// Returns once the manager says that the session's id belongs to another caller. Everything that the session owned or held is gone, or
    /// ends with its time to live, and asking again does not help. For a client that can go on with a session of another id. A client that
    /// provides something must not take it for standing still: start its provider anew
    /// ([`crate::provider::Provider::start_at_rest`]).
    pub async fn taken(&self) {
        if self.state.clone().wait_for(|state| state.taken).await.is_err() {
            // It has been closed.
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

    /// Stops pinging, without telling the manager: the session keeps what it owns and holds until its time to live is over.
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

/// Whether a session has what it had. Clones share everything.
#[derive(Debug, Clone)]
pub struct Trust {
    state: watch::Receiver<SessionState>,
    belief: Belief,
    ttl: Duration,
}

impl Trust {
    /// Whether everything that the session owned and held is its own still. While that is not known (the manager is not heard, or this process
    /// was suspended) it waits until it is; what is gone is gone as [`Session::gone`] says.
    pub async fn is_kept(&mut self) -> bool {
        while !self.belief.holds() {
            tokio::select! {
                // What the answer says of the session is told a moment after it.
                changed = self.belief.until.changed() => match changed {
                    Ok(()) => tokio::time::sleep(MOMENT).await,
                    Err(_) => return false,
                },
                () = gone(self.state.clone(), self.ttl) => return false,
            }
        }
        self.state.borrow().generation <= 1
    }

    /// Returns once it is gone for good, as [`Session::gone`] does.
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
    /// Whether the session is believed in now. For those that cannot wait for a timer, which stands still while the machine is suspended.
    pub(crate) fn holds(&self) -> bool {
        self.clock.now() < *self.until.borrow()
    }

    /// Returns this long before it ends, unless it is renewed before.
    async fn nearly_ended(mut self, margin: Duration) {
        loop {
            let at = self.until.borrow_and_update().saturating_sub(margin);
            tokio::select! {
                biased;
                changed = self.until.changed() => if changed.is_err() { return },
                () = self.clock.sleep_until(at) => return,
            }
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // The task says farewell, if the runtime still lets it.
        self.end.cancel();
    }
}

struct SessionTask {
    channels: Channels,
    endpoint: Endpoint,
    id: String,
    client: String,
    standing: Standing,
    ttl: Duration,
    clock: BootClock,
    expires: watch::Sender<BootInstant>,
    tell: watch::Sender<SessionState>,
    end: CancellationToken,
    /// Which session of the manager's this is, as its last answer said.
    number: Option<u64>,
}

impl SessionTask {
    async fn keep(mut self) {
        let mut backoff = BACKOFF.0;
        loop {
            let before = self.tell.borrow().generation;
            let (end, mut state) = (self.end.clone(), self.tell.subscribe());
            let belief = Belief { until: self.expires.subscribe(), clock: self.clock.clone() };
            let ran_out = async {
                // Once it is alive; the sender is in this task.
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
                // It is said in time that the session is over.
                () = tokio::time::sleep(backoff.min(self.patience())) => {}
            }
            backoff = (backoff * 2).min(BACKOFF.1);
        }
        // The stream with its pings is gone; a last one says that the session shall end now.
        let _ = timeout(FAREWELL, self.farewell()).await;
        self.tell.send_if_modified(|state| std::mem::take(&mut state.alive));
    }

    /// Pings over one stream until it breaks.
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
            // Counted from the question, so that it never lives longer here than there.
            self.expires.send_replace(asked + ttl);
            // A manager that does not number its sessions says 0 of each.
            // An answer that was read long after its question, as after a suspension of the machine, promises nothing any more.
            let holds = self.clock.now() < asked + ttl;
            let is_another = self.number.replace(answer.number).is_some_and(|before| before != answer.number);
            self.tell.send_if_modified(|state| {
                let before = *state;
                // One that was not alive here was not there: the answer that said so may have been lost with its stream.
                state.found |= before.generation == 0 && !answer.created;
                state.number = answer.number;
                state.generation += u64::from(answer.created || is_another || before.generation == 0);
                state.alive |= holds;
                state.taken = false;
                if holds {
                    state.unheard_since = None;
                }
                *state != before
            });
            tokio::select! {
                () = tokio::time::sleep(ttl.min(self.ttl) / PINGS_PER_TTL) => {}
                // Nothing is due: the stream broke, or the manager ended it.
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

    /// How long an answer may take: until the session is over, once it is, a time to live.
    fn patience(&self) -> Duration {
        let left = self.expires.borrow().saturating_duration_since(self.clock.now());
        if left.is_zero() { self.ttl } else { left }
    }
}
