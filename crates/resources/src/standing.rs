//! The standing of sessions: the shares and due times that they set, the turns of their requests, and the updates of their accounts.

use crate::accounts::{Accounts, Within};
use crate::error::PoolError;
use crate::event::Refusal;
use crate::group::takes;
use crate::id::{SessionId, WaiterId};
use crate::memory::{Recalled, RequestId};
use crate::own_order::{Families, OwnPlace, Settled};
use crate::pool::Pool;
use crate::queue::AcquireRequest;
use crate::replaced::Earlier;
use crate::turn::{AHEAD, Share, Standing, Turn, step};
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// A due time that is repeated relative to another moment counts as unchanged within this.
const SAME_DUE: Duration = Duration::from_secs(1);

impl Pool {
    /// Sets the standing of a session. The share applies to what is held from now on, the due time also to what waits. Not persistent: after a
    /// restart it has to be set again.
    ///
    /// # Errors
    /// The session is unknown.
    pub fn set_standing(&mut self, now: Timestamp, id: &SessionId, standing: Standing) -> Result<(), PoolError> {
        self.begin(now);
        let before = self.session(id)?.standing;
        let due = match (before.due, standing.due) {
            (Some(before), Some(due)) if due <= before + SAME_DUE && before <= due + SAME_DUE => Some(before),
            (_, due) => due,
        };
        if let Some(session) = self.sessions.get_mut(id) {
            session.standing = Standing { due, ..standing };
        }
        if standing.share != before.share {
            self.counts_anew(id);
        }
        if due != before.due {
            let waiters = self.session(id)?.waiters.clone();
            self.worked += waiters.len();
            for waiter in waiters {
                self.turn_anew(waiter);
            }
            self.schedule();
        }
        Ok(())
    }

    /// From now on a session counts with another share, or for a caller with another bound.
    pub(crate) fn counts_anew(&mut self, session: &SessionId) {
        let (share, (caller, bound)) = (self.standing(session).share, self.bound_of(session));
        self.accounts.has_share(&Within { session, family: "", share, caller: &caller, bound, now: self.now });
        self.worked += self.accounts.take_looks();
    }

    /// The standing of a session; the default if it is unknown.
    pub(crate) fn standing(&self, id: &SessionId) -> Standing {
        self.sessions.get(id).map(|session| session.standing).unwrap_or_default()
    }

    /// What a request keeps of one that it replaces, which leaves the queue; and the request id of that one, to put it back.
    pub(crate) fn replaced_by(&mut self, request: &AcquireRequest, id: &RequestId) -> Option<(RequestId, Earlier)> {
        if let Some(earlier) = self.left.take(self.now, id, &request.session) {
            return Some((id.clone(), self.as_served(earlier, request)));
        }
        let session = self.sessions.get(&request.session).filter(|_| !request.instead_of.is_empty())?;
        let replaced = RequestId::new(&session.opened_by, &request.instead_of);
        if let Some(Recalled::Waiting(waiter)) = self.memory.reply(&replaced, self.is_over(session.number))
            && self.queue.get(waiter).is_some_and(|waiter| waiter.request.session == request.session)
        {
            self.refuse(waiter, Refusal::Cancelled);
            self.settle_firsts();
        }
        let earlier = self.left.take(self.now, &replaced, &request.session)?;
        Some((replaced, self.as_served(earlier, request)))
    }

    fn as_served(&self, earlier: Earlier, request: &AcquireRequest) -> Earlier {
        Earlier { kept: earlier.kept.map(|since| self.not_before_served(request, since)), ..earlier }
    }

    /// The later of `since` and the last service of a first request of the session in the wanted families.
    pub(crate) fn not_before_served(&self, request: &AcquireRequest, since: Timestamp) -> Timestamp {
        let session = &request.session;
        let served = |family| self.accounts.served(session, family).max(self.left.served(session, family));
        self.families_taken(&request.requirements).into_iter().map(served).fold(since, Timestamp::max)
    }

