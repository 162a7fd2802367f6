//! Offers resources under a session, and withdraws them. A resource that the resource manager has forgotten is offered again. While the
//! manager cannot be reached, offers and withdrawals wait; a call that is not answered within `ANSWERED_WITHIN` is repeated.
//!
//! A provider watches its resources at the manager. When somebody else has deleted a resource, the provider logs that and offers it again.
//! The first snapshot of a new watch is compared with the offered resources: the session may have ended and been made again unnoticed, if
//! the manager's answer about that was lost.
//! A provider of hardware that moves ([`Provider::start_at_rest`]) does not offer a resource on which an earlier goal still runs, and
//! offers nothing before its driver has reported rest. A resource that such a provider offers but does not watch (the middle of a table,
//! beside the arms) is offered again when its bound for standstill has passed, also by the next provider of its [`LeaseWatch`]. A provider that does not follow the leases of what moves (a
//! process manager, for its pooled drivers) offers a resource that the manager has lost again only when the resource's bound for standstill
//! has passed: its former holders may not have heard yet. An offer whose answer was lost counts as accepted, and so do the offers of an
//! earlier process in the same session. If the manager had a resource and refuses it now (somebody took a role away), it is offered again,
//! less often.

mod bounds;

pub(crate) use bounds::Bounds;

use crate::action::STOP_GRACE;
use crate::client::{CallError, Channels, ResourceClient};
use crate::endpoint::Endpoint;
use crate::lease_watch::LeaseWatch;
use crate::panic::exit_on_panic;
use crate::session::{Session, SessionState};
use futures::{StreamExt, stream};
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::{Mutex, Notify, watch};
use tokio::time::timeout;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::Code;

/// Number of calls to the manager that run concurrently.
const AT_ONCE: usize = 16;
/// The name of this part of the process in the log.
const PART: &str = "the provider of resources";
/// Time limit for an answer; then the manager is asked again, over a new connection if the old one broke.
const ANSWERED_WITHIN: Duration = Duration::from_secs(3);
/// Pause before the manager is asked again.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);
/// The same pause if the manager refuses what it had before.
const REFUSED_INTERVAL: Duration = Duration::from_secs(1);

/// The `standstill_ms` of hardware that moves, for a provider whose session lives for `session_ttl` without a ping. For so long the
/// provider may not hear that a lease has ended; then it stops by itself, and its actions have returned [`STOP_GRACE`] later.
pub fn standstill_bound(session_ttl: Duration) -> Duration {
    session_ttl + STOP_GRACE
}

/// Keeps resources offered at the resource manager, as long as the session lives.
#[derive(Debug)]
pub struct Provider {
    shared: Arc<Shared>,
    _end: DropGuard,
}

#[derive(Debug)]
struct Shared {
    client: ResourceClient,
    /// The session's id.
    session: String,
    state: watch::Receiver<SessionState>,
    /// Locked during a call, so that an older state never overtakes a newer one.
    desired: Mutex<Desired>,
    missing: Notify,
    /// The leases of resources that are offered only at rest.
    leases: Option<LeaseWatch>,
    /// The session generation that `desired` takes into account; before the first generation nothing was offered.
    generation: AtomicU64,
    /// The kinds of the offered resources, which are watched.
    kinds: watch::Sender<BTreeSet<String>>,
}

/// The desired state at the manager, and when resources may be offered.
#[derive(Debug, Default)]
struct Desired {
    /// By resource id.
    states: BTreeMap<String, DesiredState>,
    /// Of everything that moves in this process.
    bounds: Bounds,
}

/// The desired state of a resource at the manager: offered or withdrawn.
#[derive(Debug, Default)]
struct DesiredState {
    /// The resource to be offered; `None` for a resource to be withdrawn.
    resource: Option<Resource>,
    /// Why the manager does not have this state yet; the last reason that was logged.
    problem: String,
    /// The manager's message, if another session has a resource of the same id.
    taken: Option<String>,
    presence: Presence,
    /// The manager has confirmed exactly this state, and nothing has changed it since.
    confirmed: bool,
    /// The longest bound for standstill that the resource was offered with.
    standstill: Option<Duration>,
}

