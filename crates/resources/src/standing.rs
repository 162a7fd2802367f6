//! What sessions are beside each other: the shares and due times that they say, the turns of their requests, and what is put to whose account.

use crate::accounts::{Accounts, OwnPlace, Rivals, Within};
use crate::error::PoolError;
use crate::event::Refusal;
use crate::group::takes;
use crate::id::{SessionId, WaiterId};
use crate::memory::{Recalled, RequestId};
use crate::pool::Pool;
use crate::queue::AcquireRequest;
use crate::replaced::{Earlier, Kept};
use crate::turn::{Share, Standing, Turn, step};
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// A due time that is said again, counted from another moment, is the same within this.
const SAME_DUE: Duration = Duration::from_secs(1);

/// Those who wait, by family, as far as somebody was compared with them.
type Compared = BTreeMap<String, Rivals>;

impl Pool {
    /// A session says what it is beside others. The share counts for what is held from now on, the due time for what waits, too. Not written
    /// down: after a restart it is to be said again.
    ///
    /// # Errors
    /// An unknown session.
    pub fn set_standing(&mut self, now: Timestamp, id: &SessionId, standing: Standing) -> Result<(), PoolError> {
        self.begin(now);
        let before = self.session(id)?.standing;
        let due = match (before.due, standing.due) {
            (Some(before), Some(due)) if due <= before + SAME_DUE && before <= due + SAME_DUE => Some(before),
            (_, due) => due,
        };
        if standing.share != before.share {
            self.accounts.has_share(id, standing.share, self.now);
        }
        let Some(session) = self.sessions.get_mut(id) else { return Ok(()) };
        session.standing = Standing { due, ..standing };
        if due != before.due {
            for waiter in session.waiters.clone() {
                self.turn_anew(waiter, &mut Compared::new());
            }
            self.schedule();
        }
        Ok(())
    }

    /// What a session is beside others; as usual where it is unknown.
    pub(crate) fn standing(&self, id: &SessionId) -> Standing {
        self.sessions.get(id).map(|session| session.standing).unwrap_or_default()
    }

    /// What a request keeps of one that it replaces, which leaves the queue; and whose it is, to put it back.
    pub(crate) fn replaced_by(&mut self, request: &AcquireRequest, id: &RequestId) -> Option<(RequestId, Earlier)> {
        if let Some(earlier) = self.left.take(self.now, id) {
            return Some((id.clone(), earlier));
        }
        let session = self.sessions.get(&request.session).filter(|_| !request.instead_of.is_empty())?;
        let replaced = RequestId::new(&session.opened_by, &request.instead_of);
        if let Some(Recalled::Waiting(waiter)) = self.memory.reply(&replaced)
            && self.queue.get(waiter).is_some_and(|waiter| waiter.request.session == request.session)
        {
            self.refuse(waiter, Refusal::Cancelled);
        }
        self.left.take(self.now, &replaced).map(|earlier| (replaced, earlier))
    }

    /// The turn of a request that would wait from now on.
    pub(crate) fn turn_of(&self, request: &AcquireRequest, kept: Option<Kept>, id: WaiterId) -> Turn {
        if self.would_be_first(request, id) {
            return self.first_turn(request, kept.map_or(self.now, |kept| kept.since), kept, &mut Compared::new());
        }
        self.turn_behind(request)
    }

    /// The turn of a request behind others of its session, or that does not compete.
    pub(crate) fn turn_behind(&self, request: &AcquireRequest) -> Turn {
        Turn::behind(request.speculative, self.standing(&request.session).due, request.priority)
    }

    /// The turn of the first request of its session.
    fn first_turn(
        &self,
        request: &AcquireRequest,
        since: Timestamp,
        kept: Option<Kept>,
        compared: &mut Compared,
    ) -> Turn {
        let (session, Standing { share, due }) = (&request.session, self.standing(&request.session));
        let (mut since, mut ahead) = (since, Duration::ZERO);
        for family in self.families_taken(&request.requirements) {
            since = since.max(self.accounts.served(session, family));
            if !compared.contains_key(family) {
                compared.insert(family.to_owned(), self.accounts.rivals(family, self.now));
            }
            let within = Within { session, family, share, now: self.now };
            ahead = compared.get(family).map_or(ahead, |rivals| ahead.max(self.accounts.ahead(rivals, &within)));
        }
        let kept = kept.and_then(|kept| kept.step).map_or(u32::MAX, |kept| kept.max(step(since, Duration::ZERO)));
        Turn::of(request.speculative, step(since, ahead).min(kept), due, request.priority)
    }

    fn would_be_first(&self, request: &AcquireRequest, id: WaiterId) -> bool {
        let (own, session) = (request.own_place(id), &request.session);
        self.families_taken(&request.requirements).iter().all(|family| self.accounts.is_first(session, family, &own))
    }

    /// A waiter competes from now on: what exists would do for it.
    pub(crate) fn competes(&mut self, id: WaiterId) {
        let Some(request) = self.queue.get(id).map(|waiter| waiter.request.clone()) else { return };
        self.in_accounts(&request, |accounts, within| accounts.waits(within, request.own_place(id)));
        self.look_who_is_first(&request);
        if self.families_taken(&request.requirements).is_empty() {
            self.set_first(id, true);
        }
    }

