//! Remembered answers, by caller and request id: a request that the same caller repeats under the same id is performed once.
//!
//! Bounded by number and by age, and for each caller by number and bytes. A caller's own oldest answers are forgotten first; if all callers together
//! have too many, those of the caller with the most. So no caller can make the manager forget the answers of a caller with fewer. An answer is
//! durable together with its effect; waiting requests are not.
//!
//! Effects that ended with a session (a lease, a created resource, a deletion or consumption that returned) are the answer of that [`Life`] only: if
//! the session is opened again under the same id, the request is performed again. Effects that outlast a session are made once for all its lives. A
//! request whose effects ended in part is refused then: neither answer would be right.

use crate::error::PoolError;
use crate::fingerprint::Fingerprint;
use crate::id::WaiterId;
use crate::limits::Limits;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::OperatedUnits;
use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Approximate size of an answer besides its texts, in bytes.
const OVERHEAD: usize = 256;

/// A request's id, in the namespace of the caller who opened the session of the request.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct RequestId {
    /// First, so that requests with the same id are adjacent.
    pub(crate) id: Arc<str>,
    /// Empty if unknown: then whoever asks the same counts as that caller.
    pub(crate) caller: Arc<str>,
}

/// An answer in its stored form: small, with ids instead of the things themselves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Remembered {
    Created {
        id: String,
        revision: Revision,
    },
    Granted(LeaseId),
    Touched(Vec<String>),
    Done,
    /// As [`Remembered::Touched`], if some of the effects end with the life and others do not.
    InPart(Vec<String>),
    /// The units that were deleted or consumed. Answers of earlier versions have one of the two variants above instead, without amounts.
    Operated(Vec<OperatedUnits>),
}

/// Which effects of a request end with the session for which it was performed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ends {
    Nothing,
    Part,
    All,
}

/// The number of a session among all sessions, including earlier ones with the same id; 0 is none.
pub(crate) type Life = u64;

/// What a request id leads to.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Recalled {
    Waiting(WaiterId),
    Answered(Remembered),
}

/// For each of these callers, how many of its oldest answers are forgotten.
pub(crate) type Forgotten = Vec<(Arc<str>, usize)>;

/// See the module.
#[derive(Debug, Clone, Default)]
pub(crate) struct RequestMemory {
    callers: BTreeMap<Arc<str>, OfCaller>,
    /// When and to whom each answer was given, oldest first.
    order: BTreeMap<u64, (Timestamp, Arc<str>)>,
    grants: BTreeMap<LeaseId, (Arc<str>, u64)>,
    next: u64,
    waiting: BTreeMap<RequestId, (Fingerprint, WaiterId)>,
}

/// The answers to one caller.
#[derive(Debug, Clone, Default)]
struct OfCaller {
    numbers: BTreeMap<Arc<str>, u64>,
    /// Oldest first.
    answers: BTreeMap<u64, Answer>,
    bytes: usize,
}

#[derive(Debug, Clone)]
struct Answer {
    id: Arc<str>,
    fingerprint: Fingerprint,
    reply: Remembered,
    /// The session life with which its effect ended; 0 for none.
    life: Life,
}

impl RequestId {
    pub(crate) fn new(caller: &Arc<str>, id: &str) -> RequestId {
        RequestId { id: id.into(), caller: caller.clone() }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.id.is_empty()
    }
}

impl Ends {
    /// Combines several effects, given whether each ends with the session.
    pub(crate) fn of(each: &[bool]) -> Ends {
        match (each.contains(&true), each.contains(&false)) {
            (true, true) => Ends::Part,
            (true, false) => Ends::All,
            (false, _) => Ends::Nothing,
        }
    }

    /// The same for deleted or consumed units.
    pub(crate) fn of_units(each: &[OperatedUnits]) -> Ends {
        Ends::of(&each.iter().map(|one| one.ends_with_session).collect::<Vec<_>>())
    }
}

impl Remembered {
    fn bytes(&self) -> usize {
        match self {
            Remembered::Created { id, .. } => id.len(),
            Remembered::Touched(ids) | Remembered::InPart(ids) => {
                ids.iter().map(|id| id.len() + size_of::<String>()).sum()
            }
            Remembered::Operated(all) => {
                all.iter().map(|one| one.resource.len() + one.kind.len() + size_of::<OperatedUnits>()).sum()
            }
            Remembered::Granted(_) | Remembered::Done => 0,
        }
    }

    /// Whether some of the effects end with the life for which they were made and others do not.
    fn ends_in_part(&self) -> bool {
        match self {
            Remembered::InPart(_) => true,
            Remembered::Operated(all) => Ends::of_units(all) == Ends::Part,
            _ => false,
        }
    }
}

impl Answer {
    fn bytes(&self) -> usize {
        OVERHEAD + 2 * self.id.len() + self.reply.bytes()
    }
}

impl OfCaller {
    fn get(&self, id: &str) -> Option<&Answer> {
        self.answers.get(self.numbers.get(id)?)
    }

