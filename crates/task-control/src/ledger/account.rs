//! The account of a run: what it has created and used up in its session, by the ids that the resource manager reported. If the session is lost, all
//! of it has to be made again.
//!
//! The account omits deletions of others' resources and permanent consumption, because both outlast the session.

use ratn_model::resource::{Lease, OperatedUnits, Quantity, Requirement, ResourceOperation};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// See the module.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Account {
    /// In the order of creation.
    created: Vec<Created>,
    /// By resource. These units return when the session ends, or vanish with their resource.
    used_up: BTreeMap<String, UsedUp>,
    /// The first operation whose result is unknown.
    unknown: Option<String>,
}

/// What is left of a resource that the run has created.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Created {
    /// Its id.
    pub(crate) resource: String,
    /// The requirement with which it was created, with the count that is left.
    pub(crate) left: Requirement,
}

/// The units of a resource that the run has used up.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct UsedUp {
    pub(crate) kind: String,
    pub(crate) units: Quantity,
}

impl Account {
    /// The operations are done; `units` has the result of each.
    pub(crate) fn operated(&mut self, operations: &[Requirement], units: &[Vec<OperatedUnits>]) {
        if units.len() != operations.len() {
            let unknown = operations.first().map(ToString::to_string);
            self.unknown = self.unknown.take().or(unknown);
            return;
        }
        for (operation, units) in operations.iter().zip(units) {
            self.done(operation, units);
        }
    }

    /// An operation, or the consumption of a grant, is done.
    fn done(&mut self, operation: &Requirement, units: &[OperatedUnits]) {
        for one in units {
            match operation.operation {
                ResourceOperation::Create => {
                    let left = Requirement { count: one.units, ..operation.clone() };
                    self.created.push(Created { resource: one.resource.clone(), left });
                }
                ResourceOperation::Delete => self.deleted(one),
                ResourceOperation::Consume => self.consumed(one),
                ResourceOperation::Block | ResourceOperation::Exists => {}
            }
        }
    }

    /// A lease was granted. It lists the units that the grant has used up, unless the resource manager does not report them.
    pub(crate) fn granted(&mut self, requirements: &[Requirement], lease: &Lease) {
        let consumes = |one: &&Requirement| one.operation == ResourceOperation::Consume;
        let wanted: Quantity = requirements.iter().filter(consumes).map(|one| one.count).sum();
        let told: Quantity = lease.consumed.iter().map(|one| one.units).sum();
        if told != wanted {
            let unknown = requirements.iter().find(consumes).map(ToString::to_string);
            self.unknown = self.unknown.take().or(unknown);
        }
        lease.consumed.iter().for_each(|one| self.consumed(one));
    }

    fn deleted(&mut self, deleted: &OperatedUnits) {
        for created in self.created.iter_mut().filter(|one| one.resource == deleted.resource) {
            created.left.count = created.left.count.saturating_sub(deleted.units);
        }
        self.created.retain(|one| !one.left.count.is_zero());
    }

    fn consumed(&mut self, consumed: &OperatedUnits) {
        if !consumed.ends_with_session {
            return;
        }
        let new = || UsedUp { kind: consumed.kind.clone(), units: Quantity::ZERO };
        let used_up = self.used_up.entry(consumed.resource.clone()).or_insert_with(new);
        let sum = used_up.units.thousandths().saturating_add(consumed.units.thousandths());
        used_up.units = Quantity::from_thousandths(sum.min(Quantity::MAX.thousandths()));
    }

    /// The created resources exist again, under other ids.
    pub(crate) fn renamed(&mut self, renamed: &BTreeMap<String, String>) {
        let name = |old: &mut String| {
            if let Some(new) = renamed.get(old) {
                old.clone_from(new);
            }
        };
        self.created.iter_mut().for_each(|one| name(&mut one.resource));
        let used_up = std::mem::take(&mut self.used_up).into_iter();
        self.used_up =
            used_up.map(|(resource, used_up)| (renamed.get(&resource).cloned().unwrap_or(resource), used_up)).collect();
    }

    /// The first operation whose result is unknown.
    pub(crate) fn unknown(&self) -> Option<&str> {
        self.unknown.as_deref()
    }

    /// The resources that the run has created and not deleted again.
    pub(crate) fn created(&self) -> &[Created] {
        &self.created
    }

