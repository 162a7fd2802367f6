//! The action server: its builder and its requests.

use super::admission::{Admission, Limits, State};
use super::authority::{Authority, refusal};
use super::goal::{Ending, Fingerprint, GoalEntry, LeaseKey, StopCause};
use super::run::run;
use super::service::{Messages, described};
use super::{Action, GoalContext, NoResource};
use crate::access::Caller;
use crate::client::Channels;
use crate::gate::ending;
use crate::lease_watch::{Claim, ClaimStatus, EndedHolding, GRANT_WAIT, LeaseListener, LeaseWatch};
use crate::panic::exit_on_panic;
use crate::safety::Safety;
use crate::tls::ClientTls;
use crate::trace;
use ratn_model::catalogue::{ActionSignature, DescriptionError, WorkerDescription};
use ratn_proto::convert::check_size;
use ratn_proto::types::Goal;
use std::collections::BTreeMap;
use std::fmt;
use std::future::pending;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};
use tracing::Instrument;

/// Default number of results remembered per resource.
const RESULTS_KEPT: usize = 64;
/// Default maximum of goals begun on a resource under one lease; the id of each is remembered.
const GOALS_PER_LEASE: usize = 65_536;

/// Performs goals. A handle: clones share everything.
#[derive(Debug, Clone)]
pub struct ActionServer {
    pub(super) inner: Arc<Inner>,
}

/// Builds an [`ActionServer`].
pub struct ActionServerBuilder {
    resource: String,
    provider: String,
    kind: String,
    actions: BTreeMap<String, Arc<dyn Action>>,
    one_at_a_time: bool,
    results_kept: Option<usize>,
    goals_per_lease: Option<usize>,
    stuck_after: Option<Duration>,
    channels: Channels,
    safety: Safety,
    authority: Authority,
}

pub(super) struct Inner {
    pub(super) resource: String,
    pub(super) provider: String,
    pub(super) kind: String,
    pub(super) actions: BTreeMap<String, Arc<dyn Action>>,
    pub(super) limits: Limits,
    /// How long a goal that was told to stop may run on after its grace before the server counts as stuck; `None`: never.
    pub(super) stuck_after: Option<Duration>,
    /// Why the server is stuck, once it is.
    pub(super) stuck: watch::Sender<Option<String>>,
    pub(super) channels: Channels,
    pub(super) safety: Safety,
    pub(super) authority: Authority,
    state: Mutex<State>,
}

/// A goal's place among those that wait; dropping it gives up the place.
struct Waiting {
    server: Arc<Inner>,
    entry: Arc<GoalEntry>,
}

impl ActionServerBuilder {
    /// Adds an action. A second one of the same name replaces the first.
    #[must_use]
    pub fn action(mut self, action: impl Action) -> ActionServerBuilder {
        self.actions.insert(action.name().to_owned(), Arc::new(action));
        self
    }

    /// Sets the provider's name, `inspector` in the action `inspector/nearest` of a task, and the kind of its resource, for `Describe`.
    #[must_use]
    pub fn provides(mut self, provider: &str, kind: &str) -> ActionServerBuilder {
        (self.provider, self.kind) = (provider.to_owned(), kind.to_owned());
        self
    }

    /// The description that the server will answer `Describe` with.
    pub fn description(&self) -> WorkerDescription {
        let said = |action: &Arc<dyn Action>| {
            let signature = action.signature()?.said().clone();
            Some(ActionSignature { description: action.description().to_owned(), ..signature })
        };
        let actions = self.actions.iter().map(|(name, action)| (name.clone(), said(action))).collect();
        WorkerDescription { provider: self.provider.clone(), kind: self.kind.clone(), actions }
    }

    /// Checks whether clients will accept the description: its author learns here about a violated bound.
    ///
    /// # Errors
    /// [`DescriptionError`] of the first violation.
    pub fn check(&self) -> Result<(), DescriptionError> {
        for (name, action) in &self.actions {
            action.signature().map_or(Ok(()), |signature| signature.check_defaults(name))?;
        }
        self.description().check()?;
        check_size(&described(&self.resource, (&self.provider, &self.kind), &self.actions))
    }

