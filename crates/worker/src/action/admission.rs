//! Admission control of goals: which goals run, wait or are remembered on a server, and which requests are refused.
//!
//! ```text
//! asked ─ known ────────────────────────────→ joined, or refused: another goal has its id, or its result was forgotten
//!   ├─ no lease, another's, an ended one ──────→ refused
//!   ├─ its lease is not confirmed yet ─────────→ waits for that, at most a second
//!   ├─ a goal told to stop still runs ─────────→ waits for its end; refused when that goal is overdue
//!   ├─ busy, too many goals ───────────────────→ refused
//!   └→ new
//! ```

use super::authority::{Authority, Confirmation, refusal, retry_later};
use super::fence::Fence;
use super::goal::{GoalEntry, LeaseKey, StopCause};
use super::memory::{Asked, Known, Memory};
use super::run::STOP_GRACE;
use super::server::Inner;
use crate::access::Caller;
use crate::gate::ending;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::Lease;
use ratn_proto::types::Goal;
use std::collections::VecDeque;
use std::sync::Arc;
use tonic::{Code, Status};

/// Maximum number of goals that wait at once.
const MAX_WAITING: usize = 1_024;
/// Maximum number of waiting goals of one caller, so that other callers find room.
const MAX_WAITING_PER_CALLER: usize = 128;
/// Maximum number of goals that run at once on one resource.
const MAX_RUNNING: usize = 64;
/// Maximum number of remembered leases under which an action panicked.
const MAX_PANICKED: usize = 1_024;
/// Reason code (for programs) of a refusal because too many goals wait.
pub(crate) const TOO_MANY_WAITING: &str = "TOO_MANY_WAITING";

/// Limits that a server was built with.
#[derive(Debug)]
pub(super) struct Limits {
    /// A resource performs one goal at a time.
    pub(super) one_at_a_time: bool,
    /// Results remembered per resource.
    pub(super) results_kept: usize,
    /// Maximum number of goals begun on a resource under one lease.
    pub(super) goals_per_lease: usize,
}

/// The goals of a server.
#[derive(Debug, Default)]
pub(super) struct State {
    fence: Fence,
    memory: Memory,
    /// Goals whose actions have not returned yet.
    running: Vec<Arc<GoalEntry>>,
    waiting: Vec<WaitingGoal>,
    /// Leases under which an action panicked: what it moved may still move, and nobody knows when that ends. The last ones.
    panicked: VecDeque<(String, LeaseKey)>,
    /// The provider shuts down: no goal begins any more.
    closed: bool,
}

#[derive(Debug)]
struct WaitingGoal {
    caller: Arc<str>,
    entry: Arc<GoalEntry>,
}

/// The result of a request for a goal.
pub(super) enum Admission {
    /// The goal starts.
    New,
    /// The goal was known: the request joins it.
    Joined(Arc<GoalEntry>),
    /// The goal was told to stop while it waited.
    Stopped(StopCause),
    /// The goal has to wait until this other goal, which was told to stop, has ended.
    After(Arc<GoalEntry>),
    /// The goal has to wait for the resource manager's report of its lease; this is the refusal if the report takes too long.
    Awaiting(Status),
}

impl State {
    pub(super) fn running(&self) -> impl Iterator<Item = &GoalEntry> {
        self.running.iter().map(|entry| &**entry)
    }

    pub(super) fn waiting(&self) -> impl Iterator<Item = &GoalEntry> {
        self.waiting.iter().map(|waiting| &*waiting.entry)
    }

    /// Cancels the goal of this id, also if it still waits to begin; returns whether there was such a goal.
    ///
    /// # Errors
    /// PERMISSION_DENIED if all goals of this id were given by other callers.
    pub(super) fn cancel(&self, caller: &Caller, id: &str) -> Result<bool, Status> {
        let found: Vec<&GoalEntry> = self.running().chain(self.waiting()).filter(|entry| entry.id == id).collect();
        let own: Vec<&&GoalEntry> = found.iter().filter(|entry| caller.may_end_for(&entry.giver)).collect();
        match (own.as_slice(), found.first()) {
            ([], Some(other)) => Err(not_yours(caller, other)),
            (own, _) => {
                own.iter().for_each(|entry| entry.stop(StopCause::Cancelled));
                Ok(!own.is_empty())
            }
        }
    }

    /// Shuts down: no goal begins any more, and every goal is told to stop. Returns the running goals.
    pub(super) fn close(&mut self) -> Vec<Arc<GoalEntry>> {
        self.closed = true;
        self.running().chain(self.waiting()).for_each(|entry| entry.stop(StopCause::ShuttingDown));
        self.running.clone()
    }

