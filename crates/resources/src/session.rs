//! Sessions: everything that a client provides, holds, waits for or has consumed hangs on one.

use crate::caller::for_all;
use crate::error::{ALL, ALL_BUT_OPERATORS, PoolError, malformed};
use crate::event::{EndReason, Refusal};
use crate::expiry::Timer;
use crate::id::{SessionId, Slot, WaiterId};
use crate::limits::Limits;
use crate::pool::Pool;
use crate::record::Effect;
use crate::turn::Standing;
use ratn_model::id::LeaseId;
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// A live session.
#[derive(Debug, Clone)]
pub(crate) struct Session {
    /// The client's name, for people.
    pub(crate) name: String,
    /// Who opened it, as the connection proved: nobody else speaks for it. Empty where nobody knows.
    pub(crate) opened_by: Arc<str>,
    /// Whether that is an operator, as its last ping said; nothing before the first one after a restart.
    pub(crate) for_anybody: Option<bool>,
    /// Which of all sessions of this pool it is: one that is opened anew under the same id has another number. 0 where it was opened by a
    /// version that did not number them.
    pub(crate) number: u64,
    /// How long it lives without a keep-alive.
    pub(crate) ttl: Duration,
    /// When it expires unless kept alive.
    pub(crate) expires: Timestamp,
    /// It ends, and why: it is nobody's any more, though not everything that hung on it is gone yet. Where that takes several turns,
    /// its `ttl` is 0, which is how it is written down.
    pub(crate) ending: Option<EndReason>,
    /// The resources that vanish with it.
    pub(crate) provides: BTreeSet<Slot>,
    /// Its leases.
    pub(crate) leases: BTreeSet<LeaseId>,
    /// Its queued acquires.
    pub(crate) waiters: BTreeSet<WaiterId>,
    /// The resources of which it has consumed something that returns at its task's end.
    pub(crate) consumed: BTreeSet<Slot>,
    /// What it is beside others, as it has said since the pool was made or restored.
    pub(crate) standing: Standing,
}

/// A session as others see it.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionView {
    /// Its id.
    pub id: SessionId,
    /// The client's name.
    pub name: String,
    /// Who opened it, as the connection proved; empty where nobody knows.
    pub opened_by: Arc<str>,
    /// How long it lives without a keep-alive.
    pub ttl: Duration,
    /// When it expires unless kept alive.
    pub expires: Timestamp,
    /// Its live leases.
    pub leases: Vec<LeaseId>,
    /// Its queued acquires.
    pub waiters: Vec<WaiterId>,
    /// Ids of the resources that it provides, in order.
    pub provides: Vec<String>,
    /// What it is beside others.
    pub standing: Standing,
}

/// Who speaks for sessions, as the connection proves it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Speaker {
    /// The same name is the same speaker.
    pub name: Arc<str>,
    /// Also for sessions that others opened: an operator.
    pub for_anybody: bool,
}

impl Speaker {
    /// Where nobody else is: inside a process, in a simulation.
    pub fn trusted() -> Speaker {
        Speaker { name: Arc::default(), for_anybody: true }
    }
}

/// By id.
pub(crate) type Sessions = BTreeMap<SessionId, Session>;

impl Session {
    pub(crate) fn new(name: String, opened_by: Arc<str>, number: u64, ttl: Duration, expires: Timestamp) -> Session {
        Session {
            name,
            opened_by,
            for_anybody: None,
            number,
            ttl,
            expires,
            ending: ttl.is_zero().then_some(EndReason::SessionExpired),
            provides: BTreeSet::new(),
            leases: BTreeSet::new(),
            waiters: BTreeSet::new(),
            consumed: BTreeSet::new(),
            standing: Standing::default(),
        }
    }

    /// Whether it is an operator's, or of one who is not known.
    pub(crate) fn is_operators(&self) -> bool {
        self.for_anybody == Some(true) || self.opened_by.is_empty()
    }

    /// Whether it is known to be nobody's who is an operator.
    pub(crate) fn is_no_operators(&self) -> bool {
        self.for_anybody == Some(false) && !self.opened_by.is_empty()
    }
}