/// Whether the manager has a resource, as far as known.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
enum Presence {
    /// The manager does not have it.
    #[default]
    Absent,
    /// It was offered without an answer: the manager may have it, and may have granted it.
    Unknown,
    /// The manager has confirmed it.
    There,
}

impl Provider {
    /// A provider that offers nothing yet, at the resource manager of `session`.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn start(channels: &Channels, endpoint: &Endpoint, session: &Session) -> Result<Provider, CallError> {
        Provider::start_with(channels, endpoint, session, None)
    }

    /// As [`Provider::start`], for resources that `leases` watches. A resource that the manager does not have (any more) is offered when
    /// the driver has called [`LeaseWatch::brought_to_rest`] and no goal runs on the resource. So its next holder finds it at rest.
    ///
    /// # Errors
    /// As [`Channels::get`].
    pub fn start_at_rest(
        channels: &Channels,
        endpoint: &Endpoint,
        session: &Session,
        leases: &LeaseWatch,
    ) -> Result<Provider, CallError> {
        Provider::start_with(channels, endpoint, session, Some(leases.clone()))
    }

    fn start_with(
        channels: &Channels,
        endpoint: &Endpoint,
        session: &Session,
        leases: Option<LeaseWatch>,
    ) -> Result<Provider, CallError> {
        let client = ResourceClient::new(channels, endpoint, session.id())?;
        let bounds = leases.as_ref().map(LeaseWatch::bounds).unwrap_or_default();
        bounds.all_lost();
        let shared = Arc::new(Shared {
            client,
            session: session.id().to_owned(),
            state: session.state(),
            desired: Mutex::new(Desired { states: BTreeMap::new(), bounds }),
            missing: Notify::new(),
            leases,
            generation: AtomicU64::new(1),
            kinds: watch::Sender::default(),
        });
        let end = CancellationToken::new();
        let (watching, restoring) = (watch_own(Arc::clone(&shared)), restore(Arc::clone(&shared)));
        tokio::spawn(exit_on_panic(PART, end.clone().run_until_cancelled_owned(watching)));
        tokio::spawn(exit_on_panic(PART, end.clone().run_until_cancelled_owned(restoring)));
        Ok(Provider { shared, _end: end.drop_guard() })
    }

    /// The resource manager's client, in the name of the session.
    pub fn client(&self) -> &ResourceClient {
        &self.shared.client
    }

    /// Offers a resource (its id must not be empty), or updates one that was offered before. True if the manager has it now. False if the
    /// manager cannot be reached, or another session still has a resource of this id: it will be offered as soon as possible.
    ///
    /// # Errors
    /// [`CallError::Refused`] if the manager refuses the resource. It is then not offered again, unless the manager had it before.
    pub async fn offer(&self, resource: Resource) -> Result<bool, CallError> {
        self.set_desired(resource.id.clone(), Some(resource)).await
    }

    /// As [`Provider::offer`] for each of the resources, several at a time; returns the results by id.
    pub async fn offer_all(&self, resources: Vec<Resource>) -> Vec<(String, Result<bool, CallError>)> {
        let mut desired = self.shared.desired.lock().await;
        let ids: BTreeSet<String> = resources.iter().map(|resource| resource.id.clone()).collect();
        for resource in resources {
            self.shared.watch_for(&resource.kind);
            desired.want(resource.id.clone(), Some(resource));
        }
        self.shared.offer(&mut desired, &ids).await
    }

    /// Registers resources that an earlier process offered in the same session and that the manager still had when it was asked: they may
    /// be leased. With each comes the bound for standstill that it was offered with.
    pub async fn offered_before(&self, resources: Vec<(Resource, Option<Duration>)>) {
        let mut desired = self.shared.desired.lock().await;
        for (resource, standstill) in resources {
            self.shared.watch_for(&resource.kind);
            let entry = desired.want(resource.id.clone(), Some(resource));
            entry.presence = Presence::Unknown;
            entry.standstill = entry.standstill.max(standstill);
        }
    }

    /// Registers resources that an earlier session or process offered: what they were leased for may still move. Each is offered when its
    /// bound for standstill has passed from now on.
    pub async fn may_move(&self, resources: &[Resource]) {
        let desired = self.shared.desired.lock().await;
        for resource in resources {
            desired.bounds.lost(&resource.id, resource.standstill());
        }
    }

    /// Withdraws a resource; its holders lose their leases. True if it is gone now. False if the manager cannot be reached: the resource
    /// will be withdrawn as soon as possible.
    ///
    /// # Errors
    /// [`CallError::Refused`] if the manager refuses; it is not asked again.
    pub async fn withdraw(&self, id: &str) -> Result<bool, CallError> {
        self.set_desired(id.to_owned(), None).await
    }

    /// Withdraws a resource unless it is leased. True if it is gone now. False, and the resource stays, if it is leased or the manager
    /// cannot be reached.
    pub async fn withdraw_unless_held(&self, id: &str) -> bool {
        let mut desired = self.shared.desired.lock().await;
        let Some(resource) = desired.states.get(id).and_then(|entry| entry.resource.clone()) else { return true };
        if !self.shared.state.borrow().alive {
            return false;
        }
        // This call deletes only free resources, and no other resource has these attributes.
        let mut requirement = Requirement::new(ResourceOperation::Delete, resource.kind);
        requirement.class = Some(resource.class);
        requirement.attributes = resource.attributes;
        match answered(&self.shared.client, self.shared.client.delete_matching(requirement)).await {
            Ok(deleted) => {
                debug_assert_eq!(deleted, [id], "attributes of a resource are its own");
                desired.states.remove(id);
                true
            }
            Err(error) => {
                tracing::debug!(id, %error, "not withdrawn");
                false
            }
        }
    }

    async fn set_desired(&self, id: String, resource: Option<Resource>) -> Result<bool, CallError> {
        let mut desired = self.shared.desired.lock().await;
        if let Some(resource) = &resource {
            self.shared.watch_for(&resource.kind);
        }
        desired.want(id.clone(), resource);
        let asked = self.shared.offer(&mut desired, &BTreeSet::from([id])).await;
        asked.into_iter().next().map_or(Ok(true), |(_, done)| done)
    }

    /// The reason why the manager does not have an offered resource: another session has one of the same id. That session may end, so the
    /// resource is offered again.
    pub async fn refusal(&self, id: &str) -> Option<String> {
        self.shared.desired.lock().await.states.get(id).and_then(|entry| entry.taken.clone())
    }

    /// The offered resources, sorted by id.
    pub async fn offered(&self) -> Vec<Resource> {
        self.shared.desired.lock().await.states.values().filter_map(|entry| entry.resource.clone()).collect()
    }
}

