//! What sessions are beside each other: the shares and due times that they say, the turns of their requests, and what is put to whose account.

use crate::accounts::{Accounts, Within};
use crate::error::PoolError;
use crate::event::Refusal;
use crate::group::{Key, key, takes};
use crate::id::SessionId;
use crate::memory::{Recalled, RequestId};
use crate::pool::Pool;
use crate::queue::AcquireRequest;
use crate::turn::{Share, Standing, Turn, step};
use ratn_model::resource::{Quantity, Requirement};
use ratn_model::time::Timestamp;
use std::collections::BTreeSet;
use std::time::Duration;

/// A due time that is said again, counted from another moment, is the same within this.
const SAME_DUE: Duration = Duration::from_secs(1);

impl Pool {
    /// A session says what it is beside others. It counts for what is asked, held and given back from now on; requests that wait stay where
    /// they are. Not written down: after a restart it is to be said again.
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
            let units = |family: &str| self.resources.quantity_of_family(family);
            self.accounts.has_share(id, standing.share, self.now, units);
        }
        if let Some(session) = self.sessions.get_mut(id) {
            session.standing = Standing { due, ..standing };
        }
        Ok(())
    }

    /// What a session is beside others; as usual where it is unknown.
    pub(crate) fn standing(&self, id: &SessionId) -> Standing {
        self.sessions.get(id).map(|session| session.standing).unwrap_or_default()
    }

    /// When a request was asked, by the count of turns. One that it replaces leaves the queue.
    pub(crate) fn asked_at(&mut self, request: &AcquireRequest, id: &RequestId) -> Timestamp {
        let mut earlier = self.left.take(self.now, id);
        if earlier.is_none()
            && !request.instead_of.is_empty()
            && let Some(session) = self.sessions.get(&request.session)
        {
            let replaced = RequestId::new(&session.opened_by, &request.instead_of);
            if let Some(Recalled::Waiting(waiter)) = self.memory.reply(&replaced)
                && self.queue.get(waiter).is_some_and(|waiter| waiter.request.session == request.session)
            {
                self.refuse(waiter, Refusal::Cancelled);
            }
            earlier = self.left.take(self.now, &replaced);
        }
        let groups = |request: &AcquireRequest| request.requirements.iter().map(key).collect::<Vec<Key>>();
        let asked = earlier.and_then(|earlier| earlier.asked_for(self.now, request.speculative, &groups(request)));
        asked.unwrap_or(self.now)
    }

    /// The turn of a request that was asked at `asked` and waits from now on.
    pub(crate) fn turn_of(&mut self, request: &AcquireRequest, asked: Timestamp) -> Turn {
        let Standing { due, .. } = self.standing(&request.session);
        let (mut clock, mut last, mut is_alone) = (asked, None, true);
        for kind in self.kinds_taken(&request.requirements) {
            self.in_account(&request.session, kind, |accounts, within| {
                clock = clock.max(accounts.ask(within));
                match accounts.alone(within.session, within.family) {
                    Some(own) => last = last.max(own),
                    None => is_alone = false,
                }
            });
        }
        let step = last.filter(|_| is_alone).unwrap_or_else(|| step(asked, clock));
        Turn::of(request.speculative, step, due, request.priority)
    }

    /// A request begins to wait, or does not any more.
    pub(crate) fn count_waiting(&mut self, request: &AcquireRequest, turn: Turn, waits: bool) {
        for kind in self.kinds_taken(&request.requirements) {
            self.in_account(&request.session, kind, |accounts, within| match waits {
                true => accounts.waits(within, turn.step()),
                false => accounts.waits_no_more(within, turn.step()),
            });
        }
    }

    /// Does something in the account that a session has of the family of a kind.
    pub(crate) fn in_account(&mut self, session: &SessionId, kind: &str, act: impl FnOnce(&mut Accounts, &Within<'_>)) {
        let Standing { share, .. } = self.standing(session);
        let family = self.resources.family(kind);
        let units = self.resources.quantity_of_family(family);
        act(&mut self.accounts, &Within { session, family, share, units, now: self.now });
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

    /// A kind of each family of which something is wanted.
    fn kinds_taken<'a>(&self, requirements: &'a [Requirement]) -> Vec<&'a str> {
        let mut families = BTreeSet::new();
        let taken = requirements.iter().filter(|requirement| takes(requirement)).map(|one| one.kind.as_str());
        taken.filter(|kind| families.insert(self.resources.family(kind))).collect()
    }

    /// The same of what everybody has, for the invariants.
    pub(crate) fn accounts_agree(&self) -> Result<(), String> {
        let mut has = std::collections::BTreeMap::<_, (Quantity, usize)>::new();
        for lease in self.leases.values() {
            for (slot, amount) in &lease.held {
                let Some(resource) = self.resources.get(*slot) else { continue };
                let family = self.resources.family(&resource.description.kind).into();
                has.entry((lease.session.clone(), family)).or_default().0 += *amount;
            }
        }
        for (_, waiter) in self.queue.iter() {
            for kind in self.kinds_taken(&waiter.request.requirements) {
                let family = self.resources.family(kind).into();
                has.entry((waiter.request.session.clone(), family)).or_default().1 += 1;
            }
        }
        self.accounts.agree(&has)?;
        let mut units = std::collections::BTreeMap::<&str, Quantity>::new();
        for (_, resource) in self.resources.iter() {
            *units.entry(self.resources.family(&resource.description.kind)).or_default() += resource.quantity();
        }
        let counted = units.into_iter().all(|(family, units)| self.resources.quantity_of_family(family) == units);
        if counted { Ok(()) } else { Err("the units of a family are miscounted".to_owned()) }
    }
}

impl AcquireRequest {
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
