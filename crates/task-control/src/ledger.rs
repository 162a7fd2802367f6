//! The open items of a run: what it has asked for and has not been answered yet, folded from its events and commands. After task control was killed,
//! they are asked again. A pure fold; [`super::resume`] acts on it.

mod account;
mod beginnings;
mod settling;

pub(super) use account::{Account, Created, UsedUp};
pub(super) use beginnings::{Began, Beginnings, Guard};
pub(super) use settling::{Answers, Settled, Unfinished, created};

use super::record::Decided;
use ratn_executive::protocol::{Command, Event, Goal, Origin, Unmade};
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::resource::{OperatedUnits, Requirement};
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Number of commits that a checkpoint keeps although the world pool has confirmed them: a world pool that is killed without durable storage may lose
/// its last ones, and they are then repeated.
const KEPT: usize = 256;
/// Number of withdrawn requests that a checkpoint keeps, the last ones. Older ones were answered long ago: the resource manager lets no session wait
/// for more at a time (`waiters_per_session`).
const KEPT_WITHDRAWN: usize = 4096;

/// Number of leases to keep that the run was about to give back last: older ones have been given back.
const KEPT_RETURNED: usize = 256;

/// Number of cancelled goals to keep: no more can be unfinished at a time, because each has a few seconds to end.
const KEPT_STOPPED: usize = 64;

/// The open items of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Ledger {
    pub(super) origin: Origin,
    /// The root's revision when the run began.
    pub(super) first_revision: Revision,
    /// The latest root revision that the run has heard of: its world contains what others had committed up to it.
    pub(super) knows: Revision,
    /// How the instances and composite states under way began.
    pub(super) beginnings: Beginnings,
    /// The number of the first operation that failed: neither it nor anything behind it is performed.
    pub(super) failed: Option<u64>,
    /// The number of the run's session, in which it has created and holds its resources. A session with the run's id and another number was opened by
    /// a resumption that died before it had recreated anything.
    pub(super) session: u64,
    /// The number of the last operation that is done in that session.
    pub(super) recorded: u64,
    /// When the last event came.
    pub(super) last: Timestamp,
    /// How often the run has been resumed so far.
    pub(super) resumptions: u32,
    /// Numbers of acquires and of operations so far; they are part of request ids.
    pub(super) acquires: u64,
    pub(super) operations: u64,
    /// Acquires without an answer.
    pub(super) waiting: BTreeMap<InstanceId, Asked>,
    /// Request ids of acquires that were withdrawn, or repeated, without an answer: a grant may have crossed.
    pub(super) withdrawn: Vec<String>,
    /// Leases that were granted and not given back.
    pub(super) held: BTreeSet<LeaseId>,
    /// The last leases that the run was about to give back. Whether it did is unknown.
    pub(super) returned: Vec<LeaseId>,
    /// The leases under which a goal has ended of which the log does not say that nothing moves for it any more. Goals that a resumption looks for
    /// again (`goals`, `stopped`) say it themselves.
    pub(super) doubtful: BTreeSet<LeaseId>,
    /// The leases among the returned ones that were to be given back while a commit was unconfirmed.
    pub(super) went_back: Vec<WentBack>,
    /// What the run has created and used up in its session.
    pub(super) account: Account,
    /// Possible ids of the last request that the resource manager has answered, as far as the log says.
    pub(super) answered: Vec<String>,
    /// The last lease that the resource manager has granted.
    pub(super) youngest_lease: LeaseId,
    /// Projections that were asked for.
    pub(super) projecting: BTreeMap<InstanceId, Projecting>,
    /// Goals under way.
    pub(super) goals: BTreeMap<InstanceId, (u32, Goal)>,
    /// The last goals that were cancelled. Whether the cancels arrived, and whether the goals have ended, is unknown.
    pub(super) stopped: Vec<(InstanceId, u32, Goal)>,
    /// Every commit, in order, except those that were forgotten.
    pub(super) commits: Vec<Decided>,
    /// Number of forgotten commits, all older than the kept ones: see [`Ledger::forget`].
    pub(super) forgotten: u64,
    /// Creates, deletes and consumes of retirements that are perhaps not done in the run's session, in order.
    pub(super) operated: Vec<Operated>,
    /// When the executive wants to be woken.
    pub(super) wakes: BTreeSet<Timestamp>,
    /// The run's outcome, once it has ended.
    pub(super) ended: Option<String>,
}