    /// Makes a resource perform one goal at a time. A further goal is refused; but if the goal before it was told to stop, the further goal
    /// waits for its end.
    #[must_use]
    pub fn one_at_a_time(mut self) -> ActionServerBuilder {
        self.one_at_a_time = true;
        self
    }

    /// Sets how many results of each resource are remembered.
    #[must_use]
    pub fn results_kept(mut self, results: usize) -> ActionServerBuilder {
        self.results_kept = Some(results);
        self
    }

    /// Sets how many goals may begin on a resource under one lease.
    #[must_use]
    pub fn goals_per_lease(mut self, goals: usize) -> ActionServerBuilder {
        self.goals_per_lease = Some(goals);
        self
    }

    /// Sets how long a goal that was told to stop, and has not within [`STOP_GRACE`](super::STOP_GRACE), may run on before the server is [stuck](ActionServer::stuck).
    #[must_use]
    pub fn stuck_after(mut self, patience: Duration) -> ActionServerBuilder {
        self.stuck_after = Some(patience);
        self
    }

    /// Sets the watch by which the resource manager confirms leases; goals end with their lease. Without it every goal that needs a lease is
    /// refused.
    #[must_use]
    pub fn leases(mut self, watch: &LeaseWatch) -> ActionServerBuilder {
        self.authority = Authority::Watch(watch.clone());
        self
    }

    /// **For tests only.** Goals are performed without asking the resource manager for their lease: everybody who can reach the server can
    /// give it goals.
    #[must_use]
    pub fn dangerously_believe_every_lease(mut self) -> ActionServerBuilder {
        self.authority = Authority::Claimant;
        self
    }

    /// Sets the channels over which its actions call the world pool and other providers. Without it they reach no server with TLS.
    #[must_use]
    pub fn channels(mut self, channels: Channels) -> ActionServerBuilder {
        self.channels = channels;
        self
    }

    /// Sets the state of emergency stop and hold. While a stop is in force, its goals end and no goal begins. For a driver of hardware that
    /// moves.
    #[must_use]
    pub fn safety(mut self, safety: Safety) -> ActionServerBuilder {
        self.safety = safety;
        self
    }

    /// Makes the server. An action whose resource the [`LeaseWatch`] does not watch refuses every goal; a log line says so.
    pub fn build(self) -> ActionServer {
        if let Some(watch) = self.authority.watch() {
            let named = self.actions.values().flat_map(|action| match action.resources() {
                none if none.is_empty() => vec![self.resource.as_str()],
                named => named,
            });
            for resource in named.filter(|named| !named.is_empty() && watch.resources().iter().all(|of| of != named)) {
                tracing::error!(
                    resource,
                    "its leases are not watched, so its goals are refused: name it to LeaseWatch::of"
                );
            }
        }
        let inner = Arc::new(Inner {
            resource: self.resource,
            provider: self.provider,
            kind: self.kind,
            actions: self.actions,
            limits: Limits {
                one_at_a_time: self.one_at_a_time,
                results_kept: self.results_kept.unwrap_or(RESULTS_KEPT),
                goals_per_lease: self.goals_per_lease.unwrap_or(GOALS_PER_LEASE),
            },
            stuck_after: self.stuck_after,
            stuck: watch::Sender::default(),
            channels: self.channels,
            safety: self.safety,
            authority: self.authority,
            state: Mutex::default(),
        });
        if let Some(watch) = inner.authority.watch() {
            let listener: Weak<Inner> = Arc::downgrade(&inner);
            watch.listen(listener);
        }
        ActionServer { inner }
    }
}

impl ActionServer {
    /// Begins a server for the resource of this id: a goal needs a lease of it, which [`ActionServerBuilder::leases`] confirms. With an empty
    /// id no lease is asked for, except for actions that name a resource of their own. Of goals without a lease only the last results are
    /// remembered: one that is given again later is performed again.
    pub fn builder(resource: impl Into<String>) -> ActionServerBuilder {
        ActionServerBuilder {
            resource: resource.into(),
            provider: String::new(),
            kind: String::new(),
            actions: BTreeMap::new(),
            one_at_a_time: false,
            results_kept: None,
            goals_per_lease: None,
            stuck_after: None,
            channels: Channels::new(&ClientTls::none()),
            safety: Safety::default(),
            authority: Authority::default(),
        }
    }

