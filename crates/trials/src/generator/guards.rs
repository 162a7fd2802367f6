//! `retry` of any state with something to execute before each try, and `finally`.

use super::*;
use ratn_model::guard::Retried;

impl Maker {
    /// Adds a guard to an existing state.
    pub(super) fn guard(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) {
        let mut guard = Guard::default();
        if self.dice.percent(70) {
            let count = 1 + self.dice.below(2) as u32;
            let backoff_s = if self.dice.percent(30) { 0.5 * (1 + self.dice.below(8)) as f64 } else { 0.0 };
            let mut on = vec![ABORTED.to_owned()];
            let custom = self.at(id).outcomes.clone();
            if let Some(outcome) = self.dice.one_of(&custom).filter(|_| self.dice.percent(40)) {
                on.push(outcome.clone());
            }
            if self.dice.percent(10) {
                on.push(PREEMPTED.to_owned());
            }
            let mut before = Vec::new();
            if self.dice.percent(60) {
                before = self.beside(id, path, depth, room, visible);
            }
            guard.retried = Some(Retried { count, backoff_s, on, before });
        }
        if guard.retried.is_none() || self.dice.percent(30) {
            guard.finally = self.beside(id, path, depth, room, visible);
        }
        self.guards.insert(id, guard);
    }

    /// States of a guard; the guarded state may be left by the outcomes of these states.
    fn beside(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> Vec<StateId> {
        let (list, _, leaving) = self.list(id, path, depth + 2, room, visible.clone(), false);
        for outcome in leaving {
            if !self.at(id).outcomes.contains(&outcome) {
                self.at(id).outcomes.push(outcome);
            }
        }
        list
    }
}
