//! What each caller has in the pool: how many sessions it opened, and how many acquires of those wait. Counted beside the sessions,
//! which say whose they are; kept nowhere.

use crate::session::Sessions;
use std::collections::BTreeMap;
use std::sync::Arc;

/// By the name that the connection proves.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Callers(BTreeMap<Arc<str>, Has>);

#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Has {
    sessions: usize,
    waiters: usize,
}

impl Callers {
    /// As the sessions say.
    pub(crate) fn of(sessions: &Sessions) -> Callers {
        let mut callers = Callers::default();
        for session in sessions.values() {
            callers.opened(&session.opened_by);
            session.waiters.iter().for_each(|_| callers.waits(&session.opened_by));
        }
        callers
    }

    pub(crate) fn sessions(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.sessions)
    }

    pub(crate) fn waiters(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.waiters)
    }

    pub(crate) fn opened(&mut self, caller: &Arc<str>) {
        self.0.entry(caller.clone()).or_default().sessions += 1;
    }

    pub(crate) fn closed(&mut self, caller: &str) {
        self.less(caller, |has| &mut has.sessions);
    }

    pub(crate) fn waits(&mut self, caller: &Arc<str>) {
        self.0.entry(caller.clone()).or_default().waiters += 1;
    }

    pub(crate) fn waits_no_more(&mut self, caller: &str) {
        self.less(caller, |has| &mut has.waiters);
    }

    fn less(&mut self, caller: &str, count: impl Fn(&mut Has) -> &mut usize) {
        let Some(has) = self.0.get_mut(caller) else { return };
        let count = count(has);
        *count = count.saturating_sub(1);
        if *has == Has::default() {
            self.0.remove(caller);
        }
    }
}