    /// Shuts the server down before the process ends: no goal begins any more, every goal is told to stop, and the call returns when all
    /// actions have returned. A goal that did not come to its end in time counts as crashed for its client, as if the process had been
    /// killed. Give the resources back only after this has returned.
    pub async fn shut_down(&self) {
        let running = self.inner.state().close();
        for goal in running {
            goal.returned.cancelled().await;
        }
    }

    /// Resolves, with the reason for people, when a goal that was told to stop still runs after [`ActionServerBuilder::stuck_after`]. Such
    /// a goal ends only with the process.
    pub async fn stuck(&self) -> String {
        let mut stuck = self.inner.stuck.subscribe();
        let why = stuck.wait_for(Option::is_some).await.ok().and_then(|why| why.clone());
        // The sender belongs to this server.
        why.unwrap_or_default()
    }

    /// Tells a goal to stop, also if it still waits to begin. False if there is no such goal.
    pub fn cancel(&self, goal: &str) -> bool {
        let state = self.inner.state();
        let found = state.running().chain(state.waiting()).filter(|entry| entry.id == goal);
        found.map(|entry| entry.stop(StopCause::Cancelled)).count() > 0
    }

    /// How many goals run, including those that were told to stop and have not returned yet.
    pub fn running(&self) -> usize {
        self.inner.state().running().count()
    }

    /// How many goals wait: for their lease to be confirmed, or for the end of a goal that was told to stop.
    pub fn waiting(&self) -> usize {
        self.inner.state().waiting().count()
    }

    /// Finds a goal that was given before under the lease that it names; returns its messages.
    ///
    /// # Errors
    /// NOT_FOUND if the goal was never given under a live lease; FAILED_PRECONDITION if only its result has been forgotten; ALREADY_EXISTS
    /// if another goal has its id; PERMISSION_DENIED if another caller gave it.
    pub(super) fn join(&self, caller: &Caller, goal: &Goal, inputs: Fingerprint) -> Result<Messages, Status> {
        let (action, resource) = self.inner.performer(goal)?;
        let entry = GoalEntry::new(caller, goal, inputs, resource, action.cancel_when_abandoned());
        match self.inner.state().known(&self.inner.limits, caller, &entry)? {
            Some(entry) => Ok(Messages::of(&entry, true)),
            None => Err(Status::not_found(format!(
                "goal {} is not known here: never given under the lease that it names, or forgotten with it",
                goal.id
            ))),
        }
    }

    /// Starts a goal, or finds the one of the same id, lease, action and inputs; returns its messages.
    ///
    /// # Errors
    /// A status that says why not.
    pub(super) async fn admit(&self, caller: &Caller, goal: Goal, inputs: Fingerprint) -> Result<Messages, Status> {
        let (action, resource) = self.inner.performer(&goal)?;
        let entry = GoalEntry::new(caller, &goal, inputs, resource, action.cancel_when_abandoned());
        let heard_by = Instant::now() + GRANT_WAIT;
        let mut waiting = None;
        loop {
            // Subscribe first, so that no update from here on is missed.
            let heard = self.inner.authority.watch().map(LeaseWatch::heard);
            let admission = self.inner.state().admit(&self.inner, caller, &goal, &entry)?;
            let (predecessor, refused) = match admission {
                Admission::Joined(entry) => return Ok(Messages::of(&entry, true)),
                Admission::Stopped(StopCause::ShuttingDown) => return Err(ending()),
                Admission::Stopped(cause) => {
                    let outcome = cause.failure().into();
                    entry.result.send_replace(Some(Ending::Outcome { outcome, orphaned: false, may_move: false }));
                    return Ok(Messages::of(&entry, false));
                }
                Admission::New => {
                    // Subscribe before the action can report anything.
                    let messages = Messages::of(&entry, false);
                    let deadline_ms = goal.deadline_ms;
                    let (channels, safety) = (self.inner.channels.clone(), self.inner.safety.clone());
                    let context = GoalContext::new(goal, Arc::clone(&entry), channels, safety);
                    let action = Arc::clone(action);
                    let running = run(Arc::clone(&self.inner), entry, action, context, deadline_ms);
                    let running = trace::within_any(trace::current(), running).in_current_span();
                    tokio::spawn(exit_on_panic("the task of a goal", running));
                    return Ok(messages);
                }
                Admission::After(other) => (Some(other), None),
                Admission::Awaiting(refused) => (None, Some(refused)),
            };
            if waiting.is_none() {
                // A close or cancel between two checks is found at the next check.
                self.inner.state().wait(caller, &entry)?;
                waiting = Some(Waiting { server: Arc::clone(&self.inner), entry: Arc::clone(&entry) });
                continue;
            }
            let over = async {
                match &predecessor {
                    Some(other) => other.over().await,
                    None => sleep_until(heard_by).await,
                }
            };
            tokio::select! {
                biased;
                () = entry.cancelled.cancelled() => {}
                // A stop counts even if it is cleared before the goal's turn: nobody expects a motion then.
                reason = self.inner.safety.stopped() => entry.stop(StopCause::EmergencyStop(reason)),
                () = changed(heard) => {}
                () = over => if let Some(refused) = refused {
                    return Err(refused);
                },
            }
        }
    }
}