    fn remove(&mut self, number: u64) -> Option<Answer> {
        let answer = self.answers.remove(&number)?;
        self.numbers.remove(&answer.id);
        self.bytes -= answer.bytes();
        Some(answer)
    }

    fn insert(&mut self, number: u64, answer: Answer) {
        self.bytes += answer.bytes();
        self.numbers.insert(answer.id.clone(), number);
        self.answers.insert(number, answer);
    }
}

impl RequestMemory {
    /// The result of an earlier request with this id, unless its effect ended with a life that is over. An answer to an unknown caller belongs to
    /// whoever asks the same.
    ///
    /// # Errors
    /// Another request had this id, or only a part of its effects ended with a life that is over.
    pub(crate) fn recall(
        &self,
        id: &RequestId,
        fingerprint: Fingerprint,
        is_over: impl Fn(Life) -> bool,
    ) -> Result<Option<Recalled>, PoolError> {
        if let Some((print, waiter)) = self.waiting.get(id) {
            return same(id, *print, fingerprint).map(|()| Some(Recalled::Waiting(*waiter)));
        }
        let counts = |answer: &&Answer| !is_over(answer.life) || answer.reply.ends_in_part();
        let own = self.answer(id).filter(counts);
        own.map_or(Ok(()), |answer| same(id, answer.fingerprint, fingerprint))?;
        let unknown = || self.unknown(id).filter(counts).filter(|answer| answer.fingerprint.may_be(fingerprint));
        match own.or_else(unknown) {
            Some(answer) if is_over(answer.life) => Err(PoolError::DoneInPart { id: id.id.to_string() }),
            answer => Ok(answer.map(|answer| Recalled::Answered(answer.reply.clone()))),
        }
    }

    /// The same, whatever the request was.
    pub(crate) fn reply(&self, id: &RequestId, is_over: impl Fn(Life) -> bool) -> Option<Recalled> {
        let waiting = self.waiting.get(id).map(|(_, waiter)| Recalled::Waiting(*waiter));
        let counts = |answer: &&Answer| !is_over(answer.life);
        let answer = || self.answer(id).filter(counts).or_else(|| self.unknown(id).filter(counts));
        waiting.or_else(|| answer().map(|answer| Recalled::Answered(answer.reply.clone())))
    }

    /// The answer to a request, even if its effect ended with a life that is over.
    pub(crate) fn answered(&self, id: &RequestId) -> Option<&Remembered> {
        self.answer(id).or_else(|| self.unknown(id)).map(|answer| &answer.reply)
    }

    /// The waiter with this id: the caller's own, else that of the first caller who has one.
    pub(crate) fn waiter(&self, id: &RequestId) -> Option<WaiterId> {
        let first = RequestId { caller: Arc::default(), ..id.clone() };
        let of_all = self.waiting.range(first..).take_while(|(other, _)| other.id == id.id);
        let own = self.waiting.get(id).or_else(|| of_all.map(|(_, waiting)| waiting).next());
        own.map(|(_, waiter)| *waiter)
    }

    pub(crate) fn wait(&mut self, id: &RequestId, fingerprint: Fingerprint, waiter: WaiterId) {
        self.waiting.insert(id.clone(), (fingerprint, waiter));
    }

    /// The request with this id does not wait any more.
    pub(crate) fn waited(&mut self, id: &RequestId) -> Option<Fingerprint> {
        self.waiting.remove(id).map(|(fingerprint, _)| fingerprint)
    }

    /// The answers to forget before one more is remembered.
    pub(crate) fn too_many(&self, now: Timestamp, limits: &Limits, id: &RequestId, reply: &Remembered) -> Forgotten {
        let for_at_most = Duration::from_millis(limits.remember_for_ms);
        let mut forget: BTreeMap<&Arc<str>, usize> = BTreeMap::new();
        for (_, caller) in self.order.values().take_while(|(at, _)| *at + for_at_most <= now) {
            *forget.entry(caller).or_default() += 1;
        }
        let none = OfCaller::default();
        let own = self.callers.get(&id.caller).unwrap_or(&none);
        let gone = forget.get(&id.caller).copied().unwrap_or_default();
        let mut bytes = own.bytes + OVERHEAD + 2 * id.id.len() + reply.bytes();
        bytes -= own.answers.values().take(gone).map(Answer::bytes).sum::<usize>();
        let mut left = own.answers.len() - gone;
        let over = own.answers.values().skip(gone).take_while(|answer| {
            let over = left >= limits.remembered_per_caller.max(1) || bytes > limits.remembered_bytes_per_caller;
            (bytes, left) = (bytes.saturating_sub(answer.bytes()), left.saturating_sub(1));
            over
        });
        let over = over.count();
        if over > 0 {
            *forget.entry(&id.caller).or_default() += over;
        }
        let of_all = self.order.len() - forget.values().sum::<usize>();
        for _ in limits.remembered_requests.max(1)..=of_all {
            let left = |(caller, known): &(&Arc<str>, &OfCaller)| {
                known.answers.len() - forget.get(caller).copied().unwrap_or_default()
            };
            let Some((most, _)) = self.callers.iter().max_by_key(left) else { break };
            *forget.entry(most).or_default() += 1;
        }
        forget.into_iter().map(|(caller, count)| (caller.clone(), count)).collect()
    }

