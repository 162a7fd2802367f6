//! The pool as it should be, written without looking at how the resource manager does it: sessions, resources, leases, one change at
//! a time.
//!
//! What it leaves open, because a client cannot know: when exactly a session expires (not before its time to live is over since the
//! last ping that was answered was *sent*), and whether an acquire whose answer was lost was granted and taken back.

use super::history::{Amounts, Asked, Call, Done, Grant, History, NEVER, Session, Shown};
use super::search::{Model, Timed};
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{Hash, Hasher};
use std::sync::Arc;

/// What there is at the beginning: kind `A` one by one, `B` in whole units, `C` divisible and gone for good when it is consumed.
pub(crate) const STOCK: [(&str, u64); 5] =
    [("a-0", 1_000), ("a-1", 1_000), ("a-2", 1_000), ("b", 4_000), ("c", 20_000)];
/// The resource of which is consumed.
const CHARGE: &str = "c";

#[derive(Debug, Clone, Hash, PartialEq)]
struct Resource {
    capacity: u64,
    owner: Option<Session>,
}

#[derive(Debug, Clone, Hash, PartialEq)]
struct Lease {
    session: Session,
    request: String,
    held: Amounts,
}

/// What may happen without an answer.
#[derive(Debug, Default)]
struct Unheard {
    /// Grants that nobody was answered, by token.
    grants: BTreeMap<u64, (Grant, Asked)>,
    asked: BTreeMap<String, Asked>,
    perhaps: Vec<Timed<Call>>,
    /// When each session was pinged without an answer for the first time.
    pinged: BTreeMap<Session, u64>,
    /// What every lease held in the beginning, by token.
    held: BTreeMap<u64, Amounts>,
}

/// See the module.
#[derive(Debug, Clone)]
pub(crate) struct Pool {
    unheard: Arc<Unheard>,
    /// Which of the calls that may have been done were.
    happened: BTreeSet<usize>,
    /// Which live, and until when at least.
    sessions: BTreeMap<Session, u64>,
    resources: BTreeMap<String, Resource>,
    leases: BTreeMap<u64, Lease>,
    spent: u64,
    last_token: u64,
}

impl Hash for Pool {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (&self.happened, &self.sessions, &self.resources, &self.leases).hash(state);
        (self.spent, self.last_token).hash(state);
    }
}

impl Pool {
    /// The pool before anything of this history.
    pub(crate) fn new(history: &History, name: impl Fn(&str) -> Option<Session>) -> Pool {
        let answered: BTreeSet<u64> = (history.threads.iter().flatten())
            .filter_map(|timed| if let Done::Granted { token, .. } = &timed.call.done { Some(*token) } else { None })
            .collect();
        let grants = history.grants.iter().filter(|(token, grant)| {
            !answered.contains(token) && grant.held.keys().all(|id| id != super::provider::TOOL)
        });
        let grants = grants.filter_map(|(token, grant)| {
            let session = name(&grant.session)?;
            let asked = history.asked.get(&grant.request).copied();
            // Nobody has asked for it: nothing explains it, and whoever sees it cannot be explained either.
            asked.filter(|asked| asked.session == session).map(|asked| (*token, (grant.clone(), asked)))
        });
        let unheard = Unheard {
            grants: grants.collect(),
            asked: history.asked.clone(),
            perhaps: history.perhaps.clone(),
            pinged: history.pinged.clone(),
            held: history.grants.iter().map(|(token, grant)| (*token, grant.held.clone())).collect(),
        };
        let stock = STOCK.map(|(id, capacity)| (id.to_owned(), Resource { capacity, owner: None }));
        Pool {
            unheard: Arc::new(unheard),
            happened: BTreeSet::new(),
            sessions: BTreeMap::new(),
            resources: stock.into(),
            leases: BTreeMap::new(),
            spent: 0,
            last_token: 0,
        }
    }

    fn held(&self, id: &str) -> u64 {
        self.leases.values().filter_map(|lease| lease.held.get(id)).sum()
    }

    fn free(&self, id: &str) -> u64 {
        let Some(resource) = self.resources.get(id) else { return 0 };
        let spent = if id == CHARGE { self.spent } else { 0 };
        resource.capacity.saturating_sub(self.held(id) + spent)
    }

    fn grant(mut self, session: Session, request: &str, token: u64, held: &Amounts) -> Option<Pool> {
        let possible = token > self.last_token
            && self.sessions.contains_key(&session)
            && held.iter().all(|(id, amount)| self.free(id) >= *amount);
        self.last_token = token;
        let lease = Lease { session, request: request.to_owned(), held: held.clone() };
        self.leases.insert(token, lease);
        possible.then_some(self)
    }

