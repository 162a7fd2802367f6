//! Signals that were sent to the run and that no wait has taken yet.
//!
//! Each signal ends one wait, the oldest signal of a name first; one that arrives before its wait is kept. Only a wait at its place in
//! the program takes a signal, never a speculative instance, so none is lost with a branch that is not taken.

use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// Limit of kept signals per name.
pub const MOST_SIGNALS_KEPT: usize = 1024;

/// What was sent, by name.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Signals {
    kept: BTreeMap<String, VecDeque<Value>>,
}

impl Signals {
    /// Keeps a signal for a later wait. Above the limit it is dropped; task control refuses such signals before they become events.
    /// While a wait for a name is under way, none of its signals are kept, so a signal that is waited for is never refused.
    pub(crate) fn came(&mut self, name: String, value: Value) {
        let of_name = self.kept.entry(name).or_default();
        if of_name.len() < MOST_SIGNALS_KEPT {
            of_name.push_back(value);
        }
    }

    /// Takes the oldest kept signal of a name for a wait.
    pub(crate) fn take(&mut self, name: &str) -> Option<Value> {
        let of_name = self.kept.get_mut(name)?;
        let value = of_name.pop_front();
        if of_name.is_empty() {
            self.kept.remove(name);
        }
        value
    }

    /// Number of kept signals of a name.
    pub(crate) fn count(&self, name: &str) -> usize {
        self.kept.get(name).map_or(0, VecDeque::len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_signal_ends_one_wait_and_the_oldest_of_a_name_comes_first() {
        let mut signals = Signals::default();
        for (name, value) in [("go", 1), ("stop", 2), ("go", 3)] {
            signals.came(name.to_owned(), Value::Int(value));
        }
        assert_eq!((signals.count("go"), signals.count("stop")), (2, 1));
        assert_eq!(signals.take("go"), Some(Value::Int(1)));
        assert_eq!(signals.take("go"), Some(Value::Int(3)));
        assert_eq!(signals.take("go"), None);
        assert_eq!(signals.take("stop"), Some(Value::Int(2)));
        assert_eq!(signals, Signals::default());
    }

    #[test]
    fn no_more_of_a_name_are_kept_than_the_bound_says_and_none_for_those_of_another() {
        let mut signals = Signals::default();
        for number in 0..2 * MOST_SIGNALS_KEPT as i64 {
            signals.came("go".to_owned(), Value::Int(number));
        }
        assert_eq!(signals.count("go"), MOST_SIGNALS_KEPT);
        signals.came("stop".to_owned(), Value::Null);
        assert_eq!(signals.take("stop"), Some(Value::Null));
    }
}
