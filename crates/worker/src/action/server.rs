//! The goals of one server: who may start, what runs, what is remembered.

use super::authority::{Authority, Confirmation, refusal};
use super::fence::Fence;
use super::goal::{Ending, GoalEntry, StopCause};
use super::memory::{Known, Memory};
use super::service::Messages;
use super::{Action, ActionFailure, ActionResult, GoalContext};
use crate::client::Channels;
use crate::lease_watch::{EndedHolding, GRANT_WAIT, LeaseListener, LeaseWatch};
use crate::safety::{Safety, SafetyState};
use crate::trace;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::Lease;
use ratn_proto::MAX_PORTS_BYTES;
use ratn_proto::convert::{ports_bytes, value_bytes, wire_ports};
use ratn_proto::types::{Goal, GoalOutcome};
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio::task::JoinError;
use tokio::time::{Instant, timeout_at};
use tonic::{Code, Status};
use tracing::Instrument;

/// Of each resource so many results are remembered unless said otherwise.
const RESULTS_KEPT: usize = 64;
/// Under one lease so many goals are begun on a resource at the most, unless said otherwise: the id of each is remembered.
const GOALS_PER_LEASE: usize = 65_536;
/// At most so many goals wait for a word of their lease.
const MAX_AWAITED: usize = 256;
/// At most so many goals run at once.
const MAX_RUNNING: usize = 64;
/// A goal that was told to stop and does not is ended hard after this long.
const STOP_GRACE: Duration = Duration::from_secs(3);

/// Performs goals. A handle: clones share everything.
#[derive(Debug, Clone)]
pub struct ActionServer {
    pub(super) inner: Arc<Inner>,
}

/// What an [`ActionServer`] shall be.
#[derive(Default)]
pub struct ActionServerBuilder {
    resource: String,
    actions: BTreeMap<String, Arc<dyn Action>>,
    one_at_a_time: bool,
    results_kept: Option<usize>,
    goals_per_lease: Option<usize>,
    channels: Channels,
    safety: Safety,
    authority: Authority,
}

pub(super) struct Inner {
    pub(super) resource: String,
    pub(super) actions: BTreeMap<String, Arc<dyn Action>>,
    one_at_a_time: bool,
    results_kept: usize,
    goals_per_lease: usize,
    channels: Channels,
    safety: Safety,
    authority: Authority,
    /// Room for goals that wait for a word of their lease.
    awaited: Semaphore,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    fence: Fence,
    memory: Memory,
    running: Vec<Arc<GoalEntry>>,
}

/// What became of a request for a goal.
pub(super) enum Admission {
    /// It starts.
    New(Arc<GoalEntry>, Arc<dyn Action>),
    /// It was known.
    Joined(Arc<GoalEntry>),
    /// It has to wait until this one, told to stop, has ended.
    After(Arc<GoalEntry>),
    /// It has to wait for what the resource manager says of its lease; this is the refusal if that takes too long.
    Awaiting(Status),
}

impl ActionServerBuilder {
    /// With an action. A second one of the same name replaces the first.
    #[must_use]
    pub fn action(mut self, action: impl Action) -> ActionServerBuilder {
        self.actions.insert(action.name().to_owned(), Arc::new(action));
        self
    }

    /// A resource performs one goal at a time: a further one is refused, unless the one before was told to stop.
    #[must_use]
    pub fn one_at_a_time(mut self) -> ActionServerBuilder {
        self.one_at_a_time = true;
        self
    }

    /// Remembers this many results of each resource.
    #[must_use]
    pub fn results_kept(mut self, results: usize) -> ActionServerBuilder {
        self.results_kept = Some(results);
        self
    }

    /// Begins at the most this many goals on a resource under one lease.
    #[must_use]
    pub fn goals_per_lease(mut self, goals: usize) -> ActionServerBuilder {
        self.goals_per_lease = Some(goals);
        self
    }

    /// Goals are performed under leases that the resource manager confirms, and end with them. Without this every goal that needs a
    /// lease is refused.
    #[must_use]
    pub fn leases(mut self, watch: &LeaseWatch) -> ActionServerBuilder {
        self.authority = Authority::Watch(watch.clone());
        self
    }

    /// **For tests only.** Believes whatever a goal says of its lease: whoever reaches the server moves what it moves.
    #[must_use]
    pub fn dangerously_believe_every_lease(mut self) -> ActionServerBuilder {
        self.authority = Authority::Claimant;
        self
    }