    /// Forgets the oldest answers, of whichever caller.
    pub(crate) fn forget_oldest(&mut self, count: usize) {
        for _ in 0..count {
            let Some((number, (_, caller))) = self.order.pop_first() else { return };
            self.remove(&caller, number);
        }
    }

    /// Forgets the oldest answers of these callers.
    pub(crate) fn forget(&mut self, forgotten: &Forgotten) {
        for (caller, count) in forgotten {
            let oldest = self.callers.get(caller).map(|known| known.answers.keys().take(*count).copied().collect());
            let oldest: Vec<u64> = oldest.unwrap_or_default();
            oldest.into_iter().for_each(|number| drop(self.remove(caller, number)));
        }
    }

    pub(crate) fn remember(
        &mut self,
        id: RequestId,
        fingerprint: Fingerprint,
        reply: Remembered,
        life: Life,
        now: Timestamp,
    ) {
        if let Some(before) = self.callers.get(&id.caller).and_then(|known| known.numbers.get(&id.id)).copied() {
            self.remove(&id.caller, before);
        }
        let number = self.next;
        self.next += 1;
        if let Remembered::Granted(lease) = reply {
            self.grants.insert(lease, (id.caller.clone(), number));
        }
        self.order.insert(number, (now, id.caller.clone()));
        self.callers.entry(id.caller).or_default().insert(number, Answer { id: id.id, fingerprint, reply, life });
    }

    /// Forgets the request that led to this lease, as if it had never been made; returns its id.
    pub(crate) fn forget_grant(&mut self, lease: LeaseId) -> Option<RequestId> {
        let (caller, number) = self.grants.get(&lease).cloned()?;
        let id = self.remove(&caller, number)?;
        Some(RequestId { id, caller })
    }

    fn remove(&mut self, caller: &Arc<str>, number: u64) -> Option<Arc<str>> {
        self.order.remove(&number);
        let known = self.callers.get_mut(caller)?;
        let answer = known.remove(number);
        if let Some(Answer { reply: Remembered::Granted(lease), .. }) = &answer {
            self.grants.remove(lease);
        }
        if known.answers.is_empty() {
            self.callers.remove(caller);
        }
        answer.map(|answer| answer.id)
    }

    fn answer(&self, id: &RequestId) -> Option<&Answer> {
        self.callers.get(&id.caller)?.get(&id.id)
    }

    /// The answer under this id to an unknown caller.
    fn unknown(&self, id: &RequestId) -> Option<&Answer> {
        self.callers.get("")?.get(&id.id)
    }

    /// The answers with their callers and session lives, oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&Arc<str>, &Arc<str>, Fingerprint, &Remembered, Life)> {
        self.order.iter().filter_map(|(number, (_, caller))| {
            let answer = self.callers.get(caller)?.answers.get(number)?;
            Some((caller, &answer.id, answer.fingerprint, &answer.reply, answer.life))
        })
    }

    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Checks the bounds, except for a single answer that is larger; and that the indices agree with the answers.
    pub(crate) fn check(&self, limits: &Limits) -> Result<(), &'static str> {
        let ensure = |holds: bool, broken| if holds { Ok(()) } else { Err(broken) };
        ensure(self.order.len() <= limits.remembered_requests.max(1), "the request memory is too long")?;
        let (mut answers, mut grants) = (0, 0);
        for (caller, known) in &self.callers {
            answers += known.answers.len();
            let most = limits.remembered_per_caller.max(1);
            ensure(known.answers.len() <= most, "the request memory of a caller is too long")?;
            let fits = known.bytes <= limits.remembered_bytes_per_caller || known.answers.len() == 1;
            ensure(fits, "the request memory of a caller is too large")?;
            let bytes = known.answers.values().map(Answer::bytes).sum::<usize>();
            ensure(bytes == known.bytes, "the bytes of the request memory are miscounted")?;
            ensure(known.numbers.len() == known.answers.len(), "a request id has two answers")?;
            for (number, answer) in &known.answers {
                let listed = self.order.get(number).is_some_and(|(_, listed)| listed == caller);
                ensure(listed && known.numbers.get(&answer.id) == Some(number), "an answer is not in the order")?;
                if let Remembered::Granted(lease) = answer.reply {
                    grants += 1;
                    let listed = self.grants.get(&lease).is_some_and(|(_, of)| of == number);
                    ensure(listed, "a grant is not known by its lease")?;
                }
            }
        }
        ensure(answers == self.order.len(), "the order of the request memory does not agree")?;
        ensure(grants == self.grants.len(), "a lease is known whose answer was forgotten")
    }
}

/// Checks that both may be of the same request.
fn same(id: &RequestId, known: Fingerprint, asked: Fingerprint) -> Result<(), PoolError> {
    if known.may_be(asked) { Ok(()) } else { Err(PoolError::RequestIdReused { id: id.id.to_string() }) }
}
