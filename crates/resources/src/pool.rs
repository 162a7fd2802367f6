//! The pool: its state, requests with ids, and what others can see of it.

use crate::accounts::Accounts;
use crate::caller::Callers;
use crate::crowd::Crowds;
use crate::error::PoolError;
use crate::event::{Notice, WatchEvent};
use crate::expiry::{Timer, Work};
use crate::fingerprint::Fingerprint;
use crate::history::{Compacted, History};
use crate::id::{SessionId, Slot, WaiterId};
use crate::kept_ids::KeptIds;
use crate::kinds::Kinds;
use crate::lease::{EndingLeases, LeaseView, Leases};
use crate::limits::Limits;
use crate::memory::{Ends, Life, Recalled, Remembered, RequestId, RequestMemory};
use crate::pace::Pace;
use crate::queue::{AcquireRequest, Queue};
use crate::record::{Effect, Record};
use crate::replaced::Left;
use crate::request::{Reply, Request};
use crate::resource::{Resource, ResourceView};
use crate::resources::Resources;
use crate::session::{Sessions, Speaker};
use crate::withdrawals::Withdrawals;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Every resource, session, lease and waiter. See the crate's documentation.
#[derive(Debug, Clone, Default)]
pub struct Pool {
    pub(crate) limits: Limits,
    pub(crate) now: Timestamp,
    // What is durable; changed in `apply.rs` only.
    pub(crate) resources: Resources,
    pub(crate) sessions: Sessions,
    /// The callers for whom the ids of ended sessions are kept.
    pub(crate) kept_ids: KeptIds,
    pub(crate) leases: Leases,
    /// The units that ended leases have left.
    pub(crate) ending: EndingLeases,
    /// Holders of resources with many holders; derived from the fields above.
    pub(crate) crowds: Crowds,
    /// Leases with consumption that can be taken back, by consumed resource.
    pub(crate) undoable: BTreeMap<Slot, BTreeSet<LeaseId>>,
    pub(crate) memory: RequestMemory,
    pub(crate) revision: Revision,
    pub(crate) last_lease: u64,
    pub(crate) last_token: u64,
    pub(crate) last_number: u64,
    /// The number of the session that was opened last.
    pub(crate) last_session: u64,
    pub(crate) history: History,
    // What is not.
    pub(crate) queue: Queue,
    /// The past use by each session, for fair shares.
    pub(crate) accounts: Accounts,
    /// Requests that have left the queue and whose place another request may take.
    pub(crate) left: Left,
    /// Request ids whose acquires may arrive after they were withdrawn.
    pub(crate) withdrawals: Withdrawals,
    /// Why providers cannot provide more of a kind, by session and kind.
    pub(crate) shortages: BTreeMap<SessionId, BTreeMap<String, String>>,
    pub(crate) timers: BTreeSet<(Timestamp, Timer)>,
    pub(crate) next_waiter: u64,
    /// Amounts by caller.
    pub(crate) callers: Callers,
    /// How fast tokens may grow; unbounded if no start value was given.
    pub(crate) pace: Option<Pace>,
    /// Timers that are due but not completely handled.
    pub(crate) overdue: BTreeSet<Timer>,
    /// Limits for the work of a turn.
    pub(crate) work: Work,
    /// Work done in this turn, counted in examined resources.
    pub(crate) worked: usize,
    /// At this amount of work the rest is left to the next turn.
    pub(crate) enough: usize,
    pub(crate) notices: Vec<Notice>,
    pub(crate) records: Vec<Record>,
}

impl Pool {
    /// An empty pool.
    pub fn new(limits: Limits) -> Pool {
        let mut pool = Pool::default();
        pool.set_limits(limits);
        pool
    }

    /// The same pool with a hierarchy of kinds: a request for a kind may get a resource of a subclass. No request may wait yet.
    #[must_use]
    pub fn with_kinds(mut self, kinds: Kinds) -> Pool {
        debug_assert!(self.queue.len() == 0, "waiters are in families of the kinds of before");
        self.resources.set_kinds(kinds);
        self.open_accounts();
        self
    }

    /// The same pool; ids and tokens of later grants, and numbers of later sessions, are above `floor`. A restarted manager passes the microseconds
    /// of a clock, so that its leases are not refused as old ones even if some of its state was lost: tokens do not grow faster than the clock
    /// (`pace.rs`).
    #[must_use]
    pub fn above(mut self, floor: u64) -> Pool {
        for last in [&mut self.last_lease, &mut self.last_token, &mut self.last_session, &mut self.next_waiter] {
            *last = floor.max(*last);
        }
        self.pace = Some(Pace::from(self.last_token.max(self.last_lease)));
        self
    }

