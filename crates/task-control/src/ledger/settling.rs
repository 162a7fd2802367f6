//! Settles the operations whose answers were lost with the run's session: the resource manager is asked by their request ids which of them are done.
//! Pure: which requests to ask about, and what the answers mean.
//!
//! Operations are done in order, and the resource manager forgets a caller's oldest answers first. So everything before a known answer was done, and
//! an unknown one was not done if anything older is known. If nothing is known, an operation that takes something away may have been done: then
//! nobody can say what is left to do, and the run is refused.

use super::account::Account;
use super::{Ledger, Operated, operation_request};
use ratn_model::id::InstanceId;
use ratn_model::resource::{OperatedUnits, Requirement, ResourceOperation};
use ratn_proto::types::Recalled;
use std::collections::BTreeMap;

/// By request id; `None` if no answer is known.
pub(crate) type Answers = BTreeMap<String, Option<Recalled>>;

/// The result of settling the open operations of a run.
#[derive(Debug, PartialEq)]
pub(crate) struct Settled {
    /// The account, with everything that is done.
    pub(crate) account: Account,
    /// The operations that are done, by number, with the result of each.
    pub(crate) done: Vec<(u64, Vec<Vec<OperatedUnits>>)>,
    /// The operations that are not done, in order.
    pub(crate) open: Vec<Unfinished>,
}

/// An operation that is not done, or of which only the first parts are done.
#[derive(Debug, PartialEq)]
pub(crate) struct Unfinished {
    pub(crate) number: u64,
    pub(crate) instance: InstanceId,
    pub(crate) operations: Vec<Requirement>,
    /// The results of its first parts, which are done.
    pub(crate) done: Vec<Vec<OperatedUnits>>,
}

impl Settled {
    /// Number of parts not done that take something away, perhaps for good.
    pub(crate) fn removals(&self) -> usize {
        let left = self.open.iter().flat_map(|one| one.operations.iter().skip(one.done.len()));
        left.filter(|operation| takes_away(operation)).count()
    }
}

/// The resource manager has forgotten what has become of an operation.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error(
    "whether `{operation}` was done is not known: the answer to the run was lost with its session, and the resource manager remembers \
     no request of the run of that time any more. It is not done again, as it may be done: run the task again, or begin it in the middle \
     (`--from`)"
)]
pub(crate) struct Forgotten {
    operation: String,
}

/// One part of an open operation.
struct Part<'a> {
    of: &'a Operated,
    index: usize,
    request: String,
}

impl Part<'_> {
    fn operation(&self) -> &Requirement {
        &self.of.operations[self.index]
    }

    fn takes_away(&self) -> bool {
        takes_away(self.operation())
    }

    /// Its result, as far as the answer says it.
    fn units(&self, answer: &Recalled) -> Option<Vec<OperatedUnits>> {
        let operation = self.operation();
        match (operation.operation, &answer.created) {
            (ResourceOperation::Create, Some(id)) => Some(vec![created(operation, id)]),
            (ResourceOperation::Create, None) => None,
            _ if self.takes_away() && answer.operated.is_empty() => None,
            _ => Some(answer.operated.clone()),
        }
    }
}

/// The result of a create, with the id of the new resource.
pub(crate) fn created(operation: &Requirement, id: &str) -> OperatedUnits {
    let (resource, kind) = (id.to_owned(), operation.kind.clone());
    OperatedUnits { resource, kind, units: operation.count, ends_with_session: true }
}

/// Whether it takes something away, perhaps for good.
pub(crate) fn takes_away(operation: &Requirement) -> bool {
    matches!(operation.operation, ResourceOperation::Delete | ResourceOperation::Consume)
}

/// Whether it is a request to the resource manager.
fn is_asked_for(operation: &Requirement) -> bool {
    takes_away(operation) || operation.operation == ResourceOperation::Create
}

