//! Changes over a world, without a copy of the world: the facts that differ.

use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::value::Value;
use ratn_world::world::World;
use std::collections::BTreeMap;

/// The result of a list of changes, in which every `increase` has been replaced by its value.
#[derive(Debug, Default)]
pub(super) struct Overlay {
    /// `None`: the fact does not hold.
    keys: BTreeMap<FactKey, Option<Value>>,
    /// Facts of the world below that match do not hold, unless they are in `keys`.
    deleted: Vec<FactPattern>,
}

impl Overlay {
    pub(super) fn of<'c>(changes: impl IntoIterator<Item = &'c Change>) -> Overlay {
        let mut overlay = Overlay::default();
        changes.into_iter().for_each(|change| overlay.apply(change));
        overlay
    }

    fn apply(&mut self, change: &Change) {
        match change {
            Change::Set { fact, value } => drop(self.keys.insert(fact.clone(), Some(value.clone()))),
            Change::Delete { pattern } => {
                let above = self.keys.iter_mut().filter(|(key, _)| pattern.matches(key));
                above.for_each(|(_, value)| *value = None);
                self.deleted.push(pattern.clone());
            }
            Change::Increase { .. } => debug_assert!(false, "an increase is worked out where it is forecast"),
        }
    }

    /// The value of a fact after a list of changes; `Some(None)` if it was deleted, `None` if the list does not change
    /// it.
    pub(super) fn value_after(changes: &[Change], fact: &FactKey) -> Option<Option<Value>> {
        changes.iter().rev().find_map(|change| match change {
            Change::Set { fact: set, value } => (set == fact).then(|| Some(value.clone())),
            Change::Delete { pattern } => pattern.matches(fact).then_some(None),
            Change::Increase { .. } => None,
        })
    }

    fn is_deleted(&self, key: &FactKey) -> bool {
        self.deleted.iter().any(|pattern| pattern.matches(key))
    }

    /// Visits the facts that match, in the order of keys, until `visit` returns false.
    pub(super) fn each_fact(
        &self,
        below: &World,
        pattern: &FactPattern,
        visit: &mut dyn FnMut(&FactKey, &Value) -> bool,
    ) {
        let mut above = self.keys.iter().filter(|(key, _)| pattern.matches(key)).peekable();
        let mut goes_on = true;
        below.each_fact(pattern, &mut |key, value| {
            while goes_on && let Some((over, new)) = above.next_if(|(over, _)| *over < key) {
                goes_on = new.as_ref().is_none_or(|new| visit(over, new));
            }
            if !goes_on {
                return false;
            }
            match above.next_if(|(over, _)| *over == key) {
                Some((_, new)) => goes_on = new.as_ref().is_none_or(|new| visit(key, new)),
                None if self.is_deleted(key) => {}
                None => goes_on = visit(key, value),
            }
            goes_on
        });
        for (over, new) in above {
            goes_on = goes_on && new.as_ref().is_none_or(|new| visit(over, new));
        }
    }

    /// Every fact of a pattern that differs from the world below: its value below and here.
    pub(super) fn differing<'o>(
        &'o self,
        below: &'o World,
        looked: impl Fn(&FactKey) -> bool + 'o,
    ) -> Vec<(&'o FactKey, Option<&'o Value>, Option<&'o Value>)> {
        let mut all: Vec<_> = self
            .keys
            .iter()
            .filter(|(key, _)| looked(key))
            .map(|(key, value)| (key, below.get(key), value.as_ref()))
            .collect();
        for (place, pattern) in self.deleted.iter().enumerate() {
            for (key, fact) in below.matching(pattern) {
                let counted =
                    self.keys.contains_key(key) || self.deleted[..place].iter().any(|other| other.matches(key));
                if !counted && looked(key) {
                    all.push((key, Some(&fact.value), None));
                }
            }
        }
        all.retain(|(_, below, here)| below != here);
        all
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use ratn_model::fact::Term;
    use ratn_model::id::Revision;

    fn key(argument: i64) -> FactKey {
        FactKey { predicate: "p".into(), arguments: vec![Term::Int(argument)] }
    }

    #[test]
    fn facts_above_and_below_are_visited_in_one_order() {
        let below = World::from_facts((0..6).map(|n| (key(n), Value::Int(n))), Revision(0));
        let all = FactPattern { predicate: "p".into(), arguments: vec![None] };
        let changes = [
            Change::Set { fact: key(9), value: Value::Int(90) },
            Change::Delete { pattern: FactPattern::of(&key(9)) },
            Change::Set { fact: key(3), value: Value::Int(30) },
            Change::Delete { pattern: FactPattern::of(&key(4)) },
            Change::Set { fact: key(-1), value: Value::Int(0) },
        ];
        let overlay = Overlay::of(&changes);
        let mut seen = Vec::new();
        overlay.each_fact(&below, &all, &mut |key, value| {
            seen.push(format!("{key}={value}"));
            seen.len() < 5
        });
        assert_eq!(seen, ["p(-1)=0", "p(0)=0", "p(1)=1", "p(2)=2", "p(3)=30"]);
        let mut after = below.clone();
        after.apply(&changes).unwrap();
        let mut visited = Vec::new();
        overlay.each_fact(&below, &all, &mut |key, value| {
            visited.push((key.clone(), value.clone()));
            true
        });
        let expected: Vec<_> = after.iter().map(|(key, fact)| (key.clone(), fact.value.clone())).collect();
        assert_eq!(visited, expected);
        let differing: Vec<String> =
            overlay.differing(&below, |_| true).iter().map(|(key, ..)| key.to_string()).collect();
        assert_eq!(differing, ["p(-1)", "p(3)", "p(4)"]);
    }
}