impl Shared {
    fn watch_for(&self, kind: &str) {
        self.kinds.send_if_modified(|kinds| !kinds.contains(kind) && kinds.insert(kind.to_owned()));
    }

    /// Whether the manager confirms that it has a resource of this provider's session. Without an answer the resource is offered again,
    /// which changes nothing if the manager has it.
    async fn is_there(&self, id: &str) -> bool {
        answered(&self.client, self.client.get(id)).await.is_ok_and(|resource| self.is_own(&resource))
    }

    fn is_own(&self, resource: &Resource) -> bool {
        resource.session == self.session
    }

    /// Handles the loss of a resource at the manager: if it should be there, and was, it is offered again.
    async fn vanished(&self, id: &str, reason: &str) {
        let mut desired = self.desired.lock().await;
        let Desired { states, bounds } = &mut *desired;
        let is_known = |entry: &&mut DesiredState| entry.presence != Presence::Absent && entry.resource.is_some();
        let Some(entry) = states.get_mut(id).filter(is_known) else { return };
        entry.gone(id, bounds);
        if self.state.borrow().alive {
            tracing::warn!(
                resource = id,
                reason,
                "the resource manager lost a resource that is still here: it is offered again"
            );
        }
        self.missing.notify_one();
    }

    /// As [`Shared::ask`], for a caller that gets the refusal: a resource that is refused and absent is not desired any more.
    async fn offer(&self, desired: &mut Desired, ids: &BTreeSet<String>) -> Vec<(String, Result<bool, CallError>)> {
        let concluded = self.ask(desired, ids).await;
        for (id, _) in concluded.iter().filter(|(_, done)| done.is_err()) {
            if desired.states.get(id).is_some_and(|entry| entry.presence == Presence::Absent) {
                desired.states.remove(id);
            }
        }
        concluded
    }