    /// The turn of a request that begins to wait now.
    pub(crate) fn turn_of(&mut self, request: &AcquireRequest, kept: Option<Timestamp>, id: WaiterId) -> Turn {
        if self.would_be_first(request, id) {
            return self.first_turn(request, kept.unwrap_or(self.now));
        }
        self.turn_behind(request)
    }

    /// The turn of a request behind others of its session, or that does not compete.
    pub(crate) fn turn_behind(&self, request: &AcquireRequest) -> Turn {
        Turn::behind(request.speculative, self.standing(&request.session).due, request.priority)
    }

    /// The turn of a first request of its session.
    fn first_turn(&mut self, request: &AcquireRequest, since: Timestamp) -> Turn {
        let since = self.not_before_served(request, since);
        let (due, mut ahead) = (self.standing(&request.session).due, Duration::ZERO);
        self.in_accounts(request, |accounts, within| ahead = ahead.max(accounts.ahead(within)));
        self.worked += self.accounts.take_looks();
        // A difference above `AHEAD` is only possible if the shares of its caller exceed their bound.
        let since = since + ahead.saturating_sub(AHEAD);
        Turn::of(request.speculative, step(since, ahead), due, request.priority)
    }

    fn would_be_first(&self, request: &AcquireRequest, id: WaiterId) -> bool {
        self.accounts.is_first(&request.session, self.families_taken(&request.requirements), &request.own_place(id))
    }

    /// A waiter begins to compete: existing resources could satisfy it.
    pub(crate) fn competes(&mut self, id: WaiterId) {
        let Some(request) = self.queue.get(id).map(|waiter| waiter.request.clone()) else { return };
        self.in_accounts(&request, |accounts, within| accounts.waits(within, request.own_place(id)));
        let families = self.families_of(&request);
        if families.is_empty() {
            self.set_first(id, true);
        }
        self.accounts.joins(&request.session, families, request.own_place(id));
        self.settle_firsts();
    }

    /// A waiter stops competing, but stays.
    pub(crate) fn competes_no_more(&mut self, id: WaiterId) {
        let Some(request) = self.queue.get(id).map(|waiter| waiter.request.clone()) else { return };
        self.set_first(id, false);
        self.has_competed(&request, id, false);
        self.settle_firsts();
    }

    /// A waiter stops competing; `served` if it was served as a first request of its session. `settle_firsts` has to follow.
    pub(crate) fn has_competed(&mut self, request: &AcquireRequest, id: WaiterId, served: bool) {
        let (own, families) = (request.own_place(id), self.families_of(request));
        if served {
            self.left.first_was_served(self.now, &request.session, &families);
        }
        self.accounts.parts(&request.session, &families, &own);
        self.in_accounts(request, |accounts, within| accounts.waits_no_more(within, own, served));
    }

    /// Updates the first requests of sessions, after requests have come or gone. Once for all changes together.
    pub(crate) fn settle_firsts(&mut self) {
        while let Some(Settled { no_more, anew, .. }) = self.accounts.settle_next() {
            no_more.into_iter().for_each(|id| self.set_first(id, false));
            anew.into_iter().for_each(|id| self.set_first(id, true));
        }
        self.worked += self.accounts.take_looks();
    }

    fn set_first(&mut self, id: WaiterId, first: bool) {
        let Some(waiter) = self.queue.waiters.get_mut(&id) else { return };
        waiter.first = first;
        let request = waiter.request.clone();
        if first {
            self.in_accounts(&request, Accounts::begins_turn);
        }
        self.turn_anew(id);
    }

    /// Recomputes the turn of a waiter; returns whether its place has changed.
    fn turn_anew(&mut self, id: WaiterId) -> bool {
        let Some(waiter) = self.queue.get(id) else { return false };
        let (request, since, before) = (waiter.request.clone(), waiter.since, waiter.turn);
        let turn = if waiter.first { self.first_turn(&request, since) } else { self.turn_behind(&request) };
        let moves = turn != before;
        if moves {
            self.queue.move_to(id, turn);
        }
        moves
    }

