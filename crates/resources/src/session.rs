//! Sessions: everything that a client provides, holds, waits for or has consumed belongs to one.

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
    /// The caller who opened it, as the connection proved: nobody else may use it. Empty if unknown.
    pub(crate) opened_by: Arc<str>,
    /// Whether that caller is an operator, according to the last ping; `None` before the first ping after a restart.
    pub(crate) for_anybody: Option<bool>,
    /// The number of the session among all sessions of this pool: a session that is opened again under the same id has another number. 0 if it was
    /// opened by a version that did not number sessions.
    pub(crate) number: u64,
    /// How long it lives without a keep-alive.
    pub(crate) ttl: Duration,
    /// When it expires unless it is kept alive.
    pub(crate) expires: Timestamp,
    /// The reason if it is ending: it cannot be used any more, but not everything that belongs to it is removed. If that takes several turns, its
    /// `ttl` is recorded as 0.
    pub(crate) ending: Option<EndReason>,
    /// The resources that it provides, which are deleted with it.
    pub(crate) provides: BTreeSet<Slot>,
    /// Its leases.
    pub(crate) leases: BTreeSet<LeaseId>,
    /// Its queued acquires.
    pub(crate) waiters: BTreeSet<WaiterId>,
    /// The resources of which it has consumed units that return when its task ends.
    pub(crate) consumed: BTreeSet<Slot>,
    /// Its standing beside others, as set since the pool was created or restored.
    pub(crate) standing: Standing,
}

/// A session as others see it.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionView {
    /// Its id.
    pub id: SessionId,
    /// The client's name.
    pub name: String,
    /// The caller who opened it, as the connection proved; empty if unknown.
    pub opened_by: Arc<str>,
    /// How long it lives without a keep-alive.
    pub ttl: Duration,
    /// When it expires unless it is kept alive.
    pub expires: Timestamp,
    /// Its live leases.
    pub leases: Vec<LeaseId>,
    /// Its queued acquires.
    pub waiters: Vec<WaiterId>,
    /// The ids of the resources that it provides, in order.
    pub provides: Vec<String>,
    /// Its standing beside others.
    pub standing: Standing,
}

/// The caller who uses sessions, as the connection proves.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Speaker {
    /// The name; equal names are the same caller.
    pub name: Arc<str>,
    /// Whether it may also use sessions that others opened: an operator.
    pub for_anybody: bool,
}

impl Speaker {
    /// If there are no other callers: inside a process, in a simulation.
    pub fn trusted() -> Speaker {
        Speaker { name: Arc::default(), for_anybody: true }
    }
}

/// Sessions by id.
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

    /// Whether it belongs to an operator, or to an unknown caller.
    pub(crate) fn is_operators(&self) -> bool {
        self.for_anybody == Some(true) || self.opened_by.is_empty()
    }

    /// Whether it is known not to belong to an operator.
    pub(crate) fn is_no_operators(&self) -> bool {
        self.for_anybody == Some(false) && !self.opened_by.is_empty()
    }
}

impl Pool {
    /// Like [`Pool::keep_alive_as`], with [`Speaker::trusted`].
    ///
    /// # Errors
    /// The same as there.
    pub fn keep_alive(
        &mut self,
        now: Timestamp,
        id: &SessionId,
        client: &str,
        ttl: Duration,
    ) -> Result<bool, PoolError> {
        self.keep_alive_as(now, &Speaker::trusted(), id, client, ttl)
    }

    /// Keeps the session alive for `ttl` from now. An unknown or expired session is opened (anew: nothing of an earlier one is left) for the speaker,
    /// who owns it from then on, also after its end (see [`Pool::check_speaker`]); the answer is then true. `client` is a name for people. Only a new
    /// session or another `ttl` is recorded.
    ///
    /// # Errors
    /// The session was opened, or last opened, by another caller, or is still ending; the name is malformed; `ttl` is zero; or there are too many sessions.
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

    /// Whether the speaker may open one more session.
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

    /// Checks that the speaker may use a session. An ended session belongs to its opener as long as its id is kept ([`Limits::kept_session_ids`]);
    /// any other unknown session belongs to nobody.
    ///
    /// # Errors
    /// Another caller opened the session, or the id is kept for another caller.
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

    /// The same pool with every session's expiry delayed by `grace`, unless it is pinged before: this honours what the previous process may have promised.
    #[must_use]
    pub fn with_session_grace(mut self, grace: Duration) -> Pool {
        for (id, session) in self.sessions.iter_mut().filter(|(_, session)| session.ending.is_none()) {
            self.timers.remove(&(session.expires, Timer::Session(id.clone())));
            session.expires = session.expires + grace;
            self.timers.insert((session.expires, Timer::Session(id.clone())));
        }
        self
    }

    /// The number of a session; 0 if a version opened it that did not number sessions, `None` if it is unknown. A session that was opened again under
    /// its id has another number, also after a restart.
    pub fn session_number(&self, id: &SessionId) -> Option<u64> {
        self.session(id).ok().map(|session| session.number)
    }

    /// How long a session lives without a keep-alive; `None` if it is unknown.
    pub fn session_ttl(&self, id: &SessionId) -> Option<Duration> {
        self.session(id).ok().map(|session| session.ttl)
    }

    /// Ends a session and everything that belongs to it. From now on it is unknown; if much belongs to it, the rest is removed in the next turns.
    ///
    /// # Errors
    /// The session is unknown or expired.
    pub fn close_session(&mut self, now: Timestamp, id: &SessionId) -> Result<(), PoolError> {
        self.begin(now);
        self.session(id)?;
        self.begin_end(id, EndReason::SessionClosed);
        self.end_overdue();
        self.schedule();
        Ok(())
    }

    /// All sessions, ordered by id.
    pub fn sessions(&self) -> Vec<SessionView> {
        self.sessions.iter().map(|(id, session)| self.session_view(id, session, usize::MAX)).collect()
    }

    /// With at most `named` of its leases and resources.
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

    /// Whether a session exists.
    pub fn has_session(&self, id: &SessionId) -> bool {
        self.session(id).is_ok()
    }

    pub(crate) fn session(&self, id: &SessionId) -> Result<&Session, PoolError> {
        let known = self.sessions.get(id).filter(|session| session.ending.is_none());
        known.ok_or_else(|| PoolError::UnknownSession { session: id.clone() })
    }

    /// Begins to end a session: its waiters leave, and the rest is removed in turns.
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

    /// Removes what belongs to an ending session, up to the limit of a turn, and finally the session.
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
                    // The resource was renewable when it was consumed.
                    false => (Effect::TaskEnded { session: id.clone() }, session.consumed.len()),
                }
            } else if let Some(&slot) = session.provides.first() {
                match self.lease_that_ends_with(slot) {
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
