//! The pool: its state, requests with their ids, and what can be seen of it.

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
    /// For whom the ids of sessions that have ended are kept.
    pub(crate) kept_ids: KeptIds,
    pub(crate) leases: Leases,
    /// What leases that have ended have left.
    pub(crate) ending: EndingLeases,
    /// Who has units of a resource with many holders; of the three above.
    pub(crate) crowds: Crowds,
    /// Leases with consumption that can be taken back, by the resource that was consumed of.
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
    /// What each session has had beside others.
    pub(crate) accounts: Accounts,
    /// Requests whose place others may take.
    pub(crate) left: Left,
    /// Request ids whose acquires may arrive after they were withdrawn.
    pub(crate) withdrawals: Withdrawals,
    /// What providers cannot provide, by kind, and why.
    pub(crate) shortages: BTreeMap<SessionId, BTreeMap<String, String>>,
    pub(crate) timers: BTreeSet<(Timestamp, Timer)>,
    pub(crate) next_waiter: u64,
    /// What each caller has.
    pub(crate) callers: Callers,
    /// How fast tokens may grow; as fast as they like where nobody said from where.
    pub(crate) pace: Option<Pace>,
    /// What is due and has not ended yet.
    pub(crate) overdue: BTreeSet<Timer>,
    /// How much may be done in a turn.
    pub(crate) work: Work,
    /// How much was done in this turn, counted in resources that were looked at.
    pub(crate) worked: usize,
    /// With so much the rest is left to the next turn.
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

    /// The same pool, in which who asks for a kind may get one of a kind below it. Nobody may wait yet.
    #[must_use]
    pub fn with_kinds(mut self, kinds: Kinds) -> Pool {
        debug_assert!(self.queue.len() == 0, "waiters are in families of the kinds of before");
        self.resources.set_kinds(kinds);
        self.open_accounts();
        self
    }

    /// The same pool; what it grants from now on has ids and tokens above `floor` too, and the sessions that it opens have such numbers. A restarted manager passes the microseconds
    /// of a clock, so that its leases are not refused as old ones, whatever was lost of what it kept: tokens do not grow faster
    /// than those (`pace.rs`).
    #[must_use]
    pub fn above(mut self, floor: u64) -> Pool {
        for last in [&mut self.last_lease, &mut self.last_token, &mut self.last_session, &mut self.next_waiter] {
            *last = floor.max(*last);
        }
        self.pace = Some(Pace::from(self.last_token.max(self.last_lease)));
        self
    }

    /// The same pool, restored from a log whose end may be lost: revisions are above `floor` from now on, so that none means two
    /// things, and who watched before is told to begin anew.
    #[must_use]
    pub fn with_revisions_above(mut self, floor: Revision) -> Pool {
        if floor > self.revision {
            self.commit(Effect::RevisionsLeapt { revision: floor });
        }
        self
    }

    /// From now on other bounds hold; what is there beyond them stays. Who may be served with wider ones is, by the next
    /// [`Pool::advance`].
    pub fn set_limits(&mut self, limits: Limits) {
        self.resources.set_max_holders(limits.holders);
        if limits.holders > self.limits.holders {
            let families: Vec<Arc<str>> = self.queue.families.keys().cloned().collect();
            families.iter().for_each(|family| self.queue.mark(family, false));
        }
        self.limits = limits;
    }

    /// How many resources, sessions, leases and waiters there are.
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

    /// Performs a mutation that a speaker asks for who may speak for its session ([`Pool::check_speaker`]). With a request id, an equal
    /// request of that id answered before is not performed again: its answer is given once more. Request ids are of who opened the
    /// session, or of the speaker where it is not there. What ended with a session is performed anew for one that was opened anew under its id.
    ///
    /// # Errors
    /// As the method of the same name; nothing has changed then, and the id is not used up.
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
                // Of another session: only the id is known of what an earlier version remembers.
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
                    // Remembered by the grant, which may be long after this or was within it.
                    Reply::Queued(_) | Reply::Granted(_) => return Ok(reply),
                    // By its last part.
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

    /// What a request for a session was answered, also where that ended with an earlier session of the same id; nothing where it was never performed,
    /// or that is forgotten: of one caller the oldest answers are forgotten first, so where an older one is known it was not. Of an acquire that was
    /// granted it is [`Reply::Done`].
    ///
    /// # Errors
    /// A session that another opened.
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

    /// Who is answered: the opener of the session, where that is there.
    fn caller_of<'a>(&'a self, session: Option<&SessionId>, speaker: &'a Speaker) -> &'a Arc<str> {
        let session = session.and_then(|session| self.sessions.get(session));
        session.map_or(&speaker.name, |session| &session.opened_by)
    }

    /// How much of what fits exists and is not consumed, held or not (the paper's `exists`).
    pub fn exists(&self, requirement: &Requirement) -> Quantity {
        self.resources.quantity(requirement)
    }

    /// The ids of what fits a requirement, in order.
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

    /// Every resource, in the order of ids.
    pub fn list(&self) -> Vec<ResourceView> {
        self.resources.iter().map(|one| self.view_of(one)).collect()
    }

    /// At most so many resources behind an id, in the order of ids; from the first one behind the empty id.
    pub fn list_after(&self, id: &str, most: usize) -> Vec<ResourceView> {
        self.resources.after(id).take(most).map(|one| self.view_of(one)).collect()
    }

    pub(crate) fn view_of(&self, (slot, resource): (Slot, &Resource)) -> ResourceView {
        resource.view(self.holders(slot, resource))
    }

    /// Every live lease, in the order of ids.
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

    /// The lease that was granted last, living or not; ids grow.
    pub fn youngest_lease(&self) -> LeaseId {
        LeaseId(self.last_lease)
    }

    /// The queue, in the order in which it is served.
    pub fn waiters(&self) -> Vec<(WaiterId, AcquireRequest)> {
        self.queue.iter().map(|(id, waiter)| (id, waiter.request.clone())).collect()
    }

    /// The waiter of a request id, if it waits: the caller's own, else one of another caller.
    pub fn waiter_of(&self, caller: &Arc<str>, request_id: &str) -> Option<WaiterId> {
        self.memory.waiter(&RequestId::new(caller, request_id))
    }

    /// The request id of a waiter, empty where it has none, and what it asked for.
    pub fn waiter(&self, id: WaiterId) -> Option<(&str, &AcquireRequest)> {
        self.queue.get(id).map(|waiter| (&*waiter.request_id.id, &waiter.request))
    }

    /// The first of the queue, in the order in which it is served.
    pub fn first_waiters(&self, count: usize) -> Vec<WaiterId> {
        self.queue.iter().take(count).map(|(id, _)| id).collect()
    }

    /// How many wait.
    pub fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// How many events there were so far; the next one has this revision plus one.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// What happened after a revision, in order and without a gap.
    ///
    /// # Errors
    /// Where that is not known any more (or not yet).
    pub fn changes_after(&self, revision: Revision) -> Result<Vec<Arc<WatchEvent>>, Compacted> {
        self.history.after(revision, self.revision)
    }

    /// What happened since the last call, in order.
    pub fn take_notices(&mut self) -> Vec<Notice> {
        std::mem::take(&mut self.notices)
    }

    /// The durable changes since the last call, in order. They have to be on the disk before anything that was answered or
    /// noticed since then goes out; together they are one entry ([`crate::encode`]), so that none is there without the rest.
    pub fn take_records(&mut self) -> Vec<Record> {
        std::mem::take(&mut self.records)
    }

    pub(crate) fn id_of(&self, slot: Slot) -> Option<String> {
        self.resources.get(slot).map(|resource| resource.description.id.clone())
    }

    /// Which life of a session it is now; 0 where it is not there.
    pub(crate) fn life(&self, session: Option<&SessionId>) -> Life {
        session.and_then(|session| self.session_number(session)).unwrap_or(0)
    }

    /// Whether a life is over, for who asks in a session of this life; for who asks in none that is there none is.
    pub(crate) fn is_over(&self, asks: Life) -> impl Fn(Life) -> bool {
        let lives = |life| self.sessions.values().any(|session| session.number == life && session.ending.is_none());
        move |life| ![0, asks].contains(&life) && asks != 0 && !lives(life)
    }

    /// Keeps the answer to a request id, together with its effect, which ends with a life unless that is 0.
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

    /// The reply, and what of what was done ends with the session that it was done for.
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
            Request::Release { session, lease } => {
                self.release(now, session.as_ref(), lease)?;
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

/// As it is told. Whoever asks for a grant once more is told of its lease elsewhere.
fn replied(answered: Remembered) -> Reply {
    match answered {
        Remembered::Created { id, revision } => Reply::Created { id, revision },
        Remembered::Operated(units) => Reply::Operated(units),
        Remembered::Touched(ids) | Remembered::InPart(ids) => Reply::Touched(ids),
        Remembered::Granted(_) | Remembered::Done => Reply::Done,
    }
}