impl Ledger {
    /// The requests to ask the resource manager about; none if no operation is open.
    pub(crate) fn unheard_requests(&self) -> Vec<String> {
        let Some(first) = self.operated.first() else { return Vec::new() };
        let older = first.older.iter().cloned();
        older.chain(self.open_parts().map(|part| part.request)).collect()
    }

    /// Settles the open operations, given the answers to these requests.
    ///
    /// # Errors
    /// If it cannot be told any more what was done.
    pub(crate) fn settle(&self, answers: &Answers) -> Result<Settled, Forgotten> {
        let answer = |request: &str| answers.get(request).and_then(Option::as_ref);
        let parts: Vec<Part<'_>> = self.open_parts().collect();
        let done = parts.iter().rposition(|part| answer(&part.request).is_some()).map_or(0, |last| last + 1);
        let (done, open) = parts.split_at(done);
        let forgotten = |part: &Part<'_>| Forgotten { operation: part.operation().to_string() };
        let mut known: BTreeMap<(u64, usize), Vec<OperatedUnits>> = BTreeMap::new();
        for part in done {
            let units = answer(&part.request).and_then(|answer| part.units(answer)).ok_or_else(|| forgotten(part))?;
            known.insert((part.of.number, part.index), units);
        }
        let has_older = || self.operated.iter().take(1).flat_map(|one| &one.older).any(|older| answer(older).is_some());
        if let Some(part) = open.iter().find(|part| part.takes_away())
            && done.is_empty()
            && !has_older()
        {
            return Err(forgotten(part));
        }
        let first_open = open.first().map(|part| (part.of.number, part.index));
        let mut settled = Settled { account: self.account.clone(), done: Vec::new(), open: Vec::new() };
        for one in &self.operated {
            let Operated { number, instance, operations, .. } = one;
            // An operation that is no request has an empty result.
            let is_done = |index: &usize| first_open.is_none_or(|open| (*number, *index) < open);
            let units = (0..operations.len()).take_while(is_done);
            let units: Vec<_> = units.map(|index| known.remove(&(*number, index)).unwrap_or_default()).collect();
            settled.account.operated(&operations[..units.len()], &units);
            if units.len() == operations.len() {
                settled.done.push((*number, units));
            } else {
                let (number, instance, operations) = (*number, *instance, operations.clone());
                settled.open.push(Unfinished { number, instance, operations, done: units });
            }
        }
        Ok(settled)
    }