    /// The same pool, restored from a log whose end may be lost: later revisions are above `floor`, so that no revision means two things, and earlier
    /// watchers are told to begin anew.
    #[must_use]
    pub fn with_revisions_above(mut self, floor: Revision) -> Pool {
        if floor > self.revision {
            self.commit(Effect::RevisionsLeapt { revision: floor });
        }
        self
    }

    /// Sets other limits; what exceeds them stays. Requests that can be served under wider limits are served by the next [`Pool::advance`].
    pub fn set_limits(&mut self, limits: Limits) {
        self.resources.set_max_holders(limits.holders);
        if limits.holders > self.limits.holders {
            let families: Vec<Arc<str>> = self.queue.families.keys().cloned().collect();
            families.iter().for_each(|family| self.queue.mark(family, false));
        }
        self.limits = limits;
    }

    /// The numbers of resources, sessions, leases and waiters.
    pub fn amounts(&self) -> [usize; 4] {
        [self.resources.len(), self.sessions.len(), self.leases.len(), self.queue.len()]
    }

    /// As [`Pool::handle_as`], by [`Speaker::trusted`].
    ///
    /// # Errors
    /// As there.
    pub fn handle(&mut self, now: Timestamp, request_id: &str, request: Request) -> Result<Reply, PoolError> {
        self.handle_as(now, &Speaker::trusted(), request_id, request)
    }

    /// Performs a mutation for a speaker who may use its session ([`Pool::check_speaker`]). If an equal request with the same request id was answered
    /// before, it is not performed again: its answer is repeated. Request ids belong to the caller who opened the session, or to the speaker if the
    /// session does not exist. Effects that ended with a session are made anew if the session was opened again under its id.
    ///
    /// # Errors
    /// As for the method of the same name; then nothing has changed, and the id is not used up.
    pub fn handle_as(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        request_id: &str,
        request: Request,
    ) -> Result<Reply, PoolError> {
        self.begin(now);
        if request_id.is_empty() {
            let done = self.perform(now, speaker, RequestId::default(), Fingerprint::UNKNOWN, request);
            return done.map(|(reply, _)| reply);
        }
        self.check_name("request id", request_id)?;
        let id = RequestId::new(self.caller_of(request.session(), speaker), request_id);
        let fingerprint = Fingerprint::of(&request);
        let life = self.life(request.session());
        match self.memory.recall(&id, fingerprint, self.is_over(life))? {
            Some(Recalled::Waiting(waiter)) => Ok(Reply::Queued(waiter)),
            Some(Recalled::Answered(Remembered::Granted(lease))) => {
                // The lease is of another session: an earlier version remembers only the id of a request.
                if self.leases.get(&lease).is_some_and(|known| Some(&known.session) != request.session()) {
                    return Err(PoolError::RequestIdReused { id: request_id.to_owned() });
                }
                self.lease(lease).map(Reply::Granted).ok_or(PoolError::UnknownLease { lease })
            }
            Some(Recalled::Answered(answered)) => Ok(replied(answered)),
            None if let Request::Acquire(acquire) = &request
                && self.withdrawals.is_withdrawn(&id, &acquire.session) =>
            {
                Err(PoolError::Withdrawn { id: request_id.to_owned() })
            }
            None => {
                let is_acquire = matches!(request, Request::Acquire(_));
                let reply = self.perform(now, speaker, id.clone(), fingerprint, request);
                if reply.is_err() && is_acquire {
                    self.withdrawals.heard_of(self.now, &self.limits, id.clone());
                }
                let (reply, ends) = reply?;
                let remembered = match &reply {
                    // Remembered by the grant, which may come much later or was just made.
                    Reply::Queued(_) | Reply::Granted(_) => return Ok(reply),
                    // Remembered by its last part.
                    Reply::Unfinished => return Ok(reply),
                    Reply::Created { id, revision } => Remembered::Created { id: id.clone(), revision: *revision },
                    Reply::Operated(units) => Remembered::Operated(units.clone()),
                    Reply::Touched(ids) => Remembered::Touched(ids.clone()),
                    Reply::Done => Remembered::Done,
                };
                self.remember(id, fingerprint, remembered, if ends == Ends::Nothing { 0 } else { life });
                Ok(reply)
            }
        }
    }

