//! The gain from results that improved after they were first given, while the run went on with them.

use ratn_model::id::InstanceId;
use serde::Serialize;
use std::collections::BTreeMap;

/// The gain from improvement in a run. All of it was free: nobody waited for it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Improvement {
    /// Number of retired results that had been given for use while their goals went on.
    pub results: usize,
    /// Number of those that improved.
    pub better: usize,
    /// Cost of the first results, in seconds of robot time: how long the motions would have taken.
    pub first_cost_s: f64,
    /// Reduction of that cost in the end.
    pub gained_s: f64,
}

/// Goals that gave a result and went on; kept until the goal has ended and the fate of its result is known.
#[derive(Debug, Clone, Default)]
pub(super) struct Improvements {
    open: BTreeMap<InstanceId, One>,
    total: Improvement,
}

#[derive(Debug, Clone, Copy)]
struct One {
    attempt: u32,
    first_s: f64,
    best_s: f64,
    is_over: bool,
    is_real: bool,
}

impl Improvements {
    /// A goal gave a result: its first or a better one.
    pub(super) fn given(&mut self, id: InstanceId, attempt: u32, cost_s: f64) {
        let first = One { attempt, first_s: cost_s, best_s: cost_s, is_over: false, is_real: false };
        let one = self.open.entry(id).or_insert(first);
        if one.attempt != attempt {
            *one = first;
        } else if !one.is_over {
            one.best_s = one.best_s.min(cost_s);
        }
    }

    /// Whether a goal has given a result.
    pub(super) fn has(&self, id: InstanceId, attempt: u32) -> bool {
        self.open.get(&id).is_some_and(|one| one.attempt == attempt)
    }

    /// A goal has ended. Returns whether it had given a result before.
    pub(super) fn is_over(&mut self, id: InstanceId, attempt: u32) -> bool {
        let Some(one) = self.open.get_mut(&id).filter(|one| one.attempt == attempt) else { return false };
        one.is_over = true;
        self.count(id);
        true
    }

    /// The result has retired.
    pub(super) fn is_real(&mut self, id: InstanceId) {
        if let Some(one) = self.open.get_mut(&id) {
            one.is_real = true;
            self.count(id);
        }
    }

    /// The result was discarded.
    pub(super) fn is_gone(&mut self, id: InstanceId) {
        self.open.remove(&id);
    }

    fn count(&mut self, id: InstanceId) {
        if let Some(one) = self.open.get(&id).copied().filter(|one| one.is_over && one.is_real) {
            self.open.remove(&id);
            self.total.add(&one);
        }
    }

    /// The gain from the results that have retired so far.
    pub(super) fn total(&self) -> Improvement {
        let mut total = self.total;
        self.open.values().filter(|one| one.is_real).for_each(|one| total.add(one));
        total
    }
}

impl Improvement {
    fn add(&mut self, one: &One) {
        self.results += 1;
        self.better += usize::from(one.best_s < one.first_s);
        self.first_cost_s += one.first_s;
        self.gained_s += one.first_s - one.best_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_real_counts_with_the_best_that_was_given_in_time() {
        let (used, discarded) = (InstanceId(1), InstanceId(2));
        let mut improvements = Improvements::default();
        for (id, cost_s) in [(used, 5.0), (discarded, 9.0), (used, 4.0), (discarded, 1.0), (used, 3.5)] {
            improvements.given(id, 1, cost_s);
        }
        assert!(improvements.is_over(used, 1));
        // The better result crossed with the message that it is not wanted any more.
        improvements.given(used, 1, 1.0);
        improvements.is_gone(discarded);
        assert_eq!(improvements.total(), Improvement::default());
        improvements.is_real(used);
        let expected = Improvement { results: 1, better: 1, first_cost_s: 5.0, gained_s: 1.5 };
        assert_eq!(improvements.total(), expected);
        assert!(!improvements.is_over(used, 1));
    }

    #[test]
    fn another_attempt_is_another_result() {
        let mut improvements = Improvements::default();
        improvements.given(InstanceId(1), 1, 2.0);
        improvements.given(InstanceId(1), 2, 7.0);
        improvements.is_real(InstanceId(1));
        assert_eq!(improvements.total().first_cost_s, 7.0);
    }
}