    /// Makes the calls for these resources, several at a time, if the session lives. True: the desired state is reached; false: the call
    /// will be repeated. A resource that is gone, or may not be withdrawn, is not desired any more.
    async fn ask(&self, desired: &mut Desired, ids: &BTreeSet<String>) -> Vec<(String, Result<bool, CallError>)> {
        if !self.state.borrow().alive {
            self.missing.notify_one();
            return ids.iter().map(|id| (id.clone(), Ok(false))).collect();
        }
        self.look_at_session(desired);
        let (moving, ids): (BTreeSet<&String>, BTreeSet<&String>) = ids.iter().partition(|id| self.moves(desired, id));
        let mut before = BTreeMap::new();
        let mut asked = Vec::with_capacity(ids.len());
        for id in ids {
            let Some(entry) = desired.states.get_mut(id) else { continue };
            before.insert(id.clone(), entry.asked(id, &desired.bounds));
            asked.push(ask(self.client.clone(), id.clone(), entry.resource.clone()));
        }
        let answers: Vec<_> = stream::iter(asked).buffer_unordered(AT_ONCE).collect().await;
        let mut concluded = Vec::with_capacity(answers.len() + moving.len());
        for id in moving {
            tracing::debug!(resource = %id, "it is not known to be at rest: a goal may still run at it");
            self.missing.notify_one();
            concluded.push((id.clone(), Ok(false)));
        }
        for (id, answer) in answers {
            let Some(entry) = desired.states.get_mut(&id) else { continue };
            entry.learn(&id, before.get(&id).copied().unwrap_or_default(), &answer, &desired.bounds);
            let done = entry.conclude(&id, answer);
            match &done {
                Ok(false) => self.missing.notify_one(),
                Ok(true) if entry.resource.is_some() => entry.confirmed = true,
                // The manager may have had the resource, and have leased it.
                Err(_) if entry.resource.is_some() => self.missing.notify_one(),
                Ok(true) | Err(_) => drop(desired.states.remove(&id)),
            }
            concluded.push((id, done));
        }
        concluded
    }

    /// If the session was made again, nothing of the previous one is offered any more.
    fn look_at_session(&self, Desired { states, bounds }: &mut Desired) {
        let generation = self.state.borrow().generation;
        if self.generation.swap(generation, Ordering::SeqCst) != generation {
            states.iter_mut().for_each(|(id, entry)| entry.gone(id, bounds));
        }
    }

    /// Whether a resource that the manager does not have still moves, or may.
    fn moves(&self, desired: &Desired, id: &str) -> bool {
        let missing = |entry: &DesiredState| entry.resource.is_some() && entry.presence != Presence::There;
        desired.states.get(id).is_some_and(missing)
            && match &self.leases {
                // What an action moved that panicked may still move, though no goal runs.
                Some(leases) if leases.watches(id) => {
                    !leases.is_at_rest(id) || leases.has_panicked(id) && desired.bounds.may_move(id)
                }
                // Nobody knows which goals run beside it.
                Some(leases) => !leases.is_brought_to_rest() || desired.bounds.may_move(id),
                None => desired.bounds.may_move(id),
            }
    }
}

