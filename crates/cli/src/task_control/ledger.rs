//! What a run has asked for and has not been answered yet, folded from its events and commands: what has to be asked again when
//! task control was killed. A pure fold; what is done with it is [`super::resume`]'s.

use super::record::Decided;
use ratn_executive::protocol::{Command, Event, Goal, Origin};
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, Revision};
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The open items of a run.
#[derive(Debug, Clone, Default)]
pub(super) struct Ledger {
    pub(super) origin: Origin,
    /// The root's revision when the run began.
    pub(super) first_revision: Revision,
    /// When the last event came.
    pub(super) last: Timestamp,
    /// How often task control has come back so far.
    pub(super) resumptions: u32,
    /// Numbers of acquires and of operations so far; they are part of request ids.
    pub(super) acquires: u64,
    pub(super) operations: u64,
    /// Acquires without an answer.
    pub(super) waiting: BTreeMap<InstanceId, Asked>,
    /// Request ids of acquires that were withdrawn, or asked for again, without an answer: a grant may have crossed.
    pub(super) withdrawn: Vec<String>,
    /// Leases that were granted and not given back, with what they consumed beside.
    pub(super) held: BTreeSet<LeaseId>,
    /// What acquires have used up for the rest of the run.
    pub(super) consumed: Vec<Requirement>,
    /// Projections that were asked for.
    pub(super) projecting: BTreeMap<InstanceId, Projecting>,
    /// Goals under way.
    pub(super) goals: BTreeMap<InstanceId, (u32, Goal)>,
    /// Every commit, in order.
    pub(super) commits: Vec<Decided>,
    /// Everything that was created, deleted and consumed at retirements, in order, with its number.
    pub(super) operated: Vec<(u64, InstanceId, Vec<Requirement>)>,
    /// When the executive wants to be woken.
    pub(super) wakes: BTreeSet<Timestamp>,
    /// The run's outcome, once it has ended.
    pub(super) ended: Option<String>,
}

/// An acquire.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Asked {
    /// Its request id, as sent last.
    pub(super) request: String,
    pub(super) number: u64,
    pub(super) requirements: Vec<Requirement>,
    pub(super) priority: i64,
}

/// A projection that is being made.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Projecting {
    pub(super) attempt: u32,
    pub(super) base: Revision,
    pub(super) changes: Vec<Change>,
    pub(super) writers: Vec<Arc<str>>,
    pub(super) reads: Footprint,
    pub(super) lease: Option<(LeaseId, FencingToken)>,
}

/// The request id of an acquire. Asked for again after task control was gone, it is another request: whatever the first one
/// was granted meanwhile went back.
pub(super) fn acquire_request(run: &str, instance: InstanceId, number: u64, resumptions: u32) -> String {
    let again = if resumptions > 0 { format!("+{resumptions}") } else { String::new() };
    format!("{run}/{instance}/acquire-{number}{again}")
}

/// The request id of one operation of a retirement.
pub(super) fn operation_request(run: &str, instance: InstanceId, number: u64, index: usize) -> String {
    format!("{run}/{instance}/operate-{number}.{index}")
}

