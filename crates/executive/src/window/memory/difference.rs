//! The facts in which two lists of changes differ, and whether the differences are within the tolerances of the facts.

use ratn_model::fact::{Change, FactKey, FactPattern};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use std::collections::BTreeMap;

/// One fact, or several, that came out otherwise than predicted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Deviation {
    pub(crate) pattern: FactPattern,
    /// The predicted value; `None`: not mentioned, or deleted.
    pub(crate) was: Option<Value>,
    /// The present value; `None`: not mentioned, or deleted.
    pub(crate) is: Option<Value>,
    /// Whether the deviation is within the tolerance.
    pub(crate) is_tolerated: bool,
}

/// All deviations between two lists of changes.
#[derive(Debug, Default)]
pub(crate) struct Difference {
    pub(crate) deviations: Vec<Deviation>,
}

impl Difference {
    pub(crate) fn is_empty(&self) -> bool {
        self.deviations.is_empty()
    }

    /// The deviations that are within the tolerance, or those beyond it.
    pub(crate) fn that_are(&self, tolerated: bool) -> impl Iterator<Item = &Deviation> {
        self.deviations.iter().filter(move |deviation| deviation.is_tolerated == tolerated)
    }

    /// Whether every deviation beyond the tolerance concerns a single fact.
    pub(super) fn is_of_single_facts(&self) -> bool {
        self.that_are(false).all(|deviation| deviation.pattern.arguments.iter().all(Option::is_some))
    }

    /// The present changes, but facts that differ within the tolerance only keep the values that readers have seen.
    pub(super) fn keep_otherwise(&self, was: &[Change], is: &[Change]) -> Vec<Change> {
        let differs = |key: &FactKey| self.that_are(false).any(|deviation| deviation.pattern.matches(key));
        let before = Final::of(was);
        let kept = |change: &Change| match change {
            Change::Set { fact, .. } if !differs(fact) => match before.keys.get(fact) {
                Some(Some(value)) => Change::Set { fact: fact.clone(), value: (*value).clone() },
                _ => change.clone(),
            },
            other => other.clone(),
        };
        is.iter().map(kept).collect()
    }

    /// Adds facts that are not known any more, or that were not compared.
    pub(super) fn add_unknown(&mut self, patterns: impl IntoIterator<Item = FactPattern>) {
        let unknown = |pattern| Deviation { pattern, was: None, is: None, is_tolerated: false };
        self.deviations.extend(patterns.into_iter().map(unknown));
    }

    /// Adds the facts in which the predicted changes `was` differ from the present changes `is`. `elsewhere` gives the value
    /// of a fact that only one of the lists mentions, if it is known.
    pub(super) fn add(
        &mut self,
        was: &[Change],
        is: &[Change],
        tolerance: impl Fn(&FactKey) -> Tolerance,
        elsewhere: impl Fn(&FactKey) -> Option<Option<Value>>,
    ) {
        if was == is {
            return;
        }
        let (before, now) = (Final::of(was), Final::of(is));
        for pattern in before.deleted.iter().chain(&now.deleted) {
            if before.deleted.contains(pattern) != now.deleted.contains(pattern) {
                self.add_unknown([(*pattern).clone()]);
            }
        }
        let keys: std::collections::BTreeSet<&FactKey> = before.keys.keys().chain(now.keys.keys()).copied().collect();
        for key in keys {
            let of = |list: &Final<'_>| match list.keys.get(key) {
                Some(value) => Some(value.cloned()),
                None if list.deletes(key) => Some(None),
                None => elsewhere(key),
            };
            let (was, is) = (of(&before), of(&now));
            if was.is_some() && was == is {
                continue;
            }
            let is_tolerated = match (&was, &is) {
                (Some(Some(was)), Some(Some(is))) => tolerance(key).equal(was, is),
                _ => false,
            };
            let pattern = FactPattern::of(key);
            self.deviations.push(Deviation { pattern, was: was.flatten(), is: is.flatten(), is_tolerated });
        }
    }
}

impl Deviation {
    /// The deviation as a sentence.
    pub(crate) fn sentence(&self) -> String {
        let said = |value: &Option<Value>| value.as_ref().map_or("nothing".to_owned(), ToString::to_string);
        match (&self.was, &self.is) {
            (None, None) => format!("what it read, {}, is computed again", self.pattern),
            (was, is) => format!("{} was {}, as predicted, and came out as {}", self.pattern, said(was), said(is)),
        }
    }
}

/// The final result of a list of changes.
struct Final<'c> {
    keys: BTreeMap<&'c FactKey, Option<&'c Value>>,
    deleted: Vec<&'c FactPattern>,
}

impl<'c> Final<'c> {
    fn of(changes: &'c [Change]) -> Final<'c> {
        let mut all = Final { keys: BTreeMap::new(), deleted: Vec::new() };
        for change in changes {
            match change {
                Change::Set { fact, value } => drop(all.keys.insert(fact, Some(value))),
                Change::Delete { pattern } => {
                    let above = all.keys.iter_mut().filter(|(key, _)| pattern.matches(key));
                    above.for_each(|(_, value)| *value = None);
                    all.deleted.push(pattern);
                }
                Change::Increase { fact, .. } => drop(all.keys.insert(fact, None)),
            }
        }
        all
    }

    fn deletes(&self, key: &FactKey) -> bool {
        self.deleted.iter().any(|pattern| pattern.matches(key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::fact::Term;

    fn set(argument: i64, value: f64) -> Change {
        let fact = FactKey { predicate: "p".into(), arguments: vec![Term::Int(argument)] };
        Change::Set { fact, value: Value::Float(value) }
    }

    fn differing(was: &[Change], is: &[Change], number: f64) -> Vec<String> {
        let mut difference = Difference::default();
        difference.add(was, is, |_| Tolerance { number, ..Tolerance::EXACT }, |_| None);
        difference.that_are(false).map(|deviation| deviation.pattern.to_string()).collect()
    }

    #[test]
    fn only_what_is_beyond_the_tolerance_differs_and_order_means_nothing() {
        assert_eq!(differing(&[set(1, 1.0), set(2, 5.0)], &[set(2, 5.05), set(1, 1.0)], 0.1), [""; 0]);
        assert_eq!(differing(&[set(1, 1.0), set(2, 5.0)], &[set(2, 5.2), set(1, 1.0)], 0.1), ["p(2)"]);
        assert_eq!(differing(&[], &[set(3, 1.0)], 0.1), ["p(3)"], "what nobody expected differs");
        assert_eq!(differing(&[set(3, 1.0)], &[], 0.1), ["p(3)"]);
    }

    #[test]
    fn a_deletion_of_many_differs_from_that_of_one() {
        let all = Change::Delete { pattern: FactPattern { predicate: "p".into(), arguments: vec![None] } };
        assert_eq!(differing(&[all.clone(), set(1, 1.0)], &[set(1, 1.0)], 0.0), ["p(?)"]);
        assert_eq!(differing(&[set(1, 1.0), all.clone()], &[all], 0.0), [""; 0]);
    }
}