/// Creates or deletes a resource at the manager; returns its id and the answer.
async fn ask(client: ResourceClient, id: String, resource: Option<Resource>) -> (String, Result<(), CallError>) {
    let answer = match resource {
        Some(resource) => answered(&client, client.create(resource)).await.map(drop),
        None => answered(&client, client.delete(&id)).await,
    };
    (id, answer)
}

/// The manager's answer, or an error after [`ANSWERED_WITHIN`]: a manager that hangs does not break the connection.
async fn answered<T>(
    client: &ResourceClient,
    call: impl Future<Output = Result<T, CallError>>,
) -> Result<T, CallError> {
    timeout(ANSWERED_WITHIN, call).await.unwrap_or_else(|_| {
        let reason = format!("no answer within {} s", ANSWERED_WITHIN.as_secs());
        Err(CallError::Broken { endpoint: client.endpoint().clone(), reason })
    })
}

impl Desired {
    /// Sets the desired state of a resource: present with these values, or withdrawn.
    fn want(&mut self, id: String, resource: Option<Resource>) -> &mut DesiredState {
        let entry = self.states.entry(id).or_default();
        (entry.resource, entry.confirmed) = (resource, false);
        entry
    }
}

impl DesiredState {
    /// The manager does not have the resource any more; its former holder may move it until its bound has passed.
    fn gone(&mut self, id: &str, bounds: &Bounds) {
        self.confirmed = false;
        if std::mem::take(&mut self.presence) != Presence::Absent {
            bounds.lost(id, self.standstill);
        }
    }

    /// Records that the manager is being asked; returns the presence before that.
    fn asked(&mut self, id: &str, bounds: &Bounds) -> Presence {
        let before = self.presence;
        if let Some(resource) = &self.resource {
            self.standstill = self.standstill.max(resource.standstill());
            if before == Presence::Absent {
                self.presence = Presence::Unknown;
            }
            self.note(id, bounds);
        }
        before
    }

    /// Updates the presence by the manager's answer.
    fn learn(&mut self, id: &str, before: Presence, answer: &Result<(), CallError>, bounds: &Bounds) {
        match answer {
            Ok(()) if self.resource.is_some() => self.presence = Presence::There,
            // Withdrawn: its holder has lost it, and may not have heard yet.
            Ok(()) => self.gone(id, bounds),
            Err(error) => match error.code() {
                None | Some(Code::DeadlineExceeded) => {}
                // It was created and has gone since, or it was gone before it was withdrawn.
                Some(Code::NotFound) => self.gone(id, bounds),
                // The session is unknown now, and so are the resources that were offered in it.
                Some(Code::FailedPrecondition) => {
                    self.presence = before;
                    self.gone(id, bounds);
                }
                Some(_) => self.presence = before,
            },
        }
        self.note(id, bounds);
    }

    /// Notes whether the manager may have the resource, for the provider after this one.
    fn note(&self, id: &str, bounds: &Bounds) {
        match self.presence {
            Presence::Absent => bounds.not_offered(id),
            Presence::Unknown | Presence::There => bounds.offered(id, self.standstill),
        }
    }

    /// Whether the desired state is reached; an error if it never will be.
    fn conclude(&mut self, id: &str, answer: Result<(), CallError>) -> Result<bool, CallError> {
        match answer {
            Err(error) if self.resource.is_none() && error.code() == Some(Code::NotFound) => {}
            Err(error) if is_transient(&error) => {
                self.taken = (error.code() == Some(Code::AlreadyExists)).then(|| error.to_string());
                let problem = error.to_string();
                if self.problem != problem {
                    tracing::warn!(resource = %id, "the resource manager will be asked again: {problem}");
                    self.problem = problem;
                }
                return Ok(false);
            }
            Err(error) => {
                let problem = error.to_string();
                if self.problem != problem {
                    tracing::warn!(resource = %id, "the resource manager refuses: {problem}");
                    self.problem = problem;
                }
                return Err(error);
            }
            Ok(()) => {}
        }
        self.problem.clear();
        self.taken = None;
        Ok(true)
    }
}