/// Returns at the next update of the watch; never returns without a watch.
async fn changed(heard: Option<watch::Receiver<u64>>) {
    match heard {
        // The sender is in the watch, which is in the server.
        Some(mut heard) => drop(heard.changed().await),
        None => pending().await,
    }
}

impl Inner {
    /// The action of a goal, and the resource of which the goal needs a lease.
    pub(super) fn performer(&self, goal: &Goal) -> Result<(&Arc<dyn Action>, &str), Status> {
        let action = &goal.action;
        let Some(found) = self.actions.get(action) else {
            let known: Vec<&str> = self.actions.keys().map(String::as_str).collect();
            let message = format!("no action `{action}`: there are {}", known.join(", "));
            return Err(Status::invalid_argument(message));
        };
        let resource = found.resource_for(goal).map_err(|why| match why {
            NoResource::Input(why) => Status::invalid_argument(why),
            NoResource::Lease(why) => refusal(Code::FailedPrecondition, "NO_LEASE", why),
        })?;
        Ok((found, resource.unwrap_or(&self.resource)))
    }

    fn stop_where(&self, which: impl Fn(&GoalEntry) -> bool, cause: &StopCause) {
        self.state().running().filter(|goal| which(goal)).for_each(|goal| goal.stop(cause.clone()));
    }

    pub(super) fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.server.state().leave(&self.entry);
    }
}

impl LeaseListener for Inner {
    fn lease_ended(&self, ended: &EndedHolding) {
        let lease = Some((ended.lease, ended.token));
        let is_under = |goal: &GoalEntry| goal.lease == lease && goal.resource == ended.resource;
        self.stop_where(is_under, &StopCause::LeaseEnded(ended.reason.clone()));
    }

    fn leases_unheard(&self, reason: &str) {
        let state = self.state();
        for goal in state.running().filter(|goal| !goal.resource.is_empty()) {
            if self.actions.get(&goal.action).is_some_and(|action| action.can_be_suspended()) {
                goal.suspend(true);
            } else {
                goal.stop(StopCause::LeaseUnheard(reason.to_owned()));
            }
        }
    }

    fn leases_heard(&self) {
        let Some(watch) = self.authority.watch() else { return };
        let state = self.state();
        for goal in state.running().filter(|goal| goal.is_suspended()) {
            let standing = goal.lease.map(|(lease, token)| {
                watch.check(&Claim { resource: &goal.resource, lease, token, session: &goal.session })
            });
            match standing {
                Some(ClaimStatus::Confirmed) => goal.suspend(false),
                // The watch has lost its trust in the manager again; the manager's next message decides.
                Some(ClaimStatus::Unheard(_)) => {}
                _ => goal.stop(StopCause::LeaseEnded("it ended while the resource manager was not heard".to_owned())),
            }
        }
    }

    fn leases_lost(&self, reason: &str) {
        self.stop_where(|goal| !goal.resource.is_empty(), &StopCause::LeaseUnheard(reason.to_owned()));
    }

    fn under_way(&self, resource: &str, lease: Option<LeaseKey>) -> Vec<CancellationToken> {
        let state = self.state();
        // What a panicked action moved is never known to stand still: this one does not fire.
        let for_ever = lease.filter(|_| state.has_panicked(resource, lease)).map(|_| CancellationToken::new());
        let at = state.running().filter(|goal| goal.resource == resource);
        let at = at.filter(|goal| lease.is_none() || goal.lease == lease).map(|goal| goal.returned.clone());
        at.chain(for_ever).collect()
    }