    /// Over channels that others use too.
    #[must_use]
    pub fn channels(mut self, channels: Channels) -> ActionServerBuilder {
        self.channels = channels;
        self
    }

    /// Its goals end, and further ones are not begun, while an emergency stop is in force: for what moves something.
    #[must_use]
    pub fn safety(mut self, safety: Safety) -> ActionServerBuilder {
        self.safety = safety;
        self
    }

    /// The server.
    pub fn build(self) -> ActionServer {
        let inner = Arc::new(Inner {
            resource: self.resource,
            actions: self.actions,
            one_at_a_time: self.one_at_a_time,
            results_kept: self.results_kept.unwrap_or(RESULTS_KEPT),
            goals_per_lease: self.goals_per_lease.unwrap_or(GOALS_PER_LEASE),
            channels: self.channels,
            safety: self.safety,
            authority: self.authority,
            awaited: Semaphore::new(MAX_AWAITED),
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
    /// A server that is `resource`: a goal needs a lease of it, which [`ActionServerBuilder::leases`] confirms. With an empty name
    /// no lease is asked for, except by actions that name a resource of their own.
    pub fn builder(resource: impl Into<String>) -> ActionServerBuilder {
        ActionServerBuilder { resource: resource.into(), ..ActionServerBuilder::default() }
    }

    /// Ends with the process: tells every goal to stop, and returns when all have ended. Their clients hear what they would
    /// hear if the process had been killed, unless a goal made it in time: a crash of the attempt, not an outcome.
    pub async fn shut_down(&self) {
        self.inner.stop_where(|_| true, &StopCause::ShuttingDown);
        let running = self.inner.state().running.clone();
        for goal in running {
            goal.over().await;
        }
    }

    /// Tells a goal to stop; whether it was under way.
    pub fn cancel(&self, goal: &str) -> bool {
        self.inner.stop_where(|entry| entry.id == goal, &StopCause::Cancelled) > 0
    }

    /// How many goals run.
    pub fn running(&self) -> usize {
        self.inner.state().running.len()
    }

    /// How many goals wait for a word of their lease.
    pub fn awaiting(&self) -> usize {
        MAX_AWAITED - self.inner.awaited.available_permits()
    }

    /// Finds a goal that was given before; what is to be heard of it.
    ///
    /// # Errors
    /// NOT_FOUND where it was never given under a lease that lives; FAILED_PRECONDITION where only its result has been forgotten.
    pub(super) fn join(&self, goal: &str) -> Result<Messages, Status> {
        match self.inner.state().memory.find(goal) {
            Known::Entry(entry) => Ok(Messages::of(&entry, true)),
            Known::ResultForgotten(lease) => Err(forgotten(goal, lease, self.inner.results_kept)),
            Known::Never => Err(Status::not_found(format!(
                "goal {goal} is not known here: never given, or forgotten with its lease"
            ))),
        }
    }

    /// Starts a goal, or finds the one of the same id; what is to be heard of it.
    ///
    /// # Errors
    /// A status that says why not.
    pub(super) async fn admit(&self, goal: Goal) -> Result<Messages, Status> {
        let heard_by = Instant::now() + GRANT_WAIT;
        let mut room = None;
        loop {
            // What is heard from here on is not missed.
            let heard = self.inner.authority.watch().map(LeaseWatch::heard);
            let admission = self.inner.state().admit(&self.inner, &goal)?;
            match admission {
                Admission::Joined(entry) => return Ok(Messages::of(&entry, true)),
                Admission::New(entry, action) => {
                    // Listens before the action can say anything.
                    let messages = Messages::of(&entry, false);
                    let deadline_ms = goal.deadline_ms;
                    let (channels, safety) = (self.inner.channels.clone(), self.inner.safety.clone());
                    let context = GoalContext::new(goal, Arc::clone(&entry), channels, safety);
                    let running = run(Arc::clone(&self.inner), entry, action, context, deadline_ms);
                    tokio::spawn(trace::within_any(trace::current(), running).in_current_span());
                    return Ok(messages);
                }
                // Ends within the grace: the runner sees to it.
                Admission::After(entry) => entry.over().await,
                Admission::Awaiting(refused) => {
                    if room.is_none() {
                        room = Some(self.inner.awaited.try_acquire().map_err(|_| too_many_awaited())?);
                    }
                    let Some(mut heard) = heard else { return Err(refused) };
                    // The sender is in the watch, which is in the server.
                    let Ok(_) = timeout_at(heard_by, heard.changed()).await else { return Err(refused) };
                }
            }
        }
    }
}

impl Inner {
    fn stop_where(&self, which: impl Fn(&GoalEntry) -> bool, cause: &StopCause) -> usize {
        let state = self.state();
        state.running.iter().filter(|goal| which(goal)).map(|goal| goal.stop(cause.clone())).count()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LeaseListener for Inner {
    fn lease_ended(&self, ended: &EndedHolding) {
        let is_under = |goal: &GoalEntry| goal.lease == Some(ended.lease) && goal.resource == ended.resource;
        self.stop_where(is_under, &StopCause::LeaseEnded(ended.reason.clone()));
    }

    fn leases_lost(&self, reason: &str) {
        self.stop_where(|goal| !goal.resource.is_empty(), &StopCause::LeaseUnheard(reason.to_owned()));
    }
}

impl State {
    fn admit(&mut self, server: &Inner, goal: &Goal) -> Result<Admission, Status> {
        let Some(action) = server.actions.get(&goal.action) else {
            let known: Vec<&str> = server.actions.keys().map(String::as_str).collect();
            let message = format!("no action `{}`: there are {}", goal.action, known.join(", "));
            return Err(Status::invalid_argument(message));
        };
        match self.memory.find(&goal.id) {
            Known::Entry(entry) => return Ok(Admission::Joined(entry)),
            Known::ResultForgotten(lease) => return Err(forgotten(&goal.id, lease, server.results_kept)),
            Known::Never => {}
        }
        let resource = action.resource().unwrap_or(&server.resource);
        if !resource.is_empty() {
            let lease = leased(goal, resource)?;
            if let Confirmation::Awaited(refused) = server.authority.confirm(goal, lease, resource)? {
                return Ok(Admission::Awaiting(refused));
            }
            self.fence(lease, resource)?;
            if self.memory.begun_under(resource, lease.id) >= server.goals_per_lease {
                let (most, lease) = (server.goals_per_lease, lease.id);
                let message = format!("{most} goals of {resource} were begun under {lease}: no more; acquire it anew");
                return Err(refusal(Code::ResourceExhausted, "TOO_MANY_GOALS", message));
            }
        }
        if server.one_at_a_time
            && let Some(other) = self.running.iter().find(|other| other.resource == resource)
        {
            if other.cancelled.is_cancelled() {
                return Ok(Admission::After(Arc::clone(other)));
            }
            let message = format!("busy with goal {}: one goal at a time", other.id);
            return Err(Status::resource_exhausted(message));
        }
        if self.running.len() >= MAX_RUNNING {
            let message = format!("{MAX_RUNNING} goals are under way: no more at once");
            return Err(Status::resource_exhausted(message));
        }
        let entry = GoalEntry::new(goal, resource.to_owned(), action.cancel_when_abandoned());
        self.memory.begin(&entry);
        self.running.push(Arc::clone(&entry));
        Ok(Admission::New(entry, Arc::clone(action)))
    }

    /// Refuses an older lease than one seen; stops goals of older ones. Only what is confirmed gets here.
    fn fence(&mut self, lease: &Lease, resource: &str) -> Result<(), Status> {
        self.fence.admit(resource, lease.token).map_err(|highest: FencingToken| {
            let (id, token) = (lease.id, lease.token);
            let message = format!("{id} ({token}) of {resource} is over: {highest} was seen since; acquire it anew");
            refusal(Code::FailedPrecondition, "LEASE_FENCED", message)
        })?;
        for other in self.running.iter().filter(|other| other.resource == resource && other.token < lease.token) {
            other.stop(StopCause::Fenced(lease.token));
        }
        Ok(())
    }

    fn end(&mut self, entry: &GoalEntry, results_kept: usize) {
        self.running.retain(|other| other.id != entry.id);
        self.memory.end(entry, results_kept);
    }
}

/// The goal's lease, which has to name `resource`.
fn leased<'a>(goal: &'a Goal, resource: &str) -> Result<&'a Lease, Status> {
    let names = |lease: &&Lease| lease.resources.iter().any(|leased| leased.id == resource);
    goal.lease.as_ref().filter(names).ok_or_else(|| {
        let message = format!("the goal has no lease of {resource}: acquire it and send the lease along");
        refusal(Code::FailedPrecondition, "NO_LEASE", message)
    })
}

fn forgotten(goal: &str, lease: LeaseId, results_kept: usize) -> Status {
    let message = format!(
        "goal {goal} was begun under {lease} and has ended; its result is not among the last {results_kept} of its resource, which \
         are remembered, and it is not begun again"
    );
    refusal(Code::FailedPrecondition, "RESULT_FORGOTTEN", message)
}

fn too_many_awaited() -> Status {
    let message = format!("{MAX_AWAITED} goals wait here for a word of their leases: try again in a moment");
    refusal(Code::ResourceExhausted, "TOO_MANY", message)
}

/// Runs a goal to its end, whatever its action does.
async fn run(
    server: Arc<Inner>,
    entry: Arc<GoalEntry>,
    action: Arc<dyn Action>,
    context: GoalContext,
    deadline_ms: u64,
) {
    tracing::debug!(goal = %entry.id, action = %context.action, "begun");
    let performing = trace::within_any(trace::current(), async move {
        match context.safety.state() {
            SafetyState::Stopped { reason } => Err(ActionFailure::emergency_stop(&reason)),
            _ => action.execute(context).await,
        }
    });
    let mut performing = tokio::spawn(performing.in_current_span());
    let deadline = async {
        if deadline_ms > 0 {
            tokio::time::sleep(Duration::from_millis(deadline_ms)).await;
            entry.stop(StopCause::Deadline);
        }
        // It only tells the goal to stop; the goal ends by itself, or is overdue.
        std::future::pending::<Infallible>().await
    };
    let stopped = async {
        entry.stop(StopCause::EmergencyStop(server.safety.stopped().await));
        std::future::pending::<Infallible>().await
    };
    let overdue = async {
        entry.cancelled.cancelled().await;
        tokio::time::sleep(STOP_GRACE).await;
    };
    let result = tokio::select! {
        biased;
        performed = &mut performing => result_of(performed),
        () = overdue => {
            performing.abort();
            let cause = GoalOutcome::from(entry.stopped()).reason;
            Err(ActionFailure::Aborted(format!("{cause}; it did not stop within {} s", STOP_GRACE.as_secs())))
        }
        never = deadline => match never {},
        never = stopped => match never {},
    };
    let lost = result.as_ref().is_err_and(|failure| matches!(failure, ActionFailure::Lost(_)));
    let outcome = bounded(result.unwrap_or_else(GoalOutcome::from));
    let outcome = match entry.cause() {
        // Whatever the action makes of being stopped.
        Some(cause @ StopCause::EmergencyStop(_)) if !outcome.is_success() => cause.failure().into(),
        _ => outcome,
    };
    tracing::debug!(goal = %entry.id, outcome = %outcome.outcome, reason = %outcome.reason, "ended");
    // No longer running before anybody hears of its end: the next goal must find its place free.
    server.state().end(&entry, server.results_kept);
    let ending = match entry.cause() {
        Some(StopCause::ShuttingDown) if !outcome.is_success() => Ending::Gone,
        None if lost => Ending::Lost(outcome.reason),
        cause => {
            let orphaned = !outcome.is_success() && cause.is_some_and(|cause| cause.is_orphaning());
            Ending::Outcome(outcome, orphaned)
        }
    };
    entry.result.send_replace(Some(ending));
}

/// An outcome whose outputs fit into a message; a failure that says what does not, otherwise.
fn bounded(outcome: GoalOutcome) -> GoalOutcome {
    let outputs = wire_ports(outcome.outputs.clone());
    let bytes = ports_bytes(&outputs);
    if bytes <= MAX_PORTS_BYTES {
        return outcome;
    }
    let largest = outcome.outputs.iter().max_by_key(|(name, _)| value_bytes(&outputs[*name]));
    let largest = largest.map_or("", |(name, _)| name.as_str());
    let reason =
        format!("the outputs have {bytes} bytes, most of them `{largest}`: at most {MAX_PORTS_BYTES} are sent");
    ActionFailure::Aborted(reason).into()
}

fn result_of(performed: Result<ActionResult, JoinError>) -> ActionResult {
    performed.unwrap_or_else(|error| {
        Err(ActionFailure::Aborted(match error.try_into_panic() {
            Ok(panic) => format!("the action panicked: {}", panic_message(&*panic)),
            Err(error) => format!("the action was torn down: {error}"),
        }))
    })
}

fn panic_message(panic: &(dyn std::any::Any + Send)) -> &str {
    match (panic.downcast_ref::<&str>(), panic.downcast_ref::<String>()) {
        (Some(text), _) => text,
        (_, Some(text)) => text,
        _ => "no message",
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