/// Whether a retry may help: there was no answer, the session is unknown (not yet, or no longer, known), a session that has a resource of
/// the same id may end, or the resource was created and went with its session before the answer (`NotFound`).
fn is_transient(error: &CallError) -> bool {
    use Code::{AlreadyExists, DeadlineExceeded, FailedPrecondition, NotFound, ResourceExhausted};
    match error.code() {
        None => true,
        Some(code) => {
            matches!(code, FailedPrecondition | ResourceExhausted | DeadlineExceeded | AlreadyExists | NotFound)
        }
    }
}

/// Makes the calls whenever the session was made again, and as long as a desired state is not reached.
async fn restore(shared: Arc<Shared>) {
    let mut state = shared.state.clone();
    let mut restored = 0;
    loop {
        let Ok(generation) = state.wait_for(|s| s.alive).await.map(|s| s.generation) else { return };
        if generation == restored {
            tokio::select! {
                () = shared.missing.notified() => {}
                changed = state.changed() => match changed {
                    Ok(()) => continue,
                    Err(_) => return,
                },
            }
        }
        if let Some(pause) = ask_for_all(&shared).await {
            tokio::time::sleep(pause).await;
            shared.missing.notify_one();
        } else {
            restored = generation;
        }
    }
}

/// Makes the calls for everything that the manager has not confirmed; returns the pause before the next attempt, `None` if everything is
/// confirmed.
async fn ask_for_all(shared: &Shared) -> Option<Duration> {
    let mut desired = shared.desired.lock().await;
    if shared.state.borrow().alive {
        shared.look_at_session(&mut desired);
    }
    let open = desired.states.iter().filter(|(_, entry)| !entry.confirmed);
    let ids = open.map(|(id, _)| id.clone()).collect();
    let pause = |(_, done): (String, Result<bool, CallError>)| match done {
        Ok(true) => None,
        Ok(false) => Some(RETRY_INTERVAL),
        Err(_) => Some(REFUSED_INTERVAL),
    };
    shared.ask(&mut desired, &ids).await.into_iter().filter_map(pause).min()
}

/// Watches the offered resources, as long as there are any; starts again if the watch breaks or other kinds are offered.
async fn watch_own(shared: Arc<Shared>) {
    let mut kinds = shared.kinds.subscribe();
    loop {
        let now = kinds.borrow_and_update().clone();
        if !now.is_empty() {
            tokio::select! {
                () = watch_kinds(&shared, &now) => tokio::time::sleep(RETRY_INTERVAL).await,
                _ = kinds.changed() => {}
            }
        } else if kinds.changed().await.is_err() {
            return;
        }
    }
}

async fn watch_kinds(shared: &Shared, kinds: &BTreeSet<String>) {
    let kinds: Vec<&str> = kinds.iter().map(String::as_str).collect();
    let there = |desired: &Desired| -> BTreeSet<String> {
        let there = desired.states.iter().filter(|(_, entry)| entry.presence == Presence::There);
        there.map(|(id, _)| id.clone()).collect()
    };
    // Known before the snapshot is made: a resource that the snapshot lacks is gone.
    let before = there(&*shared.desired.lock().await);
    let Ok(mut watch) = answered(&shared.client, shared.client.watch(&kinds)).await else { return };
    while let Ok(Some(update)) = watch.next().await {
        match update {
            ResourceUpdate::Snapshot { resources, .. } => {
                let shown = resources.into_iter().filter(|resource| shared.is_own(resource));
                let shown: BTreeSet<String> = shown.map(|resource| resource.id).collect();
                let now = there(&*shared.desired.lock().await);
                for id in before.union(&now).filter(|id| !shown.contains(*id)) {
                    // A resource that came while the watch began may have come after the snapshot, or gone before it.
                    if before.contains(id) || !shared.is_there(id).await {
                        shared.vanished(id, "it went while nobody watched").await;
                    }
                }
            }
            ResourceUpdate::Event(event) if event.kind == ResourceEventKind::Deleted => {
                shared.vanished(&event.resource.id, &event.reason).await;
            }
            ResourceUpdate::Event(_) => {}
        }
    }
}
