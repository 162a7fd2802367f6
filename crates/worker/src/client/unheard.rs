//! Tracks acquires whose answers may have been lost: if the client asks again and then drops the call, it has to tell the manager, or an
//! unknown lease would stay.
//!
//! The resource manager cannot know whether an answer was read. A client can: a request is unheard from the break of a stream until one of
//! its questions is granted, or the request is withdrawn. A refusal does not change this: the manager may refuse a repeated question before
//! it looks up what it granted to an earlier one.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Maximum number of requests kept without a question under way. The lost answers of further ones are forgotten.
const MOST: usize = 1_024;

/// Requests by id. Clones share everything.
#[derive(Debug, Clone, Default)]
pub(super) struct Unheard(Arc<Mutex<BTreeMap<String, Request>>>);

#[derive(Debug, Default)]
struct Request {
    /// Questions under way.
    under_way: usize,
    /// An answer was lost, and no question has been granted since.
    lost: bool,
}

/// How a question ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ended {
    Granted,
    Refused,
    /// Its answer did not arrive.
    Lost,
}

/// A question under way.
#[derive(Debug)]
pub(super) struct Question {
    unheard: Unheard,
    request: String,
}

impl Unheard {
    /// Records that a question of a request begins.
    pub(super) fn ask(&self, request: &str) -> Question {
        self.open().entry(request.to_owned()).or_default().under_way += 1;
        Question { unheard: self.clone(), request: request.to_owned() }
    }

    /// Records that the request is withdrawn, with everything granted to it.
    pub(super) fn withdrawn(&self, request: &str) {
        let mut requests = self.open();
        let Some(known) = requests.get_mut(request) else { return };
        known.lost = false;
        if known.under_way == 0 {
            requests.remove(request);
        }
    }

    fn open(&self) -> MutexGuard<'_, BTreeMap<String, Request>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Question {
    /// Records that the question was answered, or its answer lost.
    pub(super) fn ended(&self, ended: Ended) {
        if ended == Ended::Refused {
            return;
        }
        let lost = ended == Ended::Lost;
        let mut requests = self.unheard.open();
        if lost && requests.len() > MOST {
            let idle = requests.iter().find(|(_, request)| request.under_way == 0).map(|(id, _)| id.clone());
            idle.map(|id| requests.remove(&id));
        }
        if let Some(request) = requests.get_mut(&self.request) {
            request.lost = lost;
        }
    }

    /// Records that the question was dropped. Returns whether this was the last question of a request whose answer was lost.
    pub(super) fn dropped(&self) -> bool {
        let mut requests = self.unheard.open();
        let Some(request) = requests.get_mut(&self.request).filter(|request| request.under_way == 1) else {
            return false;
        };
        std::mem::take(&mut request.lost)
    }
}

impl Drop for Question {
    fn drop(&mut self) {
        let mut requests = self.unheard.open();
        let Some(request) = requests.get_mut(&self.request) else { return };
        request.under_way -= 1;
        if request.under_way == 0 && !request.lost {
            requests.remove(&self.request);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_unheard_from_a_lost_answer_on_until_one_is_heard() {
        let unheard = Unheard::default();
        let first = unheard.ask("r");
        assert!(!first.dropped(), "nothing was lost");
        first.ended(Ended::Lost);
        drop(first);
        let (second, other) = (unheard.ask("r"), unheard.ask("other"));
        assert!(!other.dropped());
        let beside = unheard.ask("r");
        assert!(!second.dropped(), "another question of it is under way");
        beside.ended(Ended::Granted);
        drop(beside);
        assert!(!second.dropped(), "the answer was heard");
        second.ended(Ended::Lost);
        let refused = unheard.ask("r");
        refused.ended(Ended::Refused);
        drop(refused);
        assert!(second.dropped() && !second.dropped(), "a refusal is no grant; and it is said once");
        second.ended(Ended::Lost);
        unheard.withdrawn("r");
        assert!(!second.dropped(), "there is nothing left of it");
        drop((second, other));
        assert!(unheard.open().is_empty());
        for number in 0..2 * MOST {
            unheard.ask(&number.to_string()).ended(Ended::Lost);
        }
        assert!(unheard.open().len() <= MOST + 1);
    }
}
