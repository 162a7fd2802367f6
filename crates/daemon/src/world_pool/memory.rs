//! Remembered answers, by caller and request id: a request that the same caller repeats under the same id is performed once.
//!
//! Bounded in all and for each caller. A caller's own oldest answers are forgotten first; where all callers together have too many, the
//! oldest of the caller with the most is forgotten.

use super::fingerprint::Fingerprint;
use crate::access::Caller;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum numbers of remembered answers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub(super) in_all: usize,
    pub(super) per_caller: usize,
}

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Memory<T> {
    answers: BTreeMap<Key, Answer<T>>,
    /// Answers of all callers, oldest first.
    order: BTreeMap<u64, Key>,
    /// The sequence numbers of each caller's answers.
    of_callers: BTreeMap<Arc<str>, BTreeMap<u64, Arc<str>>>,
    next: u64,
    bounds: Bounds,
}

/// The id comes first, so that all answers of one id are adjacent.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    id: Arc<str>,
    caller: Arc<str>,
}

#[derive(Debug, Clone)]
struct Answer<T> {
    fingerprint: Fingerprint,
    value: T,
}

/// An id that was used for another request before.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("request id `{id}` was used for another request before; ids are unique to what is asked")]
pub(super) struct Reused {
    pub(super) id: String,
}

impl<T: Copy> Memory<T> {
    pub(super) fn new(bounds: Bounds) -> Memory<T> {
        let (answers, order, of_callers) = Default::default();
        Memory { answers, order, of_callers, next: 0, bounds }
    }

    /// The first answer to this request; an empty id is never known. An answer whose caller is unknown belongs to everybody who asks the
    /// same.
    pub(super) fn recall(&self, caller: &Arc<str>, id: &str, fingerprint: Fingerprint) -> Result<Option<T>, Reused> {
        let key = Key { id: Arc::from(id), caller: caller.clone() };
        if let Some(own) = self.answers.get(&key) {
            let is_same = own.fingerprint.may_be(fingerprint);
            return if is_same { Ok(Some(own.value)) } else { Err(Reused { id: id.to_owned() }) };
        }
        let unknown = self.answers.get(&Key { caller: Arc::default(), ..key });
        Ok(unknown.filter(|answer| answer.fingerprint.may_be(fingerprint)).map(|answer| answer.value))
    }

    /// The answer to a request of this caller, whatever the request was.
    pub(super) fn of(&self, caller: &Arc<str>, id: &str) -> Option<T> {
        self.answers.get(&Key { id: Arc::from(id), caller: caller.clone() }).map(|answer| answer.value)
    }

    /// As [`Memory::recall`]. An operator may continue what another caller began: the same request of any caller counts as the operator's.
    pub(super) fn recall_for(&self, caller: &Caller, id: &str, fingerprint: Fingerprint) -> Result<Option<T>, Reused> {
        let own = self.recall(&caller.name, id, fingerprint)?;
        if own.is_some() || !caller.is_operator() {
            return Ok(own);
        }
        let of_all = self.answers.range(Key { id: Arc::from(id), caller: Arc::default() }..);
        let mut same = of_all.take_while(|(key, _)| &*key.id == id).map(|(_, answer)| answer);
        Ok(same.find(|answer| answer.fingerprint == fingerprint).map(|answer| answer.value))
    }

    pub(super) fn insert(&mut self, caller: &Arc<str>, id: &str, fingerprint: Fingerprint, value: T) {
        let key = Key { id: Arc::from(id), caller: caller.clone() };
        if key.id.is_empty() || self.answers.insert(key.clone(), Answer { fingerprint, value }).is_some() {
            return;
        }
        let number = self.next;
        self.next += 1;
        let of_caller = self.of_callers.entry(caller.clone()).or_default();
        of_caller.insert(number, key.id.clone());
        let too_many = of_caller.len() > self.bounds.per_caller;
        self.order.insert(number, key);
        if too_many {
            self.forget_oldest(caller);
        }
        while self.order.len() > self.bounds.in_all {
            let most = self.of_callers.iter().max_by_key(|(_, answers)| answers.len());
            let Some(most) = most.map(|(caller, _)| caller.clone()) else { return };
            self.forget_oldest(&most);
        }
    }

