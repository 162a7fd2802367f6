//! The answers given, by request id: the same id twice is performed once. Bounded; the oldest is forgotten first.

use super::fingerprint::Fingerprint;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Memory<T> {
    answers: BTreeMap<Arc<str>, Answer<T>>,
    /// The oldest first.
    order: VecDeque<Arc<str>>,
    limit: usize,
}

#[derive(Debug, Clone)]
struct Answer<T> {
    fingerprint: Fingerprint,
    value: T,
}

/// An id that was used for something else before.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("request id `{id}` was used for another request before; ids are unique to what is asked")]
pub(super) struct Reused {
    pub(super) id: String,
}

impl<T: Copy> Memory<T> {
    pub(super) fn new(limit: usize) -> Memory<T> {
        Memory { answers: BTreeMap::new(), order: VecDeque::new(), limit }
    }

    /// What this request led to before; an empty id is never known.
    pub(super) fn recall(&self, id: &str, fingerprint: Fingerprint) -> Result<Option<T>, Reused> {
        match self.answers.get(id) {
            Some(answer) if answer.fingerprint.may_be(fingerprint) => Ok(Some(answer.value)),
            Some(_) => Err(Reused { id: id.to_owned() }),
            None => Ok(None),
        }
    }

    pub(super) fn insert(&mut self, id: &str, fingerprint: Fingerprint, value: T) {
        let id: Arc<str> = Arc::from(id);
        if id.is_empty() || self.answers.insert(Arc::clone(&id), Answer { fingerprint, value }).is_some() {
            return;
        }
        self.order.push_back(id);
        while self.order.len() > self.limit {
            if let Some(oldest) = self.order.pop_front() {
                self.answers.remove(&oldest);
            }
        }
    }

    /// The answers, the oldest first.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Arc<str>, Fingerprint, T)> {
        let known = |id| self.answers.get(id).map(|answer| (id, answer.fingerprint, answer.value));
        self.order.iter().filter_map(known)
    }
}