    /// It does not any more, though it stays.
    pub(crate) fn competes_no_more(&mut self, id: WaiterId) {
        let Some(request) = self.queue.get(id).map(|waiter| waiter.request.clone()) else { return };
        self.set_first(id, false);
        self.has_competed(&request, id, false);
    }

    /// It does not any more; it was served as the first of its session, or was not.
    pub(crate) fn has_competed(&mut self, request: &AcquireRequest, id: WaiterId, served: bool) {
        self.in_accounts(request, |accounts, within| accounts.waits_no_more(within, request.own_place(id), served));
        self.look_who_is_first(request);
    }

    /// Who is the first of a session where a request competes, or has competed.
    fn look_who_is_first(&mut self, request: &AcquireRequest) {
        let mut concerned = BTreeSet::new();
        for family in self.families_taken(&request.requirements) {
            concerned.extend(self.accounts.first_two(&request.session, family));
        }
        for id in concerned {
            let Some(waiter) = self.queue.get(id) else { continue };
            let first = self.would_be_first(&waiter.request, id);
            if first != waiter.first {
                self.set_first(id, first);
            }
        }
    }

    fn set_first(&mut self, id: WaiterId, first: bool) {
        let Some(waiter) = self.queue.waiters.get_mut(&id) else { return };
        waiter.first = first;
        let request = waiter.request.clone();
        if first {
            self.in_accounts(&request, |accounts, within| {
                let rivals = accounts.rivals(within.family, within.now);
                accounts.begins_turn(&rivals, within);
            });
        }
        self.turn_anew(id, &mut Compared::new());
    }

    /// Puts a waiter where it stands now; whether that is another place.
    fn turn_anew(&mut self, id: WaiterId, compared: &mut Compared) -> bool {
        let Some(waiter) = self.queue.get(id) else { return false };
        let turn = match waiter.first {
            true => self.first_turn(&waiter.request, waiter.since, waiter.kept, compared),
            false => self.turn_behind(&waiter.request),
        };
        let moves = turn != waiter.turn;
        if moves {
            self.queue.move_to(id, turn);
        }
        moves
    }

    /// What sessions have had since is another amount: puts the first of each in a family where they stand now; whether one moved.
    pub(crate) fn turns_anew(&mut self, family: &str) -> bool {
        let (firsts, mut compared) = (self.accounts.firsts(family), Compared::new());
        self.worked += firsts.len();
        let mut moved = false;
        for id in firsts {
            moved |= self.turn_anew(id, &mut compared);
        }
        moved
    }

    /// Does something in the accounts that the session of a request has of the families that it takes something of.
    fn in_accounts(&mut self, request: &AcquireRequest, mut act: impl FnMut(&mut Accounts, &Within<'_>)) {
        let (session, Standing { share, .. }) = (&request.session, self.standing(&request.session));
        for kind in kinds_taken(&request.requirements) {
            let family = self.resources.family(kind);
            act(&mut self.accounts, &Within { session, family, share, now: self.now });
        }
    }

    /// Does something in the account that a session has of the family of a kind.
    pub(crate) fn in_account(&mut self, session: &SessionId, kind: &str, act: impl FnOnce(&mut Accounts, &Within<'_>)) {
        let Standing { share, .. } = self.standing(session);
        let family = self.resources.family(kind);
        act(&mut self.accounts, &Within { session, family, share, now: self.now });
    }

    /// The accounts of those who hold something, from now on. Nobody waits.
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

    /// The families of which something is wanted.
    fn families_taken<'a>(&'a self, requirements: &'a [Requirement]) -> BTreeSet<&'a str> {
        kinds_taken(requirements).map(|kind| self.resources.family(kind)).collect()
    }

    /// The same of what everybody has, for the invariants.
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
            if waiter.first != waiter.turn.step().is_some() {
                return Err(format!("the turn of {id} is not that of a first request, or of one behind it"));
            }
        }
        self.accounts.agree(&has)
    }
}

/// The kinds of which something is wanted.
fn kinds_taken(requirements: &[Requirement]) -> impl Iterator<Item = &str> {
    requirements.iter().filter(|requirement| takes(requirement)).map(|requirement| requirement.kind.as_str())
}

impl AcquireRequest {
    fn own_place(&self, id: WaiterId) -> OwnPlace {
        (self.speculative, Reverse(self.priority), id)
    }

    /// For what may turn out not to be needed: all that is needed for certain comes before it.
    #[must_use]
    pub fn speculative(mut self, speculative: bool) -> AcquireRequest {
        self.speculative = speculative;
        self
    }

    /// In the place of another request of the session, by its id: it keeps the time at which that one was asked, and that one leaves.
    #[must_use]
    pub fn instead_of(mut self, request_id: &str) -> AcquireRequest {
        request_id.clone_into(&mut self.instead_of);
        self
    }
}

impl Standing {
    /// With this share, and nothing due.
    pub fn of(share: Share) -> Standing {
        Standing { share, due: None }
    }
}
