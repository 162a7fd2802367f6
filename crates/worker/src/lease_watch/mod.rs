//! The leases on this provider's resources, as reported by the resource manager: a goal that names a lease proves nothing by that.
//!
//! ```text
//!   resource manager ──watch──▶ follow (a task) ──▶ Holdings (pure) ◀── check ── ActionServer::admit
//!                                       └── what ended ──▶ ActionServer: its goals end
//! ```
//! A provider makes one [`LeaseWatch`] for its resources, gives it to its [`crate::action::ActionServer`], and has it follow the
//! manager. While the watch is interrupted, no goal begins. Goals under way go on as long as the provider's own session lives (without a
//! session: for a time after the manager's last answer). After that, every goal under a lease ends, except those that can be suspended
//! ([`crate::action::Action::can_be_suspended`]): they stand still until the manager answers again, and end when it is given up. When the
//! manager answers again, a goal goes on only where its lease still lives.
//!
//! When a lease ends, the provider confirms for its own resources that nothing moves any more (`standstill.rs`). No goal begins before the
//! driver has reported that everything is at rest ([`LeaseWatch::brought_to_rest`]).
//!
//! [`BootClock`] measures for how long the manager is trusted: a machine that was suspended confirms nothing when it wakes up.

mod holdings;
mod location;
mod standstill;

pub use holdings::{Claim, ClaimStatus, EndedHolding, Holdings};
pub use location::{ManagerLocation, RESOURCE_MANAGER_VARIABLE};

use crate::boot_clock::{BootClock, BootInstant};
use crate::client::{CallError, Channels, ResourceClient, ResourceWatch};
use crate::endpoint::Endpoint;
use crate::provider::Bounds;
use crate::session::{Belief, GIVEN_UP_AFTER, Session, SessionState};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_panic_point::panic_point;
use ratn_proto::types::ResourceUpdate;
use std::future::{pending, ready};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;

/// How long an unknown lease is waited for: its grant reaches its holder and this provider at about the same time.
pub const GRANT_WAIT: Duration = Duration::from_secs(1);

/// Pause before the manager is asked again.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);
/// Without a session of its own, a provider asks the manager this many times within the time for which the manager is trusted without an
/// answer.
const QUESTIONS_PER_PATIENCE: u32 = 4;
/// Maximum time for which a goal is suspended, as a multiple of the patience. It is longer than a client believes that its session may live
/// ([`Session::gone`]), so that the client ends the goal first.
const SUSPENDED_FOR: u32 = GIVEN_UP_AFTER + 1;
/// Why no claim is confirmed when the manager is not trusted any more, before that has been reported.
const TOO_OLD: &str = "the last word of the resource manager is too old";
/// Interval of the log line that there is no watch.
const WARN_INTERVAL: Duration = Duration::from_secs(10);

/// A listener to the end of leases.
pub(crate) trait LeaseListener: Send + Sync {
    /// A lease no longer holds a resource.
    fn lease_ended(&self, ended: &EndedHolding);

    /// Every lease may have ended. The manager may be heard again, and then tells which have not.
    fn leases_unheard(&self, reason: &str);

    /// The manager has reported which leases are live.
    fn leases_heard(&self);

    /// Every lease may have ended, and the manager is given up.
    fn leases_lost(&self, reason: &str);

    /// The running goals of a resource; if a lease (id and token) is given, only that lease's, and those that have panicked. Each token fires
    /// when the goal's action has returned, or has panicked just then: ask again. A goal that had panicked before has a token that never fires.
    fn under_way(&self, resource: &str, lease: Option<(LeaseId, FencingToken)>) -> Vec<CancellationToken>;

    /// Whether an action at the resource has ever panicked: what it moved may still move, though no goal runs.
    fn has_panicked(&self, resource: &str) -> bool;
}

/// The leases of a provider's resources, as far as the resource manager has reported them. A handle: clones share everything.
#[derive(Clone)]
pub struct LeaseWatch {
    shared: Arc<Shared>,
}