    fn vanish(&mut self, id: &str) {
        self.resources.remove(id);
        for lease in self.leases.values_mut() {
            lease.held.remove(id);
        }
    }

    fn expire(mut self, session: Session) -> Pool {
        self.sessions.remove(&session);
        self.leases.retain(|_, lease| lease.session != session);
        let owned = self.resources.iter().filter(|(_, resource)| resource.owner == Some(session));
        for id in owned.map(|(id, _)| id.clone()).collect::<Vec<_>>() {
            self.vanish(&id);
        }
        self
    }

    fn shows(&self, pool: &BTreeMap<String, Shown>) -> bool {
        let shown = |id: &String| {
            let held = self.leases.iter().filter_map(|(token, lease)| Some((*token, *lease.held.get(id)?)));
            Shown { free: self.free(id), held: held.collect() }
        };
        pool.len() == self.resources.len() && self.resources.keys().all(|id| pool.get(id) == Some(&shown(id)))
    }

    /// The lease of an acquire.
    fn lease_of(&self, request: &str) -> Option<u64> {
        self.leases.iter().find(|(_, lease)| lease.request == request).map(|(token, _)| *token)
    }

    fn done(&self, session: Session, begin: u64, end: u64, done: &Done) -> Option<Pool> {
        let mut pool = self.clone();
        match done {
            Done::Pinged { ttl, created } => {
                let new = pool.sessions.insert(session, begin + ttl).is_none();
                return (*created == new).then_some(pool);
            }
            Done::Granted { request, token, held } => {
                // What the lease lost before its answer was read is only in what others saw.
                let held = pool.unheard.held.get(token).unwrap_or(held).clone();
                return pool.grant(session, request, *token, &held);
            }
            Done::Released { token, released } => {
                return (pool.leases.remove(token).is_some() == *released).then_some(pool);
            }
            Done::Withdrawn { request, withdrawn, sure } => {
                let lease = pool.lease_of(request);
                lease.map(|token| pool.leases.remove(&token));
                // It may have waited.
                let waited =
                    pool.unheard.asked.get(request).is_some_and(|asked| asked.begin <= end && asked.until >= begin);
                let possible = if *withdrawn { lease.is_some() || waited } else { lease.is_none() || !*sure };
                return possible.then_some(pool);
            }
            Done::Consumed { amount } => {
                if pool.free(CHARGE) < *amount || !pool.sessions.contains_key(&session) {
                    return None;
                }
                pool.spent += amount;
            }
            Done::Created { resource } => {
                if !pool.sessions.contains_key(&session) {
                    return None;
                }
                let made = Resource { capacity: 1_000, owner: Some(session) };
                pool.resources.insert(resource.clone(), made);
            }
            Done::Deleted { resource, there } => {
                if pool.resources.contains_key(resource) != *there {
                    return None;
                }
                pool.vanish(resource);
            }
            Done::Seen { pool: shown } => return self.shows(shown).then_some(pool),
        }
        Some(pool)
    }
}

impl Model for Pool {
    type Call = Call;

    fn after(&self, timed: &Timed<Call>) -> Option<Pool> {
        self.done(timed.call.session, timed.begin, timed.end, &timed.call.done)
    }

    fn unheard(&self, earliest: u64, latest: u64) -> Vec<Pool> {
        let mut after = Vec::new();
        for (index, timed) in self.unheard.perhaps.iter().enumerate() {
            if timed.begin > latest || self.happened.contains(&index) {
                continue;
            }
            if let Some(mut pool) = self.done(timed.call.session, timed.begin, NEVER, &timed.call.done) {
                pool.happened.insert(index);
                after.push(pool);
            }
        }
        for (session, begin) in &self.unheard.pinged {
            // It matters only where it opens a session, and nothing is promised of how long that lives.
            if *begin <= latest && !self.sessions.contains_key(session) {
                let mut pool = self.clone();
                pool.sessions.insert(*session, 0);
                after.push(pool);
            }
        }
        let expired = self.sessions.iter().filter(|(_, until)| **until <= latest);
        after.extend(expired.map(|(session, _)| self.clone().expire(*session)));
        for (token, lease) in &self.leases {
            if self.unheard.grants.contains_key(token) {
                let mut pool = self.clone();
                pool.leases.remove(token);
                after.push(pool);
            }
            // Without a request that waits there is none to be taken back.
            debug_assert!(!lease.request.is_empty());
        }
        for (token, (grant, asked)) in self.unheard.grants.range(self.last_token + 1..) {
            if asked.begin <= latest && asked.until >= earliest {
                after.extend(self.clone().grant(asked.session, &grant.request, *token, &grant.held));
            }
        }
        after
    }
}