    /// The answer to an earlier request for a session, even if its effect ended with an earlier session of the same id. `None` if the request was
    /// never performed, or its answer is forgotten: a caller's oldest answers are forgotten first, so if an older one is known, it was never
    /// performed. For a granted acquire the answer is [`Reply::Done`].
    ///
    /// # Errors
    /// Another caller opened the session.
    pub fn recall(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        session: &SessionId,
        request_id: &str,
    ) -> Result<Option<Reply>, PoolError> {
        self.check_speaker(now, speaker, session)?;
        let id = RequestId::new(self.caller_of(Some(session), speaker), request_id);
        Ok(self.memory.answered(&id).cloned().map(replied))
    }

    /// The caller to answer: the opener of the session if that exists, else the speaker.
    fn caller_of<'a>(&'a self, session: Option<&SessionId>, speaker: &'a Speaker) -> &'a Arc<str> {
        let session = session.and_then(|session| self.sessions.get(session));
        session.map_or(&speaker.name, |session| &session.opened_by)
    }

    /// The amount of fitting resources that exists and is not consumed, held or not (the paper's `exists`).
    pub fn exists(&self, requirement: &Requirement) -> Quantity {
        self.resources.quantity(requirement)
    }

    /// The ids of the resources that fit a requirement, sorted.
    pub fn fitting(&self, requirement: &Requirement) -> Vec<String> {
        let mut ids: Vec<String> =
            self.resources.fitting(requirement).map(|(_, resource)| resource.description.id.clone()).collect();
        ids.sort_unstable();
        ids
    }

    /// One resource.
    pub fn get(&self, id: &str) -> Option<ResourceView> {
        let slot = self.resources.find(id)?;
        self.resources.get(slot).map(|resource| self.view_of((slot, resource)))
    }

    /// Every resource, sorted by id.
    pub fn list(&self) -> Vec<ResourceView> {
        self.resources.iter().map(|one| self.view_of(one)).collect()
    }

    /// At most `most` resources after an id, sorted by id; from the first one if the id is empty.
    pub fn list_after(&self, id: &str, most: usize) -> Vec<ResourceView> {
        self.resources.after(id).take(most).map(|one| self.view_of(one)).collect()
    }

    pub(crate) fn view_of(&self, (slot, resource): (Slot, &Resource)) -> ResourceView {
        resource.view(self.holders(slot, resource))
    }

    /// Every live lease, sorted by id.
    pub fn leases(&self) -> Vec<LeaseView> {
        let view = |(id, record): (&LeaseId, &crate::lease::LeaseRecord)| LeaseView {
            id: *id,
            token: record.token,
            session: record.session.clone(),
            resources: record.slots().into_iter().filter_map(|slot| self.id_of(slot)).collect(),
            expires: record.expires,
            purpose: record.purpose.clone(),
        };
        self.leases.iter().map(view).collect()
    }

    /// The lease that was granted last, live or ended; ids grow.
    pub fn youngest_lease(&self) -> LeaseId {
        LeaseId(self.last_lease)
    }

    /// The queue, in the order of service.
    pub fn waiters(&self) -> Vec<(WaiterId, AcquireRequest)> {
        self.queue.iter().map(|(id, waiter)| (id, waiter.request.clone())).collect()
    }

    /// The waiter of a request id, if there is one: the caller's own, else that of another caller.
    pub fn waiter_of(&self, caller: &Arc<str>, request_id: &str) -> Option<WaiterId> {
        self.memory.waiter(&RequestId::new(caller, request_id))
    }

    /// The request id of a waiter (empty if it has none) and its request.
    pub fn waiter(&self, id: WaiterId) -> Option<(&str, &AcquireRequest)> {
        self.queue.get(id).map(|waiter| (&*waiter.request_id.id, &waiter.request))
    }

    /// The first waiters of the queue, in the order of service.
    pub fn first_waiters(&self, count: usize) -> Vec<WaiterId> {
        self.queue.iter().take(count).map(|(id, _)| id).collect()
    }

    /// Number of waiters.
    pub fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Number of events so far; the next one has this revision plus one.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// The events after a revision, in order and without a gap.
    ///
    /// # Errors
    /// If these events are not kept any more (or the revision is yet to come).
    pub fn changes_after(&self, revision: Revision) -> Result<Vec<Arc<WatchEvent>>, Compacted> {
        self.history.after(revision, self.revision)
    }