struct Shared {
    /// The resources' ids.
    resources: Vec<String>,
    holdings: Mutex<Holdings>,
    /// Incremented by every update.
    heard: watch::Sender<u64>,
    listeners: Mutex<Vec<Weak<dyn LeaseListener>>>,
    /// The driver has reported that no motion of an earlier process goes on.
    is_brought_to_rest: watch::Sender<bool>,
    /// No goal begins before that report: the provider offers these resources itself.
    begins_at_rest: AtomicBool,
    trust: Mutex<Trust>,
    clock: BootClock,
    bounds: Bounds,
}

/// For how long the manager's last update is trusted.
#[derive(Debug)]
enum Trust {
    /// Until an update says otherwise.
    UntilTold,
    /// As long as this session is believed to live.
    Session(Belief),
    /// For this duration after the last answer.
    Answers(Arc<Answered>, Duration),
}

/// The manager to watch.
enum Source {
    /// One manager, in which a session provides the resources.
    Session { client: Box<ResourceClient>, state: watch::Receiver<SessionState>, belief: Belief, id: String },
    /// The manager at this location, wherever it is now; the session of this id provides the resources.
    Location { channels: Channels, location: ManagerLocation, provider_session: String },
}

/// A watch that is being followed.
struct Following {
    stream: ResourceWatch,
    client: ResourceClient,
    /// Generation of the session that was alive when the watch began.
    generation: u64,
    answered: Arc<Answered>,
}

/// Time of the last question that was answered.
#[derive(Debug)]
struct Answered(Mutex<BootInstant>);

impl LeaseWatch {
    /// A watch of the resources of these ids. No lease is known before the watch follows a manager.
    pub fn of(resources: impl IntoIterator<Item = impl Into<String>>) -> LeaseWatch {
        LeaseWatch::by(BootClock::default(), resources)
    }

    /// As [`LeaseWatch::of`], with this clock.
    pub fn by(clock: BootClock, resources: impl IntoIterator<Item = impl Into<String>>) -> LeaseWatch {
        let shared = Shared {
            resources: resources.into_iter().map(Into::into).collect(),
            holdings: Mutex::default(),
            heard: watch::channel(0).0,
            listeners: Mutex::default(),
            is_brought_to_rest: watch::channel(false).0,
            begins_at_rest: AtomicBool::new(false),
            trust: Mutex::new(Trust::UntilTold),
            clock,
            bounds: Bounds::default(),
        };
        LeaseWatch { shared: Arc::new(shared) }
    }

    /// The ids of the resources.
    pub fn resources(&self) -> &[String] {
        &self.shared.resources
    }

    /// The bounds for standstill of what the providers of this process have offered.
    pub(crate) fn bounds(&self) -> Bounds {
        self.shared.bounds.clone()
    }

    /// Whether it watches a resource with this id.
    pub(crate) fn watches(&self, id: &str) -> bool {
        self.shared.resources.iter().any(|resource| resource == id)
    }

    /// The standing of a claimed lease by what the resource manager has reported so far.
    pub fn check(&self, claim: &Claim<'_>) -> ClaimStatus {
        let standing = self.shared.holdings().check(claim);
        match standing {
            ClaimStatus::Confirmed if !self.shared.is_trusted() => ClaimStatus::Unheard(TOO_OLD.to_owned()),
            ClaimStatus::Confirmed if self.shared.awaits_rest() => ClaimStatus::NotAtRest,
            standing => standing,
        }
    }

    /// The caller who opened the session of a lease that holds a resource; empty if unknown.
    pub fn opened_by(&self, resource: &str, lease: LeaseId) -> String {
        self.shared.holdings().opened_by(resource, lease).to_owned()
    }

    /// Whether the manager answers, or did until a moment ago.
    pub fn is_heard(&self) -> bool {
        self.shared.holdings().is_heard()
    }

    /// Reports that no motion of an earlier process goes on. A driver that was killed knows nothing of its motions when it starts again,
    /// and its session may still live. Until this is called, no standstill is confirmed, [`crate::provider::Provider::start_at_rest`]
    /// offers nothing, and no goal begins if [`LeaseWatch::follow_session`] is used. [`crate::worker::Worker`] calls it by itself.
    pub fn brought_to_rest(&self) {
        self.shared.is_brought_to_rest.send_replace(true);
        // Goals that wait for this check again.
        self.shared.heard.send_modify(|heard| *heard += 1);
    }