    /// The goal of the same id, lease, action and inputs, if there is one.
    ///
    /// # Errors
    /// FAILED_PRECONDITION if its result has been forgotten; ALREADY_EXISTS if another goal has its id; PERMISSION_DENIED if another caller
    /// gave it.
    pub(super) fn known(
        &self,
        limits: &Limits,
        caller: &Caller,
        entry: &GoalEntry,
    ) -> Result<Option<Arc<GoalEntry>>, Status> {
        match self.memory.find(&Asked::from(entry)) {
            Known::Entry(known) if !caller.may_end_for(&known.giver) => Err(not_yours(caller, &known)),
            Known::Entry(known) => Ok(Some(known)),
            Known::Never => Ok(None),
            Known::ResultForgotten(lease) => Err(forgotten(&entry.id, lease, limits.results_kept)),
            Known::Other(difference) => {
                let id = &entry.id;
                let message = format!("there is another goal {id}: {difference}; give this one an id of its own");
                Err(refusal(Code::AlreadyExists, "ANOTHER_GOAL", message))
            }
        }
    }

    /// Admits a goal, or says why not.
    pub(super) fn admit(
        &mut self,
        server: &Inner,
        caller: &Caller,
        goal: &Goal,
        entry: &Arc<GoalEntry>,
    ) -> Result<Admission, Status> {
        if let Some(cause) = entry.cause() {
            return Ok(Admission::Stopped(cause));
        }
        if let Some(known) = self.known(&server.limits, caller, entry)? {
            return Ok(Admission::Joined(known));
        }
        if self.closed {
            return Err(ending());
        }
        let (limits, resource) = (&server.limits, entry.resource.as_str());
        if !resource.is_empty() {
            let lease = leased(goal, resource)?;
            if let Confirmation::Awaited(refused) = server.authority.confirm(caller, goal, lease, resource)? {
                return Ok(Admission::Awaiting(refused));
            }
            self.take_over(&server.authority, lease, resource)?;
            if self.memory.begun_under(resource, (lease.id, lease.token)) >= limits.goals_per_lease {
                let (most, lease) = (limits.goals_per_lease, lease.id);
                let message = format!("{most} goals of {resource} were begun under {lease}: no more; acquire it anew");
                return Err(refusal(Code::ResourceExhausted, "TOO_MANY_GOALS", message));
            }
        }
        let mut others = self.running.iter().filter(|other| other.resource == resource);
        let is_in_the_way = |other: &&Arc<GoalEntry>| {
            let is_anothers = !resource.is_empty() && other.lease != entry.lease;
            other.cancelled.is_cancelled() && (limits.one_at_a_time || is_anothers)
        };
        if let Some(other) = others.clone().find(is_in_the_way) {
            if other.is_over() {
                return Err(still_running(other));
            }
            return Ok(Admission::After(Arc::clone(other)));
        }
        if limits.one_at_a_time
            && let Some(other) = others.next()
        {
            let message = format!("busy with goal {}: one goal at a time", other.id);
            return Err(Status::resource_exhausted(message));
        }
        if others.count() >= MAX_RUNNING {
            let of = if resource.is_empty() { "this provider" } else { resource };
            let message = format!("{MAX_RUNNING} goals of {of} are under way: no more at once");
            return Err(Status::resource_exhausted(message));
        }
        self.memory.begin(entry);
        self.running.push(Arc::clone(entry));
        Ok(Admission::New)
    }

    /// Stops goals whose leases are over, and forgets what was begun under those leases. Call it only for a confirmed lease.
    ///
    /// # Errors
    /// FAILED_PRECONDITION for a lease older than one already seen, if there is no watch that says who holds the resource.
    fn take_over(&mut self, authority: &Authority, lease: &Lease, resource: &str) -> Result<(), Status> {
        if authority.watch().is_none() {
            self.fence.admit(resource, lease.token).map_err(|highest: FencingToken| {
                let (id, token) = (lease.id, lease.token);
                let message =
                    format!("{id} ({token}) of {resource} is over: {highest} was seen since; acquire it anew");
                refusal(Code::FailedPrecondition, "LEASE_FENCED", message)
            })?;
        }
        let key = (lease.id, lease.token);
        let is_over = |other| other != key && authority.is_over(resource, other, key);
        for other in self.running.iter().filter(|other| other.resource == resource) {
            if other.lease.is_some_and(is_over) {
                other.stop(StopCause::Fenced(lease.token));
            }
        }
        if self.memory.begun_under(resource, key) == 0 {
            self.memory.forget_begun(resource, is_over);
        }
        Ok(())
    }