/// The creates, deletes and consumes of a retirement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Operated {
    /// Its number among all operations of the run.
    pub(super) number: u64,
    pub(super) instance: InstanceId,
    pub(super) operations: Vec<Requirement>,
    /// Requests that the resource manager had answered before this operation was requested.
    pub(super) older: Vec<String>,
}

/// A lease that was to be given back while a commit may have been under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct WentBack {
    pub(super) lease: LeaseId,
    /// The run's own number of its last commit.
    pub(super) decided: Revision,
    pub(super) at: Timestamp,
}

/// How far the daemons have confirmed what the run has decided; they perform it in order.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Confirmed {
    /// The revision of the last commit that the world pool has confirmed.
    pub(super) commit: Revision,
    /// The number of the last operation that the resource manager has confirmed.
    pub(super) operation: u64,
    /// The instance whose commit or operation failed first, and what was not made.
    pub(super) failed: Option<(InstanceId, Unmade)>,
}

/// An acquire.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Asked {
    /// Its request id, as last sent.
    pub(super) request: String,
    pub(super) number: u64,
    pub(super) requirements: Vec<Requirement>,
    pub(super) priority: i64,
}

/// A projection that is being made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Projecting {
    pub(super) attempt: u32,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    pub(super) writers: Vec<Arc<str>>,
    pub(super) reads: Footprint,
    pub(super) lease: Option<(LeaseId, FencingToken)>,
    /// Whether the goal begins only when the projection exists.
    pub(super) first: bool,
    /// The id with which the goal was started, perhaps before the projection existed.
    pub(super) named: Option<ProjectionId>,
}

/// The request id of an acquire. If it is repeated after a restart of task control, it is a new request: whatever the first one was granted meanwhile
/// is given back.
pub(super) fn acquire_request(run: &str, instance: InstanceId, number: u64, resumptions: u32) -> String {
    let again = if resumptions > 0 { format!("+{resumptions}") } else { String::new() };
    format!("{run}/{instance}/acquire-{number}{again}")
}

/// The id of the request that replaces this one when it has waited too long beside other runs.
pub(super) fn late_request(request: &str) -> String {
    format!("{request}/late")
}

/// The request id of one operation of a retirement.
pub(super) fn operation_request(run: &str, instance: InstanceId, number: u64, index: usize) -> String {
    format!("{run}/{instance}/operate-{number}.{index}")
}

/// The request id of the resource that marks a run as under way, in a session that the run has opened.
pub(super) fn claim_request(run: &str, session: u64) -> String {
    format!("{run}/claim-{session}")
}