    fn forget_oldest(&mut self, caller: &Arc<str>) {
        let Some(of_caller) = self.of_callers.get_mut(caller) else { return };
        if let Some((number, id)) = of_caller.pop_first() {
            self.order.remove(&number);
            self.answers.remove(&Key { id, caller: caller.clone() });
        }
        if of_caller.is_empty() {
            self.of_callers.remove(caller);
        }
    }

    /// The answers with their callers, oldest first.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Arc<str>, &Arc<str>, Fingerprint, T)> {
        self.order.values().filter_map(|key| {
            let answer = self.answers.get(key)?;
            Some((&key.caller, &key.id, answer.fingerprint, answer.value))
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::access::Role;
    use ratn_proto::v1;

    /// The fingerprint of request number `n`.
    fn print(n: u64) -> Fingerprint {
        Fingerprint::of("test", &v1::CommitRequest { revision: n, ..v1::CommitRequest::default() })
    }

    fn memory(in_all: usize, per_caller: usize) -> Memory<u32> {
        Memory::new(Bounds { in_all, per_caller })
    }

    #[test]
    fn the_same_id_of_another_caller_is_another_request() {
        let mut memory = memory(10, 10);
        let (adam, eve): (Arc<str>, Arc<str>) = ("adam".into(), "eve".into());
        memory.insert(&adam, "r", print(1), 1);
        assert_eq!(memory.recall(&adam, "r", print(1)), Ok(Some(1)));
        assert_eq!(memory.recall(&adam, "r", print(2)), Err(Reused { id: "r".to_owned() }));
        assert_eq!(memory.recall(&eve, "r", print(1)), Ok(None));
        assert_eq!(memory.recall(&eve, "r", print(2)), Ok(None));
        memory.insert(&eve, "r", print(2), 2);
        assert_eq!(
            (memory.recall(&adam, "r", print(1)), memory.recall(&eve, "r", print(2))),
            (Ok(Some(1)), Ok(Some(2)))
        );
    }

    #[test]
    fn what_another_began_is_gone_on_with_by_operators_alone() {
        let mut memory = memory(10, 10);
        memory.insert(&"adam".into(), "r", print(1), 1);
        let root = Caller { name: "root".into(), roles: [Role::Operator].into() };
        let eve = Caller { name: "eve".into(), roles: [Role::Task, Role::Agent].into() };
        assert_eq!(memory.recall_for(&root, "r", print(1)), Ok(Some(1)));
        assert_eq!(memory.recall_for(&root, "r", print(2)), Ok(None));
        assert_eq!(memory.recall_for(&root, "q", print(1)), Ok(None));
        assert_eq!(memory.recall_for(&eve, "r", print(1)), Ok(None));
    }

    #[test]
    fn what_an_earlier_version_remembers_for_nobody_knows_whom_is_that_of_whoever_asks_the_same() {
        let mut memory = memory(10, 10);
        memory.insert(&Arc::default(), "r", print(1), 1);
        memory.insert(&Arc::default(), "older", Fingerprint::UNKNOWN, 2);
        assert_eq!(memory.recall(&"eve".into(), "r", print(1)), Ok(Some(1)));
        assert_eq!(memory.recall(&"eve".into(), "r", print(2)), Ok(None));
        assert_eq!(memory.recall(&"eve".into(), "older", print(2)), Ok(Some(2)));
    }

    #[test]
    fn whoever_makes_many_requests_forgets_their_own_answers_and_nobody_elses() {
        for (in_all, per_caller) in [(20, 100), (100, 15)] {
            let mut memory = memory(in_all, per_caller);
            let callers: [Arc<str>; 3] = ["adam".into(), "eve".into(), "mallory".into()];
            for n in 0..5 {
                memory.insert(&callers[0], &n.to_string(), print(n), 0);
                memory.insert(&callers[1], &n.to_string(), print(n), 1);
            }
            for n in 0..60 {
                memory.insert(&callers[2], &n.to_string(), print(n), 2);
                assert!(memory.order.len() <= in_all && memory.answers.len() == memory.order.len());
                assert!(memory.of_callers.values().all(|answers| answers.len() <= per_caller));
            }
            for n in 0..5 {
                assert_eq!(memory.recall(&callers[0], &n.to_string(), print(n)), Ok(Some(0)));
                assert_eq!(memory.recall(&callers[1], &n.to_string(), print(n)), Ok(Some(1)));
            }
            assert_eq!(memory.recall(&callers[2], "0", print(0)), Ok(None));
            assert_eq!(memory.recall(&callers[2], "59", print(59)), Ok(Some(2)));
        }
    }
}