    /// Whether the driver has said [`LeaseWatch::brought_to_rest`].
    pub(crate) fn is_brought_to_rest(&self) -> bool {
        *self.shared.is_brought_to_rest.borrow()
    }

    /// From now on no goal begins before [`LeaseWatch::brought_to_rest`].
    pub(crate) fn begin_at_rest(&self) {
        self.shared.begins_at_rest.store(true, Ordering::SeqCst);
    }

    /// Returns when the driver has called [`LeaseWatch::brought_to_rest`].
    pub(crate) async fn rested(&self) {
        // The sender is in `self`, so the channel is open.
        let _ = self.shared.is_brought_to_rest.subscribe().wait_for(|said| *said).await;
    }

    /// Whether the driver has called [`LeaseWatch::brought_to_rest`], and no goal runs on the resource, not even one that was told to stop.
    pub fn is_at_rest(&self, resource: &str) -> bool {
        self.is_brought_to_rest() && self.shared.under_way(resource, None).is_none_or(|under_way| under_way.is_empty())
    }

    /// As [`LeaseListener::has_panicked`], for all listeners.
    pub(crate) fn has_panicked(&self, resource: &str) -> bool {
        self.shared.listeners().iter().any(|listener| listener.has_panicked(resource))
    }

    /// Follows the manager of a session that provides the resources, for as long as the future is polled. Leases are trusted as long as the
    /// session lives, and for `patience` after the watch broke. The standstill of an ended lease is confirmed when the actions of its goals
    /// have returned, and not before [`LeaseWatch::brought_to_rest`]; no goal begins before that either. Drop the future before the session
    /// is closed.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn follow_session(
        &self,
        channels: &Channels,
        manager: &Endpoint,
        session: &Session,
        patience: Duration,
    ) -> Result<impl Future<Output = ()> + Send + use<>, CallError> {
        let client = ResourceClient::new(channels, manager, session.id())?;
        let confirming = self.clone().confirm_standstill(client.clone());
        let (state, belief, id) = (session.state(), session.belief(), session.id().to_owned());
        let source = Source::Session { client: Box::new(client), state, belief, id };
        self.begin_at_rest();
        let following = self.clone().follow(source, patience);
        Ok(async move {
            tokio::select! {
                () = following => {}
                () = confirming => {}
            }
        })
    }

    /// Follows the manager at a location, for as long as the future is polled; for a provider whose resources another process offers, in
    /// the session of this id. Resources that other sessions offer under the same ids are not this provider's. Leases are trusted for
    /// `patience` after the manager's last answer; the manager is asked four times within that.
    pub fn follow_location(
        &self,
        channels: &Channels,
        location: ManagerLocation,
        provider_session: &str,
        patience: Duration,
    ) -> impl Future<Output = ()> + Send + use<> {
        let provider_session = provider_session.to_owned();
        self.clone().follow(Source::Location { channels: channels.clone(), location, provider_session }, patience)
    }

    /// Forgets everything: goals under way end, and no goal begins until a manager answers.
    pub fn lost(&self, reason: &str) {
        self.shared.holdings().lost(reason);
        self.shared.tell(|listener| listener.leases_lost(reason));
        self.shared.heard.send_modify(|heard| *heard += 1);
    }

    pub(crate) fn listen(&self, listener: Weak<dyn LeaseListener>) {
        self.shared.listeners.lock().unwrap_or_else(PoisonError::into_inner).push(listener);
    }

    /// Notifies of every update from now on.
    pub(crate) fn heard(&self) -> watch::Receiver<u64> {
        self.shared.heard.subscribe()
    }

    /// Applies an update of the manager. For tests of providers without a manager; otherwise [`LeaseWatch::follow_session`] does it.
    pub fn tell(&self, update: &ResourceUpdate) {
        let ended = self.shared.holdings().tell(update);
        // A goal that waits for the next lease must find the goals of the ended lease told to stop.
        self.shared.tell(|listener| ended.iter().for_each(|ended| listener.lease_ended(ended)));
        if matches!(update, ResourceUpdate::Snapshot { .. }) {
            self.shared.tell(|listener| listener.leases_heard());
        }
        self.shared.heard.send_modify(|heard| *heard += 1);
    }

    /// Every lease may have ended: goals that can be suspended are suspended until the manager answers; the others end.
    pub fn unheard(&self, reason: &str) {
        self.shared.holdings().unheard(reason);
        self.shared.tell(|listener| listener.leases_unheard(reason));
        self.shared.heard.send_modify(|heard| *heard += 1);
    }

    /// The watch broke: no goal begins, and goals under way go on, until the manager answers. For tests of providers without a manager.
    pub fn interrupted(&self) {
        self.shared.holdings().interrupted();
    }

    async fn follow(self, source: Source, patience: Duration) {
        let mut following = self.begin(&source, patience).await;
        loop {
            let is_lost = tokio::select! {
                biased;
                // Noticed before a hanging connection breaks.
                () = source.is_over(following.generation) => true,
                () = self.silence(&source, &following.client, &following.answered, patience) => true,
                () = self.read(&mut following.stream) => false,
                () = source.has_moved(following.client.endpoint()) => false,
            };
            self.interrupted();
            let generation = following.generation;
            let trusted_until = match source {
                Source::Session { .. } => self.shared.clock.now() + patience,
                Source::Location { .. } => following.answered.last() + patience,
            };
            drop(following);
            let again = async {
                sleep(RETRY_INTERVAL).await;
                self.begin(&source, patience).await
            };
            let begun = tokio::select! {
                biased;
                () = ready(()), if is_lost => None,
                () = source.is_over(generation) => None,
                () = self.shared.clock.sleep_until(trusted_until) => None,
                begun = again => Some(begun),
            };
            following = match begun {
                Some(begun) => begun,
                None => self.heard_again(&source, patience).await,
            };
        }
    }

    /// A new watch, after the manager was not heard for longer than it is trusted.
    async fn heard_again(&self, source: &Source, patience: Duration) -> Following {
        let reason = "the resource manager is not heard";
        tracing::warn!("{reason}: goals under a lease end, or are suspended, and none begins");
        self.unheard(reason);
        if let Ok(begun) = timeout(patience * SUSPENDED_FOR, self.begin(source, patience)).await {
            return begun;
        }
        tracing::warn!("{reason}: suspended goals end");
        self.lost(reason);
        self.begin(source, patience).await
    }

    /// Returns when the manager at a location has not answered for `patience`: a manager that hangs does not break the connection. The
    /// manager of a session answers its pings instead.
    async fn silence(&self, source: &Source, client: &ResourceClient, answered: &Answered, patience: Duration) {
        let (Source::Location { .. }, Some(resource)) = (source, self.shared.resources.first()) else {
            return pending().await;
        };
        loop {
            let clock = &self.shared.clock;
            let trusted_until = answered.last() + patience;
            let question = async {
                sleep(patience / QUESTIONS_PER_PATIENCE).await;
                panic_point("lease-watch");
                let asked = clock.now();
                (asked, client.get(resource).await)
            };
            tokio::select! {
                biased;
                () = clock.sleep_until(trusted_until) => return,
                (asked, answer) = question => match answer {
                    Err(error) if error.is_crash() => tracing::debug!(%error, "the resource manager does not answer"),
                    // Any answer counts, whatever it says.
                    _ => answered.at(asked),
                },
            }
        }
    }

    /// A watch that has reported which leases are live.
    async fn begin(&self, source: &Source, patience: Duration) -> Following {
        let mut warn_at = Instant::now() + patience;
        loop {
            match timeout(patience, self.try_begin(source, patience)).await {
                Ok(Ok(following)) => return following,
                Ok(Err(error)) if Instant::now() < warn_at => tracing::debug!(%error, "no watch of leases"),
                failed => {
                    let why = match failed {
                        Ok(Err(error)) => error.to_string(),
                        _ => "it does not answer".to_owned(),
                    };
                    tracing::warn!(why, resources = ?self.shared.resources, "the resource manager is not heard: no goal begins");
                    warn_at = Instant::now() + WARN_INTERVAL;
                }
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    async fn try_begin(&self, source: &Source, patience: Duration) -> Result<Following, CallError> {
        let (client, owner, generation, found) = match source {
            Source::Session { client, state, id, .. } => {
                // A closed session reports nothing more, and this watch ends with it.
                let mut state = state.clone();
                let Ok(now) = state.wait_for(|s| s.alive).await.map(|s| *s) else { pending().await };
                // A session that was opened again has no leases from before.
                (ResourceClient::clone(client), id.as_str(), now.generation, now.found && now.generation == 1)
            }
            Source::Location { channels, location, provider_session } => {
                let manager = location.find().await;
                (ResourceClient::new(channels, &manager, "")?, provider_session.as_str(), 0, false)
            }
        };
        let answered = Arc::new(Answered(Mutex::new(self.shared.clock.now())));
        let mut stream = client.watch_resources(self.shared.resources.iter().cloned()).await?;
        let first = stream.next().await?;
        self.shared.holdings().begin(owner, found);
        *self.shared.trust.lock().unwrap_or_else(PoisonError::into_inner) = match source {
            Source::Session { belief, .. } => Trust::Session(belief.clone()),
            Source::Location { .. } => Trust::Answers(Arc::clone(&answered), patience),
        };
        if let Some(snapshot) = first {
            self.tell(&snapshot);
        }
        Ok(Following { stream, client, generation, answered })
    }

    /// Returns when the watch has ended.
    async fn read(&self, stream: &mut ResourceWatch) {
        loop {
            match stream.next().await {
                Ok(Some(update)) => self.tell(&update),
                Ok(None) => return tracing::debug!("the watch of leases ended"),
                Err(error) => return tracing::debug!(%error, "the watch of leases broke"),
            }
        }
    }
}

impl Answered {
    fn last(&self) -> BootInstant {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn at(&self, asked: BootInstant) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = asked;
    }
}

impl Source {
    /// Returns when the session of this generation is not alive, also if it was not alive before the call.
    async fn is_over(&self, generation: u64) {
        match self {
            Source::Session { state, .. } => {
                let _ = state.clone().wait_for(|s| !s.alive || s.generation != generation).await;
            }
            Source::Location { .. } => pending().await,
        }
    }

    async fn has_moved(&self, endpoint: &Endpoint) {
        match self {
            Source::Session { .. } => pending().await,
            Source::Location { location, .. } => location.moved_from(endpoint).await,
        }
    }
}

impl Shared {
    fn holdings(&self) -> MutexGuard<'_, Holdings> {
        self.holdings.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the manager's last update is still trusted. Checked at each use, because no timer runs while the machine is suspended.
    fn is_trusted(&self) -> bool {
        match &*self.trust.lock().unwrap_or_else(PoisonError::into_inner) {
            Trust::UntilTold => true,
            Trust::Session(belief) => belief.holds(),
            Trust::Answers(answered, patience) => self.clock.now() < answered.last() + *patience,
        }
    }

    /// Whether the driver still has to report that no motion of an earlier process goes on.
    fn awaits_rest(&self) -> bool {
        self.begins_at_rest.load(Ordering::SeqCst) && !*self.is_brought_to_rest.borrow()
    }

    fn tell(&self, say: impl Fn(&dyn LeaseListener)) {
        self.listeners().iter().for_each(|listener| say(&**listener));
    }

    /// As [`LeaseListener::under_way`], for all listeners; `None` without any listener, because then it is unknown.
    fn under_way(&self, resource: &str, lease: Option<(LeaseId, FencingToken)>) -> Option<Vec<CancellationToken>> {
        let listeners = self.listeners();
        let under_way = listeners.iter().flat_map(|listener| listener.under_way(resource, lease));
        (!listeners.is_empty()).then(|| under_way.collect())
    }

    fn listeners(&self) -> Vec<Arc<dyn LeaseListener>> {
        let mut listeners = self.listeners.lock().unwrap_or_else(PoisonError::into_inner);
        listeners.retain(|listener| listener.strong_count() > 0);
        listeners.iter().filter_map(Weak::upgrade).collect()
    }
}

impl std::fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LeaseWatch").field("holdings", &self.shared.holdings).finish_non_exhaustive()
    }
}