    /// The services of sessions have changed: recomputes the turns of their first requests in a family; returns whether one moved.
    pub(crate) fn turns_anew(&mut self, family: &str) -> bool {
        let firsts = self.accounts.firsts(family);
        self.worked += firsts.len();
        let mut moved = false;
        for id in firsts {
            moved |= self.turn_anew(id);
        }
        moved
    }

    /// Updates the accounts of a request's session in the families from which the request takes units.
    fn in_accounts(&mut self, request: &AcquireRequest, mut act: impl FnMut(&mut Accounts, &Within<'_>)) {
        let (session, Standing { share, .. }) = (&request.session, self.standing(&request.session));
        let (caller, bound) = self.bound_of(session);
        let families: BTreeSet<&str> =
            kinds_taken(&request.requirements).map(|kind| self.resources.family(kind)).collect();
        for family in families {
            act(&mut self.accounts, &Within { session, family, share, caller: &caller, bound, now: self.now });
        }
    }

    /// Updates the account of a session in the family of a kind.
    pub(crate) fn in_account(&mut self, session: &SessionId, kind: &str, act: impl FnOnce(&mut Accounts, &Within<'_>)) {
        let Standing { share, .. } = self.standing(session);
        let (caller, bound) = self.bound_of(session);
        let family = self.resources.family(kind);
        act(&mut self.accounts, &Within { session, family, share, caller: &caller, bound, now: self.now });
    }

    /// The caller who opened a session, and the bound on the total share of that caller's sessions, in thousandths; `None` for operators.
    fn bound_of(&self, session: &SessionId) -> (Arc<str>, Option<u64>) {
        let Some(known) = self.sessions.get(session) else { return Default::default() };
        let bound = u64::from(self.limits.share_per_caller) * Share::ONE.thousandths();
        (known.opened_by.clone(), (!known.is_operators()).then_some(bound))
    }

    /// Opens accounts for all sessions that hold something. The queue is empty.
    pub(crate) fn open_accounts(&mut self) {
        self.accounts = Accounts::default();
        let held: Vec<(SessionId, String, Quantity)> = self
            .leases
            .values()
            .flat_map(|lease| lease.held.iter().map(|(slot, amount)| (&lease.session, slot, amount)))
            .filter_map(|(session, slot, amount)| {
                let kind = self.resources.get(*slot)?.description.kind.clone();
                Some((session.clone(), kind, *amount))
            })
            .collect();
        for (session, kind, amount) in held {
            self.in_account(&session, &kind, |accounts, within| accounts.holds(within, amount));
        }
    }

    /// The families from which something is wanted.
    fn families_taken<'a>(&'a self, requirements: &'a [Requirement]) -> BTreeSet<&'a str> {
        kinds_taken(requirements).map(|kind| self.resources.family(kind)).collect()
    }

    fn families_of(&self, request: &AcquireRequest) -> Families {
        self.families_taken(&request.requirements).into_iter().map(Arc::from).collect()
    }

    /// Checks the accounts against the leases and the queue, for the invariants.
    pub(crate) fn accounts_agree(&self) -> Result<(), String> {
        let mut has = BTreeMap::<_, (Quantity, usize)>::new();
        for lease in self.leases.values() {
            for (slot, amount) in &lease.held {
                let Some(resource) = self.resources.get(*slot) else { continue };
                let family = self.resources.family(&resource.description.kind).into();
                has.entry((lease.session.clone(), family)).or_default().0 += *amount;
            }
        }
        for (id, waiter) in self.queue.iter() {
            let request = &waiter.request;
            for family in self.families_taken(&request.requirements).into_iter().filter(|_| waiter.hopeful) {
                has.entry((request.session.clone(), family.into())).or_default().1 += 1;
            }
            if waiter.first != (waiter.hopeful && self.would_be_first(request, id)) {
                return Err(format!("{id} is the first of its session, or is not, and its account says otherwise"));
            }
            if waiter.first == waiter.turn.is_behind() {
                return Err(format!("the turn of {id} is not that of a first request, or of one behind it"));
            }
        }
        self.accounts.agree(&has)
    }
}

/// The kinds from which something is wanted.
fn kinds_taken(requirements: &[Requirement]) -> impl Iterator<Item = &str> {
    requirements.iter().filter(|requirement| takes(requirement)).map(|requirement| requirement.kind.as_str())
}

impl AcquireRequest {
    fn own_place(&self, id: WaiterId) -> OwnPlace {
        (self.speculative, Reverse(self.priority), id)
    }

    /// Marks it as speculative: everything that is certainly needed comes first.
    #[must_use]
    pub fn speculative(mut self, speculative: bool) -> AcquireRequest {
        self.speculative = speculative;
        self
    }

    /// Replaces another request of the session, given by its id: it keeps that request's waiting time, and that request leaves.
    #[must_use]
    pub fn instead_of(mut self, request_id: &str) -> AcquireRequest {
        request_id.clone_into(&mut self.instead_of);
        self
    }
}

impl Standing {
    /// A standing with this share, and no due time.
    pub fn of(share: Share) -> Standing {
        Standing { share, due: None }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::expiry::Work;
    use crate::limits::Limits;
    use crate::resource::ResourceSpec;
    use ratn_model::resource::{ResourceClass, ResourceOperation};

    const KINDS: [&str; 4] = ["Arm", "Camera", "Gripper", "Tool"];
    const SESSIONS: usize = 100;
    const WAITERS: i64 = 200;

    fn session(number: usize) -> SessionId {
        SessionId::from(format!("s-{number}").as_str())
    }

    fn all_of_it(number: usize) -> AcquireRequest {
        let blocks = |kind: &&str| Requirement::new(ResourceOperation::Block, *kind);
        AcquireRequest::new(session(number), KINDS.iter().map(blocks).collect())
    }

    /// The first session holds everything, each session waits for it, and the second one with many more requests, whose deadline is `until`.
    fn crowded(until: Timestamp) -> Pool {
        let mut pool = Pool::new(Limits::default());
        for number in 0..SESSIONS {
            pool.keep_alive(Timestamp(0), &session(number), "s", Duration::from_secs(3_600)).unwrap();
        }
        for kind in KINDS {
            pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, kind)).unwrap();
        }
        for number in 0..SESSIONS {
            pool.acquire(Timestamp(0), all_of_it(number)).unwrap();
            pool.acquire(Timestamp(0), all_of_it(number).priority(1).deadline(until)).unwrap();
        }
        for priority in 0..WAITERS {
            pool.acquire(Timestamp(0), all_of_it(1).priority(-priority).deadline(until)).unwrap();
        }
        while pool.next_deadline() == Some(Timestamp(0)) {
            pool.advance(Timestamp(0));
        }
        pool.check_invariants().unwrap();
        // Nothing that follows is postponed, and no other work is counted.
        pool.work = Work { per_turn: 0, per_call: 0 };
        pool
    }

    /// Checks that the work was about one read of each account of each family.
    fn looked_little(pool: &Pool) {
        assert!(pool.worked < 2 * KINDS.len() * SESSIONS + SESSIONS + 200, "{} looks", pool.worked);
        pool.check_invariants().unwrap();
    }

    #[test]
    fn a_session_that_ends_does_not_look_who_is_first_for_each_of_its_waiters() {
        let mut pool = crowded(Timestamp(2_000_000_000_000));
        pool.close_session(Timestamp(1), &session(1)).unwrap();
        assert_eq!(pool.waiting(), 2 * SESSIONS - 3);
        looked_little(&pool);
    }

    #[test]
    fn of_all_that_are_refused_at_a_moment_is_looked_once_who_is_first() {
        let then = Timestamp(1_000_000_000);
        let mut pool = crowded(then);
        pool.advance(then);
        assert_eq!(pool.waiting(), SESSIONS - 1);
        looked_little(&pool);
    }

    #[test]
    fn another_due_time_takes_one_look() {
        let mut pool = crowded(Timestamp(2_000_000_000_000));
        let standing = Standing { due: Some(Timestamp(5_000_000_000)), ..Standing::default() };
        pool.set_standing(Timestamp(1), &session(1), standing).unwrap();
        looked_little(&pool);
    }
}