    /// The parts that are requests to the resource manager, in order.
    fn open_parts(&self) -> impl Iterator<Item = Part<'_>> {
        self.operated.iter().flat_map(|of| {
            let asked_for = of.operations.iter().enumerate().filter(|(_, operation)| is_asked_for(operation));
            asked_for.map(|(index, _)| {
                let request = operation_request(&self.origin.run, of.instance, of.number, index);
                Part { of, index, request }
            })
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_executive::protocol::{Command, Event, Origin};
    use ratn_model::id::{FencingToken, LeaseId};
    use ratn_model::resource::Lease;
    use ratn_model::time::Timestamp;

    fn of(operation: ResourceOperation, kind: &str, count: u32) -> Requirement {
        Requirement { count: count.into(), ..Requirement::new(operation, kind) }
    }

    fn units(resource: &str, units: u32, ends_with_session: bool) -> OperatedUnits {
        let kind = "Box".to_owned();
        OperatedUnits { resource: resource.to_owned(), kind, units: units.into(), ends_with_session }
    }

    /// A run that has been granted a lease and then decides these operations.
    fn ledger(operated: &[&[Requirement]]) -> Ledger {
        let instance = InstanceId(1);
        let mut ledger = Ledger { origin: Origin { run: "r".into(), ..Origin::default() }, ..Ledger::default() };
        ledger.command(&Command::Acquire { instance, requirements: Vec::new(), priority: 0 });
        let lease = Lease { id: LeaseId(1), token: FencingToken(1), resources: Vec::new(), consumed: Vec::new() };
        ledger.event(Timestamp(0), &Event::Granted { instance, lease });
        for operations in operated {
            ledger.command(&Command::Operate { instance, operations: operations.to_vec() });
        }
        ledger
    }

    /// Answers to some of the requests of a ledger, by their index among those to ask about.
    fn answers(ledger: &Ledger, known: &[(usize, Recalled)]) -> Answers {
        let requests = ledger.unheard_requests();
        known.iter().map(|(place, recalled)| (requests[*place].clone(), Some(recalled.clone()))).collect()
    }

    fn operated(units: Vec<OperatedUnits>) -> Recalled {
        Recalled { created: None, operated: units }
    }

    fn made(id: &str) -> Recalled {
        Recalled { created: Some(id.to_owned()), operated: Vec::new() }
    }

    const GRANT: usize = 1;
    const FIRST: usize = 3;

    #[test]
    fn requests_that_were_answered_before_are_asked_about_with_those_that_were_not() {
        let ledger = ledger(&[&[of(ResourceOperation::Create, "Box", 1), of(ResourceOperation::Exists, "Box", 1)]]);
        let asked = ledger.unheard_requests();
        assert_eq!(asked, ["r/i1/acquire-1/late", "r/i1/acquire-1", "r/claim-0", "r/i1/operate-1.0"]);
        assert!(Ledger::default().unheard_requests().is_empty());
    }

    #[test]
    fn what_is_known_is_done_and_what_is_behind_it_is_not() {
        use ResourceOperation::{Create, Delete};
        let ledger = ledger(&[&[of(Create, "Box", 2)], &[of(Delete, "Box", 1), of(Delete, "Box", 3)]]);
        let box_1 = || vec![units("Box-1", 1, true)];
        let known = [(FIRST, made("Box-1")), (FIRST + 1, operated(box_1()))];
        let settled = ledger.settle(&answers(&ledger, &known)).unwrap();
        assert_eq!(settled.done, [(1, vec![vec![units("Box-1", 2, true)]])]);
        let [open] = &settled.open[..] else { panic!("{settled:?}") };
        assert_eq!((open.number, &open.done, settled.removals()), (2, &vec![box_1()], 1));
        let left: Vec<_> = settled.account.created().iter().map(|one| one.left.count.units()).collect();
        assert_eq!(left, [1]);
    }

    #[test]
    fn what_takes_away_was_not_done_where_an_older_request_is_known_and_is_refused_where_none_is() {
        use ResourceOperation::{Consume, Create, Delete};
        for operation in [of(Delete, "Box", 1), of(Consume, "Box", 1)] {
            let ledger = ledger(&[&[of(Create, "Cup", 1)], std::slice::from_ref(&operation)]);
            for older in 0..FIRST {
                let settled = ledger.settle(&answers(&ledger, &[(older, Recalled::default())])).unwrap();
                assert_eq!((settled.done.len(), settled.open.len(), settled.removals()), (0, 2, 1));
            }
            let forgotten = ledger.settle(&Answers::new()).unwrap_err();
            assert!(forgotten.to_string().contains(&format!("whether `{operation}` was done is not known")));
        }
        let ledger = ledger(&[&[of(Create, "Cup", 1)]]);
        let settled = ledger.settle(&Answers::new()).unwrap();
        assert_eq!(settled.open.len(), 1, "what was created went with the session");
    }

    #[test]
    fn what_was_done_and_is_forgotten_is_refused() {
        use ResourceOperation::{Create, Delete};
        let ledger = ledger(&[&[of(Delete, "Box", 1)], &[of(Create, "Cup", 1)]]);
        let known = [(GRANT, Recalled::default()), (FIRST + 1, made("Cup-1"))];
        assert!(
            ledger.settle(&answers(&ledger, &known)).is_err(),
            "an older one is done, and what it took is not known"
        );
        let known = [(FIRST, Recalled::default())];
        assert!(ledger.settle(&answers(&ledger, &known)).is_err(), "an earlier version has done it");
    }
}