impl Pool {
    /// As [`Pool::keep_alive_as`], by [`Speaker::trusted`].
    ///
    /// # Errors
    /// As there.
    pub fn keep_alive(
        &mut self,
        now: Timestamp,
        id: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<bool, PoolError> {
        self.keep_alive_as(now, &Speaker::trusted(), id, client, ttl)
    }

    /// The session lives for `ttl` from now. An unknown or expired one is opened (anew: nothing of an earlier one is left) by the
    /// speaker, whose it is from then on, also after its end (see [`Pool::check_speaker`]), and the answer is true. `client` says who that is, for people. Only a new session or
    /// another `ttl` is written down.
    ///
    /// # Errors
    /// A session that another opened, or opened last, or that is still ending, a malformed name, no time to live, or too many sessions.
    pub fn keep_alive_as(
        &mut self,
        now: Timestamp,
        speaker: &Speaker,
        id: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<bool, PoolError> {
        self.check_speaker(now, speaker, id)?;
        if self.sessions.get(id).is_some_and(|session| session.ending.is_some()) {
            return Err(PoolError::SessionEnding { session: id.clone() });
        }
        if ttl.is_zero() {
            return Err(malformed("session time to live 0", "a session lives for more than 0 seconds"));
        }
        let opened = self.kept_alive(speaker, id, client, ttl)?;
        if let Some(session) = self.sessions.get_mut(id).filter(|session| session.opened_by == speaker.name) {
            let was_operators = session.is_operators();
            session.for_anybody = Some(speaker.for_anybody);
            if session.is_operators() != was_operators {
                self.counts_anew(id);
            }
        }
        Ok(opened)
    }

    fn kept_alive(
        &mut self,
        speaker: &Speaker,
        id: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<bool, PoolError> {
        match self.sessions.get_mut(id) {
            Some(session) if session.ttl == ttl => {
                self.timers.remove(&(session.expires, Timer::Session(id.clone())));
                session.expires = self.now + ttl;
                self.timers.insert((session.expires, Timer::Session(id.clone())));
                Ok(false)
            }
            Some(_) => {
                self.check_name("client name", client)?;
                self.commit(Effect::SessionKept { session: id.clone(), client: client.to_owned(), ttl });
                Ok(false)
            }
            None => {
                self.check_name("session id", id.as_str())?;
                self.check_name("client name", client)?;
                self.check_sessions(speaker)?;
                let (session, client, opened_by) = (id.clone(), client.to_owned(), speaker.name.clone());
                let number = self.last_session + 1;
                self.commit(Effect::SessionNumbered { session, client, ttl, opened_by, number });
                Ok(true)
            }
        }
    }

    /// Whether the speaker may open one more.
    fn check_sessions(&self, speaker: &Speaker) -> Result<(), PoolError> {
        let Limits { sessions, sessions_per_caller, sessions_for_operators, .. } = self.limits;
        if self.sessions.len() >= sessions {
            return Err(PoolError::TooMany { what: "sessions", whose: ALL, key: "sessions", limit: sessions });
        }
        if speaker.for_anybody {
            return Ok(());
        }
        if self.callers.sessions(&speaker.name) >= sessions_per_caller {
            let (whose, quota) = (speaker.name.clone(), "sessions_per_caller");
            return Err(PoolError::Quota { what: "sessions", whose, quota, limit: sessions_per_caller });
        }
        let for_all = for_all(sessions, sessions_for_operators);
        if self.sessions.len() >= for_all {
            let (whose, key) = (ALL_BUT_OPERATORS, "sessions_for_operators");
            return Err(PoolError::TooMany { what: "sessions", whose, key, limit: for_all });
        }
        Ok(())
    }

    /// Whether the speaker may speak for a session. One that has ended is still its opener's, as long as its id is kept
    /// ([`Limits::kept_session_ids`]); any other one that is not there is nobody's.
    ///
    /// # Errors
    /// A session that another opened, or the id of one.
    pub fn check_speaker(&mut self, now: Timestamp, speaker: &Speaker, id: &SessionId) -> Result<(), PoolError> {
        self.begin(now);
        if speaker.for_anybody {
            return Ok(());
        }
        let (session, speaker) = (id.clone(), speaker.name.clone());
        let Some(known) = self.sessions.get(id) else {
            let kept_for = self.kept_ids.opener(id, self.now, &self.limits).filter(|opener| **opener != speaker);
            let refused =
                |opener: &Arc<str>| Err(PoolError::SessionIdKept { session, opened_by: opener.clone(), speaker });
            return kept_for.map_or(Ok(()), refused);
        };
        if known.opened_by != speaker {
            return Err(PoolError::SessionOfAnother { session, opened_by: known.opened_by.clone(), speaker });
        }
        Ok(())
    }

    /// The same pool, in which every session expires so much later, unless it is pinged before: what a predecessor of this pool's owner
    /// may have promised meanwhile is kept.
    #[must_use]
    pub fn with_session_grace(mut self, grace: Duration) -> Pool {
        for (id, session) in self.sessions.iter_mut().filter(|(_, session)| session.ending.is_none()) {
            self.timers.remove(&(session.expires, Timer::Session(id.clone())));
            session.expires = session.expires + grace;
            self.timers.insert((session.expires, Timer::Session(id.clone())));
        }
        self
    }

    /// The number of a session; 0 where a version opened it that did not number them, nothing where it is unknown. A session that was
    /// opened anew under its id has another one, also after a restart.
    pub fn session_number(&self, id: &SessionId) -> Option<u64> {
        self.session(id).ok().map(|session| session.number)
    }

    /// How long a session lives without a keep-alive; nothing where it is unknown.
    pub fn session_ttl(&self, id: &SessionId) -> Option<Duration> {
        self.session(id).ok().map(|session| session.ttl)
    }

    /// Ends a session and everything that hangs on it. From now on it is unknown; where much hangs on it, the rest of that goes in the
    /// next turns.
    ///
    /// # Errors
    /// An unknown or expired session.
    pub fn close_session(&mut self, now: Timestamp, id: &SessionId) -> Result<(), PoolError> {
        self.begin(now);
        self.session(id)?;
        self.begin_end(id, EndReason::SessionClosed);
        self.end_overdue();
        self.schedule();
        Ok(())
    }

    /// Every session, in the order of ids.
    pub fn sessions(&self) -> Vec<SessionView> {
        self.sessions.iter().map(|(id, session)| self.session_view(id, session, usize::MAX)).collect()
    }

    /// With so many of its leases and resources at the most.
    pub(crate) fn session_view(&self, id: &SessionId, session: &Session, named: usize) -> SessionView {
        let provides = session.provides.iter().take(named).filter_map(|slot| self.id_of(*slot));
        let mut provides: Vec<String> = provides.collect();
        provides.sort_unstable();
        SessionView {
            id: id.clone(),
            name: session.name.clone(),
            opened_by: session.opened_by.clone(),
            ttl: session.ttl,
            expires: session.expires,
            leases: session.leases.iter().take(named).copied().collect(),
            waiters: session.waiters.iter().copied().collect(),
            provides,
            standing: session.standing,
        }
    }

    /// Whether a session is there.
    pub fn has_session(&self, id: &SessionId) -> bool {
        self.session(id).is_ok()
    }

    pub(crate) fn session(&self, id: &SessionId) -> Result<&Session, PoolError> {
        let known = self.sessions.get(id).filter(|session| session.ending.is_none());
        known.ok_or_else(|| PoolError::UnknownSession { session: id.clone() })
    }

    /// Nobody has a session any more: its waiters leave, and what else hangs on it begins to go.
    pub(crate) fn begin_end(&mut self, id: &SessionId, reason: EndReason) {
        let Some(session) = self.sessions.get_mut(id) else { return };
        session.ending = Some(reason);
        let (expires, waiters) = (session.expires, std::mem::take(&mut session.waiters));
        self.stop_timer(expires, Timer::Session(id.clone()));
        self.shortages.remove(id);
        self.resources.close(id);
        for waiter in waiters {
            self.refuse(waiter, Refusal::SessionEnded);
        }
        self.overdue.insert(Timer::Session(id.clone()));
        self.end_some_of(id);
    }

    /// Ends what hangs on a session that ends, as much of it as a turn may; and the session with the last of it.
    pub(crate) fn end_some_of(&mut self, id: &SessionId) {
        while let Some(session) = self.sessions.get(id)
            && let Some(reason) = session.ending
            && !self.has_ended_enough()
        {
            let (lease, consumed) = (session.leases.first(), session.consumed.first());
            let (effect, holdings) = if let Some(&lease) = lease {
                (Effect::LeaseEnded { lease, reason }, self.leases.get(&lease).map_or(0, |record| record.held.len()))
            } else if let Some(&slot) = consumed {
                let resource = self.resources.get(slot);
                let amount = resource.map_or(Quantity::ZERO, |resource| resource.consumed_by(id));
                match resource.is_some_and(|resource| resource.description.renewable) {
                    true => (Effect::Returned { session: id.clone(), slot, amount }, 0),
                    // It was renewable when it was consumed.
                    false => (Effect::TaskEnded { session: id.clone() }, session.consumed.len()),
                }
            } else if let Some(&slot) = session.provides.first() {
                match self.lease_of(slot) {
                    Some(lease) => {
                        let held = self.leases.get(&lease).map_or(0, |record| record.held.len());
                        (Effect::LeaseEnded { lease, reason: EndReason::ResourceGone }, held)
                    }
                    // What leases have left of it goes with it.
                    None => {
                        let left = self.resources.get(slot).map_or(0, |resource| resource.holders.len());
                        (Effect::ResourceDeleted { slot, reason }, left)
                    }
                }
            } else {
                (Effect::SessionEnded { session: id.clone() }, 0)
            };
            self.ended(holdings + 1);
            self.commit(effect);
        }
    }
}
