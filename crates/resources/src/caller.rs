//! Use of the pool by each caller: the numbers of sessions, of resources provided, of leases, of waiting acquires and of their selectors. Derived
//! from the sessions, which name their callers; not stored. [`Share`] checks whether a caller may have more.

use crate::error::{ALL, ALL_BUT_OPERATORS, PoolError};
use crate::group::Key;
use crate::lease::EndingLeases;
use crate::queue::Queue;
use crate::session::{Session, Sessions};
use std::collections::BTreeMap;
use std::sync::Arc;

/// By the caller's name, which the connection proves.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Callers(BTreeMap<Arc<str>, Has>);

#[derive(Debug, Clone, Default, PartialEq)]
struct Has {
    sessions: usize,
    resources: usize,
    /// Including leases that have ended but whose providers have not confirmed standstill.
    leases: usize,
    waiters: usize,
    /// For each selector, the number of requirements of the caller's waiters.
    selectors: BTreeMap<Key, usize>,
}

/// The use of something limited, and its limits.
pub(crate) struct Share {
    pub(crate) what: &'static str,
    pub(crate) there: usize,
    /// The name and the value of the limit in total.
    pub(crate) limit: (&'static str, usize),
    /// The name and the value of the part that is reserved for operators.
    pub(crate) for_operators: (&'static str, usize),
    pub(crate) of_caller: usize,
    /// The name and the value of the limit per caller.
    pub(crate) quota: (&'static str, usize),
}

impl Share {
    /// Whether a session may have this many more.
    pub(crate) fn check(&self, more: usize, session: &Session) -> Result<(), PoolError> {
        let Share { what, there, limit: (key, limit), for_operators, of_caller, quota: (quota, most) } = *self;
        if there + more > limit {
            return Err(PoolError::TooMany { what, whose: ALL, key, limit });
        }
        if session.is_operators() {
            return Ok(());
        }
        if of_caller + more > most {
            return Err(PoolError::Quota { what, whose: session.opened_by.clone(), quota, limit: most });
        }
        let (key, for_operators) = for_operators;
        let for_all = for_all(limit, for_operators);
        if there + more > for_all {
            return Err(PoolError::TooMany { what, whose: ALL_BUT_OPERATORS, key, limit: for_all });
        }
        Ok(())
    }
}

/// The part of a limit that is for everybody: at least half of it.
pub(crate) fn for_all(limit: usize, for_operators: usize) -> usize {
    limit - for_operators.min(limit / 2)
}

impl Callers {
    /// Counts the sessions, ending leases and waiters.
    pub(crate) fn of(sessions: &Sessions, ending: &EndingLeases, queue: &Queue) -> Callers {
        let mut callers = Callers::default();
        for session in sessions.values() {
            let caller = &session.opened_by;
            callers.opened(caller);
            session.provides.iter().for_each(|_| callers.provides(caller));
            session.leases.iter().for_each(|_| callers.holds(caller));
            for waiter in session.waiters.iter().filter_map(|id| queue.get(*id)) {
                callers.waits(caller, &waiter.groups);
            }
        }
        ending.values().for_each(|ending| callers.holds(&ending.opened_by));
        callers
    }

    pub(crate) fn sessions(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.sessions)
    }

    pub(crate) fn resources(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.resources)
    }

    pub(crate) fn leases(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.leases)
    }

    pub(crate) fn waiters(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.waiters)
    }

    pub(crate) fn selectors(&self, caller: &str) -> usize {
        self.0.get(caller).map_or(0, |has| has.selectors.len())
    }

    /// The selectors that each caller waits for.
    pub(crate) fn waited_for(&self) -> impl Iterator<Item = impl Iterator<Item = &Key>> {
        self.0.values().map(|has| has.selectors.keys())
    }

    /// How many of these selectors a caller does not wait for yet.
    pub(crate) fn new_selectors(&self, caller: &str, groups: &[Key]) -> usize {
        let mut groups: Vec<&Key> = groups.iter().collect();
        groups.sort_unstable();
        groups.dedup();
        let known = |key: &Key| self.0.get(caller).is_some_and(|has| has.selectors.contains_key(key));
        groups.into_iter().filter(|key| !known(key)).count()
    }

    pub(crate) fn provides(&mut self, caller: &Arc<str>) {
        self.0.entry(caller.clone()).or_default().resources += 1;
    }

    pub(crate) fn provides_no_more(&mut self, caller: &str) {
        self.less(caller, |has| &mut has.resources);
    }

    pub(crate) fn holds(&mut self, caller: &Arc<str>) {
        self.0.entry(caller.clone()).or_default().leases += 1;
    }

    pub(crate) fn holds_no_more(&mut self, caller: &str) {
        self.less(caller, |has| &mut has.leases);
    }

    pub(crate) fn opened(&mut self, caller: &Arc<str>) {
        self.0.entry(caller.clone()).or_default().sessions += 1;
    }

    pub(crate) fn closed(&mut self, caller: &str) {
        self.less(caller, |has| &mut has.sessions);
    }

    pub(crate) fn waits(&mut self, caller: &Arc<str>, groups: &[Key]) {
        let has = self.0.entry(caller.clone()).or_default();
        has.waiters += 1;
        groups.iter().for_each(|key| *has.selectors.entry(key.clone()).or_default() += 1);
    }

    pub(crate) fn waits_no_more(&mut self, caller: &str, groups: &[Key]) {
        let Some(has) = self.0.get_mut(caller) else { return };
        for key in groups {
            let Some(count) = has.selectors.get_mut(key) else { continue };
            *count -= 1;
            if *count == 0 {
                has.selectors.remove(key);
            }
        }
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