    fn has_panicked(&self, resource: &str) -> bool {
        self.state().has_panicked(resource, None)
    }
}

impl fmt::Debug for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ActionServer").field("resource", &self.resource).field("state", &self.state).finish()
    }
}

impl fmt::Debug for ActionServerBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let actions: Vec<&String> = self.actions.keys().collect();
        f.debug_struct("ActionServerBuilder").field("resource", &self.resource).field("actions", &actions).finish()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::action::ActionResult;
    use ratn_model::id::{FencingToken, LeaseId};
    use ratn_model::resource::{Lease, LeasedResource};
    use ratn_proto::types::GoalOutcome;
    use ratn_proto::v1::execute_response::Kind;
    use tokio::time::timeout;

    /// Moves until it is told to stop; then it panics, or stands still.
    struct Moves {
        panics: bool,
    }

    #[tonic::async_trait]
    impl Action for Moves {
        fn name(&self) -> &str {
            "move"
        }

        async fn execute(&self, goal: GoalContext) -> ActionResult {
            goal.cancelled.cancelled().await;
            assert!(!self.panics, "on purpose");
            Ok(GoalOutcome::success())
        }
    }

    const OWN: LeaseKey = (LeaseId(7), FencingToken(70));

    /// A server with a goal under way, its messages, and the watch that it listens to.
    async fn moving(panics: bool) -> (ActionServer, Messages, LeaseWatch) {
        let server = ActionServer::builder("arm").dangerously_believe_every_lease().action(Moves { panics }).build();
        let watch = LeaseWatch::of(["arm"]);
        let listener: Weak<Inner> = Arc::downgrade(&server.inner);
        watch.listen(listener);
        let (id, kind, endpoint) = ("arm".to_owned(), "Arm".to_owned(), String::new());
        let resources = vec![LeasedResource { id, kind, endpoint, superclasses: Vec::new() }];
        let lease = Lease { id: OWN.0, token: OWN.1, resources, consumed: Vec::new() };
        let goal = Goal { id: "g".to_owned(), action: "move".to_owned(), lease: Some(lease), ..Goal::default() };
        let messages = server.admit(&Caller::default(), goal, Fingerprint::of(None)).await.unwrap();
        (server, messages, watch)
    }

    async fn may_move(messages: &mut Messages) -> bool {
        loop {
            if let Kind::Result(result) = messages.next().await.unwrap().unwrap() {
                return result.may_move;
            }
        }
    }

    #[tokio::test]
    async fn what_a_panicked_action_moved_is_not_known_to_stand_still_whether_its_lease_ends_before_or_after() {
        for panics in [true, false] {
            // The calls of the goal go on for a while, or there are none.
            for calls in [true, false] {
                let (server, mut messages, watch) = moving(panics).await;
                let call = calls.then(|| server.inner.state().running().next().unwrap().calls.counted());
                let mut before = stands_still(watch.clone());
                assert!(timeout(Duration::from_millis(5), &mut before).await.is_err(), "it moves");
                server.cancel("g");
                tokio::time::sleep(Duration::from_millis(5)).await;
                drop(call);
                assert_eq!(may_move(&mut messages).await, panics);
                for rests in [before, stands_still(watch)] {
                    let rests = timeout(Duration::from_millis(20), rests).await;
                    assert_eq!(rests.is_err(), panics, "{calls}");
                }
                timeout(Duration::from_secs(9), server.shut_down()).await.unwrap();
                let under_way = |resource: &str, lease| server.inner.under_way(resource, lease).len();
                let other = Some((LeaseId(8), FencingToken(80)));
                assert_eq!([under_way("arm", other), under_way("leg", Some(OWN)), under_way("arm", None)], [0, 0, 0]);
            }
        }
    }

    /// Returns when it is known that the arm stands still.
    fn stands_still(watch: LeaseWatch) -> std::pin::Pin<Box<dyn Future<Output = bool>>> {
        Box::pin(async move { watch.stands_still("arm", OWN).await })
    }
}