impl Ledger {
    /// Follows an event that was given to the executive.
    pub(super) fn event(&mut self, at: Timestamp, event: &Event) {
        self.last = self.last.max(at);
        self.beginnings.event(event, self.knows);
        match event {
            Event::Started { origin, revision, .. } => {
                self.origin = (**origin).clone();
                self.session = origin.session;
                (self.first_revision, self.knows) = (*revision, *revision);
            }
            Event::Recorded { operation, session, units, renamed } => {
                self.session = *session;
                self.recorded = self.recorded.max(*operation);
                self.done(*operation, units);
                self.account.renamed(renamed);
            }
            Event::SessionLost { held_until } => self.lose(*held_until),
            Event::WorldChanged { revision, .. } => self.knows = self.knows.max(*revision),
            Event::Resumed { share } => {
                self.origin.share = share.or(self.origin.share);
                self.resumptions += 1;
                for (instance, asked) in &mut self.waiting {
                    let again = acquire_request(&self.origin.run, *instance, asked.number, self.resumptions);
                    self.withdrawn.push(std::mem::replace(&mut asked.request, again));
                }
            }
            Event::Woken => self.wakes = self.wakes.split_off(&Timestamp(at.0.saturating_add(1))),
            Event::Granted { instance, lease } => {
                // A lease that the run has handed over was held before.
                let is_new = self.held.insert(lease.id) && self.went_back.iter().all(|one| one.lease != lease.id);
                self.went_back.retain(|one| one.lease != lease.id);
                let asked = self.waiting.remove(instance);
                if let Some(asked) = asked.filter(|_| is_new) {
                    self.account.granted(&asked.requirements, lease);
                    // Grants may be heard in another order than they were made.
                    if lease.id > self.youngest_lease {
                        self.youngest_lease = lease.id;
                        self.answered = vec![late_request(&asked.request), asked.request];
                    }
                }
            }
            Event::Refused { instance, .. } => {
                self.waiting.remove(instance);
            }
            Event::RetirementFailed { instance, unmade, .. } => self.failed(*instance, *unmade),
            Event::Projected { instance, attempt, projection } => {
                // A projection that need not exist before its goal starts may only be promised.
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt || !asked.first);
                if let Some(asked) = self.projecting.get_mut(instance).filter(|asked| asked.attempt == *attempt) {
                    asked.named = Some(*projection);
                }
            }
            // The goal of a crashed attempt may go on; it is cancelled then.
            Event::Crashed { instance, attempt, .. } => {
                self.stops(*instance, *attempt);
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            Event::Finished { instance, attempt, at_rest, .. } => {
                let is_meant = |id: &InstanceId, goal: &mut (u32, Goal)| id == instance && goal.0 == *attempt;
                for (_, (_, goal)) in self.goals.extract_if(.., is_meant) {
                    self.doubtful.extend(goal.lease.filter(|_| !at_rest).map(|lease| lease.id));
                }
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            _ => {}
        }
    }

    /// Follows a command of the executive.
    pub(super) fn command(&mut self, command: &Command) {
        match command {
            Command::Acquire { instance, requirements, priority } => {
                self.acquires += 1;
                let request = acquire_request(&self.origin.run, *instance, self.acquires, self.resumptions);
                let asked =
                    Asked { request, number: self.acquires, requirements: requirements.clone(), priority: *priority };
                self.waiting.insert(*instance, asked);
            }
            Command::Withdraw { instance } => {
                self.withdrawn.extend(self.waiting.remove(instance).map(|asked| asked.request));
                if self.withdrawn.len() >= 2 * KEPT_WITHDRAWN {
                    self.withdrawn.drain(..KEPT_WITHDRAWN);
                }
            }
            Command::Project { instance, attempt, base, changes, writers, reads, lease, first } => {
                let (attempt, base, changes, writers) = (*attempt, *base, changes.clone(), writers.clone());
                let (reads, lease, first) = (reads.clone(), *lease, *first);
                let asked = Projecting { attempt, base, changes, writers, reads, lease, first, named: None };
                self.projecting.insert(*instance, asked);
            }
            Command::Start { instance, attempt, goal } => {
                self.goals.insert(*instance, (*attempt, (**goal).clone()));
            }
            Command::Cancel { instance, attempt } => {
                self.stops(*instance, *attempt);
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            Command::Release { instance, lease, projection } => {
                self.projecting
                    .retain(|id, asked| id != instance || asked.named.is_none() || asked.named != *projection);
                if let Some(lease) = lease.filter(|lease| self.held.remove(lease)) {
                    self.returned.push(lease);
                    self.returned.drain(..self.returned.len().saturating_sub(KEPT_RETURNED));
                    let decided = self.commits.last().map(|decided| decided.revision);
                    let at = self.last;
                    self.went_back.extend(decided.map(|decided| WentBack { lease, decided, at }));
                }
            }
            Command::Commit { instance, writer, changes, evidence, revision } => {
                let (instance, revision, writer) = (*instance, *revision, writer.clone());
                let (changes, evidence) = (changes.clone(), evidence.clone());
                let (knew, behind) = (self.knows, self.operations);
                let now = Began { knows: knew, held_until: None };
                let began = self.beginnings.of(instance, &writer).unwrap_or(now);
                let guard = self.beginnings.guard(instance).cloned();
                if self.failed.is_none() {
                    let decided = Decided { instance, writer, changes, evidence, revision, began, guard, knew, behind };
                    self.commits.push(decided);
                }
            }
            Command::Operate { instance, operations } => {
                self.operations += 1;
                if self.failed.is_none() {
                    let older = self.answered.iter().cloned();
                    let older = older.chain([claim_request(&self.origin.run, self.session)]).collect();
                    let (number, instance, operations) = (self.operations, *instance, operations.clone());
                    self.operated.push(Operated { number, instance, operations, older });
                }
            }
            Command::Wake { at } => {
                self.wakes.insert(*at);
            }
            Command::End { outcome, .. } => self.ended = Some(outcome.clone()),
            Command::Note(_) => {}
        }
        self.beginnings.command(command, self.knows);
    }

    /// The run has lost what it held. What was lost earlier keeps the revision of its earlier loss.
    fn lose(&mut self, held_until: Revision) {
        for decided in &mut self.commits {
            decided.began.held_until.get_or_insert(held_until);
        }
    }

    /// A decision of an instance was not performed, nor was anything behind it, because the recorder stops there. A failed commit may still be made,
    /// with those behind it up to the next failed operation: made in order, they give the world that the program says. A failed operation may not:
    /// the reason of its refusal may still exist.
    fn failed(&mut self, instance: InstanceId, unmade: Unmade) {
        let is_meant = |one: &&Operated| match unmade {
            Unmade::Untried => false,
            Unmade::Operation(failed) => one.number == failed,
            // A log of an earlier version: takes the first operation that may be meant.
            Unmade::Unknown => one.instance == instance,
        };
        let Some(failed) = self.operated.iter().find(is_meant).map(|one| one.number) else { return };
        self.failed = Some(failed);
        self.operated.retain(|one| one.number < failed);
        self.commits.retain(|decided| decided.behind < failed);
    }

    /// The operations up to number `last` are done; `units` is the result of the last one.
    fn done(&mut self, last: u64, units: &[Vec<OperatedUnits>]) {
        for one in self.operated.extract_if(.., |one| one.number <= last) {
            let units: &[Vec<OperatedUnits>] = if one.number == last { units } else { &[] };
            self.account.operated(&one.operations, units);
            let parts = one.operations.len().checked_sub(1);
            let request = parts.map(|index| operation_request(&self.origin.run, one.instance, one.number, index));
            if let Some(request) = request {
                self.answered = vec![request];
            }
        }
    }

    /// The operations that are perhaps not done in the run's session, in order.
    pub(super) fn open_operations(&self) -> impl Iterator<Item = &Operated> {
        self.operated.iter()
    }

    /// A goal is cancelled.
    fn stops(&mut self, instance: InstanceId, attempt: u32) {
        let is_meant = self.goals.get(&instance).is_some_and(|goal| goal.0 == attempt);
        if let Some((_, goal)) = is_meant.then(|| self.goals.remove(&instance)).flatten() {
            self.stopped.push((instance, attempt, goal));
            let old = self.stopped.drain(..self.stopped.len().saturating_sub(KEPT_STOPPED));
            self.doubtful.extend(old.filter_map(|(_, _, goal)| goal.lease).map(|lease| lease.id));
        }
    }

    /// Forgets what was confirmed long ago, so that the ledger does not grow with the run. A world pool that has none of the kept commits needs older
    /// ones, which are in the log.
    pub(super) fn forget(&mut self, confirmed: Confirmed) {
        self.forget_but(KEPT, confirmed);
    }

    fn forget_but(&mut self, kept: usize, confirmed: Confirmed) {
        let commits = self.commits.iter().take_while(|decided| decided.revision <= confirmed.commit).count();
        let commits = commits.saturating_sub(kept);
        self.commits.drain(..commits);
        self.forgotten += commits as u64;
        self.went_back.retain(|one| one.decided > confirmed.commit);
        self.doubtful.retain(|lease| self.held.contains(lease) || self.returned.contains(lease));
        self.withdrawn.drain(..self.withdrawn.len().saturating_sub(KEPT_WITHDRAWN));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_executive::protocol::Note;
    use ratn_model::resource::{Lease, ResourceOperation};

    fn requirement(operation: ResourceOperation, kind: &str, count: u32) -> Requirement {
        Requirement { count: count.into(), ..Requirement::new(operation, kind) }
    }

    fn lease(id: u64) -> Lease {
        Lease { id: LeaseId(id), token: FencingToken(id), resources: Vec::new(), consumed: Vec::new() }
    }

    #[test]
    fn what_is_not_answered_is_open() {
        let (one, two, three) = (InstanceId(1), InstanceId(2), InstanceId(3));
        let mut ledger = Ledger { origin: Origin { run: "r".into(), ..Origin::default() }, ..Ledger::default() };
        for instance in [one, two, three] {
            ledger.command(&Command::Acquire {
                instance,
                requirements: vec![requirement(ResourceOperation::Consume, "Energy", 2)],
                priority: 0,
            });
        }
        ledger.event(Timestamp(5), &Event::Granted { instance: one, lease: lease(7) });
        ledger.command(&Command::Withdraw { instance: two });
        let open: Vec<&str> = ledger.waiting.values().map(|asked| asked.request.as_str()).collect();
        assert_eq!(open, [acquire_request("r", three, 3, 0)]);
        assert_eq!(ledger.withdrawn, [acquire_request("r", two, 2, 0)]);
        assert_eq!(ledger.held.len(), 1);

        ledger.event(Timestamp(9), &Event::Resumed { share: None });
        assert_eq!(ledger.waiting[&three].request, acquire_request("r", three, 3, 1));
        ledger.command(&Command::Release { instance: one, lease: Some(LeaseId(7)), projection: None });
        assert!(ledger.held.is_empty());
        assert_eq!(ledger.returned, [LeaseId(7)]);
        assert_eq!(ledger.withdrawn, [acquire_request("r", two, 2, 0), acquire_request("r", three, 3, 0)]);
    }

    #[test]
    fn a_goal_is_open_until_it_has_ended_or_is_cancelled_in_its_attempt() {
        let instance = InstanceId(1);
        let mut ledger = Ledger::default();
        ledger.command(&Command::Start { instance, attempt: 2, goal: Box::new(goal()) });
        ledger.command(&Command::Cancel { instance, attempt: 1 });
        assert_eq!(ledger.goals.len(), 1);
        ledger.event(
            Timestamp(1),
            &Event::Crashed { instance, attempt: 2, reason: String::new(), unknown: false, refused: false },
        );
        assert!(ledger.goals.is_empty());
        // The goal may go on if its projection could not be made: a resumption cancels it.
        assert_eq!(ledger.stopped.iter().map(|(_, attempt, _)| *attempt).collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn a_wake_is_open_until_its_moment_was_told() {
        let mut ledger = Ledger::default();
        for at in [10, 20, 30] {
            ledger.command(&Command::Wake { at: Timestamp(at) });
        }
        ledger.event(Timestamp(20), &Event::Woken);
        assert_eq!(ledger.wakes, BTreeSet::from([Timestamp(30)]));
    }

    fn recorded(operation: u64, session: u64, units: Vec<Vec<OperatedUnits>>) -> Event {
        Event::Recorded { operation, session, units, renamed: BTreeMap::new() }
    }

    fn units(resource: &str, kind: &str, units: u32) -> OperatedUnits {
        let (resource, kind) = (resource.to_owned(), kind.to_owned());
        OperatedUnits { resource, kind, units: units.into(), ends_with_session: true }
    }

    #[test]
    fn an_operation_is_open_until_it_is_recorded_and_what_it_came_to_is_in_the_account_then() {
        use ResourceOperation::{Create, Delete};
        let mut ledger = Ledger { session: 7, ..Ledger::default() };
        for operation in [requirement(Create, "Box", 3), requirement(Delete, "Box", 1), requirement(Delete, "Box", 1)] {
            ledger.command(&Command::Operate { instance: InstanceId(1), operations: vec![operation] });
        }
        let open = |ledger: &Ledger| ledger.open_operations().map(|one| one.number).collect::<Vec<_>>();
        let left = |ledger: &Ledger| {
            let created = ledger.account.created().iter();
            created.map(|one| (one.resource.clone(), one.left.count.units())).collect::<Vec<_>>()
        };
        assert_eq!((open(&ledger), left(&ledger)), (vec![1, 2, 3], vec![]));
        ledger.event(Timestamp(1), &recorded(1, 7, vec![vec![units("Box-1", "Box", 3)]]));
        ledger.event(Timestamp(1), &recorded(2, 7, vec![vec![units("Box-1", "Box", 1)]]));
        assert_eq!((open(&ledger), left(&ledger)), (vec![3], vec![("Box-1".to_owned(), 2)]));
        // A resumption has recreated all of it in a new session, and does the rest there.
        let renamed = BTreeMap::from([("Box-1".to_owned(), "Box-9".to_owned())]);
        ledger.event(Timestamp(2), &Event::Recorded { operation: 2, session: 9, units: Vec::new(), renamed });
        assert_eq!((open(&ledger), left(&ledger)), (vec![3], vec![("Box-9".to_owned(), 2)]));
        ledger.event(Timestamp(2), &recorded(3, 9, vec![vec![units("Box-9", "Box", 1)]]));
        assert_eq!((open(&ledger), left(&ledger), ledger.session), (vec![], vec![("Box-9".to_owned(), 1)], 9));
        assert_eq!(ledger.account.unknown(), None);
    }

    #[test]
    fn of_operations_that_are_recorded_together_it_is_not_known_what_they_came_to() {
        let mut ledger = Ledger::default();
        for number in 1..=2 {
            let operations = vec![requirement(ResourceOperation::Create, "Box", number)];
            ledger.command(&Command::Operate { instance: InstanceId(1), operations });
        }
        ledger.event(Timestamp(1), &recorded(2, 7, vec![vec![units("Box-2", "Box", 2)]]));
        assert!(ledger.account.unknown().is_some() && ledger.operated.is_empty());
    }

    #[test]
    fn a_lease_that_was_handed_over_has_used_up_nothing_again() {
        let consumes = || vec![requirement(ResourceOperation::Consume, "Energy", 2)];
        let mut ledger = Ledger::default();
        let lease = Lease { consumed: vec![units("battery", "Energy", 2)], ..lease(7) };
        for instance in [1, 2].map(InstanceId) {
            ledger.command(&Command::Acquire { instance, requirements: consumes(), priority: 0 });
            ledger.event(Timestamp(1), &Event::Granted { instance, lease: lease.clone() });
        }
        let used_up = ledger.account.used_up().map(|(resource, one)| (resource, one.units.units()));
        assert_eq!(used_up.collect::<Vec<_>>(), [("battery", 2)]);
    }

    #[test]
    fn what_grants_have_used_up_counts_in_whatever_order_they_are_heard() {
        let mut ledger = Ledger::default();
        let requirements = || vec![requirement(ResourceOperation::Consume, "Energy", 2)];
        let leases = [(1, 8, "second"), (2, 7, "first")];
        for (instance, _, _) in leases {
            let instance = InstanceId(instance);
            ledger.command(&Command::Acquire { instance, requirements: requirements(), priority: 0 });
        }
        for (instance, id, battery) in leases {
            let lease = Lease { consumed: vec![units(battery, "Energy", 2)], ..lease(id) };
            ledger.event(Timestamp(1), &Event::Granted { instance: InstanceId(instance), lease });
        }
        let mut used_up: Vec<_> =
            ledger.account.used_up().map(|(resource, one)| (resource, one.units.units())).collect();
        used_up.sort_unstable();
        assert_eq!(used_up, [("first", 2), ("second", 2)]);
    }

    #[test]
    fn a_commit_is_made_of_what_others_had_made_until_it_was_decided() {
        let mut ledger = Ledger::default();
        let decides = |ledger: &mut Ledger, number: u64| {
            ledger.command(&Command::Commit {
                instance: InstanceId(number),
                writer: String::new(),
                changes: Vec::new(),
                evidence: Vec::new(),
                revision: Revision(number),
            });
        };
        decides(&mut ledger, 1);
        ledger.event(Timestamp(1), &Event::WorldChanged { revision: Revision(5), facts: Vec::new() });
        decides(&mut ledger, 2);
        assert_eq!(
            ledger.commits.iter().map(|decided| decided.began.knows).collect::<Vec<_>>(),
            [Revision(0), Revision(5)]
        );
    }

    fn goal() -> Goal {
        Goal {
            improves: None,
            reads_nothing: false,
            provider: "arm".into(),
            action: "follow".into(),
            inputs: BTreeMap::new(),
            seed: 0,
            lease: None,
            projection: None,
            expected_s: None,
            timeout_s: None,
        }
    }

    fn commits(instance: InstanceId, number: u64) -> Command {
        let (writer, changes, evidence) = (String::new(), Vec::new(), Vec::new());
        Command::Commit { instance, writer, changes, evidence, revision: Revision(number) }
    }

    #[test]
    fn what_was_heard_of_behind_the_beginning_of_a_motion_is_not_what_its_commit_is_made_of() {
        let (motion, other) = (InstanceId(1), InstanceId(2));
        let mut ledger = Ledger::default();
        let heard = |ledger: &mut Ledger, revision: u64| {
            ledger.event(Timestamp(1), &Event::WorldChanged { revision: Revision(revision), facts: Vec::new() });
        };
        heard(&mut ledger, 4);
        ledger.command(&Command::Start { instance: motion, attempt: 1, goal: Box::new(goal()) });
        heard(&mut ledger, 10);
        ledger.event(Timestamp(2), &Event::Granted { instance: other, lease: lease(7) });
        heard(&mut ledger, 12);
        for (number, instance) in (1..).zip([motion, other, InstanceId(3)]) {
            ledger.command(&commits(instance, number));
        }
        assert_eq!(ledger.commits.iter().map(|decided| decided.began.knows.0).collect::<Vec<_>>(), [4, 10, 12]);
        ledger.command(&Command::Note(Note::Retired { instance: motion }));
        ledger.command(&Command::Note(Note::Squashed { instance: other }));
        assert!(ledger.beginnings.is_empty());
    }

    #[test]
    fn what_was_lost_once_is_lost_since_then_until_it_begins_anew() {
        let [motion, other] = [1, 2].map(InstanceId);
        let mut ledger = Ledger::default();
        let starts = |ledger: &mut Ledger, instance| {
            ledger.command(&Command::Start { instance, attempt: 1, goal: Box::new(goal()) });
        };
        let heard = |ledger: &mut Ledger, revision: u64| {
            ledger.event(Timestamp(1), &Event::WorldChanged { revision: Revision(revision), facts: Vec::new() });
        };
        let lost = |ledger: &Ledger| {
            let behind = |instance| ledger.beginnings.of(instance, "").and_then(|began| began.others_count());
            let lost = [motion, other].into_iter().filter_map(|instance| Some((instance.0, behind(instance)?.0)));
            lost.collect::<Vec<_>>()
        };
        starts(&mut ledger, motion);
        heard(&mut ledger, 5);
        starts(&mut ledger, other);
        ledger.command(&commits(InstanceId(3), 1));
        assert_eq!(lost(&ledger), []);
        for held_until in [4, 9] {
            ledger.event(Timestamp(1), &Event::SessionLost { held_until: Revision(held_until) });
            assert_eq!(lost(&ledger), [(1, 4), (2, 5)], "it knew of what was changed before it began");
        }
        ledger.command(&commits(motion, 2));
        starts(&mut ledger, motion);
        ledger.command(&commits(motion, 3));
        assert_eq!(lost(&ledger), [(2, 5)]);
        let counts = ledger.commits.iter().map(|decided| decided.began.others_count().map(|behind| behind.0));
        assert_eq!(counts.collect::<Vec<_>>(), [Some(5), Some(4), None]);
    }

    #[test]
    fn nothing_is_left_to_do_of_an_operation_that_failed_and_of_what_is_behind_it() {
        let operates = |instance: u64| Command::Operate {
            instance: InstanceId(instance),
            operations: vec![requirement(ResourceOperation::Create, "Box", 1)],
        };
        let mut ledger = Ledger::default();
        for number in [1, 2, 3] {
            ledger.command(&commits(InstanceId(number), number));
            ledger.command(&operates(number));
        }
        let left = |ledger: &Ledger| {
            let commits = ledger.commits.iter().map(|decided| decided.revision.0).collect::<Vec<_>>();
            (commits, ledger.operated.iter().map(|one| one.number).collect::<Vec<_>>())
        };
        // A failed commit may still be made: an operation that was done before is not taken for the failed one.
        ledger.event(Timestamp(1), &recorded(1, 7, Vec::new()));
        let failed = |instance: u64| Event::RetirementFailed {
            instance: InstanceId(instance),
            reason: String::new(),
            unmade: Unmade::Unknown,
        };
        ledger.event(Timestamp(1), &failed(1));
        assert_eq!(left(&ledger), (vec![1, 2, 3], vec![2, 3]));
        ledger.event(Timestamp(2), &failed(2));
        assert_eq!(left(&ledger), (vec![1, 2], vec![]));
        // Those behind it fail as well, and what is decided on the way out is not performed either.
        ledger.event(Timestamp(2), &failed(3));
        ledger.command(&commits(InstanceId(4), 4));
        ledger.command(&operates(4));
        assert_eq!(left(&ledger), (vec![1, 2], vec![]));
        assert_eq!((ledger.operations, ledger.failed), (4, Some(2)));
    }

    #[test]
    fn of_a_commit_that_failed_the_operation_of_the_same_state_is_left_to_do_and_all_behind_it() {
        let operates = |instance: u64| Command::Operate {
            instance: InstanceId(instance),
            operations: vec![requirement(ResourceOperation::Create, "Box", 1)],
        };
        let mut ledger = Ledger::default();
        for number in [1, 2] {
            ledger.command(&commits(InstanceId(number), number));
            ledger.command(&operates(number));
        }
        // The commit of the first instance fails, and so does everything behind it: none of that was tried.
        for instance in [1, 1, 2, 2] {
            let (instance, reason) = (InstanceId(instance), String::new());
            ledger.event(Timestamp(1), &Event::RetirementFailed { instance, reason, unmade: Unmade::Untried });
        }
        assert_eq!((ledger.commits.len(), ledger.open_operations().count(), ledger.failed), (2, 2, None));
        // A resumption makes them in order, and the second operation is refused.
        ledger.event(Timestamp(2), &recorded(1, 7, Vec::new()));
        let (instance, reason) = (InstanceId(2), String::new());
        ledger.event(Timestamp(3), &Event::RetirementFailed { instance, reason, unmade: Unmade::Operation(2) });
        assert_eq!((ledger.commits.len(), ledger.open_operations().count(), ledger.failed), (2, 0, Some(2)));
    }

    #[test]
    fn what_is_forgotten_has_come_to_the_same() {
        use ResourceOperation::{Consume, Create, Delete};
        let operations = |number: u64| {
            let deleted = if number.is_multiple_of(3) { "Foreign" } else { "Box" };
            vec![requirement(Create, "Box", 2), requirement(Delete, deleted, 1), requirement(Consume, "Energy", 3)]
        };
        let came_to = |number: u64| {
            let box_of = |number: u64| format!("Box-{number}");
            let foreign = OperatedUnits { ends_with_session: false, ..units("foreign", "Foreign", 1) };
            let deleted = if number.is_multiple_of(3) { foreign } else { units(&box_of(number), "Box", 1) };
            vec![vec![units(&box_of(number), "Box", 2)], vec![deleted], vec![units("battery", "Energy", 3)]]
        };
        let (mut whole, mut short) = (Ledger::default(), Ledger::default());
        for number in 1..=200 {
            for ledger in [&mut whole, &mut short] {
                let instance = InstanceId(number);
                ledger.command(&commits(instance, number));
                ledger.command(&Command::Operate { instance, operations: operations(number) });
                let requirements = vec![requirement(Consume, "Energy", 1)];
                ledger.command(&Command::Acquire { instance, requirements, priority: 0 });
                let lease = Lease { consumed: vec![units("battery", "Energy", 1)], ..lease(number) };
                ledger.event(Timestamp(number), &Event::Granted { instance, lease });
                ledger.command(&Command::Release { instance, lease: Some(LeaseId(number)), projection: None });
                // The resource manager is behind.
                if let Some(done) = number.checked_sub(3).filter(|done| *done > 0) {
                    ledger.event(Timestamp(number), &recorded(done, 7, came_to(done)));
                }
            }
            // The world pool is further behind.
            let confirmed = Confirmed { commit: Revision(number / 2), ..Confirmed::default() };
            short.forget_but(4, confirmed);
            assert_eq!((&short.account, &short.operated), (&whole.account, &whole.operated));
            assert_eq!(short.operated.len() as u64, number.min(3), "it does not grow with the run");
            // Everything that is not confirmed is kept, and a few more.
            let commits = (number / 2).saturating_sub(4);
            assert_eq!((short.forgotten, &short.commits[..]), (commits, &whole.commits[commits as usize..]));
        }
        assert_eq!(short.account.used_up().count(), 1);
        assert_eq!(short.account.unknown(), None);
    }
}