    /// By resource: the units used up by the run that return when its session ends, or vanish with it.
    pub(crate) fn used_up(&self) -> impl Iterator<Item = (&str, &UsedUp)> {
        self.used_up.iter().map(|(resource, used_up)| (resource.as_str(), used_up))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::{FencingToken, LeaseId};

    fn of(operation: ResourceOperation, kind: &str, count: u32) -> Requirement {
        Requirement { count: count.into(), ..Requirement::new(operation, kind) }
    }

    fn units(resource: &str, units: u32, ends_with_session: bool) -> OperatedUnits {
        let kind = resource.trim_end_matches(|digit: char| digit.is_ascii_digit()).to_owned();
        OperatedUnits { resource: resource.to_owned(), kind, units: units.into(), ends_with_session }
    }

    fn left(account: &Account) -> Vec<(&str, u32)> {
        account.created().iter().map(|one| (one.resource.as_str(), one.left.count.units())).collect()
    }

    fn used_up(account: &Account) -> Vec<(&str, u32)> {
        account.used_up().map(|(resource, one)| (resource, one.units.units())).collect()
    }

    #[test]
    fn what_is_deleted_is_what_the_manager_took_and_what_others_had_made_is_not_counted() {
        use ResourceOperation::{Create, Delete};
        let mut account = Account::default();
        let operations = [of(Create, "Box", 3), of(Create, "Box", 2), of(Delete, "Box", 4)];
        let done = [
            vec![units("Box1", 3, true)],
            vec![units("Box2", 2, true)],
            vec![units("Box2", 2, true), units("Box9", 2, false)],
        ];
        account.operated(&operations, &done);
        assert_eq!((left(&account), account.unknown()), (vec![("Box1", 3)], None));
    }

    #[test]
    fn what_is_used_up_counts_by_resource_where_it_ends_with_the_session() {
        use ResourceOperation::Consume;
        let mut account = Account::default();
        let done = vec![units("Glue1", 1, false), units("Glue2", 1, true)];
        account.operated(&[of(Consume, "Glue", 2)], &[done]);
        let lease = Lease {
            id: LeaseId(1),
            token: FencingToken(1),
            resources: Vec::new(),
            consumed: vec![units("Glue2", 3, true)],
        };
        account.granted(&[of(ResourceOperation::Block, "Arm", 1), of(Consume, "Glue", 3)], &lease);
        assert_eq!((used_up(&account), account.unknown()), (vec![("Glue2", 4)], None));
    }

    #[test]
    fn what_was_made_anew_has_its_new_id_from_then_on() {
        use ResourceOperation::{Consume, Create, Delete};
        let mut account = Account::default();
        let operations = [of(Create, "Box", 3), of(Consume, "Box", 1), of(Consume, "Glue", 1)];
        let done = [vec![units("Box1", 3, true)], vec![units("Box1", 1, true)], vec![units("Glue1", 1, true)]];
        account.operated(&operations, &done);
        account.renamed(&BTreeMap::from([("Box1".to_owned(), "Box7".to_owned())]));
        assert_eq!((left(&account), used_up(&account)), (vec![("Box7", 3)], vec![("Box7", 1), ("Glue1", 1)]));
        account.operated(&[of(Delete, "Box", 2)], &[vec![units("Box7", 2, true)]]);
        assert_eq!(left(&account), [("Box7", 1)]);
    }

    #[test]
    fn what_a_manager_of_before_does_not_say_is_known_to_be_unknown() {
        use ResourceOperation::{Consume, Create};
        let mut account = Account::default();
        account.operated(&[of(Create, "Box", 1)], &[]);
        account.operated(&[of(Create, "Cup", 1)], &[]);
        assert_eq!(account.unknown(), Some(of(Create, "Box", 1).to_string().as_str()), "the first");
        let mut account = Account::default();
        let lease = Lease { id: LeaseId(1), token: FencingToken(1), resources: Vec::new(), consumed: Vec::new() };
        account.granted(&[of(ResourceOperation::Block, "Arm", 1)], &lease);
        assert_eq!(account.unknown(), None);
        account.granted(&[of(Consume, "Glue", 1)], &lease);
        assert!(account.unknown().is_some());
    }
}