impl Ledger {
    /// An event that the executive was given.
    pub(super) fn event(&mut self, at: Timestamp, event: &Event) {
        self.last = self.last.max(at);
        match event {
            Event::Started { origin, revision, .. } => {
                self.origin = origin.clone();
                self.first_revision = *revision;
            }
            Event::Resumed => {
                self.resumptions += 1;
                for (instance, asked) in &mut self.waiting {
                    let again = acquire_request(&self.origin.run, *instance, asked.number, self.resumptions);
                    self.withdrawn.push(std::mem::replace(&mut asked.request, again));
                }
            }
            Event::Woken => self.wakes = self.wakes.split_off(&Timestamp(at.0.saturating_add(1))),
            Event::Granted { instance, lease } => {
                self.held.insert(lease.id);
                if let Some(asked) = self.waiting.remove(instance) {
                    let used_up = |r: &Requirement| r.operation == ResourceOperation::Consume;
                    self.consumed.extend(asked.requirements.into_iter().filter(used_up));
                }
            }
            Event::Refused { instance, .. } => {
                self.waiting.remove(instance);
            }
            Event::Projected { instance, attempt, .. } => {
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            Event::Finished { instance, attempt, .. } | Event::Crashed { instance, attempt, .. } => {
                self.goals.retain(|id, goal| id != instance || goal.0 != *attempt);
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            _ => {}
        }
    }

    /// A command that it gave.
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
            }
            Command::Project { instance, attempt, base, changes, writers, reads, lease } => {
                let (attempt, base, changes, writers) = (*attempt, *base, changes.clone(), writers.clone());
                let asked = Projecting { attempt, base, changes, writers, reads: reads.clone(), lease: *lease };
                self.projecting.insert(*instance, asked);
            }
            Command::Start { instance, attempt, goal } => {
                self.goals.insert(*instance, (*attempt, (**goal).clone()));
            }
            Command::Cancel { instance, attempt } => {
                self.goals.retain(|id, goal| id != instance || goal.0 != *attempt);
                self.projecting.retain(|id, asked| id != instance || asked.attempt != *attempt);
            }
            Command::Release { lease, .. } => {
                if let Some(lease) = lease {
                    self.held.remove(lease);
                }
            }
            Command::Commit { instance, writer, changes, evidence, revision } => {
                let (instance, revision, writer) = (*instance, *revision, writer.clone());
                let (changes, evidence) = (changes.clone(), evidence.clone());
                self.commits.push(Decided { instance, writer, changes, evidence, revision });
            }
            Command::Operate { instance, operations } => {
                self.operations += 1;
                self.operated.push((self.operations, *instance, operations.clone()));
            }
            Command::Wake { at } => {
                self.wakes.insert(*at);
            }
            Command::End { outcome, .. } => self.ended = Some(outcome.clone()),
            Command::Note(_) => {}
        }
    }

    /// What the run has created and not deleted again, for a session that has to be made anew: with the old one it is gone.
    /// What others had created and the run has deleted stays away.
    pub(super) fn created(&self) -> Vec<Requirement> {
        let mut left: Vec<Requirement> = Vec::new();
        for operation in self.operated.iter().flat_map(|(_, _, operations)| operations) {
            match operation.operation {
                ResourceOperation::Create => left.push(operation.clone()),
                ResourceOperation::Delete => delete(&mut left, operation),
                _ => {}
            }
        }
        left
    }

    /// What the run has used up, for the same reason.
    pub(super) fn used_up(&self) -> impl Iterator<Item = &Requirement> {
        let retired = self.operated.iter().flat_map(|(_, _, operations)| operations);
        retired.filter(|r| r.operation == ResourceOperation::Consume).chain(&self.consumed)
    }
}

/// Takes away as many units as the deletion says, of what it fits, the oldest first.
fn delete(left: &mut Vec<Requirement>, deletion: &Requirement) {
    let mut count = deletion.count;
    for created in left.iter_mut() {
        let attributes = &created.attributes;
        let fits = created.kind == deletion.kind
            && deletion.accepts(|name| attributes.get(name).map(std::borrow::Cow::Borrowed));
        if fits {
            let taken = count.min(created.count);
            created.count = created.count.saturating_sub(taken);
            count = count.saturating_sub(taken);
        }
    }
    left.retain(|created| !created.count.is_zero());
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::resource::Lease;

    fn requirement(operation: ResourceOperation, kind: &str, count: u32) -> Requirement {
        Requirement { count: count.into(), ..Requirement::new(operation, kind) }
    }

    fn lease(id: u64) -> Lease {
        Lease { id: LeaseId(id), token: FencingToken(id), resources: Vec::new() }
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
        assert_eq!((ledger.held.len(), ledger.used_up().count()), (1, 1));

        ledger.event(Timestamp(9), &Event::Resumed);
        assert_eq!(ledger.waiting[&three].request, acquire_request("r", three, 3, 1));
        ledger.command(&Command::Release { instance: one, lease: Some(LeaseId(7)), projection: None });
        assert!(ledger.held.is_empty());
        assert_eq!(ledger.withdrawn, [acquire_request("r", two, 2, 0), acquire_request("r", three, 3, 0)]);
    }

    #[test]
    fn a_goal_is_open_until_it_has_ended_or_is_cancelled_in_its_attempt() {
        let instance = InstanceId(1);
        let goal = Goal {
            provider: "arm".into(),
            action: "follow".into(),
            inputs: BTreeMap::new(),
            seed: 0,
            lease: None,
            projection: None,
            expected_s: None,
            timeout_s: None,
        };
        let mut ledger = Ledger::default();
        ledger.command(&Command::Start { instance, attempt: 2, goal: Box::new(goal) });
        ledger.command(&Command::Cancel { instance, attempt: 1 });
        assert_eq!(ledger.goals.len(), 1);
        ledger.event(Timestamp(1), &Event::Crashed { instance, attempt: 2, reason: String::new() });
        assert!(ledger.goals.is_empty());
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

    #[test]
    fn what_was_created_and_not_deleted_is_left() {
        use ResourceOperation::{Create, Delete};
        let mut ledger = Ledger::default();
        let operations = vec![
            requirement(Delete, "Foreign", 1),
            requirement(Create, "Box", 3),
            requirement(Create, "Tray", 1),
            requirement(Delete, "Box", 2),
            requirement(Delete, "Tray", 1),
        ];
        ledger.command(&Command::Operate { instance: InstanceId(1), operations });
        assert_eq!(ledger.created(), [requirement(Create, "Box", 1)]);
    }
}
