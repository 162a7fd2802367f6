//! The answers given, by request id: the same id twice is performed once. Bounded by number and by age; the oldest is
//! forgotten first. An answer is durable together with its effect; who is still in the queue is not.

use crate::error::PoolError;
use crate::fingerprint::Fingerprint;
use crate::id::WaiterId;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// An answer as it is kept: small, with ids instead of what they name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Remembered {
    Created { id: String, revision: Revision },
    Granted(LeaseId),
    Touched(Vec<String>),
    Done,
}

/// What a request id leads to.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Recalled {
    Waiting(WaiterId),
    Answered(Remembered),
}

#[derive(Debug, Clone)]
struct Answer {
    number: u64,
    fingerprint: Fingerprint,
    reply: Remembered,
}

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct RequestMemory {
    answers: BTreeMap<String, Answer>,
    /// When each was given, the oldest first.
    order: BTreeMap<u64, (Timestamp, String)>,
    next: u64,
    waiting: BTreeMap<String, (Fingerprint, WaiterId)>,
}

impl RequestMemory {
    /// What this request led to before.
    pub(crate) fn recall(&self, id: &str, fingerprint: Fingerprint) -> Result<Option<Recalled>, PoolError> {
        let known = self.waiting.get(id).map(|(print, waiter)| (*print, Recalled::Waiting(*waiter)));
        let known = known.or_else(|| {
            self.answers.get(id).map(|answer| (answer.fingerprint, Recalled::Answered(answer.reply.clone())))
        });
        match known {
            Some((print, _)) if !print.may_be(fingerprint) => Err(PoolError::RequestIdReused { id: id.to_owned() }),
            known => Ok(known.map(|(_, recalled)| recalled)),
        }
    }

    /// The same, whatever the request was.
    pub(crate) fn reply(&self, id: &str) -> Option<Recalled> {
        let waiting = self.waiting.get(id).map(|(_, waiter)| Recalled::Waiting(*waiter));
        waiting.or_else(|| self.answers.get(id).map(|answer| Recalled::Answered(answer.reply.clone())))
    }

    pub(crate) fn wait(&mut self, id: &str, fingerprint: Fingerprint, waiter: WaiterId) {
        self.waiting.insert(id.to_owned(), (fingerprint, waiter));
    }

    /// Who waited under this id waits no longer.
    pub(crate) fn waited(&mut self, id: &str) -> Option<Fingerprint> {
        self.waiting.remove(id).map(|(fingerprint, _)| fingerprint)
    }

    /// How many of the oldest have to go before one more is remembered.
    pub(crate) fn too_many(&self, now: Timestamp, limit: usize, for_at_most: Duration) -> usize {
        let by_number = (self.order.len() + 1).saturating_sub(limit.max(1));
        let old = |at: Timestamp| at + for_at_most <= now;
        self.order.values().enumerate().take_while(|(i, (at, _))| *i < by_number || old(*at)).count()
    }

    pub(crate) fn remember(
        &mut self,
        id: String,
        fingerprint: Fingerprint,
        reply: Remembered,
        forget: usize,
        now: Timestamp,
    ) {
        for _ in 0..forget {
            if let Some((_, (_, oldest))) = self.order.pop_first() {
                self.answers.remove(&oldest);
            }
        }
        let number = self.next;
        self.next += 1;
        self.order.insert(number, (now, id.clone()));
        let answer = Answer { number, fingerprint, reply };
        if let Some(before) = self.answers.insert(id, answer) {
            self.order.remove(&before.number);
        }
    }

    /// The request that led to this lease is as if it had never been asked. It is among the youngest.
    pub(crate) fn forget_grant(&mut self, lease: LeaseId) {
        let led_here = |id: &String| self.answers.get(id).is_some_and(|a| a.reply == Remembered::Granted(lease));
        let found = self.order.iter().rev().find(|(_, (_, id))| led_here(id)).map(|(number, _)| *number);
        if let Some((_, id)) = found.and_then(|number| self.order.remove(&number)) {
            self.answers.remove(&id);
        }
    }

    /// The answers, the oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&String, Fingerprint, &Remembered)> {
        self.order
            .values()
            .filter_map(|(_, id)| self.answers.get(id).map(|answer| (id, answer.fingerprint, &answer.reply)))
    }

    pub(crate) fn len(&self) -> usize {
        self.order.len()
    }

    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    pub(crate) fn order_agrees(&self) -> bool {
        self.order.len() == self.answers.len()
            && self.order.iter().all(|(number, (_, id))| self.answers.get(id).is_some_and(|a| a.number == *number))
    }
}
