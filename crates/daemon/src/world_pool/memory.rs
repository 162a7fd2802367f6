//! The answers given, by request id: the same id twice is performed once. Bounded; the oldest is forgotten first.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::{self, Debug, Write};
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
    fingerprint: u128,
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
    pub(super) fn recall(&self, id: &str, fingerprint: u128) -> Result<Option<T>, Reused> {
        match self.answers.get(id) {
            Some(answer) if answer.fingerprint == fingerprint => Ok(Some(answer.value)),
            Some(_) => Err(Reused { id: id.to_owned() }),
            None => Ok(None),
        }
    }

    pub(super) fn insert(&mut self, id: &str, fingerprint: u128, value: T) {
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
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Arc<str>, u128, T)> {
        let known = |id| self.answers.get(id).map(|answer| (id, answer.fingerprint, answer.value));
        self.order.iter().filter_map(known)
    }
}

/// What makes two requests the same one: FNV-1a over 128 bits of what they print; clients are not adversaries of themselves.
pub(super) fn fingerprint(request: &impl Debug) -> u128 {
    struct Fnv(u128);
    impl Write for Fnv {
        fn write_str(&mut self, text: &str) -> fmt::Result {
            const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
            self.0 = text.bytes().fold(self.0, |hash, byte| (hash ^ u128::from(byte)).wrapping_mul(PRIME));
            Ok(())
        }
    }
    let mut hash = Fnv(0x6c62_272e_07bb_0142_62b8_2175_6295_c58d);
    // Nothing that is printed into a hash can fail.
    let _ = write!(hash, "{request:?}");
    hash.0
}