    /// Adds a goal to those that wait.
    ///
    /// # Errors
    /// UNAVAILABLE (the client may try again) if too many goals wait.
    pub(super) fn wait(&mut self, caller: &Caller, entry: &Arc<GoalEntry>) -> Result<(), Status> {
        let of_caller = self.waiting.iter().filter(|waiting| waiting.caller == caller.name).count();
        if of_caller >= MAX_WAITING_PER_CALLER {
            let name = &caller.name;
            return Err(too_many_waiting(format!("{MAX_WAITING_PER_CALLER} goals of {name} wait here to begin")));
        }
        if self.waiting.len() >= MAX_WAITING {
            return Err(too_many_waiting(format!("{MAX_WAITING} goals of all callers wait here to begin")));
        }
        if self.closed {
            return Err(ending());
        }
        self.waiting.push(WaitingGoal { caller: Arc::clone(&caller.name), entry: Arc::clone(entry) });
        Ok(())
    }

    /// Removes a goal from those that wait.
    pub(super) fn leave(&mut self, entry: &Arc<GoalEntry>) {
        self.waiting.retain(|waiting| !Arc::ptr_eq(&waiting.entry, entry));
    }

    /// Records that a goal's action has panicked.
    pub(super) fn panicked(&mut self, entry: &GoalEntry) {
        if let Some(lease) = entry.lease {
            self.panicked.push_back((entry.resource.clone(), lease));
            self.panicked.drain(..self.panicked.len().saturating_sub(MAX_PANICKED));
        }
    }

    /// Whether an action at a resource has panicked, under this lease or, without one, under any.
    pub(super) fn has_panicked(&self, resource: &str, lease: Option<LeaseKey>) -> bool {
        self.panicked.iter().any(|(at, under)| at == resource && lease.is_none_or(|lease| lease == *under))
    }

    /// Records that a goal's action has returned.
    pub(super) fn end(&mut self, entry: &Arc<GoalEntry>, results_kept: usize) {
        self.running.retain(|other| !Arc::ptr_eq(other, entry));
        self.memory.end(entry, results_kept);
    }
}

/// The goal's lease; it must contain `resource`.
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

fn still_running(goal: &GoalEntry) -> Status {
    let (id, resource, grace_s) = (&goal.id, &goal.resource, STOP_GRACE.as_secs());
    let message = format!(
        "goal {id} of {resource} was told to stop, has not within {grace_s} s, and still runs: nothing begins before it has ended; if it \
         never does, end the provider"
    );
    refusal(Code::ResourceExhausted, "STILL_RUNNING", message)
}

fn not_yours(caller: &Caller, goal: &GoalEntry) -> Status {
    let GoalEntry { id, giver, .. } = goal;
    let message = format!(
        "goal {id} was given by `{giver}`, not by `{caller}`: only its giver and operators hear of it and end it"
    );
    refusal(Code::PermissionDenied, "NOT_YOURS", message)
}

fn too_many_waiting(who: String) -> Status {
    retry_later(TOO_MANY_WAITING, format!("{who}, the most at once: nothing was begun, try again in a moment"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;
    use crate::action::goal::Fingerprint;

    fn caller(name: &str, role: Role) -> Caller {
        Caller { name: name.into(), roles: [role].as_slice().into() }
    }

    #[test]
    fn a_goal_is_ended_and_heard_of_by_its_giver_and_operators_alone() {
        let (giver, operator) = (caller("uid 1", Role::Task), caller("uid 0", Role::Operator));
        let limits = Limits { one_at_a_time: true, results_kept: 1, goals_per_lease: 1 };
        let goal = Goal { id: "g".to_owned(), ..Goal::default() };
        let entry = GoalEntry::new(&giver, &goal, Fingerprint::of(None), "", true);
        let mut state = State::default();
        assert!(!state.cancel(&giver, "g").unwrap());
        state.memory.begin(&entry);
        state.running.push(Arc::clone(&entry));
        for stranger in [caller("uid 2", Role::Task), caller("uid 3", Role::Agent)] {
            assert_eq!(state.cancel(&stranger, "g").unwrap_err().code(), Code::PermissionDenied);
            assert_eq!(state.known(&limits, &stranger, &entry).unwrap_err().code(), Code::PermissionDenied);
        }
        assert!(!entry.cancelled.is_cancelled());
        assert!(state.known(&limits, &operator, &entry).unwrap().is_some());
        assert!(state.known(&limits, &giver, &entry).unwrap().is_some());
        assert!(state.cancel(&giver, "g").unwrap() && entry.cancelled.is_cancelled());
        assert!(state.cancel(&operator, "g").unwrap());
    }
}