    /// The notices since the last call, in order.
    pub fn take_notices(&mut self) -> Vec<Notice> {
        std::mem::take(&mut self.notices)
    }

    /// The durable changes since the last call, in order. They have to be on disk before any answer or notice since then is sent; together they are
    /// one entry ([`crate::encode`]), so that none is stored without the rest.
    pub fn take_records(&mut self) -> Vec<Record> {
        std::mem::take(&mut self.records)
    }

    pub(crate) fn id_of(&self, slot: Slot) -> Option<String> {
        self.resources.get(slot).map(|resource| resource.description.id.clone())
    }

    /// The number of the present session with this id; 0 if there is none.
    pub(crate) fn life(&self, session: Option<&SessionId>) -> Life {
        session.and_then(|session| self.session_number(session)).unwrap_or(0)
    }

    /// Whether a session life is over, for a caller in a session of life `asks`; for a caller without a session no life is over.
    pub(crate) fn is_over(&self, asks: Life) -> impl Fn(Life) -> bool {
        let lives = |life| self.sessions.values().any(|session| session.number == life && session.ending.is_none());
        move |life| ![0, asks].contains(&life) && asks != 0 && !lives(life)
    }

    /// Keeps the answer to a request id, together with its effect, which ends with the session life unless that is 0.
    pub(crate) fn remember(&mut self, id: RequestId, fingerprint: Fingerprint, reply: Remembered, life: Life) {
        if !id.is_empty() {
            let forget = self.memory.too_many(self.now, &self.limits, &id, &reply);
            let RequestId { id: request_id, caller } = id;
            self.commit(match life {
                0 => Effect::AnsweredTo { caller, request_id, fingerprint, reply, forget },
                _ => Effect::AnsweredForLife { caller, request_id, fingerprint, reply, forget, life },
            });
        }
    }

    /// Performs a request; returns the reply, and which of its effects end with its session.
    fn perform(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        id: RequestId,
        print: Fingerprint,
        request: Request,
    ) -> Result<(Reply, Ends), PoolError> {
        Ok(match request {
            Request::Create { session, spec } => {
                let ResourceView { description, revision, .. } = self.create(now, session.as_ref(), spec)?;
                (Reply::Created { id: description.id.clone(), revision }, Ends::of(&[session.is_some()]))
            }
            Request::Delete { session, id } => {
                let is_own = session.is_some() && self.get(&id).is_some_and(|known| known.owner == session);
                self.delete(now, session.as_ref(), &id)?;
                (Reply::Done, Ends::of(&[is_own]))
            }
            Request::DeleteUnits { session, requirement } => {
                let deleted = self.take_units(now, &session, &requirement)?;
                let ends = Ends::of_units(&deleted);
                (Reply::Operated(deleted), ends)
            }
            Request::Consume { session, requirement, resource } => {
                let consumed = self.consume_units(now, &session, &requirement, resource.as_deref())?;
                let ends = Ends::of_units(&consumed);
                (Reply::Operated(consumed), ends)
            }
            Request::Acquire(request) => (Reply::Queued(self.enqueue(request, id, print)?), Ends::Nothing),
            Request::Release { session, lease, at_rest } => {
                let give_back = if at_rest { Pool::release } else { Pool::release_moving };
                give_back(self, now, session.as_ref(), lease)?;
                (Reply::Done, Ends::Nothing)
            }
            Request::ConfirmStandstill { session, lease, resource } => {
                let freed = self.confirm_standstill_as(now, speaker, session.as_ref(), lease, &resource)?;
                (Reply::Touched(freed.then_some(resource).into_iter().collect()), Ends::Nothing)
            }
            Request::EndTask { session } => {
                let reply = if self.end_task(now, &session)? { Reply::Done } else { Reply::Unfinished };
                (reply, Ends::All)
            }
        })
    }
}

/// The answer in its reply form. A repeated request for a grant gets its lease elsewhere.
fn replied(answered: Remembered) -> Reply {
    match answered {
        Remembered::Created { id, revision } => Reply::Created { id, revision },
        Remembered::Operated(units) => Reply::Operated(units),
        Remembered::Touched(ids) | Remembered::InPart(ids) => Reply::Touched(ids),
        Remembered::Granted(_) | Remembered::Done => Reply::Done,
    }
}
